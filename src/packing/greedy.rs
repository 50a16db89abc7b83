//! One greedy construction: pieces in a given order, each at the best of all positions on a strip.

use std::collections::BTreeMap;

use glam::DVec2;

use super::mask::Mask;
use super::occupancy::{Occupancy, Window};
use super::shape::Shapes;

/// What a greedy run is told.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Plan {
    /// Pieces in the order of placement.
    pub order: Vec<u32>,
    /// Width of the strip in cells.
    pub width: usize,
    /// Height limit of the strip in cells.
    pub height: usize,
    /// What makes a position good.
    pub rule: PlacementRule,
    /// Whether to go on after a piece that does not fit.
    pub partial: bool,
    /// Whether a piece is looked for only from where the last one of its size class was found.
    pub frontiers: bool,
}

/// Weights of a position's score (less is better), each term relative to the strip's width.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PlacementRule {
    /// Growth of the strip's used height (Box Cutter 3.3, the active area).
    pub growth: f64,
    /// Height of the piece's top.
    pub top: f64,
    /// Height of the piece's bottom.
    pub low: f64,
}

/// Where a piece went: its orientation, and the cell of its mask's corner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Spot {
    pub orientation: u32,
    pub x: u32,
    pub y: u32,
}

impl Spot {
    /// The mask's corner, in cells.
    pub fn corner(self) -> DVec2 {
        DVec2::new(f64::from(self.x), f64::from(self.y))
    }
}

/// A layout on one strip.
#[derive(Debug, Clone)]
pub(crate) struct StripLayout {
    /// By piece; `None` for pieces that were not in the order, or did not fit.
    pub spots: Vec<Option<Spot>>,
    /// Cells used from the origin.
    pub width: usize,
    pub height: usize,
    /// Pieces that did not fit.
    pub left_over: Vec<u32>,
    /// Words looked at.
    pub work: u64,
}

impl StripLayout {
    /// Lets the extent reach over a piece.
    fn reach(&mut self, shapes: &Shapes, piece: usize, spot: Spot) {
        self.width = self.width.max(spot.x as usize + shapes.at(piece, spot).mask.width);
        self.height = self.height.max(shapes.top(piece, spot));
    }

    /// Recomputes the extent from the spots.
    fn measure(&mut self, shapes: &Shapes) {
        (self.width, self.height) = (0, 0);
        for piece in 0..self.spots.len() {
            if let Some(spot) = self.spots[piece] {
                self.reach(shapes, piece, spot);
            }
        }
    }
}

/// A strip with the pieces placed so far. Cells are shifted by the gutter, so that gutters may hang over the edge.
pub(crate) struct StripBuilder<'a> {
    shapes: &'a Shapes,
    sheet: Occupancy,
    width: usize,
    height: usize,
    /// By size class, the row above which no shape of the class was found to fit.
    frontiers: Option<BTreeMap<SizeClass, u32>>,
}

/// What shapes have in common that need about the same room: classes of width, of height, and of the part of their box that they fill.
type SizeClass = (u8, u8, u8);

/// Classes of lengths in an octave, and of fillings.
const CLASSES: (f64, f64) = (6.0, 8.0);

fn size_class(mask: &Mask, cells: usize, gutter: usize) -> SizeClass {
    let class = |side: usize| (((side + 2 * gutter) as f64).log2() * CLASSES.0) as u8;
    let filled = cells as f64 / (mask.width * mask.height).max(1) as f64;
    (class(mask.width), class(mask.height), (filled * CLASSES.1) as u8)
}

impl<'a> StripBuilder<'a> {
    fn new(shapes: &'a Shapes, width: usize, height: usize, frontiers: bool) -> Self {
        let pad = 2 * shapes.gutter;
        let sheet = Occupancy::new(width + pad, height + pad, shapes.pitch);
        StripBuilder { shapes, sheet, width, height, frontiers: frontiers.then(BTreeMap::new) }
    }

    fn stamp(&mut self, piece: usize, spot: Spot, taken: bool, work: &mut u64) {
        let g = self.shapes.gutter;
        let mask = &self.shapes.at(piece, spot).mask;
        *work += self.sheet.stamp(mask, spot.x as usize + g, spot.y as usize + g, taken);
    }

    /// The first free spot of the piece in this orientation with its corner in these rows (inclusive), by rows.
    fn find(&self, piece: usize, orientation: usize, rows: (usize, usize), work: &mut u64) -> Option<Spot> {
        let shape = &self.shapes.of_piece[piece][orientation];
        let x_last = self.width.checked_sub(shape.mask.width)?;
        let y_last = rows.1.min(self.height.checked_sub(shape.mask.height)?);
        if rows.0 > y_last {
            return None;
        }
        let window = Window { x: (0, x_last), y: (rows.0, y_last) };
        let (found, words) = self.sheet.find(&shape.probe, window);
        *work += words;
        found.map(|(x, y)| Spot { orientation: orientation as u32, x: x as u32, y: y as u32 })
    }

