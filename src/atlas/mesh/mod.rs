//! The one editable mesh: half edges over the surface and the layout of an Atlas.
//!
//! A [`Mesh`] holds an [`Atlas`], the [`Topology`] of it and the corners about each vertex, and keeps them true through four edits, each
//! of which costs what it touches: [`Mesh::cut`] unzips a path of UV edges, [`Mesh::weld`] zips seams, [`Mesh::split_edges`] puts
//! points on surface edges in all faces that have them, [`Mesh::move_uv`] moves a UV vertex. Adjacency after an edit is what
//! [`Topology::new`] would derive from the edited Atlas, non-manifold edges included. Provenance follows by itself. Edits can be recorded and undone
//! exactly ([`Mesh::mark`], [`Mesh::undo`]).
//!
//! Stars, boundary loops and seams are iterated, not stored. An algorithm keeps its own data beside the mesh, indexed by
//! handles.

mod cut;
mod journal;
mod lists;
mod split;
#[cfg(test)]
mod tests;
mod weld;

pub use journal::Mark;
pub use split::EdgeSplits;

use glam::DVec2;

use self::journal::{Change, Journal};
use self::lists::CornerLists;
use super::groups::sorted_unique;
use super::topology::{ends, key, neighbours};
use super::{Atlas, FaceId, HalfEdge, Topology, UvId, VertexId};

/// An Atlas under editing.
///
/// A corner of a face is named by the half edge that leaves it.
#[derive(Debug, Clone)]
pub struct Mesh {
    atlas: Atlas,
    topology: Topology,
    /// Corners by UV vertex.
    at_uv: CornerLists,
    /// Corners by surface vertex.
    at_vertex: CornerLists,
    journal: Journal,
}

impl Mesh {
    /// Starts from an Atlas. A surface without a layout gets a UV vertex for each of its vertices, all at the origin: each component is one
    /// chart without shape, which can be cut open.
    pub fn new(mut atlas: Atlas) -> Self {
        if !atlas.has_layout() {
            atlas.uv = vec![DVec2::ZERO; atlas.surface.positions.len()];
            atlas.corners = atlas.surface.triangles.iter().map(|t| t.map(|v| UvId(v.0))).collect();
        }
        let topology = Topology::new(&atlas);
        let at_uv = CornerLists::new(atlas.uv.len(), &atlas.corners, UvId::index);
        let at_vertex = CornerLists::new(atlas.surface.positions.len(), &atlas.surface.triangles, VertexId::index);
        Mesh { atlas, topology, at_uv, at_vertex, journal: Journal::default() }
    }

    /// As it is now. UV vertices that were welded away are still in `uv`, unused.
    pub fn atlas(&self) -> &Atlas {
        &self.atlas
    }

    /// Adjacency as it is now.
    pub fn topology(&self) -> &Topology {
        &self.topology
    }

    /// The Atlas, without UV vertices that no face uses.
    pub fn into_atlas(self) -> Atlas {
        let mut atlas = self.atlas;
        atlas.drop_unused_uvs();
        atlas
    }

    /// The UV vertex at a corner.
    pub fn uv_at(&self, corner: HalfEdge) -> UvId {
        self.atlas.corners[corner.face().index()][corner.corner()]
    }

    /// The surface vertex at a corner.
    pub fn vertex_at(&self, corner: HalfEdge) -> VertexId {
        self.atlas.surface.triangles[corner.face().index()][corner.corner()]
    }

    /// The UV vertices at which a half edge starts and ends.
    pub fn uv_ends(&self, h: HalfEdge) -> [UvId; 2] {
        ends(&self.atlas.corners, h)
    }

    /// The surface vertices at which a half edge starts and ends.
    pub fn surface_ends(&self, h: HalfEdge) -> [VertexId; 2] {
        ends(&self.atlas.surface.triangles, h)
    }

    /// Where a UV vertex lies.
    pub fn position(&self, uv: UvId) -> DVec2 {
        self.atlas.uv[uv.index()]
    }

