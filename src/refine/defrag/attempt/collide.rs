//! Overlaps that an operation would make (section 4.2.3).

use super::{Trial, clash};
use crate::atlas::bvh::Bounds;
use crate::atlas::rigid::Rigid;

/// Pairs that are enough to end the search after a face.
const MOST: usize = 64;
/// Faces of a chart that lie in the cells about one, as a rule.
const AROUND: u64 = 28;

impl Trial<'_> {
    /// Whether the border of the chart that comes lies on the other chart, apart from the faces that will be deformed.
    pub(super) fn border_collides(&mut self) -> bool {
        self.collides(true)
    }

    /// Whether its interior does: that borders cross where charts overlap holds only where neither is folded.
    pub(super) fn interior_collides(&mut self) -> bool {
        self.collides(false)
    }

    fn collides(&mut self, border: bool) -> bool {
        let mesh = self.mesh;
        let [kept, moved] = [self.op.kept, self.op.moved].map(|c| &mesh.charts[c as usize]);
        let mut hit = false;
        for &f in &moved.faces {
            let at = self.aligned_triangle(f);
            let bounds = Bounds::of(&at);
            self.region = self.region.union(bounds);
            if hit || self.scratch.in_band(f).is_some() || mesh.on_border(f) != border {
                continue;
            }
            self.work += 1;
            kept.grid.query(&bounds, &kept.faces, |g| {
                hit = self.scratch.in_band(g).is_none() && clash(mesh, f, &at, g, &mesh.triangle(g));
                !hit
            });
        }
        hit
    }

    /// Faces of the band that overlap others, and those of the band that they overlap.
    pub(super) fn overlapping(&mut self) -> Vec<u32> {
        let mesh = self.mesh;
        let mut found = Vec::new();
        let placed: Vec<_> = self.band.iter().map(|&f| self.placed_triangle(f)).collect();
        let charts = if self.within() { vec![self.op.kept] } else { vec![self.op.kept, self.op.moved] };
        self.work += AROUND * (self.band.len() * charts.len()) as u64;
        for (&f, at) in self.band.iter().zip(&placed) {
            let bounds = Bounds::of(at);
            for &c in &charts {
                let comes = !self.within() && c == self.op.moved;
                let own = if comes { moved_back(&bounds, at, &self.op.motion) } else { bounds };
                let chart = &mesh.charts[c as usize];
                chart.grid.query(&own, &chart.faces, |g| {
                    if self.scratch.in_band(g).is_none() && clash(mesh, f, at, g, &self.aligned_triangle(g)) {
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
        // The band against itself: by a sweep along x.
        let bounds: Vec<Bounds> = placed.iter().map(|t| Bounds::of(t)).collect();
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
                if clash(mesh, self.band[i], &placed[i], self.band[j], &placed[j]) {
                    found.extend([self.band[i], self.band[j]]);
                }
            }
        }
        found
    }
}

/// Bounds of a triangle in the coordinates that `motion` leads from.
fn moved_back(bounds: &Bounds, at: &[glam::DVec2; 3], motion: &Rigid) -> Bounds {
    let back = motion.inverse();
    let own = Bounds::of(&at.map(|p| back.apply(p)));
    let slack = 1e-9 * bounds.max.abs().max(bounds.min.abs()).max_element().max(1.0);
    Bounds { min: own.min - slack, max: own.max + slack }
}
