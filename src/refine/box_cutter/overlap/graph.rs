//! The graph of Box Cutter, section 4.1: the triangles of one chart, what pulls them together and what keeps them apart.

use rayon::prelude::*;

use crate::atlas::groups::Grouped;
use crate::atlas::overlap::overlaps_in_blocks;
use crate::atlas::seams::{rigid_seams, seam_runs, uv_length, weld_tolerance};
use crate::atlas::{Atlas, Charts, FaceId, HalfEdge, Topology};
use crate::context::Context;
use crate::error::Result;

/// An edge of average length weighs this much. Weights are whole numbers, so that sums do not depend on their order.
pub(crate) const UNIT: f64 = 65536.0;
const HEAVIEST: f64 = (1u64 << 40) as f64;

/// Weighted neighbours of every node, each edge stored at both ends.
#[derive(Debug, Clone, Default)]
pub(crate) struct Arcs {
    /// By node, one more than nodes: its first arc.
    start: Vec<u32>,
    /// By arc: the other node.
    pub to: Vec<u32>,
    /// By arc.
    pub weight: Vec<i64>,
    /// By arc: the same edge at the other node.
    pub reverse: Vec<u32>,
}

impl Arcs {
    pub(crate) fn new(nodes: usize, edges: &[(u32, u32, i64)]) -> Self {
        let mut start = vec![0u32; nodes + 1];
        for e in edges {
            start[e.0 as usize + 1] += 1;
            start[e.1 as usize + 1] += 1;
        }
        for i in 0..nodes {
            start[i + 1] += start[i];
        }
        let mut next = start.clone();
        let n = 2 * edges.len();
        let mut arcs = Arcs { start, to: vec![0; n], weight: vec![0; n], reverse: vec![0; n] };
        for &(a, b, weight) in edges {
            let (i, j) = (next[a as usize], next[b as usize]);
            next[a as usize] += 1;
            next[b as usize] += 1;
            (arcs.to[i as usize], arcs.reverse[i as usize], arcs.weight[i as usize]) = (b, j, weight);
            (arcs.to[j as usize], arcs.reverse[j as usize], arcs.weight[j as usize]) = (a, i, weight);
        }
        arcs
    }

    /// The arcs of a node.
    pub(crate) fn of(&self, node: u32) -> std::ops::Range<usize> {
        self.start[node as usize] as usize..self.start[node as usize + 1] as usize
    }

    /// (other node, weight) of each edge of a node.
    pub(crate) fn neighbours(&self, node: u32) -> impl Iterator<Item = (u32, i64)> + '_ {
        self.of(node).map(|i| (self.to[i], self.weight[i]))
    }
}

/// The graph of one chart. Nodes are positions in `faces`.
#[derive(Debug)]
pub(crate) struct Graph {
    /// The chart's triangles.
    pub faces: Vec<FaceId>,
    /// Neighbours in the chart; cutting between them costs the weight.
    pub near: Arcs,
    /// Lifted: separating these two gains the weight.
    pub bias: Arcs,
    /// By node: those that it overlaps.
    conflicts: Grouped<u32>,
}

impl Graph {
    /// The graph of given edges, for `nodes` nodes.
    pub(crate) fn from_edges(
        nodes: usize,
        near: &[(u32, u32, i64)],
        bias: &[(u32, u32, i64)],
        conflicts: &[(u32, u32)],
    ) -> Self {
        let conflicts = Grouped::new(nodes, conflicts.iter().flat_map(|&(a, b)| [(a, b), (b, a)]));
        Graph {
            faces: (0..nodes).map(FaceId::new).collect(),
            near: Arcs::new(nodes, near),
            bias: Arcs::new(nodes, bias),
            conflicts,
        }
    }

    /// Number of nodes.
    pub(crate) fn len(&self) -> usize {
        self.faces.len()
    }

    /// The nodes that a node overlaps.
    pub(crate) fn conflicts(&self, node: u32) -> &[u32] {
        self.conflicts.of(node)
    }

    /// Whether there is any bias.
    pub(crate) fn has_bias(&self) -> bool {
        !self.bias.to.is_empty()
    }

    /// Sets the bias edges.
    pub(crate) fn set_bias(&mut self, edges: &[(u32, u32, i64)]) {
        self.bias = Arcs::new(self.len(), edges);
    }

    /// What a labelling costs: the weight of all edges cut, less the bias gained.
    pub(crate) fn cost(&self, label: &[u32]) -> i64 {
        let cut = |arcs: &Arcs| -> i64 {
            let own = |v: u32| arcs.neighbours(v).filter(move |n| n.0 > v && label[n.0 as usize] != label[v as usize]);
            (0..self.len() as u32).flat_map(own).map(|n| n.1).sum()
        };
        cut(&self.near) - cut(&self.bias)
    }
}

