//! Which face lies across which edge. Topology knows no positions.

use super::{Atlas, FaceId};

/// An edge of a face: `3 * face + k` is the edge from corner `k` to corner `k + 1`.
pub type HalfEdge = u32;

/// No half edge: the edge is a border.
pub const NONE: HalfEdge = u32::MAX;

/// Adjacency of an Atlas' faces, in UV and on the surface.
///
/// Two faces are neighbours in UV when they share an edge with the same two UV vertices and the
/// same two surface vertices; such an edge is interior to a chart. An edge shared by more than two
/// faces is non-manifold: its faces are paired in the order of opposite direction first, then of face
/// index, and what is left over is border.
#[derive(Debug, Clone)]
pub struct Topology {
    /// By half edge: the half edge across, in the same chart, or [`NONE`].
    pub uv_twin: Vec<HalfEdge>,
    /// By half edge: the half edge across on the welded surface, or [`NONE`] at the mesh boundary.
    /// Where `uv_twin` is not [`NONE`] both agree.
    pub surface_twin: Vec<HalfEdge>,
    /// Number of surface edges with more than two faces.
    pub non_manifold_edges: usize,
    /// Pairs of faces on one UV edge that has more than two half edges. They hang together though
    /// `uv_twin` may not say so: a chart is all faces that share UV edges.
    pub crowded: Vec<[FaceId; 2]>,
}

impl Topology {
    /// Derives the adjacency of `atlas`.
    pub fn new(atlas: &Atlas) -> Self {
        let n = atlas.face_count() * 3;
        let mut uv_twin = vec![NONE; n];
        let mut keys = sorted_edges(n, |h| {
            let [a, b] = edge(&atlas.corners[h / 3], h % 3);
            (a.0, b.0)
        });
        pair_runs(&mut keys, &mut uv_twin, &[]);
        let mut crowded: Vec<[FaceId; 2]> = keys
            .chunk_by(|a, b| (a.0, a.1) == (b.0, b.1))
            .filter(|run| run.len() > 2)
            .flat_map(|run| run.windows(2).map(|w| [Self::face(w[0].3), Self::face(w[1].3)]))
            .filter(|pair| pair[0] != pair[1])
            .collect();
        // Edges without length: the only ones that a triangle collapsed to a point has.
        let mut points: Vec<(u32, FaceId)> = (0..n)
            .map(|h| (edge(&atlas.corners[h / 3], h % 3), FaceId::new(h / 3)))
            .filter(|(ends, _)| ends[0] == ends[1])
            .map(|(ends, face)| (ends[0].0, face))
            .collect();
        points.sort_unstable();
        points.dedup();
        crowded.extend(points.windows(2).filter(|w| w[0].0 == w[1].0).map(|w| [w[0].1, w[1].1]));
        let mut surface_twin = uv_twin.clone();
        let mut keys = sorted_edges(n, |h| {
            let [a, b] = edge(&atlas.surface.triangles[h / 3], h % 3);
            (a.0, b.0)
        });
        let non_manifold_edges = pair_runs(&mut keys, &mut surface_twin, &uv_twin);
        Topology { uv_twin, surface_twin, non_manifold_edges, crowded }
    }

    /// The face of a half edge.
    pub fn face(half_edge: HalfEdge) -> FaceId {
        FaceId(half_edge / 3)
    }

    /// Whether edge `k` of the face is a border of its chart.
    pub fn is_border(&self, face: FaceId, k: usize) -> bool {
        self.uv_twin[3 * face.index() + k] == NONE
    }

    /// Whether the edge is a seam: interior to the surface, border of a chart.
    pub fn is_seam(&self, half_edge: HalfEdge) -> bool {
        self.uv_twin[half_edge as usize] == NONE && self.surface_twin[half_edge as usize] != NONE
    }
}

fn edge<T: Copy>(corners: &[T; 3], k: usize) -> [T; 2] {
    [corners[k], corners[(k + 1) % 3]]
}

/// (low, high, reversed, half edge), sorted.
fn sorted_edges(n: usize, ends: impl Fn(usize) -> (u32, u32)) -> Vec<(u32, u32, bool, u32)> {
    let keys: Vec<_> = (0..n)
        .map(|h| {
            let (a, b) = ends(h);
            (a.min(b), a.max(b), a > b, h as u32)
        })
        .filter(|k| k.0 != k.1)
        .collect();
    sorted(keys)
}

/// Sorts edges: by their low ends in one pass, as few start at each, then those few.
fn sorted(mut keys: Vec<(u32, u32, bool, u32)>) -> Vec<(u32, u32, bool, u32)> {
    let vertices = keys.iter().map(|k| k.0 as usize + 1).max().unwrap_or(0);
    if vertices > 4 * keys.len() {
        keys.sort_unstable();
        return keys;
    }
    // Where the edges of each vertex end, once they are placed.
    let mut ends = vec![0; vertices + 1];
    for key in &keys {
        ends[key.0 as usize + 1] += 1;
    }
    let mut sum = 0;
    for end in &mut ends {
        sum += *end;
        *end = sum;
    }
    let mut all = vec![(0, 0, false, 0); keys.len()];
    for key in keys {
        let place = &mut ends[key.0 as usize];
        all[*place] = key;
        *place += 1;
    }
    all.chunk_by_mut(|a, b| a.0 == b.0).for_each(|own| own.sort_unstable());
    all
}

/// Pairs the half edges of each run of equal edges. Those already paired in `taken` stay.
fn pair_runs(keys: &mut [(u32, u32, bool, u32)], twin: &mut [HalfEdge], taken: &[HalfEdge]) -> usize {
    let mut crowded = 0;
    for run in keys.chunk_by_mut(|a, b| (a.0, a.1) == (b.0, b.1)) {
        if run.len() <= 2 {
            // Either way round they are a pair.
            if let [a, b] = *run
                && [a, b].iter().all(|k| taken.get(k.3 as usize).is_none_or(|t| *t == NONE))
            {
                join(twin, a.3, b.3);
            }
            continue;
        }
        crowded += 1;
        let free: Vec<_> = run.iter().filter(|k| taken.get(k.3 as usize).is_none_or(|t| *t == NONE)).copied().collect();
        let (forward, backward): (Vec<_>, Vec<_>) = free.into_iter().partition(|k| !k.2);
        let pairs = forward.len().min(backward.len());
        for (a, b) in forward.iter().zip(&backward) {
            join(twin, a.3, b.3);
        }
        // Inconsistent winding: the rest runs the same way round.
        let rest = if forward.len() > backward.len() { &forward[pairs..] } else { &backward[pairs..] };
        for pair in rest.chunks_exact(2) {
            join(twin, pair[0].3, pair[1].3);
        }
    }
    crowded
}

fn join(twin: &mut [HalfEdge], a: HalfEdge, b: HalfEdge) {
    if a / 3 != b / 3 {
        twin[a as usize] = b;
        twin[b as usize] = a;
    }
}
