//! UASTC: 16 bytes a block, of modes that ASTC and BC7 share (Binomial, "UASTC Texture Specification"). Of its 19 modes those are tried that tell most
//! blocks best: one line through all texels, one line and a channel of its own, two lines in thirty partitions.

use std::sync::LazyLock;

/// Texels of a block, row by row.
pub(super) type Texels = [[u8; 4]; 16];

/// How endpoints are quantised: bits, and values of the digit above them (1, 3 or 5).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Range {
    bits: u32,
    digit: u32,
}

const LEVELS_16: Range = Range { bits: 4, digit: 1 };
const LEVELS_32: Range = Range { bits: 5, digit: 1 };
const LEVELS_40: Range = Range { bits: 3, digit: 5 };
const LEVELS_48: Range = Range { bits: 4, digit: 3 };
const LEVELS_160: Range = Range { bits: 5, digit: 5 };
const LEVELS_192: Range = Range { bits: 6, digit: 3 };
const LEVELS_256: Range = Range { bits: 8, digit: 1 };

/// Which hints for other formats a mode carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Hints {
    /// RGB: for BC1 and ETC1.
    Colour,
    /// RGBA: for ETC2 also.
    ColourAndAlpha,
    /// RGBA: the same without corrections.
    Short,
}

/// A mode.
#[derive(Debug, Clone, Copy)]
struct Mode {
    /// Its word, and the bits of that.
    code: (u32, u32),
    /// Channels: RGB, RGBA, or grey and alpha.
    channels: usize,
    weight_bits: u32,
    range: Range,
    subsets: usize,
    /// Whether one channel has weights of its own.
    dual: bool,
    hints: Hints,
}

const fn mode(code: (u32, u32), channels: usize, weight_bits: u32, range: Range, hints: Hints) -> Mode {
    Mode { code, channels, weight_bits, range, subsets: 1, dual: false, hints }
}

const RGB_4: Mode = mode((0x1, 4), 3, 4, LEVELS_192, Hints::Colour);
const RGB_3: Mode = mode((0xb, 5), 3, 3, LEVELS_256, Hints::Colour);
const RGB_5: Mode = mode((0x9, 4), 3, 5, LEVELS_32, Hints::Colour);
const RGB_DUAL: Mode = Mode { dual: true, ..mode((0x1b, 5), 3, 2, LEVELS_160, Hints::Colour) };
const RGB_TWO_3: Mode = Mode { subsets: 2, ..mode((0x1d, 5), 3, 3, LEVELS_16, Hints::Colour) };
const RGB_TWO_2: Mode = Mode { subsets: 2, ..mode((0x13, 5), 3, 2, LEVELS_40, Hints::Colour) };
const RGBA_4: Mode = mode((0x2, 3), 4, 4, LEVELS_48, Hints::Short);
const RGBA_3: Mode = mode((0x6, 3), 4, 3, LEVELS_192, Hints::Short);
const RGBA_2: Mode = mode((0xd, 5), 4, 2, LEVELS_256, Hints::ColourAndAlpha);
const RGBA_DUAL: Mode = Mode { dual: true, ..mode((0x0, 2), 4, 2, LEVELS_48, Hints::Short) };
const RGBA_TWO: Mode = Mode { subsets: 2, ..mode((0xf, 5), 4, 2, LEVELS_16, Hints::ColourAndAlpha) };
const GREY_ALPHA: Mode = mode((0x5, 7), 2, 4, LEVELS_256, Hints::ColourAndAlpha);
const GREY_ALPHA_DUAL: Mode = Mode { dual: true, ..mode((0x25, 6), 2, 2, LEVELS_256, Hints::ColourAndAlpha) };
/// The mode of blocks of one colour.
const SOLID: (u32, u32) = (0x17, 5);

/// Squared error a block below which no further modes are tried: half a step of a channel of 8 bits.
const CLOSE: f32 = 24.0;
/// Rounds in which endpoints and weights are fitted to each other.
const ROUNDS: usize = 3;
/// Partitions that are tried, of those that look best.
const PARTITIONS: usize = 3;