/// What the graphs of all charts have in common.
pub(crate) struct Scale<'a> {
    pub atlas: &'a Atlas,
    pub topology: &'a Topology,
    /// Factor on the length of an edge.
    pub weight: Option<&'a (dyn Fn(HalfEdge) -> f64 + Sync)>,
    /// Average UV edge length of the atlas.
    pub average: f64,
}

impl<'a> Scale<'a> {
    pub(crate) fn new(
        atlas: &'a Atlas,
        topology: &'a Topology,
        weight: Option<&'a (dyn Fn(HalfEdge) -> f64 + Sync)>,
    ) -> Self {
        let lengths = topology.half_edges().map(|h| uv_length(atlas, h)).filter(|l| l.is_finite());
        let (sum, count) = lengths.fold((0.0, 0.0), |(s, n), l| (s + l, n + 1.0));
        Scale { atlas, topology, weight, average: if sum > 0.0 { sum / count } else { 1.0 } }
    }

    /// l / l_avg, times the importance of the edge, in whole numbers.
    pub(crate) fn of(&self, h: HalfEdge) -> i64 {
        let importance = self.weight.map_or(1.0, |w| w(h));
        let weight = uv_length(self.atlas, h) / self.average * importance * UNIT;
        if weight.is_finite() { weight.round().clamp(1.0, HEAVIEST) as i64 } else { UNIT as i64 }
    }
}

/// Builds the graph of a chart from its overlapping pairs, without bias. Nodes are positions in `faces`, which ascend.
pub(crate) fn build(scale: &Scale, faces: &[FaceId], pairs: &[(u32, u32)]) -> Graph {
    let local = |f: FaceId| faces.binary_search(&f).ok().map(|i| i as u32);
    let mut near = Vec::with_capacity(faces.len() * 3 / 2);
    for (i, f) in faces.iter().enumerate() {
        for h in (0..3).map(|k| HalfEdge::of(*f, k)) {
            let twin = scale.topology.uv_twin(h).filter(|twin| *twin > h);
            if let Some(j) = twin.and_then(|twin| local(twin.face())) {
                near.push((i as u32, j, scale.of(h)));
            }
        }
    }
    // The faces of a non-manifold edge hang together, but it costs nothing to part them: their edge is a border already.
    let incident = scale.topology.incident_faces().filter_map(|[f, g]| Some((local(f)?, local(g)?, 1)));
    near.extend(incident.filter(|e| e.0 != e.1));
    Graph { faces: faces.to_vec(), ..Graph::from_edges(faces.len(), &near, &[], pairs) }
}

/// Bias edges of the given charts, as faces: across each stretch of at least two edges of a globally continuous boundary of one
/// chart (a single edge of equal length is no evidence) [4.1].
pub(crate) fn bias_edges(scale: &Scale, charts: &Charts, wanted: &[bool]) -> Vec<(FaceId, FaceId, i64)> {
    let tolerance = weld_tolerance(scale.atlas);
    let mut found = Vec::new();
    for run in seam_runs(scale.atlas, scale.topology, charts) {
        if run.charts[0] != run.charts[1] || !wanted[run.charts[0].index()] {
            continue;
        }
        for seam in rigid_seams(scale.atlas, scale.topology, &run, tolerance).iter().filter(|s| s.edges.len() > 1) {
            for &h in &seam.edges {
                let other = scale.topology.surface_twin(h).map(HalfEdge::face);
                if let Some(other) = other.filter(|f| *f != h.face()) {
                    found.push((h.face(), other, scale.of(h)));
                }
            }
        }
    }
    found
}

/// Pair tests per face before a chart counts as too crowded to list.
const TESTS_PER_FACE: usize = 4_000;

/// The overlapping pairs block by block, with whether a block was too crowded to list, until `visit` says false.
fn pairs_in_blocks(
    atlas: &Atlas,
    faces: &[FaceId],
    context: &Context,
    mut visit: impl FnMut(Vec<(u32, u32)>, bool) -> bool,
) -> Result<()> {
    let visit = |pairs, cut| {
        context.check()?;
        Ok(visit(pairs, cut))
    };
    overlaps_in_blocks(atlas, faces, (TESTS_PER_FACE, usize::MAX), |_| true, visit)
}

/// How many pairs of the faces overlap, or `None` when there are more than `limit`.
pub(crate) fn count_pairs(atlas: &Atlas, faces: &[FaceId], limit: usize, context: &Context) -> Result<Option<usize>> {
    let (mut count, mut complete) = (0, true);
    pairs_in_blocks(atlas, faces, context, |pairs, cut| {
        count += pairs.len();
        complete = !cut && count <= limit;
        complete
    })?;
    Ok(complete.then_some(count))
}

/// The overlapping pairs, as positions in `faces`, sorted.
pub(crate) fn list_pairs(atlas: &Atlas, faces: &[FaceId], context: &Context) -> Result<Vec<(u32, u32)>> {
    let mut all = Vec::new();
    pairs_in_blocks(atlas, faces, context, |pairs, cut| {
        all.extend(pairs);
        !cut
    })?;
    all.par_sort_unstable();
    Ok(all)
}
