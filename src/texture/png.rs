//! PNG files out: nothing is lost, and as few bytes as a filter per row and a good compressor find (PNG, third edition, W3C 2025).

use std::borrow::Cow;

use image::DynamicImage;
use libdeflater::{CompressionLvl, Compressor, crc32};
use rayon::prelude::*;

use super::depth;
use super::pixels::Depth;
use crate::error::{Failure, Result};

/// Compression level of libdeflate to choose filters by.
const TRIAL: i32 = 6;
/// Levels of images up to so many bytes, and of larger ones: 10 is a fourteenth smaller than 9 and takes twice as long, 11 a hundredth.
const LEVELS: [(usize, i32); 2] = [(1 << 20, 11), (1 << 24, 10)];
const LARGE: i32 = 9;
/// Rows that filters are tried on: bands of so many rows, and about so many bytes in all.
const BAND: usize = 64;
const SAMPLE: usize = 1 << 20;
/// Bytes of an IDAT chunk.
const CHUNK: usize = 1 << 30;

/// How samples lie in the file.
struct Layout {
    /// Bytes of a row.
    line: usize,
    /// Bytes from a sample to the one left of it.
    step: usize,
    depth: u8,
    /// 0 grey, 2 RGB, 3 palette, 4 grey and alpha, 6 RGBA.
    kind: u8,
}

/// How the filter of a row is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Strategy {
    /// One for all rows, by its number in the format.
    Fixed(u8),
    /// That with the least sum of absolute values.
    LeastSum,
    /// That with the least entropy of its bytes.
    LeastEntropy,
    /// That with the fewest different pairs of bytes.
    FewestPairs,
}

/// All that are tried.
const STRATEGIES: [Strategy; 7] = [
    Strategy::Fixed(NONE),
    Strategy::Fixed(SUB),
    Strategy::Fixed(UP),
    Strategy::Fixed(PAETH),
    Strategy::LeastSum,
    Strategy::LeastEntropy,
    Strategy::FewestPairs,
];

const NONE: u8 = 0;
const SUB: u8 = 1;
const UP: u8 = 2;
const AVERAGE: u8 = 3;
const PAETH: u8 = 4;

/// Encodes an image at its own depth with its own channels. Up to 256 colours become a palette, grey of few levels fewer bits: decoders
/// give the same for them.
///
/// # Errors
/// `internal` where memory for the file is missing.
pub(super) fn encode(image: &DynamicImage) -> Result<Vec<u8>> {
    let (layout, samples, palette) = laid_out(image);
    let strategy = chosen(&layout, &samples)?;
    let filtered = filtered(strategy, &layout, &samples);
    let level = LEVELS.iter().find(|(bytes, _)| filtered.len() <= *bytes).map_or(LARGE, |(_, level)| *level);
    let data = zlib(&filtered, level)?;
    drop((filtered, samples));
    let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
    file.reserve_exact(data.len() + 4096);
    let mut header = Vec::new();
    header.extend(image.width().to_be_bytes());
    header.extend(image.height().to_be_bytes());
    header.extend([layout.depth, layout.kind, 0, 0, 0]);
    chunk(&mut file, b"IHDR", &header);
    if let Some(colours) = palette {
        chunk(&mut file, b"PLTE", &colours.iter().flat_map(|c| [c[0], c[1], c[2]]).collect::<Vec<u8>>());
        if image.color().has_alpha() {
            chunk(&mut file, b"tRNS", &colours.iter().map(|c| c[3]).collect::<Vec<u8>>());
        }
    }
    data.chunks(CHUNK).for_each(|part| chunk(&mut file, b"IDAT", part));
    chunk(&mut file, b"IEND", &[]);
    Ok(file)
}

fn chunk(file: &mut Vec<u8>, kind: &[u8; 4], data: &[u8]) {
    file.extend((data.len() as u32).to_be_bytes());
    let start = file.len();
    file.extend(kind);
    file.extend(data);
    let sum = crc32(&file[start..]);
    file.extend(sum.to_be_bytes());
}

/// Up to 256 colours.
type Palette = Vec<[u8; 4]>;

