//! The multicut of one chart: start, Kernighan-Lin with joins, and what goes beyond.

use super::graph::Graph;
use super::mincut::MinCut;
use super::partition::Partition;
use super::split::End;
use crate::context::Context;
use crate::error::Result;

/// Rounds over all borders before the search is called done.
const ROUNDS: usize = 16;

/// A solution.
#[derive(Debug, Clone)]
pub(crate) struct Solved {
    /// Cluster by node: clusters are connected, and none overlaps itself.
    pub label: Vec<u32>,
    /// Edges and overlaps looked at.
    pub work: u64,
    /// Whether the work limit left a border of this solution unvisited. Starts not tried and neighbourhoods left unsplit do not
    /// count: that search has no natural end.
    pub cut_short: bool,
}

/// The search for the multicut of one graph.
pub(super) struct Search<'a> {
    pub graph: &'a Graph,
    pub cutter: MinCut,
    /// By node: moved in the present chain.
    pub moved: Vec<bool>,
    /// By node: steps from the start of the last breadth-first search.
    pub distance: Vec<u32>,
    /// Edges and overlaps looked at.
    pub work: u64,
    limit: u64,
    /// Whether the limit ended the last polish.
    cut_short: bool,
    pub context: &'a Context,
}

/// The best of contraction and of splitting top down, each polished with chains and minimum cuts, and then improved by splitting
/// neighbourhoods anew. Stops when about `limit` edges and overlaps were looked at.
pub(crate) fn solve(graph: &Graph, limit: u64, context: &Context) -> Result<Solved> {
    let mut search = Search {
        graph,
        cutter: MinCut::new(graph),
        moved: vec![false; graph.len()],
        distance: vec![u32::MAX; graph.len()],
        work: 0,
        limit,
        cut_short: false,
        context,
    };
    let mut best = Partition::singletons(graph);
    search.contract(&mut best)?;
    search.polish(&mut best)?;
    let mut cost = graph.cost(&best.label);
    let mut cut_short = search.cut_short;
    for end in End::ALL {
        if search.spent() {
            break;
        }
        let mut next = Partition::whole(graph);
        let pending = (0..next.members.len() as u32).collect();
        search.split(&mut next, pending, end)?;
        search.contract(&mut next)?;
        search.polish(&mut next)?;
        let own = graph.cost(&next.label);
        if own < cost {
            (best, cost, cut_short) = (next, own, search.cut_short);
        }
    }
    search.reshape(&mut best, &mut cost)?;
    Ok(Solved { work: search.work, cut_short, label: best.label })
}

impl Search<'_> {
    fn spent(&self) -> bool {
        self.work >= self.limit || self.context.out_of_time()
    }

    /// Improves border after border, by the chains of Kernighan and Lin and by minimum cuts, until nothing gains.
    fn polish(&mut self, partition: &mut Partition) -> Result<()> {
        let graph = self.graph;
        self.cut_short = false;
        for _ in 0..ROUNDS {
            let mut gained = 0;
            let changed = std::mem::replace(&mut partition.dirty, vec![false; partition.members.len()]);
            let was_changed = |l: u32| changed.get(l as usize).is_none_or(|c| *c);
            for (a, b) in partition.borders(graph) {
                if self.spent() {
                    self.cut_short = true;
                    return Ok(());
                }
                let touched = [a, b].iter().any(|&l| was_changed(l) || partition.dirty[l as usize]);
                if !touched || [a, b].iter().any(|&l| partition.members[l as usize].is_empty()) {
                    continue;
                }
                gained += self.move_along_border(partition, (a, b))?;
                if [a, b].iter().all(|&l| !partition.members[l as usize].is_empty()) {
                    gained += self.cut_border(partition, (a, b))?;
                }
            }
            if graph.has_bias() {
                for a in 0..partition.members.len() as u32 {
                    gained += self.move_apart(partition, a)?;
                }
            }
            if gained == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Joins each cluster with its neighbours, splits the union anew from each end, and keeps what is cheaper.
    fn reshape(&mut self, best: &mut Partition, cost: &mut i64) -> Result<()> {
        let graph = self.graph;
        let mut improved = true;
        let mut done: Vec<Vec<u32>> = Vec::new();
        while improved && !self.spent() {
            improved = false;
            // Clusters named by their first triangle: labels change.
            let mut centres: Vec<u32> = best.members.iter().filter_map(|m| m.first().copied()).collect();
            centres.sort_unstable();
            for centre in centres {
                let borders = best.borders(graph);
                let own = best.label[centre as usize];
                let around: Vec<u32> = borders
                    .iter()
                    .filter_map(|&(a, b)| if a == own { Some(b) } else { (b == own).then_some(a) })
                    .collect();
                let mut unions = vec![around.clone()];
                if around.len() > 1 {
                    unions.extend(around.iter().map(|&l| vec![l]));
                }
                for union in unions {
                    if self.spent() || around.is_empty() {
                        return Ok(());
                    }
                    let mut nodes: Vec<u32> = best.members[own as usize].clone();
                    union.iter().for_each(|&l| nodes.extend(&best.members[l as usize]));
                    nodes.sort_unstable();
                    if done.contains(&nodes) {
                        continue;
                    }
                    if self.split_anew(best, cost, own, &nodes)? {
                        improved = true;
                        break;
                    }
                    done.push(nodes);
                }
            }
        }
        Ok(())
    }

    fn split_anew(&mut self, best: &mut Partition, cost: &mut i64, own: u32, nodes: &[u32]) -> Result<bool> {
        let graph = self.graph;
        for end in End::ALL {
            if self.spent() {
                break;
            }
            let mut next = best.clone();
            next.dirty.fill(false);
            for &v in nodes {
                let old = std::mem::replace(&mut next.label[v as usize], own);
                next.members[old as usize].clear();
            }
            next.members[own as usize] = nodes.to_vec();
            let before = next.members.len() as u32;
            next.rebuild(graph, nodes);
            let pending = std::iter::once(own).chain(before..next.members.len() as u32).collect();
            self.split(&mut next, pending, end)?;
            self.work += 2 * graph.near.to.len() as u64;
            self.polish(&mut next)?;
            let reached = graph.cost(&next.label);
            if reached < *cost {
                (*best, *cost) = (next, reached);
                return Ok(true);
            }
        }
        Ok(false)
    }
}
