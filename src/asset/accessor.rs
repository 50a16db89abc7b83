//! Typed and raw reading of accessors: any component type, stride, sparse, normalised or not.

use super::accessor_layout::{self, AccessorLayout, SparseLayout};
use super::accessor_type::{ComponentType, Kind};
use super::document::Document;
use crate::error::{Failure, Result};

/// The elements of an accessor, tightly packed, for copying without loss.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawAccessor {
    /// Type of a component.
    pub component_type: ComponentType,
    /// Shape of an element.
    pub kind: Kind,
    /// Whether integers stand for fractions of their range.
    pub normalized: bool,
    /// Bytes of one element.
    pub element_size: usize,
    /// Number of elements.
    pub count: usize,
    /// `count * element_size` bytes, sparse replacements applied.
    pub data: Vec<u8>,
}

impl RawAccessor {
    /// Float vectors of 2, 3 or 4 components (1 is a scalar).
    pub fn from_floats<const N: usize>(values: &[[f32; N]]) -> Self {
        let kind = match N {
            1 => Kind::Scalar,
            2 => Kind::Vec2,
            3 => Kind::Vec3,
            _ => Kind::Vec4,
        };
        debug_assert_eq!(kind.components(), N);
        let data = values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        RawAccessor {
            component_type: ComponentType::F32,
            kind,
            normalized: false,
            element_size: 4 * N,
            count: values.len(),
            data,
        }
    }

    /// Indices, 16 bits wide where they fit (65535 restarts primitives and is kept out), else 32.
    pub fn from_indices(values: &[u32]) -> Self {
        let wide = values.iter().any(|v| *v >= 0xFFFF);
        let (component_type, data) = if wide {
            (ComponentType::U32, values.iter().flat_map(|v| v.to_le_bytes()).collect())
        } else {
            (ComponentType::U16, values.iter().flat_map(|v| (*v as u16).to_le_bytes()).collect())
        };
        RawAccessor {
            component_type,
            kind: Kind::Scalar,
            normalized: false,
            element_size: component_type.size(),
            count: values.len(),
            data,
        }
    }
}

/// What an accessor holds, without its data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Type of a component.
    pub component_type: ComponentType,
    /// Shape of an element.
    pub kind: Kind,
    /// Whether integers stand for fractions of their range.
    pub normalized: bool,
    /// Number of elements.
    pub count: usize,
}

/// What an accessor holds.
///
/// # Errors
/// `invalid_model` when there is no such accessor or a field of it is broken.
pub fn accessor_shape(doc: &Document, accessor: usize) -> Result<Shape> {
    let found = accessor_layout::accessor(&doc.json, accessor)?;
    Ok(Shape { component_type: found.component, kind: found.kind, normalized: found.normalized, count: found.count })
}

/// Number of elements of an accessor.
///
/// # Errors
/// `invalid_model` when there is no such accessor or a field of it is broken.
pub fn accessor_count(doc: &Document, accessor: usize) -> Result<usize> {
    Ok(accessor_shape(doc, accessor)?.count)
}

/// Reads a VEC2 accessor as floats; see [`read_vec`].
///
/// # Errors
/// As [`read_vec`].
pub fn read_vec2(doc: &Document, accessor: usize) -> Result<Vec<[f32; 2]>> {
    read_vec(doc, accessor)
}

/// Reads a VEC3 accessor as floats; see [`read_vec`].
///
/// # Errors
/// As [`read_vec`].
pub fn read_vec3(doc: &Document, accessor: usize) -> Result<Vec<[f32; 3]>> {
    read_vec(doc, accessor)
}

/// Reads a VEC4 accessor as floats; see [`read_vec`].
///
/// # Errors
/// As [`read_vec`].
pub fn read_vec4(doc: &Document, accessor: usize) -> Result<Vec<[f32; 4]>> {
    read_vec(doc, accessor)
}

/// Reads an accessor of `N` components as floats: normalised integers by glTF 2.0, section 3.6.2.2 (signed ones clamped
/// at -1), plain integers (KHR_mesh_quantization) by their value. NaN and infinity come through.
///
/// # Errors
/// `invalid_model` at the accessor, when it has another number of components or leaves its buffer.
pub fn read_vec<const N: usize>(doc: &Document, accessor: usize) -> Result<Vec<[f32; N]>> {
    let raw = raw_elements(doc, accessor)?;
    if raw.kind.components() != N || raw.element_size != N * raw.component_type.size() || raw.kind == Kind::Mat2 {
        let message = format!("the accessor is a {}, and {N} components are expected", raw.kind.name());
        return Err(Failure::model(message).at(format!("/accessors/{accessor}")));
    }
    // Division, not multiplication by the inverse: 255 must give exactly 1.
    let divided = |value: f32, limit: f32| if raw.normalized { (value / limit).max(-1.0) } else { value };
    let data = raw.data.as_slice();
    Ok(match raw.component_type {
        ComponentType::I8 => convert(data, |[a]: [u8; 1]| divided(f32::from(a as i8), 127.0)),
        ComponentType::U8 => convert(data, |[a]: [u8; 1]| divided(f32::from(a), 255.0)),
        ComponentType::I16 => convert(data, |b| divided(f32::from(i16::from_le_bytes(b)), 32767.0)),
        ComponentType::U16 => convert(data, |b| divided(f32::from(u16::from_le_bytes(b)), 65535.0)),
        ComponentType::U32 => convert(data, |b| u32::from_le_bytes(b) as f32),
        ComponentType::F32 => convert(data, f32::from_le_bytes),
    })
}

