//! Faces of a chart by place, for charts that change.
//!
//! A loose grid on several levels: a face lies in the one cell that its middle is in, on the level whose cells are as large as it
//! is; so adding and removing cost nothing to speak of, and a query looks half a cell further.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use glam::DVec2;

use crate::atlas::bvh::Bounds;

/// Levels: cells double from one to the next.
const LEVELS: usize = 32;

/// Maps of small whole numbers.
type IntegerMap<K, V> = HashMap<K, V, BuildHasherDefault<IntegerHasher>>;

/// The grid of one chart.
#[derive(Debug, Clone, Default)]
pub(super) struct FaceGrid {
    /// Side of the smallest cells.
    cell: f64,
    cells: IntegerMap<(u32, i32, i32), Vec<(u32, Bounds)>>,
    /// Faces by level.
    count: [u32; LEVELS],
}

impl FaceGrid {
    /// An empty grid; `cell` is the size of small faces.
    pub(super) fn new(cell: f64) -> Self {
        FaceGrid { cell, ..FaceGrid::default() }
    }

    /// The cell of a face with these bounds. Those that are not finite or far off all meet in a few cells.
    fn key(&self, bounds: &Bounds) -> (u32, i32, i32) {
        let size = bounds.size().max_element();
        let level = (size / self.cell).max(1.0).log2().ceil().clamp(0.0, (LEVELS - 1) as f64) as u32;
        let side = self.cell * f64::from(1u32 << level.min(31));
        let middle = (bounds.min + bounds.max) * (0.5 / side);
        (level, cell(middle.x), cell(middle.y))
    }

    pub(super) fn add(&mut self, face: u32, bounds: &Bounds) {
        let key = self.key(bounds);
        self.count[key.0 as usize] += 1;
        self.cells.entry(key).or_default().push((face, *bounds));
    }

    /// Takes out a face that was added with these bounds.
    pub(super) fn remove(&mut self, face: u32, bounds: &Bounds) {
        let key = self.key(bounds);
        if let Some(cell) = self.cells.get_mut(&key)
            && let Some(at) = cell.iter().position(|(f, _)| *f == face)
        {
            cell.swap_remove(at);
            self.count[key.0 as usize] -= 1;
        }
    }

    /// Calls `visit` with every face whose bounds meet `bounds`, in an order that depends only on what was done, until it says
    /// `false`. `all` are the chart's faces: they are walked, all of them, where cells would be more.
    pub(super) fn query(&self, bounds: &Bounds, all: &[u32], mut visit: impl FnMut(u32) -> bool) {
        let levels = || (0..LEVELS).filter(|&level| self.count[level] > 0);
        // Cells of a level that the query looks at: the first and the last, and how many.
        let window = |level: usize| {
            let side = self.cell * f64::from(1u32 << level.min(31));
            let half = DVec2::splat(0.5 * side);
            let (low, high) = ((bounds.min - half) / side, (bounds.max + half) / side);
            let spread = high - low + 1.0;
            (low, high, spread.x * spread.y)
        };
        let too_many = |level: usize| {
            let cells = window(level).2;
            cells > 4.0 * f64::from(self.count[level]) + 64.0 || cells.is_nan()
        };
        if levels().any(too_many) {
            all.iter().all(|face| visit(*face));
            return;
        }
        for level in levels() {
            let (low, high, _) = window(level);
            for y in cell(low.y)..=cell(high.y) {
                for x in cell(low.x)..=cell(high.x) {
                    for (face, own) in self.cells.get(&(level as u32, x, y)).into_iter().flatten() {
                        if own.meets(bounds) && !visit(*face) {
                            return;
                        }
                    }
                }
            }
        }
    }
}

/// The cell that a coordinate is in.
fn cell(at: f64) -> i32 {
    let towards_zero = at as i32;
    towards_zero.saturating_sub(i32::from(f64::from(towards_zero) > at))
}

/// A hasher for small whole numbers; nothing depends on the order in which the map would be walked.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct IntegerHasher(u64);

impl Hasher for IntegerHasher {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|b| self.write_u32(u32::from(*b)));
    }
    fn write_u32(&mut self, value: u32) {
        self.0 = (self.0.rotate_left(5) ^ u64::from(value)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 ^= self.0 >> 29;
    }
    fn write_i32(&mut self, value: i32) {
        self.write_u32(value as u32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::Rng;

    #[test]
    fn a_query_finds_all_that_meet_it() {
        let mut rng = Rng(2);
        let boxes: Vec<Bounds> = (0..400)
            .map(|i| {
                let (p, size) = (rng.point(100.0), rng.unit() * if i % 20 == 0 { 40.0 } else { 2.0 });
                Bounds { min: p, max: p + DVec2::new(size, rng.unit() * size) }
            })
            .collect();
        let mut grid = FaceGrid::new(0.5);
        boxes.iter().enumerate().for_each(|(i, b)| grid.add(i as u32, b));
        for (i, b) in boxes.iter().enumerate().step_by(3) {
            grid.remove(i as u32, b);
        }
        let left: Vec<u32> = (0..400).filter(|i| i % 3 != 0).collect();
        for query in &boxes {
            let mut found = Vec::new();
            grid.query(query, &left, |f| {
                found.push(f);
                true
            });
            found.sort_unstable();
            assert!(found.windows(2).all(|w| w[0] < w[1]));
            for &f in &left {
                assert!(!boxes[f as usize].meets(query) || found.binary_search(&f).is_ok());
            }
        }
    }
}
