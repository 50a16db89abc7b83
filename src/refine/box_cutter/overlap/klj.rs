//! Kernighan-Lin with joins (Keuper et al. 2015), with triangles that must not meet: chains of moves between two neighbouring
//! clusters, the join of the two, and the split of a new cluster, whichever gains most.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::graph::Graph;
use super::partition::Partition;
use super::solve::Search;
use crate::atlas::groups::sorted_unique;
use crate::error::Result;

/// A chain ends when this many moves in a row brought no new best.
const PATIENCE: usize = 400;

impl Search<'_> {
    /// Improves the border between the clusters `a` and `b`; what was gained. No move brings overlapping triangles together, so
    /// every state on the way is free of overlaps.
    pub(crate) fn move_along_border(&mut self, partition: &mut Partition, (a, b): (u32, u32)) -> Result<i64> {
        let graph = self.graph;
        self.context.check()?;
        let small = if partition.members[a as usize].len() <= partition.members[b as usize].len() { a } else { b };
        let mut start = Vec::new();
        let mut join = 0;
        for &v in &partition.members[small as usize] {
            self.work += graph.near.of(v).len() as u64;
            let mut at_border = false;
            for (w, weight) in graph.near.neighbours(v) {
                if partition.label[w as usize] == a + b - small {
                    join += weight;
                    at_border = true;
                    start.push(w);
                }
            }
            for (w, weight) in graph.bias.neighbours(v) {
                if partition.label[w as usize] == a + b - small {
                    join -= weight;
                }
            }
            if at_border {
                start.push(v);
            }
        }
        if start.is_empty() {
            return Ok(0);
        }
        let start = sorted_unique(start);
        let joinable = join > 0 && !partition.in_conflict(graph, a, b);
        let (gain, moves) = self.chain(partition, (a, b), &start);
        if joinable && join >= gain {
            let gone = std::mem::take(&mut partition.members[b as usize]);
            gone.iter().for_each(|&v| partition.label[v as usize] = a);
            partition.members[a as usize].extend(gone);
            partition.members[a as usize].sort_unstable();
            partition.dirty[a as usize] = true;
            return Ok(join);
        }
        accept(graph, partition, (a, b), gain, &moves);
        Ok(gain.max(0))
    }

    /// Moves a part of cluster `a` that bias wants elsewhere into a new cluster; what was gained.
    pub(crate) fn move_apart(&mut self, partition: &mut Partition, a: u32) -> Result<i64> {
        let graph = self.graph;
        self.context.check()?;
        let inside = |v: u32| graph.bias.neighbours(v).any(|(w, _)| partition.label[w as usize] == a);
        let start: Vec<u32> = partition.members[a as usize].iter().copied().filter(|&v| inside(v)).collect();
        self.work += partition.members[a as usize].len() as u64;
        if start.is_empty() {
            return Ok(0);
        }
        let b = partition.fresh();
        let (gain, moves) = self.chain(partition, (a, b), &start[..1]);
        accept(graph, partition, (a, b), gain, &moves);
        if gain <= 0 {
            partition.members.pop();
            partition.dirty.pop();
        }
        Ok(gain.max(0))
    }

    /// The best chain of moves that starts among `start`, and its gain. Afterwards labels are what they were before.
    fn chain(&mut self, partition: &mut Partition, (a, b): (u32, u32), start: &[u32]) -> (i64, Vec<u32>) {
        let graph = self.graph;
        let label = &mut partition.label;
        let mut heap = BinaryHeap::new();
        for &v in start {
            heap.push((gain(graph, label, v, a + b - label[v as usize]), Reverse(v)));
        }
        let (mut sum, mut best, mut length) = (0i64, 0i64, 0usize);
        let mut moves: Vec<u32> = Vec::new();
        while let Some((promised, Reverse(v))) = heap.pop() {
            let from = label[v as usize];
            if self.moved[v as usize] || (from != a && from != b) {
                continue;
            }
            let to = a + b - from;
            self.work += (graph.near.of(v).len() + graph.conflicts(v).len()) as u64;
            let now = gain(graph, label, v, to);
            if now != promised {
                // Somebody moved since; neighbours are pushed anew on each move, so the right entry is there as well.
                continue;
            }
            if graph.conflicts(v).iter().any(|&u| label[u as usize] == to) {
                continue;
            }
            self.moved[v as usize] = true;
            label[v as usize] = to;
            moves.push(v);
            sum += now;
            if sum > best {
                (best, length) = (sum, moves.len());
            }
            if moves.len() - length > PATIENCE {
                break;
            }
            let near = graph.near.neighbours(v).chain(graph.bias.neighbours(v)).map(|n| n.0);
            // Whom v kept away may now follow.
            let freed = graph
                .conflicts(v)
                .iter()
                .copied()
                .filter(|&u| graph.near.neighbours(u).any(|(w, _)| label[w as usize] == from));
            for w in near.chain(freed) {
                let own = label[w as usize];
                if !self.moved[w as usize] && (own == a || own == b) {
                    heap.push((gain(graph, label, w, a + b - own), Reverse(w)));
                }
            }
        }
        for &v in &moves {
            self.moved[v as usize] = false;
            label[v as usize] = a + b - label[v as usize];
        }
        moves.truncate(length);
        (best, moves)
    }
}

/// Makes the moves of a chain, if they gain anything.
fn accept(graph: &Graph, partition: &mut Partition, (a, b): (u32, u32), gain: i64, moves: &[u32]) {
    if gain <= 0 {
        return;
    }
    for &v in moves {
        partition.label[v as usize] = a + b - partition.label[v as usize];
    }
    // Taken, since a chain may leave nothing in one of them.
    let mut nodes = std::mem::take(&mut partition.members[a as usize]);
    nodes.append(&mut partition.members[b as usize]);
    nodes.sort_unstable();
    partition.rebuild(graph, &nodes);
}

/// By how much the cost falls when `v` moves to cluster `to`.
fn gain(graph: &Graph, label: &[u32], v: u32, to: u32) -> i64 {
    let from = label[v as usize];
    let weigh = |l: u32, weight: i64| {
        if l == to {
            weight
        } else if l == from {
            -weight
        } else {
            0
        }
    };
    let near: i64 = graph.near.neighbours(v).map(|(w, weight)| weigh(label[w as usize], weight)).sum();
    let bias: i64 = graph.bias.neighbours(v).map(|(w, weight)| weigh(label[w as usize], weight)).sum();
    near - bias
}
