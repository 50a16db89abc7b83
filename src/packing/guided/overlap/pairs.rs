//! Which pieces overlap, by how many cells, and what each pair weighs.

use crate::packing::guided::item::PlacedItem;
use crate::packing::guided::proxy::shared_cells;

/// The weight of a pair that never overlapped for long, and the largest.
const UNIT_WEIGHT: i32 = 16;
const MAX_WEIGHT: f64 = 4096.0;
/// Factors on the weights of pairs after each pass, as in Gardeyn and Wauters (2025): apart, least and most overlapping.
const DECAY: f64 = 0.95;
const GROWTH: [f64; 2] = [1.2, 2.0];

/// By pair of pieces, both ways round: row `i` is that of piece `i`.
pub(super) struct PairOverlaps {
    pieces: usize,
    /// Cells shared.
    cells: Vec<u32>,
    weights: Vec<i32>,
}

impl PairOverlaps {
    pub fn new(pieces: usize) -> Self {
        PairOverlaps { pieces, cells: vec![0; pieces * pieces], weights: vec![UNIT_WEIGHT; pieces * pieces] }
    }

    pub fn reset_weights(&mut self) {
        self.weights.fill(UNIT_WEIGHT);
    }

    /// Cells that a piece shares with all others.
    pub fn of(&self, i: usize) -> u64 {
        self.cells[i * self.pieces..(i + 1) * self.pieces].iter().map(|s| u64::from(*s)).sum()
    }

    /// Weights of the pairs of a piece.
    pub fn weights(&self, i: usize) -> &[i32] {
        &self.weights[i * self.pieces..(i + 1) * self.pieces]
    }

    /// Recomputes the cells that piece `i` shares with the pieces before `end`; gives the work.
    pub fn update(&mut self, placed: &[PlacedItem], i: usize, end: usize, gutter: usize) -> u64 {
        let n = self.pieces;
        let g = gutter as i32;
        let a = &placed[i];
        let (w, h) = (a.item.width() + g, a.item.height() + g);
        let mut work = 0;
        for (j, b) in placed[..end].iter().enumerate() {
            if j == i {
                continue;
            }
            let (dx, dy) = (b.x - a.x, b.y - a.y);
            let apart = dx >= w || dy >= h || -dx >= b.item.width() + g || -dy >= b.item.height() + g;
            let cells = if apart { 0 } else { shared_cells(&a.item.wide, &b.item.mask, dx + g, dy + g) };
            if !apart {
                work += (h.min(b.item.height()) as u64 * (w.min(b.item.width()) as u64).div_ceil(64)) / 2;
            }
            self.cells[i * n + j] = cells;
            self.cells[j * n + i] = cells;
        }
        work
    }

    /// Weights grow with the overlap that persists, and fade where there is none.
    pub fn update_weights(&mut self) {
        let most = f64::from(self.cells.iter().copied().max().unwrap_or(0).max(1));
        for (weight, &cells) in self.weights.iter_mut().zip(&self.cells) {
            if cells == 0 {
                if *weight > UNIT_WEIGHT {
                    *weight = (f64::from(*weight) * DECAY).max(f64::from(UNIT_WEIGHT)) as i32;
                }
            } else {
                let factor = GROWTH[0] + (GROWTH[1] - GROWTH[0]) * f64::from(cells) / most;
                *weight = (f64::from(*weight) * factor + 1.0).min(MAX_WEIGHT) as i32;
            }
        }
    }
}