/// Weights of 64 by bits (ASTC; where BC7 has them they are the same).
fn weights(bits: u32) -> &'static [f32] {
    const OF_2: [f32; 4] = [0.0, 21.0, 43.0, 64.0];
    const OF_3: [f32; 8] = [0.0, 9.0, 18.0, 27.0, 37.0, 46.0, 55.0, 64.0];
    const OF_4: [f32; 16] =
        [0.0, 4.0, 8.0, 12.0, 17.0, 21.0, 25.0, 29.0, 35.0, 39.0, 43.0, 47.0, 52.0, 56.0, 60.0, 64.0];
    static OF_5: LazyLock<[f32; 32]> =
        LazyLock::new(|| std::array::from_fn(|i| (2 * i + 2 * usize::from(i > 15)) as f32));
    match bits {
        2 => &OF_2,
        3 => &OF_3,
        4 => &OF_4,
        _ => &*OF_5,
    }
}

/// By 8 bits: the value that means what is nearest, and what it means.
type Quantised = [(u8, u8); 256];

impl Range {
    fn levels(self) -> u32 {
        self.digit << self.bits
    }

    /// The 8 bits that a value means (ASTC, "Endpoint Unquantization").
    fn unquantised(self, value: u32) -> u8 {
        let (low, digit) = (value & ((1 << self.bits) - 1), value >> self.bits);
        let bit = |n: u32| low >> n & 1;
        let (c, b) = match (self.digit, self.bits) {
            (1, 4) => return (low * 17) as u8,
            (1, 5) => return (low << 3 | low >> 2) as u8,
            (1, _) => return low as u8,
            (5, 3) => (26, bit(2) << 8 | bit(1) << 7 | bit(2) << 2 | bit(1) << 1 | bit(2)),
            (3, 4) => (22, bit(3) << 8 | bit(2) << 7 | bit(1) << 6 | bit(3) << 2 | bit(2) << 1 | bit(1)),
            (5, 5) => (6, (low >> 1) << 5 | bit(4)),
            _ => (5, (low >> 1) << 4 | bit(5)),
        };
        let a = if bit(0) == 1 { 511 } else { 0 };
        let value = (digit * c + b) ^ a;
        ((a & 0x80) | value >> 2) as u8
    }

    fn table(self) -> &'static Quantised {
        static TABLES: LazyLock<Vec<(Range, Quantised)>> = LazyLock::new(|| {
            let ranges = [LEVELS_16, LEVELS_32, LEVELS_40, LEVELS_48, LEVELS_160, LEVELS_192, LEVELS_256];
            let table = |range: Range| {
                std::array::from_fn(|wanted| {
                    let all = (0..range.levels()).map(|v| (v as u8, range.unquantised(v)));
                    all.min_by_key(|(v, means)| (means.abs_diff(wanted as u8), *v)).unwrap_or_default()
                })
            };
            ranges.into_iter().map(|range| (range, table(range))).collect()
        });
        let found = TABLES.iter().find(|(range, _)| *range == self);
        &found.unwrap_or(&TABLES[0]).1
    }
}

/// Partitions into two, by the seeds that make them in ASTC; each is one of BC7 too.
const SEEDS: [u32; 30] = [
    28, 20, 16, 29, 91, 9, 107, 72, 149, 204, 50, 114, 496, 17, 78, 39, 252, 828, 43, 156, 116, 210, 476, 273, 684,
    359, 246, 195, 694, 524,
];

/// By partition, which texels belong to the second part: a bit a texel.
static PARTS: LazyLock<[u16; 30]> = LazyLock::new(|| SEEDS.map(part));

/// ASTC's partition of a small block into two ("Partition Pattern Generation").
fn part(seed: u32) -> u16 {
    let mut hash = seed + 1024;
    hash ^= hash >> 15;
    hash = hash.wrapping_sub(hash << 17);
    hash = hash.wrapping_add(hash << 7);
    hash = hash.wrapping_add(hash << 4);
    hash ^= hash >> 5;
    hash = hash.wrapping_add(hash << 16);
    hash ^= hash >> 7;
    hash ^= hash >> 3;
    hash ^= hash << 6;
    hash ^= hash >> 17;
    let nibble = |at: u32| {
        let v = hash >> at & 15;
        v * v
    };
    let (odd, even) = (if seed & 2 > 0 { 4 } else { 5 }, 5);
    let [first, second] = if seed & 1 > 0 { [odd, even] } else { [even, odd] };
    let (s1, s2, s3, s4) = (nibble(0) >> first, nibble(4) >> second, nibble(8) >> first, nibble(12) >> second);
    let mut bits = 0;
    for i in 0..16u32 {
        let (x, y) = (2 * (i % 4), 2 * (i / 4));
        let a = (s1 * x + s2 * y + (hash >> 14)) & 63;
        let b = (s3 * x + s4 * y + (hash >> 10)) & 63;
        bits |= u16::from(a < b) << i;
    }
    bits
}

