//! What can be asked of reading a model.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What happens to charts that repeat their texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Tiling {
    /// The repeated texels are baked out, up to a limit.
    Bake,
    /// Their material is left as it is.
    Leave,
}

/// What reading a model needs to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadOptions {
    /// Number of the TEXCOORD set that is refined.
    pub uv_set: u32,
    /// What happens to charts that repeat their texture.
    pub tiling: Tiling,
}

impl Default for ReadOptions {
    fn default() -> Self {
        ReadOptions { uv_set: 0, tiling: Tiling::Bake }
    }
}
