//! The search over plans of construction, coarse first, then fine; the thorough one goes on by guided local search.

mod coarse;
mod finalists;
mod pages;

use glam::DVec2;
use rayon::prelude::*;

use self::coarse::Evaluated;
use super::greedy::{PlacementRule, Spot, StripLayout, greedy};
use super::guided::{GuidedSearch, InitialLayout};
use super::orientation::{Orientation, orientations};
use super::outline::Outline;
use super::shape::Shapes;
use super::sheet::SheetObjective;
use super::tuning::Tuning;
use super::{Move, Packing, Piece, Request};
use crate::atlas::bvh::Bounds;
use crate::context::Context;
use crate::error::Result;
use crate::packing::PackSearch;

/// Words that the thorough search looks at: about ten seconds on two cores.
const THOROUGH_WORK: f64 = 2e9;
/// The part of it that the thorough search spends at most on the plans of the fast one, with which it begins.
const FAST_PART: f64 = 0.08;
/// One over the least effort for which all finalists are built.
const FULL: f64 = 8.0;
/// Rules that plans choose from: the growth of the strip's used height counts most (Box Cutter, section 3.3), then what stays low.
pub(crate) const RULES: [PlacementRule; 3] = [
    PlacementRule { growth: 4.0, top: 1.0, low: 0.0 },
    PlacementRule { growth: 4.0, top: 0.0, low: 1.0 },
    PlacementRule { growth: 4.0, top: 0.5, low: 0.5 },
];

/// Angles beside the best axes for a piece, by its share of the area and its place in the order of areas: large pieces decide the sheet's size.
fn angles(share: f64, rank: usize) -> u32 {
    match rank {
        0..6 if share > 0.1 => 11,
        0..14 => 3,
        14..200 => 1,
        _ => 0,
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
    by_area.iter().enumerate().for_each(|(r, &piece)| rank[piece] = r);
    let total = request.pieces.iter().map(|p| p.area).sum::<f64>().max(1e-12);
    let mut orientations: Vec<Vec<Orientation>> = request
        .pieces
        .par_iter()
        .zip(&rank)
        .map(|(p, &rank)| orientations(p, request.rotation, request.mirror, angles(p.area / total, rank)))
        .collect();
    if let ([piece], [own]) = (request.pieces, orientations.as_mut_slice()) {
        *own = least_sheet(request, piece, own).into_iter().collect();
    }
    let side = (total * request.scale.powi(2) / 0.7).sqrt().max(1e-6);
    let longest = request.pieces.iter().map(|p| p.diagonal() * request.scale).fold(0.0, f64::max);
    let span = 3.0 * side + longest + 64.0 * request.spacing.unit;
    let outlines: Vec<Outline> = request.pieces.par_iter().map(Outline::new).collect();
    let tuning = Tuning::of(n);
    Search { request, tuning, outlines: &outlines, orientations: &orientations, context, side, span }.run()
}

/// The orientation in which a piece that is alone needs the least sheet: the first of those.
fn least_sheet(request: &Request<'_>, piece: &Piece, all: &[Orientation]) -> Option<Orientation> {
    let sheet = SheetObjective::new(request, 1.0);
    let cost = |o: &Orientation| {
        let turn = o.matrix() * request.scale;
        let size = Bounds::around(piece.triangles.iter().flatten().map(|p| turn * *p)).or_zero().size();
        sheet.cost(size.x, size.y)
    };
    let costs = all.iter().map(|o| (cost(o), *o));
    // What rounding tells apart is the same.
    costs.reduce(|best, next| if next.0 < best.0 * (1.0 - 1e-9) { next } else { best }).map(|(_, o)| o)
}

impl Request<'_> {
    /// Words that the search may look at.
    fn budget(&self, tuning: &Tuning) -> f64 {
        let own = match self.search {
            PackSearch::Fast => tuning.coarse_work,
            PackSearch::Thorough => THOROUGH_WORK,
        };
        self.work_budget.map_or(own, |words| words as f64) * self.effort
    }
}

struct Search<'a> {
    request: &'a Request<'a>,
    tuning: &'a Tuning,
    /// By piece.
    outlines: &'a [Outline],
    /// By piece, those that constructions try.
    orientations: &'a [Vec<Orientation>],
    context: &'a Context,
    /// Side of a square that would hold everything at a good density, in texels.
    side: f64,
    /// No strip is longer or wider than this many texels, unless everything is spread over pages.
    span: f64,
}

