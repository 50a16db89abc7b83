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

use serde::de::DeserializeOwned;
use serde_json::Value;

use super::extensions::retain;
use super::json::read_key;
use crate::error::{Result, Warning};

/// An extension of a glTF object, where it has one.
///
/// # Errors
/// `invalid_model` at `pointer/extensions/name` or below, when it is not as it should be.
fn extension<T: DeserializeOwned>(owner: &Value, name: &str, pointer: &str) -> Result<Option<T>> {
    let Some(extensions) = owner.get("extensions") else { return Ok(None) };
    read_key(extensions, name, &format!("{pointer}/extensions"))
}

/// Removes an extension from a glTF object.
fn remove_extension(owner: &mut Value, name: &str) {
    if let Some(object) = owner.as_object_mut() {
        retain(object, |other| other != name);
    }
}

/// Says that an extension is gone, with the bytes before and after.
fn decompressed(name: &str, before: usize, after: usize) -> Warning {
    let message = format!("{name} was decompressed, {before} bytes to {after}: the output is written without it");
    Warning::new("decompressed", message)
}

#[cfg(test)]
mod tests;
