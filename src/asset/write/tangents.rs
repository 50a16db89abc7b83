//! Tangents for charts that have none and were cut, joined or turned.
//!
//! Where a primitive has a normal map and no TANGENT, renderers compute tangents from the texture coordinates (glTF 2.0,
//! 3.7.2.1: MikkTSpace). Those of the new layout would not be those of the uploaded one wherever charts were cut apart or put
//! together, and the shading would show it. So the tangents of the uploaded layout are written, turned with their charts.

use bevy_mikktspace::{Geometry, TangentSpace, generate_tangents};
use serde_json::Value;

use super::blend::{unit, wide};
use super::turn::{Tangent, Turn};
use super::vertices::{Point, Points};
use super::{Refined, reads_directions, uploaded};
use crate::asset::accessor::{read_vec2, read_vec3};
use crate::asset::json::{array, index};
use crate::asset::primitive::primitive_pointer;
use crate::asset::{Document, PrimitiveRef};
use crate::atlas::{Atlas, FaceId, HalfEdge, Topology};
use crate::error::Result;

/// Which primitives of a set lost the tangents that renderers would compute: they read directions, have NORMAL and no TANGENT, and
/// a face of theirs was split, turned or mirrored, or an edge of theirs was cut or joined. (Where UVs are sheared, the
/// tangents that follow from turned UVs are not the turned tangents.)
pub(super) fn lost(doc: &Document, refined: &Refined<'_>, faces: &[Vec<FaceId>]) -> Result<Vec<bool>> {
    let set = refined.set;
    let mut lost = Vec::with_capacity(set.primitives.len());
    for (p, primitive) in set.primitives.iter().enumerate() {
        let attributes = uploaded(doc, primitive)?.get("attributes");
        let has = |name: &str| attributes.is_some_and(|a| a.get(name).is_some());
        lost.push(reads_directions(set, p) && has("NORMAL") && !has("TANGENT"));
    }
    if lost.contains(&true) {
        let (before, after) = (Topology::new(&set.atlas), Topology::new(refined.atlas));
        for (lost, faces) in lost.iter_mut().zip(faces) {
            *lost &= faces.iter().any(|f| is_changed(&set.atlas, refined.atlas, &before, &after, *f));
        }
    }
    Ok(lost)
}

/// Whether a face was split or turned, or has other neighbours in its chart than it had.
fn is_changed(uploaded: &Atlas, atlas: &Atlas, before: &Topology, after: &Topology, face: FaceId) -> bool {
    let provenance = &atlas.provenance[face.index()];
    let turned = || Turn::of(uploaded.uv_triangle(provenance.source), atlas.uv_triangle(face));
    !provenance.is_whole()
        || turned().is_some_and(|t| !t.is_none())
        || (0..3).any(|k| {
            let old = before.uv_twin(HalfEdge::of(provenance.source, k)).map(HalfEdge::face);
            let new = after.uv_twin(HalfEdge::of(face, k)).map(|h| atlas.provenance[h.face().index()].source);
            old != new
        })
}

/// MikkTSpace of an uploaded primitive: the tangents at the corners of each of its faces. None where there are no normals, or
/// none that make sense of it.
pub(crate) fn generate(doc: &Document, primitive: &PrimitiveRef) -> Result<Option<Vec<[Tangent; 3]>>> {
    let pointer = format!("{}/attributes", primitive_pointer(primitive.mesh, primitive.primitive));
    let value = doc.json.pointer(&pointer).unwrap_or(&Value::Null);
    let accessors = array(&doc.json, "accessors").len();
    let find = |name: &str| index(value, name, accessors, &pointer);
    let name = format!("TEXCOORD_{}", primitive.layout.uv_set);
    let (Some(positions), Some(normals), Some(uvs)) = (find("POSITION")?, find("NORMAL")?, find(&name)?) else {
        return Ok(None);
    };
    let mut mesh = TangentMesh {
        corners: &primitive.corners,
        positions: read_vec3(doc, positions)?,
        normals: read_vec3(doc, normals)?,
        uvs: read_vec2(doc, uvs)?
            .into_iter()
            .map(|uv| primitive.layout.transform.apply(uv).as_vec2().to_array())
            .collect(),
        tangents: vec![[[1.0, 0.0, 0.0, 1.0]; 3]; primitive.corners.len()],
    };
    let finite = mesh.normals.iter().flatten().all(|x| x.is_finite());
    let enough = mesh.normals.len() >= mesh.positions.len();
    if !finite || !enough || primitive.corners.is_empty() || generate_tangents(&mut mesh).is_err() {
        return Ok(None);
    }
    Ok(Some(mesh.tangents))
}

struct TangentMesh<'a> {
    corners: &'a [[u32; 3]],
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    tangents: Vec<[Tangent; 3]>,
}

impl TangentMesh<'_> {
    fn vertex(&self, face: usize, corner: usize) -> usize {
        self.corners[face][corner] as usize
    }
}

impl Geometry for TangentMesh<'_> {
    fn num_faces(&self) -> usize {
        self.corners.len()
    }

    fn num_vertices_of_face(&self, _: usize) -> usize {
        3
    }

    fn position(&self, face: usize, corner: usize) -> [f32; 3] {
        self.positions[self.vertex(face, corner)]
    }

    fn normal(&self, face: usize, corner: usize) -> [f32; 3] {
        self.normals[self.vertex(face, corner)]
    }

    fn tex_coord(&self, face: usize, corner: usize) -> [f32; 2] {
        self.uvs[self.vertex(face, corner)]
    }

    fn set_tangent(&mut self, space: Option<TangentSpace>, face: usize, corner: usize) {
        let Some(space) = space else { return };
        let [x, y, z, w] = space.tangent_encoded();
        // Its bitangent follows v, which runs down the image; glTF's points up.
        let [x, y, z] = unit([f64::from(x), f64::from(y), f64::from(z)]);
        if [x, y, z] != [0.0; 3] {
            self.tangents[face][corner] = [x, y, z, -w];
        }
    }
}

/// The tangents, on the uploaded layout, at the corners of a face, which lie at `points` of its source.
pub(super) fn at(
    owner: &Points<'_>,
    primitive: &PrimitiveRef,
    tangents: &[[Tangent; 3]],
    face: FaceId,
    points: [Point; 3],
) -> Result<[Tangent; 3]> {
    let (source, corners) = owner.source(face)?;
    let own = source.index().checked_sub(primitive.first_face).and_then(|i| tangents.get(i));
    let own = own.copied().unwrap_or([[1.0, 0.0, 0.0, 1.0]; 3]);
    let of_vertex = |v: u32| corners.iter().position(|c| *c == v).map_or(own[0], |k| own[k]);
    Ok(points.map(|point| match point {
        Point::Vertex(v) => of_vertex(v),
        _ => {
            let (weights, n) = point.weights();
            // In the order of the point, so that both faces at an edge agree.
            let sum = weights[..n].iter().fold(glam::DVec3::ZERO, |sum, (v, w)| {
                let [x, y, z, _] = of_vertex(*v);
                sum + wide([x, y, z]) * *w
            });
            let [x, y, z] = unit(sum.to_array());
            [x, y, z, of_vertex(weights[0].0)[3]]
        }
    }))
}

#[cfg(test)]
mod tests;
