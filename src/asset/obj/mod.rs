//! OBJ with MTL, converted to a glTF document while it is loaded.
//!
//! One mesh, one primitive for each material in order of first use; a material whose faces differ in having texture
//! coordinates or normals gets one primitive for each kind. The v axis is flipped to glTF's.

mod lines;
mod materials;
mod mtl;
mod number;
mod parse;
mod polygon;
mod primitives;

use std::collections::{BTreeMap, BTreeSet};

use serde_json::json;

use super::Document;
use super::limits::Limits;
use super::name;
use super::upload::{Upload, UploadEntry};
use super::uri::{self, quote};
use crate::error::{Failure, Result, Warning};
use lines::{Lines, keyword};
use materials::Materials;
use mtl::Mtl;
use parse::{NONE, ObjGeometry};

/// Loads an OBJ file with the libraries and images that it names.
///
/// # Errors
/// `invalid_model` with the line number, `too_large` beyond `limits`.
pub(crate) fn load(
    entry: &UploadEntry<'_>,
    upload: &Upload<'_>,
    limits: &Limits,
    warnings: &mut Vec<Warning>,
) -> Result<Document> {
    let geometry = parse::parse(&entry.bytes, limits)?;
    if geometry.positions.is_empty() {
        return Err(Failure::model(format!("the file {} holds no OBJ vertices", quote(&entry.path))));
    }
    warn_of_dropped(&geometry, warnings);
    let name = uri::stem(&name::readable(&entry.path)).to_owned();
    let json = json!({ "asset": { "version": "2.0", "generator": "intarsia" }, "scene": 0 });
    let mut document = Document {
        json,
        buffers: Vec::new(),
        images: Vec::new(),
        name,
        merging: Default::default(),
        tile: None,
        undefined: Default::default(),
        origins: Default::default(),
        compressed: None,
    };
    let parts = primitives::build(&geometry, warnings);
    let materials = add_materials(&mut document, &geometry, &parts, entry, upload, limits, warnings)?;
    let mut primitives = Vec::with_capacity(parts.len());
    let mut untextured: BTreeMap<usize, usize> = BTreeMap::new();
    for part in parts {
        let mut material = materials.get(&part.material).copied();
        if let Some(m) = material.filter(|_| !part.has_uvs()) {
            material = Some(*untextured.entry(m).or_insert_with(|| without_textures(&mut document, m)));
        }
        let textured = material.is_some_and(|m| {
            document.json.pointer(&format!("/materials/{m}/pbrMetallicRoughness/baseColorTexture")).is_some()
        });
        primitives.push(part.write(&mut document, material, textured, warnings));
    }
    if primitives.is_empty() {
        // glTF has no empty arrays.
        document.push("scenes", json!({}));
        return Ok(document);
    }
    let own = geometry.name.as_ref().map(|own| name::readable_in(own, encoding(&geometry)).into_owned());
    let name = own.unwrap_or_else(|| document.name.clone());
    let mesh = document.push("meshes", json!({ "name": name, "primitives": primitives }));
    let mut node = json!({ "name": name, "mesh": mesh });
    if let Some(origin) = geometry.origin {
        node["translation"] = json!(origin);
        node["extras"] = json!({ "origin": origin });
        let message = format!(
            "the model lies far from the origin, where 32 bits cannot hold its vertices: positions are relative to {origin:?}, which is the node's translation"
        );
        warnings.push(Warning::new("recentred", message));
    }
    let node = document.push("nodes", node);
    document.push("scenes", json!({ "nodes": [node] }));
    Ok(document)
}

/// A material for faces without texture coordinates: the same, or a copy without its textures where it has any. Gives its index.
fn without_textures(document: &mut Document, material: usize) -> usize {
    let Some(own) = document.json.pointer(&format!("/materials/{material}")) else { return material };
    let mut plain = own.clone();
    if let Some(map) = plain.as_object_mut() {
        map.shift_remove("normalTexture");
        // Without the map the factor alone would glow.
        if map.shift_remove("emissiveTexture").is_some() {
            map.shift_remove("emissiveFactor");
        }
    }
    if let Some(pbr) = plain.get_mut("pbrMetallicRoughness").and_then(serde_json::Value::as_object_mut) {
        pbr.shift_remove("baseColorTexture");
    }
    if plain == *own { material } else { document.push("materials", plain) }
}

