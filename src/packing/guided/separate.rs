//! Takes overlapping pieces apart inside a box: guided local search.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use super::field::Field;
use super::form::{Form, Grid, shared};
use crate::context::Context;
use crate::error::Result;
use crate::packing::orientation::Orientation;
use crate::packing::outline::Outline;
use crate::packing::random::Random;

/// The weight of a pair that never overlapped for long, and the largest.
const UNIT_WEIGHT: i32 = 16;
const MAX_WEIGHT: f64 = 4096.0;
/// Factors on the weights of pairs after each pass, as in Gardeyn and Wauters (2025): apart, least and most overlapping.
const DECAY: f64 = 0.95;
const GROWTH: [f64; 2] = [1.2, 2.0];
/// Orientations of which a scan of the whole box tries every position, for each move.
const SCANNED: usize = 4;
/// Places of a scan that are looked at closely.
const CLOSER: usize = 3;
/// Angles tried for a piece that does not fit the box.
const TURNS: u32 = 24;
/// A pass counts as progress when less than this part of the least overlap so far is left.
const PROGRESS: f64 = 0.98;

/// The pieces on one grid: what all walkers share.
pub(super) struct Stock<'a> {
    pub outlines: &'a [Outline],
    pub grid: Grid,
    /// Orientations that scans choose from, by piece; empty where pieces only move a little.
    pub pool: Vec<Vec<Arc<Form>>>,
    /// Whether pieces turn by any angle.
    pub turns: bool,
    /// Cells that the pieces own between them.
    pub cells: f64,
}

/// A piece on the sheet: its form, and the cell of its mask's corner.
#[derive(Debug, Clone)]
pub(super) struct Placed {
    pub form: Arc<Form>,
    pub x: i32,
    pub y: i32,
}

impl Placed {
    /// Twice the centre of the box.
    pub fn centre(&self) -> [i32; 2] {
        [2 * self.x + self.form.width(), 2 * self.y + self.form.height()]
    }
}

/// A piece's prices by blocks, for scans.
#[derive(Debug, Default)]
struct Patch {
    x: i32,
    y: i32,
    width: usize,
    prices: Vec<i32>,
}

/// One walker's table: a box, the pieces in it, and what their overlaps weigh.
pub(super) struct Table<'a> {
    pub stock: &'a Stock<'a>,
    pub placed: Vec<Placed>,
    pub random: Random,
    /// Words looked at.
    pub work: u64,
    /// Pieces looked at because they overlapped.
    pub moves: u64,
    width: i32,
    height: i32,
    patches: Vec<Patch>,
    weights: Vec<i32>,
    shared: Vec<u32>,
    near: Field,
    far: Field,
}

/// The best place so far of the piece that moves.
struct Best {
    cost: f32,
    placed: Placed,
}

impl<'a> Table<'a> {
    pub fn new(stock: &'a Stock<'a>, placed: Vec<Placed>, random: Random) -> Self {
        let n = placed.len();
        Table {
            stock,
            placed,
            random,
            work: 0,
            moves: 0,
            width: 0,
            height: 0,
            patches: (0..n).map(|_| Patch::default()).collect(),
            weights: vec![UNIT_WEIGHT; n * n],
            shared: vec![0; n * n],
            near: Field::default(),
            far: Field::default(),
        }
    }

    /// Moves the pieces, which lie anyhow, until none overlap in a box of `width` x `height` cells. Gives up, with `false`, when
    /// `patience` passes in a row brought no progress or the work reaches `limit`.
    pub fn separate(
        &mut self,
        width: i32,
        height: i32,
        patience: usize,
        limit: u64,
        context: &Context,
    ) -> Result<bool> {
        (self.width, self.height) = (width, height);
        // So that boxes that are refused at once count too.
        self.work += 2000;
        if !self.enter() {
            return Ok(false);
        }
        self.weights.fill(UNIT_WEIGHT);
        let n = self.placed.len();
        let (mut least, mut stale) = (f64::INFINITY, 0);
        loop {
            let mut crowded: Vec<usize> = (0..n).filter(|&i| self.overlap_of(i) > 0).collect();
            if crowded.is_empty() {
                return Ok(true);
            }
            let total: f64 = crowded.iter().map(|&i| self.overlap_of(i) as f64).sum();
            if total < least * PROGRESS {
                (least, stale) = (total, 0);
            } else {
                stale += 1;
            }
            if stale > patience || self.work > limit || context.out_of_time() {
                return Ok(false);
            }
            for k in (1..crowded.len()).rev() {
                crowded.swap(k, self.random.below(k + 1));
            }
            for i in crowded {
                context.check()?;
                if self.overlap_of(i) > 0 {
                    self.relocate(i);
                    self.moves += 1;
                }
            }
            self.reweigh();
        }
    }

