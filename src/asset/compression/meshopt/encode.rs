//! Streams of the three modes, written so that [`super::decode`] and every other reader give the same bytes back.

use super::attributes::{BLOCK, GROUP, block_size};
use super::indices::{Recent, from_zigzag};
use super::{Codec, Mode, StreamLayout};

/// Least bytes behind the blocks of attributes, by version.
const TAIL: [usize; 2] = [32, 24];
/// Pairs of sources that a triangle without a known edge names by their number.
const PAIRS: usize = 14;

/// Encodes elements that lie tightly, without a filter; none where the layout has no such stream.
pub(in crate::asset::compression) fn encode(data: &[u8], layout: &StreamLayout, codec: Codec) -> Option<Vec<u8>> {
    if layout.check().is_err() || layout.bytes() != Some(data.len()) {
        return None;
    }
    match layout.mode {
        Mode::Attributes => Some(attributes(data, layout.stride, codec)),
        Mode::Triangles => triangles(&wide(data, layout.stride)),
        Mode::Indices => sequence(&wide(data, layout.stride)),
    }
}

fn wide(data: &[u8], stride: usize) -> Vec<u32> {
    if stride == 2 {
        data.as_chunks::<2>().0.iter().map(|b| u32::from(u16::from_le_bytes(*b))).collect()
    } else {
        data.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect()
    }
}

/// Mode 0. The tail holds the first element, from which differences begin.
fn attributes(data: &[u8], stride: usize, codec: Codec) -> Vec<u8> {
    let first = data.get(..stride).map_or_else(|| vec![0; stride], <[u8]>::to_vec);
    let block = block_size(stride) * stride;
    let mut out = Vec::with_capacity(data.len() / 2);
    let mut modes = Vec::new();
    match codec {
        Codec::Version0 => {
            out.push(0xA0);
            let mut before = first.as_slice();
            for elements in data.chunks(block) {
                for channel in 0..stride / 4 {
                    let deltas = differences(elements, before, stride, channel, 0);
                    deltas.iter().for_each(|column| groups(&mut out, column, [0, 2, 4, 8]));
                }
                before = elements.get(elements.len() - stride..).unwrap_or(before);
            }
        }
        Codec::Version1 => {
            out.push(0xA1);
            modes = (0..stride / 4).map(|channel| best_mode(data, &first, stride, channel)).collect();
            let mut before = first.as_slice();
            for elements in data.chunks(block) {
                let (mut controls, mut columns) = (vec![0u8; stride / 4], Vec::new());
                for (channel, control) in controls.iter_mut().enumerate() {
                    let deltas = differences(elements, before, stride, channel, modes[channel]);
                    for (byte, column) in deltas.iter().enumerate() {
                        let (kind, packed) = column_of_version_1(column, elements.len() / stride);
                        *control |= kind << (2 * byte);
                        columns.extend(packed);
                    }
                }
                out.extend(controls);
                out.extend(columns);
                before = elements.get(elements.len() - stride..).unwrap_or(before);
            }
        }
    }
    let tail = stride + modes.len();
    let padding = TAIL[usize::from(codec == Codec::Version1)].saturating_sub(tail);
    out.resize(out.len() + padding, 0);
    out.extend(first);
    out.extend(modes);
    out
}

/// The mode of version 1 whose columns are shortest: bytes, pairs of bytes, or bits that differ.
fn best_mode(data: &[u8], first: &[u8], stride: usize, channel: usize) -> u8 {
    let size = |mode: u8| -> usize {
        let (mut before, mut size) = (first, 0);
        for elements in data.chunks(block_size(stride) * stride) {
            let deltas = differences(elements, before, stride, channel, mode);
            size += deltas.iter().map(|c| column_of_version_1(c, elements.len() / stride).1.len()).sum::<usize>();
            before = elements.get(elements.len() - stride..).unwrap_or(before);
        }
        size
    };
    (0..3).min_by_key(|mode| size(*mode)).unwrap_or(0)
}

