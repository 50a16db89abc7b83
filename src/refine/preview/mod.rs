//! The preview of a job: what its page draws, before and after, in one compact file. `api/preview.md` tells the layout.
//!
//! It is made where the job ends, while the uploaded images, the Atlases and the provenance of every face are at hand: nothing of an upload
//! is kept after its job. It is bounded by [`MAX_BYTES`], whatever comes in.

mod container;
mod pages;
mod side;
mod simplify;

use serde_json::{Value, json};

use self::container::Sections;
use self::pages::{Share, after_page, before_page};
use self::side::{Counterparts, ShownPrimitive, side};
use super::group::Group;
use super::load::Loaded;
use super::refinement::Refinement;
use super::textures::active;
use crate::asset::mesh_instances;
use crate::atlas::{Charts, FaceId, Topology};
use crate::context::Context;
use crate::error::{Failure, Result};
use crate::texture::Wrap;

/// Name of the artifact.
pub const NAME: &str = "preview.bin";
/// Bytes of the file, at most.
const MAX_BYTES: usize = 10_000_000;
/// Of these, bytes of all pictures together.
const PICTURE_BYTES: usize = 5_500_000;
/// Triangles that are shown, of both sides together: about what the rest of the bytes holds.
const MOST_TRIANGLES: usize = 400_000;
/// Transforms of one mesh that are shown.
const MOST_INSTANCES: usize = 64;

/// The preview of what was done.
///
/// # Errors
/// `canceled`.
pub(super) fn preview(
    loaded: &Loaded,
    refinements: &[Refinement<'_>],
    max_pixels: u64,
    context: &Context,
) -> Result<Vec<u8>> {
    let mut budget = MOST_TRIANGLES;
    loop {
        let file = with_budget(loaded, refinements, max_pixels, budget, context)?;
        if file.len() <= MAX_BYTES || budget < 1000 {
            return Ok(file);
        }
        // Geometry that compresses badly.
        budget /= 2;
    }
}

fn with_budget(
    loaded: &Loaded,
    refinements: &[Refinement<'_>],
    max_pixels: u64,
    budget: usize,
    context: &Context,
) -> Result<Vec<u8>> {
    let instances: Vec<_> = loaded.models.iter().map(|m| mesh_instances(&m.doc.json, MOST_INSTANCES)).collect();
    let faces_of =
        |r: &Refinement<'_>| r.group.set().atlas.face_count() + if r.kept { 0 } else { r.atlas.face_count() };
    let all: usize = refinements.iter().map(faces_of).sum();
    let pictures: usize = refinements.iter().map(pages::count).sum();
    let mut share = Share::new(PICTURE_BYTES, pictures);
    let mut sections = Sections::default();
    let (mut atlases, mut shown) = (Vec::new(), 0);
    for r in refinements {
        context.check()?;
        let set = r.group.set();
        let most =
            |faces: usize| if all <= budget { faces } else { (faces as f64 * budget as f64 / all as f64) as usize };
        let charts_of = |atlas: &crate::atlas::Atlas| {
            let topology = Topology::new(atlas);
            let charts = atlas.has_layout().then(|| Charts::new(&topology));
            (topology, charts)
        };
        let before = charts_of(&set.atlas);
        let after = (!r.kept).then(|| charts_of(&r.atlas));
        let shown_primitive = |primitive: usize| {
            let found = model_of(r.group, primitive).zip(set.primitives.get(primitive));
            let Some((model, own)) = found else { return ShownPrimitive::default() };
            let matrices = instances[model].get(own.mesh).into_iter().flatten();
            let material = own.material.and_then(|m| loaded.models[model].index.materials.get(m));
            ShownPrimitive {
                matrices: matrices.map(|m| m.as_mat4().to_cols_array()).collect(),
                alpha: material.map(|m| m.alpha).unwrap_or_default(),
            }
        };
        let counterparts = Counterparts::new(r, before.1.as_ref(), after.as_ref().and_then(|a| a.1.as_ref()));
        let resampled = resampled_faces(r);
        let (told, faces) = side(
            &set.atlas,
            &before,
            &side::Extras { counterparts: &counterparts.of_before, resampled: &[], primitive: &shown_primitive },
            most(set.atlas.face_count()),
            &mut sections,
        )?;
        shown += faces;
        let told_after = match &after {
            Some(derived) => {
                let extras = side::Extras {
                    counterparts: &counterparts.of_after,
                    resampled: &resampled,
                    primitive: &shown_primitive,
                };
                let (told, faces) = side(&r.atlas, derived, &extras, most(r.atlas.face_count()), &mut sections)?;
                shown += faces;
                told
            }
            None => Value::Null,
        };
        let mut slots = Vec::new();
        for (index, slot) in active(r.group) {
            context.check()?;
            let before = before_page(loaded, r.group, index, slot, max_pixels, &mut share, &mut sections)?;
            let baked = r.slots.iter().find(|baked| baked.slot == index);
            let after = baked.map(|baked| {
                let pages = baked.files.iter();
                pages
                    .map(|file| after_page(&file.bytes, max_pixels, &mut share, &mut sections))
                    .collect::<Result<Vec<_>>>()
            });
            let wrap = match r.group.is_joined() {
                true => [Wrap::ClampToEdge; 2],
                false => slot.readings.first().map(|reading| reading.wrap).unwrap_or_default(),
            };
            slots.push(json!({
                "name": slot.name, "wrap": wrap.map(wrap_name), "before": [before], "after": after.transpose()?,
            }));
        }
        atlases.push(json!({
            "id": set.id, "name": set.name, "kept": r.kept, "slots": slots, "before": told, "after": told_after,
        }));
    }
    let header = json!({ "triangles": all, "shown": shown, "atlases": atlases });
    sections.file(&header).map_err(|e| Failure::internal(e.to_string()))
}

/// The model of a primitive of a group.
fn model_of(group: &Group, primitive: usize) -> Option<usize> {
    let mut first = 0;
    group.members.iter().find_map(|member| {
        first += member.set.primitives.len();
        (primitive < first).then_some(member.model)
    })
}

/// By face of the refined Atlas, whether texels of any slot were resampled.
fn resampled_faces(r: &Refinement<'_>) -> Vec<bool> {
    let is_resampled = |f: FaceId| {
        let copied = |verbatim: &Vec<bool>| verbatim.get(f.index()).copied().unwrap_or(true);
        !r.slots.iter().all(|slot| copied(&slot.verbatim_face))
    };
    r.atlas.faces().map(is_resampled).collect()
}

fn wrap_name(wrap: Wrap) -> &'static str {
    match wrap {
        Wrap::Repeat => "repeat",
        Wrap::MirroredRepeat => "mirrored_repeat",
        Wrap::ClampToEdge => "clamp_to_edge",
    }
}

#[cfg(test)]
mod tests;
