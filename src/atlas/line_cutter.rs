//! Straight cuts across packed charts: where a line crosses the faces that lie under it.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec2;

use super::{Atlas, FaceId, HalfEdge, Mesh, UvId, VertexId};

/// A part of a straight line in the UVs of a chart, as uploaded: from `from` to `to`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// One end.
    pub from: DVec2,
    /// The other.
    pub to: DVec2,
}

/// Rounds of splitting: a seam can be crossed as often as the chart lies along it.
const PASSES: usize = 8;

/// Cuts charts along straight segments (Box Cutter, section 3.2: triangles that a cut line crosses are subdivided, and what would become a T-junction
/// is fixed on the other side of the seam). Where a line passes within `snap` of a vertex, the cut goes through the vertex.
pub struct LineCutter {
    mesh: Mesh,
    /// UV edges to cut, ends ascending.
    cuts: BTreeSet<(UvId, UvId)>,
    snap: f64,
}

impl LineCutter {
    /// Starts from a mesh; `snap` in texels.
    pub fn new(mesh: Mesh, snap: f64) -> Self {
        LineCutter { mesh, cuts: BTreeSet::new(), snap }
    }

    /// Splits those of the faces that the segment crosses and marks the edges along it as cut. The faces that come to be are appended
    /// to `faces`. Faces of other charts may be split, too, where they share a split edge: these are appended to `others`, each
    /// with the face that it is a part of.
    pub fn cut(&mut self, faces: &mut Vec<FaceId>, segment: Segment, others: &mut Vec<(FaceId, FaceId)>) {
        let Some(along) = (segment.to - segment.from).try_normalize() else { return };
        let length = (segment.to - segment.from).length();
        let snap = self.snap;
        let side = |p: DVec2| {
            let s = along.perp_dot(p - segment.from);
            if s.abs() < snap { 0.0 } else { s }
        };
        let place = |p: DVec2| along.dot(p - segment.from);
        // Corners on the line, by UV vertex.
        let mut on_line: BTreeSet<UvId> = BTreeSet::new();
        // A seam whose two sides are both crossed is split at one place at a time.
        for _ in 0..PASSES {
            let splits = self.crossings(faces, &side, &place, length, &mut on_line);
            if splits.is_empty() {
                break;
            }
            self.split(&splits, faces, others, &mut on_line);
        }
        // Edges along the line separate its two sides.
        for &face in faces.iter() {
            for h in (0..3).map(|k| HalfEdge::of(face, k)) {
                let [a, b] = self.mesh.uv_ends(h);
                if a != b && on_line.contains(&a) && on_line.contains(&b) {
                    let [pa, pb] = [a, b].map(|u| self.mesh.position(u));
                    // Two vertices on the line need not be joined along it: near the ends of a short edge snapping may say so.
                    if side(pa) == 0.0 && side(pb) == 0.0 && (0.0..=length).contains(&place((pa + pb) * 0.5)) {
                        self.cuts.insert((a.min(b), a.max(b)));
                    }
                }
            }
        }
    }

