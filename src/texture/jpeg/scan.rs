//! One interleaved scan (ITU T.81, F.1.2), made strip by strip in parallel: symbols first, then, when all are counted, their bits.

use std::ops::Range;

use rayon::prelude::*;

use super::blocks::{Coefficients, Quantizer};
use super::huffman::{Code, Counts};
use super::{JpegCoding, LONGEST, Tables, ZIGZAG, chroma, impossible};
use crate::error::Result;

/// Texels of a strip, about.
const STRIP_TEXELS: usize = 1 << 18;
/// The end of a block, and sixteen zeros in a run.
const END: u8 = 0;
const SIXTEEN_ZEROS: u8 = 0xf0;

/// A file to be.
#[derive(Debug, Clone)]
pub(crate) struct Frame {
    size: [usize; 2],
    channels: usize,
    /// Texels by sample of chroma.
    sampling: [usize; 2],
    /// Whether chroma is what decoders smooth to what they gave.
    sharp: bool,
    tables: Tables,
    quantizers: [Quantizer; 2],
}

/// Rows of samples of 8 bits, with those above and below that belong to the same page.
#[derive(Debug, Clone, Copy)]
struct Rows<'a> {
    samples: &'a [u8],
    /// The first of them.
    top: usize,
}

/// The symbols of a strip.
#[derive(Debug)]
pub(crate) struct Scanned {
    /// Each symbol, followed by the bits that it announces in one byte or two. The first of each component, which depends on the strip before,
    /// is left out.
    symbols: Vec<u8>,
    /// By table (luma, chroma), of first coefficients and of the others.
    counts: Box<[[Counts; 2]; 2]>,
    /// By component: the first and the last of the blocks' first coefficients.
    ends: [[i16; 2]; 3],
}

impl Frame {
    /// For pages of one channel or three.
    ///
    /// # Errors
    /// `internal` for a size that JPEG does not have.
    pub(crate) fn new(coding: &JpegCoding, size: [u32; 2], channels: u8) -> Result<Self> {
        if size.iter().any(|side| !(1..=LONGEST).contains(side)) {
            return Err(impossible(&format!("{} x {} texels are beyond its sizes", size[0], size[1])));
        }
        if channels != 1 && channels != 3 {
            return Err(impossible(&"it has one channel or three"));
        }
        let sampling = if channels == 1 { [1; 2] } else { coding.sampling.map(usize::from) };
        Ok(Frame {
            size: size.map(|side| side as usize),
            channels: channels.into(),
            sampling,
            sharp: coding.decoded,
            tables: *coding.tables,
            quantizers: [0, 1].map(|t| Quantizer::new(&coding.tables[t])),
        })
    }

    /// Rows that are encoded together; a strip has a multiple of them, but for the last.
    fn unit_rows(&self) -> usize {
        8 * self.sampling[1]
    }

    /// Rows above and below a strip that its encoding reads.
    pub(crate) fn reach(&self) -> usize {
        if self.undoes(1) { 2 * chroma::REACH } else { 0 }
    }

    /// Whether what decoders smooth along an axis is undone.
    fn undoes(&self, axis: usize) -> bool {
        self.sharp && self.sampling[axis] == 2
    }

    /// The same for pages of another height.
    pub(crate) fn of_height(&self, height: usize) -> Self {
        Frame { size: [self.size[0], height], ..self.clone() }
    }

    /// All strips of a page.
    ///
    /// # Errors
    /// `internal` where samples are missing.
    pub(super) fn strips(&self, samples: &[u8]) -> Result<Vec<Scanned>> {
        let [width, height] = self.size;
        if samples.len() != width * height * self.channels {
            return Err(impossible(&"its samples do not fill it"));
        }
        let unit = self.unit_rows();
        let rows = (STRIP_TEXELS / width / unit).max(1) * unit;
        let starts: Vec<usize> = (0..height).step_by(rows).collect();
        let strip = |top: &usize| self.strip(samples, 0, *top..(top + rows).min(height));
        starts.par_iter().map(strip).collect()
    }

