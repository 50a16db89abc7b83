//! What is taken over from an uploaded KTX2 file: its kind, and its blocks as they are, so that those which are only moved lose nothing.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};

use basisu::{DecodeFlags, TargetFormat, Transcoder};

use super::BasisKind;
use super::block::{Endpoint, Pattern, of_etc1, selector};
use super::{block, uastc};

/// Blocks that a file has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Uploaded {
    /// Of all levels, as ETC1 has them: colour, and alpha, which is what green shows.
    Etc1s([Vec<[u8; 8]>; 2]),
    /// Of the first level, and what they show.
    Uastc { blocks: Vec<[u8; 16]>, texels: Vec<uastc::Texels> },
}

impl Uploaded {
    /// Those of an ETC1S file; none where it cannot be read.
    pub(super) fn etc1s(file: &[u8], levels: u32, alpha: bool) -> Option<Self> {
        let of = |file: &[u8]| -> Option<Vec<[u8; 8]>> {
            let transcoder = Transcoder::new(file).ok()?;
            let mut blocks = Vec::new();
            for level in 0..levels.max(1) {
                let bytes = transcoder.transcode(level, TargetFormat::Etc1Rgb, DecodeFlags::NONE).ok()?;
                blocks.extend(bytes.as_chunks::<8>().0);
            }
            Some(blocks)
        };
        let blocks = [of(file)?, if alpha { of(&alpha_as_colour(file, levels)?)? } else { Vec::new() }];
        Some(Uploaded::Etc1s(blocks))
    }

    /// Those of a UASTC file, whose first level has these blocks; without those that reach beyond it.
    pub(super) fn uastc(file: &[u8], blocks: Vec<u8>) -> Option<Self> {
        let transcoder = Transcoder::new(file).ok()?;
        let shown = transcoder.transcode(0, TargetFormat::Rgba32, DecodeFlags::NONE).ok()?;
        let shown = shown.as_chunks::<4>().0;
        let (wide, high) = transcoder.base_dimensions();
        let [wide, high] = [wide as usize, high as usize];
        let in_a_row = wide.div_ceil(4);
        let (mut kept, mut texels) = (Vec::new(), Vec::new());
        for (i, block) in blocks.as_chunks::<16>().0.iter().enumerate() {
            let (x, y) = (4 * (i % in_a_row), 4 * (i / in_a_row));
            if x + 4 <= wide && y + 4 <= high {
                kept.push(*block);
                texels.push(std::array::from_fn(|k| shown[(y + k / 4) * wide + x + k % 4]));
            }
        }
        Some(Uploaded::Uastc { blocks: kept, texels })
    }

    pub(super) fn kind(&self) -> BasisKind {
        match self {
            Uploaded::Etc1s(_) => BasisKind::Etc1s,
            Uploaded::Uastc { .. } => BasisKind::Uastc,
        }
    }

    /// Blocks of an ETC1S file: colour or alpha.
    fn pairs(&self, alpha: bool) -> &[[u8; 8]] {
        match self {
            Uploaded::Etc1s(blocks) => &blocks[usize::from(alpha)],
            Uploaded::Uastc { .. } => &[],
        }
    }

    /// Different endpoints and patterns of an ETC1S file, and blocks.
    pub(super) fn counts(&self) -> [usize; 3] {
        let distinct = |mut all: Vec<u32>| {
            all.sort_unstable();
            all.dedup();
            all.len()
        };
        let pairs = || self.pairs(false).iter().chain(self.pairs(true)).map(|b| of_etc1(*b));
        let endpoint = |e: Endpoint| u32::from_le_bytes([e.colour[0], e.colour[1], e.colour[2], e.table]);
        let endpoints = distinct(pairs().map(|(e, _)| endpoint(e)).collect());
        [endpoints, distinct(pairs().map(|(_, p)| p).collect()), pairs().count()]
    }
}

