//! Refined sets back into their document: new UVs, the vertices and materials that they need, the baked images.
//!
//! The JSON is edited: what is not touched stays equal, indices never change, new objects are appended.

mod attributes;
mod blend;
mod extensions;
mod read_back;
mod skin;
pub(crate) mod tangents;
#[cfg(test)]
mod tests;
mod textures;
mod turn;
mod vertices;

use std::collections::BTreeMap;

use serde_json::Value;

pub use read_back::read_back;

use self::attributes::{Attributes, emit};
use self::textures::{Owner, Textures};
use self::vertices::{Points, Pool, Vertices};
use super::accessor::RawAccessor;
use super::append::ELEMENT_ARRAY_BUFFER;
use super::document::Document;
use super::extensions::VARIANTS;
use super::geometry::{HeldTriangle, vertex_count, with_held};
use super::json::{array, array_mut, object_mut};
use super::material_index::MaterialIndex;
use super::primitive::primitive_pointer;
use super::texture_set::{PrimitiveRef, TextureSet};
use crate::atlas::{Atlas, FaceId};
use crate::context::Context;
use crate::error::{Failure, Result};
use crate::texture::Format;

/// A texture set with its refined Atlas and what was baked for it.
#[derive(Debug, Clone)]
pub struct Refined<'a> {
    /// The set as read.
    pub set: &'a TextureSet,
    /// The Atlas after refinement.
    pub atlas: &'a Atlas,
    /// One image for each page of each slot that is not exempt.
    pub images: Vec<BakedImage>,
}

/// One encoded output texture.
#[derive(Debug, Clone)]
pub struct BakedImage {
    /// Index into the set's slots.
    pub slot: usize,
    /// Index into the refined Atlas' sheets.
    pub page: usize,
    /// Container of `bytes`.
    pub format: Format,
    /// The file.
    pub bytes: Vec<u8>,
    /// A name that sets which share an Atlas give the same image: it stands once in the document, and beside it, when it
    /// is saved with side files, under this name.
    pub shared: Option<String>,
}