    /// The strip of some rows, from a multiple of the rows that are encoded together. `samples` are those of the page from row `top` on, with
    /// [`reach`](Self::reach) rows about the strip where the page has them.
    ///
    /// # Errors
    /// `internal` where rows are missing.
    pub(crate) fn strip(&self, samples: &[u8], top: usize, rows: Range<usize>) -> Result<Scanned> {
        let line = self.size[0] * self.channels;
        let reach = self.reach();
        let needed = rows.start.saturating_sub(reach)..(rows.end + reach).min(self.size[1]);
        if top > needed.start
            || samples.len() < (needed.end - top) * line
            || !rows.start.is_multiple_of(self.unit_rows())
        {
            return Err(impossible(&"rows of a strip are missing"));
        }
        let planes = self.planes(Rows { samples, top }, &rows);
        Ok(self.scanned(&planes, rows.len()))
    }

    /// Luma and chroma of a strip, in -128..=127, padded to whole blocks.
    fn planes(&self, page: Rows<'_>, rows: &Range<usize>) -> Vec<Plane> {
        let (units, unit) = (rows.len().div_ceil(self.unit_rows()), self.unit_rows());
        let columns = self.size[0].div_ceil(8 * self.sampling[0]) * 8 * self.sampling[0];
        let mut luma = Plane::new(columns, units * unit);
        if self.channels == 1 {
            for (y, out) in luma.rows() {
                let row = self.row(page, rows.start + y);
                out.iter_mut().zip(row).for_each(|(out, grey)| *out = f32::from(*grey) - 128.0);
                pad(out, self.size[0]);
            }
            return vec![luma];
        }
        for (y, out) in luma.rows() {
            for (out, texel) in out.iter_mut().zip(self.row(page, rows.start + y).chunks_exact(3)) {
                let [r, g, b] = [0, 1, 2].map(|c| f32::from(texel[c]));
                *out = 0.299 * r + 0.587 * g + 0.114 * b - 128.0;
            }
            pad(out, self.size[0]);
        }
        let [blue, red] = self.chroma(page, rows);
        vec![luma, blue, red]
    }

