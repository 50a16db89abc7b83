//! Geometry compressed before a document is saved: as it came, or as it was asked for.

mod draco;
mod meshopt;

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Value, json};

use crate::asset::extensions::{DRACO, MESHOPT};
use crate::asset::json::array;
use crate::asset::{Compression, Document};
use crate::context::Context;
use crate::error::Result;

/// A document's buffer views that are not in its buffers, by index, and the document that names them.
#[derive(Debug, Clone, Default)]
pub struct CompressedViews {
    /// The document as it is saved, but for where its bytes are.
    pub(crate) json: Value,
    pub(crate) views: BTreeMap<usize, CompressedView>,
}

/// The bytes of a buffer view.
#[derive(Debug, Clone)]
pub(crate) struct CompressedView {
    pub(crate) bytes: Arc<[u8]>,
    /// The extension of the view that names them, where it is not the view itself.
    pub(crate) extension: Option<&'static str>,
}

impl Document {
    /// Whether any geometry would leave compressed.
    pub fn is_compressed(&self, compression: Compression) -> bool {
        match compression {
            Compression::Keep => self.origins.any(),
            Compression::None => false,
            Compression::Meshopt | Compression::Draco => true,
        }
    }

    /// Compresses the geometry for saving, as it is asked for; what cannot be compressed is told as a warning and left as it is. The document
    /// itself stays as it is, and is not to be changed any more.
    ///
    /// # Errors
    /// `invalid_model` for broken accessors, `canceled`.
    pub fn compress(&mut self, compression: Compression, context: &Context) -> Result<()> {
        self.compressed = None;
        if !self.is_compressed(compression) {
            return Ok(());
        }
        let mut out = CompressedViews { json: self.json.clone(), views: BTreeMap::new() };
        if compression != Compression::Meshopt {
            draco::compress(self, compression == Compression::Draco, &mut out, context)?;
        }
        if compression != Compression::Draco {
            meshopt::compress(self, compression == Compression::Meshopt, &mut out, context)?;
        }
        let mut names: Vec<&str> = MESHOPT.to_vec();
        names.retain(|name| out.views.values().any(|view| view.extension == Some(name)));
        if out.views.values().any(|view| view.extension.is_none()) {
            names.push(DRACO);
        }
        names.into_iter().for_each(|name| declare(&mut out.json, name));
        self.compressed = Some(out).filter(|out| !out.views.is_empty());
        Ok(())
    }
}

/// Names an extension among those that are used and required: there is nothing for readers that do not know it.
fn declare(json: &mut Value, name: &str) {
    for key in ["extensionsUsed", "extensionsRequired"] {
        if array(json, key).iter().any(|n| n.as_str() == Some(name)) {
            continue;
        }
        if !json[key].is_array() {
            json[key] = json!([]);
        }
        if let Some(names) = json[key].as_array_mut() {
            names.push(Value::from(name));
        }
    }
}

/// Appends an object to an array of a document that has it; gives its index.
fn push(json: &mut Value, key: &str, object: Value) -> usize {
    if !json[key].is_array() {
        json[key] = json!([]);
    }
    json[key].as_array_mut().map_or(0, |all| {
        all.push(object);
        all.len() - 1
    })
}
