//! The Atlas of a set as a written file has it.

use std::collections::{BTreeMap, HashMap};

use super::{Refined, faces_of, held_on, pages};
use crate::asset::geometry::{GeometryReader, PrimitiveGeometry, interleaved, weld};
use crate::asset::json::array;
use crate::asset::primitive::primitive_pointer;
use crate::asset::{Document, UvLayout};
use crate::atlas::{Atlas, FaceId, UvId};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Reads the Atlas of `sets[index]` from the document that [`super::write`] made of all of `sets` (or from the file saved from it).
/// Faces, provenance, pages and sheets are those of the refined Atlas; surface and UVs are the file's own.
///
/// # Errors
/// `invalid_model` or `internal` where the document does not hold the set.
pub fn read_back(doc: &Document, sets: &[Refined<'_>], index: usize, context: &Context) -> Result<Atlas> {
    let refined = sets.get(index).ok_or_else(|| Failure::internal("there is no such set"))?;
    let (set, after) = (refined.set, refined.atlas);
    let faces = faces_of(set, after)?;
    let appended = if after.sheets.len() > 1 { appended(doc, sets)? } else { BTreeMap::new() };
    let mut reader = GeometryReader::new(doc);
    // Geometries, the faces that they hold, and the page of each.
    let mut parts: Vec<(PrimitiveGeometry, Vec<FaceId>, u16)> = Vec::new();
    for (p, primitive) in set.primitives.iter().enumerate() {
        for (n, page) in pages(after, &faces[p]).into_iter().enumerate() {
            let number = match n {
                0 => primitive.primitive,
                _ => appended.get(&(index, p)).map_or(usize::MAX, |first| first + n - 1),
            };
            let mut geometry =
                reader.read(primitive.mesh, number, Some(UvLayout::plain(primitive.written)), context)?;
            let own: Vec<FaceId> = faces[p].iter().copied().filter(|f| after.page[f.index()] == page).collect();
            let numbered = own
                .iter()
                .map(|f| (after.provenance[f.index()].source.index().saturating_sub(primitive.first_face), *f));
            let (there, read) = (interleaved(numbered, held_on(primitive, n)), geometry.all_corners());
            if there.len() != read.len() {
                let text = format!("{} triangles were written, and {} are read", there.len(), read.len());
                return Err(Failure::internal(text).at(primitive_pointer(primitive.mesh, number)));
            }
            // Those that are held back belong to no Atlas, whatever became of their numbers.
            geometry.corners =
                read.into_iter().zip(&there).filter(|(_, face)| face.is_some()).map(|(t, _)| t).collect();
            geometry.held = Vec::new();
            parts.push((geometry, own, page));
        }
    }
    let (geometries, owners): (Vec<_>, Vec<_>) = parts.into_iter().map(|(g, faces, page)| (g, (faces, page))).unzip();
    let read = weld(&geometries, [1, 1], context)?;
    let mut atlas = Atlas {
        provenance: after.provenance.clone(),
        page: after.page.clone(),
        sheets: after.sheets.clone(),
        corners: vec![Default::default(); after.corners.len()],
        uv: Vec::new(),
        surface: crate::atlas::Surface {
            triangles: vec![Default::default(); after.corners.len()],
            ..read.surface.clone()
        },
    };
    let order = owners.iter().flat_map(|(faces, page)| faces.iter().map(|f| (*f, *page)));
    // Corners on two pages may have equal UVs in the file: each page has its own. Looked up, never walked.
    let mut scaled = vec![None; read.uv.len()];
    let mut copies: HashMap<(UvId, u16), UvId> = HashMap::new();
    atlas.uv = read.uv.clone();
    for (i, (face, page)) in order.enumerate() {
        atlas.surface.triangles[face.index()] = read.surface.triangles[i];
        let sheet = after.sheets[usize::from(page)];
        let size = glam::DVec2::new(f64::from(sheet[0]), f64::from(sheet[1]));
        let mut corners = read.corners[i];
        for corner in &mut corners {
            match scaled[corner.index()] {
                None => {
                    scaled[corner.index()] = Some(page);
                    atlas.uv[corner.index()] = read.uv[corner.index()] * size;
                }
                Some(first) if first == page => {}
                Some(_) => {
                    *corner = *copies.entry((*corner, page)).or_insert_with(|| {
                        atlas.uv.push(read.uv[corner.index()] * size);
                        UvId::new(atlas.uv.len() - 1)
                    });
                }
            }
        }
        atlas.corners[face.index()] = corners;
    }
    Ok(atlas)
}

/// Numbers of the first primitive that [`super::write`] appended for each (set, primitive): they stand at their mesh's
/// end in the order of sets, primitives and pages.
fn appended(doc: &Document, sets: &[Refined<'_>]) -> Result<BTreeMap<(usize, usize), usize>> {
    // By mesh: how many were appended so far; then where the first stands.
    let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
    let mut places = BTreeMap::new();
    for (s, refined) in sets.iter().enumerate() {
        let faces = faces_of(refined.set, refined.atlas)?;
        for (p, primitive) in refined.set.primitives.iter().enumerate() {
            let count = counts.entry(primitive.mesh).or_default();
            places.insert((s, p), (primitive.mesh, *count));
            *count += pages(refined.atlas, &faces[p]).len() - 1;
        }
    }
    let first = |mesh: usize| {
        let pointer = format!("/meshes/{mesh}");
        let all = doc.json.pointer(&pointer).map_or(0, |m| array(m, "primitives").len());
        let added = counts.get(&mesh).copied().unwrap_or(0);
        all.checked_sub(added).ok_or_else(|| Failure::internal("written primitives are missing").at(pointer))
    };
    places.into_iter().map(|(key, (mesh, before))| Ok((key, first(mesh)? + before))).collect()
}
