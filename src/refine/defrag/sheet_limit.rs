//! How large charts may become: each has to lie on a sheet. The paper packs whatever comes of merging; where a chart fits on no sheet,
//! all would have to be scaled down.

use glam::DVec2;

use super::mesh::MergeMesh;
use super::operation::Operation;
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::back;

/// Part of a sheet's side that is kept for what is not known ahead: deformation moves borders.
const SPARE: f64 = 0.01;

/// The largest size of a chart.
#[derive(Debug, Clone, Copy)]
pub(super) struct SheetLimit {
    /// Sides in texels, the longer first.
    sides: [f64; 2],
}

impl SheetLimit {
    /// `sides` are those of the largest chart that has a sheet to lie on. There is no limit where a chart of the input is larger: all
    /// are scaled down then.
    pub(super) fn new(mesh: &MergeMesh, sides: [f64; 2]) -> Option<Self> {
        let fits = |b: &Bounds| SheetLimit { sides }.growth(b.size()) >= 1.0;
        let fit = mesh.charts().iter().all(|c| !c.bounds.size().is_finite() || fits(&c.bounds));
        fit.then(|| SheetLimit { sides: sides.map(|s| s * (1.0 - SPARE)) })
    }

    /// By how much a chart of this size may grow in both directions; below one, it does not fit. By a quarter turn it may.
    pub(super) fn growth(&self, size: DVec2) -> f64 {
        f64::min(self.sides[0] / size.max_element(), self.sides[1] / size.min_element())
    }

    /// Whether the two charts of the operation fit once they are one, turned as they will be placed.
    pub(super) fn allows(&self, mesh: &MergeMesh, op: &Operation) -> bool {
        if op.is_within() {
            return true;
        }
        let (kept, moved) = (mesh.chart(op.kept), mesh.chart(op.moved));
        let Bounds { min, max } = moved.bounds;
        let corners =
            [min, DVec2::new(max.x, min.y), max, DVec2::new(min.x, max.y)].map(|p| op.motion.transform_point2(p));
        let both = kept.bounds.union(Bounds::of(&corners));
        if both.size().length() <= self.sides[1] {
            return true;
        }
        let turn = match mesh.main_part_after(op) {
            (part, true) => back(&(op.motion * mesh.motion[part as usize])),
            (part, false) => back(&mesh.motion[part as usize]),
        };
        let exact = [(kept, turn), (moved, turn * op.motion)]
            .into_iter()
            .flat_map(|(chart, motion)| chart.faces.iter().map(move |&f| (f, motion)))
            .map(|(f, motion)| Bounds::of(&mesh.triangle(f).map(|p| motion.transform_point2(p))))
            .fold(Bounds::EMPTY, Bounds::union);
        self.growth(exact.size()) >= 1.0
    }
}
