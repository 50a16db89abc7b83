//! The triangles of primitives, and the Atlas that they form.

use std::collections::HashMap;
use std::rc::Rc;

use glam::{DVec2, DVec3};

use super::accessor::{accessor_count, read_indices, read_vec2, read_vec3};
use super::document::Document;
use super::json::{array, index};
use super::primitive::primitive_pointer;
use super::transform::{TextureTransform, UvLayout};
use crate::atlas::{Atlas, UvId, VertexId};
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};

/// Accessors of positions and, where there are any, UVs.
type VertexAccessors = (usize, Option<usize>);

/// A primitive's triangles, with what an Atlas needs of its vertices.
#[derive(Debug)]
pub(crate) struct PrimitiveGeometry {
    /// Index into `/meshes`: vertices of different meshes are never welded.
    pub(crate) mesh: usize,
    /// Where its vertices come from.
    pub(crate) accessors: VertexAccessors,
    /// Position by glTF vertex, finite for those of `corners`.
    pub(crate) positions: Rc<Vec<[f32; 3]>>,
    /// UV by glTF vertex, as stored, finite for those of `corners`; none where the primitive has no layout.
    pub(crate) uvs: Option<Rc<Vec<[f32; 2]>>>,
    /// What is done to the UVs before a texture is read.
    pub(crate) transform: TextureTransform,
    /// glTF vertices of each triangle.
    pub(crate) corners: Vec<[u32; 3]>,
    /// Triangles that are none of these, because a number of theirs is not finite: of each its vertices, and how many of `corners` stand before it.
    pub(crate) held: Vec<HeldTriangle>,
}

/// A triangle that is held back: its glTF vertices, and how many triangles that are not held back stand before it.
pub(crate) type HeldTriangle = ([u32; 3], usize);

/// Triangles in their order, those that are held back among them: `own` are the others, each with its number among the uploaded
/// ones that are not held back, ascending. None stands for one that is held back.
pub(crate) fn interleaved<T>(own: impl Iterator<Item = (usize, T)>, held: &[HeldTriangle]) -> Vec<Option<T>> {
    let mut all = Vec::new();
    let mut left = held.iter().map(|(_, before)| *before).peekable();
    for (number, triangle) in own {
        while left.next_if(|before| *before <= number).is_some() {
            all.push(None);
        }
        all.push(Some(triangle));
    }
    all.extend(left.map(|_| None));
    all
}

impl PrimitiveGeometry {
    /// All triangles in their order.
    pub(crate) fn all_corners(&self) -> Vec<[u32; 3]> {
        with_held(self.corners.iter().copied().enumerate(), &self.held)
    }
}

/// [`interleaved`] triangles by their vertices.
pub(crate) fn with_held(own: impl Iterator<Item = (usize, [u32; 3])>, held: &[HeldTriangle]) -> Vec<[u32; 3]> {
    let mut left = held.iter().map(|(corners, _)| *corners);
    interleaved(own, held).into_iter().filter_map(|own| own.or_else(|| left.next())).collect()
}

/// Reads primitives; accessors that several share are read once.
pub(crate) struct GeometryReader<'a> {
    doc: &'a Document,
    positions: HashMap<usize, Rc<Vec<[f32; 3]>>>,
    uvs: HashMap<usize, Rc<Vec<[f32; 2]>>>,
}

impl<'a> GeometryReader<'a> {
    /// A reader of `doc`.
    pub(crate) fn new(doc: &'a Document) -> Self {
        GeometryReader { doc, positions: HashMap::new(), uvs: HashMap::new() }
    }

