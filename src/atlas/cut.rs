//! Cutting charts open along edges.

use super::clusters::find_root;
use super::topology::{HalfEdge, NONE};
use super::{Atlas, Topology, UvId};

impl Atlas {
    /// The Atlas with its charts cut open along UV edges: each UV vertex on a cut becomes as many as the cuts leave
    /// parts of its fan. Faces and surface stay as they are, positions too; one half edge of a cut edge is enough, and
    /// borders among them change nothing.
    pub fn cut_along(&self, topology: &Topology, cuts: &[HalfEdge]) -> Atlas {
        let mut is_cut = vec![false; topology.uv_twin.len()];
        let mut touched = vec![false; self.uv.len()];
        for &h in cuts {
            let twin = topology.uv_twin[h as usize];
            if twin == NONE {
                continue;
            }
            is_cut[h as usize] = true;
            is_cut[twin as usize] = true;
            let (from, to) = ends(h);
            for corner in [from, to] {
                touched[self.corners[corner / 3][corner % 3].index()] = true;
            }
        }
        // Corners of one UV vertex that hang together over edges which are not cut.
        let uv_of = |corner: usize| self.corners[corner / 3][corner % 3];
        let mut parent: Vec<u32> = (0..3 * self.face_count() as u32).collect();
        let join = |parent: &mut Vec<u32>, a: usize, b: usize| {
            if uv_of(a) == uv_of(b) && touched[uv_of(a).index()] {
                let (a, b) = (find_root(parent, a as u32), find_root(parent, b as u32));
                parent[a.max(b) as usize] = a.min(b);
            }
        };
        for h in 0..topology.uv_twin.len() as u32 {
            let twin = topology.uv_twin[h as usize];
            if twin == NONE || twin < h || is_cut[h as usize] {
                continue;
            }
            let ((a, b), (c, d)) = (ends(h), ends(twin));
            for (p, q) in [(a, c), (a, d), (b, c), (b, d)] {
                join(&mut parent, p, q);
            }
        }
        for pair in &topology.crowded {
            for (i, j) in (0..9).map(|n| (n / 3, n % 3)) {
                join(&mut parent, 3 * pair[0].index() + i, 3 * pair[1].index() + j);
            }
        }
        let mut next = self.clone();
        // The first part of a vertex keeps its name.
        let mut name: Vec<Option<UvId>> = vec![None; parent.len()];
        let mut kept = vec![false; self.uv.len()];
        for corner in 0..parent.len() {
            let uv = uv_of(corner);
            if !touched[uv.index()] {
                continue;
            }
            let part = find_root(&mut parent, corner as u32) as usize;
            let own = *name[part].get_or_insert_with(|| {
                if std::mem::replace(&mut kept[uv.index()], true) {
                    next.uv.push(self.uv[uv.index()]);
                    UvId::new(next.uv.len() - 1)
                } else {
                    uv
                }
            });
            next.corners[corner / 3][corner % 3] = own;
        }
        next
    }
}

/// The corners (3 * face + k) at which a half edge starts and ends.
fn ends(h: HalfEdge) -> (usize, usize) {
    let h = h as usize;
    (h, h / 3 * 3 + (h + 1) % 3)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::sheet;
    use crate::atlas::{Charts, FaceId};
    use glam::DVec2;

    fn half_edge(atlas: &Atlas, a: DVec2, b: DVec2) -> HalfEdge {
        let has = |h: &u32| {
            let (from, to) = ends(*h);
            let at = |c: usize| atlas.uv[atlas.corners[c / 3][c % 3].index()];
            at(from) == a && at(to) == b
        };
        (0..3 * atlas.face_count() as u32).find(has).unwrap()
    }

    #[test]
    fn a_cut_across_makes_two_charts_and_a_slit_makes_none() {
        let atlas = sheet(2, 2, DVec2::ZERO);
        let topology = Topology::new(&atlas);
        let at = |x: f64, y: f64| DVec2::new(x, y);
        let upper = half_edge(&atlas, at(1.0, 0.0), at(1.0, 1.0));
        let lower = half_edge(&atlas, at(1.0, 1.0), at(1.0, 2.0));

        let slit = atlas.cut_along(&topology, &[upper]);
        let after = Topology::new(&slit);
        assert_eq!(Charts::new(&after).len(), 1);
        assert_eq!(slit.uv.len(), atlas.uv.len() + 1, "the end on the border is doubled, the tip is not");
        assert!(after.is_border(FaceId(upper / 3), upper as usize % 3) && after.is_seam(upper));

        let halves = atlas.cut_along(&topology, &[upper, lower]);
        assert_eq!(Charts::new(&Topology::new(&halves)).len(), 2);
        assert_eq!(halves.uv.len(), atlas.uv.len() + 3);
        assert_eq!(halves.surface, atlas.surface);
        for face in atlas.faces() {
            assert_eq!(halves.uv_triangle(face), atlas.uv_triangle(face));
        }
        assert_eq!(atlas.cut_along(&topology, &[]), atlas);
    }
}
