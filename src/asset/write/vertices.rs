//! Which vertices the refined triangles need: the uploaded ones where one UV is enough, copies where it is not,
//! new points where a face was split.

use std::collections::HashMap;

use glam::{DVec2, DVec3};

use super::turn::{Tangent, Turn};
use crate::asset::TextureSet;
use crate::atlas::{Atlas, FaceId, VertexId};
use crate::error::{Failure, Result};

/// A point of the uploaded primitive, by glTF vertices. Parameters are kept as bits, so that points can be compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Point {
    /// A vertex.
    Vertex(u32),
    /// A point of an edge; the ends are in the order of their surface vertices, so that both faces of the edge,
    /// whatever primitive they are in, name and evaluate it alike. The parameter runs from the first end.
    Edge([u32; 2], u64),
    /// A point inside a triangle, by barycentric coordinates.
    Inside([u32; 3], [u64; 3]),
}

impl Point {
    /// The vertices that it lies between with their weights, in the order of evaluation.
    pub(super) fn weights(&self) -> ([(u32, f64); 3], usize) {
        match *self {
            Point::Vertex(v) => ([(v, 1.0), (v, 0.0), (v, 0.0)], 1),
            Point::Edge([a, b], t) => {
                let t = f64::from_bits(t);
                ([(a, 1.0 - t), (b, t), (b, 0.0)], 2)
            }
            Point::Inside(v, b) => (std::array::from_fn(|k| (v[k], f64::from_bits(b[k]))), 3),
        }
    }
}

/// Barycentric coordinates closer to 0 or 1 than this are 0 or 1.
const ON_EDGE: f64 = 1e-9;

/// Components of tangents that differ by less are equal.
const SAME_TANGENT: f32 = 1e-4;

/// Names the corners of a refined Atlas by points of its uploaded primitives.
pub(super) struct Points<'a> {
    set: &'a TextureSet,
    atlas: &'a Atlas,
    /// By surface vertex of `atlas`: the edge (its surface vertices as uploaded) and parameter that the first face
    /// with it gives.
    edges: Vec<Option<([VertexId; 2], f64)>>,
    /// By surface vertex of `atlas`: the face and coordinates inside it that the first face gives.
    inside: Vec<Option<(FaceId, DVec3)>>,
}

impl<'a> Points<'a> {
    /// For one refined set.
    pub(super) fn new(set: &'a TextureSet, atlas: &'a Atlas) -> Self {
        let n = atlas.surface.positions.len();
        Points { set, atlas, edges: vec![None; n], inside: vec![None; n] }
    }

    /// The uploaded face of a face, and its glTF vertices.
    pub(super) fn source(&self, face: FaceId) -> Result<(FaceId, [u32; 3])> {
        let wrong = || Failure::internal("a face has no valid provenance");
        let provenance = self.atlas.provenance.get(face.index()).ok_or_else(wrong)?;
        let primitive = self.set.primitives.get(provenance.primitive as usize).ok_or_else(wrong)?;
        let local = provenance.source.index().checked_sub(primitive.first_face).ok_or_else(wrong)?;
        Ok((provenance.source, *primitive.corners.get(local).ok_or_else(wrong)?))
    }

    /// The points of a face's corners.
    pub(super) fn of(&mut self, face: FaceId) -> Result<[Point; 3]> {
        let (source, corners) = self.source(face)?;
        let provenance = self.atlas.provenance[face.index()];
        if provenance.is_whole() {
            return Ok(corners.map(Point::Vertex));
        }
        let mut points = [Point::Vertex(0); 3];
        for (k, point) in points.iter_mut().enumerate() {
            let vertex = self.atlas.surface.triangles[face.index()][k];
            *point = self.point(source, corners, provenance.barycentric[k], vertex)?;
        }
        Ok(points)
    }

