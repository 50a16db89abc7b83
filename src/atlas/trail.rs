//! Trails: straight walks over the triangles of one chart.
//!
//! A chart may lie on itself: which triangles a line covers says nothing then of those that it walks. A trail goes from face to face over UV
//! edges, so that it stays in the sheet where it began (the motorcycles of bounded packing efficiency, section 3.2, run so).

use std::collections::BTreeMap;

use glam::DVec2;

use super::{Atlas, FaceId, HalfEdge, Mesh, UvId, VertexId, orientation};

/// Where a trail starts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TrailStart {
    /// At a corner of a face, which names the sheet where several meet in a UV vertex.
    Corner(HalfEdge),
    /// On a half edge, this part of the way along it (0..1), into its face.
    Edge(HalfEdge, f64),
}

/// A place that a trail passes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TrailPoint {
    /// A UV vertex.
    Vertex(UvId),
    /// A point of an edge, this part of the way along the half edge (0..1).
    Edge(HalfEdge, f64),
}

/// Why a trail ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrailEnd {
    /// It came to the border of its chart.
    Border,
    /// It had its length; its last point is the last vertex or edge before that.
    Length,
    /// It never left its start: the direction leads out of the chart, or a face has no area.
    Outside,
}

/// A straight walk.
#[derive(Debug, Clone, PartialEq)]
pub struct Trail {
    /// The places that it passes, in order, the start first.
    pub points: Vec<TrailPoint>,
    /// UV length from the start to the last point.
    pub length: f64,
    /// Why it ended.
    pub end: TrailEnd,
}

/// What dividing a chart along a trail made.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DividedTrail {
    /// The half edges along the trail, from its start on.
    pub path: Vec<HalfEdge>,
    /// New faces, each after the one that it is a part of; that one remains as another part.
    pub faces: Vec<(FaceId, FaceId)>,
}

/// Rounds of splitting: a seam can be crossed on both of its sides.
const PASSES: usize = 8;

/// The line of a walk.
struct Ray {
    origin: DVec2,
    /// Of length 1.
    along: DVec2,
    /// Vertices that are nearer are on it.
    snap: f64,
}

impl Ray {
    /// Signed distance from the line.
    fn side(&self, p: DVec2) -> f64 {
        self.along.perp_dot(p - self.origin)
    }

    /// How far along it.
    fn reach(&self, p: DVec2) -> f64 {
        self.along.dot(p - self.origin)
    }

    fn is_on(&self, p: DVec2) -> bool {
        self.side(p).abs() < self.snap
    }
}

/// The place of a walk: on its way into a face through a point, or at a vertex.
#[derive(Clone, Copy)]
enum Place {
    /// At this corner, with the face yet to be chosen from those about its vertex.
    Vertex(HalfEdge),
    /// In the face of this half edge, entered through it.
    Face(HalfEdge),
}

impl Mesh {
    /// Where a point of a trail lies.
    pub fn point_position(&self, point: TrailPoint) -> DVec2 {
        match point {
            TrailPoint::Vertex(uv) => self.position(uv),
            TrailPoint::Edge(h, t) => {
                let [a, b] = self.uv_ends(h).map(|u| self.position(u));
                a + (b - a) * t
            }
        }
    }

    /// Walks from `start` in `direction` for at most `length`, in texels. The walk passes through vertices that it comes nearer to than `snap`.
    pub fn trail(&self, start: TrailStart, direction: DVec2, length: f64, snap: f64) -> Trail {
        let (first, mut place) = match start {
            TrailStart::Corner(corner) => (TrailPoint::Vertex(self.uv_at(corner)), Place::Vertex(corner)),
            TrailStart::Edge(h, t) => (TrailPoint::Edge(h, t), Place::Face(h)),
        };
        let origin = self.point_position(first);
        let mut trail = Trail { points: vec![first], length: 0.0, end: TrailEnd::Outside };
        let Some(along) = direction.try_normalize() else { return trail };
        let ray = Ray { origin, along, snap };
        // A straight walk enters no face twice.
        for _ in 0..=self.atlas().face_count() {
            let next = match place {
                Place::Vertex(corner) => self.leave_vertex(corner, &ray),
                Place::Face(h) => self.cross_face(h, &ray),
            };
            let Some(point) = next else { break };
            let at = ray.reach(self.point_position(point));
            if at > length {
                trail.end = TrailEnd::Length;
                break;
            }
            trail.points.push(point);
            trail.length = at;
            trail.end = TrailEnd::Border;
            place = match point {
                TrailPoint::Vertex(uv) => match self.fan_corner(uv, place) {
                    Some(corner) => Place::Vertex(corner),
                    None => break,
                },
                TrailPoint::Edge(h, _) => match self.topology().uv_twin(h) {
                    Some(twin) => Place::Face(twin),
                    None => break,
                },
            };
        }
        trail
    }

