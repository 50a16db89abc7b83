//! The layout of buffer views and accessors in memory, checked against the buffers.

use gltf::json::accessor::sparse::Sparse;
use gltf::json::validation::Checked;
use gltf::json::{self, buffer};
use serde_json::Value;

use super::json::{checked, list, typed, whole};
use super::{ComponentType, Kind};
use crate::error::{Code, Failure, Result, Warning};

/// An accessor's elements together must stay under this, even where no buffer holds them.
const MAX_ACCESSOR_BYTES: u64 = 4 << 30;

/// A buffer view: a byte range of a buffer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViewLayout {
    /// Index into `/buffers`.
    pub(crate) buffer: usize,
    /// First byte.
    pub(crate) offset: usize,
    /// Number of bytes.
    pub(crate) length: usize,
    /// Bytes from one element to the next, where it is given.
    pub(crate) stride: Option<usize>,
}

/// What an accessor holds, and how its elements lie in a buffer view.
#[derive(Debug, Clone)]
pub struct AccessorLayout {
    /// Type of a component.
    pub component_type: ComponentType,
    /// Shape of an element.
    pub kind: Kind,
    /// Whether integers stand for fractions of their range.
    pub normalized: bool,
    /// Number of elements.
    pub count: usize,
    /// Index into `/bufferViews`; none means zeros.
    pub(crate) view: Option<usize>,
    /// First byte in the view.
    pub(crate) offset: usize,
    /// Elements that differ.
    pub(crate) sparse: Option<Sparse>,
}

impl AccessorLayout {
    /// Bytes of one element.
    pub(crate) fn element_size(&self) -> usize {
        element_size(self.kind, self.component_type)
    }
}

/// What the crate `gltf` made of a value; none where it knows no such value.
pub(crate) fn valid<T>(value: Checked<T>) -> Option<T> {
    match value {
        Checked::Valid(known) => Some(known),
        Checked::Invalid => None,
    }
}

/// glTF's name of a shape.
pub fn kind_name(kind: Kind) -> String {
    format!("{kind:?}").to_uppercase()
}

/// Bytes of one element. Columns of matrices start at multiples of four bytes (glTF 2.0, section 3.6.2.4).
pub(crate) fn element_size(kind: Kind, component: ComponentType) -> usize {
    let column = |rows: usize| (rows * component.size()).next_multiple_of(4);
    match kind {
        Kind::Mat2 => 2 * column(2),
        Kind::Mat3 => 3 * column(3),
        Kind::Mat4 => 4 * column(4),
        _ => kind.multiplicity() * component.size(),
    }
}

/// Reads a buffer view.
///
/// # Errors
/// `invalid_model` with a pointer when a field is missing or of the wrong type.
pub(crate) fn view(json: &Value, index: usize) -> Result<ViewLayout> {
    let view: buffer::View = typed(json, "bufferViews", index)?;
    Ok(ViewLayout {
        buffer: view.buffer.value(),
        offset: view.byte_offset.map_or(0, |offset| offset.0 as usize),
        length: view.byte_length.0 as usize,
        // Some writers say 0 for "tightly packed".
        stride: view.byte_stride.map(|stride| stride.0).filter(|stride| *stride > 0),
    })
}

/// Reads an accessor.
///
/// # Errors
/// `invalid_model` with a pointer when a field is missing or of the wrong type; `too_large` when it declares absurdly many elements.
pub(crate) fn accessor(json: &Value, index: usize) -> Result<AccessorLayout> {
    let found: json::Accessor = typed(json, "accessors", index)?;
    let at = |key: &str| format!("/accessors/{index}/{key}");
    let unknown = |what: &str, key: &str| Failure::model(what).at(at(key));
    let component_type = valid(found.component_type)
        .ok_or_else(|| unknown("componentType is none of 5120, 5121, 5122, 5123, 5125, 5126", "componentType"))?;
    let kind = valid(found.type_)
        .ok_or_else(|| unknown("the type is none of SCALAR, VEC2, VEC3, VEC4, MAT2, MAT3, MAT4", "type"))?;
    let (count, size) = (found.count.0, element_size(kind, component_type.0));
    if count.checked_mul(size as u64).is_none_or(|bytes| bytes > MAX_ACCESSOR_BYTES) {
        let message = format!("the accessor declares {count} elements of {size} bytes, more than any buffer holds");
        return Err(Failure::new(Code::TooLarge, message).at(at("count")));
    }
    if let Some(sparse) = &found.sparse {
        let own = sparse.count.0;
        if own > count {
            let message = format!("the sparse accessor replaces {own} elements of {count}");
            return Err(Failure::model(message).at(at("sparse/count")));
        }
        valid(sparse.indices.component_type).ok_or_else(|| {
            let what = "sparse indices are unsigned integers: componentType 5121, 5123 or 5125";
            unknown(what, "sparse/indices/componentType")
        })?;
    }
    Ok(AccessorLayout {
        component_type: component_type.0,
        kind,
        normalized: found.normalized,
        count: count as usize,
        view: found.buffer_view.map(|view| view.value()),
        offset: found.byte_offset.map_or(0, |offset| offset.0 as usize),
        sparse: found.sparse,
    })
}