    /// The samples of a row of the page; rows below it are its last.
    fn row<'a>(&self, page: Rows<'a>, y: usize) -> &'a [u8] {
        let line = self.size[0] * self.channels;
        let at = (y.min(self.size[1] - 1) - page.top) * line;
        &page.samples[at..at + line]
    }

    fn chroma(&self, page: Rows<'_>, rows: &Range<usize>) -> [Plane; 2] {
        let [across, down] = self.sampling;
        let [width, height] = [self.size[0].div_ceil(across), self.size[1].div_ceil(down)];
        let units = rows.len().div_ceil(self.unit_rows());
        let first = rows.start / down;
        let own = units * 8;
        // Lines about the strip that undoing reads, as far as the page goes.
        let reach = if self.undoes(1) { chroma::REACH } else { 0 };
        let lines = first.saturating_sub(reach)..(first + own + reach).min(height);
        let mut means = [0, 1].map(|_| Plane::new(width, lines.len()));
        let (mut sums, mut scratch) = (vec![[0.0f32; 2]; width], Vec::new());
        for (i, y) in lines.clone().enumerate() {
            sums.fill([0.0; 2]);
            for k in 0..down {
                let row = self.row(page, y * down + k);
                add_chroma(row, across, &mut sums);
            }
            let scale = 1.0 / (across * down) as f32;
            for (c, plane) in means.iter_mut().enumerate() {
                let out = plane.row_mut(i);
                out.iter_mut().zip(&sums).for_each(|(out, sum)| *out = sum[c] * scale);
                if self.undoes(0) {
                    chroma::undo_across(out, &mut scratch);
                }
            }
        }
        means.map(|means| {
            let mut plane = Plane::new(self.size[0].div_ceil(8 * across) * 8, own);
            for (i, out) in plane.rows() {
                let line = |n: isize| {
                    let y = chroma::mirrored((first + i).min(height - 1) as isize + n, height);
                    means.row(y.clamp(lines.start, lines.end - 1) - lines.start)
                };
                if self.undoes(1) {
                    chroma::undo_down(&mut out[..width], line);
                } else {
                    out[..width].copy_from_slice(line(0));
                }
                out[..width].iter_mut().for_each(|value| *value = value.clamp(-128.0, 127.0));
                pad(out, width);
            }
            plane
        })
    }

    /// The blocks of a strip in the order of the scan, as symbols.
    fn scanned(&self, planes: &[Plane], rows: usize) -> Scanned {
        let [across, down] = self.sampling;
        let units = [self.size[0].div_ceil(8 * across), rows.div_ceil(self.unit_rows())];
        let mut writer = Writer {
            symbols: Vec::with_capacity(units[0] * units[1] * 16),
            counts: Box::new([[[0; 256]; 2]; 2]),
            ends: [[0; 2]; 3],
        };
        for y in 0..units[1] {
            for x in 0..units[0] {
                for (c, plane) in planes.iter().enumerate() {
                    let [columns, lines] = if c == 0 { [across, down] } else { [1, 1] };
                    for (j, i) in (0..lines).flat_map(|j| (0..columns).map(move |i| (j, i))) {
                        let samples = plane.block(x * columns + i, y * lines + j);
                        let block = self.quantizers[c.min(1)].coefficients(&samples);
                        writer.block(c, &block, x + y + i + j == 0);
                    }
                }
            }
        }
        Scanned { symbols: writer.symbols, counts: writer.counts, ends: writer.ends }
    }

    /// The file of all strips of a page, from the top.
    pub(crate) fn file(&self, strips: &[Scanned]) -> Vec<u8> {
        let components = self.channels;
        let mut counts = Box::new([[[0u64; 256]; 2]; 2]);
        let mut before = [0i16; 3];
        let mut firsts = Vec::with_capacity(strips.len());
        for strip in strips {
            for (sum, own) in counts.iter_mut().flatten().flatten().zip(strip.counts.iter().flatten().flatten()) {
                *sum += own;
            }
            let differences = [0, 1, 2].map(|c| strip.ends[c][0] - before[c]);
            (0..components).for_each(|c| counts[c.min(1)][0][usize::from(bits_of(differences[c]))] += 1);
            before = strip.ends.map(|ends| ends[1]);
            firsts.push(differences);
        }
        let codes: Vec<[Code; 2]> =
            counts[..components.min(2)].iter().map(|own| [0, 1].map(|k| Code::new(&own[k]))).collect();
        let mut file = self.header(&codes);
        let mut bits = Bits { out: &mut file, word: 0, count: 0 };
        for (strip, firsts) in strips.iter().zip(firsts) {
            self.write(strip, firsts, &codes, &mut bits);
        }
        bits.finish();
        file.extend([0xff, 0xd9]);
        file
    }

    /// All segments before the scan's data (ITU T.81, annex B; JFIF 1.02).
    fn header(&self, codes: &[[Code; 2]]) -> Vec<u8> {
        let mut file = vec![0xff, 0xd8];
        let mut segment = |marker: u8, payload: &[u8]| {
            file.extend([0xff, marker]);
            file.extend((payload.len() as u16 + 2).to_be_bytes());
            file.extend(payload);
        };
        segment(0xe0, b"JFIF\0\x01\x02\0\0\x01\0\x01\0\0");
        for (t, table) in self.tables.iter().enumerate().take(codes.len()) {
            let mut payload = vec![t as u8];
            payload.extend(ZIGZAG.iter().map(|place| table[usize::from(*place)] as u8));
            segment(0xdb, &payload);
        }
        let [width, height] = self.size.map(|side| (side as u16).to_be_bytes());
        let mut frame = vec![8, height[0], height[1], width[0], width[1], self.channels as u8];
        for c in 0..self.channels {
            let factors = if c == 0 { self.sampling[0] << 4 | self.sampling[1] } else { 0x11 };
            frame.extend([c as u8 + 1, factors as u8, c.min(1) as u8]);
        }
        segment(0xc0, &frame);
        for (t, own) in codes.iter().enumerate() {
            for (class, code) in own.iter().enumerate() {
                let mut payload = vec![(class << 4 | t) as u8];
                payload.extend(code.lengths);
                payload.extend(&code.symbols);
                segment(0xc4, &payload);
            }
        }
        let mut scan = vec![self.channels as u8];
        (0..self.channels).for_each(|c| scan.extend([c as u8 + 1, (c.min(1) * 0x11) as u8]));
        scan.extend([0, 63, 0]);
        segment(0xda, &scan);
        file
    }

    fn write(&self, strip: &Scanned, firsts: [i16; 3], codes: &[[Code; 2]], bits: &mut Bits<'_>) {
        let blocks = self.sampling[0] * self.sampling[1];
        let mut symbols = strip.symbols.as_slice();
        let mut is_first = true;
        while is_first || !symbols.is_empty() {
            for c in 0..self.channels {
                for k in 0..if c == 0 { blocks } else { 1 } {
                    let [first, others] = &codes[c.min(1)];
                    if is_first && k == 0 {
                        let size = bits_of(firsts[c]);
                        bits.put(first.words[usize::from(size)], magnitude(firsts[c], size), size);
                    } else {
                        let (symbol, value, rest) = next(symbols);
                        bits.put(first.words[usize::from(symbol)], value, symbol);
                        symbols = rest;
                    }
                    let mut place = 1;
                    while place < 64 {
                        let (symbol, value, rest) = next(symbols);
                        bits.put(others.words[usize::from(symbol)], value, symbol & 15);
                        symbols = rest;
                        if symbol == END {
                            break;
                        }
                        place += usize::from(symbol >> 4) + 1;
                    }
                }
            }
            is_first = false;
        }
    }
}

