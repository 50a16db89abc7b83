//! How sheets lie in memory.

use crate::packing::bits::shifted;

/// How sheets of one resolution lie in memory: row by row, in each row level by level, in each level plane by plane. The same for all sheets of a search, so
/// that a piece's look-ups are computed once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pitch {
    /// Words of one plane of one level of one row.
    pub(super) words: usize,
    pub(super) levels: usize,
    /// Positions are multiples of this many cells, a power of two.
    pub(super) stride: usize,
}

impl Pitch {
    /// For sheets up to `width` cells wide, runs up to `longest_run` cells, and positions that are multiples of `stride` cells.
    pub fn new(width: usize, longest_run: usize, stride: usize) -> Self {
        debug_assert!(stride.is_power_of_two());
        let words = width.div_ceil(64 * stride) + 1;
        Pitch { words, levels: longest_run.max(1).ilog2() as usize + 1, stride }
    }

    pub(super) fn level(self) -> usize {
        self.words * self.stride
    }

    pub(super) fn row(self) -> usize {
        self.level() * self.levels
    }

    /// Where cell `x` of a row lies: the first word of its plane, and its bit there.
    pub(super) fn plane(self, x: usize) -> (usize, usize) {
        // Strides are powers of two: no division.
        ((x & (self.stride - 1)) * self.words, x >> self.stride.trailing_zeros())
    }

    /// Recomputes the higher levels of a row for cells that can see `from..to`.
    pub(super) fn lift(self, line: &mut [u64], (from, to): (usize, usize)) {
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
