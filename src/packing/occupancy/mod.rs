//! The sheet under construction, as bits, and the search over all positions of a piece at once.
//!
//! Level k of the sheet holds, for each cell, whether any of the 2^k cells from it to the right is taken.
//! A run of cells is then tested for 64 positions in a row with two shifted words, whatever its length.
//! Where positions are multiples of a stride, each level is dealt out to as many planes, cell x to bit x / stride of plane
//! x % stride: the 64 positions of a word then reach over 64 strides. The rows between two positions are also kept joined to one
//! band, where few tests tell most positions that are not free.

mod pitch;
mod probe;

pub(crate) use self::pitch::Pitch;
pub(crate) use self::probe::Probe;

use self::probe::narrowed;
use super::bits::{longest_free, set_run, shift_onto};
use super::mask::Mask;

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
