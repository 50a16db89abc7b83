//! Mode 0: elements as differences from the one before, byte by byte, in blocks of up to 256 elements.

use super::{Decoded, Reader, body};

/// Most elements of a block.
pub(super) const BLOCK: usize = 256;
/// Elements of a group, the unit for which a number of bits is chosen.
pub(super) const GROUP: usize = 16;

/// Elements of a block.
pub(super) fn block_size(stride: usize) -> usize {
    (8192 / stride / GROUP * GROUP).min(BLOCK)
}

/// Decodes `count` elements of `stride` bytes, a multiple of 4 up to 256.
pub(super) fn decode(stream: &[u8], count: usize, stride: usize) -> Decoded<Vec<u8>> {
    let modern = match stream.first() {
        Some(0xA0) => false,
        Some(0xA1) => true,
        _ => return Err("does not begin with 0xa0 or 0xa1"),
    };
    let modes = if modern { stride / 4 } else { 0 };
    let least_tail = if modern { 24 } else { 32 };
    let tail = stride + modes;
    let (_, mut data) = body(stream, tail.max(least_tail))?;
    let mut tail = Reader { left: stream.get(stream.len() - tail..).unwrap_or_default() };
    let mut last = tail.take(stride)?.to_vec();
    let modes = tail.take(modes)?;
    if modes.iter().any(|mode| mode & 15 > 2 || (mode & 15 < 2 && mode >> 4 != 0)) {
        return Err("names an unknown channel mode");
    }

    let mut out = vec![0; count * stride];
    let mut deltas = [[0; BLOCK]; 4];
    for elements in out.chunks_mut(block_size(stride) * stride) {
        let count = elements.len() / stride;
        let controls = if modern { Some(data.take(stride / 4)?) } else { None };
        for channel in 0..stride / 4 {
            for (byte, deltas) in deltas.iter_mut().enumerate() {
                let widths = match controls {
                    None => [0, 2, 4, 8],
                    Some(controls) => match controls[channel] >> (2 * byte) & 3 {
                        0 => [0, 1, 2, 4],
                        1 => [1, 2, 4, 8],
                        2 => {
                            deltas[..count].fill(0);
                            continue;
                        }
                        _ => {
                            deltas[..count].copy_from_slice(data.take(count)?);
                            continue;
                        }
                    },
                };
                groups(&mut data, &mut deltas[..count.next_multiple_of(GROUP)], widths)?;
            }
            let mode = modes.get(channel).copied().unwrap_or(0);
            let last = &mut last[4 * channel..4 * channel + 4];
            accumulate(&deltas, mode, last, elements, stride, 4 * channel);
        }
    }
    data.end()?;
    Ok(out)
}

/// Reads the differences of one byte position: two bits a group that choose among `widths`, then the groups.
fn groups(data: &mut Reader<'_>, deltas: &mut [u8], widths: [u32; 4]) -> Decoded<()> {
    let choices = data.take((deltas.len() / GROUP).div_ceil(4))?;
    for (index, group) in deltas.chunks_mut(GROUP).enumerate() {
        let choice = choices[index / 4] >> (2 * (index % 4)) & 3;
        let width = widths[usize::from(choice)];
        if width == 0 {
            group.fill(0);
            continue;
        }
        let packed = data.take(GROUP * width as usize / 8)?;
        if width == 8 {
            group.copy_from_slice(packed);
            continue;
        }
        // All bits set stand for a byte of its own, after the group.
        let mask = ((1u16 << width) - 1) as u8;
        for (n, delta) in group.iter_mut().enumerate() {
            let bit = n as u32 * width;
            let shift = if width == 1 { bit % 8 } else { 8 - width - bit % 8 };
            let value = packed[bit as usize / 8] >> shift & mask;
            *delta = if value == mask { data.byte()? } else { value };
        }
    }
    Ok(())
}

/// Adds the differences of a channel, four bytes of each element, to `last`, by the channel's mode.
fn accumulate(deltas: &[[u8; BLOCK]; 4], mode: u8, last: &mut [u8], elements: &mut [u8], stride: usize, offset: usize) {
    let Some(first) = last.first_chunk::<4>() else { return };
    let mut value = *first;
    for (n, element) in elements.chunks_mut(stride).enumerate() {
        let delta = [deltas[0][n], deltas[1][n], deltas[2][n], deltas[3][n]];
        value = match mode & 15 {
            0 => {
                let mut sum = value;
                for (sum, delta) in sum.iter_mut().zip(delta) {
                    *sum = sum.wrapping_add((delta >> 1) ^ (delta & 1).wrapping_neg());
                }
                sum
            }
            1 => {
                let add = |value: [u8; 2], delta: [u8; 2]| {
                    let delta = u16::from_le_bytes(delta);
                    let delta = (delta >> 1) ^ (delta & 1).wrapping_neg();
                    u16::from_le_bytes(value).wrapping_add(delta).to_le_bytes()
                };
                let [a, b] = add([value[0], value[1]], [delta[0], delta[1]]);
                let [c, d] = add([value[2], value[3]], [delta[2], delta[3]]);
                [a, b, c, d]
            }
            _ => {
                // The mode names the turn that the encoder made.
                let turned = u32::from_le_bytes(delta).rotate_right(u32::from(mode >> 4));
                (u32::from_le_bytes(value) ^ turned).to_le_bytes()
            }
        };
        if let Some(place) = element.get_mut(offset..offset + 4) {
            place.copy_from_slice(&value);
        }
    }
    last.copy_from_slice(&value);
}