    /// The best spot over all orientations by `rule`, given the height used so far.
    fn best(&mut self, piece: usize, rule: PlacementRule, used: usize, limit: usize, work: &mut u64) -> Option<Spot> {
        let mut best: Option<(f64, Spot)> = None;
        let mut bound = limit;
        for orientation in 0..self.shapes.of_piece[piece].len() {
            let shape = &self.shapes.of_piece[piece][orientation];
            let height = shape.mask.height;
            let Some(room) = bound.checked_sub(height) else { continue };
            let class = self.frontiers.is_some().then(|| size_class(&shape.mask, shape.cells, self.shapes.gutter));
            let frontier = |f: &BTreeMap<SizeClass, u32>| class.and_then(|c| f.get(&c).copied());
            let from = self.frontiers.as_ref().and_then(frontier).unwrap_or(0) as usize;
            let found = self.find(piece, orientation, (from, room), work);
            if let (Some(frontiers), Some(class)) = (&mut self.frontiers, class) {
                frontiers.insert(class, found.map_or(from.max(room + 1) as u32, |s| s.y));
            }
            let Some(spot) = found else { continue };
            let top = spot.y as usize + height;
            let score = rule.growth * top.saturating_sub(used) as f64
                + rule.top * top as f64
                + rule.low * f64::from(spot.y)
                + 1e-3 * f64::from(spot.x) / self.width as f64;
            if best.is_none_or(|(least, _)| score < least) {
                best = Some((score, spot));
                // Nothing whose top is higher than the used height and this one's can win by much.
                bound = bound.min(top.max(used));
            }
        }
        best.map(|(_, spot)| spot)
    }
}

/// Pieces between two looks at whether to stop.
const CHECKED: usize = 64;

/// Runs the plan; once `stop` says so, the rest is left over.
pub(crate) fn greedy<'a>(shapes: &'a Shapes, plan: &Plan, stop: &dyn Fn() -> bool) -> (StripLayout, StripBuilder<'a>) {
    let mut strip = StripBuilder::new(shapes, plan.width, plan.height, plan.frontiers);
    let mut layout = StripLayout {
        spots: vec![None; shapes.of_piece.len()],
        width: 0,
        height: 0,
        left_over: Vec::new(),
        work: strip.sheet.cost(),
    };
    for (n, &piece) in plan.order.iter().enumerate() {
        if n % CHECKED == CHECKED - 1 && stop() {
            layout.left_over.extend(&plan.order[n..]);
            break;
        }
        match strip.best(piece as usize, plan.rule, layout.height, plan.height, &mut layout.work) {
            Some(spot) => {
                strip.stamp(piece as usize, spot, true, &mut layout.work);
                layout.spots[piece as usize] = Some(spot);
                layout.reach(shapes, piece as usize, spot);
            }
            None => {
                layout.left_over.push(piece);
                if !plan.partial {
                    break;
                }
            }
        }
    }
    (layout, strip)
}

/// Compaction: takes pieces out from the top and puts them back where they reach least high, until nothing moves any more or `rounds` are
/// over, or `stop` says so (Box Cutter 3.3: shifting by pixels, with jumps into holes allowed).
pub(crate) fn compact(strip: &mut StripBuilder<'_>, layout: &mut StripLayout, rounds: usize, stop: &dyn Fn() -> bool) {
    for _ in 0..rounds {
        // What moved left room behind.
        if let Some(frontiers) = &mut strip.frontiers {
            frontiers.clear();
        }
        let placed = layout.spots.iter().enumerate();
        let mut order: Vec<(usize, usize)> =
            placed.filter_map(|(p, spot)| spot.map(|spot| (strip.shapes.top(p, spot), p))).collect();
        order.sort_unstable();
        let mut moved = false;
        for (n, (top, piece)) in order.into_iter().enumerate() {
            if n % CHECKED == CHECKED - 1 && stop() {
                break;
            }
            let Some(spot) = layout.spots[piece] else { continue };
            strip.stamp(piece, spot, false, &mut layout.work);
            let rule = PlacementRule { growth: 0.0, top: 1.0, low: 0.0 };
            let found = strip.best(piece, rule, 0, top, &mut layout.work).unwrap_or(spot);
            let better = (strip.shapes.top(piece, found), found.x) < (top, spot.x);
            let next = if better { found } else { spot };
            moved |= better;
            strip.stamp(piece, next, true, &mut layout.work);
            layout.spots[piece] = Some(next);
        }
        layout.measure(strip.shapes);
        if !moved {
            break;
        }
    }
}
