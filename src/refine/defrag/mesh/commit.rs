//! Making a merge: the only place that changes the mesh.

use super::{MergeChart, MergeMesh};
use crate::atlas::bvh::Bounds;
use crate::atlas::groups::sorted_unique;
use crate::atlas::{UvId, triangle_area};
use crate::refine::defrag::attempt::Merge;
use crate::refine::defrag::operation::Operation;

impl MergeMesh {
    /// 3D area that would keep its texels in the merged chart.
    pub(crate) fn preserved_after(&self, op: &Operation, merge: &Merge) -> f64 {
        let left = |chart: u32| -> f64 {
            let lattice = self.lattice[self.chart(chart).main_part as usize];
            let deformed = merge.deformed.iter().filter(|&&f| {
                self.chart_of(f) == chart
                    && !self.deformed[f as usize]
                    && self.lattice[self.source[f as usize] as usize] == lattice
            });
            self.chart(chart).preserved_area - deformed.map(|&f| self.area[f as usize]).sum::<f64>()
        };
        let kept = left(op.kept);
        if op.is_within() {
            kept
        } else if op.whole_texels {
            kept + left(op.moved)
        } else {
            kept.max(left(op.moved))
        }
    }

    /// The chart of the input whose texels the merged chart is placed for, as far as known, and whether that is a part of the one that
    /// moves.
    pub(crate) fn main_part_after(&self, op: &Operation) -> (u32, bool) {
        let (kept, moved) = (self.chart(op.kept), self.chart(op.moved));
        if !op.whole_texels && moved.preserved_area > kept.preserved_area {
            (moved.main_part, true)
        } else {
            (kept.main_part, false)
        }
    }

    /// Does what the operation was found to do; `region` is where the chart changes by it.
    pub(crate) fn commit(&mut self, op: &Operation, merge: &Merge, region: Bounds) {
        let kept = op.kept as usize;
        let preserved_area = self.preserved_after(op, merge);
        let main_part = self.main_part_after(op).0;
        let changing = self.changing_edges(merge);
        let before = self.measured(&changing, merge);

        // Where deformable faces of the kept chart lie will have changed.
        let own: Vec<u32> = merge.deformable.iter().map(|d| d.0).filter(|&f| self.chart_of(f) == op.kept).collect();
        for &f in &own {
            let bounds = Bounds::of(&self.triangle(f));
            self.charts[kept].grid.remove(f, &bounds);
        }
        let coming = if op.is_within() { Vec::new() } else { self.bring(op) };
        self.reshape(op, merge);
        self.zip(merge);
        let after = self.measured(&changing, merge);

        if !op.is_within() {
            self.join(op, main_part);
        }
        for &f in coming.iter().chain(&own) {
            let bounds = Bounds::of(&self.triangle(f));
            self.charts[kept].grid.add(f, &bounds);
        }
        let chart = &mut self.charts[kept];
        chart.perimeter += after.0 - before.0;
        chart.area += after.1 - before.1;
        chart.preserved_area = preserved_area;
        chart.faces.extend(coming);
        chart.changes.push(region);
    }

    /// Border edges of what changes shape.
    fn changing_edges(&self, merge: &Merge) -> Vec<u32> {
        let own = merge.deformable.iter().flat_map(|&(f, _)| 3 * f..3 * f + 3).filter(|&h| self.is_border(h));
        sorted_unique(own.chain(merge.zip.iter().flat_map(|&(h, t)| [h, t])))
    }

    /// Length of those of the edges that are on a border, and area of the deformable faces.
    fn measured(&self, edges: &[u32], merge: &Merge) -> (f64, f64) {
        let border = edges.iter().filter(|&&h| self.is_border(h)).map(|&h| self.length(h)).sum();
        (border, merge.deformable.iter().map(|&(f, _)| triangle_area(&self.triangle(f))).sum())
    }

    /// Aligns the chart that moves, and gives its faces to the kept one.
    fn bring(&mut self, op: &Operation) -> Vec<u32> {
        let coming = std::mem::take(&mut self.charts[op.moved as usize].faces);
        let mut bounds = self.charts[op.kept as usize].bounds;
        for u in sorted_unique(coming.iter().flat_map(|&f| self.corners(f))) {
            let at = op.motion.transform_point2(self.uv(u));
            self.mesh.move_uv(UvId(u), at);
            bounds = bounds.union(Bounds::of(&[at]));
        }
        self.charts[op.kept as usize].bounds = bounds;
        for &f in &coming {
            self.chart_of[f as usize] = op.kept;
        }
        coming
    }

    /// Moves vertices, and notes what that does to the faces.
    fn reshape(&mut self, op: &Operation, merge: &Merge) {
        let mut bounds = self.charts[op.kept as usize].bounds;
        for &(u, at) in &merge.places {
            self.mesh.move_uv(UvId(u), at);
            bounds = bounds.union(Bounds::of(&[at]));
        }
        self.charts[op.kept as usize].bounds = bounds;
        for &(f, energy) in &merge.deformable {
            self.energy[f as usize] = energy;
        }
        for &f in &merge.deformed {
            self.deformed[f as usize] = true;
        }
    }

    /// Zips the seam: its vertices become one, pairs of linked half edges become edges inside the chart.
    fn zip(&mut self, merge: &Merge) {
        let fused: Vec<(UvId, UvId)> = merge.fuse.iter().map(|&(gone, stays)| (UvId(gone), UvId(stays))).collect();
        self.mesh.fuse(&fused);
        for h in merge.zip.iter().flat_map(|&(h, t)| [h, t]) {
            self.border[h as usize] = false;
            self.mergeable[h as usize] = false;
        }
    }

    /// The charts become one.
    fn join(&mut self, op: &Operation, main_part: u32) {
        let gone: MergeChart = std::mem::take(&mut self.charts[op.moved as usize]);
        for &part in &gone.parts {
            self.motion[part as usize] = op.motion * self.motion[part as usize];
        }
        let chart = &mut self.charts[op.kept as usize];
        if op.whole_texels {
            let (from, to) = (self.lattice[gone.main_part as usize], self.lattice[chart.main_part as usize]);
            for &part in &gone.parts {
                if self.lattice[part as usize] == from {
                    self.lattice[part as usize] = to;
                }
            }
        }
        chart.area += gone.area;
        chart.perimeter += gone.perimeter;
        chart.manifold &= gone.manifold;
        chart.parts.extend(&gone.parts);
        chart.main_part = main_part;
    }
}
