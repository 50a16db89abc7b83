//! Straight cuts: triangles that a line crosses are split along it, their neighbours as far as they share a split edge.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DVec2, DVec3};

use super::topology::HalfEdge;
use super::{Atlas, FaceId, Provenance, Topology, UvId, VertexId};

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
/// is fixed on the other side of the seam). Every split edge gets one new vertex, computed from its ordered ends, so that no crack
/// opens; where a line passes within `snap` of a vertex, the cut goes through the vertex.
pub struct Slicer {
    atlas: Atlas,
    /// Faces about each surface vertex.
    about: Vec<Vec<u32>>,
    /// UV edges to cut, ends ascending.
    cuts: BTreeSet<(UvId, UvId)>,
    snap: f64,
}

impl Slicer {
    /// Starts from an Atlas; `snap` in texels.
    pub fn new(atlas: Atlas, snap: f64) -> Self {
        let mut about = vec![Vec::new(); atlas.surface.positions.len()];
        for (f, t) in atlas.surface.triangles.iter().enumerate() {
            for v in t {
                if about[v.index()].last() != Some(&(f as u32)) {
                    about[v.index()].push(f as u32);
                }
            }
        }
        Slicer { atlas, about, cuts: BTreeSet::new(), snap }
    }

    /// Splits those of the faces that the segment crosses and marks the edges along it as cut. The faces that come to be are appended
    /// to `faces`. Faces of other charts may be split, too, where they share a split edge: these are appended to `others`, each
    /// with the face that it is a part of.
    pub fn slice(&mut self, faces: &mut Vec<FaceId>, segment: Segment, others: &mut Vec<(FaceId, FaceId)>) {
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
            let split = self.crossings(faces, &side, &place, length, &mut on_line);
            if split.is_empty() {
                break;
            }
            on_line.extend(self.split_edges(&split, faces, others));
        }
        // Edges along the line separate its two sides.
        for &face in faces.iter() {
            let corners = self.atlas.corners[face.index()];
            for k in 0..3 {
                let (a, b) = (corners[k], corners[(k + 1) % 3]);
                if a != b && on_line.contains(&a) && on_line.contains(&b) {
                    let [pa, pb] = [a, b].map(|u| self.atlas.uv[u.index()]);
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
        let mut split: BTreeMap<(VertexId, VertexId), f64> = BTreeMap::new();
        for &face in faces {
            let p = self.atlas.uv_triangle(face);
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
            let corners = self.atlas.corners[face.index()];
            on_line.extend((0..3).filter(|&k| s[k] == 0.0).map(|k| corners[k]));
            if !apart {
                continue;
            }
            let t = self.atlas.surface.triangles[face.index()];
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

    /// Splits the edges in all faces that have them. Gives the new UV vertices.
    fn split_edges(
        &mut self,
        split: &BTreeMap<(VertexId, VertexId), f64>,
        faces: &mut Vec<FaceId>,
        others: &mut Vec<(FaceId, FaceId)>,
    ) -> Vec<UvId> {
        let mut affected: BTreeSet<u32> = BTreeSet::new();
        let mut middle: BTreeMap<(VertexId, VertexId), VertexId> = BTreeMap::new();
        for (&(a, b), &t) in split {
            let of_b = &self.about[b.index()];
            affected.extend(self.about[a.index()].iter().filter(|f| of_b.contains(f)));
            let [pa, pb] = [a, b].map(|v| self.atlas.surface.positions[v.index()]);
            middle.insert((a, b), VertexId::new(self.atlas.surface.positions.len()));
            self.atlas.surface.positions.push(pa + (pb - pa) * t);
            self.about.push(Vec::new());
        }
        let own: BTreeSet<u32> = faces.iter().map(|f| f.0).collect();
        let mut fresh: Vec<UvId> = Vec::new();
        // New UV vertices by UV edge, ends in the order of their surface vertices.
        let mut on_edge: BTreeMap<(UvId, UvId), UvId> = BTreeMap::new();
        for f in affected {
            let face = FaceId(f);
            let triangle = self.atlas.surface.triangles[face.index()];
            let corners = self.atlas.corners[face.index()];
            let provenance = self.atlas.provenance[face.index()];
            // Around the face: its corners and the new vertices between them.
            let mut ring: Vec<Knot> = Vec::with_capacity(6);
            for k in 0..3 {
                let j = (k + 1) % 3;
                ring.push(Knot {
                    vertex: triangle[k],
                    uv: corners[k],
                    weight: provenance.barycentric[k],
                    fresh: false,
                });
                let (low, high) = if triangle[k] <= triangle[j] { (k, j) } else { (j, k) };
                let key = (triangle[low], triangle[high]);
                let Some((&vertex, t)) = middle.get(&key).zip(split.get(&key).copied()) else { continue };
                let (ua, ub) = (corners[low], corners[high]);
                let uv = *on_edge.entry((ua, ub)).or_insert_with(|| {
                    let [a, b] = [ua, ub].map(|u| self.atlas.uv[u.index()]);
                    self.atlas.uv.push(a + (b - a) * t);
                    UvId::new(self.atlas.uv.len() - 1)
                });
                if self.cuts.remove(&(ua.min(ub), ua.max(ub))) {
                    self.cuts.insert((ua.min(uv), ua.max(uv)));
                    self.cuts.insert((ub.min(uv), ub.max(uv)));
                }
                let [a, b] = [low, high].map(|k| provenance.barycentric[k]);
                if own.contains(&f) {
                    fresh.push(uv);
                }
                ring.push(Knot { vertex, uv, weight: a + (b - a) * t, fresh: true });
            }
            for (n, part) in self.triangulate(&ring).into_iter().enumerate() {
                let knots = part.map(|i| ring[i]);
                let id = if n == 0 { face } else { FaceId::new(self.atlas.corners.len()) };
                self.put(id, knots, provenance, self.atlas.page[face.index()]);
                if n > 0 && own.contains(&f) {
                    faces.push(id);
                } else if n > 0 {
                    others.push((id, face));
                }
            }
        }
        fresh
    }

    /// Triangles of a ring of up to six knots around a triangle: ears at the old corners between two new vertices, then what is left, by
    /// its shorter diagonal.
    fn triangulate(&self, ring: &[Knot]) -> Vec<[usize; 3]> {
        let at = |i: usize| self.atlas.uv[ring[i].uv.index()];
        let mut left: Vec<usize> = (0..ring.len()).collect();
        let mut parts = Vec::new();
        while left.len() > 3 {
            let n = left.len();
            let neighbours = |i: usize| (left[(i + n - 1) % n], left[(i + 1) % n]);
            let corner_between = |i: &usize| {
                let (a, b) = neighbours(*i);
                !ring[left[*i]].fresh && ring[a].fresh && ring[b].fresh
            };
            let ear = match (0..n).find(corner_between) {
                Some(i) => i,
                None => {
                    // A diagonal between two old corners would run along a split edge.
                    let usable = |i: usize| {
                        let (a, b) = neighbours(i);
                        ring[a].fresh || ring[b].fresh
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

    fn put(&mut self, id: FaceId, knots: [Knot; 3], whole: Provenance, page: u16) {
        let triangle = knots.map(|k| k.vertex);
        let corners = knots.map(|k| k.uv);
        let provenance = Provenance { barycentric: knots.map(|k| k.weight), ..whole };
        if id.index() < self.atlas.corners.len() {
            for v in self.atlas.surface.triangles[id.index()] {
                if !triangle.contains(&v) {
                    self.about[v.index()].retain(|f| *f != id.0);
                }
            }
            self.atlas.surface.triangles[id.index()] = triangle;
            self.atlas.corners[id.index()] = corners;
            self.atlas.provenance[id.index()] = provenance;
        } else {
            self.atlas.surface.triangles.push(triangle);
            self.atlas.corners.push(corners);
            self.atlas.provenance.push(provenance);
            self.atlas.page.push(page);
        }
        for v in triangle {
            if !self.about[v.index()].contains(&id.0) {
                self.about[v.index()].push(id.0);
            }
        }
    }

    /// The Atlas, cut open along all that was marked.
    pub fn finish(self) -> Atlas {
        let topology = Topology::new(&self.atlas);
        let is_cut = |h: &HalfEdge| {
            let corners = self.atlas.corners[*h as usize / 3];
            let (a, b) = (corners[*h as usize % 3], corners[(*h as usize + 1) % 3]);
            self.cuts.contains(&(a.min(b), a.max(b)))
        };
        let cuts: Vec<HalfEdge> = (0..topology.uv_twin.len() as u32).filter(is_cut).collect();
        self.atlas.cut_along(&topology, &cuts)
    }
}

/// A vertex on the rim of a face that is split.
#[derive(Debug, Clone, Copy)]
struct Knot {
    vertex: VertexId,
    uv: UvId,
    /// Barycentric coordinates in the source face.
    weight: DVec3,
    /// Whether it is new.
    fresh: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{Rng, join, sheet};
    use crate::atlas::{Charts, Exactness, NONE, check};

    fn cut(atlas: &Atlas, segments: &[Segment]) -> Atlas {
        let mut slicer = Slicer::new(atlas.clone(), 1e-6);
        let mut faces: Vec<FaceId> = atlas.faces().collect();
        for s in segments {
            slicer.slice(&mut faces, *s, &mut Vec::new());
        }
        slicer.finish()
    }

    fn segment(from: [f64; 2], to: [f64; 2]) -> Segment {
        Segment { from: from.into(), to: to.into() }
    }

    fn border(atlas: &Atlas) -> f64 {
        let topology = Topology::new(atlas);
        (0..topology.uv_twin.len())
            .filter(|h| topology.uv_twin[*h] == NONE)
            .map(|h| {
                let c = atlas.corners[h / 3];
                atlas.uv[c[h % 3].index()].distance(atlas.uv[c[(h + 1) % 3].index()])
            })
            .sum()
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
        let mut slicer = Slicer::new(atlas.clone(), 1e-6);
        let (mut faces, mut others) = (vec![FaceId(0), FaceId(1), FaceId(2), FaceId(3)], Vec::new());
        slicer.slice(&mut faces, segment([0.4, -1.0], [0.4, 2.0]), &mut others);
        let after = slicer.finish();
        assert_eq!(others.len(), 1);
        check(&atlas, &after, Exactness::Exact).unwrap();
        let topology = Topology::new(&after);
        let open = |t: &[u32]| t.iter().filter(|t| **t == NONE).count();
        let before = open(&Topology::new(&atlas).surface_twin);
        assert_eq!(
            open(&topology.surface_twin),
            before + 1,
            "no T-junction: only the outer border's split edge counts twice"
        );
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
        let open = |a: &Atlas| Topology::new(a).surface_twin.iter().filter(|t| **t == NONE).count();
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
