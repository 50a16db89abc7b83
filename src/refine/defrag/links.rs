//! Which charts are linked, by which edges (section 4).

use std::collections::{BTreeMap, BTreeSet};

use super::mesh::MergeMesh;

/// All seams between two charts, or within one.
#[derive(Debug, Default)]
pub(super) struct ChartLink {
    /// One half edge of each pair.
    pub edges: Vec<u32>,
    /// Its operations.
    pub operations: Vec<u32>,
    /// The most that one of its operations failed: those that follow on it begin with that.
    pub fails: u32,
}

/// The links of all charts.
#[derive(Debug)]
pub(super) struct ChartLinks {
    links: Vec<ChartLink>,
    /// By chart: its links by the other chart.
    of_chart: Vec<BTreeMap<u32, u32>>,
}

impl ChartLinks {
    pub(super) fn new(mesh: &MergeMesh) -> Self {
        let mut links = ChartLinks { links: Vec::new(), of_chart: vec![BTreeMap::new(); mesh.charts().len()] };
        for ((a, b), edges) in mesh.linked_charts() {
            let link = links.links.len() as u32;
            links.of_chart[a as usize].insert(b, link);
            links.of_chart[b as usize].insert(a, link);
            links.links.push(ChartLink { edges, ..ChartLink::default() });
        }
        links
    }

    /// All links.
    pub(super) fn ids(&self) -> std::ops::Range<u32> {
        0..self.links.len() as u32
    }

    pub(super) fn link(&self, link: u32) -> &ChartLink {
        &self.links[link as usize]
    }

    pub(super) fn link_mut(&mut self, link: u32) -> &mut ChartLink {
        &mut self.links[link as usize]
    }

    /// The link between two charts, or within one.
    pub(super) fn between(&self, a: u32, b: u32) -> Option<u32> {
        self.of_chart[a as usize].get(&b).copied()
    }

    /// The links of a chart, by the other chart.
    pub(super) fn of_chart(&self, chart: u32) -> Vec<(u32, u32)> {
        self.of_chart[chart as usize].iter().map(|(other, link)| (*other, *link)).collect()
    }

    /// These half edges are linked no more.
    pub(super) fn dissolve(&mut self, link: u32, zip: &[(u32, u32)]) {
        let zipped: BTreeSet<u32> = zip.iter().flat_map(|&(h, t)| [h, t]).collect();
        self.link_mut(link).edges.retain(|h| !zipped.contains(h));
    }

    /// What is left between two charts that became one is within it now; the seams of `moved` are those of `kept`. Gives the links
    /// that this changes, and the operations of links that are no more.
    pub(super) fn join(&mut self, kept: u32, moved: u32) -> (Vec<u32>, Vec<u32>) {
        let (mut changed, mut operations) = (Vec::new(), Vec::new());
        self.of_chart[kept as usize].remove(&moved);
        for (other, from) in std::mem::take(&mut self.of_chart[moved as usize]) {
            let other = if other == moved { kept } else { other };
            if other != kept {
                self.of_chart[other as usize].remove(&moved);
            }
            let Some(to) = self.between(kept, other) else {
                self.of_chart[kept as usize].insert(other, from);
                self.of_chart[other as usize].insert(kept, from);
                changed.push(from);
                continue;
            };
            changed.push(to);
            if to != from {
                let gone = std::mem::take(self.link_mut(from));
                operations.extend(gone.operations);
                let link = self.link_mut(to);
                link.edges.extend(gone.edges);
                link.fails = link.fails.max(gone.fails);
            }
        }
        (changed, operations)
    }
}
