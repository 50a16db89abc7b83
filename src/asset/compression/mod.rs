//! Compressed geometry, decompressed while a model is loaded: what comes after sees an ordinary document.
//!
//! [`views`] decodes buffer views (EXT_meshopt_compression, KHR_meshopt_compression), [`primitives`] primitives
//! (KHR_draco_mesh_compression). Indices of buffer views and accessors stay; decoded bytes are appended to a buffer, the
//! extensions are removed, and the model is written uncompressed, as a warning for each of them says.

mod draco;
mod meshopt;
mod primitives;
mod squeeze;
mod views;

pub(crate) use primitives::primitives;
pub(crate) use views::{placeholders, renew_bounds, views};

use serde_json::{Map, Value};

use super::uri::quote;
use crate::error::{Failure, Result, Warning};

/// The object of an extension in a glTF object, where it has one.
///
/// # Errors
/// `invalid_model` at `pointer/extensions/name` when something else than an object stands there.
fn extension<'a>(owner: &'a Value, name: &str, pointer: &str) -> Result<Option<&'a Map<String, Value>>> {
    let Some(found) = owner.get("extensions").and_then(|e| e.get(name)) else { return Ok(None) };
    let object = found.as_object().map(Some);
    object.ok_or_else(|| Failure::model("an object is expected here").at(format!("{pointer}/extensions/{name}")))
}

/// Removes an extension from a glTF object.
fn remove_extension(owner: &mut Value, name: &str) {
    let Some(object) = owner.as_object_mut() else { return };
    let Some(extensions) = object.get_mut("extensions").and_then(Value::as_object_mut) else { return };
    if extensions.shift_remove(name).is_some() && extensions.is_empty() {
        object.shift_remove("extensions");
    }
}

/// Removes an extension from the lists of those that are used and required.
fn undeclare(json: &mut Value, name: &str) {
    let Some(root) = json.as_object_mut() else { return };
    for key in ["extensionsUsed", "extensionsRequired"] {
        let Some(list) = root.get_mut(key).and_then(Value::as_array_mut) else { continue };
        let before = list.len();
        list.retain(|n| n.as_str() != Some(name));
        if list.is_empty() && before > 0 {
            root.shift_remove(key);
        }
    }
}

/// Says that an extension is gone, with the bytes before and after.
fn decompressed(name: &str, before: usize, after: usize) -> Warning {
    let message = format!("{name} was decompressed, {before} bytes to {after}: the output is written without it");
    Warning::new("decompressed", message)
}

/// A word of a closed list.
fn word<T: Copy>(object: &Map<String, Value>, key: &str, words: &[(&str, T)], pointer: &str) -> Result<Option<T>> {
    let Some(found) = object.get(key) else { return Ok(None) };
    let known = words.iter().find(|(w, _)| found.as_str() == Some(*w)).map(|(_, value)| Some(*value));
    known.ok_or_else(|| {
        let all: Vec<&str> = words.iter().map(|(w, _)| *w).collect();
        let message = format!("{key} is {}, not one of {}", quote(&found.to_string()), all.join(", "));
        Failure::model(message).at(format!("{pointer}/{key}"))
    })
}

#[cfg(test)]
mod tests;
