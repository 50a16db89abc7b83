//! Every option of a job: the sections that the rooms and the stages own, put together.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::openapi::schema::{AdditionalProperties, ArrayBuilder, Type};
use utoipa::openapi::{Object, RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::erased::{ErasedStage, NamedSchemas, forget_default};
pub use super::fabrication::{FabricationParams, Seams};
pub use super::importance::ImportanceSource;
pub use super::output::{Container, Output, OutputOptions};
pub use super::recipe::Recipe;
use super::recipe::{PRESETS, PresetStage, Step, preset};
use super::stage::Stage;
use super::table::{self, StageSections};
use crate::asset::{Demand, ReadOptions, Tiling, UvSet};
use crate::atlas::OverlapMode;
use crate::error::WARNINGS;
use crate::metrics::{self, Requirement};
use crate::packing::{Pack, Rotation};
use crate::params::params;
use crate::texture::Texture;
use crate::texture::{Overflow, Size};

/// All options of a job.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub struct Options {
    /// A preset's name, or the stages in order.
    pub recipe: Recipe,
    /// How charts are placed on sheets.
    pub pack: Pack,
    /// Parameters of the stages, each a section under the stage's name.
    #[serde(flatten)]
    #[schema(inline)]
    pub stages: StageSections,
    /// What the output textures are like.
    pub texture: Texture,
    /// What one atlas is.
    pub atlas: AtlasOptions,
    /// Which parts of the surface matter more; null is all alike.
    pub importance: Option<ImportanceSource>,
    /// Panels to cut from sheets, drawn of the refined charts; null draws none.
    pub fabrication: Option<FabricationParams>,
    /// What the output model is: its container, or an object of `container` and `compression`.
    pub output: Output,
    /// Requirements on the report: a dotted path to its bounds.
    pub require: BTreeMap<String, Requirement>,
    /// Codes of warnings that fail the job, whose result is there all the same.
    pub strict: Vec<String>,
    /// Path of the model to take, where an archive holds several; null takes the only one.
    pub model: Option<String>,
    /// Whether the result of an equal job of the same tenant that said so too may be taken, without running. Not with `time_limit_s`, nor
    /// from another build. Of a service only.
    pub reuse: bool,
    /// URL that is told when the job has ended (Standard Webhooks); null tells nobody. Of a service only.
    #[schema(max_length = 2048)]
    pub webhook: Option<String>,
    /// Seed of every random choice.
    pub seed: u64,
    /// Limit on the work of searches, in units of work (reproducible); null is the stages' own.
    #[schema(minimum = 1)]
    pub work_budget: Option<u64>,
    /// Wall-clock limit in seconds; searches stop with their best (not reproducible).
    #[schema(exclusive_minimum = 0, maximum = 1e9)]
    pub time_limit_s: Option<f64>,
    /// Free data, returned with the job.
    pub metadata: Map<String, Value>,
}

impl Options {
    /// What a preset starts from; what users say goes on top.
    pub fn preset(name: &str) -> Self {
        let plain = Options { recipe: Recipe::Preset(name.to_owned()), ..Options::default() };
        let Some(preset) = preset(name) else { return plain };
        let mut all = serde_json::to_value(&plain).unwrap_or_default();
        merge(&mut all, serde_json::from_str(preset.options).unwrap_or_default());
        serde_json::from_value(all).unwrap_or(plain)
    }

    /// The stages of the recipe, presets written out.
    pub fn steps(&self) -> Vec<Step> {
        let own = |stage: &str| self.stages.find(stage).cloned().or_else(|| table::find(stage));
        match &self.recipe {
            Recipe::Stages(stages) => stages.iter().cloned().map(Step::from).collect(),
            Recipe::Preset(name) => match preset(name) {
                Some(preset) => {
                    let step =
                        |of: &PresetStage| Some(Step { stage: own(of.stage)?, only_if_smaller: of.only_if_smaller });
                    preset.stages.iter().filter_map(step).collect()
                }
                None => vec![own(name).unwrap_or_else(ErasedStage::of::<Pack>).into()],
            },
        }
    }
}

impl Options {
    /// What textures must not have more of, once they are encoded.
    pub(super) fn weighed(&self) -> &[Weighed] {
        let keeps = self.atlas.if_larger == IfLarger::KeepInput && self.texture.size == Size::KeepDensity;
        if keeps { &self.atlas.if_larger_by } else { &[] }
    }

    /// What the recipe does, as far as memory is concerned.
    pub fn demand(&self) -> Demand {
        let steps = self.steps();
        let unwraps = steps.iter().any(|step| !step.stage.needs_layout());
        let copies = steps.iter().all(|step| step.stage.name() == Pack::NAME)
            && self.pack.rotation != Rotation::Any
            && self.texture.size == Size::KeepDensity
            && self.texture.scale == 1.0
            && self.texture.overflow == Overflow::Pages
            && self.texture.format.has_jpeg()
            && !self.atlas.merge;
        let ktx2 = self.texture.format.asks_for_ktx2();
        Demand { bakes: self.atlas.uv_set != UvSet::New, unwraps, copies, ktx2 }
    }
}

/// Puts `over` on top of `base`, object by object.
fn merge(base: &mut Value, over: Value) {
    match (base, over) {
        (Value::Object(base), Value::Object(over)) => {
            for (key, value) in over {
                merge(base.entry(key).or_insert(Value::Null), value);
            }
        }
        (base, over) => *base = over,
    }
}

