//! The sheet under construction, as bits, and the search over all positions of a piece at once.
//!
//! Level k of the sheet holds, for each cell, whether any of the 2^k cells from it to the right is taken.
//! A run of cells is then tested for 64 positions in a row with two shifted words, whatever its length.
//! Where positions are multiples of a stride, each level is dealt out to as many planes, cell x to bit x / stride of plane
//! x % stride: the 64 positions of a word then reach over 64 strides. The rows between two positions are also kept joined to one
//! band, where few tests tell most positions that are not free.

use super::mask::Mask;

/// How sheets of one resolution lie in memory: row by row, in each row level by level, in each level plane by plane. The same for all sheets of a search, so
/// that a piece's look-ups are computed once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pitch {
    /// Words of one plane of one level of one row.
    words: usize,
    levels: usize,
    /// Positions are multiples of this many cells, a power of two.
    stride: usize,
}

impl Pitch {
    /// For sheets up to `width` cells wide, runs up to `longest_run` cells, and positions that are multiples of `stride` cells.
    pub fn new(width: usize, longest_run: usize, stride: usize) -> Self {
        debug_assert!(stride.is_power_of_two());
        let words = width.div_ceil(64 * stride) + 1;
        Pitch { words, levels: longest_run.max(1).ilog2() as usize + 1, stride }
    }

    fn level(self) -> usize {
        self.words * self.stride
    }

    fn row(self) -> usize {
        self.level() * self.levels
    }

    /// Where cell `x` of a row lies: the first word of its plane, and its bit there.
    fn plane(self, x: usize) -> (usize, usize) {
        // Strides are powers of two: no division.
        ((x & (self.stride - 1)) * self.words, x >> self.stride.trailing_zeros())
    }

    /// Recomputes the higher levels of a row for cells that can see `from..to`.
    fn lift(self, line: &mut [u64], (from, to): (usize, usize)) {
        let Pitch { words, stride, levels } = self;
        let last = (to / stride / 64).min(words - 1);
        for k in 1..levels {
            let step = 1usize << (k - 1);
            let first = from.saturating_sub(2 * step) / stride / 64;
            let (below, above) = line.split_at_mut(k * stride * words);
            let below = &below[(k - 1) * stride * words..];
            for plane in 0..stride {
                let source = &below[plane * words..][..words];
                let (other, by) = self.plane(plane + step);
                let other = &below[other..][..words];
                let above = &mut above[plane * words..][..words];
                for i in first..=last {
                    above[i] = source[i] | shifted(other, i, by);
                }
            }
        }
    }
}

/// A piece's mask prepared for searching: its runs, each as two look-ups on a level.
#[derive(Debug, Clone)]
pub(crate) struct Probe {
    pub width: usize,
    pub height: usize,
    tests: Vec<Test>,
    /// Runs of whole bands.
    bands: Vec<Test>,
    /// Rows of the longest runs and their lengths: a row of the sheet without so much room is out.
    widest: Vec<(u32, u32)>,
}

/// A run: where the two words that answer for it lie, relative to the word of the position, and how far they are shifted.
#[derive(Debug, Clone, Copy)]
struct Test {
    first: u32,
    second: u32,
    shifts: [u8; 2],
}

/// Runs so many rows apart collide independently of each other.
const REACH: u32 = 16;
/// How many runs are chosen with regard to those before them.
const SPREAD: usize = 8;
/// How many of the longest runs are held against the room that rows have.
const WIDEST: usize = 12;

impl Probe {
    /// Prepares a mask; long runs come first, since they collide most often, and where `apart` says so also those that are far
    /// from each other.
    pub fn new(mask: &Mask, pitch: Pitch, apart: bool) -> Self {
        let mut runs = mask.runs();
        runs.sort_unstable_by_key(|&(row, first, last)| (std::cmp::Reverse(last - first), row, first));
        let widest = runs.iter().take(WIDEST).map(|&(row, first, last)| (row, last - first + 1)).collect();
        let mut bands = if pitch.stride > 1 { mask.bands(pitch.stride).runs() } else { Vec::new() };
        if apart {
            spread(&mut bands, (REACH / pitch.stride as u32).max(1));
            spread(&mut runs, REACH);
        }
        let tests = |runs: Vec<(u32, u32, u32)>| {
            runs.into_iter().map(|(row, first, last)| Test::new(row as usize, first, last, pitch)).collect()
        };
        Probe { width: mask.width, height: mask.height, tests: tests(runs), bands: tests(bands), widest }
    }
}

