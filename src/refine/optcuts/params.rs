//! Every parameter of OptCuts, with unit, range, default and source.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use utoipa::openapi::schema::{ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use crate::error::Result;
use crate::params::params;
use crate::refine::stage::{Stage, StageInput, Staged};

/// Symmetric Dirichlet energy of an isometric map: no bound can be that low.
pub(super) const ISOMETRIC: f64 = 4.0;
/// Largest bound.
pub(super) const MOST: f64 = 1000.0;

params! {
    /// Parameters of the stage `optcuts`. Sections are those of Li, Kaufman, Kim, Solomon and Sheffer 2018.
    pub struct OptCuts {
        /// Bound on the mean symmetric Dirichlet energy of the map from the surface (eq. 1; 4 is isometric, the paper reports 4.05, 4.1 and
        /// 4.2); `input` is what the uploaded layout has of it, each connected part of the surface its own (section 7.5), or 4.1
        /// where there is no layout.
        pub max_distortion: MaxDistortion = MaxDistortion::AtMost(4.1);
        /// Whether no two faces of a connected part of the surface may overlap (section 6.4); what overlaps itself is told by the report's
        /// `overlap_fraction`. Layouts with images never overlap: a texel cannot show two places.
        pub bijective: bool = true;
        /// How much is tried.
        pub quality: Quality = Quality::Balanced;
        /// What the search starts from.
        pub start: Start = Start::Auto;
        /// How cuts are searched for.
        pub search: Search = Search::Default;
    }
}

impl Stage for OptCuts {
    const NAME: &'static str = "optcuts";
    const DESCRIPTION: &'static str = "Cuts and flattens the surface with the shortest seams that a bound on distortion allows, then packs the charts.";
    const WEIGHT: f64 = 12.0;
    const NEEDS_LAYOUT: bool = false;

    fn may_overlap(&self) -> bool {
        !self.bijective
    }

    fn run(&self, input: &StageInput<'_>) -> Result<Staged> {
        super::optcuts(input, self)
    }
}

/// A bound on the distortion of a layout.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MaxDistortion {
    /// The mean symmetric Dirichlet energy is at most this; more than 4.
    AtMost(f64),
    /// It is at most that of the uploaded layout.
    Input,
}

/// What stands for [`MaxDistortion::Input`].
const INPUT: &str = "input";

impl Serialize for MaxDistortion {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        match self {
            MaxDistortion::AtMost(bound) => bound.serialize(serializer),
            MaxDistortion::Input => INPUT.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for MaxDistortion {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let value = serde_json::Value::deserialize(deserializer)?;
        match value.as_f64() {
            Some(bound) if bound > ISOMETRIC && bound <= MOST => Ok(MaxDistortion::AtMost(bound)),
            Some(bound) => Err(D::Error::custom(format!(
                "the bound is {bound}; it is more than {ISOMETRIC}, which no distortion at all has, and at most {MOST}"
            ))),
            None if value == INPUT => Ok(MaxDistortion::Input),
            None => {
                Err(D::Error::custom(format!("expected a number above {ISOMETRIC}, or \"{INPUT}\", and not {value}")))
            }
        }
    }
}

/// By hand: what can be derived knows no bounds of an untagged value.
impl PartialSchema for MaxDistortion {
    fn schema() -> RefOr<Schema> {
        let number =
            ObjectBuilder::new().schema_type(Type::Number).exclusive_minimum(Some(ISOMETRIC)).maximum(Some(MOST));
        let input = ObjectBuilder::new().schema_type(Type::String).enum_values(Some([INPUT]));
        OneOfBuilder::new()
            .item(number.description(Some("The mean symmetric Dirichlet energy is at most this; 4 is isometric.")))
            .item(input.description(Some("It is at most that of the uploaded layout.")))
            .description(Some("A bound on the distortion of a layout."))
            .into()
    }
}

impl ToSchema for MaxDistortion {}

/// How much is tried.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = OptCutsQuality)]
pub enum Quality {
    /// Cuts from extremities to the border (section 7.3) as far as they go, then local operations: seams a little longer, in a fraction of the time.
    Fast,
    /// Local operations until the bound holds, then parts of the seams again, for about as much work.
    Balanced,
    /// Several starts, each improved for four times as long; the best is taken.
    Best,
}

/// What the search starts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = OptCutsStart)]
pub enum Start {
    /// The uploaded charts, in those parts of the surface whose charts neither fold nor overlap themselves; else as `fresh`.
    Auto,
    /// The uploaded charts, cut where they fold or overlap themselves. Surfaces without a layout stay as they are.
    Uploaded,
    /// The surface alone: the uploaded layout goes, and what shared texels has texels of its own.
    Fresh,
}

/// How cuts are searched for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = OptCutsSearch)]
pub enum Search {
    /// What is found to be better and faster than the published loop.
    Default,
    /// The published loop.
    Paper,
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_bound_is_more_than_no_distortion() {
        let read = |value: serde_json::Value| serde_json::from_value::<MaxDistortion>(value);
        assert_eq!(read(json!(4.1)).unwrap(), MaxDistortion::AtMost(4.1));
        assert_eq!(read(json!("input")).unwrap(), MaxDistortion::Input);
        for wrong in [json!(4), json!(4.0), json!(-1), json!(1e9), json!("uploaded"), json!(null), json!([5])] {
            let message = read(wrong).unwrap_err().to_string();
            assert!(message.contains("more than 4") || message.contains("above 4"), "{message}");
        }
        for bound in [MaxDistortion::AtMost(4.2), MaxDistortion::Input] {
            assert_eq!(read(serde_json::to_value(bound).unwrap()).unwrap(), bound);
        }
    }
}
