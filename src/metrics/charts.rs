//! Counts: charts, flipped and degenerate triangles, small charts.

use super::measures::Totals;
use crate::atlas::{Atlas, Charts, FaceId, orientation};

/// Height over longest side under which a triangle counts as degenerate in 3D: what is left of an exact zero in double precision.
const SLIVER: f64 = 1e-12;

/// Whether a face has no area in UV (exactly) or in 3D (to double precision).
pub(crate) fn is_degenerate(atlas: &Atlas, face: FaceId) -> bool {
    let [a, b, c] = atlas.uv_triangle(face);
    orientation(a, b, c) == 0 || has_no_surface(atlas, face)
}

/// Whether a face has no area in 3D, to double precision.
pub(crate) fn has_no_surface(atlas: &Atlas, face: FaceId) -> bool {
    let [p, q, r] = atlas.triangle(face);
    let longest = (q - p).length_squared().max((r - q).length_squared()).max((p - r).length_squared());
    (q - p).cross(r - p).length() <= SLIVER * longest
}

/// 1 or -1 by chart: the sign of its UV area; 0 where it has none.
pub(crate) fn chart_orientations(atlas: &Atlas, charts: &Charts) -> Vec<i8> {
    let sign = |faces: &Vec<FaceId>| {
        let area: f64 = faces.iter().map(|&f| atlas.uv_area(f)).sum();
        i8::from(area > 0.0) - i8::from(area < 0.0)
    };
    charts.faces.iter().map(sign).collect()
}

pub(super) fn add(totals: &mut Totals, atlas: &Atlas, charts: &Charts) {
    totals.charts = charts.len() as u64;
    let signs = chart_orientations(atlas, charts);
    for (faces, chart_sign) in charts.faces.iter().zip(signs) {
        let mut area = 0.0;
        for &f in faces {
            area += atlas.area(f);
            let [a, b, c] = atlas.uv_triangle(f);
            totals.flipped += u64::from(orientation(a, b, c) * chart_sign < 0);
            totals.degenerate += u64::from(is_degenerate(atlas, f));
        }
        totals.surface_area += area;
        totals.chart_areas.push(area);
    }
}