/// The schema of [`Options`]: one object, in which the stages' sections stand beside the others, and nothing else may. A default stands
/// where what is left out has that value with every recipe.
pub struct OptionsSchema;

impl PartialSchema for OptionsSchema {
    fn schema() -> RefOr<Schema> {
        let mut options = Object::new();
        gather(Options::schema(), &mut options);
        options.additional_properties = Some(Box::new(AdditionalProperties::FreeForm(false)));
        let sections = options
            .properties
            .values_mut()
            .filter(|p| matches!(p, RefOr::Ref(r) if r.default.as_ref().is_some_and(Value::is_object)));
        sections.for_each(forget_default);
        if let Some(RefOr::T(Schema::Object(require))) = options.properties.get_mut("require") {
            let paths = Object::builder().schema_type(Type::String).enum_values(Some(metrics::paths()));
            require.property_names = Some(Box::new(paths.build().into()));
        }
        if let Some(strict) = options.properties.get_mut("strict") {
            *strict = strict_schema();
        }
        RefOr::T(options.into())
    }
}

/// The schema of `strict`: the codes of all warnings, with what each tells.
fn strict_schema() -> RefOr<Schema> {
    let codes = Object::builder().schema_type(Type::String).enum_values(Some(WARNINGS.iter().map(|w| w.0)));
    let told: Vec<String> = WARNINGS.iter().map(|(code, what)| format!("* `{code}`: {what}")).collect();
    let about = "Codes of warnings that fail the job (`strict_warning`), whose result is there all the same. The preset `gate` fills them in.";
    let all = ArrayBuilder::new().items(codes).max_items(Some(WARNINGS.len())).unique_items(true);
    all.description(Some(format!("{about}\n\n{}", told.join("\n")))).into()
}

/// Takes the defaults from those parameters that a preset has another value for.
fn forget_defaults_of_presets(schemas: &mut NamedSchemas) {
    let RefOr::T(Schema::Object(options)) = OptionsSchema::schema() else { return };
    for preset in PRESETS {
        let own: Map<String, Value> = serde_json::from_str(preset.options).unwrap_or_default();
        for (section, parameters) in own.iter().filter_map(|(key, own)| Some((key, own.as_object()?))) {
            let Some(RefOr::Ref(section)) = options.properties.get(section) else { continue };
            let is_own = |name: &str| section.ref_location.rsplit('/').next() == Some(name);
            for (_, schema) in schemas.iter_mut().filter(|(name, _)| is_own(name)) {
                let RefOr::T(Schema::Object(schema)) = schema else { continue };
                for key in parameters.keys() {
                    schema.properties.get_mut(key).into_iter().for_each(forget_default);
                }
            }
        }
    }
}

/// Puts the properties of a schema that is composed of objects into one; what describes the whole comes last.
fn gather(schema: RefOr<Schema>, into: &mut Object) {
    let description = match schema {
        RefOr::T(Schema::AllOf(all)) => {
            all.items.into_iter().for_each(|part| gather(part, into));
            all.description
        }
        RefOr::T(Schema::Object(part)) => {
            into.properties.extend(part.properties);
            part.description
        }
        _ => None,
    };
    into.description = description.or(into.description.take());
}

impl ToSchema for OptionsSchema {
    fn name() -> std::borrow::Cow<'static, str> {
        Options::name()
    }

    fn schemas(schemas: &mut NamedSchemas) {
        Options::schemas(schemas);
        forget_defaults_of_presets(schemas);
    }
}

/// What the textures of an atlas are weighed by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Weighed {
    /// Their pixels.
    Pixels,
    /// The bytes of their files.
    Bytes,
    /// Bytes on a graphics card, uncompressed with all mip levels.
    GpuBytes,
}

impl Weighed {
    /// In a sentence, after "more".
    pub(super) fn told(self) -> &'static str {
        match self {
            Weighed::Pixels => "pixels",
            Weighed::Bytes => "bytes",
            Weighed::GpuBytes => "bytes on a graphics card",
        }
    }
}

/// What happens when the refined textures are larger than the input's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum IfLarger {
    /// The atlas stays as uploaded, with a warning.
    KeepInput,
    /// The larger result is taken.
    Accept,
}

params! {
    /// What one atlas is.
    pub struct AtlasOptions {
        /// Whether texture sets of one model that have the same slots share an atlas, equal images, textures and materials become one,
        /// factors of materials without textures go into the atlas, and what is drawn alike is drawn at once.
        pub merge: bool = false;
        /// What happens to charts that share texels.
        pub overlaps: OverlapMode = OverlapMode::Stack;
        /// What happens to charts that repeat their texture.
        pub tiling: Tiling = Tiling::Bake;
        /// The TEXCOORD set that is refined, by its number; `new` makes the layout a set of its own, by the first free number: the uploaded
        /// set stays, with the images that are read through it.
        pub uv_set: UvSet = UvSet::Number(0);
        /// What happens when nothing is gained.
        pub if_larger: IfLarger = IfLarger::KeepInput;
        /// What "larger" means: more of any of these.
        pub if_larger_by: Vec<Weighed> = vec![Weighed::Pixels];
    }
}

impl AtlasOptions {
    /// What reading a model needs of them.
    pub fn reading(&self) -> ReadOptions {
        ReadOptions { uv_set: self.uv_set, tiling: self.tiling }
    }
}
