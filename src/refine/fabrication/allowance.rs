//! An outline about an outline. Where a panel is narrower than twice the width it crosses itself, which cutters and
//! people can do with.

use glam::DVec2;

use super::outline::normal;

/// Corners whose mitre would be longer than so many widths are bevelled.
const MITRE: f64 = 2.0;

/// A closed loop moved outwards by `width`; `outward` as [`super::outline::Outlines::outward`] gives it.
pub(super) fn offset(ring: &[DVec2], outward: f64, width: f64) -> Vec<DVec2> {
    let mut points: Vec<DVec2> = ring.to_vec();
    points.dedup();
    while points.len() > 1 && points.first() == points.last() {
        points.pop();
    }
    let n = points.len();
    if n < 3 {
        return Vec::new();
    }
    let mut out = Vec::with_capacity(n + 4);
    for i in 0..n {
        let (before, at, after) = (points[(i + n - 1) % n], points[i], points[(i + 1) % n]);
        join(at, normal([before, at], outward), normal([at, after], outward), outward, width, &mut out);
    }
    out
}

/// The corner of an offset line at a point between two edges with these normals. Where the outline turns outwards the corner
/// stays in the notch, so that no line runs into the panel.
pub(super) fn join(at: DVec2, a: DVec2, b: DVec2, outward: f64, width: f64, out: &mut Vec<DVec2>) {
    // The mitre is as long as 1 / cos(half the turn).
    let cos = (0.5 * (1.0 + a.dot(b))).max(0.0).sqrt();
    // Direction of the second edge, from its normal.
    let along = DVec2::new(-b.y, b.x) * outward;
    if cos * MITRE >= 1.0 {
        out.push(at + (a + b) / (1.0 + a.dot(b)) * width);
    } else if along.dot(a) <= 0.0 {
        out.extend([at + a * width, at + b * width]);
    } else {
        out.push(at + (a + b).normalize_or_zero() * MITRE * width);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn notches_stay_outside_and_tips_are_bevelled() {
        // A square of 20 with a narrow notch in its upper side (y down: the inside is below), either way round.
        let ring = [(0.0, 0.0), (9.0, 0.0), (10.0, 8.0), (11.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0)];
        let ring: Vec<DVec2> = ring.into_iter().map(DVec2::from).collect();
        let offset_of = |reversed: bool| {
            let mut ring = ring.clone();
            if reversed {
                ring.reverse();
            }
            offset(&ring, if reversed { -1.0 } else { 1.0 }, 2.0)
        };
        for points in [offset_of(false), offset_of(true)] {
            let inside = |p: &DVec2| {
                let notch = (p.x - 10.0).abs() < 1.0 - p.y / 8.0;
                (0.0..=20.0).contains(&p.x) && (0.0..=20.0).contains(&p.y) && !notch
            };
            assert!(!points.iter().any(inside), "{points:?}");
            for corner in [(-2.0, -2.0), (22.0, -2.0), (22.0, 22.0), (-2.0, 22.0), (10.0, 4.0)].map(DVec2::from) {
                assert!(points.iter().any(|p| (*p - corner).length() < 1e-9), "{corner} in {points:?}");
            }
        }
        // A needle's tip would be far out: it is cut off.
        let needle = [(0.0, 0.0), (100.0, 1.0), (0.0, 2.0)].map(DVec2::from);
        let points = offset(&needle, 1.0, 2.0);
        assert!(points.iter().all(|p| p.x < 103.0), "{points:?}");
    }
}