    /// Brings all pieces into the box; false when one has no form that fits.
    fn enter(&mut self) -> bool {
        for i in 0..self.placed.len() {
            let (width, height) = (self.width, self.height);
            let fits = |f: &Form| f.width() <= width && f.height() <= height;
            if !fits(&self.placed[i].form) {
                let narrower = self.narrower(i);
                let others: Vec<&Arc<Form>> = self.stock.pool[i].iter().filter(|f| fits(f)).collect();
                let centre = self.placed[i].centre();
                if let Some(orientation) = narrower {
                    self.placed[i] = self.form(i, orientation, centre);
                } else if !others.is_empty() {
                    let form = others[self.random.below(others.len())].clone();
                    self.placed[i] = centred(form, centre, &self.stock.grid);
                }
                if !fits(&self.placed[i].form) {
                    return false;
                }
            }
            let (w, h) = (self.width, self.height);
            let placed = &mut self.placed[i];
            placed.x = self.stock.grid.snap(placed.x.clamp(0, w - placed.form.width()));
            placed.y = self.stock.grid.snap(placed.y.clamp(0, h - placed.form.height()));
        }
        for i in 0..self.placed.len() {
            self.lay(i);
            self.compare(i, i);
        }
        true
    }

    /// An angle near the present one at which the piece fits the box.
    fn narrower(&mut self, i: usize) -> Option<Orientation> {
        if !self.stock.turns {
            return None;
        }
        let grid = &self.stock.grid;
        let Orientation { angle, mirror } = self.placed[i].form.orientation;
        for k in 1..=TURNS {
            let far = 0.4 * (f64::from(k) / f64::from(TURNS)).powi(2);
            let turn = far * (2.0 * self.random.unit() - 1.0);
            let next = Orientation { angle: (angle + turn).rem_euclid(TAU), mirror };
            let sides = self.stock.outlines[i].sides(next.matrix() * grid.scale) / grid.cell;
            self.work += self.stock.outlines[i].work() / 8;
            if sides.x + 0.1 < f64::from(self.width) && sides.y + 0.1 < f64::from(self.height) {
                return Some(next);
            }
        }
        None
    }

    fn overlap_of(&self, i: usize) -> u64 {
        let n = self.placed.len();
        self.shared[i * n..(i + 1) * n].iter().map(|s| u64::from(*s)).sum()
    }

    /// Recomputes the shared cells of piece `i` and the pieces before `end`, and all others unless `end` is `i`.
    fn compare(&mut self, i: usize, end: usize) {
        let n = self.placed.len();
        let g = self.stock.grid.gutter as i32;
        let a = &self.placed[i];
        let (w, h) = (a.form.width() + g, a.form.height() + g);
        for j in 0..end {
            if j == i {
                continue;
            }
            let b = &self.placed[j];
            let (dx, dy) = (b.x - a.x, b.y - a.y);
            let apart = dx >= w || dy >= h || -dx >= b.form.width() + g || -dy >= b.form.height() + g;
            let cells = if apart { 0 } else { shared(&a.form.wide, &b.form.mask, dx + g, dy + g) };
            if !apart {
                self.work += (h.min(b.form.height()) as u64 * (w.min(b.form.width()) as u64).div_ceil(64)) / 2;
            }
            self.shared[i * n + j] = cells;
            self.shared[j * n + i] = cells;
        }
    }

    /// Weights grow with the overlap that persists, and fade where there is none.
    fn reweigh(&mut self) {
        let most = f64::from(self.shared.iter().copied().max().unwrap_or(0).max(1));
        for (weight, &shared) in self.weights.iter_mut().zip(&self.shared) {
            if shared == 0 {
                if *weight > UNIT_WEIGHT {
                    *weight = (f64::from(*weight) * DECAY).max(f64::from(UNIT_WEIGHT)) as i32;
                }
            } else {
                let factor = GROWTH[0] + (GROWTH[1] - GROWTH[0]) * f64::from(shared) / most;
                *weight = (f64::from(*weight) * factor + 1.0).min(MAX_WEIGHT) as i32;
            }
        }
    }