/// An ETC1S file whose colour is the alpha of another: the transcoder gives the blocks of colour alone.
fn alpha_as_colour(file: &[u8], levels: u32) -> Option<Vec<u8>> {
    let mut out = file.to_vec();
    let global = usize::try_from(u64::from_le_bytes(out.get(64..72)?.try_into().ok()?)).ok()?;
    for level in 0..levels.max(1) as usize {
        let image = global.checked_add(GLOBAL_HEADER + IMAGE * level)?;
        let image = out.get_mut(image..image + IMAGE)?;
        // Flags, then where colour and alpha begin in the level, and how long they are.
        image.copy_within(12..20, 4);
        image[12..].fill(0);
    }
    out.get_mut(52..56)?.copy_from_slice(&ONE_SAMPLE.to_le_bytes());
    Some(out)
}

/// Bytes of BasisLZ's global data before the images, of each image, and of a descriptor with one sample.
const GLOBAL_HEADER: usize = 20;
const IMAGE: usize = 20;
const ONE_SAMPLE: u32 = 44;

/// Where texel i of a block comes from in the eight ways in which a square can be laid on itself; first as it is.
const SYMMETRIES: [fn(usize) -> usize; 8] = [
    |i| i,
    |i| 4 * (3 - i % 4) + i / 4,
    |i| 15 - i,
    |i| 4 * (i % 4) + 3 - i / 4,
    |i| 4 * (i / 4) + 3 - i % 4,
    |i| 4 * (3 - i / 4) + i % 4,
    |i| 4 * (i % 4) + i / 4,
    |i| 4 * (3 - i % 4) + 3 - i / 4,
];

/// Blocks of files by what they show.
pub(super) struct KnownBlocks<'a> {
    uploads: &'a [&'a Uploaded],
    /// By hash of the texels: file and block.
    at: HashMap<u64, (u32, u32)>,
}

impl<'a> KnownBlocks<'a> {
    pub(super) fn new(uploads: &'a [&'a Uploaded]) -> Self {
        let mut at = HashMap::new();
        for (file, upload) in uploads.iter().enumerate() {
            let mut add = |i: usize, hash: u64| {
                at.entry(hash).or_insert((file as u32, i as u32));
            };
            match upload {
                Uploaded::Etc1s(blocks) => {
                    for (is_alpha, blocks) in [false, true].into_iter().zip(blocks) {
                        for (i, block) in blocks.iter().enumerate() {
                            add(i, hash(&(is_alpha, shown(of_etc1(*block), is_alpha))));
                        }
                    }
                }
                Uploaded::Uastc { texels, .. } => {
                    texels.iter().enumerate().for_each(|(i, texels)| add(i, hash(texels)))
                }
            }
        }
        KnownBlocks { uploads, at }
    }

    /// What shows exactly these texels in ETC1S, as colour or as alpha; a block of the upload may be turned or mirrored for it.
    pub(super) fn pair(&self, texels: &block::Texels, alpha: bool) -> Option<(Endpoint, Pattern)> {
        SYMMETRIES.iter().find_map(|symmetry| {
            let seen: block::Texels = std::array::from_fn(|i| texels[symmetry(i)]);
            let (file, block) = *self.at.get(&hash(&(alpha, seen)))?;
            let (endpoint, stored) = of_etc1(*self.uploads[file as usize].pairs(alpha).get(block as usize)?);
            let pattern = (0..16).map(|i| (selector(stored, i) as u32) << (2 * symmetry(i))).sum();
            (shown((endpoint, pattern), alpha) == *texels).then_some((endpoint, pattern))
        })
    }

    /// What shows exactly these texels in UASTC.
    pub(super) fn block(&self, wanted: &uastc::Texels) -> Option<[u8; 16]> {
        let (file, block) = *self.at.get(&hash(wanted))?;
        match self.uploads[file as usize] {
            Uploaded::Uastc { blocks, texels } if texels[block as usize] == *wanted => Some(blocks[block as usize]),
            _ => None,
        }
    }
}

/// What a block shows: of alpha what green says.
fn shown((endpoint, pattern): (Endpoint, Pattern), alpha: bool) -> block::Texels {
    let texels = endpoint.texels(pattern);
    if alpha { texels.map(|[_, green, _]| [green; 3]) } else { texels }
}

fn hash<T: Hash>(texels: &T) -> u64 {
    let mut hasher = DefaultHasher::new();
    texels.hash(&mut hasher);
    hasher.finish()
}
