//! glTF, 3D tiles of glTF and OBJ in and out, without losing what is not understood.
//!
//! [`Document`] is a glTF document as `serde_json::Value` with its buffers and image files in memory; OBJ is converted to
//! one while it is loaded, so that everything after sees glTF alone. [`TextureSet`] is one Atlas with what is needed to
//! bake its images and write it back.
//!
//! Modules form layers; each imports those below it:
//!
//! * `load`, `obj`, `side_files`, `estimate`: from files to documents; `save`: from documents to files.
//! * `write`, `merge`: refined sets into their document, and fewer materials and draw calls in it.
//! * `read`, over `sets`, `geometry` and `uv_tiles`: from a document to its texture sets.
//! * `material_index`: the materials, textures and primitives of a document with what they refer to.
//! * `buffers`, over `compression`: what a document refers to, resolved and decompressed.
//! * `append`, `accessor`, `accessor_layout`, `sources`, `prune`, `nodes`: single objects of a document.
//! * `precision`, `document` (with its `tile`), `texture_set`, `transform`, `primitive`, and the table of `extensions`.
//! * `json`, `name`, `uri`, `glb`, `archive`, `upload`, `limits`, `options`: no document at all.

mod accessor;
mod accessor_layout;
mod append;
mod archive;
mod buffers;
mod compression;
mod document;
mod estimate;
mod extensions;
mod foreign;
mod glb;
mod limits;
mod load;
pub(crate) mod merge;
mod name;
mod nodes;
mod obj;
mod options;
mod precision;
mod primitive;
mod prune;
pub mod sample;
mod save;
mod side_files;
mod side_names;
mod sources;
mod tile;
mod upload;
mod uri;

pub use accessor::{
    RawAccessor, accessor_count, accessor_shape, raw_elements, read_indices, read_vec, read_vec2, read_vec3, read_vec4,
};
pub use accessor_layout::{AccessorLayout, kind_name};
pub use append::{ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER};
pub(crate) use archive::{MAX_ENTRIES, check_entries};
pub use compression::{CompressedViews, Origins};
pub use document::{Document, File, Merging};
pub use estimate::{Demand, Estimate, estimate};
pub use gltf::json::accessor::{ComponentType, Type as Kind};
pub use limits::Limits;
pub use load::{is_model_name, load, load_while, side_file};
pub use material_index::MaterialIndex;
pub use merge::{Counts, Merge, Merged, MergedMaterial, finish as finish_merge, prepare as prepare_merge};
pub use nodes::mesh_instances;
pub use options::{Compression, ReadOptions, Tiling, UvSet};
pub use save::to_gltf;
pub use side_files::read_paths;
pub(crate) use side_names::by_name as image_type;
pub use tile::{Tile, TileKind};
pub(crate) use tile::{TileHeader, is_tile};

#[cfg(test)]
pub(crate) mod fixture;
mod geometry;
mod json;
mod material_index;
mod read;
mod sets;
mod texture_set;
mod transform;
mod uv_tiles;
mod write;

pub use foreign::foreign;
pub(crate) use primitive::declared_triangles;
pub use read::read;
pub(crate) use sets::{grid, lcm, leaves_any};
pub use sets::{is_small, mark_uniform, small_slot_warning};
pub use texture_set::{PrimitiveRef, TextureSet};
pub use transform::{TextureTransform, UvLayout};
#[cfg(test)]
pub(crate) use write::tangents::generate as mikktspace;
pub use write::{BakedImage, Refined, read_back, write};

#[cfg(test)]
mod tests;
