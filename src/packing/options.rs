//! What can be asked of packing: rotations, gutter, grid, aspect, search.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

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

/// How charts are placed on sheets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Pack {
    /// Rotations that are allowed.
    pub rotation: Rotation,
    /// Whether charts may be mirrored.
    pub mirror: bool,
    /// Charts move by multiples of this many texels of the smallest slot, 1..=64.
    pub grid: u32,
    /// Free texels between the texels of two charts, in the smallest slot, 0..=64; "auto" is 2 without mipmaps, else 4. With g of them, no
    /// texel of mip levels 0 to log2 g mixes two charts, and up to the level before, filtering at a border reads nothing of another chart.
    #[schema(value_type = Value)]
    pub gutter: Gutter,
    /// Width / height of a sheet; null is free.
    #[schema(minimum = 0.01, maximum = 100)]
    pub aspect: Option<f64>,
    /// How hard packing searches.
    pub search: PackSearch,
}

impl Default for Pack {
    fn default() -> Self {
        Pack {
            rotation: Rotation::Quarter,
            mirror: false,
            grid: 1,
            gutter: Gutter::Auto,
            aspect: None,
            search: PackSearch::Fast,
        }
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

/// Gutter width.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gutter {
    /// 2 texels where the sampler has no mipmaps, else 4.
    Auto,
    /// Texels of the smallest slot.
    Texels(u32),
}

impl Serialize for Gutter {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Gutter::Auto => serializer.serialize_str("auto"),
            Gutter::Texels(n) => serializer.serialize_u32(*n),
        }
    }
}

impl<'de> Deserialize<'de> for Gutter {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let wanted = || serde::de::Error::custom("gutter is \"auto\" or a number of texels in 0..=64");
        match Value::deserialize(deserializer)? {
            Value::String(s) if s == "auto" => Ok(Gutter::Auto),
            Value::Number(n) => {
                let n = n.as_u64().filter(|n| *n <= 64).ok_or_else(wanted)?;
                Ok(Gutter::Texels(n as u32))
            }
            _ => Err(wanted()),
        }
    }
}
