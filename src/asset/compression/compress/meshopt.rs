//! Buffer views into meshopt streams.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;
use serde_json::{Value, json};

use super::{CompressedView, CompressedViews, push};
use crate::asset::accessor::{RawAccessor, raw_elements};
use crate::asset::accessor_layout::accessor;
use crate::asset::append::{ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER};
use crate::asset::compression::meshopt::{Codec, Filter, Mode, StreamLayout, decode, encode, exponential, octahedral};
use crate::asset::compression::origin::hash_of_bytes;
use crate::asset::extensions::{GPU_INSTANCING, MESHOPT};
use crate::asset::json::{array, number, object};
use crate::asset::{ComponentType, Document, Kind};
use crate::context::Context;
use crate::error::Result;

/// What reads an accessor.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Use {
    /// A vertex attribute or a morph target, by name.
    Vertex(String),
    /// The indices of a list of triangles.
    Triangles,
    /// Other indices.
    Indices,
    /// An animation, a skin or instances.
    Other,
}

/// A stream and its layout.
struct Stream {
    layout: StreamLayout,
    bytes: Vec<u8>,
}

/// Compresses the views that came compressed and what was made anew, or `all` that accessors read.
///
/// # Errors
/// `invalid_model` for broken accessors, `canceled`.
pub(super) fn compress(document: &Document, all: bool, out: &mut CompressedViews, context: &Context) -> Result<()> {
    let origins = &document.origins;
    let Some(name) = origins.views.values().next().map(|v| v.name).or_else(|| all.then_some(MESHOPT[0])) else {
        return Ok(());
    };
    let as_they_came: Vec<(usize, Result<Option<Stream>>)> = origins
        .views
        .par_iter()
        .map(|(view, origin)| {
            let stream = document.view_bytes(*view).map(|bytes| {
                if hash_of_bytes(bytes) == origin.hash {
                    return None;
                }
                let layout = StreamLayout { filter: Filter::None, ..origin.layout };
                encode(bytes, &layout, codec(origin.name)).map(|bytes| Stream { layout, bytes })
            });
            (*view, stream)
        })
        .collect();
    for (view, changed) in as_they_came {
        let origin = &origins.views[&view];
        let (layout, bytes) = match changed? {
            None => (origin.layout, origin.stream.clone()),
            Some(stream) => (stream.layout, stream.bytes.into()),
        };
        set(out, view, origin.name, layout, bytes);
    }

    let first_new = origins.decoded.map_or(0, |[_, views]| views);
    let uses = uses(&out.json);
    let mut chosen = Vec::new();
    for (index, of) in &uses {
        let layout = accessor(&out.json, *index)?;
        let is_new = layout.view.is_some_and(|view| view >= first_new);
        let is_done = layout.view.is_none_or(|view| origins.views.contains_key(&view));
        // Accessors beyond the document's are Draco's.
        if !is_done && layout.sparse.is_none() && (all || is_new) && *index < array(&document.json, "accessors").len() {
            chosen.push((*index, of));
        }
    }
    let streams: Vec<Result<Option<Stream>>> = chosen
        .par_iter()
        .map(|(index, of)| {
            context.check()?;
            let has_bounds = document.json["accessors"][*index].get("min").is_some();
            let raw = raw_elements(document, *index)?;
            let filter = match of {
                Use::Vertex(attribute) if !has_bounds => origins.filters.get(attribute).copied(),
                _ => None,
            };
            Ok(stream(&raw, of, filter, codec(name)))
        })
        .collect();
    for ((index, of), stream) in chosen.into_iter().zip(streams) {
        let Some(Stream { layout, bytes }) = stream? else { continue };
        let mut view = json!({ "buffer": 0, "byteLength": layout.count * layout.stride });
        match of {
            Use::Vertex(_) => {
                view["byteStride"] = Value::from(layout.stride);
                view["target"] = Value::from(ARRAY_BUFFER);
            }
            Use::Triangles | Use::Indices => view["target"] = Value::from(ELEMENT_ARRAY_BUFFER),
            Use::Other => {}
        }
        let view = push(&mut out.json, "bufferViews", view);
        set(out, view, name, layout, bytes.into());
        let object = &mut out.json["accessors"][index];
        object["bufferView"] = Value::from(view);
        if let Some(fields) = object.as_object_mut() {
            fields.shift_remove("byteOffset");
        }
    }
    Ok(())
}

/// The later codec where it may stand.
fn codec(name: &str) -> Codec {
    if name == MESHOPT[1] { Codec::Version1 } else { Codec::Version0 }
}

fn set(out: &mut CompressedViews, view: usize, name: &'static str, layout: StreamLayout, bytes: Arc<[u8]>) {
    let mut extension = json!({ "buffer": 0, "byteLength": bytes.len(), "byteStride": layout.stride, "count": layout.count, "mode": layout.mode });
    if layout.filter != Filter::None {
        extension["filter"] = json!(layout.filter);
    }
    out.json["bufferViews"][view]["extensions"][name] = extension;
    out.views.insert(view, CompressedView { bytes, extension: Some(name) });
}

