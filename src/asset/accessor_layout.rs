//! The layout of buffer views and accessors in memory, checked against the buffers.

use serde_json::{Map, Value};

use super::accessor_type::{ComponentType, Kind};
use super::uri::quote;
use crate::error::{Code, Failure, Result, Warning};

/// An accessor's elements together must stay under this, even where no buffer holds them.
const MAX_ACCESSOR_BYTES: u64 = 4 << 30;

/// A buffer view: a byte range of a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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

/// An accessor: how the elements lie in a buffer view.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct AccessorLayout {
    /// Type of a component.
    pub(crate) component: ComponentType,
    /// Shape of an element.
    pub(crate) kind: Kind,
    /// Whether integers stand for fractions of their range.
    pub(crate) normalized: bool,
    /// Number of elements.
    pub(crate) count: usize,
    /// Index into `/bufferViews`; none means zeros.
    pub(crate) view: Option<usize>,
    /// First byte in the view.
    pub(crate) offset: usize,
    /// Elements that differ.
    pub(crate) sparse: Option<SparseLayout>,
}

/// The sparse part of an accessor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SparseLayout {
    /// Number of elements that differ.
    pub(crate) count: usize,
    /// Type of the indices: unsigned.
    pub(crate) component: ComponentType,
    /// ViewLayout and first byte of the indices.
    pub(crate) indices: (usize, usize),
    /// ViewLayout and first byte of the values.
    pub(crate) values: (usize, usize),
}

impl AccessorLayout {
    /// Bytes of one element.
    pub(crate) fn element_size(&self) -> usize {
        self.kind.element_size(self.component)
    }
}

/// An array of the document; empty where there is none.
///
/// # Errors
/// `invalid_model` when something else than an array stands there.
pub(crate) fn list<'a>(json: &'a Value, key: &str) -> Result<&'a [Value]> {
    match json.get(key) {
        None => Ok(&[]),
        Some(Value::Array(values)) => Ok(values),
        Some(_) => Err(Failure::model(format!("{key} is not an array")).at(format!("/{key}"))),
    }
}

/// One object of an array of the document.
///
/// # Errors
/// `invalid_model` when there is none.
pub(crate) fn element<'a>(json: &'a Value, key: &str, index: usize) -> Result<&'a Map<String, Value>> {
    let all = list(json, key)?;
    let found = all.get(index).ok_or_else(|| {
        Failure::model(format!("{key} {index} does not exist: there are {}", all.len())).at(format!("/{key}"))
    })?;
    found.as_object().ok_or_else(|| Failure::model("an object is expected here").at(format!("/{key}/{index}")))
}

/// A whole number at or above zero; none where the key is missing.
///
/// # Errors
/// `invalid_model` at `pointer/key` when it is something else.
pub(crate) fn whole(object: &Map<String, Value>, key: &str, pointer: &str) -> Result<Option<usize>> {
    let Some(value) = object.get(key) else { return Ok(None) };
    value.as_u64().or_else(|| exact(value)).and_then(|n| usize::try_from(n).ok()).map(Some).ok_or_else(|| {
        Failure::model(format!("{key} is not a whole number at or above zero")).at(format!("{pointer}/{key}"))
    })
}

/// Writers without an integer type write `4.0`.
fn exact(value: &Value) -> Option<u64> {
    value.as_f64().filter(|f| f.fract() == 0.0 && (0.0..9e15).contains(f)).map(|f| f as u64)
}

/// A whole number at or above zero.
///
/// # Errors
/// `invalid_model` at `pointer` when it is missing, at `pointer/key` when it is something else.
pub(crate) fn needed(object: &Map<String, Value>, key: &str, pointer: &str) -> Result<usize> {
    whole(object, key, pointer)?.ok_or_else(|| Failure::model(format!("{key} is missing")).at(pointer))
}

/// Reads a buffer view.
///
/// # Errors
/// `invalid_model` with a pointer when a field is missing or of the wrong type.
pub(crate) fn view(json: &Value, index: usize) -> Result<ViewLayout> {
    let object = element(json, "bufferViews", index)?;
    let pointer = format!("/bufferViews/{index}");
    Ok(ViewLayout {
        buffer: needed(object, "buffer", &pointer)?,
        offset: whole(object, "byteOffset", &pointer)?.unwrap_or(0),
        length: needed(object, "byteLength", &pointer)?,
        // Some writers say 0 for "tightly packed".
        stride: whole(object, "byteStride", &pointer)?.filter(|s| *s > 0),
    })
}

