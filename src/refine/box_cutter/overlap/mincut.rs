//! Minimum cuts between triangles that must part (Dinic's method, whole-numbered capacities).

use super::graph::{Arcs, Graph};
use crate::context::Context;
use crate::error::Result;

/// On which side of a cut a node must be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    /// Not part of this problem.
    Out,
    /// As the cut likes.
    Free,
    /// With the source.
    Source,
    /// With the sink.
    Sink,
}

const UNREACHED: u32 = u32::MAX;

/// Room for cuts on one graph; made once, used for many.
#[derive(Debug)]
pub(crate) struct MinCut {
    /// By node. Whoever sets sides sets them back to [`Side::Out`].
    pub side: Vec<Side>,
    residual: Vec<i64>,
    level: Vec<u32>,
    cursor: Vec<u32>,
}

impl MinCut {
    pub(crate) fn new(graph: &Graph) -> Self {
        let n = graph.len();
        MinCut {
            side: vec![Side::Out; n],
            residual: vec![0; graph.near.to.len()],
            level: vec![UNREACHED; n],
            cursor: vec![0; n],
        }
    }

    /// Sets the side of nodes.
    pub(crate) fn set(&mut self, nodes: &[u32], side: Side) {
        nodes.iter().for_each(|&v| self.side[v as usize] = side);
    }

    /// The weight of the cheapest cut between the sources and the sinks among `nodes`. Afterwards [`MinCut::with_source`] tells
    /// the sides: of all cheapest cuts, the one nearest to the sources.
    pub(crate) fn cut(&mut self, graph: &Graph, nodes: &[u32], work: &mut u64, context: &Context) -> Result<i64> {
        let arcs = &graph.near;
        for &v in nodes {
            self.residual[arcs.of(v)].copy_from_slice(&arcs.weight[arcs.of(v)]);
            *work += arcs.of(v).len() as u64;
        }
        let mut flow = 0;
        loop {
            context.check()?;
            if !self.levels(arcs, nodes, work) {
                return Ok(flow);
            }
            for &v in nodes {
                self.cursor[v as usize] = arcs.of(v).start as u32;
            }
            for &v in nodes {
                if self.side[v as usize] == Side::Source {
                    flow += self.push_from(arcs, v, work);
                }
            }
        }
    }

    /// After a cut: whether the node is on the side of the sources.
    pub(crate) fn with_source(&self, node: u32) -> bool {
        self.level[node as usize] != UNREACHED
    }

    /// Distances from the sources over arcs with room. False when no sink can be reached.
    fn levels(&mut self, arcs: &Arcs, nodes: &[u32], work: &mut u64) -> bool {
        let mut queue: Vec<u32> = Vec::new();
        for &v in nodes {
            let source = self.side[v as usize] == Side::Source;
            self.level[v as usize] = if source { 0 } else { UNREACHED };
            if source {
                queue.push(v);
            }
        }
        let mut nearest = UNREACHED;
        let mut head = 0;
        while let Some(&v) = queue.get(head) {
            head += 1;
            let next = self.level[v as usize] + 1;
            if next > nearest {
                break;
            }
            for i in arcs.of(v) {
                let w = arcs.to[i] as usize;
                *work += 1;
                if self.residual[i] > 0 && self.level[w] == UNREACHED && self.side[w] != Side::Out {
                    self.level[w] = next;
                    if self.side[w] == Side::Sink {
                        nearest = next;
                    } else {
                        queue.push(w as u32);
                    }
                }
            }
        }
        nearest != UNREACHED
    }

    /// Pushes what the levels admit from one source.
    fn push_from(&mut self, arcs: &Arcs, source: u32, work: &mut u64) -> i64 {
        let mut flow = 0;
        let mut path: Vec<usize> = Vec::new();
        let mut v = source;
        loop {
            if self.side[v as usize] == Side::Sink {
                let room = path.iter().map(|&i| self.residual[i]).min().unwrap_or(0);
                flow += room;
                let mut full = path.len();
                for (k, &i) in path.iter().enumerate().rev() {
                    self.residual[i] -= room;
                    self.residual[arcs.reverse[i] as usize] += room;
                    if self.residual[i] == 0 {
                        full = k;
                    }
                }
                *work += path.len() as u64;
                // Back to where the first full arc starts.
                v = path.get(full).map_or(source, |&i| arcs.to[arcs.reverse[i] as usize]);
                path.truncate(full);
                continue;
            }
            let end = arcs.of(v).end as u32;
            let mut next = None;
            while self.cursor[v as usize] < end {
                let i = self.cursor[v as usize] as usize;
                let w = arcs.to[i] as usize;
                *work += 1;
                let down = self.side[w] != Side::Out && self.level[w] == self.level[v as usize].wrapping_add(1);
                if self.residual[i] > 0 && down {
                    next = Some(i);
                    break;
                }
                self.cursor[v as usize] += 1;
            }
            match (next, path.pop()) {
                (Some(i), last) => {
                    path.extend(last);
                    path.push(i);
                    v = arcs.to[i];
                }
                (None, None) => return flow,
                (None, Some(last)) => {
                    v = arcs.to[arcs.reverse[last] as usize];
                    self.cursor[v as usize] += 1;
                }
            }
        }
    }
}
