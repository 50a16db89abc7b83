//! Buffer views with a compressed source.

use std::collections::BTreeSet;

use serde_json::{Map, Value};

use super::meshopt::{Filter, Mode, StreamLayout, decode};
use super::squeeze::squeeze;
use super::{decompressed, extension, remove_extension, undeclare, word};
use crate::asset::Document;
use crate::asset::accessor::raw_elements;
use crate::asset::accessor_layout::{list, needed, whole};
use crate::asset::append::set_bounds;
use crate::asset::extensions::MESHOPT;
use crate::asset::limits::Budget;
use crate::error::{Code, Failure, Result, Warning};

/// What a buffer view says of its compressed source.
struct CompressedSource {
    /// Which of the two names.
    name: &'static str,
    /// JSON pointer of the extension.
    pointer: String,
    /// Buffer and byte range of the stream.
    buffer: usize,
    offset: usize,
    length: usize,
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
            let found = extension(buffer, name, &format!("/buffers/{index}"))?;
            if found.is_some_and(|e| e.get("fallback").and_then(Value::as_bool) == Some(true)) {
                stand_ins.insert(index);
            }
        }
    }
    let mut real = BTreeSet::new();
    for (index, view) in list(json, "bufferViews")?.iter().enumerate() {
        let pointer = format!("/bufferViews/{index}");
        let Some(object) = view.as_object() else { continue };
        let parent = whole(object, "buffer", &pointer)?;
        match source(view, index)? {
            Some(source) => {
                real.insert(source.buffer);
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
    warnings: &mut Vec<Warning>,
    check: &dyn Fn() -> Result<()>,
) -> Result<BTreeSet<usize>> {
    let mut filtered = BTreeSet::new();
    let mut bytes = [[0; 2]; MESHOPT.len()];
    let mut sources = BTreeSet::new();
    for index in 0..list(&document.json, "bufferViews")?.len() {
        let view = &document.json["bufferViews"][index];
        let Some(source) = source(view, index)? else { continue };
        check()?;
        let stream = document
            .buffers
            .get(source.buffer)
            .and_then(|b| b.get(source.offset..source.offset.checked_add(source.length)?))
            .ok_or_else(|| {
                let message = format!("the compressed bytes leave buffer {}", source.buffer);
                Failure::model(message).at(source.pointer.clone())
            })?;
        let pointer = format!("/bufferViews/{index}");
        let (parent, size) = target(view, &source, &pointer)?;
        budget.charge(size, &pointer)?;
        let data = decode(stream, &source.layout)
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
        sources.insert(source.buffer);
        if source.layout.filter != Filter::None {
            filtered.insert(index);
        }
        for (name, [before, after]) in MESHOPT.iter().zip(&mut bytes) {
            if *name == source.name {
                *before += source.length;
                *after += size;
            }
        }
    }
    for (name, [before, after]) in MESHOPT.iter().zip(bytes) {
        for buffer in document.json.get_mut("buffers").and_then(Value::as_array_mut).into_iter().flatten() {
            remove_extension(buffer, name);
        }
        undeclare(&mut document.json, name);
        if after > 0 {
            warnings.push(decompressed(name, before, after));
        }
    }
    for buffer in sources {
        squeeze(document, buffer);
    }
    Ok(filtered)
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
        let view = object.get("bufferView").and_then(Value::as_u64).and_then(|v| usize::try_from(v).ok());
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
        if let Some(object) = extension(view, name, &own)? {
            return read(object, name, format!("{own}/extensions/{name}")).map(Some);
        }
    }
    Ok(None)
}

fn read(object: &Map<String, Value>, name: &'static str, pointer: String) -> Result<CompressedSource> {
    let modes = [("ATTRIBUTES", Mode::Attributes), ("TRIANGLES", Mode::Triangles), ("INDICES", Mode::Indices)];
    let filters = [
        ("NONE", Filter::None),
        ("OCTAHEDRAL", Filter::Octahedral),
        ("QUATERNION", Filter::Quaternion),
        ("EXPONENTIAL", Filter::Exponential),
        ("COLOR", Filter::Color),
    ];
    let layout = StreamLayout {
        mode: word(object, "mode", &modes, &pointer)?
            .ok_or_else(|| Failure::model("mode is missing").at(pointer.clone()))?,
        filter: word(object, "filter", &filters, &pointer)?.unwrap_or(Filter::None),
        count: needed(object, "count", &pointer)?,
        stride: needed(object, "byteStride", &pointer)?,
    };
    layout.check().map_err(|why| Failure::model(why.to_string()).at(pointer.clone()))?;
    Ok(CompressedSource {
        name,
        buffer: needed(object, "buffer", &pointer)?,
        offset: whole(object, "byteOffset", &pointer)?.unwrap_or(0),
        length: needed(object, "byteLength", &pointer)?,
        layout,
        pointer,
    })
}

/// The buffer that a view names, and the bytes that the view has once it is decoded.
fn target(view: &Value, source: &CompressedSource, pointer: &str) -> Result<(usize, usize)> {
    let empty = Map::new();
    let object = view.as_object().unwrap_or(&empty);
    let wanted = needed(object, "byteLength", pointer)?;
    let size = source.layout.bytes().ok_or_else(|| {
        let message = "the compressed stream declares more bytes than there can be";
        Failure::new(Code::TooLarge, message).at(source.pointer.clone())
    })?;
    if size != wanted {
        let message = format!("byteLength is {wanted}, and the compressed elements take {size} bytes");
        return Err(Failure::model(message).at(format!("{pointer}/byteLength")));
    }
    Ok((needed(object, "buffer", pointer)?, size))
}
