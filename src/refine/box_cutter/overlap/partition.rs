//! Clusters of triangles, kept connected.

use super::graph::Graph;
use crate::atlas::groups::sorted_unique;

/// A division of a graph's nodes into clusters. A label without members is free.
#[derive(Debug, Clone)]
pub(crate) struct Partition {
    /// Cluster by node.
    pub label: Vec<u32>,
    /// Nodes by cluster, ascending where [`Partition::rebuild`] made them.
    pub members: Vec<Vec<u32>>,
    /// By cluster: changed since somebody cleared it.
    pub dirty: Vec<bool>,
}

impl Partition {
    /// Every node alone.
    pub(crate) fn singletons(graph: &Graph) -> Self {
        let n = graph.len() as u32;
        Partition { label: (0..n).collect(), members: (0..n).map(|v| vec![v]).collect(), dirty: vec![true; n as usize] }
    }

    /// All nodes together, as far as they are connected.
    pub(crate) fn whole(graph: &Graph) -> Self {
        Self::from_labels(graph, vec![0; graph.len()])
    }

    /// The clusters of a labelling, as far as they are connected.
    pub(crate) fn from_labels(graph: &Graph, label: Vec<u32>) -> Self {
        let clusters = label.iter().max().map_or(0, |m| *m as usize + 1);
        let mut members = vec![Vec::new(); clusters];
        for (v, l) in label.iter().enumerate() {
            members[*l as usize].push(v as u32);
        }
        let nodes: Vec<u32> = (0..graph.len() as u32).collect();
        let mut all = Partition { label, dirty: vec![true; clusters], members };
        all.rebuild(graph, &nodes);
        all
    }

    /// A new, empty cluster.
    pub(crate) fn fresh(&mut self) -> u32 {
        self.members.push(Vec::new());
        self.dirty.push(true);
        self.members.len() as u32 - 1
    }

    /// Makes connected clusters of `nodes`, which must be all members of every label they carry: the first part of a
    /// label keeps it, further parts get new ones.
    pub(crate) fn rebuild(&mut self, graph: &Graph, nodes: &[u32]) {
        const UNSEEN: u32 = 1 << 31;
        for &v in nodes {
            let l = self.label[v as usize];
            self.members[l as usize].clear();
            self.dirty[l as usize] = true;
            self.label[v as usize] = l | UNSEEN;
        }
        let mut stack = Vec::new();
        for &seed in nodes {
            let raw = self.label[seed as usize];
            if raw & UNSEEN == 0 {
                continue;
            }
            let old = raw & !UNSEEN;
            let own = if self.members[old as usize].is_empty() { old } else { self.fresh() };
            let mut part = Vec::new();
            self.label[seed as usize] = own;
            stack.push(seed);
            while let Some(v) = stack.pop() {
                part.push(v);
                for (w, _) in graph.near.neighbours(v) {
                    if self.label[w as usize] == raw {
                        self.label[w as usize] = own;
                        stack.push(w);
                    }
                }
            }
            part.sort_unstable();
            self.members[own as usize] = part;
        }
    }

    /// The pairs of clusters with a common border, sorted.
    pub(crate) fn borders(&self, graph: &Graph) -> Vec<(u32, u32)> {
        let mut pairs = Vec::new();
        for v in 0..graph.len() as u32 {
            let a = self.label[v as usize];
            for (w, _) in graph.near.neighbours(v) {
                let b = self.label[w as usize];
                if a < b && pairs.last() != Some(&(a, b)) {
                    pairs.push((a, b));
                }
            }
        }
        sorted_unique(pairs)
    }

    /// Whether two nodes of the clusters `a` and `b` overlap (or, for `a == b`, two of one).
    pub(crate) fn in_conflict(&self, graph: &Graph, a: u32, b: u32) -> bool {
        let (few, many) =
            if self.members[a as usize].len() <= self.members[b as usize].len() { (a, b) } else { (b, a) };
        self.members[few as usize].iter().any(|&v| graph.conflicts(v).iter().any(|&u| self.label[u as usize] == many))
    }
}
