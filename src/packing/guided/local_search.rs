//! One local search: a container a little smaller than that of the best layout, again and again, with disruptions where that fails.

use super::Level;
use super::disruption::{exchange, resize};
use super::item::PlacedItem;
use super::objective::Objective;
use super::overlap::OverlapMinimizer;
use crate::context::Context;
use crate::error::Result;
use crate::packing::random::Random;

/// The largest part of the sheet's area that a step takes away.
const LARGEST_STEP: f64 = 0.03;
/// Factors on the step after a success, a failure, and a container that the objective refuses.
const AFTER_SUCCESS: f64 = 1.5;
const AFTER_FAILURE: f64 = 0.6;
const AFTER_REFUSAL: f64 = 0.5;
/// Containers refused in a row that end a search.
const REFUSALS: u32 = 20;
/// Factors on the sides of a start, until the pieces come apart.
const SLACKS: [f64; 3] = [1.0, 1.02, 1.06];

/// By how much the container shrinks from step to step.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShrinkSchedule {
    /// Part of the sheet's area that the first step takes away, and the least.
    pub first: f64,
    pub least: f64,
    /// Passes without progress after which a container is given up.
    pub patience: usize,
    /// How far the aspect may change in a step (natural logarithm).
    pub drift: f64,
    /// Failures in a row after which the layout is disrupted.
    pub failures: u32,
}

/// A layout without overlaps.
#[derive(Debug, Clone)]
pub(super) struct FeasibleLayout {
    pub placed: Vec<PlacedItem>,
    pub width: i32,
    pub height: i32,
    pub cost: f64,
}

/// A search and the best that it found.
pub(super) struct LocalSearch {
    pub best: Option<FeasibleLayout>,
    pub random: Random,
    pub work: u64,
    step: f64,
    failed: u32,
}

impl LocalSearch {
    pub fn new(seed: u64, schedule: &ShrinkSchedule) -> Self {
        LocalSearch { best: None, random: Random::new(seed), work: 0, step: schedule.first, failed: 0 }
    }

    /// Takes the pieces of a start apart in a container of its size, or one a little larger.
    pub fn make_feasible(
        &mut self,
        Level { instances, objective }: &Level<'_>,
        schedule: &ShrinkSchedule,
        start: (Vec<PlacedItem>, i32, i32),
        limit: u64,
        context: &Context,
    ) -> Result<()> {
        let (placed, width, height) = start;
        let mut minimizer = OverlapMinimizer::new(instances, placed, self.random.clone());
        for slack in SLACKS {
            let larger = |side: i32| (f64::from(side) * slack).ceil() as i32;
            let limit = minimizer.work + limit;
            if minimizer.minimize(larger(width), larger(height), schedule.patience, limit, context)? {
                self.best = Some(feasible(&minimizer, objective));
                break;
            }
        }
        self.work += minimizer.work;
        self.random = minimizer.random;
        Ok(())
    }

    /// Shrinks the container until `quota` words more were looked at, or nothing smaller is possible.
    pub fn run(
        &mut self,
        Level { instances, objective }: &Level<'_>,
        schedule: &ShrinkSchedule,
        quota: u64,
        context: &Context,
    ) -> Result<()> {
        let Some(mut best) = self.best.take() else { return Ok(()) };
        let mut minimizer = OverlapMinimizer::new(instances, best.placed.clone(), self.random.clone());
        let mut refused = 0;
        while minimizer.work < quota && !context.out_of_time() && refused < REFUSALS {
            context.check()?;
            let disrupts = self.failed >= schedule.failures && !instances.candidates.iter().all(Vec::is_empty);
            let step = if disrupts { schedule.least } else { self.step };
            let Some((width, height)) =
                objective.shrink(best.width, best.height, step, schedule.drift, &mut minimizer.random)
            else {
                self.step = (self.step * AFTER_REFUSAL).max(schedule.least);
                refused += 1;
                continue;
            };
            let moves = minimizer.moves;
            minimizer.placed.clone_from(&best.placed);
            resize(&mut minimizer, (best.width, best.height), (width, height));
            if disrupts {
                exchange(&mut minimizer);
            }
            if minimizer.minimize(width, height, schedule.patience, quota + quota / 4, context)? {
                best = feasible(&minimizer, objective);
                self.step = (self.step * AFTER_SUCCESS).min(LARGEST_STEP);
                self.failed = 0;
            } else {
                self.step = (self.step * AFTER_FAILURE).max(schedule.least);
                self.failed += 1;
            }
            // A piece that fits no smaller container in any way ends the search.
            refused = if minimizer.moves == moves { refused + 1 } else { 0 };
        }
        self.best = Some(best);
        self.work += minimizer.work;
        self.random = minimizer.random;
        Ok(())
    }
}

/// A layout whose overlaps are gone, moved to the origin.
fn feasible(minimizer: &OverlapMinimizer<'_>, objective: &Objective) -> FeasibleLayout {
    let least = |f: &dyn Fn(&PlacedItem) -> i32| {
        minimizer.instances.grid.snap(minimizer.placed.iter().map(f).min().unwrap_or(0))
    };
    let (x, y) = (least(&|p| p.x), least(&|p| p.y));
    let (w, h) = minimizer.extent();
    let mut placed = minimizer.placed.clone();
    for p in &mut placed {
        p.x -= x;
        p.y -= y;
    }
    let (width, height) = (w - x, h - y);
    FeasibleLayout { placed, width, height, cost: objective.cost(width, height) }
}