/// Reads an accessor.
///
/// # Errors
/// `invalid_model` with a pointer when a field is missing or of the wrong type; `too_large` when it declares absurdly many elements.
pub(crate) fn accessor(json: &Value, index: usize) -> Result<AccessorLayout> {
    let object = element(json, "accessors", index)?;
    let pointer = format!("/accessors/{index}");
    let component = component(object, &pointer)?;
    let kind = object.get("type").and_then(Value::as_str).and_then(Kind::from_name).ok_or_else(|| {
        let found = object.get("type").map_or_else(|| "missing".to_owned(), |v| quote(&v.to_string()));
        Failure::model(format!("the accessor's type is {found}, not one of SCALAR, VEC2, VEC3, VEC4, MAT2, MAT3, MAT4"))
            .at(format!("{pointer}/type"))
    })?;
    let count = needed(object, "count", &pointer)?;
    let size = kind.element_size(component);
    if (count as u64).checked_mul(size as u64).is_none_or(|bytes| bytes > MAX_ACCESSOR_BYTES) {
        let message = format!("the accessor declares {count} elements of {size} bytes, more than any buffer holds");
        return Err(Failure::new(Code::TooLarge, message).at(format!("{pointer}/count")));
    }
    let sparse = match object.get("sparse") {
        None => None,
        Some(found) => Some(sparse(found, count, &format!("{pointer}/sparse"))?),
    };
    Ok(AccessorLayout {
        component,
        kind,
        normalized: object.get("normalized").and_then(Value::as_bool).unwrap_or(false),
        count,
        view: whole(object, "bufferView", &pointer)?,
        offset: whole(object, "byteOffset", &pointer)?.unwrap_or(0),
        sparse,
    })
}

fn sparse(found: &Value, count: usize, pointer: &str) -> Result<SparseLayout> {
    let part = |value: Option<&'_ Value>, name: &str| -> Result<(Map<String, Value>, String)> {
        let pointer = format!("{pointer}/{name}");
        let object = value.and_then(Value::as_object).cloned();
        Ok((object.ok_or_else(|| Failure::model("an object is expected here").at(pointer.clone()))?, pointer))
    };
    let object = found.as_object().ok_or_else(|| Failure::model("an object is expected here").at(pointer))?;
    let own = needed(object, "count", pointer)?;
    if own > count {
        let message = format!("the sparse accessor replaces {own} elements of {count}");
        return Err(Failure::model(message).at(format!("{pointer}/count")));
    }
    let (indices, at_indices) = part(object.get("indices"), "indices")?;
    let (values, at_values) = part(object.get("values"), "values")?;
    let place = |object: &Map<String, Value>, pointer: &str| -> Result<(usize, usize)> {
        Ok((needed(object, "bufferView", pointer)?, whole(object, "byteOffset", pointer)?.unwrap_or(0)))
    };
    let component = component(&indices, &at_indices)?;
    if !matches!(component, ComponentType::U8 | ComponentType::U16 | ComponentType::U32) {
        let message = "sparse indices are unsigned integers: componentType 5121, 5123 or 5125";
        return Err(Failure::model(message).at(format!("{at_indices}/componentType")));
    }
    Ok(SparseLayout {
        count: own,
        component,
        indices: place(&indices, &at_indices)?,
        values: place(&values, &at_values)?,
    })
}

fn component(object: &Map<String, Value>, pointer: &str) -> Result<ComponentType> {
    let number = needed(object, "componentType", pointer)?;
    ComponentType::from_gl(number as u64).ok_or_else(|| {
        Failure::model(format!("componentType {number} is none of 5120, 5121, 5122, 5123, 5125, 5126"))
            .at(format!("{pointer}/componentType"))
    })
}

