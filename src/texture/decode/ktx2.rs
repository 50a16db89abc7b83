//! KTX2 (Khronos Texture Container 2.0): the first level of a plain 2D texture, in Basis Universal's ETC1S and UASTC or in
//! uncompressed formats of 8 and 16 bits a channel.

use std::io::Read as _;

use basisu::{DecodeFlags, TargetFormat, Transcoder};
use image::DynamicImage;

use super::{check_sides, check_size, invalid};
use crate::error::{Failure, Result};
use crate::texture::pixels::{Depth, from_samples};
use crate::texture::{BasisUpload, Format, Header};

/// First bytes of every KTX2 file.
pub(super) const IDENTIFIER: [u8; 12] = [0xab, b'K', b'T', b'X', b' ', b'2', b'0', 0xbb, 0x0d, 0x0a, 0x1a, 0x0a];
/// Bytes before the index of levels, and of one entry of it.
const INDEX: usize = 80;
const ENTRY: usize = 24;
/// Mip levels that the largest image may have.
const LEVELS: u32 = 16;

/// Colour models of the data format descriptor (Khronos Data Format 1.3).
const MODEL_ETC1S: u32 = 163;
const MODEL_UASTC: u32 = 166;
/// Channels that mean alpha: of the second sample of ETC1S; of the only one of UASTC, as RGBA and as RRRG.
const ETC1S_ALPHA: u32 = 15;
const UASTC_ALPHA: [u32; 2] = [3, 5];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Compression {
    None,
    BasisLz,
    Zstandard,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Texels {
    /// Blocks of Basis Universal.
    Basis,
    /// Samples of one texel after the other.
    Plain { channels: u8, bytes: u8, blue_first: bool },
}

/// What a file says of its first level, checked against its length.
struct Container<'a> {
    header: Header,
    texels: Texels,
    compression: Compression,
    /// As it stands in the file.
    level: &'a [u8],
}

pub(super) fn header(bytes: &[u8]) -> Result<Header> {
    Ok(container(bytes)?.header)
}

pub(super) fn is_lossy(bytes: &[u8]) -> bool {
    container(bytes).is_ok_and(|c| c.texels == Texels::Basis)
}

/// What a file with blocks of Basis Universal takes with it; none for others, and where it cannot be read.
pub(super) fn upload(bytes: &[u8]) -> Option<BasisUpload> {
    let file = container(bytes).ok().filter(|c| c.texels == Texels::Basis)?;
    let levels = word(bytes, 40)?;
    if file.compression == Compression::BasisLz {
        return BasisUpload::etc1s(bytes, levels, file.header.channels == 4);
    }
    let Header { width, height, .. } = file.header;
    let blocks = file.plain(16 * width.div_ceil(4) as usize * height.div_ceil(4) as usize).ok()?;
    BasisUpload::uastc(bytes, levels, blocks)
}

pub(super) fn decode(bytes: &[u8], max_pixels: u64) -> Result<DynamicImage> {
    let file = container(bytes)?;
    check_size(&file.header, max_pixels)?;
    match file.texels {
        Texels::Basis => image(&file.header, basis(bytes, &file.header)?),
        Texels::Plain { channels: stored, bytes: wide, blue_first } => {
            let Header { width, height, channels, .. } = file.header;
            let texel = usize::from(stored) * usize::from(wide);
            let data = file.plain(width as usize * height as usize * texel)?;
            let place = |c: usize| if blue_first && c < 3 { 2 - c } else { c };
            // Channels that are not stored are 0.
            let order = (0..usize::from(channels)).map(place);
            let texels = data.chunks_exact(texel);
            if wide == 2 {
                let sample =
                    |t: &[u8], c: usize| t.get(2 * c..2 * c + 2).map_or(0, |b| u16::from_le_bytes([b[0], b[1]]));
                image(&file.header, texels.flat_map(|t| order.clone().map(move |c| sample(t, c))).collect())
            } else {
                let sample = |t: &[u8], c: usize| t.get(c).copied().unwrap_or(0);
                image(&file.header, texels.flat_map(|t| order.clone().map(move |c| sample(t, c))).collect())
            }
        }
    }
}

fn image<T: Depth>(header: &Header, samples: Vec<T>) -> Result<DynamicImage> {
    from_samples([header.width, header.height], header.channels, samples)
        .map_err(|_| invalid("its data does not fill the image"))
}

/// RGB or RGBA of the first level.
fn basis(bytes: &[u8], header: &Header) -> Result<Vec<u8>> {
    let failed = |e: basisu::Error| invalid(format!("{e:?}"));
    let transcoder = Transcoder::new(bytes).map_err(failed)?;
    if transcoder.base_dimensions() != (header.width, header.height) {
        return Err(invalid("its size is out of range"));
    }
    let mut texels = transcoder.transcode(0, TargetFormat::Rgba32, DecodeFlags::NONE).map_err(failed)?;
    if header.channels == 3 {
        let count = texels.len() / 4;
        for i in 0..count {
            texels.copy_within(4 * i..4 * i + 3, 3 * i);
        }
        texels.truncate(3 * count);
    }
    Ok(texels)
}

