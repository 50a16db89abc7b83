//! One piece of a surface cut and flattened.

use super::params::{Quality, Search};
use super::pieces;
use crate::atlas::Atlas;
use crate::error::Result;

/// How a piece is to be solved.
#[derive(Debug, Clone, Copy)]
#[expect(dead_code, reason = "nothing is searched for yet")]
pub(super) struct Settings {
    /// Bound on the mean symmetric Dirichlet energy.
    pub bound: f64,
    /// Whether no two faces may overlap.
    pub bijective: bool,
    /// How much is tried.
    pub quality: Quality,
    /// How cuts are searched for.
    pub search: Search,
    /// Whether the layout of the piece is where the search starts.
    pub polish: bool,
    /// Seed of every random choice.
    pub seed: u64,
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
}

/// Cuts and flattens a piece.
///
/// `piece` is one connected, edge- and vertex-manifold, consistently wound surface without degenerate faces; with a layout where the
/// settings say `polish`. `weights` are by surface vertex, at least 1; infinity forbids a seam. The solution has the same faces and surface; its
/// UVs have the unit of the surface, all faces with positive signed area, and no two faces overlap where `bijective`. `interrupt` is asked
/// often: an error is cancellation, `true` means to stop now with the best.
///
/// # Errors
/// `canceled`.
pub(super) fn solve(
    piece: Atlas,
    _weights: Option<&[f64]>,
    settings: &Settings,
    interrupt: &(dyn Fn() -> Result<bool> + Sync),
) -> Result<Solution> {
    let stopped_by = if interrupt()? { "time_limit" } else { "done" };
    let atlas = pieces::all_apart(&piece);
    let seam_length = pieces::seam_length(&atlas);
    Ok(Solution {
        atlas,
        distortion: 4.0,
        seam_length,
        bound_met: settings.bound > 4.0,
        stopped_by,
        iterations: 0,
        work: 1,
    })
}