/// A line and where the texels are on it.
#[derive(Debug, Clone, Copy)]
struct Line {
    /// Values as they are told, by channel: one end, the other.
    ends: [[u8; 2]; 4],
    /// By texel of its part.
    weights: [u8; 16],
    error: f32,
}

/// The line that tells some texels best, in some channels.
fn line(texels: &[[f32; 4]; 16], members: u16, channels: &[usize], mode: &Mode) -> Line {
    let own = || (0..16).filter(|i| members >> i & 1 == 1);
    let count = members.count_ones().max(1) as f32;
    let mut mean = [0f32; 4];
    own().for_each(|i| channels.iter().for_each(|c| mean[*c] += texels[i][*c] / count));
    let axis = axis(texels, members, channels, &mean);
    let along = |i: usize| channels.iter().map(|c| (texels[i][*c] - mean[*c]) * axis[*c]).sum::<f32>();
    let (low, high) = own().map(along).fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), t| (l.min(t), h.max(t)));
    let mut ends: [[f32; 4]; 2] = [low, high].map(|t| std::array::from_fn(|c| mean[c] + axis[c] * t));
    let (table, weights) = (mode.range.table(), weights(mode.weight_bits));
    let mut best = Line { ends: [[0; 2]; 4], weights: [0; 16], error: f32::INFINITY };
    for _ in 0..ROUNDS {
        let mut told = Line { ends: [[0; 2]; 4], weights: [0; 16], error: 0.0 };
        let mut ramp = [[0f32; 4]; 32];
        for c in channels {
            let [a, b] = [0, 1].map(|k| table[ends[k][*c].round().clamp(0.0, 255.0) as usize]);
            told.ends[*c] = [a.0, b.0];
            let [a, b] = [a.1, b.1].map(|v| u32::from(v) * 257);
            for (colour, w) in ramp.iter_mut().zip(weights) {
                let w = *w as u32;
                colour[*c] = ((a * (64 - w) + b * w + 32) >> 14) as f32;
            }
        }
        for i in own() {
            let (mut least, mut at) = (f32::INFINITY, 0);
            for (w, colour) in ramp[..weights.len()].iter().enumerate() {
                let error = channels.iter().map(|c| (colour[*c] - texels[i][*c]).powi(2)).sum::<f32>();
                if error < least {
                    (least, at) = (error, w);
                }
            }
            told.weights[i] = at as u8;
            told.error += least;
        }
        if told.error >= best.error {
            break;
        }
        best = told;
        // The ends that fit these weights best.
        let (mut aa, mut ab, mut bb) = (0f32, 0f32, 0f32);
        let (mut pa, mut pb) = ([0f32; 4], [0f32; 4]);
        for i in own() {
            let b = weights[usize::from(told.weights[i])] / 64.0;
            let a = 1.0 - b;
            (aa, ab, bb) = (aa + a * a, ab + a * b, bb + b * b);
            for c in channels {
                pa[*c] += a * texels[i][*c];
                pb[*c] += b * texels[i][*c];
            }
        }
        let determinant = aa * bb - ab * ab;
        if determinant.abs() < 1e-6 {
            break;
        }
        for c in channels {
            ends[0][*c] = (pa[*c] * bb - pb[*c] * ab) / determinant;
            ends[1][*c] = (pb[*c] * aa - pa[*c] * ab) / determinant;
        }
    }
    best
}

