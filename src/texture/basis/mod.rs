//! Basis Universal in KTX2 files: what KHR_texture_basisu allows.

mod bits;
mod block;
mod clusters;
mod container;
mod etc1s;
mod mips;
mod nearest;
mod streams;
mod uastc;
mod uploaded;

#[cfg(test)]
mod tests;

use std::sync::Arc;

use image::DynamicImage;
use rayon::prelude::*;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};

use super::depth;
use crate::context::Context;
use crate::error::{Failure, Result};
use container::{Content, File, Sample, Supercompression};
use etc1s::Slice;
use mips::Level;
pub use mips::MipFilter;
use streams::Streams;
use uploaded::{KnownBlocks, Uploaded};

/// Sides of textures are multiples of it.
pub(crate) const BLOCK: u32 = 4;
/// Levels that readers allow, and with them the longest side.
const LEVELS: usize = 16;
pub(crate) const LONGEST: u32 = (1 << LEVELS) - 1;
/// Colour models of the Khronos Data Format, and their channels.
const ETC1S: u8 = 163;
const ETC1S_RGB: u8 = 0;
const ETC1S_ALPHA: u8 = 15;
const UASTC: u8 = 166;
const UASTC_RGB: u8 = 0;
const UASTC_RGBA: u8 = 3;

/// How blocks hold their texels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BasisKind {
    /// Endpoints and patterns out of palettes, compressed by BasisLZ.
    Etc1s,
    /// 16 bytes a block, compressed by Zstandard.
    Uastc,
}

/// How a file is encoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BasisCoding {
    kind: BasisKind,
    /// Whether there are mip levels, down to one texel.
    mips: bool,
    filter: MipFilter,
    /// Files whose blocks are taken over where they show what is to be shown.
    uploads: Vec<Arc<Uploaded>>,
}

/// What an uploaded file takes with it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BasisUpload {
    mips: bool,
    blocks: Arc<Uploaded>,
}

impl BasisUpload {
    /// Of an ETC1S file that has `levels`; none where it cannot be read.
    pub(super) fn etc1s(file: &[u8], levels: u32, alpha: bool) -> Option<Self> {
        Some(BasisUpload { mips: levels > 1, blocks: Arc::new(Uploaded::etc1s(file, levels, alpha)?) })
    }

    /// Of a UASTC file that has `levels`, of which `blocks` are the first; none where it cannot be read.
    pub(super) fn uastc(file: &[u8], levels: u32, blocks: Vec<u8>) -> Option<Self> {
        Some(BasisUpload { mips: levels > 1, blocks: Arc::new(Uploaded::uastc(file, blocks)?) })
    }
}

impl BasisCoding {
    /// As the uploaded files, if there are any: with mip levels where one has some, UASTC where one is. What is new has mip levels where
    /// `mips`, and is ETC1S if it is colour: elsewhere that shows. `kind` is what is asked for.
    pub fn of(uploads: &[&BasisUpload], kind: Option<BasisKind>, filter: MipFilter, mips: bool) -> Self {
        let any = |kind: BasisKind| uploads.iter().any(|u| u.blocks.kind() == kind);
        let kind = kind.unwrap_or(match uploads {
            [] if filter.srgb => BasisKind::Etc1s,
            [] => BasisKind::Uastc,
            _ if any(BasisKind::Uastc) => BasisKind::Uastc,
            _ => BasisKind::Etc1s,
        });
        let mips = if uploads.is_empty() { mips } else { uploads.iter().any(|u| u.mips) };
        let uploads = uploads.iter().filter(|u| u.blocks.kind() == kind).map(|u| Arc::clone(&u.blocks)).collect();
        BasisCoding { kind, mips, filter, uploads }
    }

    /// Encodes an image of 8 bits a channel.
    ///
    /// # Errors
    /// `canceled`; `internal` for an image of 16 bits, or with sides that are no multiples of four.
    pub(super) fn encode(&self, image: &DynamicImage, context: &Context) -> Result<Vec<u8>> {
        let size = [image.width(), image.height()];
        if depth(image) != 8 || size.iter().any(|n| *n == 0 || n % BLOCK != 0 || *n > LONGEST) {
            return Err(Failure::internal("an image cannot be held in blocks of four texels and 8 bits"));
        }
        let has_alpha = image.color().has_alpha();
        let texels = image.to_rgba8().into_raw().as_chunks::<4>().0.to_vec();
        let base = Level { size: size.map(|n| n as usize), texels };
        let levels = if self.mips { base.chain(self.filter) } else { vec![base] };
        let uploads: Vec<&Uploaded> = self.uploads.iter().map(|u| &**u).collect();
        let content = match self.kind {
            BasisKind::Etc1s => etc1s_content(levels, has_alpha, &uploads, context)?,
            BasisKind::Uastc => uastc_content(&levels, has_alpha, &uploads, context)?,
        };
        Ok(File { size, srgb: self.filter.srgb, content }.bytes())
    }
}

