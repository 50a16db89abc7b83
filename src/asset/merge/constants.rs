//! Factors of materials without textures, put into small textures of one colour.

use std::collections::BTreeSet;

use serde_json::{Map, Value, json};

use super::MergedMaterial;
use crate::asset::json::{array, object};
use crate::asset::material_index::{Material, MaterialIndex};
use crate::asset::{ARRAY_BUFFER, Document, RawAccessor, UvLayout, accessor_count};
use crate::texture::{Coding, Role, encode, from_samples, linear_to_srgb};

/// Side of the texture that stands for factors, in texels.
const SIDE: u32 = 4;

/// Puts the factors of materials without textures into textures, where some textured material differs in nothing else; the
/// index follows. Gives the images made.
///
/// # Errors
/// `invalid_model` for a broken accessor.
pub(super) fn fold(
    doc: &mut Document,
    index: &mut MaterialIndex,
    uv_set: usize,
    report: &mut [MergedMaterial],
) -> crate::error::Result<BTreeSet<usize>> {
    let mut made = BTreeSet::new();
    let mut folded = Vec::new();
    let materials = array(&doc.json, "materials").to_vec();
    let textured = |m: &usize| index.materials.get(*m).is_some_and(|s| !s.uses.is_empty());
    for (m, material) in materials.iter().enumerate().filter(|(m, _)| !textured(m)) {
        let found = readers(doc, index, m, uv_set).and_then(|primitives| {
            let hosts = materials.iter().zip(&index.materials).filter(|(_, s)| !s.uses.is_empty());
            let fitting =
                hosts.filter_map(|(host, indexed)| Some((host, fit(material, host, indexed, uv_set)?))).next();
            Ok((primitives, fitting.ok_or("no textured material differs in nothing but factors")?))
        });
        let (primitives, (host, constants)) = match found {
            Ok(found) => found,
            Err(why) => {
                if let Some(entry) = report.get_mut(m) {
                    entry.kept = Some(why.to_owned());
                }
                continue;
            }
        };
        if let Some(entry) = report.get_mut(m) {
            entry.folded = constants.iter().map(|c| c.factor.to_owned()).collect();
            entry.rounding = constants.iter().map(|c| c.rounding).fold(0.0, f64::max);
        }
        let mut changed = host.clone();
        for key in ["name", "extras"] {
            match (material.get(key), changed.as_object_mut()) {
                (Some(own), Some(object)) => drop(object.insert(key.to_owned(), own.clone())),
                (None, Some(object)) => drop(object.shift_remove(key)),
                _ => {}
            }
        }
        for constant in &constants {
            let texture = texture(doc, host, constant, &mut made)?;
            if let Some(info) = changed.pointer_mut(constant.path) {
                info["index"] = Value::from(texture);
            }
        }
        doc.json["materials"][m] = changed;
        folded.push(m);
        for pointer in primitives {
            let at = format!("{pointer}/attributes");
            let count = doc.json.pointer(&at).and_then(|a| a.get("POSITION")?.as_u64());
            let count = accessor_count(doc, count.unwrap_or(u64::MAX) as usize)?;
            let uvs = RawAccessor::from_floats(&vec![[0.5f32; 2]; count]);
            let accessor = doc.append_accessor(&uvs, Some(ARRAY_BUFFER), false);
            if let Some(attributes) = doc.json.pointer_mut(&at).and_then(Value::as_object_mut) {
                attributes.insert(format!("TEXCOORD_{uv_set}"), Value::from(accessor));
            }
        }
    }
    index.follow_materials(&doc.json, &folded)?;
    Ok(made)
}

/// Pointers of the primitives that a material without textures is drawn on, where all of them can be given texture coordinates;
/// else the reason.
fn readers(doc: &Document, index: &MaterialIndex, material: usize, uv_set: usize) -> Result<Vec<String>, &'static str> {
    if uv_set > 0 {
        // glTF numbers its TEXCOORD sets from 0 on.
        return Err("texture coordinates can be made in set 0 only");
    }
    let mut found = Vec::new();
    for primitive in index.primitives.iter().filter(|p| p.materials.contains(&material)) {
        if primitive.materials.len() > 1 {
            return Err("a primitive with variants has it");
        }
        if !primitive.is_triangles() || primitive.positions.is_none() {
            return Err("it draws something else than triangles");
        }
        let pointer = primitive.pointer();
        let attributes = doc.json.pointer(&pointer).and_then(|p| object(p, "attributes"));
        if attributes.is_some_and(|a| a.keys().any(|k| k.starts_with("TEXCOORD_"))) {
            return Err("its surfaces have texture coordinates of their own");
        }
        found.push(pointer);
    }
    if found.is_empty() { Err("nothing is drawn with it") } else { Ok(found) }
}

/// A texture of one colour.
struct Constant {
    /// Where the texture info stands in the host.
    path: &'static str,
    /// What it replaces.
    factor: &'static str,
    /// Its texel: 3 or 4 channels.
    texel: Vec<u8>,
    /// Largest error of a channel, in steps of 8 bits.
    rounding: f64,
}