impl Container<'_> {
    /// The `size` bytes of uncompressed texels.
    fn plain(&self, size: usize) -> Result<Vec<u8>> {
        if self.compression == Compression::None {
            return self.level.get(..size).map(<[u8]>::to_vec).ok_or_else(short);
        }
        let mut stream = ruzstd::decoding::StreamingDecoder::new(self.level).map_err(invalid)?;
        // Not more at once than the stream really gives.
        let mut data = Vec::new();
        stream.by_ref().take(size as u64).read_to_end(&mut data).map_err(invalid)?;
        if data.len() == size { Ok(data) } else { Err(short()) }
    }
}

fn container(bytes: &[u8]) -> Result<Container<'_>> {
    let word = |at: usize| word(bytes, at).ok_or_else(short);
    let (width, height) = (word(20)?, word(24)?);
    check_sides(width, height)?;
    let [depth, layers, faces, levels] = [word(28)?, word(32)?, word(36)?, word(40)?];
    if depth > 0 || layers > 1 || faces != 1 || levels > LEVELS {
        return Err(invalid("it is no plain 2D texture"));
    }
    let compression = match word(44)? {
        0 => Compression::None,
        1 => Compression::BasisLz,
        2 => Compression::Zstandard,
        n => return Err(invalid(format!("supercompression scheme {n} is not supported"))),
    };
    let within = |offset: u64, length: u64| {
        let range = usize::try_from(offset).ok()?..usize::try_from(offset.checked_add(length)?).ok()?;
        bytes.get(range)
    };
    // All levels and the global data must be there: the decoder reads them where they are said to be.
    for level in 0..levels.max(1) as usize {
        within(long(bytes, INDEX + ENTRY * level)?, long(bytes, INDEX + ENTRY * level + 8)?).ok_or_else(short)?;
    }
    within(long(bytes, 64)?, long(bytes, 72)?).ok_or_else(short)?;
    let level = within(long(bytes, INDEX)?, long(bytes, INDEX + 8)?).ok_or_else(short)?;
    let inflated = long(bytes, INDEX + 16)?;
    let descriptor = within(u64::from(word(48)?), u64::from(word(52)?)).ok_or_else(short)?;

    let vulkan = word(12)?;
    let (texels, channels, size) = if vulkan == 0 {
        let (alpha, size) = basis_layout(descriptor, compression, [width, height])?;
        (Texels::Basis, if alpha { 4 } else { 3 }, size)
    } else {
        let (channels, bytes, blue_first) = plain_layout(vulkan)
            .filter(|_| compression != Compression::BasisLz)
            .ok_or_else(|| invalid(format!("Vulkan format {vulkan} is not supported")))?;
        let size = u64::from(width) * u64::from(height) * u64::from(channels) * u64::from(bytes);
        (Texels::Plain { channels, bytes, blue_first }, channels.max(3), Some(size))
    };
    let declared = if compression == Compression::Zstandard { inflated } else { level.len() as u64 };
    if size.is_some_and(|size| declared != size) {
        return Err(invalid(format!("{declared} bytes do not make an image of {width} x {height} texels")));
    }
    let depth = if matches!(texels, Texels::Plain { bytes: 2, .. }) { 16 } else { 8 };
    let header = Header { width, height, channels, depth, format: Format::Ktx2 };
    Ok(Container { header, texels, compression, level })
}

/// Whether there is alpha, and the bytes of the first level where the size tells them.
fn basis_layout(descriptor: &[u8], compression: Compression, [w, h]: [u32; 2]) -> Result<(bool, Option<u64>)> {
    // After the total size: two words of the block's header, the colour model, the block's size, its bytes, and the samples.
    let model = word(descriptor, 12).ok_or_else(short)? & 0xff;
    let channel = |sample: usize| word(descriptor, 28 + 16 * sample).map(|w| w >> 24 & 15);
    match (model, compression) {
        (MODEL_ETC1S, Compression::BasisLz) => Ok((channel(1) == Some(ETC1S_ALPHA), None)),
        (MODEL_UASTC, Compression::None | Compression::Zstandard) => {
            let blocks = u64::from(w.div_ceil(4)) * u64::from(h.div_ceil(4));
            Ok((channel(0).is_some_and(|c| UASTC_ALPHA.contains(&c)), Some(16 * blocks)))
        }
        _ => Err(invalid(format!("colour model {model} is not supported"))),
    }
}

/// Channels, bytes of each, and whether blue comes first, of an uncompressed format (VkFormat: R8, RG8, RGB8, BGR8, RGBA8, BGRA8 and
/// R16, RG16, RGB16, RGBA16; UNORM and, of the first, SRGB).
fn plain_layout(vulkan: u32) -> Option<(u8, u8, bool)> {
    match vulkan {
        9 | 15 => Some((1, 1, false)),
        16 | 22 => Some((2, 1, false)),
        23 | 29 => Some((3, 1, false)),
        30 | 36 => Some((3, 1, true)),
        37 | 43 => Some((4, 1, false)),
        44 | 50 => Some((4, 1, true)),
        70 => Some((1, 2, false)),
        77 => Some((2, 2, false)),
        84 => Some((3, 2, false)),
        91 => Some((4, 2, false)),
        _ => None,
    }
}

fn short() -> Failure {
    invalid("the file ends before the picture does")
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes)
}

fn long(bytes: &[u8], at: usize) -> Result<u64> {
    bytes.get(at..at + 8).and_then(|b| b.try_into().ok()).map(u64::from_le_bytes).ok_or_else(short)
}
