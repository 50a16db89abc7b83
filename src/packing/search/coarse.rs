//! The coarse search: which order, width and rule of construction is best.

use rayon::prelude::*;

use super::{FAST_PART, RULES, Search};
use crate::error::Result;
use crate::packing::PackSearch;
use crate::packing::greedy::{Plan, greedy};
use crate::packing::random::Random;
use crate::packing::shape::Shapes;
use crate::packing::tuning::Frontiers;

/// The best plans that are kept, and those that mutations begin with.
const KEPT: usize = 4;
const PARENTS: usize = 3;
/// Layouts of different widths that the thorough search keeps, and how much their widths differ at least (natural logarithm).
const DIVERSE: usize = 8;
const APART: f64 = 0.05;
/// The widest strip considered, relative to its height, where the aspect is free, and how many widths down to its inverse.
const WIDEST: f64 = 4.0;
const WIDTHS: u32 = 13;
/// Where the aspect is given: widths, the least relative to that of a sheet of the expected area, and the step between two.
const WIDTHS_AT_ASPECT: u32 = 10;
const NARROWEST: f64 = 0.92;
const WIDTH_STEP: f64 = 0.05;
/// Words that a plan costs beside those that its construction looks at, for each piece.
const PLAN_WORK: u64 = 50;

/// What the coarse search brought.
#[derive(Default)]
pub(super) struct CoarseResult {
    /// The best plans, by cost.
    pub best: Vec<Evaluated>,
    /// The best plans of different widths, by cost: of the thorough search alone.
    pub diverse: Vec<Evaluated>,
    pub work: u64,
}

/// A plan and what it came to.
#[derive(Clone)]
pub(super) struct Evaluated {
    pub plan: Plan,
    pub cost: f64,
    pub work: u64,
    pub width: usize,
    /// By piece, the orientation chosen.
    pub chosen: Vec<u32>,
}

