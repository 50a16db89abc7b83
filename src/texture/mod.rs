//! Textures: decode, resample through provenance, fill, encode.
//!
//! All images are kept at their native depth and channel count; one slot at a time is in memory.

mod bake;
mod baker;
mod basis;
mod bilinear_fit;
mod coverage;
mod decode;
mod direction;
mod encode;
mod fidelity;
mod jpeg;
mod options;
mod pixels;
mod png;
mod push_pull;
mod sampler;
mod slot;
mod strips;
mod texel_map;
mod transfer;
mod webp;

pub use bake::{Bake, Baked, Source, bake, page_size};
pub(crate) use basis::{BLOCK as BASIS_BLOCK, LONGEST as BASIS_SIDE};
pub use basis::{BasisCoding, BasisKind, BasisUpload, MipFilter};
pub(crate) use decode::{basis_upload, jpeg_coding, webp_quality};
pub use decode::{decode, header, is_lossy, probe};
pub use encode::{Coding, encode};
pub(crate) use fidelity::mix;
pub use fidelity::{Fidelity, SAMPLES as FIDELITY_SAMPLES, UploadedColors, fidelity};
pub use jpeg::JpegCoding;
pub use options::{JpegQuality, Overflow, Size, Texture, TextureFormat, TextureFormats, WebpQuality};
pub(crate) use pixels::from_samples;
pub use pixels::{depth, neutral, texel, widened};
pub(crate) use png::zlib;
pub use slot::{Reading, Slot};
pub use strips::{STREAMED_FROM, Streamed, bake_jpeg};
pub(crate) use transfer::{linear_to_srgb, srgb_to_linear};
pub(crate) use webp::LONGEST as WEBP_SIDE;

use std::fmt;

use serde::{Deserialize, Serialize};

/// What an image means, which decides how it is filtered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// sRGB colour, alpha linear.
    BaseColor,
    /// Linear data (G roughness, B metalness; R often occlusion).
    MetallicRoughness,
    /// Tangent-space normals.
    Normal,
    /// Linear data in R.
    Occlusion,
    /// sRGB colour.
    Emissive,
    /// Linear data in R (KHR_materials_clearcoat).
    Clearcoat,
    /// Linear data in G (KHR_materials_clearcoat).
    ClearcoatRoughness,
    /// Tangent-space normals (KHR_materials_clearcoat).
    ClearcoatNormal,
    /// sRGB colour (KHR_materials_sheen).
    SheenColor,
    /// Linear data in A (KHR_materials_sheen).
    SheenRoughness,
    /// Linear data in A (KHR_materials_specular).
    Specular,
    /// sRGB colour (KHR_materials_specular).
    SpecularColor,
    /// Linear data in R (KHR_materials_transmission).
    Transmission,
    /// Linear data in G (KHR_materials_volume).
    Thickness,
    /// Linear data in R (KHR_materials_iridescence).
    Iridescence,
    /// Linear data in G (KHR_materials_iridescence).
    IridescenceThickness,
    /// A direction in the tangent plane in RG, linear strength in B (KHR_materials_anisotropy).
    Anisotropy,
    /// Linear data in A (KHR_materials_diffuse_transmission).
    DiffuseTransmission,
    /// sRGB colour (KHR_materials_diffuse_transmission).
    DiffuseTransmissionColor,
    /// sRGB colour, alpha linear (KHR_materials_pbrSpecularGlossiness).
    Diffuse,
    /// sRGB colour, glossiness linear in A (KHR_materials_pbrSpecularGlossiness).
    SpecularGlossiness,
}

/// Kinds of texels that turn with their chart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Direction {
    /// RGB is a unit vector in tangent space, `value * 2 - 1`.
    Normal,
    /// RG is a direction along the surface in tangent space, `value * 2 - 1`; B is a strength in 0..=1, which does not turn.
    /// A direction and its opposite mean the same.
    Anisotropy,
}

impl fmt::Display for Role {
    /// The name in reports and file names.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl Role {
    /// Whether the colour channels are sRGB-encoded.
    pub fn is_srgb(self) -> bool {
        use Role::{
            BaseColor, Diffuse, DiffuseTransmissionColor, Emissive, SheenColor, SpecularColor, SpecularGlossiness,
        };
        matches!(
            self,
            BaseColor | Emissive | SheenColor | SpecularColor | DiffuseTransmissionColor | Diffuse | SpecularGlossiness
        )
    }

    /// Which directions the texels are, if any: they turn with their chart.
    pub fn direction(self) -> Option<Direction> {
        match self {
            Role::Normal | Role::ClearcoatNormal => Some(Direction::Normal),
            Role::Anisotropy => Some(Direction::Anisotropy),
            _ => None,
        }
    }

    /// Whether the texels are directions that turn with their chart.
    pub fn is_direction(self) -> bool {
        self.direction().is_some()
    }
}

/// How texels outside the image are read, per axis (glTF sampler `wrapS`, `wrapT`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Wrap {
    /// 10497, the glTF default.
    #[default]
    Repeat,
    /// 33648.
    MirroredRepeat,
    /// 33071.
    ClampToEdge,
}

impl Wrap {
    /// The texel in `0..size` that index `i` reads.
    pub fn texel(self, i: i64, size: i64) -> i64 {
        match self {
            Wrap::Repeat => i.rem_euclid(size),
            Wrap::MirroredRepeat => {
                let j = i.rem_euclid(2 * size);
                if j < size { j } else { 2 * size - 1 - j }
            }
            Wrap::ClampToEdge => i.clamp(0, size - 1),
        }
    }
}

/// How alpha is treated when a base colour is resampled (material `alphaMode`).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Alpha {
    /// Colour is independent of alpha.
    #[default]
    Opaque,
    /// Coverage is kept at the cutoff.
    Mask(f64),
    /// Colour is premultiplied while filtering.
    Blend,
}

/// Container format of an image file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// PNG.
    Png,
    /// JPEG.
    Jpeg,
    /// WebP.
    Webp,
    /// KTX2 with blocks of Basis Universal; other contents are read only.
    Ktx2,
}

impl Format {
    /// File name extension.
    pub fn extension(self) -> &'static str {
        match self {
            Format::Png => "png",
            Format::Jpeg => "jpg",
            Format::Webp => "webp",
            Format::Ktx2 => "ktx2",
        }
    }
    /// The format whose files have an extension, in lower case.
    pub(crate) fn of_extension(extension: &str) -> Option<Format> {
        let extension = if extension == "jpeg" { "jpg" } else { extension };
        [Format::Png, Format::Jpeg, Format::Webp, Format::Ktx2].into_iter().find(|f| f.extension() == extension)
    }
    /// Media type.
    pub fn media_type(self) -> &'static str {
        match self {
            Format::Png => "image/png",
            Format::Jpeg => "image/jpeg",
            Format::Webp => "image/webp",
            Format::Ktx2 => "image/ktx2",
        }
    }
}

/// What a header says, before anything is decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
    /// Channels after decoding (palettes expanded).
    pub channels: u8,
    /// Bits a channel after decoding: 8 or 16.
    pub depth: u8,
    /// Container.
    pub format: Format,
}

#[cfg(test)]
mod tests;