/// Puts first those runs that collide where the ones before them do not: long ones far from each other.
fn spread(runs: &mut [(u32, u32, u32)], reach: u32) {
    let mut distance = vec![reach; runs.len()];
    for done in 0..runs.len().min(SPREAD) {
        let worth = |k: &usize| (runs[*k].2 - runs[*k].1 + 1) * distance[*k];
        // The first of equals.
        let Some(next) = (done..runs.len()).rev().max_by_key(worth) else { return };
        runs[done..=next].rotate_right(1);
        distance[done..=next].rotate_right(1);
        let row = runs[done].0;
        for (run, least) in runs.iter().zip(&mut distance).skip(done + 1) {
            *least = (*least).min(run.0.abs_diff(row));
        }
    }
}

/// Where to look for a position: cells of the probe's top left corner, inclusive.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Window {
    pub x: (usize, usize),
    pub y: (usize, usize),
}

/// The taken cells of one sheet.
#[derive(Debug, Clone)]
pub(crate) struct Occupancy {
    width: usize,
    height: usize,
    pitch: Pitch,
    bits: Vec<u64>,
    /// The same cells row by row in their order, where there are several planes.
    cells: Option<Mask>,
    /// There, each `stride` rows as one.
    bands: Vec<u64>,
    /// By row: an upper bound of the longest run of free cells.
    room: Vec<u32>,
}

impl Occupancy {
    /// An empty sheet, not wider than the pitch was made for.
    pub fn new(width: usize, height: usize, pitch: Pitch) -> Self {
        debug_assert!(width.div_ceil(64 * pitch.stride) < pitch.words);
        // Two spare words, so that shifted reads stay inside.
        let bits = vec![0; pitch.row() * height + 2];
        let cells = (pitch.stride > 1).then(|| Mask::new(width, height));
        let bands = if pitch.stride > 1 { pitch.row() * (height / pitch.stride) + 2 } else { 0 };
        Occupancy { width, height, pitch, bits, cells, bands: vec![0; bands], room: vec![width as u32; height] }
    }

    /// What making one costs, in the unit of [`Occupancy::find`]: clearing a word is cheap.
    pub fn cost(&self) -> u64 {
        (self.bits.len() + self.bands.len()) as u64 / 16
    }

    /// Takes (or frees) the cells of a mask placed at `(x, y)`. Gives the work, in the unit of [`Occupancy::find`].
    pub fn stamp(&mut self, mask: &Mask, x: usize, y: usize, taken: bool) -> u64 {
        for row in 0..mask.height {
            let base = (y + row) * self.pitch.row();
            let level = &mut self.bits[base..base + self.pitch.level()];
            let line = match &mut self.cells {
                Some(cells) => {
                    shift_onto(cells.row_mut(y + row), mask.row(row), x, taken);
                    cells.row(y + row)
                }
                None => {
                    shift_onto(level, mask.row(row), x, taken);
                    &*level
                }
            };
            self.room[y + row] = longest_free(line, self.width);
        }
        if self.cells.is_some() {
            for (row, first, last) in mask.runs() {
                let base = (y + row as usize) * self.pitch.row();
                let (first, last) = (x + first as usize, x + last as usize);
                // One run on each plane that the cells lie on.
                for from in first..=last.min(first + self.pitch.stride - 1) {
                    let (plane, a) = self.pitch.plane(from);
                    let line = &mut self.bits[base + plane..base + plane + self.pitch.words];
                    set_run(line, a, a + (last - from) / self.pitch.stride, taken);
                }
            }
        }
        let (size, touched) = (self.pitch.row(), (x, x + mask.width));
        for line in self.bits[y * size..(y + mask.height) * size].chunks_exact_mut(size) {
            self.pitch.lift(line, touched);
        }
        if self.cells.is_some() {
            let stride = self.pitch.stride;
            for band in y / stride..(y + mask.height).div_ceil(stride).min(self.height / stride) {
                self.join(band, touched);
            }
        }
        // Of each row: the free runs of all of it, and every level about the mask.
        let levels = (self.pitch.levels + 1) * (mask.width / 64 + 2);
        (mask.height * (self.pitch.level() + levels) / 2) as u64
    }

    /// Recomputes a band for cells that can see `touched`.
    fn join(&mut self, band: usize, touched: (usize, usize)) {
        let Pitch { words, stride, .. } = self.pitch;
        let size = self.pitch.row();
        let line = &mut self.bands[band * size..][..size];
        let rows = &self.bits[band * stride * size..][..stride * size];
        let last = (touched.1 / stride / 64).min(words - 1);
        for plane in 0..stride {
            for i in plane * words + touched.0 / stride / 64..=plane * words + last {
                line[i] = (0..stride).fold(0, |bits, row| bits | rows[row * size + i]);
            }
        }
        self.pitch.lift(line, touched);
    }

