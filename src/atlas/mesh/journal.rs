//! What was done to a mesh, so that it can be undone exactly.

use glam::DVec2;

use super::Mesh;
use super::lists::Taken;
use crate::atlas::{FaceId, HalfEdge, Provenance, UvId, VertexId};

/// One step, with what is needed to take it back.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Change {
    /// A UV vertex was there.
    MovedUv(UvId, DVec2),
    /// A face was on this page.
    Page(FaceId, u16),
    /// The last UV vertex was added.
    PushedUv,
    /// The last surface vertex was added.
    PushedVertex,
    /// The last face was added; its corners are in the lists.
    PushedFace,
    /// A corner had another UV vertex.
    Corner { corner: HalfEdge, old: UvId, new: UvId, taken: Taken },
    /// A corner had another surface vertex.
    Vertex { corner: HalfEdge, old: VertexId, new: VertexId, taken: Taken },
    /// A face was this part of its source.
    Part(FaceId, Provenance),
    /// A half edge had these twins.
    Twins(HalfEdge, [HalfEdge; 2]),
    /// These faces hung together on a UV edge.
    Incident((UvId, UvId), Vec<[FaceId; 2]>),
}

/// A state of a mesh that can be gone back to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Mark(usize);

/// The changes since recording began; nothing while it has not.
#[derive(Debug, Clone, Default)]
pub(super) struct Journal {
    recording: bool,
    changes: Vec<Change>,
}

impl Journal {
    /// Notes a change, if changes are recorded.
    pub(super) fn note(&mut self, change: impl FnOnce() -> Change) {
        if self.recording {
            self.changes.push(change());
        }
    }
}

impl Mesh {
    /// Begins to record edits, where that has not begun, and names the state as it is now.
    pub fn mark(&mut self) -> Mark {
        self.journal.recording = true;
        Mark(self.journal.changes.len())
    }

    /// Goes back to a state: everything is as it was then, to the order of lists. Marks that are later end to be valid.
    pub fn undo(&mut self, to: Mark) {
        debug_assert!(to.0 <= self.journal.changes.len(), "the state was forgotten");
        let recording = std::mem::replace(&mut self.journal.recording, false);
        while self.journal.changes.len() > to.0 {
            let Some(change) = self.journal.changes.pop() else { break };
            self.take_back(change);
        }
        self.journal.recording = recording;
    }

    /// Ends recording; no mark is valid any more.
    pub fn forget(&mut self) {
        self.journal = Journal::default();
    }

    fn take_back(&mut self, change: Change) {
        match change {
            Change::MovedUv(uv, at) => self.atlas.uv[uv.index()] = at,
            Change::Page(face, page) => self.atlas.page[face.index()] = page,
            Change::PushedUv => {
                self.atlas.uv.pop();
                self.at_uv.pop_vertex();
            }
            Change::PushedVertex => {
                self.atlas.surface.positions.pop();
                self.at_vertex.pop_vertex();
            }
            Change::PushedFace => self.pop_face(),
            Change::Corner { corner, old, new, taken } => {
                self.at_uv.remove(new.index(), corner);
                self.at_uv.put_back(old.index(), corner, taken);
                self.atlas.corners[corner.face().index()][corner.corner()] = old;
            }
            Change::Vertex { corner, old, new, taken } => {
                self.at_vertex.remove(new.index(), corner);
                self.at_vertex.put_back(old.index(), corner, taken);
                self.atlas.surface.triangles[corner.face().index()][corner.corner()] = old;
            }
            Change::Part(face, provenance) => self.atlas.provenance[face.index()] = provenance,
            Change::Twins(h, twins) => self.topology.set_twins(h, twins),
            Change::Incident(edge, pairs) => drop(self.topology.set_incident(edge, pairs)),
        }
    }
}
