//! Pieces on the grid of the local search.

use std::sync::{Arc, OnceLock};

use glam::{DMat2, DVec2};

use super::blocks::block_runs;
use super::grid::{Grid, Run};
use super::proxy::depth_costs;
use crate::packing::mask::Mask;
use crate::packing::orientation::Orientation;
use crate::packing::outline::Outline;

/// Runs of blocks that a scan looks at, for each position.
const SCANNED_RUNS: usize = 16;

/// One piece in one orientation, rasterised.
#[derive(Debug)]
pub(super) struct RasterizedItem {
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

impl RasterizedItem {
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
        RasterizedItem { orientation, linear, anchor, mask, wide, runs, cost: OnceLock::new(), blocks: OnceLock::new() }
    }

    /// By cell of the mask's box: 0 outside, else what an overlap there costs. Most items are tried and dropped before anybody asks.
    pub fn cost(&self) -> &[u8] {
        self.cost.get_or_init(|| depth_costs(&self.mask))
    }

    /// The runs of blocks that the piece and its gutter cover for the most part, and the rows between two positions worth trying. Of high
    /// pieces some rows stand for all.
    pub fn blocks(&self, block: usize) -> (&[Run], usize) {
        let (runs, step) = self.blocks.get_or_init(|| {
            let mut runs = block_runs(&self.runs, block as i32);
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

/// The pieces on one grid: what all searches share.
pub(super) struct InstanceSet<'a> {
    pub outlines: &'a [Outline],
    pub grid: Grid,
    /// By piece, the orientations that scans choose from; empty where pieces only move a little.
    pub candidates: Vec<Vec<Arc<RasterizedItem>>>,
    /// By piece, whether it turns by any angle.
    pub rotates: Vec<bool>,
}

/// A piece on the sheet: rasterised, and the cell of its mask's corner.
#[derive(Debug, Clone)]
pub(super) struct PlacedItem {
    pub item: Arc<RasterizedItem>,
    pub x: i32,
    pub y: i32,
}

impl PlacedItem {
    /// The mask's corner, in cells.
    pub fn corner(&self) -> DVec2 {
        DVec2::new(f64::from(self.x), f64::from(self.y))
    }

    /// Twice the centre of the box.
    pub fn centre(&self) -> [i32; 2] {
        [2 * self.x + self.item.width(), 2 * self.y + self.item.height()]
    }

    /// An item with its box about this centre (doubled), on the lattice.
    pub fn centred(item: Arc<RasterizedItem>, centre: [i32; 2], grid: &Grid) -> Self {
        let x = grid.snap((centre[0] - item.width()).div_euclid(2));
        let y = grid.snap((centre[1] - item.height()).div_euclid(2));
        PlacedItem { item, x, y }
    }
}
