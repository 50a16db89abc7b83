//! Clusters: charts that share texels on purpose, and are placed as one.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::bvh::{Bounds, Bvh};
use super::groups::DisjointSets;
use super::overlap::ChartBvhs;
use super::{Atlas, ChartId, Charts};

/// What happens to charts that share texels in the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OverlapMode {
    /// They stay together and are placed as one.
    Stack,
    /// Each gets its own place.
    Separate,
}

/// Which charts are placed together.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Clusters {
    /// Cluster by [`ChartId`]. Clusters are numbered by their smallest chart.
    pub of_chart: Vec<u32>,
    /// Charts by cluster, ascending.
    pub charts: Vec<Vec<ChartId>>,
}

/// Joins charts that overlap, directly or through others ([`OverlapMode::Stack`]), or leaves each alone.
pub fn clusters(atlas: &Atlas, charts: &Charts, mode: OverlapMode) -> Clusters {
    let mut sets = match mode {
        OverlapMode::Separate => DisjointSets::new(charts.len()),
        OverlapMode::Stack => {
            let bodies = ChartBvhs::new(atlas, charts);
            let boxes: Vec<Bounds> = bodies.place.iter().map(|p| p.1).collect();
            components(&boxes, |a, b| bodies.overlap(a, b))
        }
    };
    let (of_chart, charts) = sets.numbered();
    Clusters { of_chart, charts: charts.into_iter().map(|own| own.into_iter().map(ChartId).collect()).collect() }
}

/// Overlaps that one item looks for in one round.
const HITS: usize = 4;

/// Connected components of the overlap graph.
///
/// In each round every item looks for a few neighbours outside its component among the later ones, all at once and against
/// the components of the round before; subtrees that lie wholly in its component are not entered. So a
/// stack of n equal items takes O(n log^2 n) and not n^2 tests, and the result does not depend on the order.
pub(crate) fn components(boxes: &[Bounds], overlap: impl Fn(usize, usize) -> bool + Sync) -> DisjointSets {
    let tree = Bvh::new(boxes);
    let mut sets = DisjointSets::new(boxes.len());
    // By position in the tree.
    let mut open: Vec<u32> = (0..boxes.len() as u32).collect();
    while !open.is_empty() {
        let label: Vec<u32> = (0..boxes.len() as u32).map(|i| sets.find(i)).collect();
        let by_position: Vec<u32> = tree.order.iter().map(|&i| label[i as usize]).collect();
        let common = tree.common_labels(&by_position);
        let hits: Vec<Vec<u32>> = open
            .par_iter()
            .map(|&at| {
                let i = tree.order[at as usize];
                let own = label[i as usize];
                let mut hits = Vec::new();
                tree.query_nodes(
                    &boxes[i as usize],
                    at as usize + 1,
                    |node| common[node] != Some(own),
                    |p| {
                        let j = tree.order[p];
                        if by_position[p] != own && overlap(i as usize, j as usize) {
                            hits.push(j);
                        }
                        hits.len() < HITS
                    },
                );
                hits
            })
            .collect();
        let mut still = Vec::new();
        for (&at, hits) in open.iter().zip(&hits) {
            let i = tree.order[at as usize];
            for &j in hits {
                sets.unite(i, j);
            }
            if hits.len() == HITS {
                still.push(at);
            }
        }
        open = still;
    }
    sets
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{Rng, join, sheet, soup};
    use crate::atlas::{Topology, overlapping_charts};
    use glam::DVec2;

    #[test]
    fn clusters_are_the_components_of_overlapping_charts() {
        let mut rng = Rng(11);
        let triangles: Vec<[DVec2; 3]> = (0..300)
            .map(|_| {
                let p = rng.point(100.0);
                [p, p + rng.point(7.0), p + rng.point(7.0)]
            })
            .collect();
        let atlas = soup(&triangles);
        let charts = Charts::new(&Topology::new(&atlas));
        let mut expected = DisjointSets::new(300);
        for (a, b) in overlapping_charts(&atlas, &charts) {
            expected.unite(a.0, b.0);
        }
        let found = clusters(&atlas, &charts, OverlapMode::Stack);
        assert_eq!(found.of_chart, expected.numbered().0);
        assert!(found.charts.len() > 20 && found.charts.len() < 280, "both kinds occur");
        assert_eq!(clusters(&atlas, &charts, OverlapMode::Separate).charts.len(), charts.len());
    }

    #[test]
    fn a_high_stack_is_one_cluster_and_quick() {
        let mut stack = sheet(4, 4, DVec2::ZERO);
        for _ in 0..11 {
            stack = join(&stack, &stack);
        }
        let atlas = join(&sheet(2, 2, DVec2::new(4.0, 0.0)), &stack); // the first touches the stack
        let charts = Charts::new(&Topology::new(&atlas));
        let found = clusters(&atlas, &charts, OverlapMode::Stack);
        assert_eq!(found.charts.len(), 2);
        assert_eq!(found.charts[0], [ChartId(0)]);
    }
}
