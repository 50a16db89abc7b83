//! Images, textures and materials that are equal become one; what nothing reads any more is taken out.

use std::collections::BTreeMap;

use serde_json::Value;
use sha2::{Digest, Sha256};

use crate::asset::Document;
use crate::asset::extensions::VARIANTS;
use crate::asset::json::{array, each_mut, keep, new_numbers, object_mut, renumber};
use crate::asset::material_index::MaterialIndex;
use crate::asset::sources::each_source;
use crate::error::Result;

/// Textures name the first of images with equal bytes; the index follows.
pub(super) fn images(doc: &mut Document, index: &mut MaterialIndex) {
    let mut first: BTreeMap<[u8; 32], usize> = BTreeMap::new();
    let mut same: Vec<usize> = (0..doc.images.len()).collect();
    for (i, bytes) in doc.images.iter().enumerate() {
        if let Some(bytes) = bytes.as_ref().filter(|_| !index.named_images.contains(&i)) {
            same[i] = *first.entry(Sha256::digest(bytes).into()).or_insert(i);
        }
    }
    each_source(&mut doc.json, |source| renumber(source, &same));
    let same = |image: usize| same.get(image).copied().unwrap_or(image);
    for texture in &mut index.textures {
        texture.image = texture.image.map(same);
        texture.fallback = texture.fallback.map(same);
    }
}

/// Textures name the first of equal samplers (names aside).
pub(super) fn samplers(doc: &mut Document) {
    let same = firsts(array(&doc.json, "samplers"));
    for texture in each_mut(&mut doc.json, "textures") {
        if let Some(sampler) = texture.get_mut("sampler") {
            renumber(sampler, &same);
        }
    }
}

/// Materials name the first of equal textures (names aside); the others are taken out. The index follows.
///
/// # Errors
/// `invalid_model` for a broken texture info.
pub(super) fn textures(doc: &mut Document, index: &mut MaterialIndex) -> Result<()> {
    let same = firsts(array(&doc.json, "textures"));
    let kept: Vec<bool> = same.iter().enumerate().map(|(texture, first)| texture == *first).collect();
    let numbers = new_numbers(&kept);
    for (m, material) in index.materials.iter_mut().enumerate() {
        for used in &mut material.uses {
            let new = same.get(used.texture).map(|first| numbers[*first]);
            if let Some(new) = new.filter(|n| *n != used.texture) {
                object_mut(&mut doc.json, &format!("/materials/{m}{}", used.path))?.insert("index".into(), new.into());
                used.texture = new;
            }
        }
    }
    keep(&mut index.textures, |texture| kept[texture]);
    if let Some(all) = doc.json.get_mut("textures").and_then(Value::as_array_mut) {
        keep(all, |texture| kept[texture]);
    }
    Ok(())
}

/// Primitives name the first of equal materials (names aside). Gives the material that each became; all of
/// them stay in the list, so that their numbers stay.
pub(super) fn materials(doc: &mut Document) -> Vec<usize> {
    let same = firsts(array(&doc.json, "materials"));
    let variants = format!("/extensions/{VARIANTS}/mappings");
    for mesh in each_mut(&mut doc.json, "meshes") {
        for primitive in each_mut(mesh, "primitives") {
            if let Some(m) = primitive.get_mut("material") {
                renumber(m, &same);
            }
            let mappings = primitive.pointer_mut(&variants);
            for mapping in mappings.and_then(Value::as_array_mut).into_iter().flatten() {
                if let Some(m) = mapping.get_mut("material") {
                    renumber(m, &same);
                }
            }
        }
    }
    same
}

/// By object: the first that is equal to it.
fn firsts(objects: &[Value]) -> Vec<usize> {
    let mut known: BTreeMap<String, usize> = BTreeMap::new();
    objects.iter().enumerate().map(|(i, o)| *known.entry(canonical(o, true)).or_insert(i)).collect()
}

/// A text that equal values share, whatever the order of their keys and the spelling of their numbers. `top` leaves out the name.
/// Extras are the user's: two objects that differ in them are not equal.
fn canonical(value: &Value, top: bool) -> String {
    match value {
        Value::Object(map) => {
            let mut parts: Vec<(&String, String)> =
                map.iter().filter(|(k, _)| !(top && *k == "name")).map(|(k, v)| (k, canonical(v, false))).collect();
            parts.sort();
            parts.iter().map(|(k, v)| format!("{k:?}:{v};")).collect::<String>() + "}"
        }
        Value::Array(items) => items.iter().map(|v| canonical(v, false) + ",").collect::<String>() + "]",
        Value::Number(n) => n.as_f64().map_or_else(|| n.to_string(), |x| format!("{:?}", x + 0.0)),
        other => other.to_string(),
    }
}