/// What reads each accessor that something reads, where that is one kind of thing.
fn uses(json: &Value) -> BTreeMap<usize, Use> {
    let mut found: BTreeMap<usize, Use> = BTreeMap::new();
    let mut mixed = Vec::new();
    let mut note = |accessor: Option<&Value>, of: Use| {
        let Some(index) = accessor.and_then(number) else { return };
        let known = found.entry(index).or_insert_with(|| of.clone());
        match (&*known, &of) {
            (Use::Vertex(_), Use::Vertex(_)) => {}
            // Any mode of a primitive can read what mode 2 writes.
            (Use::Triangles, Use::Indices) | (Use::Indices, Use::Triangles) => *known = Use::Indices,
            (known, of) if known == of => {}
            _ => mixed.push(index),
        }
    };
    for primitive in array(json, "meshes").iter().flat_map(|mesh| array(mesh, "primitives")) {
        let targets = array(primitive, "targets").iter().filter_map(Value::as_object);
        for (name, accessor) in object(primitive, "attributes").into_iter().chain(targets).flatten() {
            note(Some(accessor), Use::Vertex(name.clone()));
        }
        let is_list = primitive.get("mode").is_none_or(|mode| mode.as_u64() == Some(4));
        note(primitive.get("indices"), if is_list { Use::Triangles } else { Use::Indices });
    }
    for sampler in array(json, "animations").iter().flat_map(|animation| array(animation, "samplers")) {
        note(sampler.get("input"), Use::Other);
        note(sampler.get("output"), Use::Other);
    }
    for skin in array(json, "skins") {
        note(skin.get("inverseBindMatrices"), Use::Other);
    }
    for node in array(json, "nodes") {
        let instances = node.pointer(&format!("/extensions/{GPU_INSTANCING}/attributes")).and_then(Value::as_object);
        instances.into_iter().flatten().for_each(|(_, accessor)| note(Some(accessor), Use::Other));
    }
    mixed.iter().for_each(|index| drop(found.remove(index)));
    found
}

/// The shortest stream of an accessor's elements; none where there is none that is shorter than the elements.
fn stream(raw: &RawAccessor, of: &Use, filter: Option<(Filter, i16)>, codec: Codec) -> Option<Stream> {
    let size = raw.element_size;
    let (mode, stride) = match of {
        Use::Vertex(_) => (Mode::Attributes, size.next_multiple_of(4)),
        Use::Other => (Mode::Attributes, size),
        Use::Triangles if raw.count.is_multiple_of(3) => (Mode::Triangles, size),
        Use::Triangles | Use::Indices => (Mode::Indices, size),
    };
    let mut data = raw.data.clone();
    if stride != size {
        data = Vec::with_capacity(raw.count * stride);
        for element in raw.data.chunks_exact(size) {
            data.extend_from_slice(element);
            data.resize(data.len().next_multiple_of(stride), 0);
        }
    }
    let plain = StreamLayout { mode, filter: Filter::None, count: raw.count, stride };
    let mut best =
        encode(&data, &plain, codec).filter(|s| is_read(s, &plain, &data)).map(|bytes| Stream { layout: plain, bytes });
    let mut offer = |filter: Filter, elements: &[u8], is_right: &dyn Fn(&[u8]) -> bool| {
        let layout = StreamLayout { filter, ..plain };
        let Some(bytes) = encode(elements, &plain, codec) else { return };
        let shorter = best.as_ref().is_none_or(|b| bytes.len() < b.bytes.len());
        if shorter && layout.check().is_ok() && decode(&bytes, &layout).is_ok_and(|read| is_right(&read)) {
            best = Some(Stream { layout, bytes });
        }
    };
    if let (Mode::Attributes, ComponentType::F32) = (mode, raw.component_type)
        && let Some(elements) = exponential(&data, stride)
    {
        offer(Filter::Exponential, &elements, &|read| read == data);
    }
    if let (Some((Filter::Octahedral, one @ 1..)), Use::Vertex(_)) = (filter, of)
        && let Some(max) = most(raw)
    {
        let mut elements = data.clone();
        octahedral(&mut elements, stride, one);
        // Two steps of the coordinates, and the rounding of the vector's.
        let within = 2 * i32::from(max) / i32::from(one) + 2;
        offer(Filter::Octahedral, &elements, &|read| is_near(read, &data, stride, within));
    }
    best.filter(|best| best.bytes.len() < data.len())
}

/// What stands for 1 in normalised vectors of three or four components.
fn most(raw: &RawAccessor) -> Option<i16> {
    match (raw.component_type, raw.kind) {
        _ if !raw.normalized => None,
        (ComponentType::I8, Kind::Vec3 | Kind::Vec4) => Some(127),
        (ComponentType::I16, Kind::Vec3 | Kind::Vec4) => Some(32767),
        _ => None,
    }
}

/// Whether a stream gives the elements; triangles may begin at another corner.
fn is_read(stream: &[u8], layout: &StreamLayout, data: &[u8]) -> bool {
    let Ok(read) = decode(stream, layout) else { return false };
    match layout.mode {
        Mode::Triangles => {
            let size = 3 * layout.stride;
            let turned = |a: &[u8], b: &[u8]| {
                (0..3).any(|k| {
                    a[k * layout.stride..] == b[..size - k * layout.stride]
                        && a[..k * layout.stride] == b[size - k * layout.stride..]
                })
            };
            read.len() == data.len() && read.chunks_exact(size).zip(data.chunks_exact(size)).all(|(a, b)| turned(a, b))
        }
        _ => read == data,
    }
}

/// Whether no component is further from what it was than so many units.
fn is_near(read: &[u8], data: &[u8], stride: usize, within: i32) -> bool {
    match stride {
        4 => read.iter().zip(data).all(|(a, b)| (i32::from(*a as i8) - i32::from(*b as i8)).abs() <= within),
        _ => {
            let words = |bytes: &[u8]| -> Vec<i32> {
                bytes.as_chunks::<2>().0.iter().map(|b| i32::from(i16::from_le_bytes(*b))).collect()
            };
            words(read).iter().zip(words(data)).all(|(a, b)| (a - b).abs() <= within)
        }
    }
}
