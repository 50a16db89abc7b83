//! A piece in one orientation on the grid of the guided search.

use std::sync::OnceLock;

use glam::{DMat2, DVec2};

use crate::packing::mask::Mask;
use crate::packing::orientation::Orientation;
use crate::packing::{Request, Spacing};

use crate::packing::outline::Outline;

/// A cell on the rim of a piece counts this much, the deepest one `RIM + CORE`: a piece inside another then feels which way
/// out is the shortest, which the bare area of the overlap does not tell.
const RIM: usize = 4;
const CORE: usize = 12;

/// Runs of blocks that a scan looks at, for each position.
const SCANNED_RUNS: usize = 16;

/// The cells of one level of the search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    /// Texels per cell.
    pub cell: f64,
    /// Free cells between two pieces.
    pub gutter: usize,
    /// Positions are multiples of this many cells.
    pub stride: usize,
    /// Whether masks start on the lattice.
    pub on_lattice: bool,
    /// Cells along the side of a block of the coarse scan.
    pub block: usize,
    /// Factor on all pieces.
    pub scale: f64,
}

impl Grid {
    /// The grid with this cell, as the pieces of a greedy search have it.
    pub fn new(request: &Request<'_>, cell: f64, block: usize) -> Self {
        let Spacing { gutter, lattice, .. } = request.spacing;
        Grid {
            cell,
            gutter: (gutter / cell - 1e-9).ceil().max(0.0) as usize,
            stride: lattice.map_or(1, |l| ((l / cell).round() as usize).max(1)),
            on_lattice: lattice.is_some(),
            block,
            scale: request.scale,
        }
    }

    /// The multiple of the stride at or below `x`.
    pub fn snap(&self, x: i32) -> i32 {
        x - x.rem_euclid(self.stride as i32)
    }
}

/// Consecutive cells of a row, relative to the piece's corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Run {
    pub row: i32,
    pub first: i32,
    /// One past the last cell.
    pub end: i32,
}

/// One piece in one orientation.
#[derive(Debug)]
pub(super) struct Form {
    pub orientation: Orientation,
    /// Rotation, mirror and scale.
    pub linear: DMat2,
    /// What is subtracted from turned coordinates (texels) so that the mask's corner is the origin.
    pub anchor: DVec2,
    /// Cells owned.
    pub mask: Mask,
    /// Cells owned and the gutter around them; its corner is `gutter` cells before the mask's.
    pub wide: Mask,
    /// The runs of `wide`.
    pub runs: Vec<Run>,
    cost: OnceLock<Vec<u8>>,
    blocks: OnceLock<(Vec<Run>, usize)>,
}

impl Form {
    pub fn new(outline: &Outline, orientation: Orientation, grid: &Grid) -> Self {
        let linear = orientation.matrix() * grid.scale;
        let (mask, anchor) = outline.raster(linear, grid.cell, grid.on_lattice.then_some(grid.stride));
        let g = grid.gutter as i32;
        let wide = mask.dilated(grid.gutter);
        let runs: Vec<Run> = wide
            .runs()
            .into_iter()
            .map(|(row, first, last)| Run { row: row as i32 - g, first: first as i32 - g, end: last as i32 + 1 - g })
            .collect();
        Form { orientation, linear, anchor, mask, wide, runs, cost: OnceLock::new(), blocks: OnceLock::new() }
    }

    /// By cell of the mask's box: 0 outside, else what an overlap there costs. Most forms are tried and dropped before anybody asks.
    pub fn cost(&self) -> &[u8] {
        self.cost.get_or_init(|| costs(&self.mask))
    }

    /// The runs of blocks that the piece and its gutter cover for the most part, and the rows between two positions worth trying. Of high
    /// pieces some rows stand for all.
    pub fn blocks(&self, block: usize) -> (&[Run], usize) {
        let (runs, step) = self.blocks.get_or_init(|| {
            let mut runs = blocks(&self.runs, block as i32);
            let every = (runs.len() / SCANNED_RUNS).max(1) as i32;
            let top = runs.first().map_or(0, |r| r.row);
            runs.retain(|r| (r.row - top) % every == every / 2);
            (runs, (every as usize / 2).max(1))
        });
        (runs, *step)
    }

    /// Cells of the mask's box.
    pub fn cells(&self) -> usize {
        self.mask.width * self.mask.height
    }

    pub fn width(&self) -> i32 {
        self.mask.width as i32
    }

    pub fn height(&self) -> i32 {
        self.mask.height as i32
    }
}

