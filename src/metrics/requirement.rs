//! What a user may require of a figure.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Bounds on one figure of the report.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
#[schema(min_properties = 1)]
pub struct Requirement {
    /// The figure after refinement is at least this.
    pub min: Option<f64>,
    /// The figure after refinement is at most this.
    pub max: Option<f64>,
    /// After minus before is at least this.
    pub min_gain: Option<f64>,
    /// After divided by before is at most this.
    pub max_ratio: Option<f64>,
}
