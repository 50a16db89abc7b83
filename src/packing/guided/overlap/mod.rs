//! Overlap minimisation: guided local search over the places of pieces in a container of fixed size.

mod blocks;
mod moves;
mod pairs;

use self::blocks::BlockCosts;
use self::pairs::PairOverlaps;
use super::cost_grid::CostGrid;
use super::item::{InstanceSet, PlacedItem, RasterizedItem};
use crate::context::Context;
use crate::error::Result;
use crate::packing::random::Random;

/// A pass counts as progress when less than this part of the least overlap so far is left.
const PROGRESS: f64 = 0.98;
/// Words that an attempt counts beside those that it looks at, so that containers that are refused at once count too.
const ATTEMPT_WORK: u64 = 2000;

/// A container, the pieces in it, and what their overlaps weigh.
pub(super) struct OverlapMinimizer<'a> {
    pub instances: &'a InstanceSet<'a>,
    pub placed: Vec<PlacedItem>,
    pub random: Random,
    /// Words looked at.
    pub work: u64,
    /// Pieces looked at because they overlapped.
    pub moves: u64,
    /// Sides of the container, in cells.
    width: i32,
    height: i32,
    overlaps: PairOverlaps,
    /// By piece.
    blocks: Vec<BlockCosts>,
    /// Costs near a piece by cells, and in the whole container by blocks: kept for their memory.
    near: CostGrid,
    far: CostGrid,
}

impl<'a> OverlapMinimizer<'a> {
    pub fn new(instances: &'a InstanceSet<'a>, placed: Vec<PlacedItem>, random: Random) -> Self {
        let n = placed.len();
        OverlapMinimizer {
            instances,
            placed,
            random,
            work: 0,
            moves: 0,
            width: 0,
            height: 0,
            overlaps: PairOverlaps::new(n),
            blocks: (0..n).map(|_| BlockCosts::default()).collect(),
            near: CostGrid::default(),
            far: CostGrid::default(),
        }
    }

    /// Moves the pieces, which lie anyhow, until none overlap in a container of `width` x `height` cells (Gardeyn and Wauters 2025,
    /// section 4). Gives up, with `false`, when `patience` passes in a row brought no progress or the work reaches `limit`.
    pub fn minimize(
        &mut self,
        width: i32,
        height: i32,
        patience: usize,
        limit: u64,
        context: &Context,
    ) -> Result<bool> {
        (self.width, self.height) = (width, height);
        self.work += ATTEMPT_WORK;
        if !self.move_inside() {
            return Ok(false);
        }
        self.overlaps.reset_weights();
        let n = self.placed.len();
        let (mut least, mut stale) = (f64::INFINITY, 0);
        loop {
            let mut overlapping: Vec<usize> = (0..n).filter(|&i| self.overlaps.of(i) > 0).collect();
            if overlapping.is_empty() {
                return Ok(true);
            }
            let total: f64 = overlapping.iter().map(|&i| self.overlaps.of(i) as f64).sum();
            if total < least * PROGRESS {
                (least, stale) = (total, 0);
            } else {
                stale += 1;
            }
            if stale > patience || self.work > limit || context.out_of_time() {
                return Ok(false);
            }
            for k in (1..overlapping.len()).rev() {
                overlapping.swap(k, self.random.below(k + 1));
            }
            for i in overlapping {
                context.check()?;
                if self.overlaps.of(i) > 0 {
                    self.move_item(i);
                    self.moves += 1;
                }
            }
            self.overlaps.update_weights();
        }
    }

    /// Brings all pieces into the container; false when one fits in no orientation.
    fn move_inside(&mut self) -> bool {
        let (width, height) = (self.width, self.height);
        let fits = |item: &RasterizedItem| item.width() <= width && item.height() <= height;
        for i in 0..self.placed.len() {
            if !fits(&self.placed[i].item) {
                let orientation = self.fitting_orientation(i);
                let others: Vec<_> = self.instances.candidates[i].iter().filter(|item| fits(item)).collect();
                let centre = self.placed[i].centre();
                if let Some(orientation) = orientation {
                    self.placed[i] = self.rasterized(i, orientation, centre);
                } else if !others.is_empty() {
                    let item = others[self.random.below(others.len())].clone();
                    self.placed[i] = PlacedItem::centred(item, centre, &self.instances.grid);
                }
                if !fits(&self.placed[i].item) {
                    return false;
                }
            }
            let placed = &mut self.placed[i];
            placed.x = self.instances.grid.snap(placed.x.clamp(0, width - placed.item.width()));
            placed.y = self.instances.grid.snap(placed.y.clamp(0, height - placed.item.height()));
        }
        for i in 0..self.placed.len() {
            self.update_blocks(i);
            self.work += self.overlaps.update(&self.placed, i, i, self.instances.grid.gutter);
        }
        true
    }

    /// Puts a piece elsewhere.
    fn place(&mut self, i: usize, placed: PlacedItem) {
        self.placed[i] = placed;
        self.update_blocks(i);
        self.work += self.overlaps.update(&self.placed, i, self.placed.len(), self.instances.grid.gutter);
    }

    fn update_blocks(&mut self, i: usize) {
        self.work += self.blocks[i].update(&self.placed[i], self.instances.grid.block);
    }

    /// Sides of the container that the pieces need, from the origin.
    pub fn extent(&self) -> (i32, i32) {
        let far = |f: &dyn Fn(&PlacedItem) -> i32| self.placed.iter().map(f).max().unwrap_or(0);
        (far(&|p| p.x + p.item.width()), far(&|p| p.y + p.item.height()))
    }
}
