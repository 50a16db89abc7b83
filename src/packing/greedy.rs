//! One greedy construction: pieces in a given order, each at the best of all positions on a strip.

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
}

impl<'a> Table<'a> {
    pub fn new(shapes: &'a Shapes, width: usize, height: usize) -> Self {
        let pad = 2 * shapes.gutter;
        Table { shapes, sheet: Occupancy::new(width + pad, height + pad, shapes.pitch), width, height }
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
    pub fn best(&self, piece: usize, rule: Rule, used: usize, limit: usize, work: &mut u64) -> Option<Spot> {
        let mut best: Option<(f64, Spot)> = None;
        let mut bound = limit;
        for orientation in 0..self.shapes.of_piece[piece].len() {
            let height = self.shapes.of_piece[piece][orientation].mask.height;
            let Some(room) = bound.checked_sub(height) else { continue };
            let Some(spot) = self.find(piece, orientation, (0, usize::MAX), (0, room), work) else { continue };
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

/// Runs the plan.
pub(crate) fn greedy<'a>(shapes: &'a Shapes, plan: &Plan) -> (Layout, Table<'a>) {
    let mut table = Table::new(shapes, plan.width, plan.height);
    let mut layout = Layout {
        spots: vec![None; shapes.of_piece.len()],
        width: 0,
        height: 0,
        left_over: Vec::new(),
        work: table.sheet.cost(),
    };
    for &piece in &plan.order {
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
/// over (Box Cutter 3.3: shifting by pixels, with jumps into holes allowed).
pub(crate) fn settle(table: &mut Table<'_>, layout: &mut Layout, rounds: usize) {
    for _ in 0..rounds {
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
        for (top, piece) in order {
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