impl Search<'_> {
    fn run(&self) -> Result<Packing> {
        let thorough = self.request.search == PackSearch::Thorough && self.request.pieces.len() > 1;
        let budget = self.request.budget(self.tuning);
        if thorough
            && !self.request.starts.is_empty()
            && let Some((_, packing)) = self.improved(self.request.starts, budget as u64)?
        {
            return Ok(packing);
        }
        let coarse = self.shapes(self.orientations, self.cell(self.side / self.tuning.coarse_side), self.span);
        self.context.step(0.1, "searching")?;
        // The thorough search begins exactly as the fast one, so that it is never worse.
        let mut found = self.coarse(&coarse, PackSearch::Fast)?;
        found.best.truncate(self.finalists_tried());
        if thorough {
            let more = self.coarse(&coarse, PackSearch::Thorough)?;
            found.work += more.work;
            found.diverse = more.diverse;
            found.best.extend(more.best.into_iter().take(self.tuning.more_finalists));
        }
        let fine_cell = self.cell(self.side / self.tuning.fine_side);
        let (best, work) = self.finalists(&found.best, &coarse, fine_cell, found.work)?;
        let Some((cost, packing)) = best else {
            return self.pages(&self.shapes(self.orientations, fine_cell, self.span), work);
        };
        if found.diverse.is_empty() {
            return Ok(packing);
        }
        let starts: Vec<InitialLayout> =
            found.diverse.par_iter().filter_map(|plan| self.initial_layout(&coarse, plan)).collect();
        Ok(match self.improved(&starts, (budget as u64).saturating_sub(work))? {
            Some((least, better)) if least < cost => Packing { work: work + better.work, ..better },
            Some((_, worse)) => Packing { work: work + worse.work, ..packing },
            None => packing,
        })
    }

    /// Finalists of the fast search: all, or the fewer the less effort is asked for.
    fn finalists_tried(&self) -> usize {
        let all = self.tuning.finalists;
        ((all as f64 * self.request.effort * FULL).ceil() as usize).clamp(1, all)
    }

    /// Whether the job was canceled.
    fn stopped(&self) -> bool {
        self.context.check().is_err()
    }

    /// The best that guided local search makes of these layouts, and its cost.
    fn improved(&self, starts: &[InitialLayout], budget: u64) -> Result<Option<(f64, Packing)>> {
        let Search { request, tuning, outlines, orientations, context, side, .. } = *self;
        let cell = &|wanted| self.cell(wanted);
        GuidedSearch { request, tuning, outlines, orientations, context, side, budget, cell }.run(starts)
    }

    /// The layout of a coarse plan, for the local search to start from.
    fn initial_layout(&self, shapes: &Shapes, of: &Evaluated) -> Option<InitialLayout> {
        let (layout, _) = greedy(shapes, &of.plan, &|| self.stopped());
        let place = |(piece, spot): (usize, &Option<Spot>)| {
            let spot = (*spot)?;
            Some((self.orientations[piece][spot.orientation as usize], spot.corner() * shapes.cell))
        };
        let places = layout.spots.iter().enumerate().map(place).collect::<Option<_>>()?;
        Some(InitialLayout { places, sides: [layout.width, layout.height].map(|s| s as f64 * shapes.cell) })
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

    /// The pieces at a cell size, for strips up to `widest` texels wide.
    fn shapes(&self, orientations: &[Vec<Orientation>], cell: f64, widest: f64) -> Shapes {
        let Request { pieces, scale, spacing, max, .. } = self.request;
        Shapes::new(pieces, self.outlines, orientations, cell, *scale, spacing, widest.min(max[0]))
    }

    /// Longest side of a strip in cells.
    fn limit(&self, axis: usize, shapes: &Shapes) -> usize {
        let sheet = SheetObjective::new(self.request, shapes.cell);
        sheet.cells(self.request.max[axis]).min((self.span / shapes.cell + 1e-9).floor()) as usize
    }

    /// Sides of the sheet that holds a layout, in texels.
    fn sheet(&self, layout: &StripLayout, shapes: &Shapes) -> [f64; 2] {
        SheetObjective::new(self.request, shapes.cell).sides(layout.width as f64, layout.height as f64)
    }

    /// What that sheet costs; infinite where pieces are left over.
    fn cost(&self, layout: &StripLayout, shapes: &Shapes) -> f64 {
        if !layout.left_over.is_empty() {
            return f64::INFINITY;
        }
        SheetObjective::new(self.request, shapes.cell).cost(layout.width as f64, layout.height as f64)
    }

    /// The height in cells at which a strip of this width costs `cost`.
    fn height_at(&self, cost: f64, width: usize, shapes: &Shapes) -> usize {
        SheetObjective::new(self.request, shapes.cell).height_at(cost, width as f64)
    }

    fn placement(&self, shapes: &Shapes, layout: &StripLayout, piece: usize, page: u16) -> Option<Move> {
        let spot = layout.spots.get(piece).copied().flatten()?;
        let shape = shapes.at(piece, spot);
        let corner = spot.corner() * shapes.cell + DVec2::splat(self.request.spacing.margin);
        Some(Move { page, linear: shape.linear, translate: corner - shape.anchor })
    }

    fn one_sheet(&self, layout: &StripLayout, shapes: &Shapes, work: u64) -> Packing {
        let placements = (0..self.request.pieces.len()).filter_map(|p| self.placement(shapes, layout, p, 0)).collect();
        Packing { placements, sheets: vec![self.sheet(layout, shapes)], work }
    }
}
