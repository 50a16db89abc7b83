//! Elements of new vertices from those of the uploaded ones.

use glam::DVec3;

use super::vertices::Point;
use crate::asset::Document;
use crate::asset::Kind;
use crate::asset::accessor::{RawAccessor, raw_elements, read_vec};
use crate::error::Result;

/// Appends an element for each point: that of its vertex, or the weighted sum of those that it lies between, finished
/// by `finish`. The order of the sum is that of the point, so that two primitives that share an edge agree.
pub(super) fn extend<const N: usize>(
    values: &mut Vec<[f32; N]>,
    points: &[Point],
    finish: impl Fn([f64; N]) -> [f32; N],
) {
    for point in points {
        let element = match point {
            Point::Vertex(v) => values.get(*v as usize).copied().unwrap_or([0.0; N]),
            _ => {
                let (weights, n) = point.weights();
                let mut sum = [0.0; N];
                for (v, weight) in &weights[..n] {
                    let value = values.get(*v as usize).copied().unwrap_or([0.0; N]);
                    // -0 of one side and 0 of the other must give the same.
                    sum = std::array::from_fn(|k| sum[k] + f64::from(value[k]) * weight);
                }
                finish(sum)
            }
        };
        values.push(element);
    }
}

/// Nothing to finish.
pub(super) fn plain<const N: usize>(v: [f64; N]) -> [f32; N] {
    v.map(|x| x as f32)
}

/// Unit length, where there is a length.
pub(super) fn unit(v: [f64; 3]) -> [f32; 3] {
    DVec3::from(v).normalize_or_zero().to_array().map(|x| x as f32)
}

/// To f64.
pub(super) fn wide(v: [f32; 3]) -> DVec3 {
    DVec3::from(v.map(f64::from))
}

/// The elements of the points copied bit by bit, from the nearest vertex of each.
pub(super) fn copied(mut raw: RawAccessor, points: &[Point]) -> RawAccessor {
    let size = raw.element_size;
    raw.data.reserve_exact(points.len().saturating_mul(size));
    for point in points {
        let start = nearest(point) as usize * size;
        let element = raw.data.get(start..start + size).map_or_else(|| vec![0; size], <[u8]>::to_vec);
        raw.data.extend_from_slice(&element);
    }
    raw.count += points.len();
    raw
}

/// The vertex with the largest weight, the first of equals.
pub(super) fn nearest(point: &Point) -> u32 {
    let (weights, n) = point.weights();
    weights[..n].iter().fold(weights[0], |best, w| if w.1 > best.1 { *w } else { best }).0
}

/// Elements as floats, those of the points interpolated. Matrices are copied.
pub(super) fn interpolated(doc: &Document, accessor: usize, kind: Kind, points: &[Point]) -> Result<RawAccessor> {
    fn floats<const N: usize>(doc: &Document, accessor: usize, points: &[Point]) -> Result<RawAccessor> {
        let mut values = read_vec::<N>(doc, accessor)?;
        extend(&mut values, points, plain);
        Ok(RawAccessor::from_floats(&values))
    }
    match kind {
        Kind::Scalar => floats::<1>(doc, accessor, points),
        Kind::Vec2 => floats::<2>(doc, accessor, points),
        Kind::Vec3 => floats::<3>(doc, accessor, points),
        Kind::Vec4 => floats::<4>(doc, accessor, points),
        Kind::Mat2 | Kind::Mat3 | Kind::Mat4 => Ok(copied(raw_elements(doc, accessor)?, points)),
    }
}
