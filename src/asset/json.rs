//! Small readers of glTF JSON that answer with pointers instead of panics.

use serde_json::{Map, Value};

use crate::error::{Failure, Result};

/// The array under `key`, empty where there is none.
pub(crate) fn array<'a>(value: &'a Value, key: &str) -> &'a [Value] {
    value.get(key).and_then(Value::as_array).map_or(&[], Vec::as_slice)
}

/// The object under `key`, where there is one.
pub(crate) fn object<'a>(value: &'a Value, key: &str) -> Option<&'a Map<String, Value>> {
    value.get(key).and_then(Value::as_object)
}

/// The index under `key`, checked against the number of things it may name.
///
/// # Errors
/// `invalid_model` at `pointer/key` when it is no index or out of range.
pub(crate) fn index(value: &Value, key: &str, count: usize, pointer: &str) -> Result<Option<usize>> {
    match value.get(key) {
        None => Ok(None),
        Some(found) => checked(found, count, || format!("{pointer}/{key}")).map(Some),
    }
}

/// A JSON number as an index below `count`.
///
/// # Errors
/// `invalid_model` at `pointer` when it is none.
pub(crate) fn checked(value: &Value, count: usize, pointer: impl Fn() -> String) -> Result<usize> {
    let number = value
        .as_u64()
        .ok_or_else(|| Failure::model(format!("an index is expected here, and {value} is none")).at(pointer()))?;
    usize::try_from(number).ok().filter(|i| *i < count).ok_or_else(|| {
        Failure::model(format!("index {number} is out of range: there are {count} to choose from")).at(pointer())
    })
}

/// An array of the document that may be appended to, made where it is missing.
///
/// # Errors
/// `invalid_model` when something else than an array stands there.
pub(crate) fn array_mut<'a>(json: &'a mut Value, key: &str) -> Result<&'a mut Vec<Value>> {
    let root = json.as_object_mut().ok_or_else(|| Failure::model("the document is not a JSON object"))?;
    root.entry(key)
        .or_insert_with(|| Value::Array(Vec::new()))
        .as_array_mut()
        .ok_or_else(|| Failure::model(format!("{key:?} is not an array")).at(format!("/{key}")))
}

/// The object at a JSON pointer, to be changed.
///
/// # Errors
/// `invalid_model` when there is none.
pub(crate) fn object_mut<'a>(json: &'a mut Value, pointer: &str) -> Result<&'a mut Map<String, Value>> {
    json.pointer_mut(pointer)
        .and_then(Value::as_object_mut)
        .ok_or_else(|| Failure::model("an object is expected here").at(pointer))
}
