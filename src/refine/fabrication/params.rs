//! What panels for fabrication are like.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What panels for fabrication are like.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FabricationParams {
    /// Millimetres by unit of the model's meshes, 1e-6..=1e9; glTF is in metres.
    #[schema(minimum = 1e-6, maximum = 1e9)]
    pub model_unit_mm: f64,
    /// What is drawn beyond the outlines.
    pub seams: Seams,
    /// Width of the allowance or of the flaps in millimetres, 0..=10000.
    #[schema(minimum = 0, maximum = 10000)]
    pub width_mm: f64,
    /// Edges inside a panel where the surface turns by at least this angle, in radians in 0..=pi, are drawn dashed; null draws none.
    #[schema(minimum = 0, maximum = 3.2)]
    pub fold_angle: Option<f64>,
    /// Whether both sides of a seam carry its number.
    pub numbers: bool,
}

impl Default for FabricationParams {
    fn default() -> Self {
        FabricationParams {
            model_unit_mm: 1000.0,
            seams: Seams::Allowance,
            width_mm: 10.0,
            fold_angle: None,
            numbers: true,
        }
    }
}

/// What is drawn beyond the outlines of panels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Seams {
    /// Nothing.
    None,
    /// A second outline about the first, for sewing.
    Allowance,
    /// Flaps on one of the two sides of each seam, for gluing.
    Flaps,
}
