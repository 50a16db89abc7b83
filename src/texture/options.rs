//! What can be asked of the output textures: size, sheets, format.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

/// Size of the output sheet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// Texel density is kept; the sheet becomes as small as the charts allow.
    KeepDensity,
    /// The sheet keeps its size; the charts are scaled to fill it.
    KeepSize,
    /// Width and height of the largest slot in texels.
    Fixed([u32; 2]),
}

impl Serialize for Size {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Size::KeepDensity => serializer.serialize_str("keep_density"),
            Size::KeepSize => serializer.serialize_str("keep_size"),
            Size::Fixed(size) => size.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for Size {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let value = Value::deserialize(deserializer)?;
        match value.as_str() {
            Some("keep_density") => return Ok(Size::KeepDensity),
            Some("keep_size") => return Ok(Size::KeepSize),
            _ => {}
        }
        serde_json::from_value::<[u32; 2]>(value)
            .ok()
            .filter(|s| s.iter().all(|n| (1..=16384).contains(n)))
            .map(Size::Fixed)
            .ok_or_else(|| {
                serde::de::Error::custom(
                    "size is \"keep_density\", \"keep_size\" or [width, height], each in 1..=16384",
                )
            })
    }
}

/// What happens when the charts do not fit on one sheet of `max_size`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Overflow {
    /// Further sheets.
    Pages,
    /// The charts are scaled down.
    Scale,
}

/// Format of the output textures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TextureFormat {
    /// PNG stays PNG, JPEG stays JPEG, lossless WebP stays WebP; KTX2 and lossy WebP become PNG.
    Keep,
    /// PNG, lossless.
    Png,
    /// JPEG; images with alpha or 16 bits become PNG.
    Jpeg,
    /// WebP, lossless (EXT_texture_webp); images of 16 bits become PNG.
    Webp,
}

/// What the output textures are like.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Texture {
    /// "keep_density", "keep_size" or [width, height] of the largest slot.
    #[schema(value_type = Value)]
    pub size: Size,
    /// Sheet sides are multiples of this many texels, 1..=256.
    pub multiple_of: u32,
    /// Sheet sides are powers of two.
    pub power_of_two: bool,
    /// Longest side of a sheet in texels, 16..=16384.
    pub max_size: u32,
    /// What happens beyond `max_size`.
    pub overflow: Overflow,
    /// Format of the files.
    pub format: TextureFormat,
    /// Quality of JPEG files, 1..=100.
    pub jpeg_quality: u8,
}

impl Default for Texture {
    fn default() -> Self {
        Texture {
            size: Size::KeepDensity,
            multiple_of: 4,
            power_of_two: false,
            max_size: 8192,
            overflow: Overflow::Pages,
            format: TextureFormat::Keep,
            jpeg_quality: 92,
        }
    }
}
