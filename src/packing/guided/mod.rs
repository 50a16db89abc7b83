//! The thorough search: layouts are improved by taking overlaps apart in ever smaller sheets.
//!
//! Literature: Egeblad, Nielsen and Odgaard, "Fast neighborhood search for two- and three-dimensional nesting problems", EJOR 183 (2007):
//! overlap as the objective of a guided local search, pairs of pieces weighted by how long they have overlapped; Gardeyn and Wauters,
//! "An open-source heuristic to reboot 2D nesting research" (2025, arXiv 2509.13329): the growth of the weights, the schedule of shrinking,
//! restarts with large pieces exchanged.
//!
//! Deviations: pieces are bitmaps, so that one pass over running sums prices *all* positions near a place, or by blocks all positions of
//! the sheet, where the papers follow a line or sample; the sheet shrinks in both directions, since its aspect is free; angles are
//! continuous where any rotation is allowed. A walk on a middling grid finds the arrangement, then ever finer grids take up the slack
//! that coarser cells left between the pieces.

mod field;
mod form;
mod goal;
mod separate;
#[cfg(test)]
mod tests;
mod walk;

use std::sync::Arc;

use glam::DVec2;
use rayon::prelude::*;

use self::form::{Form, Grid};
use self::goal::Goal;
use self::separate::{Placed, Stock};
use self::walk::{Feasible, Gait, Walker};
use super::orientation::Orientation;
use super::outline::Outline;
use super::random::Random;
use super::{Packing, Placement, Request};
use crate::context::Context;
use crate::error::Result;
use crate::packing::Rotation;

/// By number of pieces: cells along the side of a square that would hold everything, along the side of a block, and walkers to start with.
const SIDE: [(usize, f64, usize, usize); 6] = [
    (6, 320.0, 6, 8),
    (20, 400.0, 6, 8),
    (60, 480.0, 6, 4),
    (150, 600.0, 6, 3),
    (400, 896.0, 8, 2),
    (usize::MAX, 1280.0, 8, 2),
];
/// Cells along that side on the finest grid.
const FINEST: f64 = 1800.0;
/// Rounds of the walk: the part of the budget that each takes, and how many walkers go on after it.
const ROUNDS: [(f64, usize); 4] = [(0.15, 8), (0.15, 4), (0.15, 3), (0.25, 2)];
/// Walkers that go on to the finer grids.
const POLISHED: usize = 2;

const WALK: Gait = Gait { first: 0.01, least: 0.002, patience: 40, drift: 0.15, failures: 4 };
const POLISH: Gait = Gait { first: 0.004, least: 0.0004, patience: 12, drift: 0.01, failures: u32::MAX };

/// A layout to start from.
#[derive(Debug, Clone)]
pub struct Start {
    /// By piece, how it is turned and where the corner of its box lies, in texels.
    pub places: Vec<(Orientation, DVec2)>,
    /// Sides of the box, in texels.
    pub sides: [f64; 2],
}

/// Everything that the search is told.
pub(super) struct Guided<'a> {
    pub request: &'a Request<'a>,
    /// By piece, its outline.
    pub outlines: &'a [Outline],
    /// By piece, the orientations that scans try.
    pub ways: &'a [Vec<Orientation>],
    pub context: &'a Context,
    /// Side of a square that would hold everything, in texels.
    pub side: f64,
    /// Words that may be looked at.
    pub budget: u64,
    /// The cell size at or above a wanted one that keeps whole texels where they must be kept.
    pub cell: &'a (dyn Fn(f64) -> f64 + Sync),
}