/// Writes refined sets into a copy of the document that they were read from; `index` is that of the document.
///
/// # Errors
/// `invalid_model` for attributes of differing counts, `too_large` when the vertices grow beyond what a GLB can hold,
/// `internal` where a set does not belong to the document or an image of it is missing, `canceled`.
pub fn write(doc: &Document, index: &MaterialIndex, sets: &[Refined<'_>], context: &Context) -> Result<Document> {
    let mut out = doc.clone();
    let mut textures = Textures::new(index, sets, array(&doc.json, "images").len());
    textures.place_images(&mut out)?;
    let faces: Vec<Vec<Vec<FaceId>>> = sets.iter().map(|s| faces_of(s.set, s.atlas)).collect::<Result<_>>()?;
    let lost: Vec<Vec<bool>> =
        sets.iter().zip(&faces).map(|(s, faces)| tangents::lost(doc, s, faces)).collect::<Result<_>>()?;
    let mut points: Vec<Points<'_>> = sets.iter().map(|s| Points::new(s.set, s.atlas)).collect();
    let mut written: BTreeMap<(usize, usize), Written> = BTreeMap::new();
    for members in pools(doc, sets)? {
        context.check()?;
        let make_tangents = members.iter().any(|&(s, p)| lost[s][p]);
        let (vertices, attributes) = pool(doc, &mut out, sets, &members, &faces, &mut points, make_tangents)?;
        let mut start = 0;
        for &(s, p) in &members {
            let own = faces[s][p].len();
            let triangles = vertices.triangles.get(start..start + own).unwrap_or_default().to_vec();
            start += own;
            written.insert((s, p), Written { triangles, attributes: attributes.clone() });
        }
    }
    // In the order of sets, so that `read_back` can tell which appended primitive is whose.
    for ((s, p), primitive) in written {
        context.check()?;
        let (refined, owner) = (&sets[s], Owner::of(sets, s, p));
        for (n, page) in pages(refined.atlas, &faces[s][p]).into_iter().enumerate() {
            let target = place(doc, &mut out, refined, p, n)?;
            let own = &refined.set.primitives[p];
            let on_page = faces[s][p].iter().zip(&primitive.triangles);
            let on_page = on_page.filter(|(f, _)| refined.atlas.page[f.index()] == page);
            let triangles: Vec<(usize, [u32; 3])> = on_page
                .map(|(f, t)| (refined.atlas.provenance[f.index()].source.index().saturating_sub(own.first_face), *t))
                .collect();
            let on_page_count = triangles.len();
            let triangles = with_held(triangles.into_iter(), held_on(own, n));
            set_geometry(&mut out, &target, &refined.set.primitives[p], triangles, &primitive)?;
            if on_page_count != refined.set.primitives[p].corners.len() {
                extensions::drop_of_triangles(&mut out.json, &target, context)?;
            }
            set_materials(doc, &mut out, &mut textures, &target, owner, usize::from(page))?;
        }
    }
    textures.drop_replaced(&mut out);
    extensions::declare(&doc.json, &mut out.json);
    Ok(out)
}

/// What became of a primitive.
struct Written {
    /// Triangles in the order of its faces.
    triangles: Vec<[u32; 3]>,
    attributes: Attributes,
}

/// The triangles of a primitive that are held back and stand on its `n`-th page: all on the first.
fn held_on(primitive: &PrimitiveRef, n: usize) -> &[HeldTriangle] {
    if n == 0 { &primitive.held } else { &[] }
}

/// The faces of each primitive in the order of the uploaded triangles, which is the order of drawing.
fn faces_of(set: &TextureSet, atlas: &Atlas) -> Result<Vec<Vec<FaceId>>> {
    let mut faces = vec![Vec::new(); set.primitives.len()];
    for face in atlas.faces() {
        let known = atlas.provenance.get(face.index()).and_then(|p| faces.get_mut(p.primitive as usize));
        known.ok_or_else(|| Failure::internal("a face has no valid provenance"))?.push(face);
        if atlas.page.get(face.index()).is_none_or(|p| usize::from(*p) >= atlas.sheets.len()) {
            return Err(Failure::internal("a face lies on a page that does not exist"));
        }
    }
    faces.iter_mut().for_each(|own| own.sort_by_key(|f| (atlas.provenance[f.index()].source, *f)));
    Ok(faces)
}

/// The pages that some faces lie on, ascending. A primitive without faces has one.
fn pages(atlas: &Atlas, faces: &[FaceId]) -> Vec<u16> {
    let mut pages: Vec<u16> = faces.iter().map(|f| atlas.page[f.index()]).collect();
    pages.sort_unstable();
    pages.dedup();
    if pages.is_empty() {
        pages.push(0);
    }
    pages
}

/// Whether a primitive reads directions through the refined layout.
fn reads_directions(set: &TextureSet, primitive: usize) -> bool {
    set.slots.iter().any(|s| s.role.is_direction() && s.primitives.contains(&(primitive as u32)))
}

/// Primitives, as (set, primitive), that share all their attributes, and so their vertices.
fn pools(doc: &Document, sets: &[Refined<'_>]) -> Result<Vec<Vec<(usize, usize)>>> {
    let mut order: Vec<Vec<(usize, usize)>> = Vec::new();
    let mut known: BTreeMap<(String, usize, usize), usize> = BTreeMap::new();
    for (s, refined) in sets.iter().enumerate() {
        for (p, primitive) in refined.set.primitives.iter().enumerate() {
            let value = uploaded(doc, primitive)?;
            let names = format!("{:?} {:?}", value.get("attributes"), value.get("targets"));
            let key = (names, primitive.layout.uv_set, primitive.written);
            let index = *known.entry(key).or_insert_with(|| {
                order.push(Vec::new());
                order.len() - 1
            });
            order[index].push((s, p));
        }
    }
    Ok(order)
}

fn uploaded<'a>(doc: &'a Document, primitive: &PrimitiveRef) -> Result<&'a Value> {
    let pointer = primitive_pointer(primitive.mesh, primitive.primitive);
    doc.json.pointer(&pointer).ok_or_else(|| Failure::internal("the set is of another document").at(pointer))
}