    /// Triangles and positions of a triangle primitive, and its texture coordinates through `layout`, where it has one. Triangles with
    /// numbers that are not finite are held back.
    ///
    /// # Errors
    /// `invalid_model` with the accessor's pointer: index out of range, counts that differ.
    pub(crate) fn read(
        &mut self,
        mesh: usize,
        primitive: usize,
        layout: Option<UvLayout>,
        context: &Context,
    ) -> Result<PrimitiveGeometry> {
        context.check()?;
        let pointer = primitive_pointer(mesh, primitive);
        let value = self.doc.json.pointer(&pointer);
        let value = value.ok_or_else(|| Failure::model("the primitive does not exist").at(&*pointer))?;
        let accessors = array(&self.doc.json, "accessors").len();
        let attribute = |name: &str| attribute(self.doc, &pointer, name);
        let name = layout.map(|l| format!("TEXCOORD_{}", l.uv_set));
        let (p, t) = (attribute("POSITION")?, name.as_deref().map(attribute).transpose()?);
        let positions = cached(&mut self.positions, p, || read_vec3(self.doc, p))?;
        let mut uvs = None;
        if let (Some(t), Some(name)) = (t, name) {
            let own = cached(&mut self.uvs, t, || read_vec2(self.doc, t))?;
            if positions.len() != own.len() {
                let text = format!("{name} has {} elements, POSITION has {}", own.len(), positions.len());
                return Err(Failure::model(text).at(format!("{pointer}/attributes/{name}")));
            }
            uvs = Some(own);
        }
        let mode = value.get("mode").and_then(serde_json::Value::as_u64).unwrap_or(4);
        let indices = index(value, "indices", accessors, &pointer)?;
        let order = match indices {
            Some(i) => read_indices(self.doc, i)?,
            None => (0..u32::try_from(positions.len()).map_err(|_| too_many())?).collect(),
        };
        if let Some(bad) = order.iter().find(|v| **v as usize >= positions.len()) {
            let text = format!("index {bad} is out of range: the primitive has {} vertices", positions.len());
            let at = indices.map_or(pointer, |i| format!("/accessors/{i}"));
            return Err(Failure::model(text).at(at));
        }
        // What has no layout stays as it is, and loses nothing.
        if mode == 4 && order.len() % 3 != 0 && layout.is_some() {
            let text = format!("{} indices are no whole number of triangles: the last are ignored", order.len());
            context.warn(Warning::new("trailing_indices", text).at(pointer));
        }
        let transform = layout.map_or(TextureTransform::IDENTITY, |l| l.transform);
        let is_finite = |v: &u32| {
            let uv = uvs.as_ref().map_or([0.0; 2], |uvs| uvs[*v as usize]);
            positions[*v as usize].iter().chain(&uv).all(|x| x.is_finite())
        };
        let (mut corners, mut held) = (Vec::new(), Vec::new());
        for triangle in triangles(mode, &order) {
            match triangle.iter().all(is_finite) {
                true => corners.push(triangle),
                false => held.push((triangle, corners.len())),
            }
        }
        Ok(PrimitiveGeometry { mesh, accessors: (p, t), positions, uvs, transform, corners, held })
    }
}

/// The accessor of an attribute of the primitive at `pointer`.
fn attribute(doc: &Document, pointer: &str, name: &str) -> Result<usize> {
    let at = format!("{pointer}/attributes");
    let attributes = doc.json.pointer(&at).unwrap_or(&serde_json::Value::Null);
    let found = index(attributes, name, array(&doc.json, "accessors").len(), &at)?;
    found.ok_or_else(|| Failure::model(format!("the primitive has no {name}")).at(at))
}

/// The number of vertices of a primitive, as its POSITION accessor declares it.
pub(crate) fn vertex_count(doc: &Document, pointer: &str) -> Result<usize> {
    accessor_count(doc, attribute(doc, pointer, "POSITION")?)
}

fn too_many() -> Failure {
    Failure::new(Code::TooLarge, "the texture set has more corners than 32 bits can count")
}

fn cached<const N: usize>(
    cache: &mut HashMap<usize, Rc<Vec<[f32; N]>>>,
    accessor: usize,
    read: impl FnOnce() -> Result<Vec<[f32; N]>>,
) -> Result<Rc<Vec<[f32; N]>>> {
    if let Some(found) = cache.get(&accessor) {
        return Ok(found.clone());
    }
    let values = Rc::new(read()?);
    cache.insert(accessor, values.clone());
    Ok(values)
}