    fn point(&mut self, source: FaceId, corners: [u32; 3], b: DVec3, vertex: VertexId) -> Result<Point> {
        let b = b.to_array();
        if let Some(k) = b.iter().position(|x| *x >= 1.0 - ON_EDGE) {
            return Ok(Point::Vertex(corners[k]));
        }
        let wrong = || Failure::internal("a face names a surface vertex that does not exist");
        if let Some(k) = b.iter().position(|x| x.abs() <= ON_EDGE) {
            let (mut i, mut j) = ((k + 1) % 3, (k + 2) % 3);
            let ends = self.set.atlas.surface.triangles.get(source.index()).ok_or_else(wrong)?;
            if (ends[i], corners[i]) > (ends[j], corners[j]) {
                (i, j) = (j, i);
            }
            let edge = [ends[i], ends[j]];
            let own = b[j] / (b[i] + b[j]);
            let first = self.edges.get_mut(vertex.index()).ok_or_else(wrong)?.get_or_insert((edge, own));
            let t = if first.0 == edge { first.1 } else { own };
            return Ok(Point::Edge([corners[i], corners[j]], t.to_bits()));
        }
        let own = DVec3::from(b) / (b[0] + b[1] + b[2]);
        let first = self.inside.get_mut(vertex.index()).ok_or_else(wrong)?.get_or_insert((source, own));
        let b = if first.0 == source { first.1 } else { own };
        Ok(Point::Inside(corners, b.to_array().map(f64::to_bits)))
    }

    /// The turn of a face from the uploaded to the refined layout.
    pub(super) fn turn(&self, face: FaceId) -> Option<Turn> {
        let provenance = self.atlas.provenance.get(face.index())?;
        let [a, b, c] = self.set.atlas.uv_triangle(provenance.source);
        let before = provenance.barycentric.map(|w| -> DVec2 { a * w.x + b * w.y + c * w.z });
        Turn::of(before, self.atlas.uv_triangle(face))
    }
}

/// The vertices of all refined primitives that share their attributes.
pub(super) struct Pool {
    /// Number of uploaded vertices.
    count: usize,
    /// Whether vertices whose faces turn differently are told apart.
    turning: bool,
    sites: Vec<Site>,
    /// Looked up, never walked.
    by_key: HashMap<(Point, [u32; 2]), u32>,
    faces: Vec<[(u32, Option<u32>); 3]>,
}

/// A point with one UV, and the turns of the faces at it.
struct Site {
    point: Point,
    uv: [f32; 2],
    turns: Vec<Turned>,
}

/// Faces at a site that turn alike and have one tangent.
struct Turned {
    turn: Turn,
    /// On the uploaded layout, where tangents are made.
    tangent: Option<Tangent>,
    /// Number of the vertex, once it has one.
    vertex: Option<u32>,
}

/// Whether two tangents are the same but for noise.
fn alike(a: Option<Tangent>, b: Option<Tangent>) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => a[3] == b[3] && (0..3).all(|k| (a[k] - b[k]).abs() < SAME_TANGENT),
        (a, b) => a.is_none() && b.is_none(),
    }
}

/// What a [`Pool`] comes to.
pub(super) struct Vertices {
    /// Triangles in the order in which they were added.
    pub(super) triangles: Vec<[u32; 3]>,
    /// New UV by vertex; none for uploaded vertices that no refined face has.
    pub(super) uvs: Vec<Option<[f32; 2]>>,
    /// Turn by vertex.
    pub(super) turns: Vec<Turn>,
    /// Tangent on the uploaded layout by vertex, where tangents are made.
    pub(super) tangents: Vec<Option<Tangent>>,
    /// The points of the vertices appended to the uploaded ones.
    pub(super) appended: Vec<Point>,
}

impl Pool {
    /// An empty pool over `count` uploaded vertices.
    pub(super) fn new(count: usize, turning: bool) -> Self {
        Pool { count, turning, sites: Vec::new(), by_key: HashMap::new(), faces: Vec::new() }
    }

