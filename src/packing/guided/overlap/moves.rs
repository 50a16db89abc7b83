//! Where a piece that overlaps may go: near where it is, slightly turned, or anywhere in the container.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use super::OverlapMinimizer;
use crate::packing::guided::item::{PlacedItem, RasterizedItem};
use crate::packing::orientation::Orientation;

/// Orientations of which a scan of the whole container tries every position, for each move.
const SCANNED: usize = 4;
/// Places of a scan that are looked at closely.
const CLOSER: usize = 3;
/// Angles tried for a piece that does not fit the container, and the farthest.
const TURNS: u32 = 24;
const FARTHEST_TURN: f64 = 0.4;

/// The best place so far of the piece that moves.
struct BestPlace {
    cost: f32,
    placed: PlacedItem,
}

impl OverlapMinimizer<'_> {
    /// Moves a piece to the cheapest place found.
    pub(super) fn move_item(&mut self, i: usize) {
        let from = self.placed[i].clone();
        let reach = self.instances.grid.block.max(3) as i32;
        let Some(here) = self.cheapest_near(i, &from, 0, f32::INFINITY) else { return };
        let mut best = here;
        self.improve(i, &from, reach, &mut best);
        if best.cost > 0.0 && self.instances.rotates[i] && self.random.below(2) == 0 {
            let turned = self.turned(i, &from);
            self.improve(i, &turned, reach, &mut best);
        }
        if best.cost > 0.0 && !self.instances.candidates[i].is_empty() {
            for place in self.scan(i, &from) {
                self.improve(i, &place, reach, &mut best);
            }
        }
        let best = best.placed;
        if (best.x, best.y) != (from.x, from.y) || !Arc::ptr_eq(&best.item, &from.item) {
            self.place(i, best);
        }
    }

    fn improve(&mut self, i: usize, around: &PlacedItem, reach: i32, best: &mut BestPlace) {
        if best.cost > 0.0
            && let Some(found) = self.cheapest_near(i, around, reach, best.cost)
        {
            *best = found;
        }
    }

    /// The cheapest place of an item within `reach` cells, if it is cheaper than `bound`.
    fn cheapest_near(&mut self, i: usize, around: &PlacedItem, reach: i32, bound: f32) -> Option<BestPlace> {
        let grid = &self.instances.grid;
        let (g, stride) = (grid.gutter as i32, grid.stride as i32);
        let item = &around.item;
        let room = self.room(item)?;
        let range = |at: i32, room: i32| {
            let steps = if reach == 0 { 0 } else { reach.max(stride) };
            let first = grid.snap((at - steps).clamp(0, room));
            (first, grid.snap((at + steps).clamp(0, room)).max(first))
        };
        let (x, y) = (range(around.x, room[0]), range(around.y, room[1]));
        let (left, top) = (x.0 - g, y.0 - g);
        let (w, h) = (x.1 + item.width() + g - left, y.1 + item.height() + g - top);
        self.near.reset(left, top, w as usize, h as usize);
        let mut touched = (w * h) as u64;
        for (j, (other, weight)) in self.placed.iter().zip(self.overlaps.weights(i)).enumerate() {
            if j != i {
                touched += self.near.add(other.item.cost(), other.item.mask.width, other.x, other.y, *weight);
            }
        }
        self.near.sum_up();
        let (found, looked) = self.near.cheapest(&item.runs, x, y, (grid.stride, grid.stride), bound);
        self.work += touched / 8 + looked / 6;
        found.map(|f| BestPlace { cost: f.cost, placed: PlacedItem { item: item.clone(), x: f.x, y: f.y } })
    }

    /// How far an item may lie from the origin; `None` where it does not fit the container.
    fn room(&self, item: &RasterizedItem) -> Option<[i32; 2]> {
        let room = [self.width - item.width(), self.height - item.height()];
        (room[0] >= 0 && room[1] >= 0).then_some(room)
    }

    /// The piece turned a little about its centre.
    fn turned(&mut self, i: usize, from: &PlacedItem) -> PlacedItem {
        // From about a cell at the boundary up to several degrees: small angles far more often.
        let radius = 0.5 * f64::from(from.item.width().max(from.item.height())).max(8.0);
        let most: f64 = if self.instances.candidates[i].is_empty() { 6.0 / radius } else { 0.3 };
        let least = 0.7 / radius;
        let size = least * (most / least).max(1.0).powf(self.random.unit());
        let sign = if self.random.below(2) == 0 { -1.0 } else { 1.0 };
        let Orientation { angle, mirror } = from.item.orientation;
        let mut angle = (angle + sign * size).rem_euclid(TAU);
        // Straight pieces find their way back to the axes.
        let quarter = (angle / FRAC_PI_2).round() * FRAC_PI_2;
        if (angle - quarter).abs() < 0.5 * least {
            angle = quarter.rem_euclid(TAU);
        }
        self.rasterized(i, Orientation { angle, mirror }, from.centre())
    }

    /// An orientation near the present one in which the piece fits the container.
    pub(super) fn fitting_orientation(&mut self, i: usize) -> Option<Orientation> {
        if !self.instances.rotates[i] {
            return None;
        }
        let grid = &self.instances.grid;
        let Orientation { angle, mirror } = self.placed[i].item.orientation;
        for k in 1..=TURNS {
            let far = FARTHEST_TURN * (f64::from(k) / f64::from(TURNS)).powi(2);
            let turn = far * (2.0 * self.random.unit() - 1.0);
            let next = Orientation { angle: (angle + turn).rem_euclid(TAU), mirror };
            let sides = self.instances.outlines[i].sides(next.matrix() * grid.scale) / grid.cell;
            self.work += self.instances.outlines[i].work() / 8;
            if sides.x + 0.1 < f64::from(self.width) && sides.y + 0.1 < f64::from(self.height) {
                return Some(next);
            }
        }
        None
    }

    /// The piece in another orientation, with this centre.
    pub(super) fn rasterized(&mut self, i: usize, orientation: Orientation, centre: [i32; 2]) -> PlacedItem {
        let outline = &self.instances.outlines[i];
        let item = Arc::new(RasterizedItem::new(outline, orientation, &self.instances.grid));
        self.work += outline.work() + 20 * item.runs.len() as u64;
        PlacedItem::centred(item, centre, &self.instances.grid)
    }

    /// The best places of a scan over the whole container, by blocks, in a few of the candidate orientations.
    fn scan(&mut self, i: usize, from: &PlacedItem) -> Vec<PlacedItem> {
        let block = self.instances.grid.block as i32;
        let pad = self.instances.grid.gutter as i32 / block + 2;
        let (w, h) = (self.width / block + 1 + 2 * pad, self.height / block + 1 + 2 * pad);
        self.far.reset(-pad, -pad, w as usize, h as usize);
        let mut touched = (w * h) as u64;
        for (j, (other, weight)) in self.blocks.iter().zip(self.overlaps.weights(i)).enumerate() {
            if j != i {
                touched += self.far.add(&other.costs, other.width, other.x, other.y, *weight);
            }
        }
        self.far.sum_up();
        self.work += touched / 8;
        let candidates = &self.instances.candidates[i];
        let mut found: Vec<(f32, PlacedItem)> = Vec::new();
        for k in 0..SCANNED {
            let item = if k == 0 { &from.item } else { &candidates[self.random.below(candidates.len())] };
            let Some(room) = self.room(item) else { continue };
            let last = room.map(|r| r / block);
            let bound = if found.len() < CLOSER { f32::INFINITY } else { found[CLOSER - 1].0 };
            let (runs, step) = item.blocks(block as usize);
            let (place, looked) = self.far.cheapest(runs, (0, last[0]), (0, last[1]), (1, step), bound);
            self.work += looked / 6;
            if let Some(p) = place {
                let placed = PlacedItem { item: item.clone(), x: p.x * block, y: p.y * block };
                found.push((p.cost, placed));
                found.sort_by(|a, b| a.0.total_cmp(&b.0));
            }
        }
        found.truncate(CLOSER);
        found.into_iter().map(|(_, placed)| placed).collect()
    }
}
