//! What is deformable: the faces near the seam (section 4.2.2).

use std::cmp::Ordering;
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
        // The furthest first; all are finite.
        let mut heap: BinaryHeap<Front> = (radius.iter().enumerate())
            .filter(|(_, radius)| **radius >= 0.0)
            .map(|(n, radius)| Front { left: *radius, node: n as u32, source: n as u32 })
            .collect();
        while let Some(Front { left, node, source }) = heap.pop() {
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
                        heap.push(Front { left, node, source });
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

/// A vertex reached from a fused one.
struct Front {
    /// How much further it goes.
    left: f64,
    node: u32,
    source: u32,
}

impl PartialEq for Front {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Front {}

impl PartialOrd for Front {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Front {
    fn cmp(&self, other: &Self) -> Ordering {
        self.left.total_cmp(&other.left).then(other.node.cmp(&self.node)).then(other.source.cmp(&self.source))
    }
}
