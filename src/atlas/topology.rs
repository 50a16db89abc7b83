//! Which face lies across which edge. Topology knows no positions.

use std::collections::BTreeMap;

use super::groups::{Grouped, sorted_unique};
use super::{Atlas, FaceId, HalfEdge, UvId};

/// Adjacency of an Atlas' faces, in UV and on the surface.
///
/// Two faces are neighbours in UV when they share an edge with the same two UV vertices and the
/// same two surface vertices; such an edge is interior to a chart. An edge shared by more than two
/// faces is non-manifold: its faces are paired in the order of opposite direction first, then of face
/// index, and what is left over is border.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Topology {
    /// By half edge: the half edge across, in the same chart, or [`HalfEdge::NONE`].
    uv_twin: Vec<HalfEdge>,
    /// By half edge: the half edge across on the welded surface, or [`HalfEdge::NONE`] at the mesh boundary.
    /// Where `uv_twin` is one, both agree.
    surface_twin: Vec<HalfEdge>,
    /// By UV edge with more than two faces, ends ascending: pairs of neighbours among them. They hang together though
    /// `uv_twin` may not say so: a chart is all faces that share UV edges. An edge without length, the only kind that a triangle
    /// collapsed to a point has, counts here from two faces on.
    incident: BTreeMap<(UvId, UvId), Vec<[FaceId; 2]>>,
}

impl Topology {
    /// Derives the adjacency of `atlas`.
    pub fn new(atlas: &Atlas) -> Self {
        let n = atlas.corners.len() * 3;
        let mut own =
            Topology { uv_twin: vec![HalfEdge::NONE; n], surface_twin: vec![HalfEdge::NONE; n], ..Topology::default() };
        let keys = sorted_edges(n, |h| ends(&atlas.corners, h).map(|u| u.0));
        for run in keys.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
            let pairs = own.pair_in_uv(run);
            own.set_incident((UvId(run[0].0), UvId(run[0].1)), pairs);
        }
        let collapsed = own.half_edges().map(|h| (ends(&atlas.corners, h), h.face())).filter(|(e, _)| e[0] == e[1]);
        let points: Vec<(UvId, FaceId)> = sorted_unique(collapsed.map(|(ends, face)| (ends[0], face)));
        for run in points.chunk_by(|a, b| a.0 == b.0) {
            own.set_incident((run[0].0, run[0].0), neighbours(run.iter().map(|p| p.1)));
        }
        own.surface_twin.copy_from_slice(&own.uv_twin);
        let keys = sorted_edges(n, |h| ends(&atlas.surface.triangles, h).map(|v| v.0));
        for run in keys.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
            own.pair_on_surface(run);
        }
        own
    }

    /// Number of half edges: three for each face.
    pub fn len(&self) -> usize {
        self.uv_twin.len()
    }

    /// Whether there is no face.
    pub fn is_empty(&self) -> bool {
        self.uv_twin.is_empty()
    }

    /// All half edges in order.
    pub fn half_edges(&self) -> impl ExactSizeIterator<Item = HalfEdge> + DoubleEndedIterator + use<> {
        (0..self.uv_twin.len() as u32).map(HalfEdge)
    }

    /// The half edge across, in the same chart; `None` at the chart's border.
    pub fn uv_twin(&self, half_edge: HalfEdge) -> Option<HalfEdge> {
        self.uv_twin[half_edge.index()].some()
    }

    /// The half edge across on the welded surface; `None` at the mesh boundary. Where [`Self::uv_twin`] is one, both agree.
    pub fn surface_twin(&self, half_edge: HalfEdge) -> Option<HalfEdge> {
        self.surface_twin[half_edge.index()].some()
    }

    /// Whether the edge is a border of its chart.
    pub fn is_border(&self, half_edge: HalfEdge) -> bool {
        self.uv_twin[half_edge.index()] == HalfEdge::NONE
    }

    /// The half edge across on the surface, where that is a seam: interior to the surface, border of a chart.
    pub fn across_seam(&self, half_edge: HalfEdge) -> Option<HalfEdge> {
        if self.is_border(half_edge) { self.surface_twin(half_edge) } else { None }
    }

    /// Whether the edge is a seam.
    pub fn is_seam(&self, half_edge: HalfEdge) -> bool {
        self.across_seam(half_edge).is_some()
    }

    /// Pairs of faces that share a UV edge with more than two faces (or one without length): they are of one chart even where no
    /// twin says so.
    pub fn incident_faces(&self) -> impl Iterator<Item = [FaceId; 2]> {
        self.incident.values().flatten().copied()
    }

    /// The border half edge that follows a border half edge about its end vertex, over the faces of its fan: the next of its boundary
    /// loop. A chart that touches itself at a vertex has separate loops there.
    pub fn next_on_boundary(&self, half_edge: HalfEdge) -> HalfEdge {
        let mut current = half_edge.next();
        // A fan has at most as many faces as there are half edges; inconsistent winding cannot trap us.
        for _ in 0..self.uv_twin.len() {
            match self.uv_twin(current) {
                Some(twin) => current = twin.next(),
                None => return current,
            }
        }
        current
    }

    /// Pairs the half edges of one UV edge: those that run up with those that run down, then by number. Gives what
    /// [`Self::set_incident`] is to be told of the edge.
    pub(super) fn pair_in_uv(&mut self, run: &[Key]) -> Vec<[FaceId; 2]> {
        pair_run(run, &mut self.uv_twin, |_| false);
        if run.len() > 2 { neighbours(run.iter().map(|r| r.3.face())) } else { Vec::new() }
    }

    /// Pairs the half edges of one surface edge; those that are twins in UV stay.
    pub(super) fn pair_on_surface(&mut self, run: &[Key]) {
        let uv_twin = &self.uv_twin;
        pair_run(run, &mut self.surface_twin, |h| uv_twin[h.index()] != HalfEdge::NONE);
    }

    /// The twins of a half edge as they are stored: in UV and on the surface.
    pub(super) fn twins(&self, half_edge: HalfEdge) -> [HalfEdge; 2] {
        [self.uv_twin[half_edge.index()], self.surface_twin[half_edge.index()]]
    }

    /// Sets both twins of a half edge.
    pub(super) fn set_twins(&mut self, half_edge: HalfEdge, [uv, surface]: [HalfEdge; 2]) {
        self.uv_twin[half_edge.index()] = uv;
        self.surface_twin[half_edge.index()] = surface;
    }

    /// What the twin in UV says holds on the surface too.
    pub(super) fn copy_uv_twin(&mut self, half_edge: HalfEdge) {
        self.surface_twin[half_edge.index()] = self.uv_twin[half_edge.index()];
    }

    /// Room for so many faces; new ones have no neighbours.
    pub(super) fn resize(&mut self, faces: usize) {
        self.uv_twin.resize(3 * faces, HalfEdge::NONE);
        self.surface_twin.resize(3 * faces, HalfEdge::NONE);
    }

    /// Pairs of faces that hang together on a UV edge with more than two faces, or on one without length; ends ascending.
    pub(super) fn incident_on(&self, edge: (UvId, UvId)) -> &[[FaceId; 2]] {
        if self.incident.is_empty() { &[] } else { self.incident.get(&edge).map_or(&[], Vec::as_slice) }
    }

    /// Sets them; gives what was there, where that was or is anything.
    pub(super) fn set_incident(&mut self, edge: (UvId, UvId), pairs: Vec<[FaceId; 2]>) -> Option<Vec<[FaceId; 2]>> {
        if !pairs.is_empty() {
            Some(self.incident.insert(edge, pairs).unwrap_or_default())
        } else if !self.incident.is_empty() {
            self.incident.remove(&edge)
        } else {
            None
        }
    }
}

