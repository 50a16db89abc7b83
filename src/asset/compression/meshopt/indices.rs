//! Modes 1 and 2: indices.

use super::{Decoded, body};

const NO_HISTORY: &str = "names an edge or a vertex that did not come before";

/// The last sixteen of something, the latest first.
pub(super) struct Recent<T> {
    items: [T; 16],
    pushed: usize,
}

impl<T: Copy + Default> Recent<T> {
    pub(super) fn new() -> Self {
        Recent { items: [T::default(); 16], pushed: 0 }
    }

    pub(super) fn push(&mut self, item: T) {
        self.items[self.pushed % 16] = item;
        self.pushed += 1;
    }

    /// The item pushed `back` pushes before the latest.
    pub(super) fn get(&self, back: u8) -> Decoded<T> {
        let back = usize::from(back);
        if back >= 16 || back >= self.pushed {
            return Err(NO_HISTORY);
        }
        Ok(self.items[(self.pushed - 1 - back) % 16])
    }
}

/// A signed number from its absolute value shifted left, the sign in the lowest bit.
pub(super) fn from_zigzag(v: u32) -> u32 {
    (v >> 1) ^ (v & 1).wrapping_neg()
}

/// Where the next vertex of a triangle comes from.
enum Source {
    /// The first that was not used yet.
    Next,
    /// A recent one.
    Recent(u8),
    /// Told by its difference from the last that was told.
    Told,
}

impl Source {
    fn from_nibble(nibble: u8) -> Self {
        match nibble {
            0 => Source::Next,
            15 => Source::Told,
            back => Source::Recent(back - 1),
        }
    }
}

/// Decodes triangles (mode 1): `count` times three indices.
pub(super) fn triangles(stream: &[u8], count: usize) -> Decoded<Vec<u32>> {
    let (header, mut data) = body(stream, 16)?;
    if header != 0xE1 {
        return Err("does not begin with 0xe1");
    }
    let table = stream.last_chunk::<16>().copied().unwrap_or_default();
    if table[14..] != [0, 0] || table.iter().any(|entry| entry >> 4 == 15 || entry & 15 == 15) {
        return Err("has a broken table at its end");
    }
    let codes = data.take(count)?;
    let mut out = Vec::with_capacity(3 * count);
    let mut edges = Recent::<[u32; 2]>::new();
    let mut vertices = Recent::<u32>::new();
    let (mut next, mut last) = (0u32, 0u32);
    for code in codes {
        let (high, low) = (code >> 4, code & 15);
        if high < 15 {
            let [a, b] = edges.get(high)?;
            let c = match low {
                0 => {
                    next = next.wrapping_add(1);
                    next.wrapping_sub(1)
                }
                1..=12 => vertices.get(low)?,
                _ => {
                    last = match low {
                        13 => last.wrapping_sub(1),
                        14 => last.wrapping_add(1),
                        _ => last.wrapping_add(from_zigzag(data.varint()?)),
                    };
                    last
                }
            };
            if !(1..=12).contains(&low) {
                vertices.push(c);
            }
            edges.push([c, b]);
            edges.push([a, c]);
            out.extend([a, b, c]);
            continue;
        }
        let pair = if low < 14 { table[usize::from(low)] } else { data.byte()? };
        if low >= 14 && pair == 0 {
            next = 0;
        }
        let first = if low == 15 { Source::Told } else { Source::Next };
        let sources = [first, Source::from_nibble(pair >> 4), Source::from_nibble(pair & 15)];
        let mut corners = [0; 3];
        for (corner, source) in corners.iter_mut().zip(&sources) {
            *corner = match source {
                Source::Next => {
                    next = next.wrapping_add(1);
                    next.wrapping_sub(1)
                }
                Source::Recent(back) => vertices.get(*back)?,
                Source::Told => {
                    last = last.wrapping_add(from_zigzag(data.varint()?));
                    last
                }
            };
        }
        let [a, b, c] = corners;
        edges.push([b, a]);
        edges.push([c, b]);
        edges.push([a, c]);
        for (corner, source) in corners.iter().zip(&sources) {
            if !matches!(source, Source::Recent(_)) {
                vertices.push(*corner);
            }
        }
        out.extend(corners);
    }
    data.end()?;
    Ok(out)
}

/// Decodes any indices (mode 2): differences from one of two baselines.
pub(super) fn sequence(stream: &[u8], count: usize) -> Decoded<Vec<u32>> {
    let (header, mut data) = body(stream, 4)?;
    if header != 0xD1 {
        return Err("does not begin with 0xd1");
    }
    let mut last = [0u32; 2];
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let value = data.varint()?;
        let baseline = &mut last[(value & 1) as usize];
        *baseline = baseline.wrapping_add(from_zigzag(value >> 1));
        out.push(*baseline);
    }
    data.end()?;
    Ok(out)
}
