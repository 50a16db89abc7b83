//! Models made by code, to try things on and to test with. Each has a reason to exist, told at its name.

mod bare;
mod lumpy;
mod paint;
mod parts;
mod random;
mod scaled;
mod scan;
mod scene;
mod surface;

use crate::error::{Code, Failure, Result};
use crate::params::near_or_all;
pub use scaled::SampleTextures;

type Maker = fn() -> scene::Scene;

const SAMPLES: [(&str, Maker); 15] = [
    ("textured", lumpy::textured),
    ("fragmented", lumpy::fragmented),
    ("overlapping", lumpy::overlapping),
    ("tiled", lumpy::tiled),
    ("skinned", parts::skinned),
    ("quantized", lumpy::quantized),
    ("strips", parts::strips),
    ("two_materials", lumpy::two_materials),
    ("bare", bare::bare),
    ("defects", bare::defects),
    ("scan", scan::few),
    ("scan_2000", scan::many),
    ("scan_10000", scan::very_many),
    ("scan_20000", scan::torn_20000),
    ("scan_50000", scan::torn_50000),
];

/// The names that [`sample`] knows; the first is the one to start with.
pub fn names() -> &'static [&'static str] {
    const NAMES: [&str; SAMPLES.len()] = {
        let mut names = [""; SAMPLES.len()];
        let mut i = 0;
        while i < names.len() {
            names[i] = SAMPLES[i].0;
            i += 1;
        }
        names
    };
    &NAMES
}

/// Makes a model with its textures, as GLB; the same bytes every time.
///
/// * `textured`: every slot of the core material and tangents; charts packed with room to spare.
/// * `fragmented`: some 500 small charts, as scans have.
/// * `overlapping`: mirrored halves that share texels, and an overlap by accident.
/// * `tiled`: charts in other tiles under REPEAT.
/// * `skinned`: skin, morph target, animation; two primitives on one material.
/// * `quantized`: KHR_mesh_quantization, interleaved.
/// * `strips`: a triangle strip over a sparse accessor, and a fan.
/// * `two_materials`: two texture sets, and a primitive without UVs.
/// * `bare`: a ring and a lumpy ball without texture coordinates, the top of the ball painted.
/// * `defects`: no texture coordinates, and every fault of a surface: edges with three faces, a vertex that joins two sheets, faces without
///   area, twice, wound the other way round, alone; a T-junction, a band with one side, a leaf with two.
/// * `scan`, `scan_2000`, `scan_10000`: some 500, 2,000 and 10,000 ragged charts of some 20 faces as photogrammetry makes
///   them, each as a camera sees it, with islands and holes; and what is wrong with scans: edges with three faces, faces wound
///   the other way round or without area, vertices in several copies.
/// * `scan_20000`, `scan_50000`: as many charts, of some ten faces each, on a surface with slivers and with vertices at which sheets meet
///   that are not neighbours.
///
/// # Errors
/// `invalid_options` when there is no sample of that name.
pub fn sample(name: &str) -> Result<Vec<u8>> {
    sample_with(name, SampleTextures::default())
}

/// [`sample`] with its textures made larger or smaller, or written as JPEG.
///
/// # Errors
/// As [`sample`].
pub fn sample_with(name: &str, textures: SampleTextures) -> Result<Vec<u8>> {
    let maker = SAMPLES.iter().find(|(n, _)| *n == name).map(|(_, maker)| maker).ok_or_else(|| {
        Failure::new(Code::InvalidOptions, format!("no sample is called `{name}`; {}", near_or_all(name, names())))
    })?;
    let mut document = maker().document;
    textures.apply(&mut document)?;
    document.to_glb()
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(crate) use tests::made;
