//! The border between two clusters, made as short as it can be by a minimum cut.
//!
//! This goes beyond the published method: triangles of the two clusters that overlap each other are pinned to their sides, the
//! rest goes where the cut is cheapest. Where overlaps fall into several independent groups, each group may also change sides.

use super::graph::Graph;
use super::mincut::Side;
use super::partition::Partition;
use super::solve::Search;
use crate::error::Result;

/// Groups of overlapping triangles that are tried on exchanged sides, largest first.
const GROUPS: usize = 6;

/// The best cut so far of the border between two clusters.
struct BestCut {
    cost: i64,
    /// By node: whether it lies with the sources. None where the border is best as it is.
    with_source: Option<Vec<bool>>,
}

impl Search<'_> {
    /// Improves the border between clusters `a` and `b`; what was gained. Bias is not seen by the cut, but counted before a cut is
    /// taken.
    pub(crate) fn cut_border(&mut self, partition: &mut Partition, (a, b): (u32, u32)) -> Result<i64> {
        let mut nodes = partition.members[a as usize].clone();
        nodes.extend(&partition.members[b as usize]);
        nodes.sort_unstable();
        let groups = groups(self.graph, partition, &nodes, (a, b), &mut self.work);
        if groups.is_empty() {
            return Ok(0);
        }
        self.cutter.set(&nodes, Side::Free);
        groups.iter().for_each(|group| self.pin(group, &partition.label, a));
        let before = cost_within(self.graph, &partition.label, &nodes, (a, b));
        let mut best = BestCut { cost: before, with_source: None };
        self.try_cut(partition, &nodes, (a, b), &mut best)?;
        if groups.len() > 1 {
            for group in groups.iter().take(GROUPS) {
                self.pin(group, &partition.label, b);
                if !self.try_cut(partition, &nodes, (a, b), &mut best)? {
                    self.pin(group, &partition.label, a);
                }
            }
        }
        self.cutter.set(&nodes, Side::Out);
        if let Some(with_source) = best.with_source {
            for (&v, first) in nodes.iter().zip(with_source) {
                partition.label[v as usize] = if first { a } else { b };
            }
            partition.rebuild(self.graph, &nodes);
        }
        Ok(before - best.cost)
    }

    /// Pins a group's nodes of the cluster `first` to the sources, its others to the sinks.
    fn pin(&mut self, group: &[u32], label: &[u32], first: u32) {
        for &v in group {
            self.cutter.side[v as usize] = if label[v as usize] == first { Side::Source } else { Side::Sink };
        }
    }

    /// Cuts, and says whether that is better than before.
    fn try_cut(
        &mut self,
        partition: &Partition,
        nodes: &[u32],
        clusters: (u32, u32),
        best: &mut BestCut,
    ) -> Result<bool> {
        let flow = self.cutter.cut(self.graph, nodes, &mut self.work, self.context)?;
        let first = |v| self.cutter.with_source(v);
        let cost = flow - bias_between(self.graph, &partition.label, nodes, clusters, first);
        let better = cost < best.cost;
        if better {
            *best = BestCut { cost, with_source: Some(nodes.iter().map(|&v| first(v)).collect()) };
        }
        Ok(better)
    }
}

/// The triangles of `a` and `b` that overlap each other, in groups connected by overlaps; the largest first.
fn groups(graph: &Graph, partition: &Partition, nodes: &[u32], (a, b): (u32, u32), work: &mut u64) -> Vec<Vec<u32>> {
    let label = &partition.label;
    let mut seen = vec![false; nodes.len()];
    let place = |v: u32| nodes.binary_search(&v).unwrap_or(0);
    let mut groups = Vec::new();
    for &seed in &partition.members[a as usize] {
        if seen[place(seed)] || !graph.conflicts(seed).iter().any(|&u| label[u as usize] == b) {
            continue;
        }
        seen[place(seed)] = true;
        let mut group = vec![seed];
        let mut head = 0;
        while let Some(&v) = group.get(head) {
            head += 1;
            *work += graph.conflicts(v).len() as u64 + 1;
            let other = a + b - label[v as usize];
            for &u in graph.conflicts(v) {
                if label[u as usize] == other && !std::mem::replace(&mut seen[place(u)], true) {
                    group.push(u);
                }
            }
        }
        groups.push(group);
    }
    groups.sort_by_key(|g| std::cmp::Reverse(g.len()));
    groups
}

/// What the present border between `a` and `b` costs, bias counted.
fn cost_within(graph: &Graph, label: &[u32], nodes: &[u32], (a, b): (u32, u32)) -> i64 {
    let in_a = nodes.iter().filter(|&&v| label[v as usize] == a);
    let near: i64 = in_a
        .flat_map(|&v| graph.near.neighbours(v))
        .filter(|(w, _)| label[*w as usize] == b)
        .map(|(_, weight)| weight)
        .sum();
    near - bias_between(graph, label, nodes, (a, b), |v| label[v as usize] == a)
}

/// Bias gained when the nodes of `a` and `b` for which `first` holds lie on one side, the others on the other.
fn bias_between(graph: &Graph, label: &[u32], nodes: &[u32], (a, b): (u32, u32), first: impl Fn(u32) -> bool) -> i64 {
    if !graph.has_bias() {
        return 0;
    }
    let inside = |w: u32| label[w as usize] == a || label[w as usize] == b;
    nodes
        .iter()
        .filter(|&&v| first(v))
        .flat_map(|&v| graph.bias.neighbours(v))
        .filter(|(w, _)| inside(*w) && !first(*w))
        .map(|(_, weight)| weight)
        .sum()
}
