//! WebP: what the chunks of a file say, checked before its stills, lossy or lossless, with or without alpha, are decoded.

use super::{check_sides, invalid};
use crate::error::Result;
use crate::texture::{Format, Header};

/// Flags of an extended file.
const ALPHA: u8 = 0x10;
const ANIMATION: u8 = 0x02;

/// What the chunks of a file say.
struct Container {
    size: [u32; 2],
    alpha: bool,
    lossy: bool,
}

pub(super) fn header(bytes: &[u8]) -> Result<Header> {
    let Container { size: [width, height], alpha, .. } = container(bytes)?;
    check_sides(width, height)?;
    Ok(Header { width, height, channels: if alpha { 4 } else { 3 }, depth: 8, format: Format::Webp })
}

pub(super) fn is_lossy(bytes: &[u8]) -> bool {
    container(bytes).is_ok_and(|c| c.lossy)
}

/// Walks the chunks (RFC 9649, section 2): all are there, and the picture has the size of the canvas, so that the decoder
/// allocates nothing that the header does not tell.
fn container(bytes: &[u8]) -> Result<Container> {
    let short = || invalid("the file ends before the picture does");
    let end = 8 + u64::from(word(bytes, 4).ok_or_else(short)?);
    let all = usize::try_from(end).ok().and_then(|end| bytes.get(12..end)).ok_or_else(short)?;
    let mut rest = all;
    let mut canvas: Option<([u32; 2], bool)> = None;
    while let Some(name) = rest.get(..4) {
        let length = word(rest, 4).ok_or_else(short)? as usize;
        let data = rest.get(8..).and_then(|r| r.get(..length)).ok_or_else(short)?;
        match name {
            b"VP8X" if canvas.is_none() => {
                let [flags, _, _, _, w0, w1, w2, h0, h1, h2, ..] = *data else { return Err(short()) };
                if flags & ANIMATION != 0 {
                    return Err(invalid("an animation is no texture"));
                }
                let side = |bytes: [u8; 3]| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], 0]) + 1;
                canvas = Some(([side([w0, w1, w2]), side([h0, h1, h2])], flags & ALPHA != 0));
            }
            b"VP8 " => {
                let [_, _, _, 0x9d, 0x01, 0x2a, w0, w1, h0, h1, ..] = *data else {
                    return Err(invalid("its frame has no header"));
                };
                // Two bits above the size only ask for scaling.
                let size = [[w0, w1], [h0, h1]].map(|b| u32::from(u16::from_le_bytes(b) & 0x3fff));
                return picture(size, false, true, canvas);
            }
            b"VP8L" => {
                let bits = data.first().filter(|b| **b == 0x2f).and_then(|_| word(data, 1));
                let bits = bits.ok_or_else(|| invalid("its frame has no header"))?;
                let size = [1 + (bits & 0x3fff), 1 + (bits >> 14 & 0x3fff)];
                return picture(size, bits >> 28 & 1 != 0, false, canvas);
            }
            _ => {}
        }
        rest = rest.get(8 + length + length % 2..).unwrap_or_default();
    }
    Err(invalid("it holds no picture"))
}

fn picture(size: [u32; 2], alpha: bool, lossy: bool, canvas: Option<([u32; 2], bool)>) -> Result<Container> {
    match canvas {
        Some((canvas, _)) if canvas != size => Err(invalid("its picture does not fill its canvas")),
        Some((_, alpha)) => Ok(Container { size, alpha, lossy }),
        None => Ok(Container { size, alpha, lossy }),
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes)
}