/// The textures that make `material` look as it is with all factors of `host`; none where the two differ in anything else.
fn fit(material: &Value, host: &Value, indexed: &Material, uv_set: usize) -> Option<Vec<Constant>> {
    const BASE: &str = "/pbrMetallicRoughness/baseColorTexture";
    const ROUGH: &str = "/pbrMetallicRoughness/metallicRoughnessTexture";
    // Neither directions nor extensions, whose neutral texels are not exact or not known; one plain layout.
    let plain = indexed.uses.iter().all(|u| {
        let known = [Role::BaseColor, Role::MetallicRoughness, Role::Occlusion, Role::Emissive];
        u.layout == UvLayout::plain(uv_set) && u.role.is_some_and(|r| known.contains(&r))
    });
    if !plain || host.pointer(BASE).is_none() || rest(material) != rest(host) {
        return None;
    }
    let opaque = matches!(material.get("alphaMode").and_then(Value::as_str), None | Some("OPAQUE"));
    let mut out = Vec::new();
    let colour = |v: &Value| numbers(v, "/pbrMetallicRoughness/baseColorFactor", 4);
    let mut colour = ratios(&colour(material), &colour(host), if opaque { 3 } else { 4 })?;
    colour.iter_mut().take(3).for_each(|v| *v = linear_to_srgb(*v));
    out.push(constant(BASE, "baseColorFactor", &colour));
    let (metal, rough) = ("/pbrMetallicRoughness/metallicFactor", "/pbrMetallicRoughness/roughnessFactor");
    // Occlusion, which may share the texture, is neutral.
    let packed = |v: &Value| [1.0, numbers(v, rough, 1)[0], numbers(v, metal, 1)[0]];
    let (own, theirs) = (packed(material), packed(host));
    if host.pointer(ROUGH).is_some() {
        out.push(constant(ROUGH, "metallicFactor, roughnessFactor", &ratios(&own, &theirs, 3)?));
    } else if own != theirs {
        return None;
    }
    if host.pointer("/occlusionTexture").is_some() {
        out.push(constant("/occlusionTexture", "occlusion", &[1.0; 3]));
    }
    let glow = |v: &Value| match v.get("emissiveFactor") {
        Some(_) => numbers(v, "/emissiveFactor", 3),
        None => vec![0.0; 3],
    };
    let (own, theirs) = (glow(material), glow(host));
    if host.get("emissiveTexture").is_some() {
        let light = ratios(&own, &theirs, 3)?;
        out.push(constant(
            "/emissiveTexture",
            "emissiveFactor",
            &light.into_iter().map(linear_to_srgb).collect::<Vec<_>>(),
        ));
    } else if own != theirs {
        return None;
    }
    Some(out)
}

/// What must be equal: everything but names, factors and textures.
fn rest(material: &Value) -> Map<String, Value> {
    let mut rest = material.as_object().cloned().unwrap_or_default();
    for key in ["name", "extras", "pbrMetallicRoughness", "occlusionTexture", "emissiveTexture", "emissiveFactor"] {
        rest.shift_remove(key);
    }
    let defaults = [("alphaMode", json!("OPAQUE")), ("doubleSided", json!(false)), ("extensions", json!({}))];
    for (key, default) in defaults {
        if rest.get(key) == Some(&default) {
            rest.shift_remove(key);
        }
    }
    let mut sorted: Vec<(String, Value)> = rest.into_iter().collect();
    sorted.sort_by(|a, b| a.0.cmp(&b.0));
    sorted.into_iter().collect()
}

/// Numbers at a pointer; ones where there are none, as glTF's factors default to.
fn numbers(value: &Value, pointer: &str, count: usize) -> Vec<f64> {
    let found = value.pointer(pointer);
    let at = |i: usize| match found {
        Some(Value::Array(items)) => items.get(i).and_then(Value::as_f64),
        Some(one) if count == 1 => one.as_f64(),
        _ => None,
    };
    (0..count).map(|i| at(i).unwrap_or(1.0)).collect()
}

/// What the first `count` channels of a texel must hold so that `theirs` times it is `own`.
fn ratios(own: &[f64], theirs: &[f64], count: usize) -> Option<Vec<f64>> {
    let ratio = |(own, theirs): (&f64, &f64)| if own == theirs { 1.0 } else { own / theirs };
    let ratios = own.iter().zip(theirs).take(count).map(ratio);
    ratios.map(|r| (0.0..=1.0).contains(&r).then_some(r)).collect()
}

fn constant(path: &'static str, factor: &'static str, values: &[f64]) -> Constant {
    let codes: Vec<f64> = values.iter().map(|v| v * 255.0).collect();
    let rounding = codes.iter().map(|c| (c - c.round()).abs()).fold(0.0, f64::max);
    Constant { path, factor, texel: codes.iter().map(|c| c.round() as u8).collect(), rounding }
}

/// Appends the texture of a constant, with the sampler of the host's.
fn texture(
    doc: &mut Document,
    host: &Value,
    constant: &Constant,
    made: &mut BTreeSet<usize>,
) -> crate::error::Result<usize> {
    let samples = constant.texel.repeat((SIDE * SIDE) as usize);
    let image = from_samples([SIDE, SIDE], constant.texel.len() as u8, samples)?;
    let bytes = encode(&image, &Coding::Png)?;
    let index = doc.push("images", json!({ "mimeType": "image/png" }));
    doc.images.resize(index, None);
    doc.images.push(Some(bytes));
    made.insert(index);
    let theirs = host.pointer(constant.path).and_then(|i| i.get("index")?.as_u64());
    let sampler = theirs.and_then(|t| doc.json.pointer(&format!("/textures/{t}/sampler")).cloned());
    let mut texture = json!({ "source": index });
    if let Some(sampler) = sampler {
        texture["sampler"] = sampler;
    }
    Ok(doc.push("textures", texture))
}
