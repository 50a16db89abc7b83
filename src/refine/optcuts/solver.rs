//! One piece of a surface cut and flattened.

use glam::DVec2;

use super::params::{Quality, Search};
use super::pieces;
use crate::atlas::{Atlas, FaceId, HalfEdge, Topology, orientation, triangles_overlap};
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
    let atlas = unfolded(&piece, interrupt)?;
    let seam_length = pieces::seam_length(&atlas);
    let bound_met = settings.bound > 4.0;
    Ok(Solution { atlas, distortion: 4.0, seam_length, bound_met, stopped_by: "done", iterations: 0, work: 1 })
}

/// Faces of a chart at most: each new one is held against all others.
const LARGEST: usize = 200;

/// Trees of faces, each unfolded as far as it does not meet itself.
fn unfolded(piece: &Atlas, interrupt: &(dyn Fn() -> Result<bool> + Sync)) -> Result<Atlas> {
    let mut atlas = pieces::all_apart(piece);
    let topology = Topology::new(&atlas);
    let mut done = vec![false; atlas.face_count()];
    for seed in atlas.faces() {
        if std::mem::replace(&mut done[seed.index()], true) {
            continue;
        }
        interrupt()?;
        let mut chart = vec![seed];
        let mut next = 0;
        while let Some(face) = chart.get(next).copied() {
            next += 1;
            for h in [0, 1, 2].map(|k| HalfEdge::of(face, k)) {
                let Some(twin) = topology.surface_twin(h).filter(|t| !done[t.face().index()]) else { continue };
                let own = atlas.uv_triangle(twin.face());
                let uv = |k: usize| atlas.corners[face.index()][k];
                let [a, b] = [uv(h.end_corner()), uv(h.corner())];
                let [p, q] = [a, b].map(|u| atlas.uv[u.index()]);
                let from = own[twin.end_corner()] - own[twin.corner()];
                let turn = (q - p).rotate(DVec2::new(from.x, -from.y)) / from.length_squared();
                let apex = 3 - twin.corner() - twin.end_corner();
                let tip = p + turn.rotate(own[apex] - own[twin.corner()]);
                let placed = [p, q, tip];
                let meets = |g: &FaceId| triangles_overlap(&placed, &atlas.uv_triangle(*g));
                if chart.len() >= LARGEST || orientation(p, q, tip) <= 0 || chart.iter().any(meets) {
                    continue;
                }
                let corners = &mut atlas.corners[twin.face().index()];
                let third = corners[apex];
                (corners[twin.corner()], corners[twin.end_corner()]) = (a, b);
                atlas.uv[third.index()] = tip;
                done[twin.face().index()] = true;
                chart.push(twin.face());
            }
        }
    }
    atlas.drop_unused_uvs();
    pieces::face_up(&mut atlas, 1.0);
    Ok(atlas)
}