/// The direction in which texels differ most.
fn axis(texels: &[[f32; 4]; 16], members: u16, channels: &[usize], mean: &[f32; 4]) -> [f32; 4] {
    let covariance = covariance(texels, members, channels, mean);
    let longest =
        channels.iter().copied().max_by(|a, b| covariance[*a][*a].total_cmp(&covariance[*b][*b])).unwrap_or(0);
    let mut axis = covariance[longest];
    for _ in 0..5 {
        let length = axis.iter().map(|v| v * v).sum::<f32>().sqrt();
        if length < 1e-6 {
            return std::array::from_fn(|c| f32::from(u8::from(c == longest)));
        }
        let unit = axis.map(|v| v / length);
        axis = std::array::from_fn(|i| (0..4).map(|j| covariance[i][j] * unit[j]).sum());
    }
    let length = axis.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    axis.map(|v| v / length)
}

fn covariance(texels: &[[f32; 4]; 16], members: u16, channels: &[usize], mean: &[f32; 4]) -> [[f32; 4]; 4] {
    let mut covariance = [[0f32; 4]; 4];
    for i in (0..16).filter(|i| members >> i & 1 == 1) {
        for a in channels {
            for b in channels {
                covariance[*a][*b] += (texels[i][*a] - mean[*a]) * (texels[i][*b] - mean[*b]);
            }
        }
    }
    covariance
}

/// What some texels lose, about, when they are told by a line.
fn off_line(texels: &[[f32; 4]; 16], members: u16, channels: &[usize]) -> f32 {
    let own = || (0..16).filter(|i| members >> i & 1 == 1);
    let count = members.count_ones().max(1) as f32;
    let mut mean = [0f32; 4];
    own().for_each(|i| channels.iter().for_each(|c| mean[*c] += texels[i][*c] / count));
    let axis = axis(texels, members, channels, &mean);
    let square = |i: usize| -> f32 {
        let d = |c: usize| texels[i][c] - mean[c];
        let along: f32 = channels.iter().map(|c| d(*c) * axis[*c]).sum();
        channels.iter().map(|c| d(*c) * d(*c)).sum::<f32>() - along * along
    };
    own().map(square).sum()
}

/// A block as it is told.
#[derive(Debug, Clone)]
struct Told {
    mode: &'static Mode,
    /// Number of the partition, and its second part.
    partition: u32,
    second: u16,
    /// The channel with weights of its own.
    apart: usize,
    /// By part or plane.
    lines: [Line; 2],
    error: f32,
}

/// A block of 16 bytes, as close as the modes that are tried come.
pub(super) fn encode(block: &Texels) -> [u8; 16] {
    if block.iter().all(|t| t == &block[0]) {
        return solid(block[0]);
    }
    let texels: [[f32; 4]; 16] = block.map(|t| t.map(f32::from));
    let is_opaque = block.iter().all(|t| t[3] == 255);
    let is_grey = block.iter().all(|t| t[0] == t[1] && t[1] == t[2]);
    let mut best: Option<Told> = None;
    let mut offer = |told: Told| {
        if best.as_ref().is_none_or(|b| told.error < b.error) {
            best = Some(told);
        }
        best.as_ref().is_some_and(|b| b.error <= CLOSE)
    };
    let _ = if is_opaque {
        [&RGB_4, &RGB_3, &RGB_5].into_iter().any(|mode| offer(one(&texels, mode)))
            || (0..3).any(|apart| offer(dual(&texels, &RGB_DUAL, apart)))
            || two(&texels, &[&RGB_TWO_3, &RGB_TWO_2]).any(&mut offer)
    } else if is_grey {
        offer(one(&texels, &GREY_ALPHA)) || offer(dual(&texels, &GREY_ALPHA_DUAL, 3))
    } else {
        [&RGBA_4, &RGBA_3, &RGBA_2].into_iter().any(|mode| offer(one(&texels, mode)))
            || [3, 0, 1, 2].into_iter().any(|apart| offer(dual(&texels, &RGBA_DUAL, apart)))
            || two(&texels, &[&RGBA_TWO]).any(&mut offer)
    };
    match best {
        Some(told) => told.bytes(),
        None => solid(block[0]),
    }
}

fn channels(mode: &Mode) -> &'static [usize] {
    match mode.channels {
        2 => &[0, 3],
        3 => &[0, 1, 2],
        _ => &[0, 1, 2, 3],
    }
}

fn one(texels: &[[f32; 4]; 16], mode: &'static Mode) -> Told {
    let line = line(texels, u16::MAX, channels(mode), mode);
    Told { mode, partition: 0, second: 0, apart: 4, lines: [line; 2], error: line.error }
}