    /// Adds a face. `tangents` are those on the uploaded layout, where tangents are made.
    pub(super) fn add(
        &mut self,
        points: [Point; 3],
        uvs: [[f32; 2]; 3],
        turn: Option<Turn>,
        tangents: Option<[Tangent; 3]>,
    ) {
        let turn = if self.turning { turn } else { Some(Turn::NONE) };
        let mut corners = [(0, None); 3];
        for (k, corner) in corners.iter_mut().enumerate() {
            // -0 and 0 are one place.
            let uv = uvs[k].map(|x| x + 0.0);
            let sites = &mut self.sites;
            let site = *self.by_key.entry((points[k], uv.map(f32::to_bits))).or_insert_with(|| {
                sites.push(Site { point: points[k], uv, turns: Vec::new() });
                sites.len() as u32 - 1
            });
            let turns = &mut sites[site as usize].turns;
            let tangent = tangents.map(|t| t[k]);
            let same = |t: &Turned, turn: &Turn| t.turn.agrees(turn) && alike(t.tangent, tangent);
            let group = turn.map(|turn| match turns.iter_mut().position(|t| same(t, &turn)) {
                Some(i) => {
                    turns[i].turn.z += turn.z;
                    i as u32
                }
                None => {
                    turns.push(Turned { turn, tangent, vertex: None });
                    turns.len() as u32 - 1
                }
            });
            *corner = (site, group);
        }
        self.faces.push(corners);
    }

    /// Numbers the vertices: the first at an uploaded vertex keeps its number, the others are appended.
    pub(super) fn finish(mut self) -> Result<Vertices> {
        let mut out = Vertices {
            triangles: Vec::with_capacity(self.faces.len()),
            uvs: vec![None; self.count],
            turns: vec![Turn::NONE; self.count],
            tangents: vec![None; self.count],
            appended: Vec::new(),
        };
        for corners in &self.faces {
            let mut triangle = [0; 3];
            for (index, &(site, group)) in triangle.iter_mut().zip(corners) {
                let site = &mut self.sites[site as usize];
                if site.turns.is_empty() {
                    // Only faces without area lie here.
                    site.turns.push(Turned { turn: Turn::NONE, tangent: None, vertex: None });
                }
                let turned = &mut site.turns[group.unwrap_or(0) as usize];
                let vertex = match turned.vertex {
                    Some(vertex) => vertex,
                    None => out.claim(site.point, site.uv, turned.turn, turned.tangent)?,
                };
                turned.vertex = Some(vertex);
                *index = vertex;
            }
            out.triangles.push(triangle);
        }
        Ok(out)
    }
}

impl Vertices {
    fn claim(&mut self, point: Point, uv: [f32; 2], turn: Turn, tangent: Option<Tangent>) -> Result<u32> {
        if let Point::Vertex(v) = point {
            let place = self.uvs.get_mut(v as usize);
            let place = place.ok_or_else(|| Failure::internal("a corner names a vertex that does not exist"))?;
            if place.is_none() {
                *place = Some(uv);
                self.turns[v as usize] = turn;
                self.tangents[v as usize] = tangent;
                return Ok(v);
            }
        }
        self.uvs.push(Some(uv));
        self.turns.push(turn);
        self.tangents.push(tangent);
        self.appended.push(point);
        Ok(self.uvs.len() as u32 - 1)
    }

    /// Whether any vertex was turned.
    pub(super) fn any_turn(&self) -> bool {
        self.turns.iter().any(|t| !t.is_none())
    }

    /// Whether tangents are made.
    pub(super) fn has_tangents(&self) -> bool {
        self.tangents.iter().any(Option::is_some)
    }

    /// Whether any vertex lies between uploaded ones.
    pub(super) fn any_split(&self) -> bool {
        self.appended.iter().any(|p| !matches!(p, Point::Vertex(_)))
    }
}
