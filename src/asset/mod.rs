//! glTF and OBJ in and out, without losing what is not understood.
//!
//! [`Document`] is a glTF document as `serde_json::Value` with its buffers and image files in memory;
//! OBJ is converted to one while it is loaded, so that everything after sees glTF alone. [`TextureSet`] is one
//! Atlas with what is needed to bake its images and write it back.

mod accessor;
mod accessor_layout;
mod accessor_type;
mod append;
mod archive;
mod buffers;
mod compression;
mod estimate;
mod glb;
mod limits;
mod load;
pub(crate) mod merge;
mod nodes;
mod obj;
mod options;
mod prune;
pub mod sample;
mod save;
mod side_files;
mod side_names;
mod sources;
mod upload;
mod uri;

pub use accessor::{
    RawAccessor, Shape, accessor_count, accessor_shape, raw_elements, read_indices, read_vec, read_vec2, read_vec3,
    read_vec4,
};
pub use accessor_type::{ComponentType, Kind};
pub use append::{ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER};
pub(crate) use archive::check_entries;
pub use estimate::{Estimate, estimate};
pub use limits::Limits;
pub use load::{load, load_while, side_file};
pub use merge::{Counts, Merge, Merged, MergedMaterial, Merging, finish as finish_merge, prepare as prepare_merge};
pub use options::{ReadOptions, Tiling};
pub use save::to_gltf;
pub use side_files::read_paths;
pub(crate) use side_names::by_name as image_type;

#[cfg(test)]
pub(crate) mod fixture;
mod geometry;
mod json;
mod material_index;
mod read;
mod sets;
mod transform;
mod uv_tiles;
mod write;

pub use read::read;
pub(crate) use sets::grid;
pub use sets::{is_small, mark_uniform, small_slot_warning};
pub use transform::{TextureTransform, UvLayout};
#[cfg(test)]
pub(crate) use write::tangents::generate as mikktspace;
pub use write::{BakedImage, Refined, read_back, write};

use serde_json::Value;

use crate::atlas::Atlas;
use crate::texture::Slot;

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
}

/// A primitive that takes part in a texture set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PrimitiveRef {
    /// Index into `/meshes`.
    pub mesh: usize,
    /// Index into `/meshes/N/primitives`.
    pub primitive: usize,
    /// Index into `/materials`.
    pub material: Option<usize>,
    /// The layout that is refined: the TEXCOORD set that is read, and its texture transform.
    pub layout: UvLayout,
    /// Number of the TEXCOORD set that takes the new layout: the one that is read, or a new one where something else reads it on.
    pub written: usize,
    /// First face of the primitive in the Atlas as uploaded; its faces are contiguous.
    pub first_face: usize,
    /// Number of faces.
    pub face_count: usize,
    /// Whether it is skinned or morphed.
    pub animated: bool,
    /// The glTF vertex of each corner of each face, as the index buffer names it.
    pub corners: Vec<[u32; 3]>,
}

/// A texture set: one Atlas, its primitives and its images.
#[derive(Debug, Clone)]
pub struct TextureSet {
    /// Position in the model's list of texture sets, from 0.
    pub id: usize,
    /// Name for people: the materials' names, or the model's.
    pub name: String,
    /// The Atlas as uploaded, UV tiles normalised; one face for each triangle of each primitive, in order.
    pub atlas: Atlas,
    /// Size of the reference sheet: the size of the largest slot (or a virtual 1024 x 1024).
    pub reference: [u32; 2],
    /// Primitives by the index that provenance names.
    pub primitives: Vec<PrimitiveRef>,
    /// Images, in the order of role and image index. Empty for a virtual page.
    pub slots: Vec<Slot>,
    /// Smallest translation, in reference texels (x, y), for which every slot's texels stay whole; null where there is none.
    pub grid: Option<[u32; 2]>,
}

#[cfg(test)]
mod tests;
