//! Reads of the half edges: half edge `3 f + k` runs from corner `k` of face `f` to the next.

use std::collections::BTreeMap;
use std::ops::Range;

use glam::DVec2;

use super::MergeMesh;
use crate::atlas::{FaceId, HalfEdge, UvId};

impl MergeMesh {
    /// All faces.
    pub(crate) fn faces(&self) -> Range<u32> {
        0..self.mesh.atlas().face_count() as u32
    }

    /// All half edges.
    pub(crate) fn half_edges(&self) -> Range<u32> {
        0..self.border.len() as u32
    }

    /// UV vertices, those that were fused with others too.
    pub(crate) fn vertex_count(&self) -> usize {
        self.mesh.atlas().uv.len()
    }

    /// UV vertices of a face.
    pub(crate) fn corners(&self, face: u32) -> [u32; 3] {
        self.mesh.atlas().corners[face as usize].map(|u| u.0)
    }

    /// Faces incident to a UV vertex; none once it was fused with another.
    pub(crate) fn star(&self, vertex: u32) -> impl Iterator<Item = u32> + '_ {
        self.mesh.star(UvId(vertex)).map(|f| f.0)
    }

    /// Where a UV vertex lies, in the coordinates of its chart.
    pub(crate) fn uv(&self, vertex: u32) -> DVec2 {
        self.mesh.position(UvId(vertex))
    }

    /// Where a face lies.
    pub(crate) fn triangle(&self, face: u32) -> [DVec2; 3] {
        self.mesh.atlas().uv_triangle(FaceId(face))
    }

    /// The chart of a face.
    pub(crate) fn chart_of(&self, face: u32) -> u32 {
        self.chart_of[face as usize]
    }

    /// UV vertex at the start of a half edge.
    pub(crate) fn start(&self, h: u32) -> u32 {
        self.mesh.uv_at(HalfEdge(h)).0
    }

    /// UV vertex at its end.
    pub(crate) fn end(&self, h: u32) -> u32 {
        self.mesh.uv_at(HalfEdge(h).next()).0
    }

    /// Its UV length.
    pub(crate) fn length(&self, h: u32) -> f64 {
        self.uv(self.start(h)).distance(self.uv(self.end(h)))
    }

    /// Its chart.
    pub(crate) fn chart_at(&self, h: u32) -> u32 {
        self.chart_of(h / 3)
    }

    /// Across it in its chart.
    pub(crate) fn twin(&self, h: u32) -> Option<u32> {
        if self.is_border(h) { None } else { self.mesh.topology().uv_twin(HalfEdge(h)).map(|t| t.0) }
    }

    /// Across it on the surface, where the two may be dissolved.
    pub(crate) fn linked(&self, h: u32) -> Option<u32> {
        self.mesh.topology().surface_twin(HalfEdge(h)).filter(|_| self.mergeable[h as usize]).map(|t| t.0)
    }

    /// The next along its border.
    pub(crate) fn next_on_border(&self, h: u32) -> Option<u32> {
        let mut next = HalfEdge(h).next();
        for _ in self.half_edges() {
            match self.twin(next.0) {
                Some(twin) => next = HalfEdge(twin).next(),
                None => return Some(next.0),
            }
        }
        None
    }

    /// Whether it is part of a border.
    pub(crate) fn is_border(&self, h: u32) -> bool {
        self.border[h as usize]
    }

    /// Whether a face has a border edge.
    pub(crate) fn touches_border(&self, face: u32) -> bool {
        (3 * face..3 * face + 3).any(|h| self.is_border(h))
    }

    /// The half edges of a pair of linked edges: that of chart `first` first; as given where both are, or neither is.
    pub(crate) fn linked_pair(&self, h: u32, first: u32) -> Option<(u32, u32)> {
        let t = self.linked(h)?;
        Some(if self.chart_at(h) == first { (h, t) } else { (t, h) })
    }

    /// Pairs of linked half edges by pair of charts (the smaller first), each once.
    pub(crate) fn linked_charts(&self) -> BTreeMap<(u32, u32), Vec<u32>> {
        let mut links: BTreeMap<(u32, u32), Vec<u32>> = BTreeMap::new();
        for h in self.half_edges() {
            let Some(t) = self.linked(h).filter(|t| *t > h) else { continue };
            let (a, b) = (self.chart_at(h), self.chart_at(t));
            if self.chart(a).mergeable && self.chart(b).mergeable {
                links.entry((a.min(b), a.max(b))).or_default().push(h);
            }
        }
        links
    }
}
