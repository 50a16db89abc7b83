//! One greedy construction: pieces in a given order, each at the best of all positions on a strip.

use std::collections::BTreeMap;

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
    pub rule: Rule,
    /// Whether to go on after a piece that does not fit.
    pub partial: bool,
    /// Whether a piece is looked for only from where the last one much like it was found: for thousands of pieces.
    pub frontiers: bool,
}

/// Weights of a position's score (less is better), each term relative to the strip's width.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rule {
    /// Growth of the strip's used height (Box Cutter 3.3, the active area).
    pub growth: f64,
    /// Height of the piece's top.
    pub top: f64,
    /// Height of the piece's bottom.
    pub low: f64,
}

/// Where a piece went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Spot {
    pub orientation: u32,
    pub x: u32,
    pub y: u32,
}

/// A layout on one strip.
#[derive(Debug, Clone)]
pub(crate) struct Layout {
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

impl Layout {
    /// Recomputes the extent from the spots.
    pub fn measure(&mut self, shapes: &Shapes) {
        (self.width, self.height) = (0, 0);
        for (piece, spot) in self.spots.iter().enumerate() {
            if let Some(s) = spot {
                let mask = &shapes.of_piece[piece][s.orientation as usize].mask;
                self.width = self.width.max(s.x as usize + mask.width);
                self.height = self.height.max(s.y as usize + mask.height);
            }
        }
    }
}

/// The sheet of a layout under construction. Cells are shifted by the gutter, so that gutters may hang over the edge.
pub(crate) struct Table<'a> {
    pub shapes: &'a Shapes,
    pub sheet: Occupancy,
    width: usize,
    height: usize,
    /// By likeness, the row above which no shape of the kind was found to fit.
    frontiers: Option<BTreeMap<Likeness, u32>>,
}

/// What shapes have in common that need about the same room: classes of width, of height, and of the part of their box that they fill.
type Likeness = (u8, u8, u8);

/// Classes of lengths in an octave, and of fillings.
const FINENESS: (f64, f64) = (6.0, 8.0);

fn likeness(mask: &Mask, cells: usize, gutter: usize) -> Likeness {
    let class = |side: usize| (((side + 2 * gutter) as f64).log2() * FINENESS.0) as u8;
    let filled = cells as f64 / (mask.width * mask.height).max(1) as f64;
    (class(mask.width), class(mask.height), (filled * FINENESS.1) as u8)
}

impl<'a> Table<'a> {
    pub fn new(shapes: &'a Shapes, width: usize, height: usize, frontiers: bool) -> Self {
        let pad = 2 * shapes.gutter;
        let sheet = Occupancy::new(width + pad, height + pad, shapes.pitch);
        Table { shapes, sheet, width, height, frontiers: frontiers.then(BTreeMap::new) }
    }

    pub fn stamp(&mut self, piece: usize, spot: Spot, taken: bool, work: &mut u64) {
        let g = self.shapes.gutter;
        let mask = &self.shapes.of_piece[piece][spot.orientation as usize].mask;
        *work += self.sheet.stamp(mask, spot.x as usize + g, spot.y as usize + g, taken);
    }

    /// The first free spot of the piece in this orientation with its corner in the window (inclusive), by rows.
    pub fn find(
        &self,
        piece: usize,
        orientation: usize,
        x: (usize, usize),
        y: (usize, usize),
        work: &mut u64,
    ) -> Option<Spot> {
        let shape = &self.shapes.of_piece[piece][orientation];
        let x_last = x.1.min(self.width.checked_sub(shape.mask.width)?);
        let y_last = y.1.min(self.height.checked_sub(shape.mask.height)?);
        if x.0 > x_last || y.0 > y_last {
            return None;
        }
        let window = Window { x: (x.0, x_last), y: (y.0, y_last) };
        let (found, words) = self.sheet.find(&shape.probe, window);
        *work += words;
        found.map(|(x, y)| Spot { orientation: orientation as u32, x: x as u32, y: y as u32 })
    }

