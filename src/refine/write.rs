//! The refined groups written into their models, and read back.

use std::borrow::Cow;

use super::check;
use super::load::Loaded;
use super::refinement::Refinement;
use super::textures::BakedSlot;
use crate::asset::{self, BakedImage, Document, Merged, Refined};
use crate::atlas::{Atlas, FaceId};
use crate::context::Context;
use crate::error::Result;

/// What writing leaves.
pub(super) struct Written<'a> {
    /// The groups, with the Atlases that the documents hold.
    pub refinements: Vec<Refinement<'a>>,
    /// The models, in the order of the input.
    pub documents: Vec<Document>,
    /// What merging did, model by model.
    pub merged: Vec<Merged>,
}

/// Writes the refined groups into their models, reads them back and checks them; then merges what was to be merged. With `named`, the
/// images of a model with side files are called as the textures are.
///
/// # Errors
/// `internal` when something written fails its check; `too_large`; `canceled`.
pub(super) fn write<'a>(
    loaded: &'a Loaded,
    mut refinements: Vec<Refinement<'a>>,
    named: bool,
    context: &Context,
) -> Result<Written<'a>> {
    let mut documents = write_documents(loaded, &mut refinements, named, context)?;
    let merged = merge(loaded, &refinements, &mut documents)?;
    Ok(Written { refinements, documents, merged })
}

/// The documents with what was refined; the Atlases of the refinements become those that the documents hold.
fn write_documents(
    loaded: &Loaded,
    refinements: &mut [Refinement<'_>],
    named: bool,
    context: &Context,
) -> Result<Vec<Document>> {
    let mut parts: Vec<Vec<(Cow<'_, Atlas>, Vec<FaceId>)>> = Vec::new();
    for r in refinements.iter() {
        parts.push(if r.kept { Vec::new() } else { r.group.part(&r.atlas)? });
    }
    let mut documents = Vec::new();
    let mut written: Vec<Vec<(Atlas, Vec<FaceId>)>> = parts.iter().map(|_| Vec::new()).collect();
    for (index, model) in loaded.models.iter().enumerate() {
        context.step(0.3 * index as f64 / loaded.models.len() as f64, "writing")?;
        loaded.speak_of(index, context);
        let (mut refined, mut owners) = (Vec::new(), Vec::new());
        for (g, (r, parts)) in refinements.iter().zip(&parts).enumerate() {
            for (member, (atlas, faces)) in r.group.members.iter().zip(parts).filter(|(m, _)| m.model == index) {
                let images = r.slots.iter().filter_map(|baked| {
                    let slot = member.slots.iter().position(|s| *s == Some(baked.slot))?;
                    Some(baked_images(r, baked, slot, named))
                });
                refined.push(Refined { set: &member.set, atlas, images: images.flatten().collect() });
                owners.push((g, faces));
            }
        }
        let doc = asset::write(&model.doc, &model.index, &refined, context)?;
        for (i, (g, faces)) in owners.into_iter().enumerate() {
            written[g].push((asset::read_back(&doc, &refined, i, context)?, faces.clone()));
        }
        documents.push(doc);
    }
    drop(parts);
    context.speak_of(None);
    context.step(0.3, "checking what was written")?;
    for (r, written) in refinements.iter_mut().zip(written).filter(|(r, _)| !r.kept) {
        let atlas = r.group.rejoin(&r.atlas, written);
        check::written(&r.group.set().atlas, &atlas, r.step, r.self_overlaps, context)?;
        r.atlas = atlas;
    }
    Ok(documents)
}

/// Makes what became equal one, in the models of which something was refined.
fn merge(loaded: &Loaded, refinements: &[Refinement<'_>], documents: &mut [Document]) -> Result<Vec<Merged>> {
    let mut merged = Vec::new();
    for (index, (model, doc)) in loaded.models.iter().zip(documents).enumerate() {
        let refined = refinements.iter().any(|r| !r.kept && r.group.members.iter().any(|m| m.model == index));
        if let Some(merge) = model.merge.clone().filter(|_| refined) {
            merged.push(asset::finish_merge(doc, merge)?);
        }
    }
    Ok(merged)
}

/// The pages of a slot, for the slot of a member. Sets that share an Atlas share the files.
fn baked_images(r: &Refinement<'_>, baked: &BakedSlot, slot: usize, named: bool) -> Vec<BakedImage> {
    let files = baked.files.iter().enumerate();
    files
        .map(|(page, file)| BakedImage {
            slot,
            page,
            format: file.format,
            bytes: file.bytes.clone(),
            shared: (named || r.group.is_joined()).then(|| texture_name(r, baked, page)),
        })
        .collect()
}

/// The name of a texture as a file of its own.
pub(super) fn texture_name(r: &Refinement<'_>, baked: &BakedSlot, page: usize) -> String {
    let set = r.group.set();
    let extension = baked.files.get(page).map_or("png", |f| f.format.extension());
    format!("atlas-{}.page-{page}.{}.{extension}", set.id, set.slots[baked.slot].name)
}
