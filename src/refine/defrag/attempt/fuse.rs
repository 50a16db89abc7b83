//! Fusing the vertices of a seam (section 4.2.1).

use glam::DVec2;

use super::trial::MergeTrial;
use super::{STILL, Target};
use crate::atlas::groups::{DisjointSets, sorted_unique};

/// How much further deformation spreads where that may be.
const WIDER: f64 = 3.0;
/// And by how many mean lengths of the seam's edges at least.
const WIDER_BY: f64 = 1.5;

/// One or several UV vertices that are, or become, one.
pub(super) struct Node {
    pub vertices: Vec<u32>,
    /// Where it is, in the coordinates of the kept chart.
    pub at: DVec2,
    /// How far deformation spreads from it.
    pub reach: f64,
    /// May move in the optimisation.
    pub free: bool,
    /// Fused by the operation.
    pub seam: bool,
}

impl MergeTrial<'_> {
    /// Makes nodes of the vertices that become one, at their common place; gives the largest displacement.
    pub(super) fn fuse(&mut self, zip: &[(u32, u32)]) -> f64 {
        self.unite(zip);
        let longer = self.op.lengths[0].max(self.op.lengths[1]);
        let extra = if self.variant.wide { WIDER_BY * longer / zip.len() as f64 } else { 0.0 };
        let mut largest: f64 = 0.0;
        for n in 0..self.nodes.len() {
            let at: Vec<DVec2> = self.nodes[n].vertices.iter().map(|&u| self.aligned(u)).collect();
            let target = self.meeting_point(&self.nodes[n].vertices, &at);
            // What fits to within rounding takes the place that is there already.
            let spread = at.iter().map(|p| p.distance(target)).fold(0.0, f64::max);
            let node = &mut self.nodes[n];
            node.at = if spread <= STILL { at[0] } else { target };
            if spread > STILL {
                node.reach = self.params.alpha() * spread * if self.variant.wide { WIDER } else { 1.0 } + extra;
                node.free = self.variant.target == Target::Mean;
            }
            largest = largest.max(spread);
        }
        largest
    }

    /// Makes nodes of the vertices that become one: both ends of each pair, and what hangs together by them.
    fn unite(&mut self, zip: &[(u32, u32)]) {
        let mesh = self.mesh;
        let pairs: Vec<(u32, u32)> =
            zip.iter().flat_map(|&(h, t)| [(mesh.start(h), mesh.end(t)), (mesh.end(h), mesh.start(t))]).collect();
        let vertices: Vec<u32> = sorted_unique(pairs.iter().flat_map(|&(p, q)| [p, q]));
        let place = |u: u32| vertices.partition_point(|v| *v < u) as u32;
        let mut sets = DisjointSets::new(vertices.len());
        pairs.iter().for_each(|&(p, q)| sets.unite(place(p), place(q)));
        for own in sets.sets() {
            let vertices: Vec<u32> = own.into_iter().map(|i| vertices[i as usize]).collect();
            vertices.iter().for_each(|&u| self.workspace.set_node(u, self.nodes.len() as u32));
            self.nodes.push(Node { vertices, at: DVec2::ZERO, reach: f64::NEG_INFINITY, free: false, seam: true });
        }
    }

    /// Where vertices that become one meet; `at` are their places after alignment.
    fn meeting_point(&self, vertices: &[u32], at: &[DVec2]) -> DVec2 {
        let stays = vertices
            .iter()
            .zip(at)
            .filter(|(u, _)| self.variant.target == Target::Kept && !self.mesh.star(**u).any(|f| self.is_moved(f)))
            .map(|(_, p)| *p);
        let (sum, count) = stays.fold((DVec2::ZERO, 0.0), |(s, c), p| (s + p, c + 1.0));
        match count {
            0.0 => at.iter().sum::<DVec2>() / at.len() as f64,
            // One vertex stays bit for bit.
            1.0 => sum,
            _ => sum / count,
        }
    }

    /// A face between two vertices that become one would vanish.
    pub(super) fn collapses(&self) -> bool {
        let collapses = |f: u32| {
            let c = self.mesh.corners(f);
            let n = c.map(|u| self.workspace.node(u));
            (0..3).any(|k| c[k] != c[(k + 1) % 3] && n[k].is_some() && n[k] == n[(k + 1) % 3])
        };
        self.nodes.iter().flat_map(|n| &n.vertices).any(|&u| self.mesh.star(u).any(collapses))
    }
}