/// The triangles that a list of vertices means (glTF 2.0, section 3.7.2.1); what is left over is dropped.
fn triangles(mode: u64, order: &[u32]) -> Vec<[u32; 3]> {
    match (mode, order) {
        (5, _) => {
            let strip = order.windows(3).enumerate();
            strip.map(|(i, w)| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[0], w[2], w[1]] }).collect()
        }
        (6, [hub, rest @ ..]) => rest.windows(2).map(|w| [w[0], w[1], *hub]).collect(),
        _ => order.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
    }
}

/// Bits of a number by which equal positions are told: -0 is 0.
fn bits<const N: usize>(v: [f32; N]) -> [u32; N] {
    v.map(|x| (x + 0.0).to_bits())
}

fn uv_bits(uv: DVec2) -> [u64; 2] {
    [uv.x, uv.y].map(|x| (x + 0.0).to_bits())
}

/// Surface vertex and UV vertex.
type Ids = (u32, u32);

/// Ids by glTF vertex. A thousand meshes may each use three vertices of an accessor of millions: those that use few are
/// hashed.
enum VertexIds {
    Dense(Vec<Ids>),
    Few(HashMap<u32, Ids>),
}

impl VertexIds {
    fn new(vertices: usize, faces: usize) -> Self {
        if faces < vertices / 16 {
            VertexIds::Few(HashMap::new())
        } else {
            VertexIds::Dense(vec![(u32::MAX, 0); vertices])
        }
    }

    fn get_or_insert_with(&mut self, vertex: u32, make: impl FnOnce() -> Ids) -> &Ids {
        match self {
            VertexIds::Few(known) => known.entry(vertex).or_insert_with(make),
            VertexIds::Dense(known) => {
                let ids = &mut known[vertex as usize];
                if ids.0 == u32::MAX {
                    *ids = make();
                }
                ids
            }
        }
    }
}

/// The Atlas of some primitives: positions welded within a mesh where they are equal bit by bit, UVs within a
/// welded vertex; UVs transformed and scaled to `size` texels. All primitives have UVs, or none has. No provenance, page or
/// sheet yet.
///
/// # Errors
/// `too_large` when 32 bits cannot count the corners.
pub(crate) fn weld(primitives: &[PrimitiveGeometry], size: [u32; 2], context: &Context) -> Result<Atlas> {
    let faces: usize = primitives.iter().map(|g| g.corners.len()).sum();
    if faces >= (u32::MAX / 3) as usize {
        return Err(too_many());
    }
    let scale = DVec2::new(f64::from(size[0]), f64::from(size[1]));
    let mut atlas = Atlas::default();
    // Looked up, never walked: the order of ids is that of first use.
    let mut vertices: HashMap<(usize, [u32; 3]), u32> = HashMap::new();
    let mut uvs: HashMap<(u32, [u64; 2]), u32> = HashMap::new();
    // By mesh, accessors and transform: the ids of each glTF vertex, once it is used.
    let mut tables: HashMap<(usize, VertexAccessors, TextureTransform), VertexIds> = HashMap::new();
    for geometry in primitives {
        context.check()?;
        let known = tables
            .entry((geometry.mesh, geometry.accessors, geometry.transform))
            .or_insert_with(|| VertexIds::new(geometry.positions.len(), geometry.corners.len()));
        for corners in &geometry.corners {
            let mut ids = [(0, 0); 3];
            for (id, &v) in ids.iter_mut().zip(corners) {
                *id = *known.get_or_insert_with(v, || {
                    let position = geometry.positions[v as usize];
                    let vertex = *vertices.entry((geometry.mesh, bits(position))).or_insert_with(|| {
                        atlas.surface.positions.push(DVec3::from(position.map(f64::from)));
                        atlas.surface.positions.len() as u32 - 1
                    });
                    let Some(own) = &geometry.uvs else { return (vertex, Atlas::NO_UV.0) };
                    let uv = geometry.transform.apply(own[v as usize]);
                    let uv = *uvs.entry((vertex, uv_bits(uv))).or_insert_with(|| {
                        atlas.uv.push(uv * scale);
                        atlas.uv.len() as u32 - 1
                    });
                    (vertex, uv)
                });
            }
            atlas.surface.triangles.push(ids.map(|i| VertexId(i.0)));
            atlas.corners.push(ids.map(|i| UvId(i.1)));
        }
    }
    Ok(atlas)
}
