//! A texture set as read: one Atlas with what is needed to bake its images and write it back.

use super::transform::UvLayout;
use crate::atlas::Atlas;
use crate::texture::Slot;

/// A primitive that takes part in a texture set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PrimitiveRef {
    /// Index into `/meshes`.
    pub mesh: usize,
    /// Index into `/meshes/N/primitives`.
    pub primitive: usize,
    /// Index into `/materials`.
    pub material: Option<usize>,
    /// The layout that is refined: the TEXCOORD set that is read, and its texture transform. Where there is none, the one that a
    /// stage would make.
    pub layout: UvLayout,
    /// Number of the TEXCOORD set that takes the new layout: the one that is read, or a new one where something else reads it on.
    pub written: usize,
    /// First face of the primitive in the Atlas as uploaded; its faces are contiguous.
    pub first_face: usize,
    /// Number of faces.
    pub face_count: usize,
    /// Whether it is skinned or morphed, or so far from the origin that 32 bits hold no points between its vertices: it is better cut along edges.
    pub along_edges: bool,
    /// The glTF vertex of each corner of each face, as the index buffer names it.
    pub corners: Vec<[u32; 3]>,
    /// Triangles that are no faces of the Atlas, because a number of theirs is not finite: of each its glTF vertices, and how many of
    /// `corners` stand before it.
    pub held: Vec<([u32; 3], usize)>,
    /// By face, whether its TANGENT is far from perpendicular to its NORMAL; empty where none is. Such tangents can be turned by a half, and
    /// by nothing else, so that texels of a normal map mean what they did.
    pub oblique_tangents: Vec<bool>,
}

/// A texture set: one Atlas, its primitives and its images.
#[derive(Debug, Clone)]
pub struct TextureSet {
    /// Position in the model's list of texture sets, from 0.
    pub id: usize,
    /// Name for people: the materials' names, or the model's.
    pub name: String,
    /// The Atlas as uploaded, UV tiles normalised; without a layout where its triangles have no texture coordinates. One face
    /// for each triangle of each primitive, in order.
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
