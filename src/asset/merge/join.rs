//! Primitives put together: their attributes one after the other, their indices counted on.

use std::collections::BTreeMap;

use glam::{DMat3, DMat4, DVec3};
use serde_json::{Map, Value};

use super::shown;
use crate::asset::json::{array, checked, object};
use crate::asset::primitive::declared_triangles;
use crate::asset::{
    ARRAY_BUFFER, ComponentType, Document, ELEMENT_ARRAY_BUFFER, RawAccessor, accessor_count, accessor_shape,
    raw_elements, read_indices, read_vec2, read_vec3, read_vec4,
};
use crate::error::{Failure, Result};
use crate::texture::mix;

/// What the nodes draw: the number of triangles, and a sum over them of the texture coordinates of their corners that does not
/// depend on the order of triangles or corners. Joining changes neither.
///
/// # Errors
/// `invalid_model` for a broken accessor.
pub(super) fn drawn(doc: &Document) -> Result<(u64, u64)> {
    let mut uses: BTreeMap<usize, u64> = BTreeMap::new();
    shown(&doc.json).for_each(|m| *uses.entry(m).or_default() += 1);
    let (mut count, mut sum) = (0u64, 0u64);
    for (mesh, times) in uses {
        for primitive in array(doc.json.pointer(&format!("/meshes/{mesh}")).unwrap_or(&Value::Null), "primitives") {
            count = count.saturating_add(times.saturating_mul(declared_triangles(&doc.json, primitive)));
            sum = sum.wrapping_add(times.wrapping_mul(read_at_corners(doc, primitive)?));
        }
    }
    Ok((count, sum))
}

/// The sum of [`drawn`] for one list of triangles; 0 for other primitives, which are never joined.
fn read_at_corners(doc: &Document, primitive: &Value) -> Result<u64> {
    let mut sum = 0u64;
    if primitive.get("mode").is_some_and(|m| m.as_u64() != Some(4)) {
        return Ok(sum);
    }
    let order = primitive.get("indices").map(|i| read_indices(doc, index(doc, i)?)).transpose()?;
    for (name, accessor) in object(primitive, "attributes").into_iter().flatten() {
        let Some(set) = name.strip_prefix("TEXCOORD_").and_then(|n| n.parse::<u64>().ok()) else { continue };
        let uvs = read_vec2(doc, index(doc, accessor)?)?;
        let corner = |v: usize| {
            let [x, y] = uvs.get(v).copied().unwrap_or_default().map(|c| u64::from(c.to_bits()));
            mix(x | y << 32)
        };
        let mut add = |t: [usize; 3]| {
            let corners = t.map(corner).iter().fold(set, |all, c| all.wrapping_add(*c));
            sum = sum.wrapping_add(mix(corners));
        };
        match &order {
            Some(order) => order.as_chunks::<3>().0.iter().for_each(|t| add(t.map(|v| v as usize))),
            None => (0..uvs.len() / 3).for_each(|t| add([3 * t, 3 * t + 1, 3 * t + 2])),
        }
    }
    Ok(sum)
}

/// What must be equal for primitives to be put together: material, attributes with their formats, and nothing beyond. None for
/// primitives that stay by themselves. `moved` asks for positions and directions that can be transformed.
pub(super) fn key(doc: &Document, primitive: &Value, moved: bool) -> Result<Option<String>> {
    let map = primitive.as_object();
    let known = ["attributes", "indices", "material", "mode"];
    let plain = map
        .is_some_and(|m| m.iter().all(|(k, v)| known.contains(&k.as_str()) || v.as_array().is_some_and(Vec::is_empty)));
    if !plain || primitive.get("mode").is_some_and(|m| m.as_u64() != Some(4)) {
        return Ok(None);
    }
    let material = primitive.get("material").and_then(Value::as_u64);
    let blended = material
        .and_then(|m| doc.json.pointer(&format!("/materials/{m}/alphaMode")))
        .is_some_and(|a| a.as_str() == Some("BLEND"));
    if blended {
        // The order of drawing shows.
        return Ok(None);
    }
    let mut names: Vec<(&String, String)> = Vec::new();
    for (name, accessor) in object(primitive, "attributes").into_iter().flatten() {
        let shape = accessor_shape(doc, index(doc, accessor)?)?;
        let transforms = matches!(name.as_str(), "POSITION" | "NORMAL" | "TANGENT");
        let skinned = name.starts_with("JOINTS") || name.starts_with("WEIGHTS");
        if moved && ((transforms && shape.component_type != ComponentType::F32) || skinned) {
            return Ok(None);
        }
        names.push((name, format!("{:?}{:?}{}", shape.component_type, shape.kind, shape.normalized)));
    }
    names.sort();
    Ok(names.iter().any(|(n, _)| *n == "POSITION").then(|| format!("{material:?}{names:?}")))
}

