//! Greedy additive edge contraction that never brings overlapping triangles together: the feasible start of section 4.1.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use super::graph::Graph;
use super::partition::Partition;
use super::solve::Search;
use crate::atlas::find_root;
use crate::error::Result;

/// What lies between two clusters.
#[derive(Debug, Clone, Copy, Default)]
struct Link {
    weight: i64,
    /// Whether they touch; bias alone does not connect.
    touch: bool,
    /// Whether triangles of them are known to overlap.
    forbidden: bool,
}

impl Search<'_> {
    /// Joins clusters, the pair with the greatest weight first, while a pair without overlap gains by it.
    pub(crate) fn contract(&mut self, partition: &mut Partition) -> Result<()> {
        let graph = self.graph;
        let count = partition.members.len();
        let mut links = links(graph, partition);
        let mut root: Vec<u32> = (0..count as u32).collect();
        let degree = |m: &Vec<u32>| m.iter().map(|&v| graph.conflicts(v).len() as u64).sum();
        let mut degrees: Vec<u64> = partition.members.iter().map(degree).collect();
        let mut heap = BinaryHeap::new();
        let push = |heap: &mut BinaryHeap<_>, a: u32, b: u32, link: &Link| {
            if link.touch && !link.forbidden && link.weight > 0 {
                heap.push((link.weight, Reverse(a.min(b)), Reverse(a.max(b))));
            }
        };
        for (a, own) in links.iter().enumerate() {
            for (&b, link) in own.range(a as u32 + 1..) {
                push(&mut heap, a as u32, b, link);
            }
        }
        let mut turns = 0u32;
        while let Some((weight, Reverse(a), Reverse(b))) = heap.pop() {
            turns += 1;
            if turns.is_multiple_of(4096) {
                self.context.check()?;
            }
            // Stale: one of them is gone, or the weight has changed since.
            if !links[a as usize].get(&b).is_some_and(|l| l.weight == weight && !l.forbidden) {
                continue;
            }
            let (few, many) = if degrees[a as usize] <= degrees[b as usize] { (a, b) } else { (b, a) };
            self.work += degrees[few as usize] + 1;
            let clash = partition.members[few as usize].iter().any(|&v| {
                graph.conflicts(v).iter().any(|&u| find_root(&mut root, partition.label[u as usize]) == many)
            });
            if clash {
                for (x, y) in [(a, b), (b, a)] {
                    if let Some(link) = links[x as usize].get_mut(&y) {
                        link.forbidden = true;
                    }
                }
                continue;
            }
            // The one with more neighbours keeps its name, so that few entries move.
            let (keep, gone) = if links[a as usize].len() >= links[b as usize].len() { (a, b) } else { (b, a) };
            root[gone as usize] = keep;
            degrees[keep as usize] += degrees[gone as usize];
            let mut other = std::mem::take(&mut partition.members[gone as usize]);
            let own = &mut partition.members[keep as usize];
            if own.len() < other.len() {
                std::mem::swap(own, &mut other);
            }
            own.append(&mut other);
            links[keep as usize].remove(&gone);
            for (c, link) in std::mem::take(&mut links[gone as usize]) {
                if c == keep {
                    continue;
                }
                self.work += 1;
                links[c as usize].remove(&gone);
                let sum = links[keep as usize].entry(c).or_default();
                sum.weight += link.weight;
                sum.touch |= link.touch;
                sum.forbidden |= link.forbidden;
                let sum = *sum;
                links[c as usize].insert(keep, sum);
                push(&mut heap, keep, c, &sum);
            }
        }
        for (l, own) in partition.members.iter_mut().enumerate() {
            own.sort_unstable();
            for &v in own.iter() {
                if partition.label[v as usize] != l as u32 {
                    partition.label[v as usize] = l as u32;
                    partition.dirty[l] = true;
                }
            }
        }
        Ok(())
    }
}

fn links(graph: &Graph, partition: &Partition) -> Vec<BTreeMap<u32, Link>> {
    let mut links: Vec<BTreeMap<u32, Link>> = vec![BTreeMap::new(); partition.members.len()];
    for v in 0..graph.len() as u32 {
        let a = partition.label[v as usize];
        let near = graph.near.neighbours(v).map(|(w, weight)| (w, weight, true));
        let bias = graph.bias.neighbours(v).map(|(w, weight)| (w, -weight, false));
        for (w, weight, touch) in near.chain(bias) {
            let b = partition.label[w as usize];
            if a != b {
                let link = links[a as usize].entry(b).or_default();
                link.weight += weight;
                link.touch |= touch;
            }
        }
    }
    links
}
