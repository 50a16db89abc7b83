//! From a document to its texture sets.

use super::geometry::{Geometry, Reader, weld};
use super::home::bring_home;
use super::scan::{Scan, scan};
use super::sets::{Planned, grid, plan};
use super::{Document, PrimitiveRef, TextureSet};
use crate::atlas::{FaceId, Provenance};
use crate::context::Context;
use crate::error::Result;
use crate::refine::options::AtlasOptions;

/// Longest name of a texture set, in characters.
const LONGEST_NAME: usize = 60;

/// Reads every texture set of the layout `options.uv_set`. What cannot be refined passes through with a warning on
/// the context; the result is empty when nothing can.
///
/// # Errors
/// `invalid_model` with a pointer for indices out of range, attribute counts that differ and numbers that are not
/// finite; `too_large` when 32 bits cannot count the corners; `canceled`.
pub fn read(doc: &Document, options: &AtlasOptions, context: &Context) -> Result<Vec<TextureSet>> {
    let scan = scan(doc)?;
    let uv_set = options.uv_set as usize;
    let mut reader = Reader::new(doc);
    let mut sets = Vec::new();
    for planned in plan(doc, &scan, uv_set, context)? {
        if let Some(set) = read_set(doc, &scan, planned, sets.len(), options, &mut reader, context)? {
            sets.push(set);
        }
    }
    Ok(sets)
}

fn read_set(
    doc: &Document,
    scan: &Scan,
    planned: Planned,
    id: usize,
    options: &AtlasOptions,
    reader: &mut Reader<'_>,
    context: &Context,
) -> Result<Option<TextureSet>> {
    let uv_set = options.uv_set as usize;
    let mut geometries: Vec<Geometry> = Vec::new();
    for &p in &planned.primitives {
        let primitive = &scan.primitives[p];
        geometries.push(reader.read(primitive.mesh, primitive.primitive, uv_set, context)?);
    }
    let mut atlas = weld(&geometries, planned.reference, context)?;
    if atlas.corners.is_empty() {
        return Ok(None);
    }
    if let Err(warning) = bring_home(&mut atlas, &planned.slots, planned.reference, options.tiling) {
        let first = planned.primitives.first().map(|&p| &scan.primitives[p]);
        let at = planned.slots.first().map(|s| format!("/images/{}", s.image));
        let at = at.or_else(|| first.map(|p| p.pointer())).unwrap_or_default();
        context.warn(warning.at(at));
        return Ok(None);
    }
    let mut primitives = Vec::new();
    for (i, (geometry, &p)) in geometries.into_iter().zip(&planned.primitives).enumerate() {
        let first_face = atlas.provenance.len();
        let face_count = geometry.corners.len();
        atlas
            .provenance
            .extend((first_face..first_face + face_count).map(|f| Provenance::whole(FaceId::new(f), i as u32)));
        let scanned = &scan.primitives[p];
        primitives.push(PrimitiveRef {
            mesh: scanned.mesh,
            primitive: scanned.primitive,
            material: scanned.default_material,
            uv_set,
            first_face,
            face_count,
            corners: geometry.corners,
        });
    }
    atlas.page = vec![0; atlas.corners.len()];
    atlas.sheets = vec![planned.reference];
    let name = name(doc, scan, &planned);
    let grid = grid(planned.reference, &planned.slots);
    let Planned { slots, reference, .. } = planned;
    Ok(Some(TextureSet { id, name, atlas, reference, primitives, slots, grid }))
}

/// The materials' names, each once, or the model's.
fn name(doc: &Document, scan: &Scan, planned: &Planned) -> String {
    let mut names: Vec<&str> = Vec::new();
    let mut length = 0;
    let materials = planned.primitives.iter().flat_map(|&p| &scan.primitives[p].materials);
    for name in materials.filter_map(|&m| scan.materials.get(m)?.name.as_deref()) {
        if !names.contains(&name) && length < LONGEST_NAME {
            length += name.chars().count();
            names.push(name);
        }
    }
    let joined = if names.is_empty() { doc.name.clone() } else { names.join(", ") };
    if joined.chars().count() <= LONGEST_NAME {
        return joined;
    }
    joined.chars().take(LONGEST_NAME - 1).chain(['…']).collect()
}
