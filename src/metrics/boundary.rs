//! Lengths: UV borders and 3D seams; and how often a vertex was split by them.

use glam::DVec2;

use super::measures::Totals;
use crate::atlas::bvh::Bounds;
use crate::atlas::seams::{length, uv_length};
use crate::atlas::{Atlas, Topology};

pub(super) fn add(totals: &mut Totals, atlas: &Atlas, topology: &Topology, input: &Atlas) {
    for h in topology.half_edges().filter(|h| topology.is_border(*h)) {
        totals.uv_border += uv_length(atlas, h);
        if topology.across_seam(h).is_some_and(|twin| h < twin) {
            totals.seam += length(atlas, h);
        }
    }
    totals.uv_area = atlas.faces().map(|f| atlas.uv_area(f).abs()).sum();
    totals.uv_vertices = count(atlas.uv.len(), atlas.corners.iter().flatten().map(|u| u.index()));
    let used = atlas.surface.triangles.iter().flatten().map(|v| v.index());
    totals.vertices = count(atlas.surface.positions.len(), used.clone());
    let points = used.map(|v| (atlas.surface.positions[v], atlas.surface.positions[v]));
    totals.bounds = points.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
    totals.input_side = page_boxes(input).iter().map(|b| b.size().max_element()).fold(0.0, f64::max);
}

/// How many different values below `bound` there are.
fn count(bound: usize, values: impl Iterator<Item = usize>) -> u64 {
    let mut seen = vec![false; bound];
    values.filter(|&v| !std::mem::replace(&mut seen[v], true)).count() as u64
}

/// Bounding box of the UVs of each page that has faces.
pub(super) fn page_boxes(atlas: &Atlas) -> Vec<Bounds> {
    let mut boxes = vec![Bounds::EMPTY; atlas.page.iter().map(|p| usize::from(*p) + 1).max().unwrap_or(0)];
    for f in atlas.faces() {
        let corners: [DVec2; 3] = atlas.uv_triangle(f);
        if corners.iter().all(|c| c.is_finite()) {
            let own = &mut boxes[usize::from(atlas.page[f.index()])];
            *own = own.union(Bounds::of(&corners));
        }
    }
    boxes
}