/// The samples as the file has them, row by row, and the palette.
fn laid_out(image: &DynamicImage) -> (Layout, Cow<'_, [u8]>, Option<Palette>) {
    let (width, channels) = (image.width() as usize, image.color().channel_count());
    let kind = match channels {
        1 => 0,
        2 => 4,
        3 => 2,
        _ => 6,
    };
    if let Some(samples) = u16::of(image) {
        let step = 2 * usize::from(channels);
        let bytes = Cow::Owned(samples.iter().flat_map(|s| s.to_be_bytes()).collect());
        return (Layout { line: width * step, step, depth: depth(image), kind }, bytes, None);
    }
    let samples = image.as_bytes();
    let step = usize::from(channels);
    if channels >= 3
        && let Some((colours, indices)) = palette(samples, step)
    {
        let bits = bits_of(colours.len() - 1);
        return (layout(width, bits, 3), packed(&indices, width, bits, |index| index).into(), Some(colours));
    }
    if channels == 1 {
        let bits = [1u8, 2, 4].into_iter().find(|bits| {
            let unit = 255 / ((1u32 << bits) - 1) as u8;
            samples.iter().all(|s| s.is_multiple_of(unit))
        });
        if let Some(bits) = bits {
            return (layout(width, bits, 0), packed(samples, width, bits, |grey| grey >> (8 - bits)).into(), None);
        }
    }
    (Layout { line: width * step, step, depth: 8, kind }, samples.into(), None)
}

/// That of rows of one sample of so many bits.
fn layout(width: usize, bits: u8, kind: u8) -> Layout {
    Layout { line: (width * usize::from(bits)).div_ceil(8), step: 1, depth: bits, kind }
}

/// The depth that a number fits in.
fn bits_of(largest: usize) -> u8 {
    match largest {
        0..=1 => 1,
        2..=3 => 2,
        4..=15 => 4,
        _ => 8,
    }
}

/// Samples of a byte in fewer bits, from the highest down.
fn packed(samples: &[u8], width: usize, bits: u8, narrowed: impl Fn(u8) -> u8) -> Vec<u8> {
    if bits == 8 {
        return samples.iter().map(|s| narrowed(*s)).collect();
    }
    let per_byte = 8 / usize::from(bits);
    let mut out = Vec::with_capacity(samples.len() / per_byte + samples.len() / width);
    for row in samples.chunks_exact(width) {
        for group in row.chunks(per_byte) {
            let mut byte = 0;
            for (i, sample) in group.iter().enumerate() {
                byte |= narrowed(*sample) << (8 - usize::from(bits) * (i + 1));
            }
            out.push(byte);
        }
    }
    out
}

/// The colours of an image of three or four channels in order of their brightness, and each texel's; none beyond 256 of them.
fn palette(samples: &[u8], channels: usize) -> Option<(Palette, Vec<u8>)> {
    const SLOTS: usize = 1024;
    let colour = |texel: &[u8]| [texel[0], texel[1], texel[2], texel.get(3).copied().unwrap_or(255)];
    let slot = |c: [u8; 4]| (u32::from_le_bytes(c).wrapping_mul(0x9e37_79b1) >> 22) as usize;
    let mut table: Vec<Option<([u8; 4], u16)>> = vec![None; SLOTS];
    let find = |table: &[Option<([u8; 4], u16)>], c: [u8; 4]| {
        let mut at = slot(c);
        while table[at].is_some_and(|(other, _)| other != c) {
            at = (at + 1) % SLOTS;
        }
        at
    };
    let mut colours = Vec::new();
    let mut last = None;
    for texel in samples.chunks_exact(channels) {
        let c = colour(texel);
        if last == Some(c) {
            continue;
        }
        last = Some(c);
        let at = find(&table, c);
        if table[at].is_none() {
            if colours.len() == 256 {
                return None;
            }
            table[at] = Some((c, 0));
            colours.push(c);
        }
    }
    colours.sort_by_key(|[r, g, b, a]| {
        (u32::from(*a), 299 * u32::from(*r) + 587 * u32::from(*g) + 114 * u32::from(*b), *r, *g)
    });
    for (i, c) in colours.iter().enumerate() {
        let at = find(&table, *c);
        table[at] = Some((*c, i as u16));
    }
    let index = |texel: &[u8]| table[find(&table, colour(texel))].map_or(0, |(_, i)| i as u8);
    let indices = samples.chunks_exact(channels).map(index).collect();
    Some((colours, indices))
}

