//! Merging (`atlas.merge`): fewer textures, materials and draw calls for the same look.
//!
//! [`prepare`] makes equal images one and puts the factors of materials without textures into small textures, so that their
//! surfaces can lie on the same sheet as others; the texture sets of the document are then joined like those of several
//! models. [`finish`] goes over the written document: equal textures and materials become one, and what is drawn
//! alike is drawn at once. Only documents of which every extension is understood are merged.

mod constants;
mod draws;
mod equal;
mod join;
#[cfg(test)]
pub(crate) mod tests;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::document::Document;
use super::extensions;
use super::json::{array, number};
use super::material_index::MaterialIndex;
use super::sources::{drop_images, each_source};
use crate::error::{Failure, Result};

/// What merging did to a model.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Merged {
    /// Draw calls of the scenes: primitives times the nodes that show them.
    pub draw_calls: Counts,
    /// Images that a material reads.
    pub images: Counts,
    /// Textures that a material reads.
    pub textures: Counts,
    /// What became of each material.
    pub materials: Vec<MergedMaterial>,
}

/// A number before and after.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Counts {
    /// As uploaded.
    pub before: u64,
    /// As delivered.
    pub after: u64,
}

/// What merging did to a material.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct MergedMaterial {
    /// Index into the model's `materials`.
    pub material: u64,
    /// Its name, where it has one.
    pub name: Option<String>,
    /// The material that its surfaces have now: another where the two became equal.
    pub now: u64,
    /// Factors that were put into textures.
    pub folded: Vec<String>,
    /// Largest error of a folded factor, in steps of an 8-bit texel: at most 0.5.
    pub rounding: f64,
    /// Why it stays by itself, where it does.
    pub kept: Option<String>,
}

/// A document between [`prepare`] and [`finish`].
#[derive(Debug, Clone)]
pub struct Merge(Merged);

/// Makes equal images and textures one, and textures of factors; `index`, that of the document, follows. `uv_set` is the TEXCOORD set that is refined. None, with the
/// document untouched, where an extension is not understood.
///
/// # Errors
/// `invalid_model` with a pointer for a broken document.
pub fn prepare(doc: &mut Document, index: &mut MaterialIndex, uv_set: usize) -> Result<Option<Merge>> {
    let mut channels = array(&doc.json, "animations").iter().flat_map(|a| array(a, "channels"));
    // An animation by pointer names materials and textures one by one.
    if !extensions::all_understood(&doc.json) || channels.any(|c| c.pointer("/target/extensions").is_some()) {
        return Ok(None);
    }
    let mut merged = Merged::default();
    merged.draw_calls.before = draw_calls(&doc.json);
    [merged.images.before, merged.textures.before] = read_by_materials(index);
    let materials = array(&doc.json, "materials").iter().enumerate();
    merged.materials = materials
        .map(|(i, value)| MergedMaterial {
            material: i as u64,
            name: value.get("name").and_then(Value::as_str).map(str::to_owned),
            now: i as u64,
            folded: Vec::new(),
            rounding: 0.0,
            kept: None,
        })
        .collect();
    let named = named_by_textures(doc);
    equal::images(doc, index);
    let left = named_by_textures(doc);
    doc.merging.spare = named.difference(&left).copied().collect();
    equal::textures(doc, index)?;
    doc.merging.constants = constants::fold(doc, index, uv_set, &mut merged.materials)?;
    Ok(Some(Merge(merged)))
}

/// Makes what became equal in the written document one.
///
/// # Errors
/// `internal` where triangles or what they read would be lost; `invalid_model` for a broken document.
pub fn finish(doc: &mut Document, merge: Merge) -> Result<Merged> {
    let Merge(mut merged) = merge;
    let drawn = join::drawn(doc)?;
    equal::samplers(doc);
    let mut index = MaterialIndex::new(doc)?;
    equal::textures(doc, &mut index)?;
    let read = named_by_textures(doc);
    let gone: Vec<usize> = doc.merging.spare.difference(&read).copied().collect();
    drop_images(doc, &gone);
    let now = equal::materials(doc);
    for material in &mut merged.materials {
        material.now = now.get(material.material as usize).map_or(material.material, |m| *m as u64);
    }
    draws::within_meshes(doc)?;
    draws::across_nodes(doc)?;
    if join::drawn(doc)? != drawn {
        return Err(Failure::internal("joining draw calls lost triangles or changed what they read"));
    }
    index.follow_primitives(&doc.json)?;
    merged.draw_calls.after = draw_calls(&doc.json);
    [merged.images.after, merged.textures.after] = read_by_materials(&index);
    Ok(merged)
}

/// Images that textures name.
fn named_by_textures(doc: &mut Document) -> BTreeSet<usize> {
    let mut named = BTreeSet::new();
    each_source(&mut doc.json, |source| named.extend(number(source)));
    named
}

/// Images and textures that the primitives' materials read.
fn read_by_materials(index: &MaterialIndex) -> [u64; 2] {
    let used: BTreeSet<usize> = index.primitives.iter().flat_map(|p| p.materials.iter().copied()).collect();
    let uses = used.iter().filter_map(|m| index.materials.get(*m)).flat_map(|m| &m.uses);
    let textures: BTreeSet<usize> = uses.map(|u| u.texture).collect();
    let images: BTreeSet<usize> = textures.iter().filter_map(|t| index.textures.get(*t)?.image).collect();
    [images.len() as u64, textures.len() as u64]
}

/// The meshes that nodes show, each as often as it is shown.
fn shown(json: &Value) -> impl Iterator<Item = usize> {
    array(json, "nodes").iter().filter_map(|n| number(n.get("mesh")?))
}

fn draw_calls(json: &Value) -> u64 {
    let meshes = array(json, "meshes");
    shown(json).filter_map(|m| Some(array(meshes.get(m)?, "primitives").len() as u64)).sum()
}
