//! Small readers of glTF JSON that answer with pointers instead of panics.

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::error::{Failure, Result};
use crate::params;

/// A value of the document as a type of the crate `gltf`, or one of ours. `pointer` is where it stands.
///
/// # Errors
/// `invalid_model` with the pointer of what is missing or of another kind.
pub(crate) fn read<T: DeserializeOwned>(value: &Value, pointer: impl FnOnce() -> String) -> Result<T> {
    T::deserialize(value).or_else(|_| {
        params::typed(&plain(value), &pointer()).map_err(|wrong| {
            let message = wrong.message.replace("expected usize", "expected a whole number of at least 0");
            Failure::model(message.replace("expected a map", "expected an object")).at(wrong.pointer)
        })
    })
}

/// What stands under `key`, where there is anything; as [`read`].
pub(crate) fn read_key<T: DeserializeOwned>(value: &Value, key: &str, pointer: &str) -> Result<Option<T>> {
    value.get(key).map(|found| read(found, || format!("{pointer}/{key}"))).transpose()
}

/// An object of an array of the document; as [`read`].
pub(crate) fn typed<T: DeserializeOwned>(json: &Value, key: &str, index: usize) -> Result<T> {
    let all = list(json, key)?;
    let found = all.get(index).ok_or_else(|| {
        Failure::model(format!("{key} {index} does not exist: there are {}", all.len())).at(format!("/{key}"))
    })?;
    read(found, || format!("/{key}/{index}"))
}

/// An array of the document; empty where there is none.
///
/// # Errors
/// `invalid_model` when something else than an array stands there.
pub(crate) fn list<'a>(json: &'a Value, key: &str) -> Result<&'a [Value]> {
    match json.get(key) {
        None => Ok(&[]),
        Some(Value::Array(values)) => Ok(values),
        Some(_) => Err(Failure::model(format!("{key} is not an array")).at(format!("/{key}"))),
    }
}

/// A value as it was meant: writers without an integer type write `4.0`, and extras may be anything at all.
fn plain(value: &Value) -> Value {
    match value {
        Value::Object(map) => {
            let known = map.iter().filter(|(key, _)| !matches!(key.as_str(), "extensions" | "extras"));
            Value::Object(known.map(|(key, child)| (key.clone(), plain(child))).collect())
        }
        Value::Array(items) => items.iter().map(plain).collect(),
        _ => whole(value).map_or_else(|| value.clone(), Value::from),
    }
}

/// A whole number at or above zero, however it is written.
pub(crate) fn whole(value: &Value) -> Option<u64> {
    let exact = || value.as_f64().filter(|f| f.fract() == 0.0 && (0.0..9e15).contains(f)).map(|f| f as u64);
    value.as_u64().or_else(exact)
}

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

/// The values of the array under `key`, to be changed; none where there is no array.
pub(crate) fn each_mut<'a>(value: &'a mut Value, key: &str) -> impl Iterator<Item = &'a mut Value> + use<'a> {
    value.get_mut(key).and_then(Value::as_array_mut).into_iter().flatten()
}

/// A JSON number as an index.
pub(crate) fn number(value: &Value) -> Option<usize> {
    value.as_u64().and_then(|n| usize::try_from(n).ok())
}

/// Leaves those items of a list whose index is to be kept.
pub(crate) fn keep<T>(items: &mut Vec<T>, kept: impl Fn(usize) -> bool) {
    let mut index = 0;
    items.retain(|_| {
        index += 1;
        kept(index - 1)
    });
}

/// The numbers of items once those that are not kept are gone.
pub(crate) fn new_numbers(kept: &[bool]) -> Vec<usize> {
    let before = kept.iter().scan(0, |next, kept| {
        *next += usize::from(*kept);
        Some(*next - usize::from(*kept))
    });
    before.collect()
}

/// Puts a new number in the place of an index; one that stays is left as it is written.
pub(crate) fn renumber(index: &mut Value, new: &[usize]) {
    let found = number(index).and_then(|old| Some((old, *new.get(old)?)));
    if let Some((_, new)) = found.filter(|(old, new)| old != new) {
        *index = Value::from(new);
    }
}