/// The parts of a sparse accessor with elements of `size` bytes: name, buffer view, first byte, bytes of an element.
pub(crate) fn sparse_parts(sparse: &Sparse, size: usize) -> [(&'static str, usize, usize, usize); 2] {
    let (indices, values) = (&sparse.indices, &sparse.values);
    let index_size = valid(indices.component_type).map_or(0, |component| component.0.size());
    [
        ("indices", indices.buffer_view.value(), indices.byte_offset.0 as usize, index_size),
        ("values", values.buffer_view.value(), values.byte_offset.0 as usize, size),
    ]
}

/// The stride of an accessor in its view.
///
/// # Errors
/// `invalid_model` when the elements overlap or leave the view.
pub(crate) fn extent(accessor: &AccessorLayout, view: &ViewLayout, index: usize) -> Result<usize> {
    let (size, count, offset) = (accessor.element_size(), accessor.count, accessor.offset);
    let stride = view.stride.unwrap_or(size);
    let message = if stride < size {
        format!("byteStride {stride} is less than an element of the accessor, {size} bytes")
    } else if !inside(offset, stride, size, count, view.length) {
        let length = view.length;
        format!(
            "the accessor needs {count} elements of {size} bytes, {stride} apart from byte {offset}, and its bufferView has {length} bytes"
        )
    } else {
        return Ok(stride);
    };
    Err(Failure::model(message).at(format!("/accessors/{index}")))
}

fn inside(offset: usize, stride: usize, size: usize, count: usize, length: usize) -> bool {
    let between = count.saturating_sub(1).saturating_mul(stride);
    let last = if count > 0 { size } else { 0 };
    offset.saturating_add(between).saturating_add(last) <= length
}

/// The index under `key`, looked at itself: the crate `gltf` keeps its lower 32 bits only.
fn named(object: &Value, key: &str, count: usize, pointer: &str) -> Result<Option<usize>> {
    let Some(found) = object.get(key) else { return Ok(None) };
    let exact = whole(found).map_or_else(|| found.clone(), Value::from);
    checked(&exact, count, || format!("{pointer}/{key}")).map(Some)
}

/// Checks every buffer view and accessor against `buffers`, the byte lengths of the buffers. `most` is how many
/// bytes accessors without a buffer view may declare together; all of them, which may share their bytes, may declare
/// twice that.
///
/// # Errors
/// `invalid_model` or `too_large` with a pointer. Misalignment, which leaves no doubt about the contents, is a warning.
pub(crate) fn check(json: &Value, buffers: &[usize], most: u64, warnings: &mut Vec<Warning>) -> Result<()> {
    let mut views = Vec::new();
    for (number, object) in list(json, "bufferViews")?.iter().enumerate() {
        let view = view(json, number)?;
        let pointer = format!("/bufferViews/{number}");
        named(object, "buffer", buffers.len(), &pointer)?;
        let (offset, own, length) = (view.offset, view.length, buffers[view.buffer]);
        if offset.checked_add(own).is_none_or(|end| end > length) {
            let message = format!("{own} bytes from byte {offset} leave buffer {} of {length} bytes", view.buffer);
            return Err(Failure::model(message).at(pointer));
        }
        views.push(view);
    }
    let (mut zeros_left, mut left) = (most, most.saturating_mul(2));
    for (number, object) in list(json, "accessors")?.iter().enumerate() {
        let accessor = accessor(json, number)?;
        let pointer = format!("/accessors/{number}");
        let bytes = (accessor.count * accessor.element_size()) as u64;
        let too_large = |what: String| Failure::new(Code::TooLarge, what).at(format!("{pointer}/count"));
        left = left.checked_sub(bytes).ok_or_else(|| {
            too_large(format!("the accessors together declare more than {} bytes", most.saturating_mul(2)))
        })?;
        if let Some(view) = named(object, "bufferView", views.len(), &pointer)? {
            let view = &views[view];
            extent(&accessor, view, number)?;
            let align = accessor.component_type.size();
            let aligned = (view.offset + accessor.offset).is_multiple_of(align);
            if !aligned || view.stride.is_some_and(|s| !s.is_multiple_of(align)) {
                let message = format!("the accessor's {align}-byte components do not lie on {align}-byte boundaries");
                warnings.push(Warning::new("misaligned_accessor", message).at(pointer.clone()));
            }
        } else {
            zeros_left = zeros_left
                .checked_sub(bytes)
                .ok_or_else(|| too_large(format!("accessors without a bufferView declare more than {most} bytes")))?;
        }
        let Some(sparse) = &accessor.sparse else { continue };
        let count = sparse.count.0 as usize;
        for (name, view, offset, size) in sparse_parts(sparse, accessor.element_size()) {
            let pointer = format!("{pointer}/sparse/{name}");
            named(&object["sparse"][name], "bufferView", views.len(), &pointer)?;
            let length = views.get(view).map_or(0, |view| view.length);
            if !inside(offset, size, size, count, length) {
                let text = format!("{count} sparse {name} of {size} bytes from byte {offset}");
                return Err(Failure::model(format!("{text} leave a bufferView of {length} bytes")).at(pointer));
            }
        }
    }
    Ok(())
}
