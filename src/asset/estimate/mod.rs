//! How much memory a job will need, told by headers before anything is decoded.

mod document;
mod files;
mod layout;
mod obj;
mod sum;
#[cfg(test)]
mod tests;
mod tree;

use std::path::Path;

use super::limits::Limits;
use super::load::Container;
use crate::error::Result;
use files::Files;
use sum::Sum;

/// What a job on one model will need. Of several models, each with the files that they share, the sums count.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Estimate {
    /// Bytes of memory at the peak, those of a process of its own.
    pub bytes: u64,
    /// Texels of all images.
    pub texels: u64,
    /// Triangles of all meshes, each once.
    pub triangles: u64,
}

/// What a recipe does, as far as memory is concerned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Demand {
    /// Whether the images that are read through the refined layout are drawn anew.
    pub bakes: bool,
    /// Whether surfaces are cut and flattened, those without a layout too.
    pub unwraps: bool,
    /// Whether charts only move, by whole texels, and the format of their images stays: no page of a JPEG is held then.
    pub copies: bool,
    /// Whether some images become KTX2 files.
    pub ktx2: bool,
}

/// Estimates what a refinement of `model` (its name, and where it is on the disk), with the `files` that it may name, will hold in
/// memory at its peak when `threads` compute and the recipe does what `demand` says. Files are only looked at: what is held of them is some heads, the part of a glTF JSON that tells
/// sizes (at most a few times `max_json_bytes` for the worst), and up to some 100 MB of texture coordinates. Declared sizes are clamped to
/// `limits`, beyond which a job fails; what cannot be read counts by its length, and the job itself will tell why.
///
/// # Errors
/// `too_large` when archives unpack to more than `max_input_bytes`, and for images and triangles beyond `limits`.
pub fn estimate(
    model: (&str, &Path),
    files: &[(&str, &Path)],
    limits: &Limits,
    threads: usize,
    demand: Demand,
) -> Result<Estimate> {
    let mut sum = Sum::default();
    let mut all = Files::new(std::iter::once(model).chain(files.iter().copied()), limits)?;
    sum.files += all.packed;
    let mut models = Vec::new();
    for (index, known) in all.known().iter().enumerate() {
        sum.files += known.length;
        if let Some(header) = known.image {
            sum.image(header, known.length, limits);
        }
        if let Some(container) = known.container {
            models.push((index, container));
        }
    }
    for (index, container) in models {
        match container {
            Container::Obj => {
                all.open(index, |file| obj::add(file, &mut sum));
                // Its materials may name any of the images.
                all.known().iter().filter(|k| k.image.is_some()).for_each(|k| sum.encoded += k.length);
            }
            Container::Glb | Container::Gltf | Container::Tile => {
                document::add(&mut all, index, container, limits, &mut sum)
            }
        }
    }
    sum.check(limits)?;
    Ok(sum.estimate(limits, threads, demand))
}
