//! Cutting a cluster that overlaps itself in two, top down.
//!
//! This goes beyond the published method. A sheet of triangles that is free of overlaps is grown from the far end of the cluster;
//! what it overlaps must lie on the other side; the cheapest cut between the two is taken. Repeated until nothing overlaps.
//! Where one sheet lies over another this finds the shortest cut at once, which contraction from single triangles may miss.

use super::graph::Graph;
use super::mincut::{MinCut, Side};
use super::partition::Partition;
use super::solve::Search;
use crate::error::Result;

/// From which end the sheet is grown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    /// The overlapping triangle farthest from the cluster's first triangle.
    Far,
    /// The overlapping triangle farthest from that one.
    Opposite,
    /// The overlapping triangle with the most overlaps.
    Crowded,
    /// The first overlapping triangle.
    First,
}

impl End {
    pub(crate) const ALL: [End; 4] = [End::Far, End::Opposite, End::Crowded, End::First];
}

impl Search<'_> {
    /// Cuts the given clusters until none of them overlaps itself.
    pub(crate) fn split(&mut self, partition: &mut Partition, mut pending: Vec<u32>, end: End) -> Result<()> {
        let graph = self.graph;
        while let Some(cluster) = pending.pop() {
            self.context.check()?;
            let label = &partition.label;
            let inside = |v: u32| label[v as usize] == cluster;
            let nodes = partition.members[cluster as usize].clone();
            let clashes = |v: u32| graph.conflicts(v).iter().any(|&u| inside(u));
            self.work += nodes.len() as u64;
            let Some(seed) = self.seed(&nodes, end, &inside, &clashes) else { continue };
            self.cutter.set(&nodes, Side::Free);
            grow_sheet(graph, seed, &mut self.cutter, &inside, &mut self.work);
            self.cutter.cut(graph, &nodes, &mut self.work, self.context)?;
            self.cutter.set(&nodes, Side::Out);
            let other = partition.fresh();
            for &v in &nodes {
                if self.cutter.with_source(v) {
                    partition.label[v as usize] = other;
                }
            }
            let before = partition.members.len() as u32;
            partition.rebuild(graph, &nodes);
            pending.extend([cluster, other].into_iter().chain(before..partition.members.len() as u32));
        }
        Ok(())
    }

    /// The triangle to start from, or `None` where no two triangles overlap.
    fn seed(
        &mut self,
        nodes: &[u32],
        end: End,
        inside: &dyn Fn(u32) -> bool,
        clashes: &dyn Fn(u32) -> bool,
    ) -> Option<u32> {
        let first = nodes.iter().copied().find(|&v| clashes(v))?;
        match end {
            End::First => Some(first),
            End::Crowded => {
                let graph = self.graph;
                let crowd = |v: u32| graph.conflicts(v).iter().filter(|&&u| inside(u)).count();
                nodes.iter().copied().max_by_key(|&v| (crowd(v), std::cmp::Reverse(v)))
            }
            End::Far => Some(self.farthest(nodes, nodes[0], inside, clashes).unwrap_or(first)),
            End::Opposite => {
                let far = self.farthest(nodes, nodes[0], inside, clashes).unwrap_or(first);
                Some(self.farthest(nodes, far, inside, clashes).unwrap_or(first))
            }
        }
    }

    fn farthest(
        &mut self,
        nodes: &[u32],
        from: u32,
        inside: &dyn Fn(u32) -> bool,
        wanted: &dyn Fn(u32) -> bool,
    ) -> Option<u32> {
        for &v in nodes {
            self.distance[v as usize] = u32::MAX;
        }
        let mut queue = vec![from];
        self.distance[from as usize] = 0;
        let mut head = 0;
        while let Some(&v) = queue.get(head) {
            head += 1;
            for (w, _) in self.graph.near.neighbours(v) {
                if inside(w) && self.distance[w as usize] == u32::MAX {
                    self.distance[w as usize] = self.distance[v as usize] + 1;
                    queue.push(w);
                }
            }
        }
        queue.into_iter().rev().find(|&v| wanted(v))
    }
}

/// Pins a connected sheet of overlapping triangles about `seed` to the source side, as large as it gets without overlapping
/// itself, and all that it overlaps to the sink side.
fn grow_sheet(graph: &Graph, seed: u32, cutter: &mut MinCut, inside: &dyn Fn(u32) -> bool, work: &mut u64) {
    let side = &mut cutter.side;
    let mut queue = vec![seed];
    side[seed as usize] = Side::Source;
    let mut head = 0;
    while let Some(&v) = queue.get(head) {
        head += 1;
        for &u in graph.conflicts(v) {
            if side[u as usize] == Side::Free {
                side[u as usize] = Side::Sink;
            }
        }
        *work += graph.conflicts(v).len() as u64;
        for (w, _) in graph.near.neighbours(v) {
            let meets = |s: Side| graph.conflicts(w).iter().any(|&u| side[u as usize] == s && inside(u));
            let overlaps = side[w as usize] == Side::Free && graph.conflicts(w).iter().any(|&u| inside(u));
            if overlaps && !meets(Side::Source) {
                side[w as usize] = Side::Source;
                queue.push(w);
            }
        }
    }
}
