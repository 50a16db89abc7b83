//! Making a merge: the only place that changes the mesh.

use super::attempt::Merge;
use super::mesh::{Mesh, NONE};
use super::operation::Operation;
use crate::atlas::bvh::Bounds;

impl Mesh {
    /// 3D area that would keep its texels in the merged chart.
    pub(super) fn kept_after(&self, op: &Operation, merge: &Merge) -> f64 {
        let lost = |chart: u32| -> f64 {
            let grid = self.grid_of[self.charts[chart as usize].main as usize];
            merge
                .deformed
                .iter()
                .filter(|&&f| {
                    self.chart_of[f as usize] == chart
                        && !self.deformed[f as usize]
                        && self.grid_of[self.home[f as usize] as usize] == grid
                })
                .map(|&f| self.area[f as usize])
                .sum()
        };
        let rest = |chart: u32| self.charts[chart as usize].kept - lost(chart);
        let kept = rest(op.kept);
        if op.kept == op.moved {
            kept
        } else if op.whole_texels {
            kept + rest(op.moved)
        } else {
            kept.max(rest(op.moved))
        }
    }

    /// The chart of the input whose texels the merged chart is placed for, as far as known, and whether that is a part of the one that
    /// comes.
    pub(super) fn main_after(&self, op: &Operation) -> (u32, bool) {
        let (kept, moved) = (&self.charts[op.kept as usize], &self.charts[op.moved as usize]);
        if !op.whole_texels && moved.kept > kept.kept { (moved.main, true) } else { (kept.main, false) }
    }

    /// Does what the operation was found to do.
    pub(super) fn commit(&mut self, op: &Operation, merge: &Merge, region: Bounds) {
        let (kept, moved) = (op.kept as usize, op.moved as usize);
        let within = kept == moved;
        let kept_area = self.kept_after(op, merge);
        let (main, _) = self.main_after(op);

        // Border and area of what changes shape, before.
        let mut edges: Vec<u32> = merge
            .band
            .iter()
            .flat_map(|&(f, _)| 3 * f..3 * f + 3)
            .filter(|&h| self.twin[h as usize] == NONE)
            .chain(merge.zip.iter().flat_map(|&(h, t)| [h, t]))
            .collect();
        edges.sort_unstable();
        edges.dedup();
        let border = |mesh: &Mesh| -> f64 {
            edges.iter().filter(|&&h| mesh.twin[h as usize] == NONE).map(|&h| mesh.length(h)).sum()
        };
        let area = |mesh: &Mesh| -> f64 {
            let one = |f: u32| {
                let t = mesh.triangle(f);
                0.5 * (t[1] - t[0]).perp_dot(t[2] - t[0]).abs()
            };
            merge.band.iter().map(|&(f, _)| one(f)).sum()
        };
        let before = (border(self), area(self));
        // Where faces of the band that stay lie will have changed.
        let own: Vec<u32> =
            merge.band.iter().map(|b| b.0).filter(|&f| within || self.chart_of[f as usize] == op.kept).collect();
        for &f in &own {
            let bounds = Bounds::of(&self.triangle(f));
            self.charts[kept].grid.remove(f, &bounds);
        }

        // The chart that comes.
        let coming = if within { Vec::new() } else { std::mem::take(&mut self.charts[moved].faces) };
        let mut vertices: Vec<u32> = coming.iter().flat_map(|&f| self.corners[f as usize]).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let mut bounds = self.charts[kept].bounds;
        for &u in &vertices {
            self.uv[u as usize] = op.motion.apply(self.uv[u as usize]);
            bounds = bounds.union(Bounds::of(&[self.uv[u as usize]]));
        }
        for &f in &coming {
            self.chart_of[f as usize] = op.kept;
        }

        for &(u, at) in &merge.places {
            self.uv[u as usize] = at;
            bounds = bounds.union(Bounds::of(&[at]));
        }
        self.charts[kept].bounds = bounds;
        for &(gone, stays) in &merge.fuse {
            for f in std::mem::take(&mut self.star[gone as usize]) {
                for corner in &mut self.corners[f as usize] {
                    if *corner == gone {
                        *corner = stays;
                    }
                }
                if !self.star[stays as usize].contains(&f) {
                    self.star[stays as usize].push(f);
                }
            }
        }
        for &(h, t) in &merge.zip {
            (self.twin[h as usize], self.twin[t as usize]) = (t, h);
            (self.link[h as usize], self.link[t as usize]) = (NONE, NONE);
            let [hn, hp, tn, tp] =
                [self.next[h as usize], self.prev[h as usize], self.next[t as usize], self.prev[t as usize]];
            for (before, to) in [(hp, tn), (tp, hn)] {
                if before != NONE && to != NONE {
                    self.next[before as usize] = to;
                    self.prev[to as usize] = before;
                }
            }
        }
        for &(f, energy) in &merge.band {
            self.energy[f as usize] = energy;
        }
        for &f in &merge.deformed {
            self.deformed[f as usize] = true;
        }
        let after = (border(self), area(self));

        // The charts become one.
        if !within {
            let gone = std::mem::take(&mut self.charts[moved]);
            for &part in &gone.parts {
                self.motion[part as usize] = op.motion.after(&self.motion[part as usize]);
            }
            if op.whole_texels {
                let (from, to) = (self.grid_of[gone.main as usize], self.grid_of[self.charts[kept].main as usize]);
                for &part in &gone.parts {
                    if self.grid_of[part as usize] == from {
                        self.grid_of[part as usize] = to;
                    }
                }
            }
            let chart = &mut self.charts[kept];
            chart.area += gone.area;
            chart.perimeter += gone.perimeter;
            chart.sound &= gone.sound;
            chart.parts.extend(&gone.parts);
            chart.main = main;
        }
        self.charts[kept].area += after.1 - before.1;
        self.charts[kept].perimeter += after.0 - before.0;
        self.charts[kept].kept = kept_area;
        for f in coming.iter().copied().chain(own) {
            let bounds = Bounds::of(&self.triangle(f));
            self.charts[kept].grid.add(f, &bounds);
        }
        let chart = &mut self.charts[kept];
        chart.faces.extend(coming);
        chart.changes.push(region);
    }
}