fn dual(texels: &[[f32; 4]; 16], mode: &'static Mode, apart: usize) -> Told {
    let others: Vec<usize> = channels(mode).iter().copied().filter(|c| *c != apart).collect();
    let lines = [line(texels, u16::MAX, &others, mode), line(texels, u16::MAX, &[apart], mode)];
    Told { mode, partition: 0, second: 0, apart, lines, error: lines[0].error + lines[1].error }
}

fn two<'a>(texels: &'a [[f32; 4]; 16], modes: &'a [&'static Mode]) -> impl Iterator<Item = Told> + 'a {
    let channels = channels(modes[0]);
    let mut order: Vec<(f32, u32)> = PARTS
        .iter()
        .enumerate()
        .map(|(i, second)| (off_line(texels, *second, channels) + off_line(texels, !*second, channels), i as u32))
        .collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    order.truncate(PARTITIONS);
    order.into_iter().flat_map(move |(_, partition)| {
        let second = PARTS[partition as usize];
        modes.iter().map(move |mode| {
            let lines = [line(texels, !second, channels, mode), line(texels, second, channels, mode)];
            Told { mode, partition, second, apart: 4, lines, error: lines[0].error + lines[1].error }
        })
    })
}

impl Told {
    fn part(&self, texel: usize) -> usize {
        usize::from(self.second >> texel & 1)
    }

    /// The texels as readers see them.
    fn shown(&self) -> Texels {
        let table: Vec<u32> =
            (0..self.mode.range.levels()).map(|v| u32::from(self.mode.range.unquantised(v))).collect();
        let weights = weights(self.mode.weight_bits);
        std::array::from_fn(|i| {
            let mut out = [0, 0, 0, 255];
            for c in channels(self.mode) {
                let line = &self.lines[if self.mode.dual { usize::from(*c == self.apart) } else { self.part(i) }];
                let w = weights[usize::from(line.weights[i])] as u32;
                let [a, b] = line.ends[*c].map(|v| table[usize::from(v)] * 257);
                out[*c] = ((a * (64 - w) + b * w + 32) >> 14) as u8;
            }
            if self.mode.channels == 2 {
                (out[1], out[2]) = (out[0], out[0]);
            }
            out
        })
    }

    fn bytes(mut self) -> [u8; 16] {
        let shown = self.shown();
        let mode = self.mode;
        let mut out = Bits::default();
        out.put(mode.code.0, mode.code.1);
        hints(&shown, mode.hints, &mut out);
        if mode.subsets == 2 {
            out.put(self.partition, 5);
        }
        if mode.dual && mode.channels > 2 {
            out.put(self.apart as u32, 2);
        }
        // The first weight of each part or plane has its highest bit left out: where it is set, the ends change places.
        let last = (1u8 << mode.weight_bits) - 1;
        let anchors = match (mode.dual, mode.subsets) {
            (true, _) => [0, 0],
            (_, 2) => [(!self.second).trailing_zeros() as usize, self.second.trailing_zeros() as usize],
            _ => [0, 16],
        };
        for (line, anchor) in self.lines.iter_mut().zip(anchors) {
            if line.weights.get(anchor).is_some_and(|w| *w > last / 2) {
                line.weights = line.weights.map(|w| last - w);
                line.ends = line.ends.map(|[a, b]| [b, a]);
            }
        }
        let mut values: Vec<u32> = Vec::new();
        for part in 0..mode.subsets {
            for c in channels(mode) {
                let line = if mode.dual { usize::from(*c == self.apart) } else { part };
                values.extend(self.lines[line].ends[*c].map(u32::from));
            }
        }
        put_values(&values, mode.range, &mut out);
        for i in 0..16 {
            let mut put = |line: usize| {
                let bits = mode.weight_bits - u32::from(anchors[line] == i);
                out.put(u32::from(self.lines[line].weights[i]), bits);
            };
            if mode.dual {
                put(0);
                put(1);
            } else {
                put(self.part(i));
            }
        }
        out.0.to_le_bytes()
    }
}

