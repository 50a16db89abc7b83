//! Cut lines: where they lie, how they are shifted, and which of their chords are cut (Box Cutter, sections 3.1, 3.2 and 3.2.2).

use super::outline::{Chord, Line, Outline};

/// Offsets that the line search looks at (Box Cutter 3.2, "Optimizing Cut Locations").
pub(crate) const OFFSETS: usize = 100;

/// The line, shifted to its side.
pub(crate) fn shifted(line: &Line, by: f64) -> Line {
    Line { point: line.point + line.along.perp() * by, ..*line }
}

/// The places of the line search: evenly spaced within `reach` to both sides.
pub(crate) fn offset(k: usize, reach: f64) -> f64 {
    reach * (2.0 * k as f64 / (OFFSETS - 1) as f64 - 1.0)
}

/// Adds the length of the chords that an outline has on the line shifted to each offset.
///
/// On a line, the places at which the border goes in and out alternate: their signed sum is the length inside. One pass over
/// the edges serves all offsets.
pub(crate) fn add_lengths(outline: &Outline, line: &Line, reach: f64, lengths: &mut [f64; OFFSETS]) {
    if reach <= 0.0 {
        return;
    }
    let mut own = [0.0; OFFSETS];
    let step = 2.0 * reach / (OFFSETS - 1) as f64;
    for (a, b) in outline.edges() {
        let (va, vb) = (line.side(a), line.side(b));
        let (low, high) = (va.min(vb), va.max(vb));
        if high < -reach || low > reach || va == vb {
            continue;
        }
        let (ua, ub) = (line.t(a), line.t(b));
        let first = ((low + reach) / step).ceil().max(0.0) as usize;
        for (k, sum) in own.iter_mut().enumerate().skip(first) {
            let v = offset(k, reach);
            if v >= high {
                break;
            }
            if v < low {
                continue;
            }
            let u = ua + (ub - ua) * ((v - va) / (vb - va));
            *sum += if va < vb { u } else { -u };
        }
    }
    for (sum, own) in lengths.iter_mut().zip(own) {
        *sum += own.abs();
    }
}

/// The chords of an outline on a line that may be cut: of each part that all of them leave, the greatest distance from the line
/// is at least `least`; the chords of smaller parts are left uncut (Box Cutter 3.2.2, "Preventing Small Charts").
pub(crate) fn chords(outline: &Outline, line: &Line, least: f64) -> Vec<Chord> {
    let mut chords = outline.chords(line);
    // What hardly touches the line is no cut.
    chords.retain(|c| c.length() > least * 1e-3);
    while least > 0.0 && !chords.is_empty() {
        let parts = outline.split(line, &chords);
        let small: Vec<&Outline> = parts
            .iter()
            .filter(|p| p.loops.iter().flatten().map(|v| line.side(*v).abs()).fold(0.0, f64::max) < least)
            .collect();
        if small.is_empty() {
            break;
        }
        let before = chords.len();
        chords.retain(|c| !small.iter().any(|p| touches(p, line, c, least)));
        if chords.len() == before {
            return Vec::new();
        }
    }
    chords
}

/// Whether a part has the chord on its border.
fn touches(part: &Outline, line: &Line, chord: &Chord, scale: f64) -> bool {
    let near = |a: f64, b: f64| (a - b).abs() < scale * 1e-6;
    part.edges().any(|(a, b)| {
        let (ta, tb) = (line.t(a), line.t(b));
        line.side(a).abs() < scale * 1e-6
            && line.side(b).abs() < scale * 1e-6
            && near(ta.min(tb), chord.from)
            && near(ta.max(tb), chord.to)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    fn polygon(points: &[[f64; 2]]) -> Outline {
        Outline { loops: vec![points.iter().map(|p| DVec2::from(*p)).collect()] }
    }

    #[test]
    fn lengths_are_those_of_the_chords() {
        let comb = polygon(&[[0., 0.], [9., 0.], [9., 9.], [6., 8.], [6., 3.], [3., 3.], [2., 9.], [0., 7.]]);
        let line = Line { point: DVec2::new(0.0, 4.0), along: DVec2::X };
        let mut lengths = [0.0; OFFSETS];
        add_lengths(&comb, &line, 6.0, &mut lengths);
        for (k, length) in lengths.iter().enumerate() {
            let expected: f64 = comb.chords(&shifted(&line, offset(k, 6.0))).iter().map(Chord::length).sum();
            assert!((length - expected).abs() < 1e-9, "{k}: {length} {expected}");
        }
    }

    #[test]
    fn small_parts_are_not_cut_off() {
        // A bar with a long tooth and a short one.
        let bar = polygon(&[
            [0., 0.],
            [9., 0.],
            [9., 4.],
            [8., 4.],
            [8., 2.],
            [2., 2.],
            [2., 2.3],
            [1., 2.3],
            [1., 2.],
            [0., 2.],
        ]);
        let line = Line { point: DVec2::new(0.0, 2.1), along: DVec2::X };
        assert_eq!(chords(&bar, &line, 0.0).len(), 2);
        let kept = chords(&bar, &line, 1.0);
        assert_eq!(kept.iter().map(Chord::length).collect::<Vec<_>>(), [1.0]);
        assert!(kept[0].from == 8.0 || kept[0].to == 8.0 || kept[0].from == -9.0);
        assert_eq!(chords(&bar, &line, 3.0), []);
    }
}