impl Search<'_> {
    /// Orders, widths and rules, then mutations of the best, within the budget of work.
    pub(super) fn coarse(&self, shapes: &Shapes, phase: PackSearch) -> Result<CoarseResult> {
        let all = self.request.budget(self.tuning);
        let budget = match (self.request.search, phase) {
            (PackSearch::Fast, _) => all,
            (_, PackSearch::Fast) => (all * FAST_PART).min(self.tuning.coarse_work * self.request.effort),
            (_, PackSearch::Thorough) => all * self.tuning.construction_part,
        } as u64;
        let limit = self.limit(0, shapes);
        let narrowest =
            shapes.of_piece.iter().map(|own| own.iter().map(|s| s.mask.width).min().unwrap_or(1)).max().unwrap_or(1);
        let mut found = CoarseResult::default();
        for batch in self.first_plans(shapes, narrowest, limit).chunks(self.tuning.batch) {
            self.evaluate(shapes, batch.to_vec(), phase, &mut found)?;
            if found.work > budget / 2 && !found.best.is_empty() {
                break;
            }
        }
        let mut random = Random::stream(self.context.seed, u64::from(phase == PackSearch::Thorough));
        while found.work < budget
            && !found.best.is_empty()
            && self.request.pieces.len() > 1
            && !self.context.out_of_time()
        {
            let best = &found.best;
            let height = self.limit(1, shapes);
            let parent = |k: usize| &best[k % best.len().min(PARENTS)].plan;
            let batch = (0..self.tuning.batch)
                .map(|k| Plan { height, ..mutate(parent(k), narrowest, limit, &mut random) })
                .collect();
            self.evaluate(shapes, batch, phase, &mut found)?;
            self.context.step(0.1 + 0.5 * (found.work as f64 / budget as f64), "searching")?;
        }
        Ok(found)
    }

    /// Every order on every width by the first two rules, widths near the square first: an interrupted search has tried them.
    fn first_plans(&self, shapes: &Shapes, narrowest: usize, limit: usize) -> Vec<Plan> {
        let side = self.side;
        let mut widths: Vec<usize> = match self.request.aspect {
            Some(aspect) => (0..WIDTHS_AT_ASPECT)
                .map(|k| side * aspect.sqrt() * (NARROWEST + WIDTH_STEP * f64::from(k)) / shapes.cell)
                .map(|w| w as usize)
                .collect(),
            None => (0..WIDTHS)
                .map(|k| side / WIDEST.sqrt() * WIDEST.powf(f64::from(k) / f64::from(WIDTHS - 1)) / shapes.cell)
                .map(|w| w as usize)
                .collect(),
        };
        for w in &mut widths {
            *w = (*w).max(narrowest).min(limit);
        }
        widths.dedup();
        let height = self.limit(1, shapes);
        let frontiers = self.tuning.frontiers != Frontiers::Nowhere;
        // A piece that is alone lies the same on every strip.
        if self.request.pieces.len() == 1 {
            widths = vec![narrowest.min(limit)];
        }
        let mut plans = Vec::new();
        let mut orders = self.orders(shapes);
        if let [first, ..] = orders.as_slice()
            && orders.iter().all(|order| order == first)
        {
            orders.truncate(1);
        }
        for order in &orders {
            for &width in &widths {
                for &rule in &RULES[..2] {
                    plans.push(Plan { order: order.clone(), width, height, rule, partial: false, frontiers });
                }
            }
        }
        plans.sort_by_key(|p| p.width.abs_diff((side / shapes.cell) as usize));
        plans
    }

    /// Runs plans in parallel and keeps the best, in a fixed order.
    fn evaluate(&self, shapes: &Shapes, plans: Vec<Plan>, phase: PackSearch, found: &mut CoarseResult) -> Result<()> {
        self.context.check()?;
        let CoarseResult { best, diverse, work } = found;
        // Nothing worse than the worst that is kept need be finished.
        let thorough = phase == PackSearch::Thorough;
        let (kept, of) = if thorough { (DIVERSE, &*diverse) } else { (KEPT, &*best) };
        let worst = of.last().filter(|_| of.len() >= kept).map(|t| t.cost);
        let evaluated: Vec<Evaluated> = plans
            .into_par_iter()
            .map(|mut plan| {
                if let Some(cost) = worst {
                    plan.height = plan.height.min(self.height_at(cost, plan.width, shapes));
                }
                let (layout, _) = greedy(shapes, &plan, &|| self.stopped());
                let chosen = layout.spots.iter().map(|s| s.map_or(0, |s| s.orientation)).collect();
                Evaluated { cost: self.cost(&layout, shapes), work: layout.work, width: layout.width, chosen, plan }
            })
            .collect();
        for t in evaluated {
            *work += t.work + PLAN_WORK * t.plan.order.len() as u64;
            if thorough && t.cost.is_finite() {
                diversify(diverse, &t);
            }
            if t.cost.is_finite() && !best.iter().any(|b| b.cost == t.cost && b.width == t.width) {
                best.push(t);
            }
        }
        best.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        best.truncate(KEPT);
        self.context.check()
    }

    /// Orders to start from: by area, by the longest side, by area of the bounding box, by perimeter.
    pub(super) fn orders(&self, shapes: &Shapes) -> Vec<Vec<u32>> {
        let key = |f: &dyn Fn(usize) -> f64| {
            let mut order: Vec<u32> = (0..self.request.pieces.len() as u32).collect();
            let keys: Vec<f64> = (0..order.len()).map(f).collect();
            order.sort_by(|&a, &b| keys[b as usize].total_cmp(&keys[a as usize]).then(a.cmp(&b)));
            order
        };
        let boxes = |p: usize| {
            let s = &shapes.of_piece[p][0].mask;
            (s.width as f64, s.height as f64)
        };
        vec![
            key(&|p| shapes.of_piece[p][0].cells as f64),
            key(&|p| boxes(p).0.max(boxes(p).1)),
            key(&|p| boxes(p).0 * boxes(p).1),
            key(&|p| boxes(p).0 + boxes(p).1),
        ]
    }
}

/// Keeps the plan if it is the best of its width; the list stays in order and short.
fn diversify(diverse: &mut Vec<Evaluated>, plan: &Evaluated) {
    let near = |t: &Evaluated| (t.width as f64 / plan.width.max(1) as f64).ln().abs() < APART;
    if diverse.iter().any(|t| near(t) && t.cost <= plan.cost) {
        return;
    }
    diverse.retain(|t| !near(t));
    diverse.push(plan.clone());
    diverse.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    diverse.truncate(DIVERSE);
}

/// A plan like this one, with pieces exchanged, another width or another rule.
fn mutate(plan: &Plan, narrowest: usize, limit: usize, random: &mut Random) -> Plan {
    let mut next = plan.clone();
    let n = next.order.len();
    for _ in 0..1 + random.below(2) {
        match random.below(8) {
            0 => next.rule = RULES[random.below(RULES.len())],
            1 | 2 => {
                let change = 1.0 + (random.unit() - 0.5) * 0.12;
                next.width = ((next.width as f64 * change).round() as usize).clamp(narrowest.min(limit), limit);
            }
            3..=5 => {
                let a = random.below(n);
                let b = (a + 1 + random.below(n.div_ceil(4))).min(n - 1);
                next.order.swap(a, b);
            }
            _ => {
                let a = random.below(n);
                let piece = next.order.remove(a);
                next.order.insert(random.below(n), piece);
            }
        }
    }
    next
}
