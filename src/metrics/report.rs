//! The report's schema. Scripts and CI bots read it; see the contract before changing a name.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Measures, RefinementOutcome};
use crate::asset::Merged;
use crate::error::Warning;
use crate::texture::Format;

/// What a job says about its work.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Report {
    /// Version of this schema.
    pub schema: u32,
    /// Version of Intarsia.
    pub intarsia: String,
    /// What became of all that came in; null where it was only inspected.
    pub outcome: Option<RefinementOutcome>,
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
    /// What merging did, model by model; empty where it was not asked for or the model does not let it.
    pub merged: Vec<Merged>,
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
    /// Name of the model file; of several, their names.
    pub name: String,
    /// Bytes of all files.
    pub bytes: u64,
    /// Meshes of all models.
    pub meshes: u64,
    /// Primitives of all models.
    pub primitives: u64,
    /// Triangles of all models, refined or not.
    pub triangles: u64,
    /// Materials of all models.
    pub materials: u64,
    /// Images of all models.
    pub images: u64,
    /// The models, in the order in which they came.
    pub models: Vec<ModelInput>,
}

/// One model as it came in.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelInput {
    /// Name of the model file.
    pub name: String,
    /// Bytes of its files; files that several models come with count for each.
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
    /// Why it ended. `done`; or the limit that cut it short (`work_budget`, `time_limit`, a parameter of the stage); or `no_improvement`:
    /// its search found nothing better than what it had. Where its result was not taken: `not_smaller`, because that has more pixels than
    /// it may have (`atlas.if_larger`, or a preset that asks for less), or `reverted`, because it was broken. What became of the atlas
    /// then is its `outcome`.
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
    /// Models that share it: indices into `input.models`.
    pub models: Vec<u64>,
    /// Names of the materials, or `material N`; model by model.
    pub materials: Vec<String>,
    /// Numbers of the TEXCOORD sets that have the delivered layout: more than one where its primitives have different ones free.
    pub uv_sets: Vec<u64>,
    /// Sheets after refinement.
    pub pages: u64,
    /// What became of it; null where it was only inspected.
    pub outcome: Option<RefinementOutcome>,
    /// Whether it has a layout, so that its figures count: one without stays out of `require`. `outcome` tells what became of it.
    pub refined: bool,
    /// Least and greatest weight of its surface, where `importance` gives weights.
    pub importance: Option<[f64; 2]>,
    /// As uploaded; of several sets that share it, their sheets side by side.
    pub before: Measures,
    /// As delivered.
    pub after: Measures,
}

/// One image before and after. Fidelity is that of the delivered file, decoded, against the uploaded one; figures that begin with `layout_`
/// tell what the new layout alone cost, before the file was encoded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TextureReport {
    /// The atlas that it belongs to.
    pub atlas_id: u64,
    /// The page that it is drawn on.
    pub page: u64,
    /// Name of the slot.
    pub slot: String,
    /// Index into the model's `images`, as uploaded; of several sources, the largest one's.
    pub image_index: u64,
    /// Name of the image, where it has one.
    pub name: Option<String>,
    /// As uploaded; of several sources, the largest.
    pub before: ImageReport,
    /// Every uploaded image that it was made of.
    pub sources: Vec<TextureSource>,
    /// As delivered.
    pub after: ImageReport,
    /// Texels of the slot, on all pages, whose centre a chart covers and that were copied unchanged, before encoding.
    pub verbatim_texels: u64,
    /// Surface colour before against after in dB, at most 120; null for directions.
    #[schema(maximum = 120)]
    pub psnr_db: Option<f64>,
    /// The same before encoding, where the encoder changed it.
    #[schema(maximum = 120)]
    pub layout_psnr_db: Option<f64>,
    /// Whether at all sampled points the texels of the bilinear footprint are equal (directions: after the turn).
    pub exact: bool,
    /// The same before encoding: true where `exact` is false if the encoder alone changed texels.
    pub layout_exact: bool,
    /// Median angle between directions before and after, in degrees; null for colours and data.
    pub angle_median_deg: Option<f64>,
    /// 95th percentile of that angle, in degrees.
    pub angle_p95_deg: Option<f64>,
    /// Median angle before encoding, where the encoder changed it.
    pub layout_angle_median_deg: Option<f64>,
    /// 95th percentile of the angle before encoding, where the encoder changed it.
    pub layout_angle_p95_deg: Option<f64>,
    /// Largest difference of a channel at the sampled points, in 1/255.
    pub max_error: f64,
    /// Mean difference of a channel at mip level 2, in 1/255.
    pub mip2_mean_error: f64,
    /// Largest difference of a channel at mip level 2, in 1/255.
    pub mip2_max_error: f64,
}

/// An uploaded image that became part of a texture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TextureSource {
    /// Its model: an index into `input.models`.
    pub model: u64,
    /// Index into the model's `images`, as uploaded.
    pub image_index: u64,
    /// Name of the image, where it has one.
    pub name: Option<String>,
    /// As uploaded.
    pub before: ImageReport,
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