    /// Moves a piece to the cheapest place found: near where it is, slightly turned, or anywhere in the box.
    fn relocate(&mut self, i: usize) {
        let from = self.placed[i].clone();
        let reach = self.stock.grid.block.max(3) as i32;
        let Some(here) = self.look(i, &from, 0, f32::INFINITY) else { return };
        let mut best = here;
        self.improve(i, &from, reach, &mut best);
        if best.cost > 0.0 && self.stock.turns && self.random.below(2) == 0 {
            let turned = self.turned(i, &from);
            self.improve(i, &turned, reach, &mut best);
        }
        if best.cost > 0.0 && !self.stock.pool[i].is_empty() {
            for place in self.scan(i, &from) {
                self.improve(i, &place, reach, &mut best);
            }
        }
        let best = best.placed;
        if (best.x, best.y) != (from.x, from.y) || !Arc::ptr_eq(&best.form, &from.form) {
            self.placed[i] = best;
            self.lay(i);
            self.compare(i, self.placed.len());
        }
    }

    fn improve(&mut self, i: usize, around: &Placed, reach: i32, best: &mut Best) {
        if best.cost > 0.0
            && let Some(found) = self.look(i, around, reach, best.cost)
        {
            *best = found;
        }
    }

    /// The cheapest place of a form within `reach` cells, if it is cheaper than `bound`.
    fn look(&mut self, i: usize, around: &Placed, reach: i32, bound: f32) -> Option<Best> {
        let grid = &self.stock.grid;
        let (g, stride) = (grid.gutter as i32, grid.stride as i32);
        let form = &around.form;
        let room = [self.width - form.width(), self.height - form.height()];
        if room[0] < 0 || room[1] < 0 {
            return None;
        }
        let range = |at: i32, room: i32| {
            let steps = if reach == 0 { 0 } else { reach.max(stride) };
            let first = grid.snap((at - steps).clamp(0, room));
            (first, grid.snap((at + steps).clamp(0, room)).max(first))
        };
        let (x, y) = (range(around.x, room[0]), range(around.y, room[1]));
        let (left, top) = (x.0 - g, y.0 - g);
        let (w, h) = (x.1 + form.width() + g - left, y.1 + form.height() + g - top);
        self.near.reset(left, top, w as usize, h as usize);
        let n = self.placed.len();
        let mut touched = (w * h) as u64;
        for (j, other) in self.placed.iter().enumerate() {
            if j != i {
                let weight = self.weights[i * n + j];
                touched += self.near.add(other.form.cost(), other.form.mask.width, other.x, other.y, weight);
            }
        }
        self.near.sum_up();
        let (found, looked) = self.near.cheapest(&form.runs, x, y, (grid.stride, grid.stride), bound);
        self.work += touched / 8 + looked / 6;
        found.map(|f| Best { cost: f.cost, placed: Placed { form: form.clone(), x: f.x, y: f.y } })
    }

    /// The piece turned a little about its centre.
    fn turned(&mut self, i: usize, from: &Placed) -> Placed {
        // From about a cell at the rim up to several degrees: small angles far more often.
        let radius = 0.5 * f64::from(from.form.width().max(from.form.height())).max(8.0);
        let most: f64 = if self.stock.pool[i].is_empty() { 6.0 / radius } else { 0.3 };
        let least = 0.7 / radius;
        let size = least * (most / least).max(1.0).powf(self.random.unit());
        let sign = if self.random.below(2) == 0 { -1.0 } else { 1.0 };
        let Orientation { angle, mirror } = from.form.orientation;
        let mut angle = (angle + sign * size).rem_euclid(TAU);
        // Straight pieces find their way back to the axes.
        let quarter = (angle / FRAC_PI_2).round() * FRAC_PI_2;
        if (angle - quarter).abs() < 0.5 * least {
            angle = quarter.rem_euclid(TAU);
        }
        self.form(i, Orientation { angle, mirror }, from.centre())
    }