    /// The first free position in the window, rows from the top, cells from the left, and the number of words
    /// that were looked at (the unit of work).
    pub fn find(&self, probe: &Probe, window: Window) -> (Option<(usize, usize)>, u64) {
        let mut work = 0;
        let (Some(x_room), Some(y_room)) = (self.width.checked_sub(probe.width), self.height.checked_sub(probe.height))
        else {
            return (None, work);
        };
        let x_last = window.x.1.min(x_room);
        let y_last = window.y.1.min(y_room);
        if window.x.0 > x_last || window.y.0 > y_last {
            return (None, work);
        }
        let stride = self.pitch.stride;
        let (x_first, x_last) = (window.x.0.div_ceil(stride), x_last / stride);
        if x_first > x_last {
            return (None, work);
        }
        let (word_first, word_last) = (x_first / 64, x_last / 64);
        let low = !0u64 << (x_first % 64);
        let high = !0u64 >> (63 - x_last % 64);
        // What collided at one word is likely to collide at the next too.
        let mut hints = [0; 2];
        for y in (window.y.0.next_multiple_of(stride)..=y_last).step_by(stride) {
            work += 1;
            if probe.widest.iter().any(|&(row, run)| self.room[y + row as usize] < run) {
                continue;
            }
            for i in word_first..=word_last {
                let mut free = !0u64;
                if i == word_first {
                    free &= low;
                }
                if i == word_last {
                    free &= high;
                }
                work += 1;
                let row = self.pitch.row();
                let bands = self.bands.get(y / stride * row + i..).unwrap_or_default();
                free = narrowed(free, &probe.bands, bands, &mut hints[0], &mut work);
                if free == 0 {
                    continue;
                }
                free = narrowed(free, &probe.tests, &self.bits[y * row + i..], &mut hints[1], &mut work);
                if free != 0 {
                    return (Some(((i * 64 + free.trailing_zeros() as usize) * stride, y)), work);
                }
            }
        }
        (None, work)
    }
}

/// Those of the free positions at which no run meets a taken cell. `hint` is the run that left none the last time.
#[inline(always)]
fn narrowed(mut free: u64, tests: &[Test], here: &[u64], hint: &mut usize, work: &mut u64) -> u64 {
    if let Some(test) = tests.get(*hint) {
        free &= !test.taken(here);
    }
    if free == 0 {
        return 0;
    }
    for (n, test) in tests.iter().enumerate() {
        free &= !test.taken(here);
        if free == 0 {
            *work += n as u64;
            *hint = n;
            return 0;
        }
    }
    *work += tests.len() as u64;
    free
}

impl Test {
    fn new(row: usize, first: u32, last: u32, pitch: Pitch) -> Self {
        let level = (last - first + 1).ilog2();
        let base = row * pitch.row() + level as usize * pitch.level();
        let [first, second] = [first, last + 1 - (1 << level)].map(|x| pitch.plane(x as usize));
        Test {
            first: (base + first.0 + first.1 / 64) as u32,
            second: (base + second.0 + second.1 / 64) as u32,
            shifts: [(first.1 % 64) as u8, (second.1 % 64) as u8],
        }
    }

    /// Of 64 positions, those at which the run meets a taken cell.
    #[inline(always)]
    fn taken(&self, here: &[u64]) -> u64 {
        word_at(here, self.first, self.shifts[0]) | word_at(here, self.second, self.shifts[1])
    }
}

/// The 64 cells that start `shift` cells after word `offset`.
#[inline(always)]
fn word_at(here: &[u64], offset: u32, shift: u8) -> u64 {
    match here.get(offset as usize..offset as usize + 2) {
        Some(&[low, high]) => (low >> shift) | ((high << 1) << (63 - shift)),
        _ => 0,
    }
}

/// The longest run of zeros among the first `width` bits.
fn longest_free(line: &[u64], width: usize) -> u32 {
    let mut longest = 0;
    let mut current = 0;
    for (i, &word) in line.iter().enumerate().take(width.div_ceil(64)) {
        let bits = (width - i * 64).min(64) as u32;
        if word == 0 {
            current += bits;
            continue;
        }
        longest = longest.max(current + word.trailing_zeros().min(bits));
        if word.count_zeros() > longest {
            let mut free = !word;
            let mut inner = 0;
            while free != 0 {
                free &= free << 1;
                inner += 1;
            }
            longest = longest.max(inner.min(bits));
        }
        current = word.leading_zeros().saturating_sub(64 - bits);
    }
    longest.max(current)
}