/// The strategy that makes a sample of the rows smallest.
fn chosen(layout: &Layout, samples: &[u8]) -> Result<Strategy> {
    let rows = samples.len() / layout.line.max(1);
    let bands = (SAMPLE / (BAND * layout.line).max(1)).max(1);
    let starts: Vec<usize> = if bands * BAND >= rows {
        vec![0]
    } else {
        (0..bands).map(|i| i * (rows - BAND) / (bands - 1).max(1)).collect()
    };
    let height = if starts.len() == 1 { rows.min(bands * BAND) } else { BAND };
    let tried = |strategy: &Strategy| -> Result<usize> {
        let mut bytes = Vec::new();
        for start in &starts {
            let mut rows = Filter::new(*strategy, layout);
            (*start..(start + height).min(rows_of(layout, samples))).for_each(|y| rows.append(samples, y, &mut bytes));
        }
        Ok(zlib(&bytes, TRIAL)?.len())
    };
    let sizes: Vec<Result<usize>> = STRATEGIES.par_iter().map(tried).collect();
    let sizes = sizes.into_iter().collect::<Result<Vec<usize>>>()?;
    let best = (0..STRATEGIES.len()).min_by_key(|i| sizes[*i]).unwrap_or(0);
    Ok(STRATEGIES[best])
}

fn rows_of(layout: &Layout, samples: &[u8]) -> usize {
    samples.len() / layout.line.max(1)
}

fn filtered(strategy: Strategy, layout: &Layout, samples: &[u8]) -> Vec<u8> {
    let rows = rows_of(layout, samples);
    let mut out = vec![0; rows * (layout.line + 1)];
    out.par_chunks_mut(BAND * (layout.line + 1)).enumerate().for_each(|(band, out)| {
        let mut filter = Filter::new(strategy, layout);
        let mut bytes = Vec::with_capacity(out.len());
        (band * BAND..((band + 1) * BAND).min(rows)).for_each(|y| filter.append(samples, y, &mut bytes));
        out.copy_from_slice(&bytes);
    });
    out
}

/// Filters rows, each for itself.
struct Filter<'a> {
    strategy: Strategy,
    layout: &'a Layout,
    above: Vec<u8>,
    candidate: Vec<u8>,
    pairs: Vec<u64>,
}

impl<'a> Filter<'a> {
    fn new(strategy: Strategy, layout: &'a Layout) -> Self {
        Filter { strategy, layout, above: vec![0; layout.line], candidate: Vec::new(), pairs: Vec::new() }
    }

    /// Appends the number of a filter and the filtered row.
    fn append(&mut self, samples: &[u8], y: usize, out: &mut Vec<u8>) {
        let (line, step) = (self.layout.line, self.layout.step);
        let row = &samples[y * line..(y + 1) * line];
        match y.checked_sub(1) {
            Some(above) => self.above.copy_from_slice(&samples[above * line..y * line]),
            None => self.above.fill(0),
        }
        if let Strategy::Fixed(filter) = self.strategy {
            out.push(filter);
            apply(filter, row, &self.above, step, out);
            return;
        }
        let start = out.len();
        let mut least = f64::INFINITY;
        for filter in [NONE, SUB, UP, AVERAGE, PAETH] {
            self.candidate.clear();
            apply(filter, row, &self.above, step, &mut self.candidate);
            let cost = self.cost();
            if cost < least {
                least = cost;
                out.truncate(start);
                out.push(filter);
                out.extend_from_slice(&self.candidate);
            }
        }
    }

    fn cost(&mut self) -> f64 {
        match self.strategy {
            Strategy::Fixed(_) => 0.0,
            Strategy::LeastSum => {
                self.candidate.iter().map(|b| u64::from((*b as i8).unsigned_abs())).sum::<u64>() as f64
            }
            Strategy::LeastEntropy => {
                let mut counts = [0u32; 256];
                self.candidate.iter().for_each(|b| counts[usize::from(*b)] += 1);
                -counts.iter().filter(|n| **n > 0).map(|n| f64::from(*n) * f64::from(*n).log2()).sum::<f64>()
            }
            Strategy::FewestPairs => {
                self.pairs.clear();
                self.pairs.resize(1024, 0);
                for pair in self.candidate.windows(2) {
                    let place = usize::from(pair[0]) << 8 | usize::from(pair[1]);
                    self.pairs[place / 64] |= 1 << (place % 64);
                }
                f64::from(self.pairs.iter().map(|bits| bits.count_ones()).sum::<u32>())
            }
        }
    }
}