/// The two ends of a half edge, of faces given by their corners.
pub(super) fn ends<T: Copy>(faces: &[[T; 3]], h: HalfEdge) -> [T; 2] {
    let corners = &faces[h.face().index()];
    [corners[h.corner()], corners[h.end_corner()]]
}

/// Neighbours in a list of faces, each pair of two different ones.
pub(super) fn neighbours(faces: impl Iterator<Item = FaceId>) -> Vec<[FaceId; 2]> {
    let faces: Vec<FaceId> = faces.collect();
    faces.windows(2).map(|w| [w[0], w[1]]).filter(|pair| pair[0] != pair[1]).collect()
}

/// (low end, high end, whether it runs down, half edge).
pub(super) type Key = (u32, u32, bool, HalfEdge);

/// The key of a half edge between `a` and `b`, which sorts the half edges of one edge as they are paired.
pub(super) fn key([a, b]: [u32; 2], h: HalfEdge) -> Key {
    (a.min(b), a.max(b), a > b, h)
}

/// The edges that have a length, sorted: by their low ends in one pass, as few start at each, then those few.
fn sorted_edges(n: usize, ends: impl Fn(HalfEdge) -> [u32; 2]) -> Vec<Key> {
    let mut keys: Vec<Key> =
        (0..n as u32).map(|h| key(ends(HalfEdge(h)), HalfEdge(h))).filter(|k| k.0 != k.1).collect();
    let vertices = keys.iter().map(|k| k.0 as usize + 1).max().unwrap_or(0);
    if vertices > 4 * keys.len() {
        keys.sort_unstable();
        return keys;
    }
    let mut all = Grouped::new(vertices, keys.iter().map(|key| (key.0, *key))).into_items();
    all.chunk_by_mut(|a, b| a.0 == b.0).for_each(|own| own.sort_unstable());
    all
}

/// Pairs the half edges of one edge, sorted by direction, then number. Those that are `taken` stay as they are.
fn pair_run(run: &[Key], twin: &mut [HalfEdge], taken: impl Fn(HalfEdge) -> bool) {
    let mut join = |a: HalfEdge, b: HalfEdge| {
        if a.face() != b.face() {
            twin[a.index()] = b;
            twin[b.index()] = a;
        }
    };
    if run.len() <= 2 {
        // Either way round they are a pair.
        if let [a, b] = *run
            && !taken(a.3)
            && !taken(b.3)
        {
            join(a.3, b.3);
        }
        return;
    }
    let free = run.iter().filter(|k| !taken(k.3)).map(|k| (k.2, k.3));
    let (up, down): (Vec<_>, Vec<_>) = free.partition(|k| !k.0);
    let pairs = up.len().min(down.len());
    for (a, b) in up.iter().zip(&down) {
        join(a.1, b.1);
    }
    // Inconsistent winding: the rest runs the same way round.
    let rest = if up.len() > down.len() { &up[pairs..] } else { &down[pairs..] };
    for pair in rest.chunks_exact(2) {
        join(pair[0].1, pair[1].1);
    }
}
