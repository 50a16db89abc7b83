//! Splitting edges: a point on an edge becomes a vertex, in every face that has the edge and on both sides of a seam.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use super::journal::Change;
use super::{Mesh, ascending};
use crate::atlas::{FaceId, HalfEdge, Provenance, UvId, VertexId};

/// What splitting edges made.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EdgeSplits {
    /// The new surface vertex by surface edge, ends ascending.
    pub vertices: BTreeMap<(VertexId, VertexId), VertexId>,
    /// New UV vertices by face that had the edge and UV edge, ends in the order of their surface vertices; faces as they were before, ascending.
    pub uvs: Vec<(FaceId, [UvId; 2], UvId)>,
    /// New faces, ascending, each with the one that it is a part of; that one remains as another part.
    pub faces: Vec<(FaceId, FaceId)>,
}

/// A vertex on the boundary of a face that is split.
#[derive(Debug, Clone, Copy)]
struct RingVertex {
    vertex: VertexId,
    uv: UvId,
    /// Barycentric coordinates in the source face.
    weight: DVec3,
    /// Whether it is new.
    is_new: bool,
}

impl Mesh {
    /// Puts a point on an edge, `t` of the way from the start of the half edge to its end, 0 < t < 1.
    pub fn split_edge(&mut self, h: HalfEdge, t: f64) -> EdgeSplits {
        let [a, b] = self.surface_ends(h);
        let t = if a <= b { t } else { 1.0 - t };
        self.split_edges(&BTreeMap::from([(ascending([a, b]), t)]))
    }

    /// Puts a point on each of some surface edges (ends ascending; the place between them, in 0..1 from the first), in all faces that have
    /// them. A split edge has one new vertex, evaluated once from its ordered ends, so that no crack opens; provenance and UVs
    /// are interpolated likewise. Faces are divided by new edges between new vertices where they have several.
    pub fn split_edges(&mut self, splits: &BTreeMap<(VertexId, VertexId), f64>) -> EdgeSplits {
        let mut made = EdgeSplits::default();
        let mut affected: BTreeSet<FaceId> = BTreeSet::new();
        for (&(a, b), &t) in splits {
            let has_b = |f: &FaceId| self.atlas.surface.triangles[f.index()].contains(&b);
            affected.extend(self.corners_on(a).map(HalfEdge::face).filter(has_b));
            let [pa, pb] = [a, b].map(|v| self.atlas.surface.positions[v.index()]);
            made.vertices.insert((a, b), self.push_vertex(pa + (pb - pa) * t));
        }
        // New UV vertices by UV edge, ends in the order of their surface vertices.
        let mut on_edge: BTreeMap<[UvId; 2], UvId> = BTreeMap::new();
        let (mut edges, mut stale) = (Vec::new(), Vec::new());
        for &face in &affected {
            let triangle = self.atlas.surface.triangles[face.index()];
            let corners = self.atlas.corners[face.index()];
            let provenance = self.atlas.provenance[face.index()];
            let mut ring: Vec<RingVertex> = Vec::with_capacity(6);
            for k in 0..3 {
                let j = (k + 1) % 3;
                stale.push(ascending([corners[k], corners[j]]));
                edges.push(ascending([triangle[k], triangle[j]]));
                let weight = provenance.barycentric[k];
                ring.push(RingVertex { vertex: triangle[k], uv: corners[k], weight, is_new: false });
                let (low, high) = if triangle[k] <= triangle[j] { (k, j) } else { (j, k) };
                let edge = (triangle[low], triangle[high]);
                let Some((&vertex, &t)) = made.vertices.get(&edge).zip(splits.get(&edge)) else { continue };
                let uv_edge = [corners[low], corners[high]];
                let uv = match on_edge.get(&uv_edge) {
                    Some(uv) => *uv,
                    None => {
                        let [a, b] = uv_edge.map(|u| self.position(u));
                        let uv = self.push_uv(a + (b - a) * t);
                        on_edge.insert(uv_edge, uv);
                        uv
                    }
                };
                made.uvs.push((face, uv_edge, uv));
                let [a, b] = [low, high].map(|k| provenance.barycentric[k]);
                ring.push(RingVertex { vertex, uv, weight: a + (b - a) * t, is_new: true });
            }
            for (n, part) in self.triangulate(&ring).into_iter().enumerate() {
                let part = part.map(|i| ring[i]);
                let own = Provenance { barycentric: part.map(|r| r.weight), ..provenance };
                if n == 0 {
                    self.replace_face(face, part, own);
                } else {
                    let new = self.push_face(part, own, self.atlas.page[face.index()]);
                    made.faces.push((new, face));
                }
                edges.extend((0..3).map(|k| ascending([part[k].vertex, part[(k + 1) % 3].vertex])));
            }
        }
        self.pair(edges, &stale);
        made
    }