/// Appends a row as a filter leaves it; `step` bytes from a sample to its left neighbour.
fn apply(filter: u8, row: &[u8], above: &[u8], step: usize, out: &mut Vec<u8>) {
    let head = step.min(row.len());
    let left = row;
    match filter {
        SUB => {
            out.extend_from_slice(&row[..head]);
            out.extend(row[head..].iter().zip(left).map(|(v, l)| v.wrapping_sub(*l)));
        }
        UP => out.extend(row.iter().zip(above).map(|(v, a)| v.wrapping_sub(*a))),
        AVERAGE => {
            out.extend(row[..head].iter().zip(above).map(|(v, a)| v.wrapping_sub(a / 2)));
            let mean = |l: u8, a: u8| ((u16::from(l) + u16::from(a)) / 2) as u8;
            let rest = row[head..].iter().zip(left).zip(&above[head..]);
            out.extend(rest.map(|((v, l), a)| v.wrapping_sub(mean(*l, *a))));
        }
        PAETH => {
            out.extend(row[..head].iter().zip(above).map(|(v, a)| v.wrapping_sub(*a)));
            let rest = row[head..].iter().zip(left).zip(above[head..].iter().zip(above));
            out.extend(rest.map(|((v, l), (a, corner))| v.wrapping_sub(paeth(*l, *a, *corner))));
        }
        _ => out.extend_from_slice(row),
    }
}

/// Of left, above and the corner, the nearest to left + above - corner (12.3 of the standard).
fn paeth(left: u8, above: u8, corner: u8) -> u8 {
    let (a, b, c) = (i16::from(left), i16::from(above), i16::from(corner));
    let (da, db, dc) = ((b - c).abs(), (a - c).abs(), (a + b - 2 * c).abs());
    if da <= db && da <= dc {
        left
    } else if db <= dc {
        above
    } else {
        corner
    }
}

/// A zlib stream (RFC 1950) of `bytes`, at a level in 1..=12.
pub(crate) fn zlib(bytes: &[u8], level: i32) -> Result<Vec<u8>> {
    let failed = |e: &dyn std::fmt::Debug| Failure::internal(format!("bytes cannot be compressed: {e:?}"));
    let mut compressor = Compressor::new(CompressionLvl::new(level).map_err(|e| failed(&e))?);
    let mut out = vec![0; compressor.zlib_compress_bound(bytes.len())];
    let size = compressor.zlib_compress(bytes, &mut out).map_err(|e| failed(&e))?;
    out.truncate(size);
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::texture::encode::tests::picture;
    use crate::texture::{decode, from_samples};

    #[test]
    fn every_strategy_gives_the_image_back() {
        for deep in [false, true] {
            for channels in 1..=4 {
                let image = picture(61, 45, channels, deep);
                let (layout, samples, _) = laid_out(&image);
                for strategy in STRATEGIES {
                    let filtered = filtered(strategy, &layout, &samples);
                    let mut back = vec![0u8; samples.len()];
                    for (y, row) in filtered.chunks_exact(layout.line + 1).enumerate() {
                        for (x, v) in row[1..].iter().enumerate() {
                            let at = |dx: usize, dy: usize| match (x.checked_sub(dx), y.checked_sub(dy)) {
                                (Some(x), Some(y)) => back[y * layout.line + x],
                                _ => 0,
                            };
                            let (l, a, c) = (at(layout.step, 0), at(0, 1), at(layout.step, 1));
                            let guess = match row[0] {
                                SUB => l,
                                UP => a,
                                AVERAGE => ((u16::from(l) + u16::from(a)) / 2) as u8,
                                PAETH => paeth(l, a, c),
                                _ => 0,
                            };
                            back[y * layout.line + x] = v.wrapping_add(guess);
                        }
                    }
                    assert_eq!(back, *samples, "{strategy:?}");
                }
            }
        }
    }

    #[test]
    fn few_colours_become_a_palette_and_come_back() {
        for (count, channels) in [(1, 3), (2, 3), (4, 4), (16, 3), (17, 4), (256, 3), (256, 4), (257, 3)] {
            let mut samples: Vec<u8> = Vec::new();
            for i in 0..67u32 * 31 {
                let n = (i * 7919 % count) as u8;
                let all = [n, n.wrapping_mul(3), if i * 7919 % count > 255 { 9 } else { 7 }, n | 1];
                samples.extend(&all[..channels]);
            }
            let image = from_samples([67, 31], channels as u8, samples).unwrap();
            let file = encode(&image).unwrap();
            assert_eq!(file[25] == 3, count <= 256, "{count}");
            assert_eq!(decode(&file, 1 << 20).unwrap(), image);
        }
    }

    #[test]
    fn grey_of_few_levels_takes_few_bits() {
        for (unit, bits) in [(255, 1), (85, 2), (17, 4), (5, 8)] {
            let samples: Vec<u8> = (0..37u32 * 11).map(|i| (i * 13 % (255 / unit + 1) * unit) as u8).collect();
            let image = from_samples([37, 11], 1, samples).unwrap();
            let file = encode(&image).unwrap();
            assert_eq!((file[24], file[25]), (bits, 0));
            assert_eq!(decode(&file, 1 << 20).unwrap(), image);
        }
    }
}
