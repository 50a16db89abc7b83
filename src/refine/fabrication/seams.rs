//! Which stretch of an outline is sewn or glued to which.

use super::outline::Outlines;
use crate::atlas::{HalfEdge, NONE, Topology};

/// A stretch ends where its outline turns by more than this angle, in radians (20 degrees): flaps are trapezoids.
const CORNER: f64 = 0.35;

/// Two stretches of outlines that belong together; each in the order of its own loop.
pub(super) struct Seam {
    /// The one with the lowest half edge.
    pub first: Vec<HalfEdge>,
    /// Its other side, which runs against it.
    pub second: Vec<HalfEdge>,
}

/// All seams, in the order of their lowest half edges. Every seam edge is in exactly one, once on each side.
pub(super) fn seams(topology: &Topology, outlines: &Outlines) -> Vec<Seam> {
    let mut seen = vec![false; topology.uv_twin.len()];
    let mut seams = Vec::new();
    let twin = |h: HalfEdge| topology.surface_twin[h as usize];
    for start in 0..topology.uv_twin.len() as u32 {
        if seen[start as usize] || !topology.is_seam(start) {
            continue;
        }
        // Back to where the stretch begins, or once around.
        let mut first = start;
        loop {
            let before = outlines.previous[first as usize];
            if before == NONE || before == start || !goes_on(topology, outlines, before) || seen[before as usize] {
                break;
            }
            first = before;
        }
        let mut run = Vec::new();
        let mut h = first;
        loop {
            seen[h as usize] = true;
            seen[twin(h) as usize] = true;
            run.push(h);
            let next = outlines.next[h as usize];
            if !goes_on(topology, outlines, h) || seen[next as usize] {
                break;
            }
            h = next;
        }
        let second = run.iter().rev().map(|h| twin(*h)).collect();
        seams.push(Seam { first: run, second });
    }
    seams
}

/// Whether a stretch goes on from `h` to the edge after it, on both of its sides.
fn goes_on(topology: &Topology, outlines: &Outlines, h: HalfEdge) -> bool {
    let next = outlines.next[h as usize];
    if next == NONE || !topology.is_seam(h) || !topology.is_seam(next) {
        return false;
    }
    let (other, before) = (topology.surface_twin[h as usize], topology.surface_twin[next as usize]);
    next != other
        && outlines.next[before as usize] == other
        && !corner(outlines, h, next)
        && !corner(outlines, before, other)
}

fn corner(outlines: &Outlines, h: HalfEdge, next: HalfEdge) -> bool {
    let [a, b] = outlines.ends(h);
    let [c, d] = outlines.ends(next);
    let (u, v) = (b - a, d - c);
    u.perp_dot(v).abs().atan2(u.dot(v)) > CORNER
}