/// Endpoints: the digits of all together, then the bits of each.
fn put_values(values: &[u32], range: Range, out: &mut Bits) {
    let (group, widths): (usize, &[u32]) = match range.digit {
        3 => (5, &[0, 2, 4, 5, 7, 8]),
        5 => (3, &[0, 3, 5, 7]),
        _ => (values.len(), &[0]),
    };
    if range.digit > 1 {
        for values in values.chunks(group) {
            let number = values.iter().rev().fold(0, |n, v| n * range.digit + (v >> range.bits));
            out.put(number, widths[values.len()]);
        }
    }
    for value in values {
        out.put(value & ((1 << range.bits) - 1), range.bits);
    }
}

/// 128 bits, from the lowest.
#[derive(Debug, Default)]
struct Bits(u128, u32);

impl Bits {
    fn put(&mut self, value: u32, count: u32) {
        self.0 |= u128::from(value) << self.1;
        self.1 += count;
    }
}

/// ETC1: steps of its tables, and the texels of the two halves of a block.
const STEPS: [[i32; 2]; 8] = [[2, 8], [5, 17], [9, 29], [13, 42], [18, 60], [24, 80], [33, 106], [47, 183]];
/// The correction of ETC1's colours that is none, about; those that make all channels darker or brighter.
const CORRECTIONS: [(u32, i32); 3] = [(13, 0), (0, -1), (26, 1)];

/// What whoever makes ETC1, ETC2 or BC1 of a block need not search for: the halves, their colours' bits, tables and correction; the table of alpha.
fn hints(shown: &Texels, hints: Hints, out: &mut Bits) {
    out.put(0, if hints == Hints::Short { 1 } else { 2 });
    let corrections = if hints == Hints::Short { &CORRECTIONS[..1] } else { &CORRECTIONS[..] };
    let mut best = (u32::MAX, [0u32; 5]);
    for flip in [false, true] {
        for diff in [true, false] {
            for (bias, delta) in corrections {
                // What has no place for a correction has none, at the bounds neither.
                let delta = (hints != Hints::Short).then_some(*delta);
                if let Some((error, tables)) = etc1(shown, flip, diff, delta)
                    && error < best.0
                {
                    best = (error, [u32::from(flip), u32::from(diff), tables[0], tables[1], *bias]);
                }
            }
        }
    }
    let [flip, diff, first, second, bias] = best.1;
    out.put(flip, 1);
    out.put(diff, 1);
    out.put(first, 3);
    out.put(second, 3);
    if hints != Hints::Short {
        out.put(bias, 5);
    }
    if hints != Hints::Colour {
        out.put(alpha_table(shown), 8);
    }
}

/// What ETC1 loses of a block, and the tables of its halves; none where the halves differ by more than it can tell.
fn etc1(shown: &Texels, flip: bool, diff: bool, delta: Option<i32>) -> Option<(u32, [u32; 2])> {
    let half = |i: usize| if flip { i / 8 } else { i % 4 / 2 };
    let limit = if diff { 31 } else { 15 };
    let mut colours = [[0i32; 3]; 2];
    for (h, colour) in colours.iter_mut().enumerate() {
        for c in 0..3 {
            let sum: i32 = (0..16).filter(|i| half(*i) == h).map(|i| i32::from(shown[i][c])).sum();
            let mean = (sum * limit + 1020) / 2040;
            colour[c] = match delta {
                None => mean,
                Some(delta) if mean == 0 => delta + 1,
                Some(delta) if mean == limit => mean + delta - 1,
                Some(delta) => mean + delta,
            };
        }
    }
    if diff && (0..3).any(|c| !(-4..=3).contains(&(colours[1][c] - colours[0][c]))) {
        return None;
    }
    let mut tables = [0; 2];
    let mut sum = 0;
    for h in 0..2 {
        let base = colours[h].map(|v| if diff { v << 3 | v >> 2 } else { v * 17 });
        let of_table = |steps: &[i32; 2]| -> u32 {
            let colours = [-steps[1], -steps[0], steps[0], steps[1]].map(|s| base.map(|b| (b + s).clamp(0, 255)));
            let of_texel = |i: usize| {
                let error =
                    |colour: &[i32; 3]| (0..3).map(|c| (colour[c] - i32::from(shown[i][c])).pow(2) as u32).sum::<u32>();
                colours.iter().map(error).min().unwrap_or(0)
            };
            (0..16).filter(|i| half(*i) == h).map(of_texel).sum()
        };
        let (error, table) =
            STEPS.iter().enumerate().map(|(t, steps)| (of_table(steps), t as u32)).min().unwrap_or((0, 0));
        tables[h] = table;
        sum += error;
    }
    Some((sum, tables))
}

