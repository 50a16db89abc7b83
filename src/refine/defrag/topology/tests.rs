use super::*;
use crate::atlas::testing::sheet;
use crate::atlas::{Atlas, Charts, Topology, UvId};
use glam::DVec2;

/// Each square of a rectangle a chart of its own, over the rectangle's surface.
fn squares(nx: usize, ny: usize) -> Atlas {
    let mut atlas = sheet(nx, ny, DVec2::ZERO);
    let mut uv = Vec::new();
    for (f, corners) in atlas.corners.iter_mut().enumerate() {
        let offset = DVec2::new(3.0 * (f / 2) as f64, 0.0);
        let first = uv.len();
        if f % 2 == 0 {
            uv.extend(corners.map(|c| atlas.uv[c.index()] + offset));
            *corners = [first, first + 1, first + 2].map(UvId::new);
        } else {
            // The second half shares the diagonal.
            uv.push(atlas.uv[corners[2].index()] + offset);
            *corners = [first - 3, first - 1, first].map(UvId::new);
        }
    }
    atlas.uv = uv;
    atlas
}

fn mesh(atlas: &Atlas) -> MergeMesh {
    let charts = Charts::new(&Topology::new(atlas));
    MergeMesh::new(atlas, &charts, &vec![true; charts.len()], false)
}

/// Pairs of linked edges between two charts.
fn between(mesh: &MergeMesh, a: u32, b: u32) -> Vec<(u32, u32)> {
    mesh.linked_charts()[&(a, b)].iter().filter_map(|&h| mesh.linked_pair(h, a)).collect()
}

#[test]
fn one_seam_is_dissolved() {
    let mesh = mesh(&squares(2, 1));
    assert_eq!(mesh.charts().len(), 2);
    assert!(BoundaryLoops::default().stays_planar(&mesh, &between(&mesh, 0, 1), false));
}

#[test]
fn every_seam_of_a_band_may_be_dissolved() {
    // Each square of a band has a seam with either neighbour.
    let mut atlas = squares(4, 1);
    // The right end of the surface is its left end: a band.
    let width = 4.0;
    let twin: Vec<_> = (0..atlas.surface.positions.len())
        .map(|v| {
            let p = atlas.surface.positions[v];
            let x = if p.x == width { 0.0 } else { p.x };
            atlas.surface.positions.iter().position(|q| q.x == x && q.y == p.y).expect("it is there")
        })
        .collect();
    for t in &mut atlas.surface.triangles {
        *t = t.map(|v| crate::atlas::VertexId::new(twin[v.index()]));
    }
    let mesh = mesh(&atlas);
    assert_eq!(mesh.linked_charts().len(), 4, "each square has two neighbours");
    for &(a, b) in mesh.linked_charts().keys() {
        assert!(BoundaryLoops::default().stays_planar(&mesh, &between(&mesh, a, b), false));
    }
}

#[test]
fn all_seams_of_a_closed_surface_may_not_be_dissolved_at_once() {
    // Two triangles on the same three vertices: a closed surface.
    let uv = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 0.0], [5.0, 1.0], [6.0, 0.0]].map(DVec2::from).to_vec();
    let mut atlas = crate::atlas::testing::atlas(uv, vec![[0, 1, 2].map(UvId), [3, 5, 4].map(UvId)]);
    let [a, b, c] = atlas.surface.triangles[0];
    atlas.surface.triangles[1] = [a, c, b];
    let mesh = mesh(&atlas);
    let pairs = between(&mesh, 0, 1);
    assert_eq!(pairs.len(), 3);
    assert!(!BoundaryLoops::default().stays_planar(&mesh, &pairs, false), "nothing of the border would be left");
    assert!(BoundaryLoops::default().stays_planar(&mesh, &pairs[..1], false));
    assert!(BoundaryLoops::default().stays_planar(&mesh, &pairs[..2], false), "neighbours: a cone");
}
