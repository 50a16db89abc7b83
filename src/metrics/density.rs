//! Texel density: texels of the largest slot per unit of mesh length.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::charts::is_degenerate;
use crate::atlas::{Atlas, FaceId};

/// Texels of the largest slot per unit of mesh length, over triangles with an area: sqrt(UV area / 3D area).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TexelDensity {
    /// The smallest.
    pub min: Option<f64>,
    /// The median over triangles.
    pub median: Option<f64>,
    /// The largest.
    pub max: Option<f64>,
}

impl TexelDensity {
    /// Both together; a common median does not follow from two.
    pub(crate) fn with(self, other: Self) -> Self {
        let pick = |a: Option<f64>, b: Option<f64>, best: fn(f64, f64) -> f64| a.into_iter().chain(b).reduce(best);
        let (min, max) = (pick(self.min, other.min, f64::min), pick(self.max, other.max, f64::max));
        TexelDensity { min, median: None, max }
    }
}

/// The texel density of a face; none where it has no area.
pub(crate) fn of_face(atlas: &Atlas, face: FaceId) -> Option<f64> {
    let density = || (atlas.uv_area(face).abs() / atlas.area(face)).sqrt();
    (!is_degenerate(atlas, face)).then(density).filter(|d| d.is_finite())
}

pub(super) fn of(atlas: &Atlas) -> TexelDensity {
    let mut densities: Vec<f64> = atlas.faces().filter_map(|f| of_face(atlas, f)).collect();
    let middle = densities.len() / 2;
    if densities.is_empty() {
        return TexelDensity::default();
    }
    let (low, median, high) = densities.select_nth_unstable_by(middle, f64::total_cmp);
    let median = *median;
    let min = low.iter().copied().fold(median, f64::min);
    let max = high.iter().copied().fold(median, f64::max);
    TexelDensity { min: Some(min), median: Some(median), max: Some(max) }
}
