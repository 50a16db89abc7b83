//! What is deformable: the faces near the seam (section 4.2.2).

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::fuse::Node;
use super::trial::MergeTrial;
use super::{Reason, Target};

/// Vertices that one merge may deform: at all, where one chart gives way alone, and where deformation spreads further than published.
/// Beyond, such merges all but never succeed.
const WIDEST: [usize; 3] = [6_000, 1_500, 200];

impl MergeTrial<'_> {
    /// Vertices that it may deform.
    fn widest(&self) -> usize {
        WIDEST[if self.variant.wide { 2 } else { usize::from(self.variant.target == Target::Kept) }]
    }

    /// Spreads deformation from the seam: a vertex within alpha displacements of a fused one is free. Distances are taken to the fused
    /// vertex through which a vertex was reached.
    pub(super) fn spread(&mut self) {
        let mesh = self.mesh;
        let radius: Vec<f64> = self.nodes.iter().map(|n| n.reach).collect();
        // How much further deformation goes, the furthest first, the vertex reached, and the fused one; compared as bits: none is negative.
        let entry = |left: f64, node: u32, source: u32| (left.to_bits(), Reverse(node), Reverse(source));
        let mut heap: BinaryHeap<_> =
            (0..).zip(&radius).filter(|(_, r)| **r >= 0.0).map(|(n, r)| entry(*r, n, n)).collect();
        while let Some((left, Reverse(node), Reverse(source))) = heap.pop() {
            let left = f64::from_bits(left);
            if left < self.nodes[node as usize].reach || self.nodes.len() > self.widest() {
                continue;
            }
            let from = self.nodes[source as usize].at;
            for i in 0..self.nodes[node as usize].vertices.len() {
                let u = self.nodes[node as usize].vertices[i];
                if self.must_stay(u) {
                    continue;
                }
                let neighbours = mesh.star(u).flat_map(|f| mesh.corners(f)).filter(|w| *w != u);
                for w in neighbours {
                    let left = radius[source as usize] - self.aligned(w).distance(from);
                    if left >= 0.0
                        && let Some(node) = self.reached(w, left)
                    {
                        heap.push(entry(left, node, source));
                    }
                }
            }
        }
    }

    /// A vertex is reached, with so much left; gives its node if that is the most so far.
    fn reached(&mut self, vertex: u32, left: f64) -> Option<u32> {
        let n = self.workspace.node(vertex).unwrap_or_else(|| {
            let n = self.nodes.len() as u32;
            let (vertices, at) = (vec![vertex], self.aligned(vertex));
            self.workspace.set_node(vertex, n);
            self.nodes.push(Node { vertices, at, reach: f64::NEG_INFINITY, free: true, seam: false });
            n
        });
        let node = &mut self.nodes[n as usize];
        if node.seam && self.variant.target == Target::Kept || left <= node.reach {
            return None;
        }
        node.reach = left;
        node.free = true;
        Some(n)
    }

    /// Collects the faces with a corner that moves.
    pub(super) fn find_deformable(&mut self) -> Result<(), Reason> {
        if self.nodes.len() > self.widest() {
            return Err(Reason::Local);
        }
        let moves = |trial: &Self, node: &Node, u: u32| node.free || trial.aligned(u) != node.at;
        for n in 0..self.nodes.len() {
            for i in 0..self.nodes[n].vertices.len() {
                let u = self.nodes[n].vertices[i];
                if !moves(self, &self.nodes[n], u) {
                    continue;
                }
                for f in self.mesh.star(u) {
                    if self.workspace.make_deformable(f) {
                        self.deformable.push(f);
                    }
                }
            }
        }
        Ok(())
    }
}
