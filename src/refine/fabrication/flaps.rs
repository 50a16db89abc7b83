//! Flaps to glue a panel's neighbour to.

use glam::DVec2;

use super::allowance::join;
use super::outline::normal;

/// A flap is at most this part of its seam wide, so that its slanted ends do not meet.
const WIDEST: f64 = 0.4;

/// The flap on a stretch of outline: its points, from the stretch's start over the flap to the stretch's end. A trapezoid
/// with ends at 45 degrees where the stretch is straight.
pub(super) fn flap(line: &[DVec2], outward: f64, width: f64) -> Vec<DVec2> {
    let mut points: Vec<DVec2> = line.to_vec();
    points.dedup();
    let [first, .., last] = points.as_slice() else { return Vec::new() };
    let edges: Vec<[DVec2; 2]> = points.windows(2).map(|w| [w[0], w[1]]).collect();
    let length: f64 = edges.iter().map(|[a, b]| (*b - *a).length()).sum();
    // The slant must not pass the ends of short edges.
    let ends = edges.iter().take(1).chain(edges.last()).map(|[a, b]| (*b - *a).length()).fold(length, f64::min);
    let width = width.min(WIDEST * length);
    let slant = width.min(WIDEST * ends);
    let along = |e: &[DVec2; 2]| (e[1] - e[0]).normalize_or_zero();
    let (head, tail) = (&edges[0], &edges[edges.len() - 1]);
    let mut out = vec![*first, *first + normal(*head, outward) * width + along(head) * slant];
    for pair in edges.windows(2) {
        join(pair[0][1], normal(pair[0], outward), normal(pair[1], outward), outward, width, &mut out);
    }
    out.push(*last + normal(*tail, outward) * width - along(tail) * slant);
    out.push(*last);
    out
}
