//! The thorough search: layouts are improved by taking overlaps apart in ever smaller containers.
//!
//! Literature: Egeblad, Nielsen and Odgaard, "Fast neighborhood search for two- and three-dimensional nesting problems", EJOR 183 (2007):
//! overlap as the objective of a guided local search, pairs of pieces weighted by how long they have overlapped; Gardeyn and Wauters,
//! "An open-source heuristic to reboot 2D nesting research" (2025, arXiv 2509.13329): the growth of the weights, the schedule of shrinking,
//! restarts with large pieces exchanged, exploration and compression.
//!
//! Deviations: pieces are bitmaps, so that one pass over running sums gives the cost of *all* positions near a place, or by blocks of all
//! positions of the sheet, where the papers follow a line or sample; the container shrinks in both directions, since its aspect is free;
//! angles are continuous where any rotation is allowed. Exploration on a middling grid finds the arrangement, then compression on ever
//! finer grids takes up the slack that coarser cells left between the pieces.

mod blocks;
mod cost_grid;
mod disruption;
mod grid;
mod item;
mod local_search;
mod objective;
mod overlap;
mod proxy;

use std::sync::Arc;

use glam::DVec2;
use rayon::prelude::*;

use self::grid::Grid;
use self::item::{InstanceSet, PlacedItem, RasterizedItem};
use self::local_search::{FeasibleLayout, LocalSearch, ShrinkSchedule};
use self::objective::Objective;
use super::orientation::Orientation;
use super::outline::Outline;
use super::random::Random;
use super::tuning::Tuning;
use super::{Move, Packing, Request};
use crate::context::Context;
use crate::error::Result;
use crate::packing::Rotation;

/// Cells along the side of a square that would hold everything, on the finest grid.
const FINEST: f64 = 1800.0;
/// Making the starts feasible may take the budget divided by this.
const FEASIBILITY_SHARE: u64 = 10;
/// Rounds of exploration: the part of the budget that each takes, and how many searches go on in it.
const ROUNDS: [(f64, usize); 4] = [(0.15, 8), (0.15, 4), (0.15, 3), (0.25, 2)];
/// The random numbers' stream.
const STREAM: u64 = 0x67;
/// Searches that go on to the finer grids.
const COMPRESSED: usize = 2;

const EXPLORATION: ShrinkSchedule =
    ShrinkSchedule { first: 0.01, least: 0.002, patience: 40, drift: 0.15, failures: 4 };
const COMPRESSION: ShrinkSchedule =
    ShrinkSchedule { first: 0.004, least: 0.0004, patience: 12, drift: 0.01, failures: u32::MAX };

/// A layout to start from.
#[derive(Debug, Clone)]
pub struct InitialLayout {
    /// By piece, how it is turned and where the corner of its box lies, in texels.
    pub places: Vec<(Orientation, DVec2)>,
    /// Sides of the box, in texels.
    pub sides: [f64; 2],
}

/// Everything that the search is told.
pub(super) struct GuidedSearch<'a> {
    pub request: &'a Request<'a>,
    pub tuning: &'a Tuning,
    /// By piece, its outline.
    pub outlines: &'a [Outline],
    /// By piece, the orientations that scans try.
    pub orientations: &'a [Vec<Orientation>],
    pub context: &'a Context,
    /// Side of a square that would hold everything, in texels.
    pub side: f64,
    /// Words that may be looked at.
    pub budget: u64,
    /// The cell size at or above a wanted one that keeps whole texels where they must be kept.
    pub cell: &'a (dyn Fn(f64) -> f64 + Sync),
}

/// One level: the pieces on a grid, and what a container of its cells costs.
struct Level<'a> {
    instances: InstanceSet<'a>,
    objective: Objective,
}