/// Takes or frees the cells of a line of a mask, moved by `x` cells.
fn shift_onto(line: &mut [u64], mask: &[u64], x: usize, taken: bool) {
    let (offset, shift) = (x / 64, x % 64);
    let put = |word: &mut u64, bits: u64| {
        if taken {
            *word |= bits;
        } else {
            *word &= !bits;
        }
    };
    for (i, &word) in mask.iter().enumerate().filter(|(_, word)| **word != 0) {
        put(&mut line[offset + i], word << shift);
        let high = if shift == 0 { 0 } else { word >> (64 - shift) };
        if high != 0 {
            put(&mut line[offset + i + 1], high);
        }
    }
}

/// Sets or clears the bits `first..=last` of a line.
fn set_run(line: &mut [u64], first: usize, last: usize, value: bool) {
    for (i, word) in line.iter_mut().enumerate().take(last / 64 + 1).skip(first / 64) {
        let low = if i == first / 64 { !0u64 << (first % 64) } else { !0 };
        let high = if i == last / 64 { !0u64 >> (63 - last % 64) } else { !0 };
        if value {
            *word |= low & high;
        } else {
            *word &= !(low & high);
        }
    }
}

/// Word `i` of the line, shifted towards cell 0; zeros beyond the end.
fn shifted(line: &[u64], i: usize, by: usize) -> u64 {
    let (i, by) = (i + by / 64, by % 64);
    let low = line.get(i).copied().unwrap_or(0);
    if by == 0 {
        return low;
    }
    low >> by | line.get(i + 1).copied().unwrap_or(0) << (64 - by)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    fn random_mask(random: &mut Random, width: usize, height: usize) -> Mask {
        let mut mask = Mask::new(width, height);
        for row in 0..height {
            for _ in 0..2 {
                let a = random.below(width);
                let b = a + random.below(width - a);
                mask.set_run(row, a, b);
            }
        }
        mask
    }

    /// The first free position by testing every cell of every position.
    fn brute(taken: &[Vec<bool>], mask: &Mask, window: Window, stride: usize) -> Option<(usize, usize)> {
        for y in (window.y.0..=window.y.1).filter(|y| y % stride == 0) {
            for x in (window.x.0..=window.x.1).filter(|x| x % stride == 0) {
                let fits = y + mask.height <= taken.len() && x + mask.width <= taken[0].len();
                let free = |i, j: usize| !mask.get(i, j) || !taken[y + j][x + i];
                if fits && (0..mask.height).all(|j| (0..mask.width).all(|i| free(i, j))) {
                    return Some((x, y));
                }
            }
        }
        None
    }

    #[test]
    fn the_longest_free_run_is_never_understated() {
        let mut random = Random::new(8);
        for _ in 0..300 {
            let width = 1 + random.below(200);
            let line: Vec<u64> = (0..width.div_ceil(64) + 2)
                .map(|_| random.next() & random.next() & random.next() & random.next())
                .collect();
            let (mut longest, mut run) = (0, 0);
            for x in 0..width {
                run = if line[x / 64] >> (x % 64) & 1 == 0 { run + 1 } else { 0 };
                longest = longest.max(run);
            }
            let found = longest_free(&line, width);
            assert!(found >= longest && found <= width as u32, "{found} for {longest}");
        }
    }

    #[test]
    fn the_search_finds_what_testing_every_cell_finds() {
        let mut random = Random::new(5);
        for round in 0..150 {
            let (w, h) = (40 + random.below(160), 30 + random.below(30));
            let stride = 1 << random.below(5);
            let pitch = Pitch::new(w, 64, stride);
            let mut sheet = Occupancy::new(w, h, pitch);
            let mut taken = vec![vec![false; w]; h];
            for _ in 0..random.below(9) {
                let (mw, mh) = (1 + random.below(40), 1 + random.below(12));
                let mask = random_mask(&mut random, mw, mh);
                let (x, y) = (random.below(w - mw + 1), random.below(h - mh + 1));
                let put = random.below(4) > 0;
                sheet.stamp(&mask, x, y, put);
                for j in 0..mh {
                    for i in 0..mw {
                        if mask.get(i, j) {
                            taken[y + j][x + i] = put;
                        }
                    }
                }
            }
            let (mw, mh) = (1 + random.below(60), 1 + random.below(20));
            let mask = random_mask(&mut random, mw.min(w), mh);
            let window =
                Window { x: (random.below(20), 20 + random.below(w)), y: (random.below(10), 10 + random.below(h)) };
            let found = sheet.find(&Probe::new(&mask, pitch, round % 2 == 0), window).0;
            assert_eq!(found, brute(&taken, &mask, window, stride), "round {round}");
        }
    }
}
