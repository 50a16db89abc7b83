//! Compressed geometry, decompressed while a model is loaded, so that what comes after sees an ordinary document, and compressed again before it is saved.
//!
//! [`views`] decodes buffer views (EXT_meshopt_compression, KHR_meshopt_compression), [`primitives`] primitives
//! (KHR_draco_mesh_compression). Indices of buffer views and accessors stay; decoded bytes are appended to a buffer, and the
//! extensions are removed. [`origin`] keeps how everything came, and [`compress`] has it leave so: what did not change by its own stream.

mod compress;
mod draco;
mod meshopt;
mod origin;
mod primitives;
mod squeeze;
mod views;

pub use compress::CompressedViews;
pub use origin::Origins;
pub(crate) use primitives::primitives;
pub(crate) use views::{placeholders, renew_bounds, views};

use serde::de::DeserializeOwned;
use serde_json::Value;

use super::extensions::retain;
use super::json::read_key;
use crate::error::Result;

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

#[cfg(test)]
mod tests;