    /// The place where the walk leaves the face that it entered through `h`: a vertex that is near, or a point of another edge.
    fn cross_face(&self, h: HalfEdge, ray: &Ray) -> Option<TrailPoint> {
        let [a, b] = self.uv_ends(h).map(|u| ray.reach(self.position(u)));
        for corner in [h.next().next(), h.next(), h] {
            let p = self.position(self.uv_at(corner));
            // The opposite vertex first; an end of the edge only where the walk runs along it.
            if ray.is_on(p) && (corner == h.previous() || ray.reach(p) > a.min(b) + ray.snap) {
                return Some(TrailPoint::Vertex(self.uv_at(corner)));
            }
        }
        [h.next(), h.previous()].into_iter().find_map(|edge| self.crossing(edge, ray))
    }

    /// The point at which the walk crosses an edge.
    fn crossing(&self, h: HalfEdge, ray: &Ray) -> Option<TrailPoint> {
        let [a, b] = self.uv_ends(h).map(|u| ray.side(self.position(u)));
        (a * b < 0.0).then(|| TrailPoint::Edge(h, a / (a - b)))
    }

    /// The place to which the walk comes from a vertex: over one of the faces of the fan that the corner is of.
    fn leave_vertex(&self, corner: HalfEdge, ray: &Ray) -> Option<TrailPoint> {
        let here = ray.reach(self.position(self.uv_at(corner)));
        let fan = self.fan(corner);
        // Along an edge, if there is one.
        for &c in &fan {
            for end in [c.next(), c.previous()] {
                let p = self.position(self.uv_at(end));
                if ray.is_on(p) && ray.reach(p) > here {
                    return Some(TrailPoint::Vertex(self.uv_at(end)));
                }
            }
        }
        let forward = |point: &TrailPoint| ray.reach(self.point_position(*point)) > here;
        fan.iter().find_map(|c| self.crossing(c.next(), ray).filter(forward))
    }

    /// The corners that lie at the UV vertex of `corner` and hang together with it over UV edges, in a fixed order.
    pub fn fan(&self, corner: HalfEdge) -> Vec<HalfEdge> {
        let uv = self.uv_at(corner);
        let mut fan = vec![corner];
        let mut next = 0;
        while let Some(&c) = fan.get(next) {
            next += 1;
            for h in [c, c.previous()] {
                let Some(twin) = self.topology().uv_twin(h) else { continue };
                for other in [twin, twin.next()] {
                    if self.uv_at(other) == uv && !fan.contains(&other) {
                        fan.push(other);
                    }
                }
            }
        }
        fan
    }

    /// The corner at a vertex of the face, or the fan, that the walk was in.
    fn fan_corner(&self, uv: UvId, place: Place) -> Option<HalfEdge> {
        let of_face = |f: FaceId| (0..3).map(|k| HalfEdge::of(f, k)).find(|c| self.uv_at(*c) == uv);
        match place {
            Place::Face(h) => of_face(h.face()),
            Place::Vertex(corner) => self.fan(corner).into_iter().find_map(|c| of_face(c.face())),
        }
    }

    /// Cuts the chart open along a trail: edges that it crosses are split, faces divided along it. A stretch that ran to a length and not to a border ends at its
    /// last point.
    pub fn cut_trail(&mut self, start: TrailStart, direction: DVec2, length: f64, snap: f64) -> DividedTrail {
        let divided = self.divide_along(start, direction, length, snap);
        self.cut(&divided.path);
        divided
    }

    /// Divides the faces along a trail, without cutting. Trails that cross it later find them.
    pub fn divide_along(&mut self, start: TrailStart, direction: DVec2, length: f64, snap: f64) -> DividedTrail {
        let mut divided = DividedTrail::default();
        let Some(first) = self.start_corner(start, &mut divided.faces) else { return divided };
        let first_uv = self.uv_at(first);
        for _ in 0..PASSES {
            // Splitting divides faces: the corner is found again by its vertex and what lies about it.
            let fan = self.fan(self.corner_towards(first, first_uv, direction));
            let Some(&corner) = fan.first() else { return divided };
            let trail = self.trail(TrailStart::Corner(corner), direction, length, snap);
            let mut splits: BTreeMap<(VertexId, VertexId), f64> = BTreeMap::new();
            for point in &trail.points {
                if let TrailPoint::Edge(h, t) = *point {
                    let [a, b] = self.surface_ends(h);
                    // A seam that is crossed on both sides is split at one place now, at the other in the next round.
                    splits.entry((a.min(b), a.max(b))).or_insert(if a <= b { t } else { 1.0 - t });
                }
            }
            if splits.is_empty() {
                divided.path = self.path_along(&trail);
                return divided;
            }
            divided.faces.extend(self.split_edges(&splits).faces);
        }
        divided
    }