/// The differences of a channel's four bytes in a block, byte by byte, filled up to whole groups.
fn differences(elements: &[u8], before: &[u8], stride: usize, channel: usize, mode: u8) -> [Vec<u8>; 4] {
    let count = elements.len() / stride;
    let mut columns: [Vec<u8>; 4] = std::array::from_fn(|_| vec![0; count.next_multiple_of(GROUP).min(BLOCK)]);
    let part = |element: &[u8]| element.get(4 * channel..).and_then(<[u8]>::first_chunk::<4>).copied();
    let mut last = part(before).unwrap_or_default();
    for (n, element) in elements.chunks_exact(stride).enumerate() {
        let own = part(element).unwrap_or_default();
        let delta = match mode {
            0 => std::array::from_fn(|k| {
                let d = own[k].wrapping_sub(last[k]);
                (d << 1) ^ ((d as i8 >> 7) as u8)
            }),
            1 => {
                let of = |k: usize| {
                    let word = |v: [u8; 4]| u16::from_le_bytes([v[k], v[k + 1]]);
                    let d = word(own).wrapping_sub(word(last));
                    ((d << 1) ^ ((d as i16 >> 15) as u16)).to_le_bytes()
                };
                let ([a, b], [c, d]) = (of(0), of(2));
                [a, b, c, d]
            }
            _ => (u32::from_le_bytes(own) ^ u32::from_le_bytes(last)).to_le_bytes(),
        };
        for (column, byte) in columns.iter_mut().zip(delta) {
            column[n] = byte;
        }
        last = own;
    }
    columns
}

/// How a column is written in version 1, and its bytes: all zero, as they are, or in groups of few or of many bits.
fn column_of_version_1(column: &[u8], count: usize) -> (u8, Vec<u8>) {
    if column.iter().all(|b| *b == 0) {
        return (2, Vec::new());
    }
    let literal = column.get(..count).unwrap_or(column);
    let mut best = (3, literal.to_vec());
    for (kind, widths) in [(0, [0, 1, 2, 4]), (1, [1, 2, 4, 8])] {
        let mut packed = Vec::new();
        groups(&mut packed, column, widths);
        if packed.len() < best.1.len() {
            best = (kind, packed);
        }
    }
    best
}

/// Appends a column: two bits a group that choose the width with the fewest bytes, then the groups.
fn groups(out: &mut Vec<u8>, column: &[u8], widths: [u32; 4]) {
    let start = out.len();
    let count = column.len() / GROUP;
    out.resize(start + count.div_ceil(4), 0);
    for (index, group) in column.chunks_exact(GROUP).enumerate() {
        let size = |width: u32| match width {
            0 => group.iter().all(|b| *b == 0).then_some(0),
            8 => Some(GROUP),
            _ => Some(GROUP * width as usize / 8 + group.iter().filter(|b| **b >= mask(width)).count()),
        };
        let sizes = widths.iter().enumerate().filter_map(|(choice, width)| Some((size(*width)?, choice)));
        let Some((_, choice)) = sizes.min() else { continue };
        out[start + index / 4] |= (choice as u8) << (2 * (index % 4));
        match widths[choice] {
            0 => {}
            8 => out.extend_from_slice(group),
            width => {
                let at = out.len();
                out.resize(at + GROUP * width as usize / 8, 0);
                for (n, byte) in group.iter().enumerate() {
                    let bit = n as u32 * width;
                    let shift = if width == 1 { bit % 8 } else { 8 - width - bit % 8 };
                    out[at + bit as usize / 8] |= (*byte).min(mask(width)) << shift;
                }
                out.extend(group.iter().filter(|b| **b >= mask(width)));
            }
        }
    }
}

/// All bits of a width set: what stands for a byte of its own.
fn mask(width: u32) -> u8 {
    ((1u16 << width) - 1) as u8
}

/// A signed difference as [`from_zigzag`] reads it.
fn zigzag(from: u32, to: u32) -> u32 {
    let d = to.wrapping_sub(from);
    let coded = (d << 1) ^ ((d as i32 >> 31) as u32);
    debug_assert_eq!(from.wrapping_add(from_zigzag(coded)), to);
    coded
}

fn varint(out: &mut Vec<u8>, mut value: u32) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Where a vertex of a triangle without a known edge comes from: `0` the next one, `1..=14` a recent one, `15` told.
type Nibble = u8;

/// A triangle as it is coded, but for the number of its pair.
struct Coded {
    /// The edge, and what the third vertex is; or, for a triangle without a known edge, the first vertex' source and the pair's.
    code: Result<u8, (Nibble, u8)>,
    /// Differences of the vertices that are told.
    told: Vec<u8>,
}

