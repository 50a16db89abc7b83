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
    let name = uri::stem(&entry.path).to_owned();
    let json = json!({ "asset": { "version": "2.0", "generator": "intarsia" }, "scene": 0 });
    let mut document = Document { json, buffers: Vec::new(), images: Vec::new(), name, merging: Default::default() };
    let parts = primitives::build(&geometry, warnings);
    let materials = add_materials(&mut document, &geometry, &parts, entry, upload, limits, warnings)?;
    let mut primitives = Vec::with_capacity(parts.len());
    for part in parts {
        let material = materials.get(&part.material).copied();
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
    let name = geometry.name.clone().unwrap_or_else(|| document.name.clone());
    let mesh = document.push("meshes", json!({ "name": name, "primitives": primitives }));
    let node = document.push("nodes", json!({ "name": name, "mesh": mesh }));
    document.push("scenes", json!({ "nodes": [node] }));
    Ok(document)
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
    let libraries = materials::read_libraries(&geometry.libraries, &entry.path, upload, warnings);
    let mut made = Materials::new(upload, &entry.path, limits.max_input_bytes);
    let mut indices = BTreeMap::new();
    for part in parts {
        let Some(name) = geometry.materials.get(part.material as usize).filter(|_| part.material != NONE) else {
            continue;
        };
        if indices.contains_key(&part.material) {
            continue;
        }
        let plain;
        let (library, mtl) = match libraries.get(name) {
            Some((library, mtl)) => (library.as_str(), mtl),
            None => {
                let message = format!("no material library defines {}", quote(name));
                warnings.push(Warning::new("missing_material", message));
                plain = Mtl { name: name.clone(), ..Mtl::default() };
                (entry.path.as_str(), &plain)
            }
        };
        indices.insert(part.material, made.add(document, library, mtl, warnings)?);
    }
    Ok(indices)
}

fn warn_of_dropped(geometry: &ObjGeometry, warnings: &mut Vec<Warning>) {
    if let Some((count, line)) = geometry.thin {
        let message = format!("{count} faces of fewer than three corners are dropped, the first in line {line}");
        warnings.push(Warning::new("degenerate_faces_dropped", message));
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
            let rest = String::from_utf8_lossy(rest);
            let names = std::iter::once(rest.as_ref()).chain(rest.split_whitespace());
            let clean = names.filter_map(|n| uri::join("", n).or_else(|| uri::normalise(uri::file_name(n))));
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
    quote(&String::from_utf8_lossy(bytes.get(..bytes.len().min(80)).unwrap_or_default()))
}

#[cfg(test)]
mod tests;
