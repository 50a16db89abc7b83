//! The report's schema. Scripts and CI bots read it; see the contract before changing a name.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::Measures;
use crate::error::Warning;
use crate::texture::Format;

/// What a job says about its work.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Report {
    /// Version of this schema.
    pub schema: u32,
    /// Version of Intarsia.
    pub intarsia: String,
    /// What came in.
    pub input: InputReport,
    /// The stages that ran, in order.
    pub stages: Vec<StageReport>,
    /// The texture sets that were refined or inspected.
    pub atlases: Vec<AtlasReport>,
    /// Every texture, by atlas, page and slot.
    pub textures: Vec<TextureReport>,
    /// All atlases together.
    pub model: ModelReport,
    /// What the user should know.
    pub warnings: Vec<Warning>,
}

impl Report {
    /// The current version of the schema.
    pub const SCHEMA: u32 = 1;
}

/// What came in.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct InputReport {
    /// Name of the model file.
    pub name: String,
    /// Bytes of all files.
    pub bytes: u64,
    /// Meshes of the model.
    pub meshes: u64,
    /// Primitives of the model.
    pub primitives: u64,
    /// Triangles of the model, refined or not.
    pub triangles: u64,
    /// Materials of the model.
    pub materials: u64,
    /// Images of the model.
    pub images: u64,
}

/// A stage that ran on an atlas.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StageReport {
    /// Name of the stage.
    pub stage: String,
    /// Atlas that it ran on.
    pub atlas_id: u64,
    /// Why it ended: `done`, or the limit that cut it short (`work_budget`, `time_limit`, …).
    pub stopped_by: String,
    /// What the stage says of itself.
    #[serde(flatten)]
    pub figures: serde_json::Map<String, serde_json::Value>,
}

/// One texture set.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AtlasReport {
    /// Number of the texture set, as in file names.
    pub id: u64,
    /// Name for people.
    pub name: String,
    /// Names of the materials, or `material N`.
    pub materials: Vec<String>,
    /// Sheets after refinement.
    pub pages: u64,
    /// Whether the atlas was refined; one that was not stays out of `require`.
    pub refined: bool,
    /// As uploaded.
    pub before: Measures,
    /// As delivered.
    pub after: Measures,
}

/// One image before and after.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TextureReport {
    /// The atlas that it belongs to.
    pub atlas_id: u64,
    /// The page that it is drawn on.
    pub page: u64,
    /// Name of the slot.
    pub slot: String,
    /// Index into the model's `images`, after refinement.
    pub image_index: u64,
    /// Name of the image, where it has one.
    pub name: Option<String>,
    /// As uploaded.
    pub before: ImageReport,
    /// As delivered.
    pub after: ImageReport,
    /// Texels of the slot, on all pages, whose centre a chart covers and that were copied unchanged.
    pub verbatim_texels: u64,
    /// Surface colour before against after, before encoding, in dB, at most 120; null for directions.
    pub psnr_db: Option<f64>,
    /// Whether at all sampled points the texels of the bilinear footprint are equal (directions: after the turn).
    pub exact: bool,
    /// Median angle between directions before and after, in degrees; null for colours and data.
    pub angle_median_deg: Option<f64>,
    /// 95th percentile of that angle, in degrees.
    pub angle_p95_deg: Option<f64>,
    /// Largest difference of a channel at the sampled points, in 1/255.
    pub max_error: f64,
    /// Mean difference of a channel at mip level 2, in 1/255.
    pub mip2_mean_error: f64,
    /// Largest difference of a channel at mip level 2, in 1/255.
    pub mip2_max_error: f64,
}

/// An image file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ImageReport {
    /// Width in texels.
    pub width: u32,
    /// Height in texels.
    pub height: u32,
    /// Container.
    pub format: Format,
    /// Size of the file.
    pub bytes: u64,
}

/// All atlases together.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelReport {
    /// As uploaded.
    pub before: Measures,
    /// As delivered.
    pub after: Measures,
}
