//! Seams and their parts: runs, and the halves of runs.

use std::collections::{BTreeMap, BTreeSet};

use super::mesh::MergeMesh;
use crate::atlas::groups::DisjointSets;

/// Connected runs of linked edges: those that share a seam vertex on both sides. Each ascending; ordered by their first.
pub(super) fn runs(mesh: &MergeMesh, edges: &[u32]) -> Vec<Vec<u32>> {
    let mut sets = DisjointSets::new(edges.len());
    // (vertex on the one side, vertex on the other) of each end.
    let mut ends: Vec<((u32, u32), u32)> = Vec::with_capacity(2 * edges.len());
    for (i, &h) in edges.iter().enumerate() {
        let Some(t) = mesh.linked(h) else { continue };
        for (p, q) in [(mesh.start(h), mesh.end(t)), (mesh.end(h), mesh.start(t))] {
            ends.push(((p.min(q), p.max(q)), i as u32));
        }
    }
    ends.sort_unstable();
    for pair in ends.windows(2).filter(|w| w[0].0 == w[1].0) {
        sets.unite(pair[0].1, pair[1].1);
    }
    sets.sets().into_iter().map(|run| run.into_iter().map(|i| edges[i as usize]).collect()).collect()
}

/// The two halves of a run, by the order along the border of its first side; none of a single edge. Each ascending.
pub(super) fn halves(mesh: &MergeMesh, edges: &[u32]) -> Vec<Vec<u32>> {
    if edges.len() < 2 {
        return Vec::new();
    }
    let mut first = in_order(mesh, edges);
    let mut second = first.split_off(first.len() / 2);
    first.sort_unstable();
    second.sort_unstable();
    vec![first, second]
}

/// The edges of a run in order.
fn in_order(mesh: &MergeMesh, edges: &[u32]) -> Vec<u32> {
    // One side of each pair, all of the same border where that can be told: by the vertex at which they start.
    let mut by_start: BTreeMap<u32, u32> = BTreeMap::new();
    let mut is_end: BTreeSet<u32> = BTreeSet::new();
    let chart = mesh.chart_at(edges[0]);
    let side = |h: u32| mesh.linked_pair(h, chart).map_or(h, |pair| pair.0);
    for &h in edges {
        by_start.insert(mesh.start(side(h)), h);
        is_end.insert(mesh.end(side(h)));
    }
    let mut ordered = Vec::with_capacity(edges.len());
    let mut left = by_start.clone();
    let starts: Vec<u32> =
        by_start.keys().copied().filter(|s| !is_end.contains(s)).chain(by_start.keys().copied()).collect();
    for start in starts {
        let mut at = start;
        while let Some(h) = left.remove(&at) {
            ordered.push(h);
            at = mesh.end(side(h));
        }
    }
    // Edges that start where another does.
    let mut missing: Vec<u32> = edges.iter().copied().filter(|h| !ordered.contains(h)).collect();
    ordered.append(&mut missing);
    ordered
}