    /// The edges to split: by their surface vertices, ascending, the place of the new vertex between them. Corners on the segment
    /// are added to `on_line`.
    fn crossings(
        &self,
        faces: &[FaceId],
        side: &dyn Fn(DVec2) -> f64,
        place: &dyn Fn(DVec2) -> f64,
        length: f64,
        on_line: &mut BTreeSet<UvId>,
    ) -> BTreeMap<(VertexId, VertexId), f64> {
        let atlas = self.mesh.atlas();
        let mut split: BTreeMap<(VertexId, VertexId), f64> = BTreeMap::new();
        for &face in faces {
            let p = atlas.uv_triangle(face);
            let s = p.map(side);
            let zeros = s.iter().filter(|s| **s == 0.0).count();
            let apart = s.iter().any(|s| *s > 0.0) && s.iter().any(|s| *s < 0.0);
            if !apart && zeros < 2 {
                continue;
            }
            // The two places at which the line enters and leaves the face.
            let mut places = Vec::with_capacity(3);
            for k in 0..3 {
                let j = (k + 1) % 3;
                if s[k] == 0.0 {
                    places.push(place(p[k]));
                } else if s[k] * s[j] < 0.0 {
                    let t = s[k] / (s[k] - s[j]);
                    places.push(place(p[k]) * (1.0 - t) + place(p[j]) * t);
                }
            }
            let middle = places.iter().sum::<f64>() / places.len() as f64;
            if !(0.0..=length).contains(&middle) {
                continue;
            }
            let corners = atlas.corners[face.index()];
            on_line.extend((0..3).filter(|&k| s[k] == 0.0).map(|k| corners[k]));
            if !apart {
                continue;
            }
            let t = atlas.surface.triangles[face.index()];
            for k in 0..3 {
                let j = (k + 1) % 3;
                if s[k] * s[j] < 0.0 {
                    let (low, high, a, b) =
                        if t[k] <= t[j] { (t[k], t[j], s[k], s[j]) } else { (t[j], t[k], s[j], s[k]) };
                    if low != high {
                        split.entry((low, high)).or_insert(a / (a - b));
                    }
                }
            }
        }
        split
    }

    /// Splits the edges in all faces that have them. New UV vertices of `faces` are on the line.
    fn split(
        &mut self,
        splits: &BTreeMap<(VertexId, VertexId), f64>,
        faces: &mut Vec<FaceId>,
        others: &mut Vec<(FaceId, FaceId)>,
        on_line: &mut BTreeSet<UvId>,
    ) {
        let own: BTreeSet<FaceId> = faces.iter().copied().collect();
        let made = self.mesh.split_edges(splits);
        for &(face, [a, b], uv) in &made.uvs {
            if self.cuts.remove(&(a.min(b), a.max(b))) {
                self.cuts.extend([a, b].map(|end| (end.min(uv), end.max(uv))));
            }
            if own.contains(&face) {
                on_line.insert(uv);
            }
        }
        for (new, whole) in made.faces {
            if own.contains(&whole) {
                faces.push(new);
            } else {
                others.push((new, whole));
            }
        }
    }

