//! One piece of a surface cut and flattened.

use std::f64::consts::PI;

use super::cut_map::CutMap;
use super::params::{Quality, Search as Order};
use super::search::{Search, Visited};
use super::start;
use crate::atlas::Atlas;
use crate::error::{Code, Failure, Result};
use crate::packing::Random;

/// How a piece is to be solved.
#[derive(Debug, Clone, Copy)]
pub(super) struct Settings {
    /// Bound on the mean symmetric Dirichlet energy.
    pub bound: f64,
    /// Whether no two faces may overlap.
    pub bijective: bool,
    /// How much is tried.
    pub quality: Quality,
    /// How cuts are searched for.
    pub search: Order,
    /// Whether the layout of the piece is where the search starts.
    pub polish: bool,
    /// Seed of every random choice.
    pub seed: u64,
    /// Vertices that may be moved, over all steps of all starts.
    pub budget: Option<u64>,
}

/// What was reached.
#[derive(Debug, Clone)]
pub(super) struct Solution {
    /// The piece with its layout.
    pub atlas: Atlas,
    /// Mean symmetric Dirichlet energy, at scale 1.
    pub distortion: f64,
    /// Length of the seams on the surface in its units, each once, the boundary of the surface apart.
    pub seam_length: f64,
    /// Whether the distortion is within the bound.
    pub bound_met: bool,
    /// Why the search ended.
    pub stopped_by: &'static str,
    /// Iterations of the outer loop.
    pub iterations: u64,
    /// Units of work.
    pub work: u64,
    /// Faces that had to become charts of their own.
    pub detached: usize,
}

/// What a vertex counts where seams are forbidden: so much that all ways about are shorter, and still a number.
const FORBIDDEN: f64 = 1e4;
/// How good a start must be, as E_d of its Tutte embedding, by the number of the start: the surface is cut until it is.
const STARTS: [f64; 3] = [200.0, 20.0, 2000.0];

/// Cuts and flattens a piece.
///
/// `piece` is one connected, edge- and vertex-manifold, consistently wound surface without degenerate faces; with a layout where the
/// settings say `polish`. `weights` are by surface vertex, at least 1; infinity forbids a seam. The solution has the same faces and surface; its
/// UVs have the unit of the surface, all faces with positive signed area, and no two faces overlap where `bijective`. `interrupt` is asked
/// often: an error is cancellation, `true` means to stop now with the best.
///
/// # Errors
/// `canceled`; `internal` where no map can be found to start from.
pub(super) fn solve(
    mut piece: Atlas,
    weights: Option<&[f64]>,
    settings: &Settings,
    interrupt: &(dyn Fn() -> Result<bool> + Sync),
) -> Result<Solution> {
    let positions = piece.surface.positions.clone();
    let area: f64 = piece.faces().map(|f| piece.area(f)).sum();
    let scale = (PI / area).sqrt();
    piece.surface.positions.iter_mut().for_each(|p| *p *= scale);
    piece.uv.iter_mut().for_each(|p| *p *= scale);
    let weights: Option<Vec<f64>> = weights.map(|own| own.iter().map(|w| w.clamp(1.0, FORBIDDEN)).collect());
    let starts = if settings.polish { 1 } else { starts(settings.quality) };
    let mut best: Option<Visited> = None;
    let (mut iterations, mut work) = (0, 0);
    let mut stopped_by = "done";
    for (k, enough) in STARTS.into_iter().take(starts).enumerate() {
        let none = || Failure::new(Code::Internal, "no map of this surface could be found to start from");
        let Some(mut map) = CutMap::new(piece.clone(), weights.as_deref(), settings.bijective) else {
            return Err(none());
        };
        if !settings.polish && start::embed(&mut map, enough, interrupt)?.is_none() {
            if k + 1 == starts && best.is_none() {
                return Err(none());
            }
            continue;
        }
        let mut search = {
            let budget = settings.budget.map(|all| all.saturating_sub(work));
            Search::new(map, settings.bound, Random::stream(settings.seed, k as u64), budget, interrupt)
        };
        stopped_by = match settings.search {
            Order::Paper => search.run_as_published()?,
            Order::Default => search.run(settings.quality, settings.polish)?,
        };
        iterations += search.rounds();
        work += search.work;
        let better = |a: &Visited, b: &Visited| match (a.distortion <= settings.bound, b.distortion <= settings.bound) {
            (true, true) => a.seam < b.seam,
            (false, false) => a.distortion < b.distortion,
            (met, _) => met,
        };
        if let Some(found) = search.best.take().filter(|found| best.as_ref().is_none_or(|b| better(found, b))) {
            best = Some(found);
        }
        if search.interrupted {
            break;
        }
    }
    let Some(Visited { map, seam: _, distortion }) = best else {
        return Err(Failure::new(Code::Internal, "no map of this surface could be found to start from"));
    };
    let seam_length = map.unweighted_seam_length() / scale;
    let mut atlas = map.into_atlas();
    atlas.surface.positions = positions;
    atlas.uv.iter_mut().for_each(|p| *p /= scale);
    let bound_met = distortion <= settings.bound;
    Ok(Solution { atlas, distortion, seam_length, bound_met, stopped_by, iterations, work, detached: 0 })
}

/// How many starts there are.
fn starts(quality: Quality) -> usize {
    match quality {
        Quality::Fast | Quality::Balanced => 1,
        Quality::Best => STARTS.len(),
    }
}

#[cfg(test)]
mod tests;