    /// The corners that a UV vertex has, in ascending order as long as they were not edited.
    pub fn corners_of(&self, uv: UvId) -> impl Iterator<Item = HalfEdge> + '_ {
        self.at_uv.of(uv.index())
    }

    /// The corners that lie at a surface vertex, whatever their UV vertex.
    pub fn corners_on(&self, vertex: VertexId) -> impl Iterator<Item = HalfEdge> + '_ {
        self.at_vertex.of(vertex.index())
    }

    /// The faces about a UV vertex, each once.
    pub fn star(&self, uv: UvId) -> impl Iterator<Item = FaceId> + '_ {
        self.corners_of(uv).filter(move |&c| self.is_first_of_face(uv, c)).map(HalfEdge::face)
    }

    /// Whether no corner before this one in its UV vertex' list is of the same face; only a degenerate face has several there.
    fn is_first_of_face(&self, uv: UvId, corner: HalfEdge) -> bool {
        let own = &self.atlas.corners[corner.face().index()];
        own.iter().filter(|u| **u == uv).count() == 1
            || self.corners_of(uv).find(|c| c.face() == corner.face()) == Some(corner)
    }

    /// All half edges on the edge between two surface vertices, ascending: two on a manifold edge, more on a non-manifold one.
    pub fn half_edges_between(&self, a: VertexId, b: VertexId) -> Vec<HalfEdge> {
        let mut found = Vec::new();
        for corner in self.corners_on(a) {
            for h in [corner, corner.previous()] {
                let [p, q] = self.surface_ends(h);
                if (p, q) == (a, b) || (p, q) == (b, a) {
                    found.push(h);
                }
            }
        }
        sorted_unique(found)
    }

    /// Moves a UV vertex.
    pub fn move_uv(&mut self, uv: UvId, to: DVec2) {
        let own = &mut self.atlas.uv[uv.index()];
        self.journal.note(|| Change::MovedUv(uv, *own));
        *own = to;
    }

    /// Puts a face on another page.
    pub fn set_page(&mut self, face: FaceId, page: u16) {
        let own = &mut self.atlas.page[face.index()];
        self.journal.note(|| Change::Page(face, *own));
        *own = page;
    }

    /// Adds a UV vertex that no face uses yet.
    fn push_uv(&mut self, at: DVec2) -> UvId {
        self.journal.note(|| Change::PushedUv);
        self.atlas.uv.push(at);
        self.at_uv.push_vertex();
        UvId::new(self.atlas.uv.len() - 1)
    }

    /// Gives a corner another UV vertex. Twins are not looked at: see [`Self::pair`].
    fn set_corner(&mut self, corner: HalfEdge, uv: UvId) {
        let own = &mut self.atlas.corners[corner.face().index()][corner.corner()];
        let old = std::mem::replace(own, uv);
        let taken = self.at_uv.remove(old.index(), corner);
        self.at_uv.append(uv.index(), corner);
        self.journal.note(|| Change::Corner { corner, old, new: uv, taken });
    }

    /// Pairs the half edges of some surface edges anew, after their corners changed. `stale`: UV edges that may be no more.
    fn pair(&mut self, edges: Vec<(VertexId, VertexId)>, stale: &[(UvId, UvId)]) {
        for &uv_edge in stale {
            self.set_incident(uv_edge, Vec::new());
        }
        let mut points: Vec<UvId> = stale.iter().filter(|e| e.0 == e.1).map(|e| e.0).collect();
        let mut runs = Vec::new();
        for (a, b) in sorted_unique(edges) {
            let all = self.half_edges_between(a, b);
            let before: Vec<_> = all.iter().map(|&h| (h, self.topology.twins(h))).collect();
            for &h in &all {
                self.topology.set_twins(h, [HalfEdge::NONE; 2]);
            }
            runs.clear();
            for &h in &all {
                let uv = self.uv_ends(h);
                if uv[0] == uv[1] {
                    points.push(uv[0]);
                } else {
                    runs.push(key(uv.map(|u| u.0), h));
                }
            }
            runs.sort_unstable();
            for run in runs.chunk_by(|p, q| (p.0, p.1) == (q.0, q.1)) {
                let pairs = self.topology.pair_in_uv(run);
                self.set_incident((UvId(run[0].0), UvId(run[0].1)), pairs);
            }
            all.iter().for_each(|&h| self.topology.copy_uv_twin(h));
            if a != b {
                runs.clear();
                runs.extend(all.iter().map(|&h| key(self.surface_ends(h).map(|v| v.0), h)));
                runs.sort_unstable();
                self.topology.pair_on_surface(&runs);
            }
            for (h, old) in before {
                if self.topology.twins(h) != old {
                    self.journal.note(|| Change::Twins(h, old));
                }
            }
        }
        for uv in sorted_unique(points) {
            let mut faces: Vec<FaceId> = self.star(uv).filter(|&f| self.collapses_at(f, uv)).collect();
            faces.sort_unstable();
            self.set_incident((uv, uv), neighbours(faces.into_iter()));
        }
    }

    /// Whether a face has an edge both of whose ends are the UV vertex.
    fn collapses_at(&self, face: FaceId, uv: UvId) -> bool {
        self.atlas.corners[face.index()].iter().filter(|u| **u == uv).count() > 1
    }

    fn set_incident(&mut self, uv_edge: (UvId, UvId), pairs: Vec<[FaceId; 2]>) {
        let old = self.topology.set_incident(uv_edge, pairs);
        if let Some(old) = old {
            self.journal.note(|| Change::Incident(uv_edge, old));
        }
    }
}

/// Ends in ascending order.
fn ascending<T: Ord>([a, b]: [T; 2]) -> (T, T) {
    if a <= b { (a, b) } else { (b, a) }
}