/// The vertices of a pool, the attributes that hold them, and the TEXCOORD sets that were read and written.
fn pool(
    doc: &Document,
    out: &mut Document,
    sets: &[Refined<'_>],
    members: &[(usize, usize)],
    faces: &[Vec<Vec<FaceId>>],
    points: &mut [Points<'_>],
    make_tangents: bool,
) -> Result<(Vertices, Attributes)> {
    let first = members.first().map(|&(s, p)| &sets[s].set.primitives[p]);
    let first = first.ok_or_else(|| Failure::internal("a pool of no primitives"))?;
    let value = uploaded(doc, first)?;
    let pointer = primitive_pointer(first.mesh, first.primitive);
    let layout = [first.layout.uv_set, first.written];
    let attributes = value.get("attributes");
    let has = |name: &str| attributes.is_some_and(|a| a.get(name).is_some());
    // Directions that are read through another layout keep their tangents.
    let directions = members.iter().any(|&(s, p)| reads_directions(sets[s].set, p));
    let turning = make_tangents || (directions && has("NORMAL") && has("TANGENT"));
    let mut pool = Pool::new(vertex_count(doc, &pointer)?, turning);
    for &(s, p) in members {
        let (atlas, primitive) = (sets[s].atlas, &sets[s].set.primitives[p]);
        let made = if make_tangents { tangents::generate(doc, primitive)? } else { None };
        for &face in &faces[s][p] {
            let [width, height] = atlas.sheets[usize::from(atlas.page[face.index()])];
            let uvs =
                atlas.uv_triangle(face).map(|uv| [(uv.x / f64::from(width)) as f32, (uv.y / f64::from(height)) as f32]);
            let turn = if turning { points[s].turn(face) } else { None };
            let own = points[s].of(face)?;
            let tangents = match &made {
                Some(made) => Some(tangents::at(&points[s], primitive, made, face, own)?),
                None => None,
            };
            pool.add(own, uvs, turn, tangents);
        }
    }
    let vertices = pool.finish()?;
    let attributes = emit(doc, out, value, &pointer, &vertices, layout)?;
    Ok((vertices, attributes))
}

/// JSON pointer of the primitive that takes the faces of the `n`-th page: the uploaded one, or a copy behind the others.
fn place(doc: &Document, out: &mut Document, refined: &Refined<'_>, p: usize, n: usize) -> Result<String> {
    let primitive = &refined.set.primitives[p];
    if n == 0 {
        return Ok(primitive_pointer(primitive.mesh, primitive.primitive));
    }
    let clone = uploaded(doc, primitive)?.clone();
    let mesh = out.json.pointer_mut(&format!("/meshes/{}", primitive.mesh));
    let mesh = mesh.ok_or_else(|| Failure::internal("the set is of another document"))?;
    let primitives = array_mut(mesh, "primitives")?;
    primitives.push(clone);
    Ok(primitive_pointer(primitive.mesh, primitives.len() - 1))
}

/// Gives a primitive its attributes, and indices and mode where the triangles are not the uploaded ones.
fn set_geometry(
    out: &mut Document,
    pointer: &str,
    uploaded: &PrimitiveRef,
    triangles: Vec<[u32; 3]>,
    written: &Written,
) -> Result<()> {
    let mut indices = None;
    if triangles != with_held(uploaded.corners.iter().copied().enumerate(), &uploaded.held) {
        let raw = RawAccessor::from_indices(triangles.as_flattened());
        indices = Some(out.append_accessor(&raw, Some(ELEMENT_ARRAY_BUFFER), false));
    }
    let primitive = object_mut(&mut out.json, pointer)?;
    primitive.insert("attributes".to_owned(), written.attributes.attributes.clone());
    if let Some(targets) = &written.attributes.targets {
        primitive.insert("targets".to_owned(), targets.clone());
    }
    if let Some(indices) = indices {
        primitive.insert("indices".to_owned(), Value::from(indices));
        if primitive.contains_key("mode") {
            primitive.insert("mode".to_owned(), Value::from(4));
        }
    }
    Ok(())
}

/// Points a primitive, and its variants, to the materials of a page.
fn set_materials(
    doc: &Document,
    out: &mut Document,
    textures: &mut Textures<'_>,
    pointer: &str,
    owner: Owner,
    page: usize,
) -> Result<()> {
    let mut places = vec![format!("{pointer}/material")];
    let mappings = format!("{pointer}/extensions/{VARIANTS}/mappings");
    let count = out.json.pointer(&mappings).and_then(Value::as_array).map_or(0, Vec::len);
    places.extend((0..count).map(|i| format!("{mappings}/{i}/material")));
    for place in places {
        let Some(material) = out.json.pointer(&place).and_then(Value::as_u64) else { continue };
        let new = textures.material(out, doc, material as usize, owner, page)?;
        if let Some(value) = out.json.pointer_mut(&place).filter(|_| new as u64 != material) {
            *value = Value::from(new);
        }
    }
    Ok(())
}