/// By cell, its price: the distance to the outside (in steps along the axes), scaled to the piece's deepest.
fn costs(mask: &Mask) -> Vec<u8> {
    let (w, h) = (mask.width, mask.height);
    let mut depth = vec![0u16; w * h];
    for (row, first, last) in mask.runs() {
        depth[row as usize * w + first as usize..=row as usize * w + last as usize].fill(u16::MAX);
    }
    let mut deepest = 1;
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            if depth[i] > 0 {
                let left = if x > 0 { depth[i - 1] } else { 0 };
                let above = if y > 0 { depth[i - w] } else { 0 };
                depth[i] = left.min(above).saturating_add(1);
            }
        }
    }
    for y in (0..h).rev() {
        for x in (0..w).rev() {
            let i = y * w + x;
            if depth[i] > 0 {
                let right = if x + 1 < w { depth[i + 1] } else { 0 };
                let below = if y + 1 < h { depth[i + w] } else { 0 };
                depth[i] = depth[i].min(right.min(below).saturating_add(1));
                deepest = deepest.max(depth[i]);
            }
        }
    }
    let price: Vec<u8> = (0..=usize::from(deepest))
        .map(|d| if d == 0 { 0 } else { (RIM + CORE * (d - 1) / usize::from(deepest).max(2)) as u8 })
        .collect();
    depth.into_iter().map(|d| price[usize::from(d)]).collect()
}

/// The runs of blocks of which at least a third is covered; of slivers, which fill no block, every block touched.
fn blocks(runs: &[Run], block: i32) -> Vec<Run> {
    let Some(top) = runs.iter().map(|r| r.row.div_euclid(block)).min() else { return Vec::new() };
    let bottom = runs.iter().map(|r| r.row.div_euclid(block)).max().unwrap_or(top);
    let left = runs.iter().map(|r| r.first.div_euclid(block)).min().unwrap_or(0);
    let right = runs.iter().map(|r| (r.end - 1).div_euclid(block)).max().unwrap_or(left);
    let (w, h) = ((right - left + 1) as usize, (bottom - top + 1) as usize);
    let mut covered = vec![0i32; w * h];
    for r in runs {
        let line = (r.row.div_euclid(block) - top) as usize * w;
        let mut x = r.first;
        while x < r.end {
            let at = x.div_euclid(block);
            let end = ((at + 1) * block).min(r.end);
            covered[line + (at - left) as usize] += end - x;
            x = end;
        }
    }
    let total: i32 = covered.iter().sum();
    let mut least = block * block / 3;
    let kept: i32 = covered.iter().filter(|c| **c >= least).sum();
    if kept * 10 < total * 7 {
        least = 1;
    }
    let mut out = Vec::new();
    for y in 0..h {
        let mut x = 0;
        while x < w {
            let first = x;
            while x < w && covered[y * w + x] >= least {
                x += 1;
            }
            if x > first {
                out.push(Run { row: top + y as i32, first: left + first as i32, end: left + x as i32 });
            }
            x += 1;
        }
    }
    out
}

/// Cells that `a` and `b` share, when `b`'s corner is `(dx, dy)` cells from `a`'s.
pub(super) fn shared(a: &Mask, b: &Mask, dx: i32, dy: i32) -> u32 {
    if dx < 0 {
        return shared(b, a, -dx, -dy);
    }
    let (rows, skip) = (dy.max(0) as usize, (-dy).max(0) as usize);
    let (offset, shift) = (dx as usize / 64, dx as usize % 64);
    if dx as usize >= a.width || rows >= a.height || skip >= b.height {
        return 0;
    }
    let mut count = 0;
    for row in 0..(a.height - rows).min(b.height - skip) {
        let mine = &a.row(rows + row)[offset..];
        let theirs = b.row(skip + row);
        let mut carried = 0;
        for (i, &word) in mine.iter().enumerate() {
            let next = theirs.get(i).copied().unwrap_or(0);
            // The bits of b that fall on this word of a.
            let here = if shift == 0 { next } else { next << shift | carried };
            carried = if shift == 0 { 0 } else { next >> (64 - shift) };
            count += (word & here).count_ones();
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    fn blob(random: &mut Random) -> Mask {
        let mut mask = Mask::new(1 + random.below(150), 1 + random.below(20));
        for row in 0..mask.height {
            let a = random.below(mask.width);
            mask.set_run(row, a, a + random.below(mask.width - a));
        }
        mask
    }

    #[test]
    fn shared_cells_are_those_that_testing_each_cell_finds() {
        let mut random = Random::new(11);
        for _ in 0..500 {
            let (a, b) = (blob(&mut random), blob(&mut random));
            let (dx, dy) = (random.below(320) as i32 - 160, random.below(44) as i32 - 22);
            let mut count = 0;
            for y in 0..b.height {
                for x in 0..b.width {
                    let (i, j) = (x as i32 + dx, y as i32 + dy);
                    let inside = i >= 0 && j >= 0 && (i as usize) < a.width && (j as usize) < a.height;
                    count += u32::from(inside && b.get(x, y) && a.get(i as usize, j as usize));
                }
            }
            assert_eq!(shared(&a, &b, dx, dy), count, "{dx} {dy}");
        }
    }

    #[test]
    fn deeper_cells_cost_more() {
        let mut mask = Mask::new(9, 9);
        (0..9).for_each(|row| mask.set_run(row, 0, 8));
        let cost = costs(&mask);
        assert_eq!(usize::from(cost[0]), RIM);
        assert!(cost[0] < cost[2 * 9 + 4] && cost[2 * 9 + 4] < cost[4 * 9 + 4]);
    }
}