/// Samples of one component.
#[derive(Debug)]
struct Plane {
    width: usize,
    samples: Vec<f32>,
}

impl Plane {
    fn new(width: usize, height: usize) -> Self {
        Plane { width, samples: vec![0.0; width * height] }
    }

    fn rows(&mut self) -> impl Iterator<Item = (usize, &mut [f32])> {
        self.samples.chunks_exact_mut(self.width).enumerate()
    }

    fn row(&self, y: usize) -> &[f32] {
        &self.samples[y * self.width..(y + 1) * self.width]
    }

    fn row_mut(&mut self, y: usize) -> &mut [f32] {
        &mut self.samples[y * self.width..(y + 1) * self.width]
    }

    fn block(&self, x: usize, y: usize) -> [[f32; 8]; 8] {
        let mut block = [[0.0; 8]; 8];
        for (j, row) in block.iter_mut().enumerate() {
            row.copy_from_slice(&self.row(y * 8 + j)[x * 8..x * 8 + 8]);
        }
        block
    }
}

/// Repeats the last of `width` samples to the end.
fn pad(row: &mut [f32], width: usize) {
    let last = row[width - 1];
    row[width..].fill(last);
}

/// Adds the chroma of a row to sums over `across` texels; beyond the row its last texel counts.
fn add_chroma(row: &[u8], across: usize, sums: &mut [[f32; 2]]) {
    let of = |texel: &[u8]| {
        let [r, g, b] = [0, 1, 2].map(|c| f32::from(texel[c]));
        [-0.168_735_89 * r - 0.331_264_1 * g + 0.5 * b, 0.5 * r - 0.418_687_6 * g - 0.081_312_41 * b]
    };
    for (sum, texels) in sums.iter_mut().zip(row.chunks(3 * across)) {
        for texel in texels.chunks_exact(3) {
            let value = of(texel);
            (0..2).for_each(|c| sum[c] += value[c]);
        }
        let missing = across - texels.len() / 3;
        if missing > 0 {
            let value = of(&texels[texels.len() - 3..]);
            (0..2).for_each(|c| sum[c] += value[c] * missing as f32);
        }
    }
}

