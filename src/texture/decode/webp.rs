//! WebP: what the chunks of a file say, checked before its stills, lossy or lossless, with or without alpha, are decoded.

use super::{check_sides, invalid};
use crate::error::Result;
use crate::texture::{Format, Header};

/// Flags of an extended file.
const ALPHA: u8 = 0x10;
const ANIMATION: u8 = 0x02;

/// What the chunks of a file say.
struct Container<'a> {
    size: [u32; 2],
    alpha: bool,
    lossy: bool,
    /// The picture's data.
    frame: &'a [u8],
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
fn container(bytes: &[u8]) -> Result<Container<'_>> {
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
                return picture(size, false, true, canvas, data);
            }
            b"VP8L" => {
                let bits = data.first().filter(|b| **b == 0x2f).and_then(|_| word(data, 1));
                let bits = bits.ok_or_else(|| invalid("its frame has no header"))?;
                let size = [1 + (bits & 0x3fff), 1 + (bits >> 14 & 0x3fff)];
                return picture(size, bits >> 28 & 1 != 0, false, canvas, data);
            }
            _ => {}
        }
        rest = rest.get(8 + length + length % 2..).unwrap_or_default();
    }
    Err(invalid("it holds no picture"))
}

fn picture(
    size: [u32; 2],
    alpha: bool,
    lossy: bool,
    canvas: Option<([u32; 2], bool)>,
    frame: &[u8],
) -> Result<Container<'_>> {
    match canvas {
        Some((canvas, _)) if canvas != size => Err(invalid("its picture does not fill its canvas")),
        Some((_, alpha)) => Ok(Container { size, alpha, lossy, frame }),
        None => Ok(Container { size, alpha, lossy, frame }),
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes)
}

/// Quality in 0..=100 of a lossy file, as libwebp has it, from the quantiser of its frame, or those of its segments by their shares of the
/// picture (RFC 6386, 9.3 to 9.6). None for other files.
pub(crate) fn quality(bytes: &[u8]) -> Option<u8> {
    let frame = container(bytes).ok().filter(|c| c.lossy)?.frame;
    let mut bits = BoolDecoder::new(frame.get(10..)?);
    // Colour space, clamping.
    bits.number(2);
    let (mut segments, mut shares) = (None, [0.25; 4]);
    if bits.flag() {
        let (map, data) = (bits.flag(), bits.flag());
        if data {
            let absolute = bits.flag();
            let steps = [0; 4].map(|_| bits.signed(7));
            for _ in 0..4 {
                bits.signed(6);
            }
            segments = Some((absolute, steps));
        }
        if map {
            // Of 255 in the first half, of that in its first half, of the other half in its first.
            let [half, first, third] =
                [0; 3].map(|_| if bits.flag() { f64::from(bits.number(8)) / 255.0 } else { 1.0 });
            shares = [half * first, half * (1.0 - first), (1.0 - half) * third, (1.0 - half) * (1.0 - third)];
        }
    }
    // The loop filter: kind, level, sharpness, and what changes them.
    bits.number(10);
    if bits.flag() && bits.flag() {
        for _ in 0..8 {
            bits.signed(6);
        }
    }
    // Partitions.
    bits.number(2);
    let base = bits.number(7) as i32;
    // The library takes 127 (1 - c), where c is the cube root of a function of quality that has a bend at 3/4; for a segment it raises c to a
    // power, and those are 1 in the mean.
    let compression = |index: i32| (1.0 - f64::from(index.clamp(0, 126)) / 127.0).ln();
    let mean = match segments {
        Some((absolute, steps)) => {
            let own = steps.map(|step| compression(if absolute { step } else { base + step }));
            own.iter().zip(shares).map(|(own, share)| own * share).sum()
        }
        None => compression(base),
    };
    let linear = mean.exp().powi(3);
    let quality = if linear < 0.5 { linear * 1.5 } else { (linear + 1.0) / 2.0 };
    Some((quality * 100.0).round().clamp(0.0, 100.0) as u8)
}

/// Reads bits that were coded with even probabilities (RFC 6386, 7.3). Beyond the end there are zeros.
struct BoolDecoder<'a> {
    rest: &'a [u8],
    value: u32,
    range: u32,
    shifted: u32,
}

impl<'a> BoolDecoder<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = BoolDecoder { rest: bytes, value: 0, range: 255, shifted: 0 };
        decoder.value = decoder.byte() << 8 | decoder.byte();
        decoder
    }

    fn byte(&mut self) -> u32 {
        let Some((byte, rest)) = self.rest.split_first() else { return 0 };
        self.rest = rest;
        u32::from(*byte)
    }

    fn flag(&mut self) -> bool {
        let split = 1 + ((self.range - 1) >> 1);
        let is_set = self.value >= split << 8;
        if is_set {
            self.range -= split;
            self.value -= split << 8;
        } else {
            self.range = split;
        }
        while self.range < 128 {
            self.value <<= 1;
            self.range <<= 1;
            self.shifted += 1;
            if self.shifted == 8 {
                self.shifted = 0;
                self.value |= self.byte();
            }
        }
        is_set
    }

    /// A number of so many bits.
    fn number(&mut self, bits: u32) -> u32 {
        (0..bits).fold(0, |number, _| number << 1 | u32::from(self.flag()))
    }

    /// A number with its sign behind it, 0 where it is not given.
    fn signed(&mut self, bits: u32) -> i32 {
        if !self.flag() {
            return 0;
        }
        let number = self.number(bits) as i32;
        if self.flag() { -number } else { number }
    }
}
