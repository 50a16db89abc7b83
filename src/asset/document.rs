//! The document that everything in this room reads and edits.

use std::collections::BTreeSet;

use serde_json::Value;

use super::compression::{CompressedViews, Origins};
use super::tile::Tile;

/// A file as uploaded: its relative path (forward slashes) and its bytes.
#[derive(Debug, Clone)]
pub struct File {
    /// Relative path, as glTF URIs, `mtllib` and `map_Kd` name it.
    pub path: String,
    /// Contents.
    pub bytes: Vec<u8>,
}

/// A glTF document with everything that it refers to.
#[derive(Debug, Clone)]
pub struct Document {
    /// The document. Values that are not touched stay equal.
    pub json: Value,
    /// Contents by buffer index, each at least `byteLength` long.
    pub buffers: Vec<Vec<u8>>,
    /// Encoded contents by image index; `None` where the file was not uploaded.
    pub images: Vec<Option<Vec<u8>>>,
    /// Name of the uploaded model file without its extension.
    pub name: String,
    /// What merging did to its images.
    pub merging: Merging,
    /// What it came in, where that is a 3D tile.
    pub tile: Option<Tile>,
    /// Materials that are defined in a file which was not uploaded: what they read is not known.
    pub undefined: BTreeSet<usize>,
    /// What of it came compressed.
    pub origins: Origins,
    /// What of it is compressed, once it is ready to be saved.
    pub compressed: Option<CompressedViews>,
}

/// Images that merging changed the standing of, by index.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Merging {
    /// Made of factors: surfaces read them at one point.
    pub constants: BTreeSet<usize>,
    /// Equal to others, which stand in for them.
    pub spare: BTreeSet<usize>,
}
