//! Clusters: charts that share texels on purpose, and are placed as one.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::bvh::{Bounds, Bvh};
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

impl Clusters {
    /// Clusters from a label by chart; equal labels are together.
    fn from_labels(label: &[u32]) -> Self {
        let mut number = vec![u32::MAX; label.len()];
        let mut of_chart = Vec::with_capacity(label.len());
        let mut charts: Vec<Vec<ChartId>> = Vec::new();
        for (chart, &l) in label.iter().enumerate() {
            let own = &mut number[l as usize];
            if *own == u32::MAX {
                *own = charts.len() as u32;
                charts.push(Vec::new());
            }
            of_chart.push(*own);
            charts[*own as usize].push(ChartId::new(chart));
        }
        Clusters { of_chart, charts }
    }
}

/// Joins charts that overlap, directly or through others ([`OverlapMode::Stack`]), or leaves each alone.
pub fn clusters(atlas: &Atlas, charts: &Charts, mode: OverlapMode) -> Clusters {
    let alone: Vec<u32> = (0..charts.len() as u32).collect();
    match mode {
        OverlapMode::Separate => Clusters::from_labels(&alone),
        OverlapMode::Stack => {
            let bodies = ChartBvhs::new(atlas, charts);
            let boxes: Vec<Bounds> = bodies.place.iter().map(|p| p.1).collect();
            Clusters::from_labels(&components(&boxes, |a, b| bodies.overlap(a, b)))
        }
    }
}

/// Overlaps that one item looks for in one round.
const HITS: usize = 4;

/// Connected components of the overlap graph: by item, the smallest item that it hangs together with.
///
/// In each round every item looks for a few neighbours outside its component among the later ones, all at once and against
/// the components of the round before; subtrees that lie wholly in its component are not entered. So a
/// stack of n equal items takes O(n log^2 n) and not n^2 tests, and the result does not depend on the order.
pub(crate) fn components(boxes: &[Bounds], overlap: impl Fn(usize, usize) -> bool + Sync) -> Vec<u32> {
    let tree = Bvh::new(boxes);
    let mut parent: Vec<u32> = (0..boxes.len() as u32).collect();
    // By position in the tree.
    let mut open: Vec<u32> = (0..boxes.len() as u32).collect();
    while !open.is_empty() {
        let label: Vec<u32> = (0..boxes.len() as u32).map(|i| find_root(&mut parent, i)).collect();
        let by_position: Vec<u32> = tree.order.iter().map(|&i| label[i as usize]).collect();
        let common = tree.common_labels(&by_position);
        let hits: Vec<Vec<u32>> = open
            .par_iter()
            .map(|&at| {
                let i = tree.order[at as usize];
                let own = label[i as usize];
                let mut hits = Vec::new();
                tree.query(
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
                let (a, b) = (find_root(&mut parent, i), find_root(&mut parent, j));
                parent[a.max(b) as usize] = a.min(b);
            }
            if hits.len() == HITS {
                still.push(at);
            }
        }
        open = still;
    }
    (0..boxes.len() as u32).map(|i| find_root(&mut parent, i)).collect()
}

/// The smallest member of the set that `i` is in (union-find with path halving).
pub(crate) fn find_root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        parent[i as usize] = parent[parent[i as usize] as usize];
        i = parent[i as usize];
    }
    i
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
        let mut expected: Vec<u32> = (0..300).collect();
        for (a, b) in overlapping_charts(&atlas, &charts) {
            let (a, b) = (find_root(&mut expected, a.0), find_root(&mut expected, b.0));
            expected[a.max(b) as usize] = a.min(b);
        }
        let expected: Vec<u32> = (0..300).map(|i| find_root(&mut expected, i)).collect();
        let found = clusters(&atlas, &charts, OverlapMode::Stack);
        assert_eq!(found, Clusters::from_labels(&expected));
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
