//! Outlines: the polygons of charts and of what cuts leave of them, in the chart's own coordinates.

use glam::DVec2;

use crate::atlas::bvh::Bounds;

/// A polygon with holes: closed loops, outer ones with positive signed area, holes with negative.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Outline {
    /// Vertices of each loop, in order, the first not repeated.
    pub loops: Vec<Vec<DVec2>>,
}

/// A directed line: the points `point + t * along`; what lies to its side has a positive [`Line::side`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Line {
    /// Where t is 0.
    pub point: DVec2,
    /// Unit vector.
    pub along: DVec2,
}

impl Line {
    /// Signed distance of a point.
    pub fn side(&self, p: DVec2) -> f64 {
        self.along.perp_dot(p - self.point)
    }

    /// Place along the line of the point nearest to `p`.
    pub fn t(&self, p: DVec2) -> f64 {
        self.along.dot(p - self.point)
    }

    /// The point at `t`.
    pub fn at(&self, t: f64) -> DVec2 {
        self.point + self.along * t
    }
}

/// The part of a line between two points of an outline, with inside about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Chord {
    /// Where it starts and ends, as places along the line.
    pub from: f64,
    /// See `from`.
    pub to: f64,
    /// Crossed edges at its ends: loop and index of the edge's first vertex.
    ends: [(u32, u32); 2],
}

impl Chord {
    /// Its length.
    pub fn length(&self) -> f64 {
        self.to - self.from
    }

    /// The edges of the outline that it ends at.
    pub fn edges(&self, outline: &Outline) -> [(DVec2, DVec2); 2] {
        self.ends.map(|(l, i)| {
            let l = &outline.loops[l as usize];
            (l[i as usize], l[(i as usize + 1) % l.len()])
        })
    }
}

impl Outline {
    /// Area of the polygon.
    pub fn area(&self) -> f64 {
        self.loops.iter().map(|l| signed_area(l)).sum()
    }

    /// Length of all loops.
    pub fn length(&self) -> f64 {
        self.edges().map(|(a, b)| a.distance(b)).sum()
    }

    /// All edges.
    pub fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
        self.loops.iter().flat_map(|l| (0..l.len()).map(|i| (l[i], l[(i + 1) % l.len()])))
    }

    /// The chords that the polygon has on a line, ordered along it. A vertex on the line counts as lying on its positive side.
    pub fn chords(&self, line: &Line) -> Vec<Chord> {
        let mut crossings: Vec<(f64, u32, u32)> = Vec::new();
        for (n, l) in self.loops.iter().enumerate() {
            let mut before = l.last().map_or(0.0, |p| line.side(*p));
            for i in 0..l.len() {
                let here = line.side(l[i]);
                if (before < 0.0) != (here < 0.0) {
                    let last = (i + l.len() - 1) % l.len();
                    crossings.push((line.t(crossing(l[last], before, l[i], here)), n as u32, last as u32));
                }
                before = here;
            }
        }
        crossings.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        crossings
            .chunks_exact(2)
            .map(|pair| Chord { from: pair[0].0, to: pair[1].0, ends: [0, 1].map(|k| (pair[k].1, pair[k].2)) })
            .collect()
    }

    /// The polygon cut along some of its chords of a line: its parts. A chord that meets a hole need not separate anything.
    pub fn split(&self, line: &Line, chords: &[Chord]) -> Vec<Outline> {
        if chords.is_empty() {
            return vec![self.clone()];
        }
        // All vertices as one ring buffer of successors; a chord's end is two vertices, one for each direction.
        let mut points: Vec<DVec2> = self.loops.iter().flatten().copied().collect();
        let mut start = Vec::with_capacity(self.loops.len());
        let mut next: Vec<u32> = Vec::with_capacity(points.len() + 4 * chords.len());
        for l in &self.loops {
            let first = next.len() as u32;
            start.push(first);
            next.extend((1..=l.len() as u32).map(|i| first + i % l.len() as u32));
        }
        // Crossings by edge, in the order in which the edge meets them: an edge meets a line once.
        for chord in chords {
            let ends = [chord.from, chord.to].map(|t| line.at(t));
            let arrive = [points.len() as u32, points.len() as u32 + 2];
            for k in 0..2 {
                let (l, i) = chord.ends[k];
                let from = start[l as usize] + i;
                points.extend([ends[k]; 2]);
                let leave = arrive[k] + 1;
                next.extend([0, next[from as usize]]);
                next[from as usize] = arrive[k];
                debug_assert_eq!(next.len() as u32, leave + 1);
            }
            next[arrive[0] as usize] = arrive[1] + 1;
            next[arrive[1] as usize] = arrive[0] + 1;
        }
        let mut seen = vec![false; points.len()];
        let mut loops: Vec<Vec<DVec2>> = Vec::new();
        for i in 0..points.len() {
            let mut own = Vec::new();
            let mut at = i;
            while !seen[at] {
                seen[at] = true;
                if own.last() != Some(&points[at]) {
                    own.push(points[at]);
                }
                at = next[at] as usize;
            }
            while own.len() > 1 && own.first() == own.last() {
                own.pop();
            }
            if own.len() > 2 {
                loops.push(own);
            }
        }
        group(loops)
    }

    /// The least box that holds it.
    pub fn bounds(&self) -> Bounds {
        Bounds::of(self.loops.iter().flatten())
    }
}