    /// Triangles of a ring of up to six vertices around a triangle: ears at the old corners between two new vertices, then what is left, by
    /// its shorter diagonal.
    fn triangulate(&self, ring: &[RingVertex]) -> Vec<[usize; 3]> {
        let at = |i: usize| self.position(ring[i].uv);
        let mut left: Vec<usize> = (0..ring.len()).collect();
        let mut parts = Vec::new();
        while left.len() > 3 {
            let n = left.len();
            let neighbours = |i: usize| (left[(i + n - 1) % n], left[(i + 1) % n]);
            let corner_between = |i: &usize| {
                let (a, b) = neighbours(*i);
                !ring[left[*i]].is_new && ring[a].is_new && ring[b].is_new
            };
            let ear = match (0..n).find(corner_between) {
                Some(i) => i,
                None => {
                    // A diagonal between two old corners would run along a split edge.
                    let usable = |i: usize| {
                        let (a, b) = neighbours(i);
                        ring[a].is_new || ring[b].is_new
                    };
                    let length = |i: usize| {
                        let (a, b) = neighbours(i);
                        at(a).distance_squared(at(b))
                    };
                    let best = (0..n).filter(|&i| usable(i)).min_by(|&i, &j| length(i).total_cmp(&length(j)));
                    best.unwrap_or(0)
                }
            };
            let (a, b) = neighbours(ear);
            parts.push([a, left[ear], b]);
            left.remove(ear);
        }
        parts.push([left[0], left[1], left[2]]);
        parts
    }

    fn push_vertex(&mut self, at: DVec3) -> VertexId {
        self.journal.note(|| Change::PushedVertex);
        self.atlas.surface.positions.push(at);
        self.at_vertex.push_vertex();
        VertexId::new(self.atlas.surface.positions.len() - 1)
    }

    fn replace_face(&mut self, face: FaceId, part: [RingVertex; 3], provenance: Provenance) {
        let old = std::mem::replace(&mut self.atlas.provenance[face.index()], provenance);
        self.journal.note(|| Change::Part(face, old));
        for (k, own) in part.iter().enumerate() {
            let corner = HalfEdge::of(face, k);
            if self.uv_at(corner) != own.uv {
                self.set_corner(corner, own.uv);
            }
            if self.vertex_at(corner) != own.vertex {
                self.set_vertex(corner, own.vertex);
            }
        }
    }

    fn set_vertex(&mut self, corner: HalfEdge, new: VertexId) {
        let own = &mut self.atlas.surface.triangles[corner.face().index()][corner.corner()];
        let old = std::mem::replace(own, new);
        let taken = self.at_vertex.remove(old.index(), corner);
        self.at_vertex.append(new.index(), corner);
        self.journal.note(|| Change::Vertex { corner, old, new, taken });
    }

    fn push_face(&mut self, part: [RingVertex; 3], provenance: Provenance, page: u16) -> FaceId {
        let face = FaceId::new(self.atlas.corners.len());
        self.atlas.surface.triangles.push(part.map(|r| r.vertex));
        self.atlas.corners.push(part.map(|r| r.uv));
        self.atlas.provenance.push(provenance);
        self.atlas.page.push(page);
        self.topology.resize(face.index() + 1);
        self.at_uv.resize(3 * face.index() + 3);
        self.at_vertex.resize(3 * face.index() + 3);
        for (k, own) in part.iter().enumerate() {
            self.at_uv.append(own.uv.index(), HalfEdge::of(face, k));
            self.at_vertex.append(own.vertex.index(), HalfEdge::of(face, k));
        }
        self.journal.note(|| Change::PushedFace);
        face
    }

    /// Takes back [`Self::push_face`].
    pub(super) fn pop_face(&mut self) {
        let (Some(corners), Some(triangle)) = (self.atlas.corners.pop(), self.atlas.surface.triangles.pop()) else {
            return;
        };
        self.atlas.provenance.pop();
        self.atlas.page.pop();
        let face = FaceId::new(self.atlas.corners.len());
        for k in (0..3).rev() {
            self.at_uv.remove(corners[k].index(), HalfEdge::of(face, k));
            self.at_vertex.remove(triangle[k].index(), HalfEdge::of(face, k));
        }
        self.topology.resize(face.index());
        self.at_uv.resize(3 * face.index());
        self.at_vertex.resize(3 * face.index());
    }
}
