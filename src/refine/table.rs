//! The table of all stages, and their parameters in the options of a job.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value};
use utoipa::PartialSchema;
use utoipa::openapi::schema::Ref;
use utoipa::openapi::{Object, RefOr, Schema};

use super::bounded::params::Bounded;
use super::box_cutter::params::BoxCutter;
use super::defrag::params::Defrag;
use super::erased::{ErasedStage, NamedSchemas};
use super::optcuts::params::OptCuts;
use super::stage::Stage;
use crate::packing::Pack;

/// Every stage there is, in the order in which they are listed. A stage is a folder, and a line here.
static STAGES: &[fn() -> ErasedStage] = &[
    ErasedStage::of::<Pack>,
    ErasedStage::of::<BoxCutter>,
    ErasedStage::of::<Defrag>,
    ErasedStage::of::<OptCuts>,
    ErasedStage::of::<Bounded>,
    #[cfg(test)]
    ErasedStage::of::<super::tests::nudge::Nudge>,
];

/// The stages, each with its defaults.
pub fn all() -> impl Iterator<Item = ErasedStage> {
    STAGES.iter().map(|stage| stage())
}

/// The stage of that name, with its defaults.
pub fn find(name: &str) -> Option<ErasedStage> {
    all().find(|stage| stage.name() == name)
}

/// The stages whose parameters are a section of their own in the options.
fn sections() -> impl Iterator<Item = ErasedStage> {
    all().filter(|stage| !stage.is_shared())
}

/// The parameters of each stage for those of its runs that do not say their own: sections of the options, by the stages' names.
#[derive(Debug, Clone, PartialEq)]
pub struct StageSections(Vec<ErasedStage>);

impl Default for StageSections {
    fn default() -> Self {
        StageSections(sections().collect())
    }
}

impl StageSections {
    /// The stages with their parameters, in the order of the table.
    pub fn iter(&self) -> impl Iterator<Item = &ErasedStage> {
        self.0.iter()
    }

    /// The stage of that name, if it has a section.
    pub fn find(&self, name: &str) -> Option<&ErasedStage> {
        self.iter().find(|stage| stage.name() == name)
    }

    /// The parameters of a stage.
    pub fn get<S: Stage>(&self) -> S {
        self.iter().find_map(ErasedStage::get::<S>).cloned().unwrap_or_default()
    }

    /// Replaces the parameters of a stage.
    pub fn set<S: Stage>(&mut self, parameters: S) {
        self.replace(ErasedStage::new(parameters));
    }

    /// Replaces the parameters of the stage of the same name.
    pub(super) fn replace(&mut self, stage: ErasedStage) {
        if let Some(own) = self.0.iter_mut().find(|own| own.name() == stage.name()) {
            *own = stage;
        }
    }
}

impl Serialize for StageSections {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.iter().map(|stage| (stage.name(), stage.to_value())))
    }
}

impl<'de> Deserialize<'de> for StageSections {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut all = StageSections::default();
        for (name, parameters) in Map::<String, Value>::deserialize(deserializer)? {
            let stage = all.find(&name).ok_or_else(|| D::Error::custom(format!("unknown field `{name}`")))?;
            let parsed = stage.parsed(parameters).map_err(|e| D::Error::custom(format!("{name}: {e}")))?;
            all.replace(parsed);
        }
        Ok(all)
    }
}

impl PartialSchema for StageSections {
    fn schema() -> RefOr<Schema> {
        let mut object = Object::new();
        for stage in sections() {
            let mut section = Ref::from_schema_name(stage.schema_name());
            section.description = format!(
                "Parameters of the stage `{}`, where a stage of the recipe does not say its own.",
                stage.name()
            );
            object.properties.insert(stage.name().to_owned(), section.into());
        }
        RefOr::T(object.into())
    }
}

impl utoipa::ToSchema for StageSections {
    fn schemas(schemas: &mut NamedSchemas) {
        for stage in sections() {
            schemas.push((stage.schema_name(), stage.schema()));
            schemas.extend(stage.referred());
        }
    }
}