    /// The corner at which a trail starts; a start on an edge becomes a vertex, of the face that the half edge was of or of a part of it.
    fn start_corner(&mut self, start: TrailStart, made_faces: &mut Vec<(FaceId, FaceId)>) -> Option<HalfEdge> {
        let (h, t) = match start {
            TrailStart::Corner(corner) => return Some(corner),
            TrailStart::Edge(h, t) => (h, t),
        };
        let face = h.face();
        let made = self.split_edge(h, t);
        let uv = made.uvs.iter().find(|u| u.0 == face)?.2;
        made_faces.extend(&made.faces);
        let parts = made.faces.iter().filter(|f| f.1 == face).map(|f| f.0).chain([face]);
        parts.flat_map(|f| (0..3).map(move |k| HalfEdge::of(f, k))).find(|c| self.uv_at(*c) == uv)
    }

    /// A corner at `uv` of the fan that `first` was of, in a face that the direction points into where there is one.
    fn corner_towards(&self, first: HalfEdge, uv: UvId, direction: DVec2) -> HalfEdge {
        let known = if self.uv_at(first) == uv { Some(first) } else { self.corners_of(uv).next() };
        let Some(known) = known else { return first };
        let into = |c: &HalfEdge| points_into(self.atlas(), *c, direction);
        self.fan(known).into_iter().find(into).unwrap_or(known)
    }

    /// The half edges between the vertices of a trail that crosses no edge any more.
    fn path_along(&self, trail: &Trail) -> Vec<HalfEdge> {
        let vertices: Vec<UvId> = trail
            .points
            .iter()
            .filter_map(|p| match p {
                TrailPoint::Vertex(uv) => Some(*uv),
                TrailPoint::Edge(..) => None,
            })
            .collect();
        let edge = |pair: &[UvId]| {
            let about = self.corners_of(pair[0]).flat_map(|c| [c, c.previous()]);
            let mut found = about.filter(|h| self.uv_ends(*h).contains(&pair[1]));
            found.next()
        };
        vertices.windows(2).filter_map(edge).collect()
    }
}

