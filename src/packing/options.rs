//! What can be asked of packing: rotations, gutter, grid, aspect, search.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::params::{params, word_or_number};

/// Rotations that packing may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Rotation {
    /// Quarter turns: no texel is resampled.
    Quarter,
    /// Any angle: tighter, resampled.
    Any,
    /// None.
    None,
}

params! {
    /// How charts are placed on sheets.
    pub struct Pack {
        /// Rotations that are allowed.
        pub rotation: Rotation = Rotation::Quarter;
        /// Whether charts may be mirrored.
        pub mirror: bool = false;
        /// Charts move by multiples of this many texels of the smallest slot. "auto" is 1, or in atlases with JPEG textures the sides of the
        /// blocks that these are encoded by (8 or 16), where that makes the sheet hardly larger: such blocks lose nothing more.
        pub grid: Grid = Grid::Auto;
        /// Free texels between the texels of two charts, in the smallest slot; "auto" is 2 without mipmaps, else 4. With g of them, no
        /// texel of mip levels 0 to log2 g mixes two charts, and up to the level before, filtering at a border reads nothing of another chart.
        pub gutter: Gutter = Gutter::Auto;
        /// Width / height of a sheet; null is free.
        pub aspect: Option<f64> = None, in 0.01..=100;
        /// How hard packing searches.
        pub search: PackSearch = PackSearch::Fast;
    }
}

/// How hard packing searches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum PackSearch {
    /// Several orders and sheet shapes with the greedy raster packer: about a second.
    Fast,
    /// Then guided local search over layouts: about ten seconds on two cores, several points denser.
    Thorough,
}

word_or_number! {
    /// Free texels between charts.
    pub enum Gutter {
        /// 2 texels where the sampler has no mipmaps, else 4.
        Auto = "auto";
        /// Texels of the smallest slot.
        Texels(u32) in 0..=64,
    }
}

word_or_number! {
    /// What charts move by.
    pub enum Grid {
        /// Texels; where a slot is JPEG, the blocks that it is encoded by, if that makes the sheet hardly larger.
        Auto = "auto";
        /// Multiples of this many texels of the smallest slot.
        Texels(u32) in 1..=64,
    }
}
