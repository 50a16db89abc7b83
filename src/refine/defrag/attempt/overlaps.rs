//! Overlaps that an operation would make (section 4.2.3).

use glam::DVec2;

use super::trial::MergeTrial;
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::{Rigid, back};
use crate::atlas::{penetration, triangles_overlap};
use crate::refine::defrag::mesh::MergeMesh;

/// Overlaps that are enough to end the search after a face.
const MOST: usize = 64;
/// Faces of a chart that lie in the cells around one, as a rule.
const NEARBY: u64 = 28;

impl MergeTrial<'_> {
    /// Whether the border of the chart that moves lies on the other chart, apart from what is deformable.
    pub(super) fn border_collides(&mut self) -> bool {
        self.collides(true)
    }

    /// Whether its interior does: that borders cross where charts overlap holds only where neither is folded.
    pub(super) fn interior_collides(&mut self) -> bool {
        self.collides(false)
    }

    fn collides(&mut self, border: bool) -> bool {
        let mesh = self.mesh;
        let kept = mesh.chart(self.op.kept);
        let mut hit = false;
        for &f in &mesh.chart(self.op.moved).faces {
            let at = self.aligned_triangle(f);
            let bounds = Bounds::of(&at);
            self.region = self.region.union(bounds);
            if hit || self.workspace.is_deformable(f) || mesh.touches_border(f) != border {
                continue;
            }
            self.work += 1;
            kept.grid.query(&bounds, &kept.faces, |g| {
                hit = !self.workspace.is_deformable(g) && new_overlap(mesh, f, &at, g, &mesh.triangle(g));
                !hit
            });
        }
        hit
    }

    /// Deformable faces that overlap others, and deformable ones that they overlap.
    pub(super) fn overlapping(&mut self) -> Vec<u32> {
        let placed: Vec<[DVec2; 3]> = self.deformable.iter().map(|&f| self.placed_triangle(f)).collect();
        let mut found = self.overlapping_others(&placed);
        self.overlapping_each_other(&placed, &mut found);
        found
    }

    fn overlapping_others(&mut self, placed: &[[DVec2; 3]]) -> Vec<u32> {
        let mesh = self.mesh;
        let within = self.op.is_within();
        let charts = if within { vec![self.op.kept] } else { vec![self.op.kept, self.op.moved] };
        self.work += NEARBY * (self.deformable.len() * charts.len()) as u64;
        let mut found = Vec::new();
        for (&f, at) in self.deformable.iter().zip(placed) {
            let bounds = Bounds::of(at);
            for &c in &charts {
                let own = if !within && c == self.op.moved { moved_back(&bounds, at, &self.op.motion) } else { bounds };
                let chart = mesh.chart(c);
                chart.grid.query(&own, &chart.faces, |g| {
                    if !self.workspace.is_deformable(g) && new_overlap(mesh, f, at, g, &self.aligned_triangle(g)) {
                        found.push(f);
                    }
                    // All of this face: what is found does not depend on the order in which the others lie in the grid.
                    true
                });
            }
            if found.len() >= MOST {
                break;
            }
        }
        found
    }

    /// By a sweep along x.
    fn overlapping_each_other(&mut self, placed: &[[DVec2; 3]], found: &mut Vec<u32>) {
        let bounds: Vec<Bounds> = placed.iter().map(Bounds::of).collect();
        let mut order: Vec<u32> = (0..placed.len() as u32).collect();
        order.sort_unstable_by(|&a, &b| bounds[a as usize].min.x.total_cmp(&bounds[b as usize].min.x).then(a.cmp(&b)));
        for (n, &i) in order.iter().enumerate() {
            let i = i as usize;
            for &j in &order[n + 1..] {
                let j = j as usize;
                if bounds[j].min.x > bounds[i].max.x || found.len() >= MOST {
                    break;
                }
                if !bounds[i].meets(&bounds[j]) {
                    continue;
                }
                self.work += 1;
                if new_overlap(self.mesh, self.deformable[i], &placed[i], self.deformable[j], &placed[j]) {
                    found.extend([self.deformable[i], self.deformable[j]]);
                }
            }
        }
    }
}

/// Whether two faces overlap that did not in the input, or more than there.
pub(in crate::refine::defrag) fn new_overlap(
    mesh: &MergeMesh,
    f: u32,
    at: &[DVec2; 3],
    g: u32,
    there: &[DVec2; 3],
) -> bool {
    let slack = 5.0 * mesh.tolerance;
    if !triangles_overlap(at, there) {
        return false;
    }
    let depth = penetration(at, there);
    if depth <= slack {
        return false;
    }
    let (p, q) = (&mesh.rest[f as usize], &mesh.rest[g as usize]);
    let before = penetration(p, q);
    before == 0.0 || depth > before * 1.01 + slack
}

/// Bounds of a triangle in the coordinates that `motion` leads from.
fn moved_back(bounds: &Bounds, at: &[DVec2; 3], motion: &Rigid) -> Bounds {
    let back = back(motion);
    let own = Bounds::of(&at.map(|p| back.transform_point2(p)));
    let slack = 1e-9 * bounds.max.abs().max(bounds.min.abs()).max_element().max(1.0);
    Bounds { min: own.min - slack, max: own.max + slack }
}
