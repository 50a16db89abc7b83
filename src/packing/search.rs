//! The search over plans, coarse first, then fine.

use glam::DVec2;
use rayon::prelude::*;

use super::greedy::{Layout, Plan, Rule, Spot, Table, greedy, settle};
use super::guided::{Guided, Start};
use super::orientation::{Angles, Orientation, orientations};
use super::outline::Outline;
use super::random::Random;
use super::shape::Shapes;
use super::{Packing, Placement, Request};
use crate::context::Context;
use crate::error::{Code, Failure, Result};
use crate::packing::PackSearch;

/// Cells along the side of a square that would hold everything, in the coarse search, by number of pieces.
const COARSE_SIDE: [(usize, f64); 5] = [(6, 256.0), (12, 160.0), (60, 224.0), (300, 352.0), (usize::MAX, 512.0)];
/// The same at the fine resolution, where whole texels do not stop it earlier.
const FINE_SIDE: [(usize, f64); 3] = [(6, 3072.0), (300, 2048.0), (usize::MAX, 1792.0)];
/// Words that the coarse search may look at; about half a second on two cores.
const COARSE_WORK: f64 = 8e7;
/// Words that the thorough search may look at; about ten seconds on two cores.
const THOROUGH_WORK: f64 = 2e9;
/// The part of it that goes to the greedy search for starts.
const GREEDY_PART: f64 = 0.08;
/// The same for more than `MANY` pieces, among which walks find little.
const MANY_PART: f64 = 0.6;
pub(super) const MANY: usize = 300;
/// Layouts of different widths that the thorough search starts from, and how much their widths differ at least (natural logarithm).
const STARTS: usize = 8;
const APART: f64 = 0.05;
/// The part of `COARSE_WORK` for more than `MANY` pieces, whose coarse plans are compared by greedy runs that look for like pieces only from
/// where the last one was found.
const ROUGH_PART: f64 = 0.3;
/// Of more pieces than this the fast search makes the fine layout in the same way: twice as fast, for one texel in a hundred.
const HURRIED: usize = 1000;
/// Of more than this every search does, from so many coarse plans at once, and only of the best.
const THOUSANDS: usize = 5000;
const THOUSANDS_BATCH: usize = 4;
/// Plans evaluated at once: fixed, so that the result does not depend on the number of threads.
const BATCH: usize = 16;
/// Coarse plans that are built at the fine resolution, by number of pieces.
const FINALISTS: usize = 4;
const FINALISTS_OF_MANY: [(usize, usize); 3] = [(1000, FINALISTS), (THOUSANDS, 2), (usize::MAX, 1)];
/// Up to so many pieces keep to the orientations of the coarse plans at the fine resolution; of more, small ones fill holes better
/// with all of theirs.
const NARROWED: usize = 60;
/// Rules that the search chooses from.
const RULES: [Rule; 3] = [
    Rule { growth: 4.0, top: 1.0, low: 0.0 },
    Rule { growth: 4.0, top: 0.0, low: 1.0 },
    Rule { growth: 4.0, top: 0.5, low: 0.5 },
];
/// The widest strip considered, relative to its height, where the aspect is free.
const WIDEST: f64 = 4.0;

/// The entry for so many; the last one's limit is that of its type.
fn by_count<T: Copy>(table: &[(usize, T)], n: usize) -> T {
    table[table.partition_point(|(limit, _)| *limit < n)].1
}

/// Angles for a piece by its share of the area and its place in the order of areas: large pieces decide the sheet's size.
fn angles(share: f64, rank: usize) -> Angles {
    match rank {
        0..6 if share > 0.1 => Angles::Several(11),
        0..14 => Angles::Several(3),
        14..200 => Angles::Several(1),
        _ => Angles::Axes,
    }
}

/// Packs the pieces on as few and as small sheets as the search finds.
///
/// # Errors
/// `too_large` when a piece fits on no sheet; `canceled`.
pub fn pack(request: &Request<'_>, context: &Context) -> Result<Packing> {
    let n = request.pieces.len();
    if n == 0 {
        return Ok(Packing { placements: Vec::new(), sheets: Vec::new(), work: 0 });
    }
    let mut by_area: Vec<usize> = (0..n).collect();
    by_area.sort_by(|&a, &b| request.pieces[b].area.total_cmp(&request.pieces[a].area).then(a.cmp(&b)));
    let mut rank = vec![0; n];
    for (r, &piece) in by_area.iter().enumerate() {
        rank[piece] = r;
    }
    let total = request.pieces.iter().map(|p| p.area).sum::<f64>().max(1e-12);
    let ways: Vec<Vec<Orientation>> = request
        .pieces
        .par_iter()
        .zip(&rank)
        .map(|(p, &rank)| orientations(p, request.rotation, request.mirror, angles(p.area / total, rank)))
        .collect();
    let side = (total * request.scale.powi(2) / 0.7).sqrt().max(1e-6);
    let longest = request.pieces.iter().map(|p| p.diagonal() * request.scale).fold(0.0, f64::max);
    let span = 3.0 * side + longest + 64.0 * request.spacing.unit;
    let outlines: Vec<Outline> = request.pieces.par_iter().map(Outline::new).collect();
    Search { request, outlines: &outlines, ways: &ways, context, side, span }.run()
}

