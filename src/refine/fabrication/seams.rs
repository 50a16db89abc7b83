//! Which stretch of an outline is sewn or glued to which.

use super::outline::Outlines;
use crate::atlas::{HalfEdge, Topology};

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
    let mut seen = vec![false; topology.len()];
    let mut seams = Vec::new();
    for start in topology.half_edges() {
        if seen[start.index()] || !topology.is_seam(start) {
            continue;
        }
        // Back to where the stretch begins, or once around.
        let mut first = start;
        loop {
            let before = outlines.previous[first.index()].filter(|&before| {
                before != start && goes_on(topology, outlines, before).is_some() && !seen[before.index()]
            });
            let Some(before) = before else { break };
            first = before;
        }
        let mut own = Seam { first: Vec::new(), second: Vec::new() };
        let mut h = Some(first);
        while let Some((one, twin)) = h.and_then(|h| Some((h, topology.across_seam(h)?))) {
            seen[one.index()] = true;
            seen[twin.index()] = true;
            own.first.push(one);
            own.second.push(twin);
            h = goes_on(topology, outlines, one).filter(|next| !seen[next.index()]);
        }
        own.second.reverse();
        seams.push(own);
    }
    seams
}

/// The edge after `h`, if a stretch goes on to it on both of its sides.
fn goes_on(topology: &Topology, outlines: &Outlines, h: HalfEdge) -> Option<HalfEdge> {
    let next = outlines.next[h.index()]?;
    let (other, before) = (topology.across_seam(h)?, topology.across_seam(next)?);
    let goes_on = next != other
        && outlines.next[before.index()] == Some(other)
        && !corner(outlines, h, next)
        && !corner(outlines, before, other);
    goes_on.then_some(next)
}

fn corner(outlines: &Outlines, h: HalfEdge, next: HalfEdge) -> bool {
    let [a, b] = outlines.ends(h);
    let [c, d] = outlines.ends(next);
    let (u, v) = (b - a, d - c);
    u.perp_dot(v).abs().atan2(u.dot(v)) > CORNER
}
