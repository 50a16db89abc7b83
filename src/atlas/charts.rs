//! Charts and their boundary loops, derived from the topology.

use super::{Atlas, ChartId, FaceId, HalfEdge, Topology, UvId};

/// The charts of an Atlas: connected components of faces over UV edges.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Charts {
    /// Chart by [`FaceId`]. Charts are numbered by their smallest face.
    pub of_face: Vec<ChartId>,
    /// Faces by [`ChartId`], ascending.
    pub faces: Vec<Vec<FaceId>>,
}

impl Charts {
    /// Derives the charts.
    pub fn new(topology: &Topology) -> Self {
        let n = topology.len() / 3;
        let mut of_face = vec![ChartId(u32::MAX); n];
        let mut faces: Vec<Vec<FaceId>> = Vec::new();
        let mut incident: Vec<[FaceId; 2]> = topology.incident_faces().flat_map(|[a, b]| [[a, b], [b, a]]).collect();
        incident.sort_unstable();
        let mut stack = Vec::new();
        for seed in 0..n {
            if of_face[seed].0 != u32::MAX {
                continue;
            }
            let chart = ChartId::new(faces.len());
            of_face[seed] = chart;
            stack.push(seed);
            let mut members = Vec::new();
            while let Some(f) = stack.pop() {
                let own = FaceId::new(f);
                members.push(own);
                let twins = (0..3).filter_map(|k| topology.uv_twin(HalfEdge::of(own, k))).map(HalfEdge::face);
                let start = incident.partition_point(|p| p[0] < own);
                let others = incident[start..].iter().take_while(|p| p[0] == own).map(|p| p[1]);
                for g in twins.chain(others).map(FaceId::index) {
                    if of_face[g].0 == u32::MAX {
                        of_face[g] = chart;
                        stack.push(g);
                    }
                }
            }
            members.sort_unstable();
            faces.push(members);
        }
        Charts { of_face, faces }
    }

    /// Number of charts.
    pub fn len(&self) -> usize {
        self.faces.len()
    }

    /// Whether there is no chart.
    pub fn is_empty(&self) -> bool {
        self.faces.is_empty()
    }

    /// All charts in order.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = ChartId> + use<> {
        (0..self.faces.len()).map(ChartId::new)
    }
}

/// The closed boundary loops of an Atlas' charts, each a cycle of border half edges.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Loops {
    /// Chart of each loop.
    pub chart: Vec<ChartId>,
    /// Half edges of each loop, in order; the end of one is the start of the next.
    pub half_edges: Vec<Vec<HalfEdge>>,
}

impl Loops {
    /// Walks every border edge once, turning about each border vertex over the faces of its fan,
    /// so that a chart that touches itself at a vertex gives separate loops.
    pub fn new(topology: &Topology, charts: &Charts) -> Self {
        let mut seen = vec![false; topology.len()];
        let mut chart = Vec::new();
        let mut half_edges = Vec::new();
        for start in topology.half_edges() {
            if !topology.is_border(start) || seen[start.index()] {
                continue;
            }
            let mut cycle = Vec::new();
            let mut h = start;
            while !seen[h.index()] {
                seen[h.index()] = true;
                cycle.push(h);
                h = topology.next_on_boundary(h);
            }
            chart.push(charts.of_face[start.face().index()]);
            half_edges.push(cycle);
        }
        Loops { chart, half_edges }
    }

    /// The UV vertices of a loop, in order.
    pub fn uv_vertices<'a>(&'a self, atlas: &'a Atlas, index: usize) -> impl Iterator<Item = UvId> + 'a {
        self.half_edges[index].iter().map(|h| atlas.corners[h.face().index()][h.corner()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::atlas;
    use glam::DVec2;

    #[test]
    fn all_faces_on_one_uv_edge_are_one_chart() {
        // Three fins on the edge 0-1, wound alike, and a face that is folded onto it.
        let uv = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.3, 1.0], [0.6, 1.0]].map(DVec2::from).to_vec();
        let fins = [[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 1]].map(|c| c.map(UvId));
        let charts = Charts::new(&Topology::new(&atlas(uv, fins.to_vec())));
        assert_eq!(charts.len(), 1);
    }
}
