//! The atlas while its charts are being merged: half edges over the layout, and what merging knows of faces and charts beside them.
//!
//! Faces are wound so that neighbours in a chart run along their common edge in opposite directions and each chart's area is positive:
//! what the upload wound the other way round is turned here, and turned back at the end.
//!
//! The mesh is read in `half_edges.rs` and edited in `commit.rs`, and nowhere else.

mod build;
mod commit;
mod half_edges;
mod winding;

use glam::DVec2;

use super::face_grid::FaceGrid;
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;
use crate::atlas::{Atlas, Mesh, UvId, orientation};
use crate::numeric::energy::{arap, jacobian};

/// A chart under merging.
#[derive(Debug, Clone, Default)]
pub(super) struct MergeChart {
    /// Its faces; none once it is part of another.
    pub faces: Vec<u32>,
    /// UV area.
    pub area: f64,
    /// UV length of the border.
    pub perimeter: f64,
    /// Where it lies, or a little more.
    pub bounds: Bounds,
    /// Faces by place.
    pub grid: FaceGrid,
    /// Charts of the input that it is made of.
    pub parts: Vec<u32>,
    /// The one of them whose texels it is placed for, as far as known.
    pub main_part: u32,
    /// Whether its border falls into loops: not where more than two faces share an edge.
    pub manifold: bool,
    /// Whether it may be merged at all.
    pub mergeable: bool,
    /// What became of it, in order: where it changed, in its own coordinates.
    pub changes: Vec<Bounds>,
    /// 3D area that keeps its texels if the chart is placed for it: an estimate.
    pub preserved_area: f64,
}

/// The atlas under merging: the mesh, and what merging keeps beside it.
#[derive(Debug, Clone)]
pub(super) struct MergeMesh {
    /// Every UV vertex belongs to one chart.
    mesh: Mesh,
    /// By half edge: whether it is part of a border. One whose ends became one with those of its twin still is, until it is merged itself.
    border: Vec<bool>,
    /// By half edge: whether its seam may be merged: the two sides run in opposite directions.
    mergeable: Vec<bool>,
    /// By face.
    chart_of: Vec<u32>,
    /// Whether the face's winding was reversed.
    reversed: Vec<bool>,
    /// By chart.
    charts: Vec<MergeChart>,
    /// UV triangles of the input.
    pub rest: Vec<[DVec2; 3]>,
    /// Their area, zero where they have no shape.
    pub weight: Vec<f64>,
    /// 3D area by face.
    pub area: Vec<f64>,
    /// By face: its chart in the input.
    pub source: Vec<u32>,
    /// By chart of the input: how it moved, after it was mirrored where it was.
    pub motion: Vec<Rigid>,
    /// By chart of the input: whether it was mirrored (x to -x), its triangles in `rest` too.
    pub mirrored: Vec<bool>,
    /// By chart of the input: one whose texels lie on the same lattice as its own.
    lattice: Vec<u32>,
    /// By face: reversed against most of its chart, so that in the input's winding it looks right where it is folded.
    pub against_chart: Vec<bool>,
    /// By face: deformed, and not only moved.
    pub deformed: Vec<bool>,
    /// By face: its energy times its weight.
    pub energy: Vec<f64>,
    /// Distances below this are rounding.
    pub tolerance: f64,
}

impl MergeMesh {
    /// All charts, those that are part of another too.
    pub(super) fn charts(&self) -> &[MergeChart] {
        &self.charts
    }

    /// A chart.
    pub(super) fn chart(&self, chart: u32) -> &MergeChart {
        &self.charts[chart as usize]
    }

    /// Length of all seams that may be merged, each once.
    pub(super) fn seam_length(&self) -> f64 {
        0.5 * self.half_edges().filter(|&h| self.linked(h).is_some()).map(|h| self.length(h)).sum::<f64>()
    }

    /// Energy of a face if it lay there, times its weight.
    pub(super) fn energy_at(&self, face: u32, at: &[DVec2; 3]) -> f64 {
        let weight = self.weight[face as usize];
        if weight == 0.0 {
            return 0.0;
        }
        let rest = &self.rest[face as usize];
        let energy = |rest: &[DVec2; 3]| jacobian(rest, at).map_or(0.0, |j| weight * arap(&j));
        if sign(rest) < 0 { energy(rest).min(energy(&rest.map(mirror))) } else { energy(rest) }
    }

    /// The shape that a face should have: one that was folded over in the input is mirrored back where it gets the chance. Not one of two
    /// that lie back to back.
    pub(super) fn target_shape(&self, face: u32) -> [DVec2; 3] {
        let rest = self.rest[face as usize];
        let [a, b, c] = [0, 1, 2].map(|k| self.twin(3 * face + k).map(|t| t / 3));
        let back_to_back = a == b && a.is_some() || b == c && b.is_some() || a == c && a.is_some();
        if sign(&rest) < 0 && !back_to_back && !self.against_chart[face as usize] { rest.map(mirror) } else { rest }
    }

    /// The atlas with the merged charts, faces wound as they were; `before` is the one that the mesh was made from, `at` says where a
    /// face comes to lie.
    pub(super) fn to_atlas(&self, before: &Atlas, at: impl Fn(u32) -> [DVec2; 3]) -> Atlas {
        let mut atlas = Atlas { uv: Vec::new(), ..before.clone() };
        let mut name = vec![u32::MAX; self.vertex_count()];
        for f in self.faces() {
            let now = at(f);
            let own = self.corners(f);
            let mut corners = [0, 1, 2].map(|k| {
                let name = &mut name[own[k] as usize];
                if *name == u32::MAX {
                    *name = atlas.uv.len() as u32;
                    atlas.uv.push(now[k]);
                }
                UvId(*name)
            });
            if self.reversed[f as usize] {
                corners.swap(1, 2);
            }
            atlas.corners[f as usize] = corners;
        }
        atlas
    }
}

/// The mirror image of a point.
pub(super) fn mirror(p: DVec2) -> DVec2 {
    DVec2::new(-p.x, p.y)
}

/// The sign of a triangle's area, exact.
pub(super) fn sign(t: &[DVec2; 3]) -> i8 {
    orientation(t[0], t[1], t[2])
}
