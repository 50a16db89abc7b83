//! Every option of a job, with unit, range and default. The same structs give the JSON Schema.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

use super::box_cutter::params::BoxCutter;
use super::defrag::params::Defrag;
pub use super::fabrication::{FabricationParams, Seams};
use crate::asset::{ReadOptions, Tiling};
use crate::atlas::OverlapMode;
use crate::metrics::Requirement;
use crate::packing::{Pack, Rotation};
use crate::texture::Texture;

/// All options of a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    /// A preset's name, or the stages in order.
    pub recipe: Recipe,
    /// How charts are placed on sheets.
    pub pack: Pack,
    /// Parameters of the stage `box_cutter`, where the stage does not say its own.
    pub box_cutter: BoxCutter,
    /// Parameters of the stage `defrag`, where the stage does not say its own.
    pub defrag: Defrag,
    /// What the output textures are like.
    pub texture: Texture,
    /// What one atlas is.
    pub atlas: AtlasOptions,
    /// Which parts of the surface matter more; null is all alike.
    pub importance: Option<ImportanceSource>,
    /// Panels to cut from sheets, drawn of the refined charts; null draws none.
    pub fabrication: Option<FabricationParams>,
    /// Container of the output model.
    pub output: Output,
    /// Requirements on the report: a dotted path to its bounds.
    pub require: BTreeMap<String, Requirement>,
    /// Seed of every random choice.
    pub seed: u64,
    /// Limit on the work of searches, in units of work (reproducible); null is the stages' own.
    pub work_budget: Option<u64>,
    /// Wall-clock limit in seconds; searches stop with their best (not reproducible).
    pub time_limit_s: Option<f64>,
    /// Free data, returned with the job.
    pub metadata: serde_json::Map<String, Value>,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            recipe: Recipe::Preset("pack".to_owned()),
            pack: Pack::default(),
            box_cutter: BoxCutter::default(),
            defrag: Defrag::default(),
            texture: Texture::default(),
            atlas: AtlasOptions::default(),
            importance: None,
            fabrication: None,
            output: Output::Glb,
            require: BTreeMap::new(),
            seed: 0,
            work_budget: None,
            time_limit_s: None,
            metadata: serde_json::Map::new(),
        }
    }
}

impl Options {
    /// What a preset starts from; what users say goes on top.
    pub fn preset(name: &str) -> Self {
        let mut options = Options { recipe: Recipe::Preset(name.to_owned()), ..Options::default() };
        if name == "scan" || name == "scan_tight" {
            // Charts of scans that share a few texels do so by accident; fewer seams are a gain whatever the size.
            options.atlas =
                AtlasOptions { overlaps: OverlapMode::Separate, if_larger: IfLarger::Accept, ..options.atlas };
            // Texels that were kept so far are kept.
            options.box_cutter =
                BoxCutter { max_boundary_length: Some(1.3), remove_overlaps: false, weld: false, ..options.box_cutter };
        }
        if name == "fabrication" {
            // Panels are cut from sheets of material: any turn, never mirrored, every panel once.
            options.pack = Pack { rotation: Rotation::Any, mirror: false, ..Pack::default() };
            options.atlas =
                AtlasOptions { overlaps: OverlapMode::Separate, if_larger: IfLarger::Accept, ..options.atlas };
            options.fabrication = Some(FabricationParams::default());
        }
        options
    }

    /// Whether what the stage did is only taken where it makes the textures smaller.
    pub(super) fn only_if_smaller(&self, stage: &Stage) -> bool {
        matches!((&self.recipe, stage), (Recipe::Preset(name), Stage::BoxCutter(_)) if name == "scan_tight")
    }

    /// The stages of the recipe, presets written out.
    pub fn stages(&self) -> Vec<Stage> {
        match &self.recipe {
            Recipe::Stages(stages) => stages.clone(),
            Recipe::Preset(name) if name == "box_cutter" || name == "fabrication" => {
                vec![Stage::BoxCutter(self.box_cutter.clone())]
            }
            Recipe::Preset(name) if name == "defrag" || name == "scan" => vec![Stage::Defrag(self.defrag.clone())],
            Recipe::Preset(name) if name == "scan_tight" => {
                vec![Stage::Defrag(self.defrag.clone()), Stage::BoxCutter(self.box_cutter.clone())]
            }
            Recipe::Preset(_) => vec![Stage::Pack {}],
        }
    }
}

/// A preset or a list of stages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
pub enum Recipe {
    /// Name of a preset or of a single stage.
    Preset(String),
    /// Stages in order.
    Stages(Vec<Stage>),
}

/// One stage with its parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "stage", rename_all = "snake_case", deny_unknown_fields)]
pub enum Stage {
    /// Places the charts as they are; its parameters are the job's `pack`.
    Pack {},
    /// Removes overlaps, welds, and cuts charts so that they pack better, then packs them. What a stage does not say is as in the
    /// job's `box_cutter`.
    BoxCutter(BoxCutter),
    /// Merges charts along their seams, then packs them. What a stage does not say is as in the job's `defrag`.
    Defrag(Defrag),
}

impl Stage {
    /// The name in options, reports and progress.
    pub fn name(&self) -> &'static str {
        match self {
            Stage::Pack {} => "pack",
            Stage::BoxCutter(_) => "box_cutter",
            Stage::Defrag(_) => "defrag",
        }
    }
}

/// What happens when the refined textures have more pixels than the input's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum IfLarger {
    /// The atlas stays as uploaded, with a warning.
    KeepInput,
    /// The larger result is taken.
    Accept,
}

/// What one atlas is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AtlasOptions {
    /// Whether texture sets of one model that have the same slots share an atlas, equal images, textures and materials become one,
    /// factors of materials without textures go into the atlas, and what is drawn alike is drawn at once.
    pub merge: bool,
    /// What happens to charts that share texels.
    pub overlaps: OverlapMode,
    /// What happens to charts that repeat their texture.
    pub tiling: Tiling,
    /// Number of the TEXCOORD set that is refined, 0..=7.
    pub uv_set: u32,
    /// What happens when nothing is gained.
    pub if_larger: IfLarger,
}

impl Default for AtlasOptions {
    fn default() -> Self {
        AtlasOptions {
            merge: false,
            overlaps: OverlapMode::Stack,
            tiling: Tiling::Bake,
            uv_set: 0,
            if_larger: IfLarger::KeepInput,
        }
    }
}

impl AtlasOptions {
    /// What reading a model needs of them.
    pub fn reading(&self) -> ReadOptions {
        ReadOptions { uv_set: self.uv_set, tiling: self.tiling }
    }
}

/// Where weights come from: 1 is ordinary, 100 matters a hundred times as much, 0 not at all.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ImportanceSource {
    /// A vertex attribute and its component (r, g, b, a or x, y, z, w), such as `COLOR_0.r`: floats or normalised integers. Values
    /// in 0..=1 are the weights 1..=100; where any value is above 1, all are taken as they are. Primitives without it weigh 1.
    Attribute(String),
    /// A file that comes with the model, read at the uploaded texture coordinates (repeated): its first channel, linear,
    /// 0..=1, is the weights 1..=100.
    Texture(String),
    /// Weights by the materials' names, each at least 0; the others weigh 1.
    Materials(BTreeMap<String, f64>),
}

/// Container of the output model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Output {
    /// One binary file.
    Glb,
    /// JSON with side files.
    Gltf,
}