/// Mode 1. Triangles stay in order; which of its corners comes first may change, the way round not.
fn triangles(indices: &[u32]) -> Option<Vec<u8>> {
    let mut edges = Recent::<[u32; 2]>::new();
    let mut vertices = Recent::<u32>::new();
    let (mut next, mut last) = (0u32, 0u32);
    let mut coded = Vec::with_capacity(indices.len() / 3);
    // How often each pair stands where a number may stand for it.
    let mut uses = [0u32; 256];
    for triangle in indices.as_chunks::<3>().0 {
        let turns = [0, 1, 2].map(|k| [triangle[k], triangle[(k + 1) % 3], triangle[(k + 2) % 3]]);
        let known = (0..15u8).find_map(|back| {
            let edge = edges.get(back).ok()?;
            turns.iter().find(|t| [t[0], t[1]] == edge).map(|t| (back, *t))
        });
        let mut told = Vec::new();
        if let Some((back, [a, b, c])) = known {
            let recent = (1..=12).find(|back| vertices.get(*back).is_ok_and(|v| v == c));
            let low = if c == next {
                next = next.wrapping_add(1);
                0
            } else if let Some(back) = recent {
                back
            } else {
                let low = match c {
                    _ if c.wrapping_add(1) == last => 13,
                    _ if c == last.wrapping_add(1) => 14,
                    _ => {
                        varint(&mut told, zigzag(last, c));
                        15
                    }
                };
                last = c;
                low
            };
            if !(1..=12).contains(&low) {
                vertices.push(c);
            }
            edges.push([c, b]);
            edges.push([a, c]);
            coded.push(Coded { code: Ok(back << 4 | low), told });
            continue;
        }
        let [a, b, c] = turns.into_iter().find(|t| t[0] == next).unwrap_or(turns[0]);
        let mut tell = |v: u32, told: &mut Vec<u8>| {
            varint(told, zigzag(last, v));
            last = v;
            15
        };
        let first = if a == next {
            next = next.wrapping_add(1);
            0
        } else {
            tell(a, &mut told)
        };
        let mut nibbles = [0; 2];
        for (k, v) in [b, c].into_iter().enumerate() {
            // A pair of zeros behind a told vertex would begin the numbers anew.
            let resets = first == 15 && k == 1 && nibbles[0] == 0;
            nibbles[k] = if v == next && !resets {
                next = next.wrapping_add(1);
                0
            } else {
                match (0..14).find(|back| vertices.get(*back).is_ok_and(|r| r == v)) {
                    Some(back) => back + 1,
                    None => tell(v, &mut told),
                }
            };
        }
        let pair = nibbles[0] << 4 | nibbles[1];
        if first == 0 && nibbles.iter().all(|n| *n < 15) {
            uses[usize::from(pair)] += 1;
        }
        edges.push([b, a]);
        edges.push([c, b]);
        edges.push([a, c]);
        for (v, nibble) in [(a, first), (b, nibbles[0]), (c, nibbles[1])] {
            if nibble == 0 || nibble == 15 {
                vertices.push(v);
            }
        }
        coded.push(Coded { code: Err((first, pair)), told });
    }
    // Three next vertices always have a number: their pair, spelt out, would begin the numbers anew.
    let mut often: Vec<u8> = (1..=255u8).filter(|pair| uses[usize::from(*pair)] > 0).collect();
    often.sort_by_key(|pair| (std::cmp::Reverse(uses[usize::from(*pair)]), *pair));
    let mut table = [0u8; 16];
    table.iter_mut().take(PAIRS).skip(1).zip(often).for_each(|(entry, pair)| *entry = pair);

    let (mut codes, mut rest) = (Vec::with_capacity(coded.len()), Vec::new());
    for triangle in coded {
        codes.push(match triangle.code {
            Ok(code) => code,
            Err((0, pair)) => match table.iter().take(PAIRS).position(|entry| *entry == pair) {
                Some(number) => 0xF0 | number as u8,
                None => {
                    rest.push(pair);
                    0xFE
                }
            },
            Err((_, pair)) => {
                rest.push(pair);
                0xFF
            }
        });
        rest.extend(triangle.told);
    }
    Some([&[0xE1][..], &codes, &rest, &table].concat())
}

/// Mode 2: differences from the nearer of two baselines; none for indices so far apart that no number of the stream holds it.
fn sequence(indices: &[u32]) -> Option<Vec<u8>> {
    let mut out = vec![0xD1];
    let mut last = [0u32; 2];
    for index in indices {
        let coded = last.map(|baseline| zigzag(baseline, *index));
        let which = usize::from(coded[1] < coded[0]);
        if coded[which] >> 31 != 0 {
            return None;
        }
        varint(&mut out, coded[which] << 1 | which as u32);
        last[which] = *index;
    }
    out.extend([0; 4]);
    Some(out)
}
