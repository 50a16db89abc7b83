//! What panels for fabrication are like.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::params::params;

params! {
    /// What panels for fabrication are like.
    pub struct FabricationParams {
        /// Millimetres by unit of the model's meshes; glTF is in metres.
        pub model_unit_mm: f64 = 1000.0, in 1e-6..=1e9;
        /// What is drawn beyond the outlines.
        pub seams: Seams = Seams::Allowance;
        /// Width of the allowance or of the flaps in millimetres.
        pub width_mm: f64 = 10.0, in 0..=10000;
        /// Edges inside a panel where the surface turns by at least this angle, in radians, are drawn dashed; null draws none.
        pub fold_angle: Option<f64> = None, in 0..=3.2;
        /// Whether both sides of a seam carry its number.
        pub numbers: bool = true;
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
