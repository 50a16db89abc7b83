//! What can be asked of packing: rotations, gutter, grid, aspect, search.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::openapi::schema::{ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use crate::params::params;

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
        /// Charts move by multiples of this many texels of the smallest slot.
        pub grid: u32 = 1, in 1..=64;
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

/// Widest gutter that can be asked for, in texels of the smallest slot.
const WIDEST_GUTTER: u32 = 64;

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
        let wanted =
            || serde::de::Error::custom(format!("gutter is \"auto\" or a number of texels in 0..={WIDEST_GUTTER}"));
        match Value::deserialize(deserializer)? {
            Value::String(s) if s == "auto" => Ok(Gutter::Auto),
            Value::Number(n) => {
                let n = n.as_u64().and_then(|n| u32::try_from(n).ok()).filter(|n| *n <= WIDEST_GUTTER);
                n.map(Gutter::Texels).ok_or_else(wanted)
            }
            _ => Err(wanted()),
        }
    }
}

impl PartialSchema for Gutter {
    fn schema() -> RefOr<Schema> {
        let auto = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(["auto"]));
        let texels = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(0)).maximum(Some(WIDEST_GUTTER));
        OneOfBuilder::new()
            .item(auto)
            .item(texels)
            .description(Some("\"auto\", or texels of the smallest slot."))
            .into()
    }
}

impl ToSchema for Gutter {}