    /// A new form, centred where the piece is.
    fn form(&mut self, i: usize, orientation: Orientation, centre: [i32; 2]) -> Placed {
        let outline = &self.stock.outlines[i];
        let form = Arc::new(Form::new(outline, orientation, &self.stock.grid));
        self.work += outline.work() + 20 * form.runs.len() as u64;
        centred(form, centre, &self.stock.grid)
    }

    /// The best places of a scan over the whole box, by blocks, in a few of the pool's orientations.
    fn scan(&mut self, i: usize, from: &Placed) -> Vec<Placed> {
        let block = self.stock.grid.block as i32;
        let pad = self.stock.grid.gutter as i32 / block + 2;
        let (w, h) = (self.width / block + 1 + 2 * pad, self.height / block + 1 + 2 * pad);
        self.far.reset(-pad, -pad, w as usize, h as usize);
        let n = self.placed.len();
        let mut touched = (w * h) as u64;
        for (j, patch) in self.patches.iter().enumerate() {
            if j != i {
                touched += self.far.add(&patch.prices, patch.width, patch.x, patch.y, self.weights[i * n + j]);
            }
        }
        self.far.sum_up();
        self.work += touched / 8;
        let pool = &self.stock.pool[i];
        let mut found: Vec<(f32, Placed)> = Vec::new();
        for k in 0..SCANNED {
            let form = if k == 0 { &from.form } else { &pool[self.random.below(pool.len())] };
            let room = [self.width - form.width(), self.height - form.height()];
            if room[0] < 0 || room[1] < 0 {
                continue;
            }
            let last = room.map(|r| r / block);
            let bound = if found.len() < CLOSER { f32::INFINITY } else { found[CLOSER - 1].0 };
            let (runs, step) = form.blocks(block as usize);
            let (place, looked) = self.far.cheapest(runs, (0, last[0]), (0, last[1]), (1, step), bound);
            self.work += looked / 6;
            if let Some(p) = place {
                let placed = Placed { form: form.clone(), x: p.x * block, y: p.y * block };
                found.push((p.cost, placed));
                found.sort_by(|a, b| a.0.total_cmp(&b.0));
            }
        }
        found.truncate(CLOSER);
        found.into_iter().map(|(_, placed)| placed).collect()
    }

    /// Recomputes the patch of a piece that has moved.
    fn lay(&mut self, i: usize) {
        let block = self.stock.grid.block as i32;
        if block <= 1 {
            return;
        }
        let Placed { form, x, y } = &self.placed[i];
        let patch = &mut self.patches[i];
        (patch.x, patch.y) = (x.div_euclid(block), y.div_euclid(block));
        patch.width = ((x + form.width() - 1).div_euclid(block) - patch.x + 1) as usize;
        let height = ((y + form.height() - 1).div_euclid(block) - patch.y + 1) as usize;
        patch.prices.clear();
        patch.prices.resize(patch.width * height, 0);
        let w = form.mask.width;
        for (row, line) in form.cost().chunks_exact(w).enumerate() {
            let at = ((y + row as i32).div_euclid(block) - patch.y) as usize * patch.width;
            let sums = &mut patch.prices[at..at + patch.width];
            let mut rest = line;
            let mut length = (block - x.rem_euclid(block)) as usize;
            for sum in sums {
                let (now, later) = rest.split_at(length.min(rest.len()));
                *sum += now.iter().map(|c| i32::from(*c)).sum::<i32>();
                (rest, length) = (later, block as usize);
            }
        }
        self.work += form.cells() as u64 / 8;
    }

    /// Sides of the box that the pieces need, from the origin.
    pub fn extent(&self) -> (i32, i32) {
        let far = |f: &dyn Fn(&Placed) -> i32| self.placed.iter().map(f).max().unwrap_or(0);
        (far(&|p| p.x + p.form.width()), far(&|p| p.y + p.form.height()))
    }
}

/// A form with its box about this centre (doubled), on the lattice.
pub(super) fn centred(form: Arc<Form>, centre: [i32; 2], grid: &Grid) -> Placed {
    let x = grid.snap((centre[0] - form.width()).div_euclid(2));
    let y = grid.snap((centre[1] - form.height()).div_euclid(2));
    Placed { form, x, y }
}
