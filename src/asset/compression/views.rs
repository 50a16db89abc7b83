//! Buffer views with a compressed source.

use std::collections::BTreeSet;
use std::sync::Arc;

use serde::Deserialize;
use serde_json::Value;

use super::meshopt::{Filter, StreamLayout, decode, one_of_octahedral};
use super::origin::{ViewOrigin, hash_of_bytes};
use super::squeeze::squeeze;
use super::{extension, remove_extension};
use crate::asset::Document;
use crate::asset::accessor::raw_elements;
use crate::asset::accessor_layout::view;
use crate::asset::append::set_bounds;
use crate::asset::extensions::{MESHOPT, undeclare};
use crate::asset::json::{array, each_mut, list, number, object, read_key};
use crate::asset::limits::Budget;
use crate::error::{Code, Failure, Result};

/// What the extension of a buffer says.
#[derive(Deserialize)]
struct Fallback {
    #[serde(default)]
    fallback: bool,
}

/// Where the stream of a buffer view is.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct ByteRange {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
}

/// What a buffer view says of its compressed source.
struct CompressedSource {
    /// Which of the two names.
    name: &'static str,
    /// JSON pointer of the extension.
    pointer: String,
    range: ByteRange,
    layout: StreamLayout,
}

/// Buffers that only stand in for what is compressed: no byte of them is needed, and none need be there.
///
/// # Errors
/// `invalid_model` for a broken buffer view.
pub(crate) fn placeholders(json: &Value) -> Result<BTreeSet<usize>> {
    let mut stand_ins = BTreeSet::new();
    for (index, buffer) in list(json, "buffers")?.iter().enumerate() {
        for name in MESHOPT {
            let found: Option<Fallback> = extension(buffer, name, &format!("/buffers/{index}"))?;
            if found.is_some_and(|e| e.fallback) {
                stand_ins.insert(index);
            }
        }
    }
    let mut real = BTreeSet::new();
    for (index, view) in list(json, "bufferViews")?.iter().enumerate() {
        let parent: Option<usize> = read_key(view, "buffer", &format!("/bufferViews/{index}"))?;
        match source(view, index)? {
            Some(source) => {
                real.insert(source.range.buffer);
                stand_ins.extend(parent);
            }
            None => real.extend(parent),
        }
    }
    Ok(&stand_ins - &real)
}

/// Decodes every compressed buffer view into the buffer that it names. Gives those that passed through a filter: what
/// accessors say of their least and greatest values need not be exact.
///
/// # Errors
/// `invalid_model` with a pointer for a broken extension or stream, `too_large` beyond the budget, and what `check` says.
pub(crate) fn views(
    document: &mut Document,
    budget: &mut Budget,
    check: &dyn Fn() -> Result<()>,
) -> Result<BTreeSet<usize>> {
    let mut filtered = BTreeSet::new();
    let mut sources = BTreeSet::new();
    for index in 0..list(&document.json, "bufferViews")?.len() {
        let Some(source) = source(&document.json["bufferViews"][index], index)? else { continue };
        check()?;
        let ByteRange { buffer: from, byte_offset: start, byte_length } = source.range;
        let stream = document.buffers.get(from).and_then(|b| b.get(start..start.checked_add(byte_length)?));
        let stream = stream.ok_or_else(|| {
            Failure::model(format!("the compressed bytes leave buffer {from}")).at(source.pointer.clone())
        })?;
        let pointer = format!("/bufferViews/{index}");
        let (parent, size) = target(&document.json, index, &source, &pointer)?;
        budget.charge(size, &pointer)?;
        let stream: Arc<[u8]> = stream.into();
        let data = decode(&stream, &source.layout)
            .map_err(|why| Failure::model(format!("the compressed stream {why}")).at(source.pointer.clone()))?;

        let count = document.buffers.len();
        let buffer = document.buffers.get_mut(parent).ok_or_else(|| {
            let message = format!("buffer {parent} does not exist: there are {count}");
            Failure::model(message).at(format!("{pointer}/buffer"))
        })?;
        let offset = buffer.len().next_multiple_of(4);
        buffer.resize(offset, 0);
        buffer.extend_from_slice(&data);
        let length = buffer.len();
        document.json["buffers"][parent]["byteLength"] = Value::from(length);
        let view = &mut document.json["bufferViews"][index];
        view["byteOffset"] = Value::from(offset);
        remove_extension(view, source.name);
        sources.insert(from);
        if source.layout.filter != Filter::None {
            filtered.insert(index);
        }
        let (name, layout) = (source.name, source.layout);
        document.origins.views.insert(
            index,
            ViewOrigin { name, layout, stream, range: [from, start, start + byte_length], hash: hash_of_bytes(&data) },
        );
    }
    for name in MESHOPT {
        each_mut(&mut document.json, "buffers").for_each(|buffer| remove_extension(buffer, name));
        undeclare(&mut document.json, name);
    }
    for buffer in sources {
        squeeze(document, buffer);
    }
    note_filters(document)?;
    Ok(filtered)
}

