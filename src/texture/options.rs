//! What can be asked of the output textures: size, sheets, format.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::openapi::schema::{ArrayBuilder, ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::Role;
use crate::params::{params, word_or_number};

/// Longest side of a sheet that can be asked for, in texels.
const LONGEST_SIDE: u32 = 16384;

/// Size of the output sheet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Size {
    /// Texel density is kept; the sheet becomes as small as the charts allow.
    KeepDensity,
    /// The sheet keeps its size; the charts are scaled to fill it.
    KeepSize,
    /// Width and height of the largest slot in texels.
    #[serde(untagged)]
    Fixed([u32; 2]),
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
            .filter(|s| s.iter().all(|n| (1..=LONGEST_SIDE).contains(n)))
            .map(Size::Fixed)
            .ok_or_else(|| {
                serde::de::Error::custom(format!(
                    "size is \"keep_density\", \"keep_size\" or [width, height], each in 1..={LONGEST_SIDE}",
                ))
            })
    }
}

impl PartialSchema for Size {
    fn schema() -> RefOr<Schema> {
        let named = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(["keep_density", "keep_size"]));
        let side = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(1)).maximum(Some(LONGEST_SIDE));
        let fixed = ArrayBuilder::new().items(side).min_items(Some(2)).max_items(Some(2));
        let text = "\"keep_density\", \"keep_size\", or width and height of the largest slot in texels.";
        OneOfBuilder::new().item(named).item(fixed).description(Some(text)).into()
    }
}

impl ToSchema for Size {}

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
    /// As it was uploaded; KTX2 without Basis Universal becomes PNG.
    Keep,
    /// PNG, lossless.
    Png,
    /// JPEG; images with alpha or 16 bits become PNG.
    Jpeg,
    /// WebP (EXT_texture_webp); images of 16 bits become PNG.
    Webp,
    /// KTX2 (KHR_texture_basisu): ETC1S or UASTC as it was uploaded; of other files ETC1S for colour and UASTC for the rest. Images of 16 bits become PNG.
    Ktx2,
    /// KTX2 with blocks of ETC1S: small; for colour.
    #[serde(rename = "ktx2-etc1s")]
    Ktx2Etc1s,
    /// KTX2 with blocks of UASTC: larger, and closer to what was uploaded; for normals and data.
    #[serde(rename = "ktx2-uastc")]
    Ktx2Uastc,
}

impl TextureFormat {
    /// Whether files are, or may stay, KTX2.
    pub(crate) fn may_be_ktx2(self) -> bool {
        self == TextureFormat::Keep || self.is_ktx2()
    }

    fn is_ktx2(self) -> bool {
        matches!(self, TextureFormat::Ktx2 | TextureFormat::Ktx2Etc1s | TextureFormat::Ktx2Uastc)
    }
}

/// Formats of the output textures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum TextureFormats {
    /// One for all.
    All(TextureFormat),
    /// By what the texture means; the others are kept.
    BySlot(BTreeMap<Role, TextureFormat>),
}

impl From<TextureFormat> for TextureFormats {
    fn from(format: TextureFormat) -> Self {
        TextureFormats::All(format)
    }
}

impl TextureFormats {
    /// That of the textures of a role.
    pub fn of(&self, role: Role) -> TextureFormat {
        match self {
            TextureFormats::All(format) => *format,
            TextureFormats::BySlot(formats) => formats.get(&role).copied().unwrap_or(TextureFormat::Keep),
        }
    }

    /// Whether JPEG files stay, or become, JPEG files; of some slots at least.
    pub fn has_jpeg(&self) -> bool {
        match self {
            TextureFormats::All(format) => matches!(format, TextureFormat::Keep | TextureFormat::Jpeg),
            TextureFormats::BySlot(_) => true,
        }
    }

    /// Whether files that are encoded by blocks stay so, of some slots at least: what moves by whole blocks can keep them.
    pub fn keeps_blocks(&self) -> bool {
        match self {
            TextureFormats::All(format) => !matches!(format, TextureFormat::Png | TextureFormat::Webp),
            TextureFormats::BySlot(_) => true,
        }
    }