fn index(doc: &Document, value: &Value) -> Result<usize> {
    checked(value, array(&doc.json, "accessors").len(), || "/meshes".to_owned())
}

/// A primitive of all of these, which have one [`key`]; each is transformed as given.
///
/// # Errors
/// `invalid_model` for broken accessors; `too_large` beyond 32-bit indices.
pub(super) fn joined(doc: &mut Document, parts: &[(Value, Option<DMat4>)]) -> Result<Value> {
    let Some((first, _)) = parts.first() else { return Err(Failure::internal("there is nothing to join")) };
    let mut indices: Vec<u32> = Vec::new();
    let mut base = 0u32;
    for (part, transform) in parts {
        let attributes = part.get("attributes").unwrap_or(&Value::Null);
        let count = accessor_count(doc, index(doc, attributes.get("POSITION").unwrap_or(&Value::Null))?)?;
        let count = u32::try_from(count).map_err(|_| too_large())?;
        let mut own = match part.get("indices") {
            Some(accessor) => read_indices(doc, index(doc, accessor)?)?,
            None => (0..count).collect(),
        };
        own.truncate(own.len() / 3 * 3);
        if own.iter().any(|v| *v >= count) {
            return Err(Failure::model("an index is out of range").at("/meshes"));
        }
        if transform.is_some_and(|t| t.determinant() < 0.0) {
            own.as_chunks_mut::<3>().0.iter_mut().for_each(|t| t.swap(1, 2));
        }
        indices.extend(own.iter().map(|v| v + base));
        base = base.checked_add(count).filter(|b| *b < u32::MAX).ok_or_else(too_large)?;
    }
    let mut attributes = Map::new();
    let names: Vec<String> = object(first, "attributes").into_iter().flatten().map(|(name, _)| name.clone()).collect();
    for name in names {
        let mut whole: Option<RawAccessor> = None;
        for (part, transform) in parts {
            let accessor = index(doc, part.pointer(&format!("/attributes/{name}")).unwrap_or(&Value::Null))?;
            let own = match transform {
                Some(t) => moved(doc, &name, accessor, t)?,
                None => raw_elements(doc, accessor)?,
            };
            match &mut whole {
                Some(whole) => {
                    whole.data.extend_from_slice(&own.data);
                    whole.count += own.count;
                }
                None => whole = Some(own),
            }
        }
        if let Some(whole) = whole {
            let source = index(doc, first.pointer(&format!("/attributes/{name}")).unwrap_or(&Value::Null))?;
            let accessor = doc.append_accessor(&whole, Some(ARRAY_BUFFER), name == "POSITION");
            doc.origins.derive(accessor, source);
            attributes.insert(name, Value::from(accessor));
        }
    }
    let indices = doc.append_accessor(&RawAccessor::from_indices(&indices), Some(ELEMENT_ARRAY_BUFFER), false);
    let mut joined = first.clone();
    joined["attributes"] = Value::Object(attributes);
    joined["indices"] = Value::from(indices);
    Ok(joined)
}

fn too_large() -> Failure {
    Failure::new(crate::error::Code::TooLarge, "a joined primitive has more vertices than 32 bits can count")
}

/// An attribute in the space of another node.
fn moved(doc: &Document, name: &str, accessor: usize, transform: &DMat4) -> Result<RawAccessor> {
    let linear = DMat3::from_mat4(*transform);
    let unit = |v: DVec3| v.try_normalize().unwrap_or(DVec3::Z).as_vec3().to_array();
    let wide = |v: [f32; 3]| DVec3::from(v.map(f64::from));
    Ok(match name {
        "POSITION" => {
            let all = read_vec3(doc, accessor)?;
            let all: Vec<_> =
                all.into_iter().map(|v| transform.transform_point3(wide(v)).as_vec3().to_array()).collect();
            RawAccessor::from_floats(&all)
        }
        "NORMAL" => {
            let turn = linear.inverse().transpose();
            let all = read_vec3(doc, accessor)?;
            RawAccessor::from_floats(&all.into_iter().map(|v| unit(turn * wide(v))).collect::<Vec<_>>())
        }
        "TANGENT" => {
            let hand = if linear.determinant() < 0.0 { -1.0 } else { 1.0 };
            let all = read_vec4(doc, accessor)?;
            let turned = all.into_iter().map(|[x, y, z, w]| {
                let [x, y, z] = unit(linear * wide([x, y, z]));
                [x, y, z, w * hand]
            });
            RawAccessor::from_floats(&turned.collect::<Vec<_>>())
        }
        _ => raw_elements(doc, accessor)?,
    })
}