impl Request<'_> {
    /// Words that the fast search may look at by default.
    fn coarse_work(&self) -> f64 {
        if self.pieces.len() > MANY { COARSE_WORK * ROUGH_PART } else { COARSE_WORK }
    }

    /// Words that the search may look at.
    fn budget(&self) -> f64 {
        let own = match self.search {
            PackSearch::Fast => self.coarse_work(),
            PackSearch::Thorough => THOROUGH_WORK,
        };
        self.work_budget.map_or(own, |words| words as f64) * self.effort
    }
}

struct Search<'a> {
    request: &'a Request<'a>,
    /// By piece.
    outlines: &'a [Outline],
    ways: &'a [Vec<Orientation>],
    context: &'a Context,
    /// Side of a square that would hold everything at a good density, in texels.
    side: f64,
    /// No strip is longer or wider than this many texels, unless everything is spread over pages.
    span: f64,
}

/// What the coarse search brought.
#[derive(Default)]
struct Found {
    /// The best plans, by cost.
    best: Vec<Tried>,
    /// The best plans of different widths, by cost.
    starts: Vec<Tried>,
    work: u64,
}

/// A plan and what it came to.
#[derive(Clone)]
struct Tried {
    plan: Plan,
    cost: f64,
    work: u64,
    width: usize,
    /// By piece, the orientation chosen.
    chosen: Vec<u32>,
}