/// Lowest and highest modifier of ETC2's tables for alpha.
const ALPHA_BOUNDS: [(i32, i32); 16] = [
    (-15, 14),
    (-13, 12),
    (-13, 12),
    (-13, 12),
    (-12, 11),
    (-11, 10),
    (-11, 10),
    (-11, 10),
    (-10, 9),
    (-10, 9),
    (-10, 9),
    (-10, 9),
    (-10, 9),
    (-10, 9),
    (-9, 8),
    (-9, 8),
];

/// A table and a factor whose modifiers reach over the alphas of a block.
fn alpha_table(shown: &Texels) -> u32 {
    let (low, high) = shown.iter().fold((255, 0), |(l, h), t| (l.min(i32::from(t[3])), h.max(i32::from(t[3]))));
    let spread = high - low;
    let off = |(table, factor): &(u32, u32)| {
        let (low, high) = ALPHA_BOUNDS[*table as usize];
        (((high - low) * *factor as i32 - spread).abs(), *table)
    };
    let all = (0..16).flat_map(|table| (1..16).map(move |factor| (table, factor)));
    let (table, factor) = all.min_by_key(off).unwrap_or((13, 1));
    table | factor << 4
}

/// A block of one colour, and how ETC1 shows it.
fn solid(colour: [u8; 4]) -> [u8; 16] {
    let mut out = Bits::default();
    out.put(SOLID.0, SOLID.1);
    colour.iter().for_each(|v| out.put(u32::from(*v), 8));
    let mut best = (u32::MAX, [0u32; 6]);
    for (table, steps) in STEPS.iter().enumerate() {
        for (selector, step) in [-steps[1], -steps[0], steps[0], steps[1]].into_iter().enumerate() {
            let mut base = [0u32; 3];
            let mut error = 0;
            for c in 0..3 {
                let wanted = i32::from(colour[c]);
                base[c] = (((wanted - step).clamp(0, 255) * 31 + 127) / 255) as u32;
                let shown = ((base[c] << 3 | base[c] >> 2) as i32 + step).clamp(0, 255);
                error += (shown - wanted).pow(2) as u32;
            }
            if error < best.0 {
                best = (error, [1, table as u32, selector as u32, base[0], base[1], base[2]]);
            }
        }
    }
    for (value, bits) in best.1.into_iter().zip([1, 3, 2, 5, 5, 5]) {
        out.put(value, bits);
    }
    out.0.to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values that ASTC's tables of unquantised endpoints begin and end with, and that are symmetrical.
    #[test]
    fn endpoints_mean_what_astc_says() {
        for range in [LEVELS_16, LEVELS_32, LEVELS_40, LEVELS_48, LEVELS_160, LEVELS_192, LEVELS_256] {
            let mut all: Vec<u8> = (0..range.levels()).map(|v| range.unquantised(v)).collect();
            all.sort_unstable();
            let widest = all.windows(2).map(|w| w[1] - w[0]).max().unwrap();
            assert_eq!((all[0], all[all.len() - 1]), (0, 255), "{range:?}");
            assert!(u32::from(widest) <= 255 / (range.levels() - 1) + 3, "{range:?} {widest}");
            assert!(all.iter().zip(all.iter().rev()).all(|(a, b)| *a == 255 - b), "{range:?}");
        }
        assert_eq!([1, 7, 8].map(|v| LEVELS_16.unquantised(v)), [17, 119, 136]);
        assert_eq!([1, 15, 16].map(|v| LEVELS_32.unquantised(v)), [8, 123, 132]);
    }

    #[test]
    fn partitions_have_two_parts() {
        // The first five of BC7: columns halved, the last column, the first three, and slopes.
        assert_eq!(PARTS[0], 0b1100_1100_1100_1100);
        assert_eq!(PARTS[1], 0b1000_1000_1000_1000);
        assert!(PARTS.iter().all(|p| (1..16).contains(&p.count_ones())));
    }
}
