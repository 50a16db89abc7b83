//! What can be asked of reading a model.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use utoipa::openapi::schema::{ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

/// What happens to charts that repeat their texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Tiling {
    /// The repeated texels are baked out, up to a limit.
    Bake,
    /// Their material is left as it is.
    Leave,
}

/// How the geometry of a model is compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// As it came: what did not change by its own bytes, the rest with the parameters that it had.
    #[default]
    Keep,
    /// Not at all.
    None,
    /// EXT_meshopt_compression without loss; what came as KHR_meshopt_compression stays that.
    Meshopt,
    /// KHR_draco_mesh_compression: what came so with the parameters that it had, the rest with 14 bits for positions, 10 for normals, 15 for
    /// texture coordinates that were not refined, 12 for weights and tangents, 8 for colours of floats; integers without loss.
    Draco,
}

/// Which TEXCOORD set is refined, and which takes the new layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UvSet {
    /// The set of this number, with the images that are read through it. It takes the new layout, where nothing else reads it.
    Number(u32),
    /// TEXCOORD_0, without images: it stays, with all that reads it, and the new layout is a set of its own.
    New,
}

/// Largest number of a set.
const LAST_SET: u32 = 7;
/// What stands for [`UvSet::New`].
const NEW: &str = "new";

impl UvSet {
    /// Number of the set that is read.
    pub fn number(self) -> usize {
        match self {
            UvSet::Number(number) => number as usize,
            UvSet::New => 0,
        }
    }
}

impl Default for UvSet {
    fn default() -> Self {
        UvSet::Number(0)
    }
}

impl Serialize for UvSet {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            UvSet::Number(number) => number.serialize(serializer),
            UvSet::New => NEW.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for UvSet {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let value = serde_json::Value::deserialize(deserializer)?;
        match value.as_u64() {
            Some(number) if number <= u64::from(LAST_SET) => Ok(UvSet::Number(number as u32)),
            None if value == NEW => Ok(UvSet::New),
            None if !value.is_number() => {
                Err(D::Error::custom(format!("expected a number, or \"{NEW}\", and not {value}")))
            }
            _ => Err(D::Error::custom(format!("the set is {value}, outside 0..={LAST_SET}"))),
        }
    }
}

/// By hand: what can be derived knows no bounds of an untagged value.
impl PartialSchema for UvSet {
    fn schema() -> RefOr<Schema> {
        let number = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(0)).maximum(Some(LAST_SET));
        let new = ObjectBuilder::new().schema_type(Type::String).enum_values(Some([NEW]));
        OneOfBuilder::new()
            .item(number.description(Some("The set of this number, with the images that are read through it.")))
            .item(new.description(Some("A set of its own; TEXCOORD_0 stays, and the images that are read through it.")))
            .description(Some("Which TEXCOORD set is refined, and which takes the new layout."))
            .into()
    }
}

impl ToSchema for UvSet {}

/// What reading a model needs to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadOptions {
    /// The TEXCOORD set that is refined, and the one that is written.
    pub uv_set: UvSet,
    /// What happens to charts that repeat their texture.
    pub tiling: Tiling,
}

impl Default for ReadOptions {
    fn default() -> Self {
        ReadOptions { uv_set: UvSet::Number(0), tiling: Tiling::Bake }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, from_value, json, to_value};

    use super::*;

    #[test]
    fn a_set_is_a_number_or_new() {
        for (value, set) in [(json!(0), UvSet::Number(0)), (json!(7), UvSet::Number(7)), (json!("new"), UvSet::New)] {
            assert_eq!(from_value::<UvSet>(value.clone()).unwrap(), set);
            assert_eq!(to_value(set).unwrap(), value);
        }
        let refused = |value: Value| from_value::<UvSet>(value).unwrap_err().to_string();
        for wrong in [json!(8), json!(-1), json!(0.5), json!(1e30)] {
            assert!(refused(wrong).contains("outside 0..=7"));
        }
        for wrong in [json!("old"), json!(null), json!([0])] {
            assert!(refused(wrong).contains("or \"new\""));
        }
    }
}