    /// Whether some textures are to become KTX2 files that were none.
    pub fn asks_for_ktx2(&self) -> bool {
        match self {
            TextureFormats::All(format) => format.is_ktx2(),
            TextureFormats::BySlot(formats) => formats.values().any(|format| format.is_ktx2()),
        }
    }
}

impl<'de> Deserialize<'de> for TextureFormats {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let value = Value::deserialize(deserializer)?;
        let read = if value.is_object() {
            serde_json::from_value(value).map(TextureFormats::BySlot)
        } else {
            serde_json::from_value(value).map(TextureFormats::All)
        };
        read.map_err(serde::de::Error::custom)
    }
}

impl PartialSchema for TextureFormats {
    fn schema() -> RefOr<Schema> {
        let by_slot = ObjectBuilder::new()
            .schema_type(Type::Object)
            .property_names(Some(Role::schema()))
            .additional_properties(Some(TextureFormat::schema()));
        let text = "One format for all textures, or an object of formats by slot, as {\"normal\": \"png\"}: the others are kept.";
        OneOfBuilder::new().item(TextureFormat::schema()).item(by_slot).description(Some(text)).into()
    }
}

impl ToSchema for TextureFormats {}

word_or_number! {
    /// How much JPEG files lose.
    pub enum JpegQuality {
        /// As the uploaded files.
        Keep = "keep";
        /// A quality; from 90 on chroma keeps its resolution.
        Quality(u8) in 1..=100,
    }
}

word_or_number! {
    /// How much WebP files lose.
    pub enum WebpQuality {
        /// As the uploaded files, if they were WebP; else nothing.
        Keep = "keep",
        /// Nothing.
        Lossless = "lossless";
        /// A quality.
        Quality(u8) in 0..=100,
    }
}

params! {
    /// What the output textures are like.
    pub struct Texture {
        /// "keep_density", "keep_size" or [width, height] of the largest slot.
        pub size: Size = Size::KeepDensity;
        /// Factor on the texel density that "keep_density" keeps: below 1 all charts become smaller, and are resampled.
        pub scale: f64 = 1.0, in 0.01..=1;
        /// Sheet sides are multiples of this many texels.
        pub multiple_of: u32 = 4, in 1..=256;
        /// Sheet sides are powers of two.
        pub power_of_two: bool = false;
        /// Longest side of a sheet in texels.
        pub max_size: u32 = 8192, in 16..=16384;
        /// What happens beyond `max_size`.
        pub overflow: Overflow = Overflow::Pages;
        /// Format of the files, or formats by slot.
        pub format: TextureFormats = TextureFormats::All(TextureFormat::Keep);
        /// Quality of JPEG files. "keep" takes quantisation tables, chroma subsampling and progressive scans of the uploaded files, the finest
        /// where several become one; 92 where these were no JPEG.
        pub jpeg_quality: JpegQuality = JpegQuality::Keep;
        /// Quality of WebP files. "keep" is lossless where the uploaded files were, and the best of theirs where they were lossy WebP.
        pub webp_quality: WebpQuality = WebpQuality::Keep;
    }
}

impl Texture {
    /// What in `size` does not agree with the other parameters, each in a sentence.
    pub fn conflicts(&self) -> Vec<String> {
        if self.size != Size::KeepDensity && self.scale != 1.0 {
            return vec!["`size` says how large the sheet is: `scale` is for \"keep_density\"".to_owned()];
        }
        let Size::Fixed(size) = self.size else { return Vec::new() };
        let (max, multiple) = (self.max_size, self.multiple_of.max(1));
        let conflicts = [
            (size.iter().any(|s| *s > max), format!("`size` {size:?} exceeds `max_size` {max}")),
            (
                size.iter().any(|s| s % multiple != 0),
                format!("`size` {size:?} is no multiple of `multiple_of` {multiple}"),
            ),
            (
                self.power_of_two && !size.iter().all(|s| s.is_power_of_two()),
                format!("`size` {size:?} is no power of two"),
            ),
        ];
        conflicts.into_iter().filter(|(found, _)| *found).map(|(_, sentence)| sentence).collect()
    }
}