fn etc1s_content(levels: Vec<Level>, has_alpha: bool, uploads: &[&Uploaded], context: &Context) -> Result<Content> {
    let slices: Vec<Slice> = levels.iter().flat_map(|level| slices(level, has_alpha)).collect();
    drop(levels);
    let (palettes, pairs) = etc1s::encode(&slices, uploads, context)?;
    let pairs: Vec<_> = slices.iter().map(|s| s.size[0]).zip(pairs).collect();
    let streams = Streams::new(&palettes, &pairs);
    let group = 1 + usize::from(has_alpha);
    let mut global = Vec::new();
    global.extend((palettes.endpoints.len() as u16).to_le_bytes());
    global.extend((palettes.patterns.len() as u16).to_le_bytes());
    let parts = [&streams.endpoints, &streams.patterns, &streams.tables];
    let words = |words: &[usize]| words.iter().flat_map(|n| (*n as u32).to_le_bytes()).collect::<Vec<u8>>();
    global.extend(words(&[parts[0].len(), parts[1].len(), parts[2].len(), 0]));
    for level in streams.slices.chunks_exact(group) {
        let colour = level[0].len();
        let alpha = level.get(1).map_or([0, 0], |alpha| [colour, alpha.len()]);
        global.extend(words(&[0, 0, colour, alpha[0], alpha[1]]));
    }
    parts.iter().for_each(|part| global.extend(*part));
    let sample = |channel, offset| Sample { channel, bits: [offset, 64] };
    let mut samples = vec![sample(ETC1S_RGB, 0)];
    samples.extend(has_alpha.then(|| sample(ETC1S_ALPHA, 64)));
    Ok(Content {
        model: ETC1S,
        samples,
        supercompression: Supercompression::BasisLz,
        global,
        levels: streams.slices.chunks_exact(group).map(|level| (level.concat(), 0)).collect(),
    })
}

fn uastc_content(levels: &[Level], has_alpha: bool, uploads: &[&Uploaded], context: &Context) -> Result<Content> {
    let known = KnownBlocks::new(uploads);
    let level = |level: &Level| {
        let texels = blocks(level, |texel| texel).1;
        let encoded = |i: usize| known.block(&texels[i]).unwrap_or_else(|| uastc::encode(&texels[i]));
        let blocks = in_parts(texels.len(), context, encoded)?;
        let bytes = blocks.as_flattened();
        Ok((compress_to_vec(bytes, CompressionLevel::Fastest), bytes.len() as u64))
    };
    let channel = if has_alpha { UASTC_RGBA } else { UASTC_RGB };
    Ok(Content {
        model: UASTC,
        samples: vec![Sample { channel, bits: [0, 128] }],
        supercompression: Supercompression::Zstandard,
        global: Vec::new(),
        levels: levels.iter().map(level).collect::<Result<_>>()?,
    })
}

/// Blocks from one look to the next whether all is given up.
const PART: usize = 4096;

/// What is made of each block, in parallel.
fn in_parts<T: Send>(count: usize, context: &Context, of: impl Fn(usize) -> T + Sync) -> Result<Vec<T>> {
    let part = |start: usize| {
        context.check()?;
        Ok((start..count.min(start + PART)).map(&of).collect())
    };
    let parts: Vec<Vec<T>> = (0..count).into_par_iter().step_by(PART).map(part).collect::<Result<_>>()?;
    Ok(parts.into_iter().flatten().collect())
}

/// A level's colour, and its alpha as greys.
fn slices(level: &Level, has_alpha: bool) -> Vec<Slice> {
    let slice = |alpha: bool| {
        let (size, blocks) = blocks(level, |[r, g, b, a]| if alpha { [a; 3] } else { [r, g, b] });
        Slice { size, alpha, blocks }
    };
    [false, true].into_iter().take(1 + usize::from(has_alpha)).map(slice).collect()
}

/// Blocks of a level, their number in a row and of rows; those that reach beyond it repeat its last row and column.
fn blocks<T: Send>(level: &Level, texel: impl Fn([u8; 4]) -> T + Sync) -> ([usize; 2], Vec<[T; 16]>) {
    let [wide, high] = level.size;
    let size = [wide.div_ceil(4), high.div_ceil(4)];
    let block = |i: usize| {
        let (x, y) = (4 * (i % size[0]), 4 * (i / size[0]));
        std::array::from_fn(|k| texel(level.texels[(y + k / 4).min(high - 1) * wide + (x + k % 4).min(wide - 1)]))
    };
    (size, (0..size[0] * size[1]).into_par_iter().map(block).collect())
}