/// The stride of an accessor and the end of its last element in the view.
///
/// # Errors
/// `invalid_model` when the elements overlap or leave the view.
pub(crate) fn extent(accessor: &AccessorLayout, view: &ViewLayout, index: usize) -> Result<usize> {
    let size = accessor.element_size();
    let stride = view.stride.unwrap_or(size);
    let pointer = || format!("/accessors/{index}");
    if stride < size {
        let message = format!("byteStride {stride} is less than an element of the accessor, {size} bytes");
        return Err(Failure::model(message).at(pointer()));
    }
    inside(accessor.offset, stride, size, accessor.count, view.length)
        .ok_or_else(|| {
            Failure::model(format!(
                "the accessor needs {} elements of {size} bytes, {stride} apart from byte {}, and its bufferView has {} bytes",
                accessor.count, accessor.offset, view.length
            ))
            .at(pointer())
        })
        .map(|()| stride)
}

fn inside(offset: usize, stride: usize, size: usize, count: usize, length: usize) -> Option<()> {
    let end = match count.checked_sub(1) {
        None => offset,
        Some(last) => offset.checked_add(last.checked_mul(stride)?)?.checked_add(size)?,
    };
    (end <= length).then_some(())
}

/// Checks every buffer view and accessor against `buffers`, the byte lengths of the buffers. `most` is how many
/// bytes accessors without a buffer view may declare together; all of them, which may share their bytes, may declare
/// twice that.
///
/// # Errors
/// `invalid_model` or `too_large` with a pointer. Misalignment, which leaves no doubt about the contents, is a warning.
pub(crate) fn check(json: &Value, buffers: &[usize], most: u64, warnings: &mut Vec<Warning>) -> Result<()> {
    let count = list(json, "bufferViews")?.len();
    let mut views = Vec::with_capacity(count);
    for index in 0..count {
        let view = view(json, index)?;
        let pointer = format!("/bufferViews/{index}");
        let length = buffers.get(view.buffer).ok_or_else(|| {
            Failure::model(format!("buffer {} does not exist: there are {}", view.buffer, buffers.len()))
                .at(format!("{pointer}/buffer"))
        })?;
        if view.offset.checked_add(view.length).is_none_or(|end| end > *length) {
            let message = format!(
                "{} bytes from byte {} leave buffer {} of {length} bytes",
                view.length, view.offset, view.buffer
            );
            return Err(Failure::model(message).at(pointer));
        }
        views.push(view);
    }
    let (mut zeros_left, mut left) = (most, most.saturating_mul(2));
    for index in 0..list(json, "accessors")?.len() {
        let accessor = accessor(json, index)?;
        let pointer = format!("/accessors/{index}");
        let bytes = (accessor.count * accessor.element_size()) as u64;
        let too_large = |what: &str| Failure::new(Code::TooLarge, what.to_owned()).at(format!("{pointer}/count"));
        left = left.checked_sub(bytes).ok_or_else(|| {
            too_large(&format!("the accessors together declare more than {} bytes", most.saturating_mul(2)))
        })?;
        let named = |view: usize, pointer: &str| {
            views.get(view).ok_or_else(|| {
                Failure::model(format!("bufferView {view} does not exist: there are {count}"))
                    .at(format!("{pointer}/bufferView"))
            })
        };
        match accessor.view {
            Some(number) => {
                let view = named(number, &pointer)?;
                extent(&accessor, view, index)?;
                let align = accessor.component.size();
                if !(view.offset + accessor.offset).is_multiple_of(align)
                    || view.stride.is_some_and(|s| !s.is_multiple_of(align))
                {
                    let message =
                        format!("the accessor's {align}-byte components do not lie on {align}-byte boundaries");
                    warnings.push(Warning::new("misaligned_accessor", message).at(pointer.clone()));
                }
            }
            None => {
                zeros_left = zeros_left.checked_sub(bytes).ok_or_else(|| {
                    too_large(&format!("accessors without a bufferView declare more than {most} bytes"))
                })?;
            }
        }
        let Some(sparse) = &accessor.sparse else { continue };
        let parts =
            [("indices", sparse.indices, sparse.component.size()), ("values", sparse.values, accessor.element_size())];
        for (name, (view, offset), size) in parts {
            let pointer = format!("{pointer}/sparse/{name}");
            let length = named(view, &pointer)?.length;
            inside(offset, size, size, sparse.count, length).ok_or_else(|| {
                Failure::model(format!(
                    "{} sparse {name} of {size} bytes from byte {offset} leave a bufferView of {length} bytes",
                    sparse.count
                ))
                .at(pointer.clone())
            })?;
        }
    }
    Ok(())
}
