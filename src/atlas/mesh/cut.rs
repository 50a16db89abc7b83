//! Unzipping: UV vertices become several where the faces about them hang together no longer.

use std::collections::BTreeMap;

use super::{Mesh, ascending};
use crate::atlas::groups::{DisjointSets, sorted_unique};
use crate::atlas::{FaceId, HalfEdge, UvId};

impl Mesh {
    /// Cuts charts open along UV edges: each UV vertex on a cut becomes as many as the cuts leave parts of its fan. Faces and surface
    /// stay as they are, positions too; one half edge of a cut edge is enough, and borders among them change nothing. The part with
    /// the first corner keeps the vertex.
    ///
    /// An edge both of whose ends stay whole is not cut: the tips of a slit are not doubled.
    pub fn cut(&mut self, edges: &[HalfEdge]) {
        self.cut_unless(edges, &|_, _| true);
    }

    /// [`Self::cut`] where faces on a UV edge with more than two faces need not hang together: only those pairs do for which `hang` holds.
    pub(crate) fn cut_unless(&mut self, edges: &[HalfEdge], hang: &dyn Fn(FaceId, FaceId) -> bool) {
        let mut cut: Vec<HalfEdge> = Vec::with_capacity(2 * edges.len());
        let mut touched: Vec<UvId> = Vec::with_capacity(2 * edges.len());
        for &h in edges {
            if let Some(twin) = self.topology.uv_twin(h) {
                cut.extend([h, twin]);
                touched.extend(self.uv_ends(h));
            }
        }
        cut.sort_unstable();
        let mut corners: Vec<HalfEdge> = sorted_unique(touched).into_iter().flat_map(|u| self.corners_of(u)).collect();
        corners.sort_unstable();
        // Corners of one UV vertex that hang together over edges which are not cut.
        let mut parts = DisjointSets::new(corners.len());
        let mut join = |a: HalfEdge, b: HalfEdge| {
            if self.uv_at(a) == self.uv_at(b)
                && let (Ok(a), Ok(b)) = (corners.binary_search(&a), corners.binary_search(&b))
            {
                parts.unite(a as u32, b as u32);
            }
        };
        for &corner in &corners {
            for h in [corner, corner.previous()] {
                let Some(twin) = self.topology.uv_twin(h).filter(|_| cut.binary_search(&h).is_err()) else { continue };
                join(corner, twin);
                join(corner, twin.next());
            }
            for k in 0..3 {
                let edge = ascending(self.uv_ends(HalfEdge::of(corner.face(), k)));
                for [f, g] in self.topology.incident_on(edge).iter().filter(|p| hang(p[0], p[1])) {
                    for (i, j) in (0..9).map(|n| (n / 3, n % 3)) {
                        join(HalfEdge::of(*f, i), HalfEdge::of(*g, j));
                    }
                }
            }
        }
        let parts: Vec<(HalfEdge, u32)> = (0..).zip(&corners).map(|(i, &c)| (c, parts.find(i))).collect();
        self.divide(&parts);
    }

    /// Gives each part of a UV vertex' corners a vertex of its own, at the same place. `parts`: corners, ascending, all of each vertex, and
    /// a label by corner; the label that comes first at a vertex keeps it.
    pub(crate) fn divide(&mut self, parts: &[(HalfEdge, u32)]) {
        let mut kept: BTreeMap<UvId, u32> = BTreeMap::new();
        let mut copies: BTreeMap<(UvId, u32), UvId> = BTreeMap::new();
        let (mut edges, mut stale) = (Vec::new(), Vec::new());
        let mut moves = Vec::new();
        for &(corner, part) in parts {
            let old = self.uv_at(corner);
            if *kept.entry(old).or_insert(part) == part {
                continue;
            }
            let new = match copies.get(&(old, part)) {
                Some(new) => *new,
                None => {
                    let new = self.push_uv(self.position(old));
                    copies.insert((old, part), new);
                    new
                }
            };
            for h in [corner, corner.previous()] {
                edges.push(ascending(self.surface_ends(h)));
                stale.push(ascending(self.uv_ends(h)));
            }
            moves.push((corner, new));
        }
        for (corner, uv) in moves {
            self.set_corner(corner, uv);
        }
        self.pair(edges, &stale);
    }

    /// UV vertices at which charts touch become one for each chart; `chart` by face.
    pub(crate) fn divide_by_chart(&mut self, chart: impl Fn(FaceId) -> u32) {
        let mut parts = Vec::new();
        for uv in (0..self.atlas.uv.len()).map(UvId::new) {
            let mut own = self.corners_of(uv).map(|c| (c, chart(c.face())));
            let Some(first) = own.next() else { continue };
            if own.any(|(_, c)| c != first.1) {
                parts.extend(self.corners_of(uv).map(|c| (c, chart(c.face()))));
            }
        }
        parts.sort_unstable();
        self.divide(&parts);
    }
}
