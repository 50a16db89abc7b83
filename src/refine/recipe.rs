//! What a recipe is: stages in order, or the name of a preset, which is a row of a table.

use serde::{Deserialize, Serialize};
use utoipa::openapi::schema::{ArrayBuilder, ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{Ref, RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::erased::{ErasedStage, NamedSchemas};
use super::table;

/// Most stages of a recipe.
pub const MAX_STAGES: usize = 32;

/// A preset or a list of stages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Recipe {
    /// Name of a preset or of a single stage.
    Preset(String),
    /// Stages in order.
    Stages(Vec<ErasedStage>),
}

impl Default for Recipe {
    fn default() -> Self {
        Recipe::Preset("pack".to_owned())
    }
}

impl PartialSchema for Recipe {
    fn schema() -> RefOr<Schema> {
        let text = || ObjectBuilder::new().schema_type(Type::String);
        let name = text().enum_values(Some(recipes().map(|(name, _)| name)));
        let stages: Vec<&str> = table::all().map(|stage| stage.name()).collect();
        let (stage, more) = (stages.join("|"), MAX_STAGES - 1);
        let joined = text().pattern(Some(format!(r"^\s*({stage})\s*(,\s*({stage})\s*){{1,{more}}}$")));
        let stages = ArrayBuilder::new()
            .items(Ref::from_schema_name(ErasedStage::name()))
            .min_items(Some(1))
            .max_items(Some(MAX_STAGES));
        OneOfBuilder::new()
            .item(name.description(Some("A preset, or a stage alone.")))
            .item(joined.description(Some("Stages in order, joined by commas.")))
            .item(stages.description(Some("Stages in order, with their parameters.")))
            .description(Some("A preset or a list of stages."))
            .into()
    }
}

impl ToSchema for Recipe {
    fn schemas(schemas: &mut NamedSchemas) {
        schemas.push((ErasedStage::name().into_owned(), ErasedStage::schema()));
        ErasedStage::schemas(schemas);
    }
}

/// Stages and options under a name.
#[derive(Debug, Clone, Copy)]
pub struct Preset {
    /// The name.
    pub name: &'static str,
    /// What it does, in one sentence.
    pub description: &'static str,
    /// Its stages in order.
    pub stages: &'static [PresetStage],
    /// What the options start from, as users would write it; what users say goes on top.
    pub options: &'static str,
}

/// A stage of a preset. Its parameters are those of its section in the options.
#[derive(Debug, Clone, Copy)]
pub struct PresetStage {
    /// Name of the stage.
    pub stage: &'static str,
    /// Whether its result is taken only where it makes the textures smaller.
    pub only_if_smaller: bool,
}

impl PresetStage {
    const fn new(stage: &'static str) -> Self {
        PresetStage { stage, only_if_smaller: false }
    }
}

/// Charts of scans that share a few texels do so by accident, and fewer seams are a gain whatever the size. Texels that merging kept are
/// kept: cutting neither welds nor removes overlaps.
const FOR_SCANS: &str = r#"{"atlas": {"overlaps": "separate", "if_larger": "accept"},
    "box_cutter": {"max_boundary_length": 1.3, "remove_overlaps": false, "weld": false}}"#;

/// The presets. A stage alone is a recipe too, under its own name.
pub const PRESETS: &[Preset] = &[
    Preset {
        name: "scan",
        description: "For photogrammetry: merges charts, each placed for itself, and packs them tightly.",
        stages: &[PresetStage::new("defrag")],
        options: FOR_SCANS,
    },
    Preset {
        name: "scan_tight",
        description: "The same, then cuts charts within a budget of boundary length where that makes the textures smaller still.",
        stages: &[PresetStage::new("defrag"), PresetStage { stage: "box_cutter", only_if_smaller: true }],
        options: FOR_SCANS,
    },
    Preset {
        name: "gate",
        description: "Packs, and fails the job where an image is missing or cannot be read, or where there is nothing to refine: for CI, with require.",
        stages: &[PresetStage::new("pack")],
        options: r#"{"strict": ["missing_image", "invalid_image", "nothing_to_refine"]}"#,
    },
    // Panels are cut from sheets of material: any turn, never mirrored, every panel once.
    Preset {
        name: "fabrication",
        description: "Cuts and packs 2D panels for sheets of material, without overlaps, and draws them as SVG with seam allowances or flaps.",
        stages: &[PresetStage::new("box_cutter")],
        options: r#"{"pack": {"rotation": "any", "mirror": false}, "atlas": {"overlaps": "separate", "if_larger": "accept"},
            "fabrication": {}}"#,
    },
    Preset {
        name: "unwrap",
        description: "Makes a layout of the surface alone: the shortest seams that a bound on distortion allows, packed. What has a layout keeps it, with its textures, and gets one more.",
        stages: &[PresetStage::new("optcuts")],
        options: r#"{"atlas": {"uv_set": "new", "if_larger": "accept"}, "optcuts": {"start": "fresh"}}"#,
    },
    Preset {
        name: "polish",
        description: "Shortens the seams of the uploaded layout, without more distortion than it has, and packs it.",
        stages: &[PresetStage::new("optcuts")],
        options: r#"{"atlas": {"if_larger": "accept"}, "optcuts": {"start": "uploaded", "max_distortion": "input"}}"#,
    },
    Preset {
        name: "unwrap_tight",
        description: "As unwrap, then deforms and cuts the charts until they pack with the efficiency that is asked for.",
        stages: &[PresetStage::new("optcuts"), PresetStage::new("bounded")],
        options: r#"{"atlas": {"uv_set": "new", "overlaps": "separate", "if_larger": "accept"}, "optcuts": {"start": "fresh"}}"#,
    },
    Preset {
        name: "lightmap",
        description: "A TEXCOORD set more in which nothing overlaps, nine tenths of the sheet's box are covered and four texels lie between charts; textures stay.",
        stages: &[PresetStage::new("bounded")],
        options: r#"{"atlas": {"uv_set": "new", "overlaps": "separate", "if_larger": "accept"}, "pack": {"gutter": 4},
            "texture": {"power_of_two": true}, "bounded": {"packing_efficiency": 0.9}}"#,
    },
    Preset {
        name: "tight",
        description: "Bounds packing efficiency and seams at once, by deforming and cutting or by cutting alone, whichever needs shorter seams.",
        stages: &[PresetStage::new("bounded")],
        options: r#"{"atlas": {"overlaps": "separate", "if_larger": "accept"},
            "bounded": {"max_boundary_length": 1.35, "straight_cuts_alone": true}}"#,
    },
];

/// The preset of that name.
pub fn preset(name: &str) -> Option<&'static Preset> {
    PRESETS.iter().find(|preset| preset.name == name)
}

/// All that `recipe` can name, each with what it does: the stages, then the presets.
pub fn recipes() -> impl Iterator<Item = (&'static str, &'static str)> {
    let stages = table::all().map(|stage| (stage.name(), stage.description()));
    stages.chain(PRESETS.iter().map(|preset| (preset.name, preset.description)))
}

/// A stage that is about to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The stage with its parameters.
    pub stage: ErasedStage,
    /// Whether its result is taken only where it makes the textures smaller.
    pub only_if_smaller: bool,
}

impl From<ErasedStage> for Step {
    fn from(stage: ErasedStage) -> Self {
        Step { stage, only_if_smaller: false }
    }
}