fn convert<const S: usize, const N: usize>(data: &[u8], one: impl Fn([u8; S]) -> f32) -> Vec<[f32; N]> {
    let (components, _) = data.as_chunks::<S>();
    let (elements, _) = components.as_chunks::<N>();
    elements.iter().map(|e| e.map(&one)).collect()
}

/// Reads an index accessor.
///
/// # Errors
/// `invalid_model` at the accessor, when it is not of unsigned integers or leaves its buffer.
pub fn read_indices(doc: &Document, accessor: usize) -> Result<Vec<u32>> {
    let kind = accessor_shape(doc, accessor)?.kind;
    if kind != Kind::Scalar {
        let message = format!("indices are a {}, not SCALAR", kind.name());
        return Err(Failure::model(message).at(format!("/accessors/{accessor}/type")));
    }
    let raw = raw_elements(doc, accessor)?;
    unsigned(raw.component_type, &raw.data).ok_or_else(|| {
        let message = format!("indices have componentType {}, not 5121, 5123 or 5125", raw.component_type.gl());
        Failure::model(message).at(format!("/accessors/{accessor}/componentType"))
    })
}

fn unsigned(component: ComponentType, data: &[u8]) -> Option<Vec<u32>> {
    Some(match component {
        ComponentType::U8 => data.iter().map(|b| u32::from(*b)).collect(),
        ComponentType::U16 => data.as_chunks().0.iter().map(|b| u32::from(u16::from_le_bytes(*b))).collect(),
        ComponentType::U32 => data.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect(),
        _ => return None,
    })
}

/// Reads an accessor's elements as they are, tightly packed, sparse replacements applied.
///
/// # Errors
/// `invalid_model` with a pointer, when the accessor or its sparse part is broken or leaves its buffer.
pub fn raw_elements(doc: &Document, accessor: usize) -> Result<RawAccessor> {
    let found = accessor_layout::accessor(&doc.json, accessor)?;
    let size = found.element_size();
    let mut data = dense(doc, &found, accessor)?;
    if let Some(sparse) = &found.sparse {
        replace(doc, sparse, &mut data, size, accessor)?;
    }
    Ok(RawAccessor {
        component_type: found.component,
        kind: found.kind,
        normalized: found.normalized,
        element_size: size,
        count: found.count,
        data,
    })
}

fn dense(doc: &Document, accessor: &AccessorLayout, index: usize) -> Result<Vec<u8>> {
    let size = accessor.element_size();
    let Some(number) = accessor.view else { return Ok(vec![0; accessor.count * size]) };
    let view = accessor_layout::view(&doc.json, number)?;
    let stride = accessor_layout::extent(accessor, &view, index)?;
    let bytes = doc.view_bytes(number)?.get(accessor.offset..).unwrap_or_default();
    if stride == size {
        return Ok(bytes.get(..accessor.count * size).unwrap_or_default().to_vec());
    }
    let mut data = Vec::with_capacity(accessor.count * size);
    for element in bytes.chunks(stride).take(accessor.count) {
        data.extend_from_slice(element.get(..size).unwrap_or_default());
    }
    Ok(data)
}

fn replace(doc: &Document, sparse: &SparseLayout, data: &mut [u8], size: usize, index: usize) -> Result<()> {
    let pointer = |name: &str| format!("/accessors/{index}/sparse/{name}");
    let part = |(view, offset): (usize, usize), size: usize, name: &str| {
        let bytes = doc.view_bytes(view)?;
        let end = offset.checked_add(sparse.count * size);
        end.and_then(|end| bytes.get(offset..end))
            .ok_or_else(|| Failure::model(format!("sparse {name} leave their bufferView")).at(pointer(name)))
    };
    let indices = part(sparse.indices, sparse.component.size(), "indices")?;
    let values = part(sparse.values, size, "values")?;
    let count = data.len() / size.max(1);
    let mut last = None;
    for (target, value) in unsigned(sparse.component, indices).unwrap_or_default().into_iter().zip(values.chunks(size))
    {
        if last.is_some_and(|l| target <= l) {
            let message = format!("sparse indices must rise strictly, and {target} follows {}", last.unwrap_or(0));
            return Err(Failure::model(message).at(pointer("indices")));
        }
        last = Some(target);
        let start = (target as usize).checked_mul(size);
        let place = start.and_then(|start| data.get_mut(start..start + size)).ok_or_else(|| {
            Failure::model(format!("sparse index {target} is out of range: the accessor has {count} elements"))
                .at(pointer("indices"))
        })?;
        place.copy_from_slice(value);
    }
    Ok(())
}

impl Document {
    /// The bytes of a buffer view.
    ///
    /// # Errors
    /// `invalid_model` with a pointer when there is no such view or it leaves its buffer.
    pub fn view_bytes(&self, view: usize) -> Result<&[u8]> {
        let found = accessor_layout::view(&self.json, view)?;
        let end = found.offset.checked_add(found.length);
        self.buffers
            .get(found.buffer)
            .and_then(|bytes| bytes.get(found.offset..end?))
            .ok_or_else(|| Failure::model("the bufferView leaves its buffer").at(format!("/bufferViews/{view}")))
    }
}
