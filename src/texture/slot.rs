//! What is known of an image before it is decoded: what it means, and who reads it how.

use super::{Alpha, Header, Role, Wrap};

/// One image of a texture set: what is baked to the new layout.
#[derive(Debug, Clone)]
pub struct Slot {
    /// Index into `/images`.
    pub image: usize,
    /// What the image means; the first in the order of [`Role`] where it has several.
    pub role: Role,
    /// Name in reports and files, unique in the set: the role, with a number where there are several.
    pub name: String,
    /// Size and format from the header.
    pub header: Header,
    /// Side in texels of the blocks that its file is encoded by, each by itself: 8 or 16 for JPEG, 4 for KTX2, else 1.
    pub block: u32,
    /// Who reads it with which wrap modes; together all of `primitives`, each once.
    pub readings: Vec<Reading>,
    /// Whether its sampler's minification filter reads mipmaps (the default when the filter is not given).
    pub mipmaps: bool,
    /// Alpha mode of the material(s) reading it; `Opaque` for everything but base colour.
    pub alpha: Alpha,
    /// Which of the set's primitives read it (index into `primitives`).
    pub primitives: Vec<u32>,
    /// Slots that stay as they are (one colour, or under 1/8 of the reference): not baked, UVs of [0,1] still fit them.
    pub exempt: bool,
}

/// Primitives that read an image with the same wrap modes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reading {
    /// Wrap modes (S, T) of the samplers.
    pub wrap: [Wrap; 2],
    /// Indices into the set's `primitives`, ascending.
    pub primitives: Vec<u32>,
}