/// Turns blocks into symbols.
struct Writer {
    symbols: Vec<u8>,
    counts: Box<[[Counts; 2]; 2]>,
    ends: [[i16; 2]; 3],
}

impl Writer {
    fn block(&mut self, component: usize, block: &Coefficients, is_first: bool) {
        let [first, others] = &mut self.counts[component.min(1)];
        let ends = &mut self.ends[component];
        if is_first {
            ends[0] = block[0];
        } else {
            let difference = block[0] - ends[1];
            let size = bits_of(difference);
            first[usize::from(size)] += 1;
            push(&mut self.symbols, size, difference, size);
        }
        ends[1] = block[0];
        let mut run = 0u8;
        for value in &block[1..] {
            if *value == 0 {
                run += 1;
                continue;
            }
            while run > 15 {
                others[usize::from(SIXTEEN_ZEROS)] += 1;
                self.symbols.push(SIXTEEN_ZEROS);
                run -= 16;
            }
            let size = bits_of(*value);
            let symbol = run << 4 | size;
            others[usize::from(symbol)] += 1;
            push(&mut self.symbols, symbol, *value, size);
            run = 0;
        }
        if run > 0 {
            others[usize::from(END)] += 1;
            self.symbols.push(END);
        }
    }
}

/// Bits of a number without its sign.
fn bits_of(value: i16) -> u8 {
    (16 - value.unsigned_abs().leading_zeros()) as u8
}

/// The `size` bits that stand for a number; of a negative one the complement.
fn magnitude(value: i16, size: u8) -> u16 {
    let value = if value < 0 { value.wrapping_sub(1) } else { value };
    value as u16 & ((1u32 << size) - 1) as u16
}

fn push(symbols: &mut Vec<u8>, symbol: u8, value: i16, size: u8) {
    let [low, high] = magnitude(value, size).to_le_bytes();
    match size {
        0 => symbols.push(symbol),
        1..=8 => symbols.extend([symbol, low]),
        _ => symbols.extend([symbol, low, high]),
    }
}

/// The next symbol, its bits, and what follows.
fn next(symbols: &[u8]) -> (u8, u16, &[u8]) {
    match symbols {
        [symbol, rest @ ..] if symbol & 15 == 0 => (*symbol, 0, rest),
        [symbol, value, rest @ ..] if symbol & 15 <= 8 => (*symbol, u16::from(*value), rest),
        [symbol, low, high, rest @ ..] => (*symbol, u16::from_le_bytes([*low, *high]), rest),
        _ => (END, 0, &[]),
    }
}

/// Bits of the scan; a byte of ones is followed by one of zeros.
struct Bits<'a> {
    out: &'a mut Vec<u8>,
    word: u64,
    count: u32,
}

impl Bits<'_> {
    /// A word of a code, and `size` further bits.
    #[inline]
    fn put(&mut self, (word, bits): (u16, u8), value: u16, size: u8) {
        let length = u32::from(bits) + u32::from(size);
        let all = u64::from(word) << size | u64::from(value);
        self.word = self.word << length | all;
        self.count += length;
        while self.count >= 8 {
            self.count -= 8;
            let byte = (self.word >> self.count) as u8;
            self.out.push(byte);
            if byte == 0xff {
                self.out.push(0);
            }
        }
    }

    fn finish(&mut self) {
        if self.count > 0 {
            let missing = 8 - self.count as u8;
            self.put((0, 0), (1 << missing) - 1, missing);
        }
    }
}
