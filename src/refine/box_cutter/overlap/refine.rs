//! The border between two clusters, made as short as it can be by a minimum cut.
//!
//! This goes beyond the published method: triangles of the two clusters that overlap each other are pinned to their sides, the
//! rest goes where the cut is cheapest. Where overlaps fall into several independent groups, each group may also change sides.

use super::graph::Graph;
use super::mincut::{MinCut, Side};
use super::partition::Partition;
use crate::context::Context;
use crate::error::Result;

/// Groups of overlapping triangles that are tried on exchanged sides, largest first.
const GROUPS: usize = 6;

/// Improves the border between clusters `a` and `b`; what was gained. Bias is not seen by the cut, but counted before a cut is
/// taken.
pub(crate) fn improve(
    graph: &Graph,
    partition: &mut Partition,
    cutter: &mut MinCut,
    (a, b): (u32, u32),
    work: &mut u64,
    context: &Context,
) -> Result<i64> {
    let mut nodes = partition.members[a as usize].clone();
    nodes.extend(&partition.members[b as usize]);
    nodes.sort_unstable();
    let groups = groups(graph, partition, &nodes, (a, b), work);
    let label = &partition.label;
    if groups.is_empty() {
        return Ok(0);
    }
    for &v in &nodes {
        cutter.side[v as usize] = Side::Free;
    }
    let set = |cutter: &mut MinCut, group: &[u32], flip: bool| {
        for &v in group {
            cutter.side[v as usize] = if (label[v as usize] == a) != flip { Side::Source } else { Side::Sink };
        }
    };
    groups.iter().for_each(|g| set(cutter, g, false));
    let before = cost_within(graph, label, &nodes, (a, b));
    let mut best = before;
    let mut taken: Option<Vec<bool>> = None;
    let mut try_cut = |cutter: &mut MinCut, best: &mut i64, work: &mut u64| -> Result<bool> {
        let flow = cutter.cut(graph, &nodes, work, context)?;
        let gained: i64 = bias_between(graph, label, &nodes, (a, b), |v| cutter.with_source(v));
        let better = flow - gained < *best;
        if better {
            *best = flow - gained;
            taken = Some(nodes.iter().map(|&v| cutter.with_source(v)).collect());
        }
        Ok(better)
    };
    let mut outcome = try_cut(cutter, &mut best, work).map(|_| ());
    if groups.len() > 1 {
        for group in groups.iter().take(GROUPS) {
            if outcome.is_err() {
                break;
            }
            set(cutter, group, true);
            match try_cut(cutter, &mut best, work) {
                Ok(true) => {}
                Ok(false) => set(cutter, group, false),
                Err(e) => outcome = Err(e),
            }
        }
    }
    for &v in &nodes {
        cutter.side[v as usize] = Side::Out;
    }
    outcome?;
    if let Some(with_source) = taken {
        for (&v, first) in nodes.iter().zip(with_source) {
            partition.label[v as usize] = if first { a } else { b };
        }
        partition.rebuild(graph, &nodes);
    }
    Ok(before - best)
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
