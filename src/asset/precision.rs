//! How far from the origin 32 bits still hold a shape.

/// Coordinates below this are near the origin.
pub(crate) const NEAR: f64 = 1000.0;
/// Distance from the origin, in parts of the extent, from which on 32 bits are too few.
const FAR: f64 = 32.0;

/// How far away what fills a box is, in parts of its extent; 0 for what has none.
pub(crate) fn remoteness(low: [f64; 3], high: [f64; 3]) -> f64 {
    let extent = (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max);
    if extent > 0.0 && extent.is_finite() { farthest(low, high) / extent } else { 0.0 }
}

/// Whether what fills a box lies so far from the origin that 32 bits would move its vertices by more than some millionths of its extent.
pub(crate) fn is_far(low: [f64; 3], high: [f64; 3]) -> bool {
    farthest(low, high) >= NEAR && remoteness(low, high) > FAR
}

/// The largest coordinate of a box, whatever its sign.
fn farthest(low: [f64; 3], high: [f64; 3]) -> f64 {
    (0..3).map(|k| low[k].abs().max(high[k].abs())).fold(0.0, f64::max)
}

/// The box of some points, those left out that are none.
pub(crate) fn bounding_box(points: impl Iterator<Item = [f64; 3]>) -> ([f64; 3], [f64; 3]) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for point in points.filter(|p| p.iter().all(|x| x.is_finite())) {
        for k in 0..3 {
            (low[k], high[k]) = (low[k].min(point[k]), high[k].max(point[k]));
        }
    }
    (low, high)
}
