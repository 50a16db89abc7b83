//! The sheet under construction, as bits, and the search over all positions of a piece at once.
//!
//! Level k of the sheet holds, for each cell, whether any of the 2^k cells from it to the right is taken.
//! A run of cells is then tested for 64 positions in a row with two shifted words, whatever its length.

use super::mask::Mask;

/// How sheets of one resolution lie in memory: row by row, in each row level by level. The same for all sheets of a search, so
/// that a piece's look-ups are computed once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pitch {
    /// Words of one level of one row.
    words: usize,
    levels: usize,
}

impl Pitch {
    /// For sheets up to `width` cells wide and runs up to `longest_run` cells.
    pub fn new(width: usize, longest_run: usize) -> Self {
        Pitch { words: width.div_ceil(64) + 1, levels: longest_run.max(1).ilog2() as usize + 1 }
    }

    fn row(self) -> usize {
        self.words * self.levels
    }
}

/// A piece's mask prepared for searching: its runs, each as two look-ups on a level.
#[derive(Debug, Clone)]
pub(crate) struct Probe {
    pub width: usize,
    pub height: usize,
    tests: Vec<Test>,
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

/// How many of the longest runs are held against the room that rows have.
const WIDEST: usize = 12;

impl Probe {
    /// Prepares a mask; long runs come first, since they collide most often.
    pub fn new(mask: &Mask, pitch: Pitch) -> Self {
        let mut runs = mask.runs();
        runs.sort_unstable_by_key(|&(row, first, last)| (std::cmp::Reverse(last - first), row, first));
        let widest = runs.iter().take(WIDEST).map(|&(row, first, last)| (row, last - first + 1)).collect();
        let tests = runs
            .into_iter()
            .map(|(row, first, last)| {
                let level = (last - first + 1).ilog2();
                let second = last + 1 - (1 << level);
                let base = (row as usize * pitch.row() + level as usize * pitch.words) as u32;
                Test {
                    first: base + first / 64,
                    second: base + second / 64,
                    shifts: [(first % 64) as u8, (second % 64) as u8],
                }
            })
            .collect();
        Probe { width: mask.width, height: mask.height, tests, widest }
    }
}

/// Where to look for a position: cells of the probe's top left corner, inclusive, and the lattice.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Window {
    pub x: (usize, usize),
    pub y: (usize, usize),
    /// Positions are multiples of this many cells plus `phase`; a power of two up to 64.
    pub stride: usize,
    pub phase: usize,
}

/// The taken cells of one sheet.
#[derive(Debug, Clone)]
pub(crate) struct Occupancy {
    width: usize,
    height: usize,
    pitch: Pitch,
    bits: Vec<u64>,
    /// By row: an upper bound of the longest run of free cells.
    room: Vec<u32>,
}

impl Occupancy {
    /// An empty sheet, not wider than the pitch was made for.
    pub fn new(width: usize, height: usize, pitch: Pitch) -> Self {
        debug_assert!(width.div_ceil(64) < pitch.words);
        // Two spare words, so that shifted reads stay inside.
        Occupancy { width, height, pitch, bits: vec![0; pitch.row() * height + 2], room: vec![width as u32; height] }
    }

    /// What making one costs, in the unit of [`Occupancy::find`]: clearing a word is cheap.
    pub fn cost(&self) -> u64 {
        self.bits.len() as u64 / 16
    }

    /// Takes (or frees) the cells of a mask placed at `(x, y)`. Gives the work, in the unit of [`Occupancy::find`].
    pub fn stamp(&mut self, mask: &Mask, x: usize, y: usize, taken: bool) -> u64 {
        let (offset, shift) = (x / 64, x % 64);
        for row in 0..mask.height {
            let base = (y + row) * self.pitch.row();
            let line = &mut self.bits[base..base + self.pitch.words];
            for (i, &word) in mask.row(row).iter().enumerate() {
                if word == 0 {
                    continue;
                }
                let low = word << shift;
                let high = if shift == 0 { 0 } else { word >> (64 - shift) };
                if taken {
                    line[offset + i] |= low;
                } else {
                    line[offset + i] &= !low;
                }
                if high != 0 {
                    if taken {
                        line[offset + i + 1] |= high;
                    } else {
                        line[offset + i + 1] &= !high;
                    }
                }
            }
            self.room[y + row] = longest_free(line, self.width);
            self.lift(y + row, x, x + mask.width);
        }
        // Of each row: the free runs of all of it, and every level about the mask.
        let levels = (self.pitch.levels + 1) * (mask.width / 64 + 2);
        (mask.height * (self.pitch.words + levels) / 2) as u64
    }

    /// Recomputes the levels of a row for cells that can see `from..to`.
    fn lift(&mut self, row: usize, from: usize, to: usize) {
        let words = self.pitch.words;
        let last = (to / 64).min(words - 1);
        let line = &mut self.bits[row * self.pitch.row()..][..self.pitch.row()];
        for k in 1..self.pitch.levels {
            let step = 1usize << (k - 1);
            let first = from.saturating_sub(2 * step) / 64;
            let (below, above) = line.split_at_mut(k * words);
            let source = &below[(k - 1) * words..];
            for i in first..=last {
                above[i] = source[i] | shifted(source, i, step);
            }
        }
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
        let lattice =
            (0..64).step_by(window.stride).fold(0u64, |bits, b| bits | 1 << b) << (window.phase % window.stride);
        let (word_first, word_last) = (window.x.0 / 64, x_last / 64);
        let low = !0u64 << (window.x.0 % 64);
        let high = !0u64 >> (63 - x_last % 64);
        // What collided at one word is likely to collide at the next too.
        let mut hint = 0;
        let start = next_on_lattice(window.y.0, window.stride, window.phase);
        for y in (start..=y_last).step_by(window.stride) {
            work += 1;
            if probe.widest.iter().any(|&(row, run)| self.room[y + row as usize] < run) {
                continue;
            }
            for i in word_first..=word_last {
                let mut free = lattice;
                if i == word_first {
                    free &= low;
                }
                if i == word_last {
                    free &= high;
                }
                let here = &self.bits[y * self.pitch.row() + i..];
                work += 1;
                if let Some(test) = probe.tests.get(hint) {
                    free &= !test.taken(here);
                }
                if free == 0 {
                    continue;
                }
                for (n, test) in probe.tests.iter().enumerate() {
                    free &= !test.taken(here);
                    if free == 0 {
                        work += n as u64;
                        hint = n;
                        break;
                    }
                }
                if free != 0 {
                    return (Some((i * 64 + free.trailing_zeros() as usize, y)), work + probe.tests.len() as u64);
                }
            }
        }
        (None, work)
    }
}

impl Test {
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

fn next_on_lattice(from: usize, stride: usize, phase: usize) -> usize {
    from + (phase % stride + stride - from % stride) % stride
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
    fn brute(taken: &[Vec<bool>], mask: &Mask, window: Window) -> Option<(usize, usize)> {
        for y in (window.y.0..=window.y.1).filter(|y| y % window.stride == window.phase) {
            for x in (window.x.0..=window.x.1).filter(|x| x % window.stride == window.phase) {
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
            let pitch = Pitch::new(w, 64);
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
            let stride = 1 << random.below(3);
            let window = Window {
                x: (random.below(20), 20 + random.below(w)),
                y: (random.below(10), 10 + random.below(h)),
                stride,
                phase: random.below(stride),
            };
            assert_eq!(sheet.find(&Probe::new(&mask, pitch), window).0, brute(&taken, &mask, window), "round {round}");
        }
    }
}