/// Whether a direction from a corner points into its face, or along its edge.
fn points_into(atlas: &Atlas, corner: HalfEdge, direction: DVec2) -> bool {
    let t = atlas.uv_triangle(corner.face());
    let (p, q, r) = (t[corner.corner()], t[corner.end_corner()], t[(corner.corner() + 2) % 3]);
    let turn = f64::from(orientation(p, q, r));
    turn != 0.0 && turn * (q - p).perp_dot(direction) >= 0.0 && turn * direction.perp_dot(r - p) >= 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::testing::{Rng, sheet};
    use crate::atlas::{Charts, Exactness, Topology, check};

    /// A ramp that winds about the origin: `turns` times round, so that it lies on itself; strips of width 2 at radius 4.
    fn spiral(turns: f64, steps: usize) -> Atlas {
        let mut own = sheet(steps, 2, DVec2::ZERO);
        for (i, uv) in own.uv.iter_mut().enumerate() {
            let (x, y) = (i % (steps + 1), i / (steps + 1));
            let angle = turns * std::f64::consts::TAU * x as f64 / steps as f64;
            *uv = DVec2::from_angle(angle) * (4.0 + y as f64) + DVec2::splat(10.0);
        }
        own
    }

    fn border_edge(mesh: &Mesh, near: DVec2) -> HalfEdge {
        let borders = mesh.topology().half_edges().filter(|h| mesh.topology().is_border(*h));
        let middle = |h: &HalfEdge| mesh.point_position(TrailPoint::Edge(*h, 0.5)).distance(near);
        borders.min_by(|a, b| middle(a).total_cmp(&middle(b))).unwrap()
    }

    #[test]
    fn a_trail_crosses_a_sheet_from_border_to_border() {
        let start = sheet(6, 6, DVec2::ZERO);
        let mut mesh = Mesh::new(start.clone());
        let h = border_edge(&mesh, DVec2::new(0.0, 2.5));
        let trail = mesh.trail(TrailStart::Edge(h, 0.3), DVec2::X, f64::INFINITY, 1e-9);
        assert_eq!(trail.end, TrailEnd::Border);
        assert!((trail.length - 6.0).abs() < 1e-12 && trail.points.len() == 13, "{trail:?}");
        let path = mesh.cut_trail(TrailStart::Edge(h, 0.3), DVec2::X, f64::INFINITY, 1e-9);
        assert_eq!(path.path.len(), 12);
        assert_eq!(Charts::new(mesh.topology()).len(), 2);
        check(&start, mesh.atlas(), Exactness::Exact).unwrap();
    }

    #[test]
    fn along_edges_and_through_vertices_nothing_is_split() {
        let start = sheet(4, 4, DVec2::ZERO);
        let corner = |mesh: &Mesh, at: DVec2| {
            let all = mesh.topology().half_edges();
            all.into_iter().find(|c| mesh.position(mesh.uv_at(*c)) == at).unwrap()
        };
        for (from, direction, edges) in
            [(DVec2::new(0.0, 2.0), DVec2::X, 4), (DVec2::ZERO, DVec2::ONE, 4), (DVec2::new(3.0, 4.0), DVec2::NEG_Y, 4)]
        {
            let mut mesh = Mesh::new(start.clone());
            let path = mesh.cut_trail(TrailStart::Corner(corner(&mesh, from)), direction, f64::INFINITY, 1e-9);
            assert_eq!((path.path.len(), mesh.atlas().face_count()), (edges, start.face_count()), "{from} {direction}");
            assert_eq!(Charts::new(mesh.topology()).len(), 2);
        }
        let mesh = Mesh::new(start);
        let out = mesh.trail(TrailStart::Corner(corner(&mesh, DVec2::ZERO)), DVec2::NEG_X, 9.0, 1e-9);
        assert_eq!((out.points.len(), out.end), (1, TrailEnd::Outside));
        let short = mesh.trail(TrailStart::Corner(corner(&mesh, DVec2::ZERO)), DVec2::X, 2.5, 1e-9);
        assert_eq!((short.points.len(), short.end, short.length), (3, TrailEnd::Length, 2.0));
    }

    #[test]
    fn a_chart_that_lies_on_itself_is_cut_in_one_sheet_only() {
        let start = spiral(2.5, 100);
        let mut mesh = Mesh::new(start.clone());
        // Straight outwards from the inner border, at an angle over which the ramp passes three times.
        let inner =
            |h: &HalfEdge| mesh.uv_ends(*h).iter().all(|u| mesh.position(*u).distance(DVec2::splat(10.0)) < 4.1);
        let all: Vec<HalfEdge> =
            mesh.topology().half_edges().filter(|h| mesh.topology().is_border(*h)).filter(inner).collect();
        let at = |h: &HalfEdge| mesh.point_position(TrailPoint::Edge(*h, 0.5)) - DVec2::splat(10.0);
        let over: Vec<HalfEdge> =
            all.into_iter().filter(|h| at(h).angle_to(DVec2::from_angle(0.3)).abs() < 0.08).collect();
        assert_eq!(over.len(), 3, "the ramp passes three times");
        let direction = at(&over[1]);
        let path = mesh.cut_trail(TrailStart::Edge(over[1], 0.5), direction, f64::INFINITY, 1e-9);
        let charts = Charts::new(mesh.topology());
        assert_eq!(charts.len(), 2, "one sheet is cut through, the two others are whole: {path:?}");
        let mut sizes: Vec<usize> = charts.faces.iter().map(Vec::len).collect();
        sizes.sort_unstable();
        assert!(sizes[0] > 100, "in the middle: {sizes:?}");
        let new: Vec<_> = check(&start, mesh.atlas(), Exactness::Exact).err().unwrap_or_default();
        assert!(new.is_empty(), "{new:?}");
    }

    #[test]
    fn many_trails_leave_the_surface_whole() {
        let mut rng = Rng(4);
        for round in 0..30 {
            let start = sheet(5, 4, DVec2::ZERO);
            let mut mesh = Mesh::new(start.clone());
            let mut cut = 0;
            for _ in 0..1 + round % 5 {
                let borders: Vec<HalfEdge> =
                    mesh.topology().half_edges().filter(|h| mesh.topology().surface_twin(*h).is_none()).collect();
                let h = borders[rng.next() as usize % borders.len()];
                let direction = rng.point(2.0) - DVec2::ONE;
                cut += usize::from(
                    !mesh.cut_trail(TrailStart::Edge(h, 0.1 + 0.8 * rng.unit()), direction, 1e9, 1e-7).path.is_empty(),
                );
            }
            let after = mesh.into_atlas();
            check(&start, &after, Exactness::Exact).unwrap();
            assert!((after.faces().map(|f| after.uv_area(f)).sum::<f64>() - 20.0).abs() < 1e-9);
            assert!(Charts::new(&Topology::new(&after)).len() <= 1 + 12 * cut);
        }
    }
}
