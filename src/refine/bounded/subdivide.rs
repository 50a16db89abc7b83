//! Faces that the target angles would flatten are divided first.
//!
//! An edge whose ends lie on one straight side cuts off faces that would collapse onto the side, and a face whose tip turns by less than a quarter
//! to the left would lose its area: a boundary vertex with t faces needs K > 2 - 2t.

use std::collections::BTreeMap;

use super::angles::turns;
use super::chart_map::ChartMap;
use crate::atlas::{HalfEdge, Mesh, VertexId};

/// Half edges inside the chart that must be split before its boundary can have these target angles.
pub(super) fn flattened_edges(mesh: &Mesh, map: &ChartMap, targets: &[i32]) -> Vec<HalfEdge> {
    let n = map.boundary.len();
    let turns = turns(targets);
    // By boundary vertex: the sides that end in it or go through it. Sides are numbered by the corners before them.
    let mut side = vec![0; n];
    let mut count = 0;
    let first = (0..n).find(|i| turns[*i] != 0).unwrap_or(0);
    for k in 0..n {
        let i = (first + k) % n;
        count += usize::from(turns[i] != 0);
        side[i] = count;
    }
    let sides = |i: usize| [side[i], side[(i + n - 1) % n]];
    let mut place = vec![usize::MAX; map.x.len()];
    map.boundary.iter().enumerate().for_each(|(i, v)| place[*v as usize] = i);
    let faces_on = map.faces_on_boundary();
    let mut out = Vec::new();
    for face in &map.faces {
        for k in 0..3 {
            let h = HalfEdge::of(*face, k);
            let Some(twin) = mesh.topology().uv_twin(h) else { continue };
            let local = |h: HalfEdge| {
                let u = mesh.uv_at(h);
                map.uvs.binary_search(&u).map_or(usize::MAX, |v| place[v])
            };
            let (a, b) = (local(h), local(h.next()));
            if a == usize::MAX || b == usize::MAX {
                continue;
            }
            let common = sides(a).iter().any(|s| sides(b).contains(s));
            let tip = local(h.previous());
            let is_flat_tip = tip != usize::MAX && faces_on[tip] == 1 && turns[tip] != 1;
            if (common && h < twin) || is_flat_tip {
                out.push(h.min(twin));
            }
        }
    }
    out.sort_unstable();
    out.dedup();
    out
}

/// Splits edges at their middles; gives the faces that were divided off, each with the one that it was a part of.
pub(super) fn split_at_middles(
    mesh: &mut Mesh,
    edges: &[HalfEdge],
) -> Vec<(crate::atlas::FaceId, crate::atlas::FaceId)> {
    let splits: BTreeMap<(VertexId, VertexId), f64> = edges
        .iter()
        .map(|h| {
            let [a, b] = mesh.surface_ends(*h);
            ((a.min(b), a.max(b)), 0.5)
        })
        .collect();
    mesh.split_edges(&splits).faces
}