    /// The best spot over all orientations by `rule`, given the height used so far.
    pub fn best(&mut self, piece: usize, rule: Rule, used: usize, limit: usize, work: &mut u64) -> Option<Spot> {
        let mut best: Option<(f64, Spot)> = None;
        let mut bound = limit;
        for orientation in 0..self.shapes.of_piece[piece].len() {
            let height = self.shapes.of_piece[piece][orientation].mask.height;
            let Some(room) = bound.checked_sub(height) else { continue };
            let shape = &self.shapes.of_piece[piece][orientation];
            let like = self.frontiers.is_some().then(|| likeness(&shape.mask, shape.cells, self.shapes.gutter));
            let frontier = |f: &BTreeMap<Likeness, u32>| like.and_then(|l| f.get(&l).copied());
            let from = self.frontiers.as_ref().and_then(frontier).unwrap_or(0) as usize;
            let found = self.find(piece, orientation, (0, usize::MAX), (from, room), work);
            if let (Some(frontiers), Some(like)) = (&mut self.frontiers, like) {
                frontiers.insert(like, found.map_or(from.max(room + 1) as u32, |s| s.y));
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
pub(crate) fn greedy<'a>(shapes: &'a Shapes, plan: &Plan, stop: &dyn Fn() -> bool) -> (Layout, Table<'a>) {
    let mut table = Table::new(shapes, plan.width, plan.height, plan.frontiers);
    let mut layout = Layout {
        spots: vec![None; shapes.of_piece.len()],
        width: 0,
        height: 0,
        left_over: Vec::new(),
        work: table.sheet.cost(),
    };
    for (n, &piece) in plan.order.iter().enumerate() {
        if n % CHECKED == CHECKED - 1 && stop() {
            layout.left_over.extend(&plan.order[n..]);
            break;
        }
        match table.best(piece as usize, plan.rule, layout.height, plan.height, &mut layout.work) {
            Some(spot) => {
                table.stamp(piece as usize, spot, true, &mut layout.work);
                let mask = &shapes.of_piece[piece as usize][spot.orientation as usize].mask;
                layout.width = layout.width.max(spot.x as usize + mask.width);
                layout.height = layout.height.max(spot.y as usize + mask.height);
                layout.spots[piece as usize] = Some(spot);
            }
            None => {
                layout.left_over.push(piece);
                if !plan.partial {
                    break;
                }
            }
        }
    }
    (layout, table)
}

/// Takes pieces out from the top and puts them back where they reach least high, until nothing moves any more or `rounds` are
/// over, or `stop` says so (Box Cutter 3.3: shifting by pixels, with jumps into holes allowed).
pub(crate) fn settle(table: &mut Table<'_>, layout: &mut Layout, rounds: usize, stop: &dyn Fn() -> bool) {
    for _ in 0..rounds {
        // What moved left room behind.
        if let Some(frontiers) = &mut table.frontiers {
            frontiers.clear();
        }
        let mut order: Vec<(usize, usize)> = layout
            .spots
            .iter()
            .enumerate()
            .filter_map(|(p, s)| {
                s.map(|s| (s.y as usize + table.shapes.of_piece[p][s.orientation as usize].mask.height, p))
            })
            .collect();
        order.sort_unstable_by_key(|&(top, p)| (top, p));
        let mut moved = false;
        for (n, (top, piece)) in order.into_iter().enumerate() {
            if n % CHECKED == CHECKED - 1 && stop() {
                break;
            }
            let Some(spot) = layout.spots[piece] else { continue };
            table.stamp(piece, spot, false, &mut layout.work);
            let rule = Rule { growth: 0.0, top: 1.0, low: 0.0 };
            let found = table.best(piece, rule, 0, top, &mut layout.work).unwrap_or(spot);
            let height = table.shapes.of_piece[piece][found.orientation as usize].mask.height;
            let better = (found.y as usize + height, found.x) < (top, spot.x);
            let next = if better { found } else { spot };
            moved |= better;
            table.stamp(piece, next, true, &mut layout.work);
            layout.spots[piece] = Some(next);
        }
        layout.measure(table.shapes);
        if !moved {
            break;
        }
    }
}
