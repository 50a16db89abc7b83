//! Reading a section, so that every problem is found and not only the first.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::words::{child, kind, name, near_or_all, short};
use super::{Params, Range};

/// One thing that is wrong with the options.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[schema(as = Wrong)]
pub struct Problem {
    /// JSON pointer into the options.
    pub pointer: String,
    /// One sentence for a person.
    pub message: String,
    /// Whether the pointer names a key that is not known.
    #[serde(skip)]
    pub unknown_key: bool,
}

impl Problem {
    /// What is wrong at `pointer`.
    pub fn new(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Problem { pointer: pointer.into(), message: message.into(), unknown_key: false }
    }

    /// A key that is not known.
    pub(crate) fn unknown_key(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Problem { unknown_key: true, ..Problem::new(pointer, message) }
    }
}

/// The parameters of the section at `pointer` that are outside their ranges.
pub fn out_of_range<T: Params>(section: &T, pointer: &str) -> Vec<Problem> {
    let section = serde_json::to_value(section).unwrap_or_default();
    let outside = |range: &&Range| {
        let value = section.get(range.key).and_then(Value::as_f64);
        value.filter(|v| !(range.low..=range.high).contains(v)).map(|v| (**range, v))
    };
    let problem = |(Range { key, low, high }, value): (Range, f64)| {
        Problem::new(child(pointer, key), format!("`{key}` is {value}, outside {low}..={high}"))
    };
    T::RANGES.iter().filter_map(|range| outside(&range)).map(problem).collect()
}

/// A section, key by key, on top of the values of `base`.
pub(crate) fn section<T: Serialize + DeserializeOwned + Default>(
    base: &T,
    value: &Value,
    pointer: &str,
    problems: &mut Vec<Problem>,
) -> T {
    let Some(map) = value.as_object() else {
        problems.push(Problem::new(pointer, format!("`{}` is an object, not {}", name(pointer), kind(value))));
        return T::default();
    };
    let known = keys(base);
    let mut all = match serde_json::to_value(base) {
        Ok(Value::Object(all)) => all,
        _ => Map::new(),
    };
    for (key, value) in map {
        let at = child(pointer, key);
        if !known.iter().any(|k| k == key) {
            problems.push(unknown(&at, key, &known));
            continue;
        }
        let one = Value::Object(Map::from_iter([(key.clone(), value.clone())]));
        match typed::<T>(&one, pointer) {
            Ok(_) => drop(all.insert(key.clone(), value.clone())),
            Err(problem) => problems.push(problem),
        }
    }
    typed(&Value::Object(all), pointer).unwrap_or_default()
}

/// The problem of a key that is none of those `known`.
pub(crate) fn unknown(pointer: &str, key: &str, known: &[String]) -> Problem {
    let known: Vec<&str> = known.iter().map(String::as_str).collect();
    Problem::unknown_key(pointer, format!("unknown option `{}`; {}", short(key), near_or_all(key, &known)))
}

/// The value as `T`, or where and why it is not one.
pub(crate) fn typed<T: DeserializeOwned>(value: &Value, pointer: &str) -> Result<T, Problem> {
    serde_path_to_error::deserialize(value).map_err(|error| {
        let mut at = pointer.to_owned();
        for segment in error.path().iter() {
            use serde_path_to_error::Segment;
            match segment {
                Segment::Seq { index } => at = child(&at, &index.to_string()),
                Segment::Map { key } => at = child(&at, key),
                Segment::Enum { .. } | Segment::Unknown => {}
            }
        }
        let text = error.inner().to_string();
        let text = text.replace("expected u32", "expected a whole number of at least 0");
        let text = text.replace("expected u64", "expected a whole number of at least 0");
        let text = text
            .replace("expected u8", "expected a whole number in 0..=255")
            .replace("expected f64", "expected a number");
        let message = format!("`{}`: {}", name(&at), short(&text));
        Problem::new(at, message)
    })
}

/// The keys of a value's JSON object.
pub(crate) fn keys<T: Serialize>(value: &T) -> Vec<String> {
    match serde_json::to_value(value) {
        Ok(Value::Object(map)) => map.keys().cloned().collect(),
        _ => Vec::new(),
    }
}