/// glTF materials of those that faces use, in order of first use; by index into the OBJ's names.
fn add_materials(
    document: &mut Document,
    geometry: &ObjGeometry,
    parts: &[primitives::Part],
    entry: &UploadEntry<'_>,
    upload: &Upload<'_>,
    limits: &Limits,
    warnings: &mut Vec<Warning>,
) -> Result<BTreeMap<u32, usize>> {
    let (libraries, is_one_missing) = materials::read_libraries(&geometry.libraries, &entry.path, upload, warnings);
    let mut made = Materials::new(upload, &entry.path, limits.max_input_bytes, encoding(geometry));
    let mut indices = BTreeMap::new();
    // A model and its library may be in two encodings.
    let by_reading: BTreeMap<String, &String> =
        libraries.keys().map(|name| (name::readable(name).into_owned(), name)).collect();
    for part in parts {
        let Some(name) = geometry.materials.get(part.material as usize).filter(|_| part.material != NONE) else {
            continue;
        };
        if indices.contains_key(&part.material) {
            continue;
        }
        let plain;
        let found = libraries.get(name).or_else(|| {
            let mut readings = name::readings(name).into_iter().chain([name.clone()]);
            readings.find_map(|reading| libraries.get(*by_reading.get(&reading)?))
        });
        let (library, mtl) = match found {
            Some((library, mtl)) => (library.as_str(), mtl),
            None => {
                let message = format!(
                    "no material library defines {}: its faces have a plain material (correct the name, or send the library along)",
                    quote(name)
                );
                warnings.push(Warning::new("missing_material", message));
                plain = Mtl { name: name.clone(), ..Mtl::default() };
                (entry.path.as_str(), &plain)
            }
        };
        let index = made.add(document, library, mtl, warnings)?;
        if found.is_none() && is_one_missing {
            document.undefined.insert(index);
        }
        indices.insert(part.material, index);
    }
    Ok(indices)
}

/// The encoding of the names in a file.
fn encoding(geometry: &ObjGeometry) -> Option<&'static encoding_rs::Encoding> {
    let names = geometry.libraries.iter().chain(&geometry.materials).chain(&geometry.name);
    name::encoding(names.map(String::as_str))
}

fn warn_of_dropped(geometry: &ObjGeometry, warnings: &mut Vec<Warning>) {
    if let Some(line) = geometry.lacks_uvs {
        let message = format!(
            "faces name texture coordinates, the first in line {line}, and the file has none: the model is read without any (unwrap makes some)"
        );
        warnings.push(Warning::new("missing_texture_coordinates", message));
    }
    if let Some((count, line)) = geometry.thin {
        let message = format!("{count} faces of fewer than three corners are dropped, the first in line {line}");
        warnings.push(Warning::new("degenerate_faces_dropped", message));
    }
    if let Some((count, line)) = geometry.without_position {
        let message =
            format!("{count} faces with a position that is NaN or infinite are dropped, the first in line {line}");
        warnings.push(Warning::new("non_finite_triangles", message));
    }
    if let Some((count, line)) = geometry.without_uv {
        let message = format!(
            "{count} faces with a texture coordinate that is NaN or infinite are kept without any, the first in line {line}"
        );
        warnings.push(Warning::new("non_finite_triangles", message));
    }
    if geometry.others > 0 {
        let message = format!("{} lines, points, curves or surfaces of the OBJ are dropped", geometry.others);
        warnings.push(Warning::new("obj_elements_dropped", message));
    }
}

/// Whether a text without a telling name begins as OBJ files do.
pub(crate) fn looks_like(text: &[u8]) -> bool {
    const WORDS: [&[u8]; 9] = [b"v", b"vt", b"vn", b"f", b"o", b"g", b"s", b"mtllib", b"usemtl"];
    let text = text.get(..text.len().min(64 << 10)).unwrap_or_default();
    Lines::new(text).next_line().is_some_and(|(_, line)| {
        let (word, rest) = keyword(line);
        WORDS.contains(&word) && !rest.is_empty() && rest.iter().all(|b| !b.is_ascii_control() || *b == b'\t')
    })
}

/// Clean relative paths of the libraries that an OBJ text names, as one name with blanks and as several.
pub(crate) fn libraries(text: &[u8]) -> Vec<String> {
    let mut found = Vec::new();
    let mut known = BTreeSet::new();
    let mut lines = Lines::new(text);
    while let Some((_, line)) = lines.next_line() {
        if let (b"mtllib", rest) = keyword(line) {
            let rest = name::from_bytes(rest);
            let clean = materials::possible_names(&rest)
                .into_iter()
                .filter_map(|n| uri::join("", n).or_else(|| uri::normalise(uri::file_name(n))));
            found.extend(clean.filter(|name| known.insert(name.clone())));
        }
    }
    found
}

/// The files that the materials of an MTL text name, as written.
pub(crate) fn maps(text: &[u8]) -> Vec<String> {
    let materials = mtl::parse(text);
    let maps = materials.into_iter().flat_map(|m| {
        let known = [m.map_diffuse, m.map_emissive, m.map_dissolve, m.normal];
        known.into_iter().flatten().chain(m.others.into_iter().map(|(_, map)| map))
    });
    maps.map(|m| m.file).collect()
}

/// Bytes of a line, for a sentence.
fn quote_bytes(bytes: &[u8]) -> String {
    quote(&name::from_bytes(bytes.get(..bytes.len().min(80)).unwrap_or_default()))
}

#[cfg(test)]
mod tests;