impl GuidedSearch<'_> {
    /// The best packing found from these starts, and its cost; `None` where none of them can be taken apart.
    pub fn run(&self, starts: &[InitialLayout]) -> Result<Option<(f64, Packing)>> {
        let starts = &starts[..starts.len().min(self.tuning.starts)];
        let mut seeds = Random::stream(self.context.seed, STREAM);
        let mut level = self.level((self.cell)(self.side / self.tuning.search_side), self.tuning.block, true);
        let mut searches: Vec<LocalSearch> =
            starts.iter().map(|_| LocalSearch::new(seeds.next(), &EXPLORATION)).collect();
        let mut work = self.explore(&mut searches, starts, &level)?;
        let cells = self.finer_cells(level.instances.grid.cell);
        for (k, &cell) in cells.iter().enumerate() {
            order(&mut searches, COMPRESSED);
            self.context.step(0.7 + 0.3 * k as f64 / cells.len() as f64, "closing up")?;
            let finer = self.level(cell, 1, false);
            let quota = self.budget.saturating_sub(work) / (cells.len() - k) as u64 / searches.len().max(1) as u64;
            searches = self.refined(searches, &mut seeds, &level.instances.grid, &finer, quota)?;
            work += searches.iter().map(|s| s.work).sum::<u64>();
            work += self.round(&mut searches, &finer, &COMPRESSION, quota)?;
            level = finer;
        }
        order(&mut searches, 1);
        let best = searches.into_iter().next().and_then(|s| s.best);
        Ok(best.map(|best| (best.cost, self.packing(&best, &level, work))))
    }

    /// Makes the starts feasible and shrinks their containers round by round, on with the best alone; gives the work.
    fn explore(&self, searches: &mut Vec<LocalSearch>, starts: &[InitialLayout], level: &Level<'_>) -> Result<u64> {
        let limit = self.budget / FEASIBILITY_SHARE / starts.len().max(1) as u64;
        searches.par_iter_mut().zip(starts).try_for_each(|(search, start)| {
            let start = self.on_grid(start, &level.instances.grid);
            search.make_feasible(level, &EXPLORATION, start, limit, self.context)
        })?;
        let mut work: u64 = searches.iter().map(|s| s.work).sum();
        for (round, (part, keep)) in ROUNDS.into_iter().enumerate() {
            order(searches, keep);
            let quota = (self.budget as f64 * part) as u64 / searches.len().max(1) as u64;
            self.context.step(0.1 + 0.15 * round as f64, "improving")?;
            work += self.round(searches, level, &EXPLORATION, quota)?;
        }
        Ok(work)
    }

    /// Lets all searches go on; gives the work.
    fn round(
        &self,
        searches: &mut [LocalSearch],
        level: &Level<'_>,
        schedule: &ShrinkSchedule,
        quota: u64,
    ) -> Result<u64> {
        searches
            .par_iter_mut()
            .map(|search| {
                let before = search.work;
                search.run(level, schedule, quota, self.context)?;
                Ok(search.work - before)
            })
            .collect::<Result<Vec<u64>>>()
            .map(|done| done.into_iter().sum())
    }

    /// Searches that begin where these ended, on a finer grid.
    fn refined(
        &self,
        searches: Vec<LocalSearch>,
        seeds: &mut Random,
        from: &Grid,
        level: &Level<'_>,
        quota: u64,
    ) -> Result<Vec<LocalSearch>> {
        let seeds: Vec<u64> = searches.iter().map(|_| seeds.next()).collect();
        searches
            .into_par_iter()
            .zip(seeds)
            .map(|(search, seed)| {
                let mut next = LocalSearch::new(seed, &COMPRESSION);
                if let Some(best) = &search.best {
                    let start = self.on_finer_grid(best, from, &level.instances.grid);
                    next.make_feasible(level, &COMPRESSION, start, quota, self.context)?;
                }
                Ok(next)
            })
            .collect()
    }

    /// Ever finer cells, down to the finest: each time the pieces fit a little closer.
    fn finer_cells(&self, mut cell: f64) -> Vec<f64> {
        let mut cells = Vec::new();
        loop {
            let next = (self.cell)((cell / 2.0).max(self.side / FINEST));
            if next >= cell * 0.9 {
                return cells;
            }
            cells.push(next);
            cell = next;
        }
    }

    /// The pieces on a grid; `scans` says whether whole containers are scanned for places.
    fn level(&self, cell: f64, block: usize, scans: bool) -> Level<'_> {
        let grid = Grid::new(self.request, cell, block);
        let item = |piece: usize, o: &Orientation| Arc::new(RasterizedItem::new(&self.outlines[piece], *o, &grid));
        let owned: Vec<usize> =
            self.orientations.par_iter().enumerate().map(|(p, own)| item(p, &own[0]).mask.count()).collect();
        // Other orientations may own a few cells less.
        let cells = 0.97 * owned.iter().sum::<usize>() as f64;
        let candidates =
            |p: usize| if scans { self.orientations[p].par_iter().map(|o| item(p, o)).collect() } else { Vec::new() };
        let turns_freely = self.request.rotation == Rotation::Any;
        let instances = InstanceSet {
            outlines: self.outlines,
            grid,
            candidates: (0..self.orientations.len()).into_par_iter().map(candidates).collect(),
            rotates: self.request.pieces.iter().map(|p| turns_freely && !p.half_turns).collect(),
        };
        Level { instances, objective: Objective::new(self.request, cell, cells) }
    }

    /// A start on the grid: the pieces, and the sides of their container.
    fn on_grid(&self, start: &InitialLayout, grid: &Grid) -> (Vec<PlacedItem>, i32, i32) {
        let place = |(piece, (orientation, at)): (usize, &(Orientation, DVec2))| {
            let item = Arc::new(RasterizedItem::new(&self.outlines[piece], *orientation, grid));
            let cell = (*at / grid.cell).round();
            PlacedItem { item, x: cell.x as i32, y: cell.y as i32 }
        };
        let placed = start.places.par_iter().enumerate().map(place).collect();
        let [w, h] = start.sides.map(|s| (s / grid.cell).ceil() as i32);
        (placed, w, h)
    }

    /// A layout on a finer grid.
    fn on_finer_grid(&self, best: &FeasibleLayout, from: &Grid, to: &Grid) -> (Vec<PlacedItem>, i32, i32) {
        let place = |(piece, old): (usize, &PlacedItem)| {
            let item = Arc::new(RasterizedItem::new(&self.outlines[piece], old.item.orientation, to));
            // The anchors differ by where the masks start.
            let corner = old.corner() * from.cell + item.anchor - old.item.anchor;
            let cell = (corner / to.cell).round();
            PlacedItem { item, x: to.snap(cell.x as i32), y: to.snap(cell.y as i32) }
        };
        let placed = best.placed.par_iter().enumerate().map(place).collect();
        let cells = |side: i32| (f64::from(side) * from.cell / to.cell).ceil() as i32;
        (placed, cells(best.width), cells(best.height))
    }

    fn packing(&self, best: &FeasibleLayout, level: &Level<'_>, work: u64) -> Packing {
        let place = |p: &PlacedItem| {
            let corner = p.corner() * level.instances.grid.cell + DVec2::splat(self.request.spacing.margin);
            Move { page: 0, linear: p.item.linear, translate: corner - p.item.anchor }
        };
        let placements = best.placed.iter().map(place).collect();
        Packing { placements, sheets: vec![level.objective.sheet(best.width, best.height)], work }
    }
}

/// The searches from the best on; only `keep` of those that have a layout.
fn order(searches: &mut Vec<LocalSearch>, keep: usize) {
    searches.retain(|s| s.best.is_some());
    let cost = |s: &LocalSearch| s.best.as_ref().map_or(f64::INFINITY, |b| b.cost);
    searches.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    searches.truncate(keep);
}
