//! What the output model is: its container, and how its geometry is compressed.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use utoipa::openapi::schema::OneOfBuilder;
use utoipa::openapi::{Ref, RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::erased::NamedSchemas;
use crate::asset::{Compression, TileKind};
use crate::error::{Code, Failure, Result};

/// What the output model is. Written as its container's name alone where its compression is the default.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Output {
    /// Its container.
    pub container: Container,
    /// How its geometry is compressed.
    pub compression: Compression,
}

/// What the output model is, in full.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OutputOptions {
    /// Container of the output model.
    pub container: Container,
    /// How the geometry of the output model is compressed.
    pub compression: Compression,
}

impl From<OutputOptions> for Output {
    fn from(OutputOptions { container, compression }: OutputOptions) -> Self {
        Output { container, compression }
    }
}

impl Serialize for Output {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        let Output { container, compression } = *self;
        match compression {
            Compression::Keep => container.serialize(serializer),
            _ => OutputOptions { container, compression }.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for Output {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let value = Value::deserialize(deserializer)?;
        let read = if value.is_object() {
            OutputOptions::deserialize(value).map(Output::from)
        } else {
            Container::deserialize(value).map(|container| Output { container, ..Output::default() })
        };
        read.map_err(D::Error::custom)
    }
}

impl PartialSchema for Output {
    fn schema() -> RefOr<Schema> {
        let of = |name: std::borrow::Cow<'static, str>| Ref::from_schema_name(name);
        OneOfBuilder::new()
            .item(of(Container::name()))
            .item(of(OutputOptions::name()))
            .description(Some(
                "What the output model is: its container alone, or that and how its geometry is compressed.",
            ))
            .into()
    }
}

impl ToSchema for Output {
    fn schemas(schemas: &mut NamedSchemas) {
        schemas.push((Container::name().into_owned(), Container::schema()));
        schemas.push((OutputOptions::name().into_owned(), OutputOptions::schema()));
        OutputOptions::schemas(schemas);
    }
}

/// Container of the output model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Container {
    /// The 3D tile that the model came in, else one binary file (GLB).
    #[default]
    Auto,
    /// One binary file.
    Glb,
    /// JSON with side files.
    Gltf,
    /// The batched 3D model (3D Tiles 1.0) that the input is, its tables kept.
    B3dm,
    /// The instanced 3D model (3D Tiles 1.0) that the input is, its tables kept.
    I3dm,
}

impl Container {
    /// The container of a model that came in a tile, or in none.
    ///
    /// # Errors
    /// `invalid_options` where that tile is not at hand.
    pub fn of(self, tile: Option<TileKind>) -> Result<Self> {
        let own = match tile {
            None => Container::Glb,
            Some(TileKind::B3dm) => Container::B3dm,
            Some(TileKind::I3dm) => Container::I3dm,
        };
        match self {
            Container::Auto => Ok(own),
            Container::B3dm | Container::I3dm if self != own => {
                let wanted = if self == Container::B3dm { "b3dm" } else { "i3dm" };
                let message = format!(
                    "a .{wanted} is asked for, and the model did not come in one: its feature table and batch table would be missing; ask for .glb"
                );
                Err(Failure::new(Code::InvalidOptions, message).at("/output"))
            }
            other => Ok(other),
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{from_value, json, to_value};

    use super::*;

    #[test]
    fn a_container_alone_is_an_output_and_compression_stands_beside_it() {
        let none = Output { container: Container::Gltf, compression: Compression::None };
        for (value, output) in [
            (json!("auto"), Output::default()),
            (json!("glb"), Output { container: Container::Glb, ..Output::default() }),
            (json!({ "container": "gltf", "compression": "none" }), none),
        ] {
            assert_eq!(from_value::<Output>(value.clone()).unwrap(), output);
            assert_eq!(to_value(output).unwrap(), value);
        }
        assert_eq!(from_value::<Output>(json!({ "compression": "none" })).unwrap().container, Container::Auto);
        for wrong in [json!(1), json!("obj"), json!({ "compression": "zip" }), json!({ "codec": "draco" })] {
            assert!(from_value::<Output>(wrong).is_err());
        }
    }
}
