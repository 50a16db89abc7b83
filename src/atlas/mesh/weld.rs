//! Zipping: UV vertices of one surface vertex become one, and seams between them are closed.

use super::{Mesh, ascending};
use crate::atlas::seams::linked_corners;
use crate::atlas::{HalfEdge, UvId};

impl Mesh {
    /// Zips a seam: the UV vertices at the ends of the half edge become those of its twin on the surface. Gives the vertices that went, each
    /// with the one that took its place; nothing where there is no twin.
    pub fn weld(&mut self, h: HalfEdge) -> Vec<(UvId, UvId)> {
        let fused: Vec<(UvId, UvId)> = match self.topology.surface_twin(h) {
            Some(twin) => self.linked(h, twin).into_iter().filter(|(gone, kept)| gone != kept).collect(),
            None => Vec::new(),
        };
        self.fuse(&fused);
        fused
    }

    /// The UV vertices of a half edge and of its twin on the surface, matched by surface vertex: (own, across) at its start and at its
    /// end.
    pub fn linked(&self, h: HalfEdge, twin: HalfEdge) -> [(UvId, UvId); 2] {
        linked_corners(&self.atlas, h, twin)
    }

    /// Makes UV vertices of one surface vertex one: all corners of the first of each pair become the second's, in order. Where both ends
    /// of a seam become one, the seam is closed. A pair may name a vertex that an earlier one took the corners of; it has none then.
    pub fn fuse(&mut self, pairs: &[(UvId, UvId)]) {
        let (mut edges, mut stale) = (Vec::new(), Vec::new());
        let mut corners = Vec::new();
        for &(gone, kept) in pairs {
            if gone == kept {
                continue;
            }
            corners.clear();
            corners.extend(self.corners_of(gone));
            for &corner in &corners {
                debug_assert!(
                    self.corners_of(kept).next().is_none_or(|c| self.vertex_at(c) == self.vertex_at(corner)),
                    "a UV vertex belongs to one surface vertex"
                );
                for h in [corner, corner.previous()] {
                    edges.push(ascending(self.surface_ends(h)));
                    stale.push(ascending(self.uv_ends(h)));
                }
                self.set_corner(corner, kept);
            }
        }
        self.pair(edges, &stale);
    }
}