/// Where the edge from `a` to `b` meets the line, given the distances of its ends; the same whichever end comes first.
pub(crate) fn crossing(a: DVec2, side_a: f64, b: DVec2, side_b: f64) -> DVec2 {
    let ((a, sa), (b, sb)) =
        if (a.x, a.y) <= (b.x, b.y) { ((a, side_a), (b, side_b)) } else { ((b, side_b), (a, side_a)) };
    a + (b - a) * (sa / (sa - sb))
}

/// Shoelace area.
pub(crate) fn signed_area(l: &[DVec2]) -> f64 {
    let Some(&origin) = l.first() else { return 0.0 };
    l.windows(2).map(|w| (w[0] - origin).perp_dot(w[1] - origin)).sum::<f64>() * 0.5
}

fn inside(l: &[DVec2], p: DVec2) -> bool {
    let mut odd = false;
    for i in 0..l.len() {
        let (a, b) = (l[i], l[(i + 1) % l.len()]);
        if (a.y > p.y) != (b.y > p.y) && p.x < a.x + (b.x - a.x) * ((p.y - a.y) / (b.y - a.y)) {
            odd = !odd;
        }
    }
    odd
}

/// Loops to polygons: each outer loop with the holes that lie in it.
fn group(loops: Vec<Vec<DVec2>>) -> Vec<Outline> {
    let (outer, holes): (Vec<_>, Vec<_>) = loops.into_iter().partition(|l| signed_area(l) >= 0.0);
    let mut parts: Vec<Outline> = outer.into_iter().map(|l| Outline { loops: vec![l] }).collect();
    for hole in holes {
        // The middle of an edge is less likely to lie on another loop than a vertex.
        let probe = (hole[0] + hole[1]) * 0.5;
        let home = (0..parts.len())
            .filter(|&i| inside(&parts[i].loops[0], probe))
            .min_by(|&a, &b| signed_area(&parts[a].loops[0]).total_cmp(&signed_area(&parts[b].loops[0])));
        match (home, parts.is_empty()) {
            (Some(i), _) => parts[i].loops.push(hole),
            (None, false) => parts[0].loops.push(hole),
            (None, true) => parts.push(Outline { loops: vec![hole] }),
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, y: f64, side: f64) -> Vec<DVec2> {
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|p| DVec2::from(p) * side + DVec2::new(x, y)).to_vec()
    }

    fn vertical(x: f64) -> Line {
        Line { point: DVec2::new(x, 0.0), along: DVec2::Y }
    }

    #[test]
    fn a_square_is_halved() {
        let outline = Outline { loops: vec![square(0.0, 0.0, 4.0)] };
        let chords = outline.chords(&vertical(1.0));
        assert_eq!(chords.iter().map(Chord::length).collect::<Vec<_>>(), [4.0]);
        let parts = outline.split(&vertical(1.0), &chords);
        let mut areas: Vec<f64> = parts.iter().map(Outline::area).collect();
        areas.sort_by(f64::total_cmp);
        assert_eq!(areas, [4.0, 12.0]);
        let length: f64 = parts.iter().map(Outline::length).sum();
        assert_eq!(length, 16.0 + 8.0);
    }

    #[test]
    fn a_chord_to_a_hole_does_not_separate_and_two_do() {
        let mut hole = square(1.0, 1.0, 2.0);
        hole.reverse();
        let outline = Outline { loops: vec![square(0.0, 0.0, 4.0), hole] };
        let chords = outline.chords(&vertical(2.0));
        assert_eq!(chords.len(), 2);
        let one = outline.split(&vertical(2.0), &chords[..1]);
        assert_eq!((one.len(), one[0].loops.len(), one[0].area()), (1, 1, 12.0));
        let two = outline.split(&vertical(2.0), &chords);
        assert_eq!(two.iter().map(Outline::area).collect::<Vec<_>>(), [6.0, 6.0]);
    }

    #[test]
    fn a_comb_loses_one_tooth_only_where_asked() {
        let comb: Vec<DVec2> = [[0, 0], [9, 0], [9, 9], [6, 9], [6, 3], [3, 3], [3, 9], [0, 9]]
            .map(|[x, y]| DVec2::new(f64::from(x), f64::from(y)))
            .to_vec();
        let outline = Outline { loops: vec![comb] };
        let line = Line { point: DVec2::new(0.0, 5.0), along: DVec2::X };
        let chords = outline.chords(&line);
        assert_eq!(chords.len(), 2);
        for chord in &chords {
            let parts = outline.split(&line, &[*chord]);
            let mut areas: Vec<f64> = parts.iter().map(Outline::area).collect();
            areas.sort_by(f64::total_cmp);
            assert_eq!(areas, [12.0, outline.area() - 12.0]);
        }
        assert_eq!(outline.split(&line, &chords).len(), 3);
    }

    #[test]
    fn vertices_on_the_line_are_no_trouble() {
        let diamond = [[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]].map(DVec2::from).to_vec();
        let outline = Outline { loops: vec![diamond] };
        let parts = outline.split(&vertical(0.0), &outline.chords(&vertical(0.0)));
        assert_eq!(parts.iter().map(Outline::area).collect::<Vec<_>>(), [1.0, 1.0]);
        for x in [-1.0, 1.0] {
            let parts = outline.split(&vertical(x), &outline.chords(&vertical(x)));
            assert_eq!(parts.iter().map(Outline::area).sum::<f64>(), 2.0, "a touched corner costs nothing");
        }
    }
}
