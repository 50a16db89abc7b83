//! What a job may warn of: the closed list of codes.

use serde::{Deserialize, Serialize};

/// Every code of a warning, with what it tells. The names are part of the contract: the option `strict` takes them.
pub const WARNINGS: &[(&str, &str)] = &[
    ("accessor_count_corrected", "an accessor declares another count than its compressed data holds"),
    ("animated_texture_transform", "a material is left as it is: an animation moves one of its texture transforms"),
    ("anisotropy_without_texture", "a material is left as it is: its anisotropy has no texture that could turn"),
    ("bound_not_met", "a bound that a stage promises could not be met"),
    ("boundary_limit_missed", "the seams became longer than `bounded.max_boundary_length` allows"),
    ("charts_given_back", "charts that a stage would have broken lie as they were uploaded"),
    ("charts_kept", "charts that no rectangle could be made of keep their shape"),
    (
        "decompressed",
        "a primitive that came compressed is written uncompressed: its codec cannot carry what became of it",
    ),
    (
        "degenerate_faces_dropped",
        "faces of an OBJ with fewer than three corners, or triangles of which Draco carries none, are left out: they have no area",
    ),
    ("directions_on_two_layouts", "a material is left as it is: its normal maps are read through two layouts"),
    ("draco_ignored", "a primitive's Draco data is not used: it has plain data too"),
    ("extension_dropped", "an extension of a primitive is left out: its triangles were divided"),
    ("held_back", "a part of the surface was left out by a stage: its charts share texels, or overlap themselves"),
    ("heavier_texture", "an image takes more bytes a texel than it did"),
    ("importance_missing", "a part of the surface has no weights, and counts as ordinary"),
    ("invalid_image", "an image cannot be read: what shows it is left as it is"),
    ("invalid_normals_replaced", "normals without a direction were computed from the faces"),
    ("kept_input", "an atlas stays as it was: the result would be larger"),
    ("kept_png", "an image is written as PNG: the format that was asked for cannot hold it"),
    ("lossy_reencode", "an image that was compressed with loss is compressed so once more"),
    ("map_option_dropped", "an option of a map in an MTL has no counterpart in glTF"),
    ("material_map_dropped", "a map of an MTL has no counterpart in glTF"),
    ("material_extension_texture", "a texture keeps its layout: its material extension is not known"),
    ("misaligned_accessor", "an accessor does not lie on a multiple of its size"),
    ("misaligned_chunk", "a chunk of a GLB does not lie on a multiple of four bytes"),
    ("missing_image", "an image that the model names is not there: what shows it is left as it is"),
    ("missing_material", "a material that an OBJ names is in none of its libraries"),
    ("missing_material_library", "a material library that an OBJ names is not there"),
    ("missing_texture_coordinates", "faces of an OBJ name texture coordinates that it does not have"),
    ("more_warnings", "there are more warnings than are listed"),
    ("no_layout", "a stage that starts from the uploaded layout found none"),
    ("non_finite_triangles", "triangles with a position or texture coordinate that is NaN or infinite are held back"),
    ("not_compressed", "a primitive is written uncompressed: the codec that was asked for cannot carry it"),
    ("not_joined", "charts spread too far for an atlas that several models share"),
    ("not_merged", "`atlas.merge` is not done for a model"),
    ("nothing_to_cut", "a stage found no surface that it could cut"),
    ("nothing_to_refine", "the models have nothing that the recipe could refine"),
    ("obj_elements_dropped", "lines, points, curves or surfaces of an OBJ are left out"),
    ("option_ignored", "an option of a queued job is not known to this version"),
    ("other_texture_transform", "a texture keeps its layout: it is read through another texture transform"),
    ("other_uv_set", "a texture keeps its layout: it is read through another TEXCOORD set"),
    ("packed_without_merging", "charts were packed as they are: merged, they would fill a larger sheet than they had"),
    ("palette_texture", "a texture set is left as it is: its charts cover no area"),
    ("panel_scale", "panels of one atlas differ in scale"),
    ("piece_reverted", "a part of the surface could not be flattened within the bound"),
    ("polygons_fanned", "large concave polygons of an OBJ are cut into fans, which may overlap"),
    ("primitive_extension", "a primitive is left as it is: it has an extension that is not known"),
    ("recentred", "a model far from its origin was moved there, with a node that puts it back"),
    ("reencoded_png", "an image is written as PNG: its format is read, and not written"),
    ("sampler_conflict", "a texture set is left as it is: an image is read with several wrap modes"),
    ("scaled_to_fit", "charts were scaled down to fit on a sheet"),
    ("slot_refined", "an image of one colour, or a small one, is refined because other models need it"),
    ("small_slot_resampled", "a texture far smaller than the largest is resampled"),
    ("stage_reverted", "a stage broke an atlas and was undone there"),
    ("texcoord_morph", "a primitive is left as it is: a morph target moves its texture coordinates"),
    ("texture_extension", "a texture set is left as it is: a texture has an extension that is not known"),
    ("tile_unwrapped", "a 3D tile is written as plain glTF: its batch table is left out"),
    ("tiling_left", "a texture set is left as it is: its charts repeat their texture"),
    ("tiling_too_large", "a texture set is left as it is: its repeated texture would fill too many sheets"),
    ("trailing_bytes", "bytes behind the end of a GLB are left out"),
    ("trailing_indices", "indices behind the last whole triangle are left out"),
    ("unknown_chunk", "a chunk of a GLB is not known, and left out"),
    ("unused_binary_chunk", "the binary chunk of a GLB is not used by its JSON"),
    ("unused_file", "a file was uploaded that no model names"),
    ("uv_out_of_range", "a texture set is left as it is: its texture coordinates are beyond all measure"),
    ("vertex_colors_dropped", "vertex colours of an OBJ do not fit its faces, and are left out"),
    ("wild_uvs", "texture coordinates of some faces lie far outside the image, and were taken into it"),
];

/// Something that the user should know and that did not stop the work.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Warning {
    /// Stable code in snake case: one of those that the option `strict` may name.
    pub code: String,
    /// One sentence for a person.
    pub message: String,
    /// JSON pointer into the glTF document.
    pub pointer: Option<String>,
}

impl Warning {
    /// A warning without a pointer.
    pub fn new(code: &str, message: impl Into<String>) -> Self {
        debug_assert!(WARNINGS.iter().any(|w| w.0 == code), "{code} is not listed");
        Warning { code: code.to_owned(), message: message.into(), pointer: None }
    }
    /// The same warning, at a JSON pointer.
    pub fn at(mut self, pointer: impl Into<String>) -> Self {
        self.pointer = Some(pointer.into());
        self
    }
}
