//! Charts and their boundary loops, derived from the topology.

use super::groups::DisjointSets;
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
        let mut sets = DisjointSets::new(topology.len() / 3);
        for h in topology.half_edges() {
            if let Some(twin) = topology.uv_twin(h).filter(|twin| *twin > h) {
                sets.unite(h.face().0, twin.face().0);
            }
        }
        topology.incident_faces().for_each(|[f, g]| sets.unite(f.0, g.0));
        let (of_face, faces) = sets.numbered();
        let faces = faces.into_iter().map(|own| own.into_iter().map(FaceId).collect()).collect();
        Charts { of_face: of_face.into_iter().map(ChartId).collect(), faces }
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