/// Notes which attributes came through a filter.
fn note_filters(document: &mut Document) -> Result<()> {
    if document.origins.views.is_empty() {
        return Ok(());
    }
    let mut found = Vec::new();
    for primitive in list(&document.json, "meshes")?.iter().flat_map(|mesh| array(mesh, "primitives")) {
        for (name, accessor) in object(primitive, "attributes").into_iter().flatten() {
            let accessor = number(accessor).and_then(|index| array(&document.json, "accessors").get(index));
            let view = accessor.and_then(|a| a.get("bufferView")).and_then(number);
            let origin = view.and_then(|view| document.origins.views.get(&view));
            let Some(origin) = origin.filter(|o| o.layout.filter != Filter::None) else { continue };
            if !document.origins.filters.contains_key(name) {
                let one = one_of_octahedral(&origin.stream, &origin.layout).unwrap_or_default();
                found.push((name.clone(), (origin.layout.filter, one)));
            }
        }
    }
    document.origins.filters.extend(found);
    Ok(())
}

/// Gives accessors on these buffer views the least and greatest values that they have, where they name them.
///
/// # Errors
/// `invalid_model` for a broken accessor.
pub(crate) fn renew_bounds(document: &mut Document, views: &BTreeSet<usize>) -> Result<()> {
    if views.is_empty() {
        return Ok(());
    }
    for index in 0..list(&document.json, "accessors")?.len() {
        let object = &document.json["accessors"][index];
        let view: Option<usize> = read_key(object, "bufferView", &format!("/accessors/{index}"))?;
        if view.is_some_and(|v| views.contains(&v)) && (object.get("min").is_some() || object.get("max").is_some()) {
            let raw = raw_elements(document, index)?;
            set_bounds(&mut document.json["accessors"][index], &raw);
        }
    }
    Ok(())
}

/// The compressed source of a buffer view, where it has one.
fn source(view: &Value, index: usize) -> Result<Option<CompressedSource>> {
    let own = format!("/bufferViews/{index}");
    for name in MESHOPT {
        if let (Some(layout), Some(range)) =
            (extension::<StreamLayout>(view, name, &own)?, extension(view, name, &own)?)
        {
            let pointer = format!("{own}/extensions/{name}");
            layout.check().map_err(|why| Failure::model(why.to_string()).at(&*pointer))?;
            return Ok(Some(CompressedSource { name, pointer, range, layout }));
        }
    }
    Ok(None)
}

/// The buffer that a view names, and the bytes that the view has once it is decoded.
fn target(json: &Value, index: usize, source: &CompressedSource, pointer: &str) -> Result<(usize, usize)> {
    let view = view(json, index)?;
    let size = source.layout.bytes().ok_or_else(|| {
        let message = "the compressed stream declares more bytes than there can be";
        Failure::new(Code::TooLarge, message).at(source.pointer.clone())
    })?;
    if size != view.length {
        let message = format!("byteLength is {}, and the compressed elements take {size} bytes", view.length);
        return Err(Failure::model(message).at(format!("{pointer}/byteLength")));
    }
    Ok((view.buffer, size))
}