    /// The Atlas, cut open along all that was marked.
    pub fn finish(mut self) -> Atlas {
        let mut cuts = Vec::with_capacity(self.cuts.len());
        for &(a, b) in &self.cuts {
            let about = self.mesh.corners_of(a).flat_map(|corner| [corner, corner.previous()]);
            cuts.extend(about.filter(|h| self.mesh.uv_ends(*h).contains(&b)));
        }
        self.mesh.cut(&cuts);
        self.mesh.into_atlas()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::seams::border_length;
    use crate::atlas::testing::{Rng, join, sheet};
    use crate::atlas::{Charts, Exactness, Topology, check};

    fn cut(atlas: &Atlas, segments: &[Segment]) -> Atlas {
        let mut cutter = LineCutter::new(Mesh::new(atlas.clone()), 1e-6);
        let mut faces: Vec<FaceId> = atlas.faces().collect();
        for s in segments {
            cutter.cut(&mut faces, *s, &mut Vec::new());
        }
        cutter.finish()
    }

    fn segment(from: [f64; 2], to: [f64; 2]) -> Segment {
        Segment { from: from.into(), to: to.into() }
    }

    /// Edges with nothing across them on the surface.
    fn open(atlas: &Atlas) -> usize {
        let topology = Topology::new(atlas);
        topology.half_edges().filter(|h| topology.surface_twin(*h).is_none()).count()
    }

    fn border(atlas: &Atlas) -> f64 {
        border_length(atlas, &Topology::new(atlas))
    }

    #[test]
    fn straight_cuts_make_the_charts_that_the_lines_make() {
        let atlas = sheet(6, 6, DVec2::splat(1.0));
        let cases: [(&[Segment], usize, f64); 5] = [
            (&[segment([3.3, 0.0], [3.3, 9.0])], 2, 6.0),
            (&[segment([4.0, 0.0], [4.0, 9.0])], 2, 6.0), // along edges: nothing is split
            (&[segment([3.3, 0.0], [3.3, 9.0]), segment([0.0, 2.2], [9.0, 2.2])], 4, 12.0),
            (&[segment([3.3, 0.0], [3.3, 9.0]), segment([0.0, 2.2], [3.3, 2.2])], 3, 8.3),
            (&[segment([0.0, 0.0], [9.0, 9.0])], 2, 6.0 * 2f64.sqrt()), // along diagonals
        ];
        for (segments, charts, length) in cases {
            let after = cut(&atlas, segments);
            assert_eq!(Charts::new(&Topology::new(&after)).len(), charts, "{segments:?}");
            assert!((border(&after) - border(&atlas) - 2.0 * length).abs() < 1e-9, "{segments:?}");
            check(&atlas, &after, Exactness::Exact).unwrap();
        }
    }

    #[test]
    fn a_seam_is_split_on_both_sides() {
        // Two charts that share an edge on the surface: the second's UVs lie elsewhere.
        let mut atlas = join(&sheet(2, 1, DVec2::ZERO), &sheet(2, 1, DVec2::new(0.0, 10.0)));
        let at = |atlas: &Atlas, p: DVec2| VertexId::new(atlas.uv.iter().position(|u| *u == p).unwrap());
        for x in 0..3 {
            let (upper, lower) =
                (at(&atlas, DVec2::new(f64::from(x), 1.0)), at(&atlas, DVec2::new(f64::from(x), 10.0)));
            for v in atlas.surface.triangles.iter_mut().flatten().filter(|v| **v == lower) {
                *v = upper;
            }
        }
        let mut cutter = LineCutter::new(Mesh::new(atlas.clone()), 1e-6);
        let (mut faces, mut others) = (vec![FaceId(0), FaceId(1), FaceId(2), FaceId(3)], Vec::new());
        cutter.cut(&mut faces, segment([0.4, -1.0], [0.4, 2.0]), &mut others);
        let after = cutter.finish();
        assert_eq!(others.len(), 1);
        check(&atlas, &after, Exactness::Exact).unwrap();
        let topology = Topology::new(&after);
        let before = open(&atlas);
        assert_eq!(open(&after), before + 1, "no T-junction: only the outer border's split edge counts twice");
        assert_eq!(Charts::new(&topology).len(), 3);
    }

    #[test]
    fn a_seam_that_the_line_crosses_on_both_sides_is_split_at_both_places() {
        // A tube cut open, wider at one side: its left and right border are one seam on the surface, and the line is not level.
        let mut atlas = sheet(4, 3, DVec2::ZERO);
        let at = |x: usize, y: usize| VertexId::new(y * 5 + x);
        for v in atlas.surface.triangles.iter_mut().flatten() {
            if v.index() % 5 == 4 {
                *v = at(0, v.index() / 5);
            }
        }
        let after = cut(&atlas, &[segment([-1.0, 1.3], [5.0, 1.6])]);
        let topology = Topology::new(&after);
        assert_eq!(Charts::new(&topology).len(), 2);
        check(&atlas, &after, Exactness::Exact).unwrap();
        assert_eq!(open(&after), open(&atlas), "no T-junction");
    }

    #[test]
    fn random_lines_leave_the_surface_whole() {
        let mut rng = Rng(9);
        for round in 0..40 {
            let atlas = sheet(5, 4, DVec2::ZERO);
            let segments: Vec<Segment> = (0..1 + round % 6)
                .map(|_| {
                    let (a, b) = (rng.point(5.0), rng.point(5.0));
                    let d = (b - a).normalize() * 20.0;
                    Segment { from: a - d, to: a + d }
                })
                .collect();
            let after = cut(&atlas, &segments);
            check(&atlas, &after, Exactness::Exact).unwrap();
            let area: f64 = after.faces().map(|f| after.uv_area(f)).sum();
            assert!((area - 20.0).abs() < 1e-9);
            let topology = Topology::new(&after);
            assert!(after.faces().all(|f| after.uv_area(f) > 0.0), "no face is flipped or flat");
            assert!(Charts::new(&topology).len() > segments.len(), "each line separates");
        }
    }
}