impl Guided<'_> {
    /// The best packing found from these starts, and its cost; `None` where none of them can be taken apart.
    pub fn run(&self, starts: &[Start]) -> Result<Option<(f64, Packing)>> {
        let n = self.request.pieces.len();
        let (_, side, block, most) = *SIDE.iter().find(|(limit, ..)| n <= *limit).unwrap_or(&SIDE[5]);
        let starts = &starts[..starts.len().min(most)];
        let mut grid = Grid::new(self.request, (self.cell)(self.side / side), block);
        let mut stock = self.stock(grid, true);
        let mut goal = Goal::new(self.request, grid.cell, stock.cells);
        let mut seeds = Random::stream(self.context.seed, 0x67);
        let mut walkers: Vec<Walker> = starts.iter().map(|_| Walker::new(None, seeds.next(), &WALK)).collect();
        let limit = self.budget / 10 / starts.len().max(1) as u64;
        walkers.par_iter_mut().zip(starts).try_for_each(|(walker, start)| {
            walker.enter(&stock, &goal, &WALK, self.begin(start, &grid), limit, self.context)
        })?;
        let mut work: u64 = walkers.iter().map(|w| w.work).sum();
        for (round, (part, keep)) in ROUNDS.into_iter().enumerate() {
            order(&mut walkers, keep);
            let quota = (self.budget as f64 * part) as u64 / walkers.len().max(1) as u64;
            self.context.step(0.1 + 0.15 * round as f64, "improving")?;
            work += self.round(&mut walkers, &stock, &goal, &WALK, quota)?;
        }
        // Ever finer cells: each time the pieces fit a little closer.
        let mut levels = Vec::new();
        let mut cell = grid.cell;
        loop {
            let next = (self.cell)((cell / 2.0).max(self.side / FINEST));
            if next >= cell * 0.9 {
                break;
            }
            levels.push(next);
            cell = next;
        }
        for (k, &cell) in levels.iter().enumerate() {
            order(&mut walkers, POLISHED);
            self.context.step(0.7 + 0.3 * k as f64 / levels.len() as f64, "closing up")?;
            let finer = Grid::new(self.request, cell, 1);
            stock = self.stock(finer, false);
            goal = Goal::new(self.request, cell, stock.cells);
            let quota = self.budget.saturating_sub(work) / (levels.len() - k) as u64 / walkers.len().max(1) as u64;
            let seeds: Vec<u64> = walkers.iter().map(|_| seeds.next()).collect();
            walkers = walkers
                .into_par_iter()
                .zip(seeds)
                .map(|(w, seed)| {
                    let mut next = Walker::new(None, seed, &POLISH);
                    if let Some(best) = &w.best {
                        next.enter(&stock, &goal, &POLISH, self.refined(best, &grid, &finer), quota, self.context)?;
                    }
                    Ok(next)
                })
                .collect::<Result<_>>()?;
            work += walkers.iter().map(|w| w.work).sum::<u64>();
            work += self.round(&mut walkers, &stock, &goal, &POLISH, quota)?;
            grid = finer;
        }
        order(&mut walkers, 1);
        Ok(walkers
            .into_iter()
            .next()
            .and_then(|w| w.best)
            .map(|best| (best.cost, self.packing(&best, &grid, &goal, work))))
    }

    /// Lets all walkers walk on; returns the work done.
    fn round(&self, walkers: &mut [Walker], stock: &Stock<'_>, goal: &Goal, gait: &Gait, quota: u64) -> Result<u64> {
        walkers
            .par_iter_mut()
            .map(|w| {
                let before = w.work;
                w.walk(stock, goal, gait, quota, self.context)?;
                Ok(w.work - before)
            })
            .collect::<Result<Vec<u64>>>()
            .map(|done| done.into_iter().sum())
    }

    fn stock(&self, grid: Grid, scans: bool) -> Stock<'_> {
        let form = |piece: usize, o: &Orientation| Arc::new(Form::new(&self.outlines[piece], *o, &grid));
        let first: Vec<usize> =
            self.ways.par_iter().enumerate().map(|(p, own)| form(p, &own[0]).mask.count()).collect();
        let pool = |p: usize| if scans { self.ways[p].par_iter().map(|o| form(p, o)).collect() } else { Vec::new() };
        Stock {
            outlines: self.outlines,
            grid,
            pool: (0..self.ways.len()).into_par_iter().map(pool).collect(),
            turns: self.request.rotation == Rotation::Any,
            // Other orientations may own a few cells less.
            cells: 0.97 * first.iter().sum::<usize>() as f64,
        }
    }

    /// A start on the grid.
    fn begin(&self, start: &Start, grid: &Grid) -> (Vec<Placed>, i32, i32) {
        let place = |(piece, (orientation, at)): (usize, &(Orientation, DVec2))| {
            let form = Arc::new(Form::new(&self.outlines[piece], *orientation, grid));
            let cell = (*at / grid.cell).round();
            Placed { form, x: cell.x as i32, y: cell.y as i32 }
        };
        let placed = start.places.par_iter().enumerate().map(place).collect();
        let [w, h] = start.sides.map(|s| (s / grid.cell).ceil() as i32);
        (placed, w, h)
    }

    /// A layout on a finer grid.
    fn refined(&self, best: &Feasible, from: &Grid, to: &Grid) -> (Vec<Placed>, i32, i32) {
        let place = |(piece, old): (usize, &Placed)| {
            let form = Arc::new(Form::new(&self.outlines[piece], old.form.orientation, to));
            // The anchors differ by where the masks start.
            let corner = DVec2::new(f64::from(old.x), f64::from(old.y)) * from.cell + form.anchor - old.form.anchor;
            let cell = (corner / to.cell).round();
            Placed { form, x: to.snap(cell.x as i32), y: to.snap(cell.y as i32) }
        };
        let placed = best.placed.par_iter().enumerate().map(place).collect();
        let cells = |side: i32| (f64::from(side) * from.cell / to.cell).ceil() as i32;
        (placed, cells(best.width), cells(best.height))
    }

    fn packing(&self, best: &Feasible, grid: &Grid, goal: &Goal, work: u64) -> Packing {
        let place = |p: &Placed| {
            let corner =
                DVec2::new(f64::from(p.x), f64::from(p.y)) * grid.cell + DVec2::splat(self.request.spacing.margin);
            Placement { page: 0, linear: p.form.linear, translate: corner - p.form.anchor }
        };
        let placements = best.placed.iter().map(place).collect();
        Packing { placements, sheets: vec![goal.sheet(best.width, best.height)], work }
    }
}

/// The walkers from the best on; only `keep` of those that have a layout.
fn order(walkers: &mut Vec<Walker>, keep: usize) {
    walkers.retain(|w| w.best.is_some());
    let cost = |w: &Walker| w.best.as_ref().map_or(f64::INFINITY, |b| b.cost);
    walkers.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    walkers.truncate(keep);
}
