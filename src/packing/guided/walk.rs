//! One walk through layouts: a box a little smaller than the best, again and again, with leaps where that fails.

use super::goal::Goal;
use super::separate::{Placed, Stock, Table, centred};
use crate::context::Context;
use crate::error::Result;
use crate::packing::random::Random;

/// How a walk steps.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gait {
    /// Part of the sheet's area that the first step takes away, and the least.
    pub first: f64,
    pub least: f64,
    /// Passes without progress after which a box is given up.
    pub patience: usize,
    /// How far the aspect may change in a step (natural logarithm).
    pub drift: f64,
    /// Failures in a row after which pieces are thrown about.
    pub failures: u32,
}

/// A layout without overlaps.
#[derive(Debug, Clone)]
pub(super) struct Feasible {
    pub placed: Vec<Placed>,
    pub width: i32,
    pub height: i32,
    pub cost: f64,
}

/// A walker and the best that it found.
pub(super) struct Walker {
    pub best: Option<Feasible>,
    pub random: Random,
    pub work: u64,
    step: f64,
    failed: u32,
}

impl Walker {
    pub fn new(best: Option<Feasible>, seed: u64, gait: &Gait) -> Self {
        Walker { best, random: Random::new(seed), work: 0, step: gait.first, failed: 0 }
    }

    /// Takes the pieces apart in a box of `width` x `height` cells, or one a little larger, to start from.
    pub fn enter(
        &mut self,
        stock: &Stock<'_>,
        goal: &Goal,
        gait: &Gait,
        start: (Vec<Placed>, i32, i32),
        limit: u64,
        context: &Context,
    ) -> Result<()> {
        let (placed, width, height) = start;
        let mut table = Table::new(stock, placed, self.random.clone());
        for slack in [1.0, 1.02, 1.06] {
            let larger = |side: i32| (f64::from(side) * slack).ceil() as i32;
            if table.separate(larger(width), larger(height), gait.patience, table.work + limit, context)? {
                self.best = Some(settled(&table, goal));
                break;
            }
        }
        self.work += table.work;
        self.random = table.random;
        Ok(())
    }

    /// Walks until `quota` words more were looked at, or nothing smaller is possible.
    pub fn walk(&mut self, stock: &Stock<'_>, goal: &Goal, gait: &Gait, quota: u64, context: &Context) -> Result<()> {
        let Some(mut best) = self.best.take() else { return Ok(()) };
        let mut table = Table::new(stock, best.placed.clone(), self.random.clone());
        let mut refused = 0;
        while table.work < quota && !context.out_of_time() && refused < 20 {
            context.check()?;
            let leap = self.failed >= gait.failures && !stock.pool.iter().all(Vec::is_empty);
            let step = if leap { gait.least } else { self.step };
            let Some((width, height)) = goal.shrink(best.width, best.height, step, gait.drift, &mut table.random)
            else {
                self.step = (self.step * 0.5).max(gait.least);
                refused += 1;
                continue;
            };
            let moves = table.moves;
            table.placed.clone_from(&best.placed);
            fold(&mut table, (best.width, best.height), (width, height));
            if leap {
                exchange(&mut table);
            }
            if table.separate(width, height, gait.patience, quota + quota / 4, context)? {
                best = settled(&table, goal);
                self.step = (self.step * 1.5).min(0.03);
                self.failed = 0;
            } else {
                self.step = (self.step * 0.6).max(gait.least);
                self.failed += 1;
            }
            // A piece that fits no smaller box in any way ends the walk.
            refused = if table.moves == moves { refused + 1 } else { 0 };
        }
        self.best = Some(best);
        self.work += table.work;
        self.random = table.random;
        Ok(())
    }
}

/// The table's layout, moved to the origin.
fn settled(table: &Table<'_>, goal: &Goal) -> Feasible {
    let least = |f: &dyn Fn(&Placed) -> i32| table.stock.grid.snap(table.placed.iter().map(f).min().unwrap_or(0));
    let (x, y) = (least(&|p| p.x), least(&|p| p.y));
    let (w, h) = table.extent();
    let mut placed = table.placed.clone();
    for p in &mut placed {
        p.x -= x;
        p.y -= y;
    }
    let (width, height) = (w - x, h - y);
    Feasible { placed, width, height, cost: goal.cost(width, height) }
}

/// Brings the pieces of one box into another: where it is a little smaller, what lies beyond a random line moves over it, so that overlaps
/// arise in one place (Gardeyn and Wauters, 2025, section 5.2); else all centres move in proportion.
fn fold(table: &mut Table<'_>, from: (i32, i32), to: (i32, i32)) {
    for axis in 0..2 {
        let (old, new) = if axis == 0 { (from.0, to.0) } else { (from.1, to.1) };
        let line = table.random.below(2 * old as usize) as i32;
        let near = (old - new).abs() * 50 < old;
        for p in &mut table.placed {
            let centre = p.centre()[axis];
            let by = if !near {
                (f64::from(centre) * (f64::from(new) / f64::from(old) - 1.0) / 2.0) as i32
            } else if centre > line {
                new - old
            } else {
                0
            };
            if axis == 0 { p.x += by } else { p.y += by }
        }
    }
}

/// Exchanges two large pieces of similar size, or throws one anywhere, each in any of its orientations.
fn exchange(table: &mut Table<'_>) {
    let n = table.placed.len();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(table.placed[i].form.cells()), i));
    let large = n.div_ceil(2);
    let a = table.random.below(large);
    let b = (a + 1 + table.random.below(3)).min(n - 1);
    let (i, j) = (order[a], order[b]);
    let (at, other) = (table.placed[i].centre(), table.placed[j].centre());
    let moves = if i == j || table.random.below(3) == 0 { vec![(i, at)] } else { vec![(i, other), (j, at)] };
    for (piece, centre) in moves {
        let pool = &table.stock.pool[piece];
        if !pool.is_empty() {
            let form = pool[table.random.below(pool.len())].clone();
            table.placed[piece] = centred(form, centre, &table.stock.grid);
        }
    }
}