impl Search<'_> {
    fn run(&self) -> Result<Packing> {
        let side = self.side;
        let n = self.request.pieces.len();
        if n > 1
            && self.request.search == PackSearch::Thorough
            && !self.request.starts.is_empty()
            && let Some((_, packing)) = self.improved(self.request.starts, self.request.budget() as u64)?
        {
            return Ok(packing);
        }
        let coarse = self.shapes(self.ways, self.cell(side / by_count(&COARSE_SIDE, n)), self.span);
        self.context.step(0.1, "searching")?;
        let Found { best: mut tried, mut work, .. } = self.coarse(&coarse, PackSearch::Fast)?;
        tried.truncate(by_count(&FINALISTS_OF_MANY, n));
        let mut starts = Vec::new();
        if self.request.search == PackSearch::Thorough && n > 1 {
            let found = self.coarse(&coarse, PackSearch::Thorough)?;
            work += found.work;
            starts = found.starts;
            // Of many pieces no walk changes much: more plans are worth more.
            tried.extend(found.best.into_iter().take(if n > MANY { FINALISTS } else { 0 }));
        }
        let widest = tried.iter().map(|t| t.width).max().unwrap_or(0) as f64 * coarse.cell;
        let fine_cell = self.cell(side / by_count(&FINE_SIDE, n));
        // Of many pieces all orientations are tried again.
        let fine = if fine_cell == coarse.cell && n > NARROWED {
            None
        } else {
            Some(self.shapes(&self.narrowed(&tried), fine_cell, widest + fine_cell))
        };
        let fine = fine.as_ref().unwrap_or(&coarse);
        self.context.step(0.6, "placing")?;
        let frontiers = n > if self.request.search == PackSearch::Fast { HURRIED } else { THOUSANDS };
        let mut best: Option<(f64, Layout, Table<'_>)> = None;
        let finals: Vec<Result<(f64, Layout, Table<'_>)>> = tried
            .par_iter()
            .map(|t| {
                self.context.check()?;
                let ratio = coarse.cell / fine.cell;
                let width = ((t.width as f64 * ratio).ceil() as usize).min(self.limit(0, fine));
                let height = (self.limit(1, fine))
                    .min((self.height_for(t.cost, t.width, &coarse) as f64 * ratio * 1.3) as usize + 64);
                let plan = Plan { width, height, partial: false, frontiers, ..t.plan.clone() };
                let (mut layout, mut table) = greedy(fine, &plan, &|| self.stopped());
                if layout.left_over.is_empty() && n <= MANY {
                    settle(&mut table, &mut layout, 2, &|| self.stopped());
                }
                self.context.check()?;
                Ok((self.cost(&layout, fine), layout, table))
            })
            .collect();
        for result in finals {
            let (cost, layout, table) = result?;
            work += layout.work;
            if !layout.left_over.is_empty() || best.as_ref().is_some_and(|(least, ..)| cost >= *least) {
                continue;
            }
            best = Some((cost, layout, table));
        }
        // Of many pieces only the best layout is worth settling.
        if let Some((cost, layout, table)) = best.as_mut().filter(|_| n > MANY) {
            work -= layout.work;
            settle(table, layout, 1, &|| self.stopped());
            self.context.check()?;
            work += layout.work;
            *cost = self.cost(layout, fine);
        }
        self.context.step(0.95, "placing")?;
        let Some((cost, layout, _)) = best else {
            return self.pages(&self.shapes(self.ways, fine_cell, self.span), work);
        };
        let packing = self.one_sheet(&layout, fine, work);
        if starts.is_empty() {
            return Ok(packing);
        }
        let starts: Vec<Start> = starts.par_iter().filter_map(|t| self.start(&coarse, t)).collect();
        Ok(match self.improved(&starts, (self.request.budget() as u64).saturating_sub(work))? {
            Some((least, better)) if least < cost => Packing { work: work + better.work, ..better },
            Some((_, worse)) => Packing { work: work + worse.work, ..packing },
            None => packing,
        })
    }

    /// Whether the job was canceled.
    fn stopped(&self) -> bool {
        self.context.check().is_err()
    }

    /// The best that the thorough search makes of these layouts, and its cost.
    fn improved(&self, starts: &[Start], budget: u64) -> Result<Option<(f64, Packing)>> {
        let Search { request, outlines, ways, context, side, .. } = *self;
        let cell = &|wanted| self.cell(wanted);
        Guided { request, outlines, ways, context, side, budget, cell }.run(starts)
    }

    /// The layout of a coarse plan, for the thorough search.
    fn start(&self, shapes: &Shapes, tried: &Tried) -> Option<Start> {
        let (layout, _) = greedy(shapes, &tried.plan, &|| self.stopped());
        let place = |(piece, spot): (usize, &Option<Spot>)| {
            let spot = (*spot)?;
            let at = DVec2::new(f64::from(spot.x), f64::from(spot.y)) * shapes.cell;
            Some((self.ways[piece][spot.orientation as usize], at))
        };
        let places = layout.spots.iter().enumerate().map(place).collect::<Option<_>>()?;
        Some(Start { places, sides: [layout.width, layout.height].map(|s| s as f64 * shapes.cell) })
    }

    /// The cell size at or above `wanted` texels that keeps whole texels where they must be kept.
    fn cell(&self, wanted: f64) -> f64 {
        let spacing = &self.request.spacing;
        if spacing.lattice.is_none() && spacing.gutter == 0.0 {
            return wanted;
        }
        let units = (wanted / spacing.unit).floor().max(1.0);
        // A lattice is met by cells that divide it or are multiples of it.
        let units = if spacing.lattice.is_some() { f64::exp2(units.log2().floor()) } else { units };
        units * spacing.unit
    }

    /// The orientations worth trying at the fine resolution: those that the finalists chose, or all where pieces are many.
    fn narrowed(&self, finalists: &[Tried]) -> Vec<Vec<Orientation>> {
        let narrow = |(piece, all): (usize, &Vec<Orientation>)| {
            if self.request.pieces.len() > NARROWED {
                return all.clone();
            }
            let mut chosen: Vec<u32> = finalists.iter().map(|t| t.chosen[piece]).collect();
            chosen.sort_unstable();
            chosen.dedup();
            chosen.into_iter().map(|k| all[k as usize]).collect()
        };
        self.ways.iter().enumerate().map(narrow).collect()
    }

    /// The pieces at a cell size, for strips up to `widest` texels wide.
    fn shapes(&self, ways: &[Vec<Orientation>], cell: f64, widest: f64) -> Shapes {
        let widest = widest.min(self.request.max[0]);
        Shapes::new(self.request.pieces, self.outlines, ways, cell, self.request.scale, &self.request.spacing, widest)
    }

    /// Longest side of a strip in cells.
    fn limit(&self, axis: usize, shapes: &Shapes) -> usize {
        let room = (self.request.max[axis] - 2.0 * self.request.spacing.margin).min(self.span);
        (room / shapes.cell + 1e-9).floor().max(0.0) as usize
    }

    /// Sides of the sheet that holds a layout, in texels.
    fn sheet(&self, layout: &Layout, shapes: &Shapes) -> [f64; 2] {
        let margin = 2.0 * self.request.spacing.margin;
        let mut w = layout.width as f64 * shapes.cell + margin;
        let mut h = layout.height as f64 * shapes.cell + margin;
        if let Some(aspect) = self.request.aspect {
            (w, h) = (w.max(h * aspect), h.max(w / aspect));
        }
        [self.request.round.up(w), self.request.round.up(h)]
    }

    fn cost(&self, layout: &Layout, shapes: &Shapes) -> f64 {
        if !layout.left_over.is_empty() {
            return f64::INFINITY;
        }
        let [w, h] = self.sheet(layout, shapes);
        // Among sheets of equal size the emptier one is better.
        w * h + 1e-6 * (layout.width * layout.height) as f64 * shapes.cell * shapes.cell
    }

    /// The height in cells at which a strip of this width costs `cost`.
    fn height_for(&self, cost: f64, width: usize, shapes: &Shapes) -> usize {
        let margin = 2.0 * self.request.spacing.margin;
        let w = self.request.round.up(width as f64 * shapes.cell + margin);
        let h = match self.request.aspect {
            Some(aspect) => (cost / aspect).sqrt(),
            None => cost / w,
        };
        ((h - margin) / shapes.cell).ceil().max(1.0) as usize
    }

    /// Orders, widths and rules, then mutations of the best, within the budget of work.
    fn coarse(&self, shapes: &Shapes, search: PackSearch) -> Result<Found> {
        // The thorough search begins exactly as the fast one, so that it is never worse.
        let all = self.request.budget();
        let part = if self.request.pieces.len() > MANY { MANY_PART } else { GREEDY_PART };
        let budget = match (self.request.search, search) {
            (PackSearch::Fast, _) => all,
            (_, PackSearch::Fast) => (all * GREEDY_PART).min(self.request.coarse_work() * self.request.effort),
            (_, PackSearch::Thorough) => all * part,
        } as u64;
        let (side, limit) = (self.side, self.limit(0, shapes));
        let narrowest =
            shapes.of_piece.iter().map(|ways| ways.iter().map(|s| s.mask.width).min().unwrap_or(1)).max().unwrap_or(1);
        let mut widths: Vec<usize> = match self.request.aspect {
            Some(aspect) => (0..10)
                .map(|k| side * aspect.sqrt() * (0.92 + 0.05 * f64::from(k)) / shapes.cell)
                .map(|w| w as usize)
                .collect(),
            None => (0..13)
                .map(|k| side / WIDEST.sqrt() * WIDEST.powf(f64::from(k) / 12.0) / shapes.cell)
                .map(|w| w as usize)
                .collect(),
        };
        for w in &mut widths {
            *w = (*w).max(narrowest).min(limit);
        }
        widths.dedup();
        let orders = self.orders(shapes);
        let mut plans = Vec::new();
        for order in &orders {
            for &width in &widths {
                for rule in &RULES[..2] {
                    plans.push(Plan {
                        order: order.clone(),
                        width,
                        height: self.limit(1, shapes),
                        rule: *rule,
                        partial: false,
                        frontiers: self.request.pieces.len() > MANY,
                    });
                }
            }
        }
        let mut found = Found::default();
        // Widths near the square first: an interrupted search has tried them.
        plans.sort_by_key(|p| p.width.abs_diff((side / shapes.cell) as usize));
        let size = if self.request.pieces.len() > THOUSANDS { THOUSANDS_BATCH } else { BATCH };
        for batch in plans.chunks(size) {
            self.evaluate(shapes, batch.to_vec(), search, &mut found)?;
            if found.work > budget / 2 && !found.best.is_empty() {
                break;
            }
        }
        let mut random = Random::stream(self.context.seed, u64::from(search == PackSearch::Thorough));
        while found.work < budget
            && !found.best.is_empty()
            && self.request.pieces.len() > 1
            && !self.context.out_of_time()
        {
            let best = &found.best;
            let height = self.limit(1, shapes);
            let batch = (0..size)
                .map(|k| Plan { height, ..mutate(&best[k % best.len().min(3)].plan, narrowest, limit, &mut random) })
                .collect();
            self.evaluate(shapes, batch, search, &mut found)?;
            self.context.step(0.1 + 0.5 * (found.work as f64 / budget as f64), "searching")?;
        }
        Ok(found)
    }

    /// Runs plans in parallel and keeps the best, in a fixed order.
    fn evaluate(&self, shapes: &Shapes, plans: Vec<Plan>, search: PackSearch, found: &mut Found) -> Result<()> {
        self.context.check()?;
        let Found { best, starts, work } = found;
        // Nothing worse than the worst that is kept need be finished.
        let thorough = search == PackSearch::Thorough;
        let kept = if thorough { STARTS } else { FINALISTS };
        let worst = if thorough { &*starts } else { &*best };
        let worst = worst.last().filter(|_| worst.len() >= kept).map(|t| t.cost);
        let tried: Vec<Tried> = plans
            .into_par_iter()
            .map(|mut plan| {
                if let Some(cost) = worst {
                    plan.height = plan.height.min(self.height_for(cost, plan.width, shapes));
                }
                let (layout, _) = greedy(shapes, &plan, &|| self.stopped());
                let chosen = layout.spots.iter().map(|s| s.map_or(0, |s| s.orientation)).collect();
                Tried { cost: self.cost(&layout, shapes), work: layout.work, width: layout.width, chosen, plan }
            })
            .collect();
        for t in tried {
            *work += t.work + 50 * t.plan.order.len() as u64;
            if thorough && t.cost.is_finite() {
                diversify(starts, &t);
            }
            if t.cost.is_finite() && !best.iter().any(|b| b.cost == t.cost && b.width == t.width) {
                best.push(t);
            }
        }
        best.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        best.truncate(FINALISTS);
        self.context.check()
    }

    /// Orders to start from: by area, by the longest side, by area of the bounding box, by perimeter.
    fn orders(&self, shapes: &Shapes) -> Vec<Vec<u32>> {
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

    fn placement(&self, shapes: &Shapes, layout: &Layout, piece: usize, page: u16) -> Option<Placement> {
        let spot = layout.spots.get(piece).copied().flatten()?;
        let shape = &shapes.of_piece[piece][spot.orientation as usize];
        let corner =
            DVec2::new(f64::from(spot.x), f64::from(spot.y)) * shapes.cell + DVec2::splat(self.request.spacing.margin);
        Some(Placement { page, linear: shape.linear, translate: corner - shape.anchor })
    }

    fn one_sheet(&self, layout: &Layout, shapes: &Shapes, work: u64) -> Packing {
        let placements = (0..self.request.pieces.len()).filter_map(|p| self.placement(shapes, layout, p, 0)).collect();
        Packing { placements, sheets: vec![self.sheet(layout, shapes)], work }
    }

    /// Fills sheets of the largest size one after the other.
    fn pages(&self, shapes: &Shapes, mut work: u64) -> Result<Packing> {
        let (width, height) = (self.limit(0, shapes), self.limit(1, shapes));
        let mut placements = vec![None; self.request.pieces.len()];
        let mut sheets = Vec::new();
        let mut rest = self.orders(shapes).swap_remove(0);
        while !rest.is_empty() {
            self.context.check()?;
            let plan = Plan {
                order: rest.clone(),
                width,
                height,
                rule: RULES[0],
                partial: true,
                frontiers: self.request.pieces.len() > MANY,
            };
            let (mut layout, mut table) = greedy(shapes, &plan, &|| self.stopped());
            self.context.check()?;
            if layout.left_over.len() == rest.len() {
                return Err(Failure::new(
                    Code::TooLarge,
                    format!(
                        "a chart does not fit on a sheet of {} x {} texels; raise texture.max_size or set texture.overflow to \"scale\"",
                        self.request.max[0], self.request.max[1]
                    ),
                ));
            }
            settle(&mut table, &mut layout, 2, &|| self.stopped());
            work += layout.work;
            let page = sheets.len() as u16;
            for (piece, slot) in placements.iter_mut().enumerate() {
                if layout.spots[piece].is_some() {
                    *slot = self.placement(shapes, &layout, piece, page);
                }
            }
            sheets.push(self.sheet(&layout, shapes));
            rest = std::mem::take(&mut layout.left_over);
        }
        Ok(Packing { placements: placements.into_iter().flatten().collect(), sheets, work })
    }
}

/// Keeps the plan if it is the best of its width; the list stays in order and short.
fn diversify(starts: &mut Vec<Tried>, tried: &Tried) {
    let near = |t: &Tried| (t.width as f64 / tried.width.max(1) as f64).ln().abs() < APART;
    if starts.iter().any(|t| near(t) && t.cost <= tried.cost) {
        return;
    }
    starts.retain(|t| !near(t));
    starts.push(tried.clone());
    starts.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    starts.truncate(STARTS);
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
