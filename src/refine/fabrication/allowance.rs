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
        join(at, normal([before, at], outward), normal([at, after], outward), width, &mut out);
    }
    out
}

/// The corner of an offset line at a point between two edges with these normals.
pub(super) fn join(at: DVec2, a: DVec2, b: DVec2, width: f64, out: &mut Vec<DVec2>) {
    // The mitre is as long as 1 / cos(half the turn).
    let cos = (0.5 * (1.0 + a.dot(b))).max(0.0).sqrt();
    if cos * MITRE >= 1.0 {
        out.push(at + (a + b) / (1.0 + a.dot(b)) * width);
    } else {
        out.extend([at + a * width, at + b * width]);
    }
}
