//! What the charts of a glTF document cover, where its coordinates can be read as they lie.

use std::io::Read;

use serde_json::Value;

use super::super::extensions::{DRACO, MESHOPT, TEXTURE_TRANSFORM};
use super::super::json::{array, number, whole};
use super::document::{BufferHolder, DocumentOutline};
use super::files::Files;

/// Extensions under which coordinates lie otherwise, or mean something else.
const OTHERWISE: [&str; 4] = [DRACO, MESHOPT[0], MESHOPT[1], TEXTURE_TRANSFORM];
/// Bytes that are read, of all accessors together.
const MOST_BYTES: u64 = 64 << 20;
/// Primitives that are looked at: what lies in an archive is unpacked again for each.
const MOST_PRIMITIVES: usize = 32;
/// glTF's number of 32-bit floats.
const FLOAT: u64 = 5126;

/// The area of all triangles of a document in sheets; none where that cannot be told.
pub(super) fn covered(document: &DocumentOutline, model: usize, files: &mut Files) -> Option<f64> {
    let json = &document.json;
    if array(json, "extensionsUsed").iter().any(|name| name.as_str().is_none_or(|name| OTHERWISE.contains(&name))) {
        return None;
    }
    let primitives: Vec<&Value> = array(json, "meshes").iter().flat_map(|m| array(m, "primitives")).collect();
    if primitives.len() > MOST_PRIMITIVES {
        return None;
    }
    let (mut area, mut left) = (0.0, MOST_BYTES);
    for primitive in primitives {
        let Some(accessor) = primitive.get("attributes").and_then(|a| a.get("TEXCOORD_0")) else { continue };
        if primitive.get("mode").is_some_and(|mode| mode.as_u64() != Some(4)) {
            return None;
        }
        let float = |bytes: &[u8]| f64::from(f32::from_le_bytes(*bytes.first_chunk().unwrap_or(&[0; 4])));
        let points = elements(document, accessor, model, files, &mut left, |kind| (kind == FLOAT).then_some(8))?;
        let points: Vec<[f64; 2]> = points.into_iter().map(|b| [float(&b), float(&b[4..])]).collect();
        let size = |kind: u64| Some(1usize << ((kind.checked_sub(5121)? / 2).min(2)));
        let corners: Vec<usize> = match primitive.get("indices") {
            Some(indices) => elements(document, indices, model, files, &mut left, size)?
                .into_iter()
                .map(|bytes| u64::from_le_bytes(bytes) as usize)
                .collect(),
            None => (0..points.len()).collect(),
        };
        for corners in corners.chunks_exact(3) {
            let [a, b, c] = [*points.get(corners[0])?, *points.get(corners[1])?, *points.get(corners[2])?];
            let own = ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])).abs() / 2.0;
            // Triangles of which a number is not finite are held back.
            area += if own.is_finite() { own } else { 0.0 };
        }
    }
    Some(area)
}

/// The elements of an accessor, each with zeros behind it; `size` tells their bytes by the component type.
fn elements(
    document: &DocumentOutline,
    accessor: &Value,
    model: usize,
    files: &mut Files,
    left: &mut u64,
    size: impl Fn(u64) -> Option<usize>,
) -> Option<Vec<[u8; 8]>> {
    let accessor = document.element("accessors", accessor)?;
    if accessor.get("sparse").is_some() {
        return None;
    }
    let size = size(accessor.get("componentType")?.as_u64()?)?;
    let view = accessor.get("bufferView")?;
    let (BufferHolder::File(holder), offset) = document.view(view, model, files)? else { return None };
    let stride = document.element("bufferViews", view)?.get("byteStride").and_then(number).unwrap_or(size).max(size);
    let offset = offset.checked_add(accessor.get("byteOffset").and_then(whole).unwrap_or(0))?;
    let length = accessor.get("count").and_then(whole)?.checked_mul(stride as u64)?;
    *left = left.checked_sub(length)?;
    let mut bytes = Vec::new();
    files
        .open(holder, |file| {
            file.to(offset)?;
            file.take(length).read_to_end(&mut bytes).map(|_| ())
        })?
        .ok()?;
    // The last element may have no gap behind it.
    let missing = length.checked_sub(bytes.len() as u64)?;
    if missing > (stride - size) as u64 {
        return None;
    }
    let element = |chunk: &[u8]| {
        let mut element = [0; 8];
        element[..size].copy_from_slice(chunk.get(..size)?);
        Some(element)
    };
    bytes.chunks(stride).map(element).collect()
}
