//! A stage whose type is forgotten, so that stages of all kinds stand in one list: the table, the sections of the options, a recipe.

use std::any::Any;
use std::fmt::Debug;
use std::ops::Deref;
use std::sync::Arc;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value};
use utoipa::openapi::schema::{AdditionalProperties, ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{Object, RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::stage::{Stage, StageInput, Staged};
use super::table;
use crate::error::Result;
use crate::params::{Problem, out_of_range, section};

/// Schemas by name.
pub type NamedSchemas = Vec<(String, RefOr<Schema>)>;

/// A [`Stage`] of any kind, with its parameters.
pub trait AnyStage: Any + Debug + Send + Sync {
    /// See [`Stage::NAME`].
    fn name(&self) -> &'static str;
    /// See [`Stage::DESCRIPTION`].
    fn description(&self) -> &'static str;
    /// See [`Stage::WEIGHT`].
    fn weight(&self) -> f64;
    /// See [`Stage::SHARED`].
    fn is_shared(&self) -> bool;
    /// See [`Stage::NEEDS_LAYOUT`].
    fn needs_layout(&self) -> bool;
    /// See [`Stage::may_overlap`].
    fn may_overlap(&self) -> bool;
    /// See [`Stage::run`].
    ///
    /// # Errors
    /// Those of the stage.
    fn run(&self, input: &StageInput<'_>) -> Result<Staged>;
    /// The parameters as JSON.
    fn to_value(&self) -> Value;
    /// The stage with the parameters of `value`, key by key, over its own.
    fn over(&self, value: &Value, pointer: &str, problems: &mut Vec<Problem>) -> ErasedStage;
    /// The stage with the parameters of `value`, all others their defaults.
    ///
    /// # Errors
    /// What is unknown or of the wrong type.
    fn parsed(&self, value: Value) -> serde_json::Result<ErasedStage>;
    /// The parameters that are outside their ranges.
    fn out_of_range(&self, pointer: &str) -> Vec<Problem>;
    /// Name of the schema of its parameters.
    fn schema_name(&self) -> String;
    /// Schema of its parameters.
    fn schema(&self) -> RefOr<Schema>;
    /// Schemas that the schema of its parameters refers to.
    fn referred(&self) -> NamedSchemas;
}

impl<S: Stage> AnyStage for S {
    fn name(&self) -> &'static str {
        S::NAME
    }

    fn description(&self) -> &'static str {
        S::DESCRIPTION
    }

    fn weight(&self) -> f64 {
        S::WEIGHT
    }

    fn is_shared(&self) -> bool {
        S::SHARED
    }

    fn needs_layout(&self) -> bool {
        S::NEEDS_LAYOUT
    }

    fn may_overlap(&self) -> bool {
        Stage::may_overlap(self)
    }

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        Stage::run(self, input)
    }

    fn to_value(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }

    fn over(&self, value: &Value, pointer: &str, problems: &mut Vec<Problem>) -> ErasedStage {
        ErasedStage::new(section(self, value, pointer, problems))
    }

    fn parsed(&self, value: Value) -> serde_json::Result<ErasedStage> {
        serde_json::from_value::<S>(value).map(ErasedStage::new)
    }

    fn out_of_range(&self, pointer: &str) -> Vec<Problem> {
        out_of_range(self, pointer)
    }

    fn schema_name(&self) -> String {
        <S as ToSchema>::name().into_owned()
    }

    fn schema(&self) -> RefOr<Schema> {
        <S as PartialSchema>::schema()
    }

    fn referred(&self) -> NamedSchemas {
        let mut schemas = Vec::new();
        S::schemas(&mut schemas);
        schemas
    }
}

/// A stage of any kind with its parameters, as it stands in a recipe.
#[derive(Debug, Clone)]
pub struct ErasedStage(Arc<dyn AnyStage>);

impl ErasedStage {
    /// The stage with these parameters.
    pub fn new<S: Stage>(stage: S) -> Self {
        ErasedStage(Arc::new(stage))
    }

    /// The stage with its defaults.
    pub fn of<S: Stage>() -> Self {
        Self::new(S::default())
    }

    /// The parameters, if the stage is of this kind.
    pub fn get<S: Stage>(&self) -> Option<&S> {
        (&*self.0 as &dyn Any).downcast_ref()
    }
}

impl Deref for ErasedStage {
    type Target = dyn AnyStage;

    fn deref(&self) -> &Self::Target {
        &*self.0
    }
}

impl PartialEq for ErasedStage {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name() && self.to_value() == other.to_value()
    }
}

impl Serialize for ErasedStage {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        let mut map = Map::from_iter([("stage".to_owned(), Value::from(self.name()))]);
        if let Value::Object(parameters) = self.to_value()
            && !self.is_shared()
        {
            map.extend(parameters);
        }
        map.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for ErasedStage {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let mut map = Map::deserialize(deserializer)?;
        let name = map.shift_remove("stage");
        let name = name.as_ref().and_then(Value::as_str).unwrap_or_default();
        let stage = table::find(name).ok_or_else(|| D::Error::custom(format!("there is no stage `{name}`")))?;
        match map.keys().next() {
            Some(key) if stage.is_shared() => Err(D::Error::unknown_field(key, &["stage"])),
            _ => stage.parsed(Value::Object(map)).map_err(D::Error::custom),
        }
    }
}

/// The stages of the table, each with its own parameters.
impl PartialSchema for ErasedStage {
    fn schema() -> RefOr<Schema> {
        let stages = table::all().fold(OneOfBuilder::new(), |all, stage| all.item(recipe_item(&stage)));
        stages.description(Some("One stage with its parameters.")).into()
    }
}

impl ToSchema for ErasedStage {
    fn name() -> std::borrow::Cow<'static, str> {
        "Stage".into()
    }

    fn schemas(schemas: &mut NamedSchemas) {
        schemas.extend(table::all().flat_map(|stage| stage.referred()));
    }
}

/// The schema of a stage in a recipe: its name, and its parameters beside it.
fn recipe_item(stage: &ErasedStage) -> Schema {
    let place = match stage.is_shared() {
        true => "Its parameters are the job's",
        false => "What it does not say is as in the job's",
    };
    let name = ObjectBuilder::new().schema_type(Type::String).enum_values(Some([stage.name()])).build();
    let mut item = match stage.schema() {
        RefOr::T(Schema::Object(parameters)) if !stage.is_shared() => parameters,
        _ => Object::new(),
    };
    item.properties.values_mut().for_each(forget_default);
    item.properties.insert("stage".to_owned(), RefOr::T(name.into()));
    item.required = vec!["stage".to_owned()];
    item.additional_properties = Some(Box::new(AdditionalProperties::FreeForm(false)));
    item.description = Some(format!("{} {place} `{}`.", stage.description(), stage.name()));
    item.title = Some(format!("{}Stage", stage.schema_name()));
    item.into()
}

/// Takes the default from a schema, for a place where what is left out means something else.
pub(super) fn forget_default(schema: &mut RefOr<Schema>) {
    match schema {
        RefOr::Ref(reference) => reference.default = None,
        RefOr::T(Schema::Object(object)) => object.default = None,
        RefOr::T(Schema::OneOf(one)) => one.default = None,
        RefOr::T(Schema::Array(list)) => list.default = None,
        RefOr::T(_) => {}
    }
}
