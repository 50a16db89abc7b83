//! Images, textures and materials that are equal become one; what nothing reads any more is taken out.

use std::collections::BTreeMap;

use serde_json::Value;
use sha2::{Digest, Sha256};

use super::each_info;
use crate::asset::Document;
use crate::asset::json::array;
use crate::asset::scan::{SOURCES, Scan};
use crate::error::Result;

/// Textures name the first of images with equal bytes.
pub(super) fn images(doc: &mut Document, scan: &Scan) {
    let mut first: BTreeMap<[u8; 32], usize> = BTreeMap::new();
    let mut same: Vec<usize> = (0..doc.images.len()).collect();
    for (i, bytes) in doc.images.iter().enumerate() {
        if let Some(bytes) = bytes.as_ref().filter(|_| !scan.named_images.contains(&i)) {
            same[i] = *first.entry(Sha256::digest(bytes).into()).or_insert(i);
        }
    }
    let one = |source: &mut Value| {
        let known = source.as_u64().and_then(|s| same.get(s as usize).map(|n| (*n as u64, s)));
        if let Some((new, _)) = known.filter(|(new, old)| new != old) {
            *source = Value::from(new);
        }
    };
    for texture in doc.json.get_mut("textures").and_then(Value::as_array_mut).into_iter().flatten() {
        texture.get_mut("source").map(one);
        for name in SOURCES {
            texture.pointer_mut(&format!("/extensions/{name}/source")).map(one);
        }
    }
}

/// Textures name the first of equal samplers (names aside).
pub(super) fn samplers(doc: &mut Document) {
    let (same, _) = firsts(array(&doc.json, "samplers"));
    for texture in doc.json.get_mut("textures").and_then(Value::as_array_mut).into_iter().flatten() {
        if let Some(sampler) = texture.get_mut("sampler")
            && let Some(first) = sampler.as_u64().and_then(|s| same.get(usize::try_from(s).ok()?))
            && sampler.as_u64() != Some(*first as u64)
        {
            *sampler = Value::from(*first);
        }
    }
}

/// Materials name the first of equal textures (names aside); the others are taken out.
///
/// # Errors
/// None so far.
pub(super) fn textures(doc: &mut Document) -> Result<()> {
    let (same, first) = firsts(array(&doc.json, "textures"));
    let mut number = vec![None; same.len()];
    for (n, texture) in first.iter().enumerate() {
        number[*texture] = Some(n as u64);
    }
    for material in doc.json.get_mut("materials").and_then(Value::as_array_mut).into_iter().flatten() {
        each_info(material, &mut |info| {
            let texture = info["index"].as_u64().and_then(|t| same.get(usize::try_from(t).ok()?));
            if let Some(new) = texture.and_then(|t| number[*t])
                && info["index"].as_u64() != Some(new)
            {
                info["index"] = Value::from(new);
            }
        });
    }
    if let Some(all) = doc.json.get_mut("textures").and_then(Value::as_array_mut) {
        let mut keep = number.iter();
        all.retain(|_| keep.next().is_none_or(Option::is_some));
    }
    Ok(())
}

/// Primitives name the first of equal materials (names aside). Gives the material that each became; all of
/// them stay in the list, so that their numbers stay.
///
/// # Errors
/// None so far.
pub(super) fn materials(doc: &mut Document) -> Result<Vec<usize>> {
    let (same, _) = firsts(array(&doc.json, "materials"));
    let one = |value: &mut Value| {
        let new = value.as_u64().and_then(|m| same.get(usize::try_from(m).ok()?)).map(|m| *m as u64);
        if let Some(new) = new.filter(|n| value.as_u64() != Some(*n)) {
            *value = Value::from(new);
        }
    };
    for mesh in doc.json.get_mut("meshes").and_then(Value::as_array_mut).into_iter().flatten() {
        for primitive in mesh.get_mut("primitives").and_then(Value::as_array_mut).into_iter().flatten() {
            primitive.get_mut("material").map(one);
            let mappings = primitive.pointer_mut("/extensions/KHR_materials_variants/mappings");
            for mapping in mappings.and_then(Value::as_array_mut).into_iter().flatten() {
                mapping.get_mut("material").map(one);
            }
        }
    }
    Ok(same)
}

/// By object: the first that is equal to it; and those that are such a first.
fn firsts(objects: &[Value]) -> (Vec<usize>, Vec<usize>) {
    let mut known: BTreeMap<String, usize> = BTreeMap::new();
    let same: Vec<usize> =
        objects.iter().enumerate().map(|(i, o)| *known.entry(canonical(o, true)).or_insert(i)).collect();
    let first = (0..objects.len()).filter(|i| same[*i] == *i).collect();
    (same, first)
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
