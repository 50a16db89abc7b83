//! What the sections of a job's options have in common: ranges, defaults, their JSON Schema, and how their JSON is read.
//!
//! A section is declared with [`params!`], where each parameter stands once with its default and its range. The range is
//! what JSON is held against, what the schema tells as `minimum` and `maximum`, and what the documentation says.

mod read;
mod word_or_number;
mod words;

use std::fmt::Debug;

use serde::Serialize;
use serde::de::DeserializeOwned;
use utoipa::ToSchema;

pub use read::{Problem, out_of_range};
pub(crate) use read::{keys, section, typed, unknown};
pub(crate) use word_or_number::word_or_number;
pub(crate) use words::{child, kind, listed, short};
pub use words::{near_or_all, nearest};

/// A section of the options: an object whose keys are parameters.
pub trait Params:
    Clone + Debug + Default + PartialEq + Serialize + DeserializeOwned + ToSchema + Send + Sync + 'static
{
    /// The ranges of those parameters that have one.
    const RANGES: &'static [Range];
}

/// The range of a parameter, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Name of the parameter.
    pub key: &'static str,
    /// Least value.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
}

/// Declares a section of the options: a struct whose fields have their defaults, and where they are numbers their ranges, beside them.
///
/// ```text
/// params! {
///     /// What is asked of a walk.
///     pub struct Walk {
///         /// Steps of the walk.
///         pub steps: u32 = 4, in 1..=64;
///         /// Whether it ends where it began.
///         pub closed: bool = false;
///     }
/// }
/// ```
macro_rules! params {
    (
        $(#[$($meta:tt)*])*
        $visibility:vis struct $name:ident {
            $(
                $(#[$($field_meta:tt)*])*
                $field_visibility:vis $field:ident: $type:ty = $default:expr $(, in $low:tt ..= $high:tt)?;
            )*
        }
    ) => {
        $(#[$($meta)*])*
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
        #[serde(default, deny_unknown_fields)]
        $visibility struct $name {
            $(
                $(#[$($field_meta)*])*
                $(
                    #[doc = concat!("\n\nIn ", stringify!($low), "..=", stringify!($high), ".")]
                    #[schema(minimum = $low, maximum = $high)]
                )?
                $field_visibility $field: $type,
            )*
        }

        impl Default for $name {
            fn default() -> Self {
                $name { $($field: $default),* }
            }
        }

        impl $crate::params::Params for $name {
            const RANGES: &'static [$crate::params::Range] = &[
                $($($crate::params::Range { key: stringify!($field), low: $low as f64, high: $high as f64 },)?)*
            ];
        }
    };
}
pub(crate) use params;

#[cfg(test)]
mod tests {
    use serde_json::json;
    use utoipa::PartialSchema;

    use super::*;

    params! {
        /// What is asked of a walk.
        struct Walk {
            /// Steps.
            steps: u32 = 4, in 1..=64;
            /// Slope of the way.
            slope: Option<f64> = None, in 0.5..=1.5;
            /// Whether it ends where it began.
            closed: bool = false;
        }
    }

    #[test]
    fn a_range_is_checked_and_stands_in_the_schema() {
        assert_eq!(Walk::default(), Walk { steps: 4, slope: None, closed: false });
        assert_eq!(out_of_range(&Walk::default(), "/walk"), []);
        let far = Walk { steps: 65, slope: Some(0.25), closed: true };
        let found: Vec<(String, String)> =
            out_of_range(&far, "/walk").into_iter().map(|p| (p.pointer, p.message)).collect();
        let problem = |pointer: &str, message: &str| (pointer.to_owned(), message.to_owned());
        assert_eq!(
            found,
            [
                problem("/walk/steps", "`steps` is 65, outside 1..=64"),
                problem("/walk/slope", "`slope` is 0.25, outside 0.5..=1.5"),
            ]
        );
        let schema = serde_json::to_value(Walk::schema()).unwrap();
        let steps = &schema["properties"]["steps"];
        assert_eq!((&steps["minimum"], &steps["maximum"], &steps["default"]), (&json!(1), &json!(64), &json!(4)));
        assert_eq!(schema["properties"]["slope"]["maximum"], 1.5);
        assert_eq!(steps["description"], "Steps.");
    }

    #[test]
    fn a_section_is_read_key_by_key() {
        let base = Walk { steps: 9, ..Walk::default() };
        let mut problems = Vec::new();
        let read = section(&base, &json!({"closed": true}), "/walk", &mut problems);
        assert_eq!((read, problems.len()), (Walk { closed: true, ..base.clone() }, 0));
        section(&base, &json!({"step": 1, "slope": "steep", "closed": false}), "/walk", &mut problems);
        let found: Vec<&str> = problems.iter().map(|p| p.pointer.as_str()).collect();
        assert_eq!(found, ["/walk/step", "/walk/slope"]);
        assert!(problems[0].message.contains("did you mean `steps`?"), "{problems:?}");
    }
}
