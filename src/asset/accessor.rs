//! Typed and raw reading of accessors: any component type, stride, sparse, normalised or not.

use gltf::accessor::Item;
use gltf::accessor::util::ItemIter;
use gltf::json::accessor::sparse::Sparse;

use super::accessor_layout::{self, AccessorLayout, element_size, kind_name, sparse_parts, valid};
use super::document::Document;
use super::{ComponentType, Kind};
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
    /// Elements that lie one after the other in `data`.
    pub fn new(component_type: ComponentType, kind: Kind, normalized: bool, data: Vec<u8>) -> Self {
        let element_size = element_size(kind, component_type);
        RawAccessor { component_type, kind, normalized, element_size, count: data.len() / element_size, data }
    }

    /// Float vectors of 2, 3 or 4 components (1 is a scalar).
    pub fn from_floats<const N: usize>(values: &[[f32; N]]) -> Self {
        let kind = match N {
            1 => Kind::Scalar,
            2 => Kind::Vec2,
            3 => Kind::Vec3,
            _ => Kind::Vec4,
        };
        debug_assert_eq!(kind.multiplicity(), N);
        let data = values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        Self::new(ComponentType::F32, kind, false, data)
    }

    /// Indices, 16 bits wide where they fit (65535 restarts primitives and is kept out), else 32.
    pub fn from_indices(values: &[u32]) -> Self {
        let wide = values.iter().any(|v| *v >= 0xFFFF);
        let component = if wide { ComponentType::U32 } else { ComponentType::U16 };
        Self::from_unsigned(component, Kind::Scalar, values)
    }

    /// Unsigned integers, cut to the width of their type.
    pub(crate) fn from_unsigned(component_type: ComponentType, kind: Kind, values: &[u32]) -> Self {
        let data = match component_type {
            ComponentType::U8 => values.iter().map(|v| *v as u8).collect(),
            ComponentType::U16 => values.iter().flat_map(|v| (*v as u16).to_le_bytes()).collect(),
            _ => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        };
        Self::new(component_type, kind, false, data)
    }

    /// The components as unsigned integers; none where they are something else.
    pub(crate) fn unsigned(&self) -> Option<Vec<u32>> {
        unsigned(self.component_type, &self.data)
    }
}

/// What an accessor holds, without its data.
///
/// # Errors
/// `invalid_model` when there is no such accessor or a field of it is broken.
pub fn accessor_shape(doc: &Document, accessor: usize) -> Result<AccessorLayout> {
    accessor_layout::accessor(&doc.json, accessor)
}

/// Number of elements of an accessor.
///
/// # Errors
/// As [`accessor_shape`].
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
    if raw.kind.multiplicity() != N || raw.kind == Kind::Mat2 {
        let message = format!("the accessor is a {}, and {N} components are expected", kind_name(raw.kind));
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
        let message = format!("indices are a {}, not SCALAR", kind_name(kind));
        return Err(Failure::model(message).at(format!("/accessors/{accessor}/type")));
    }
    let raw = raw_elements(doc, accessor)?;
    raw.unsigned().ok_or_else(|| {
        let found = raw.component_type.as_gl_enum();
        Failure::model(format!("indices have componentType {found}, not 5121, 5123 or 5125"))
            .at(format!("/accessors/{accessor}/componentType"))
    })
}

fn unsigned(component: ComponentType, data: &[u8]) -> Option<Vec<u32>> {
    fn widened<T: Item + Into<u32>>(data: &[u8]) -> Vec<u32> {
        ItemIter::<T>::new(data, size_of::<T>()).map(Into::into).collect()
    }
    Some(match component {
        ComponentType::U8 => widened::<u8>(data),
        ComponentType::U16 => widened::<u16>(data),
        ComponentType::U32 => widened::<u32>(data),
        _ => return None,
    })
}

/// Reads an accessor's elements as they are, tightly packed, sparse replacements applied.
///
/// # Errors
/// `invalid_model` with a pointer, when the accessor or its sparse part is broken or leaves its buffer.
pub fn raw_elements(doc: &Document, accessor: usize) -> Result<RawAccessor> {
    let found = accessor_layout::accessor(&doc.json, accessor)?;
    let mut data = dense(doc, &found, accessor)?;
    if let Some(sparse) = &found.sparse {
        replace(doc, sparse, &mut data, found.element_size(), accessor)?;
    }
    Ok(RawAccessor::new(found.component_type, found.kind, found.normalized, data))
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

fn replace(doc: &Document, sparse: &Sparse, data: &mut [u8], size: usize, index: usize) -> Result<()> {
    let at = |name: &str| format!("/accessors/{index}/sparse/{name}");
    let mut parts = [&[][..]; 2];
    for (part, (name, view, offset, size)) in parts.iter_mut().zip(sparse_parts(sparse, size)) {
        let end = offset.checked_add(sparse.count.0 as usize * size);
        let bytes = end.and_then(|end| doc.view_bytes(view).ok()?.get(offset..end));
        *part = bytes.ok_or_else(|| Failure::model(format!("sparse {name} leave their bufferView")).at(at(name)))?;
    }
    let [indices, values] = parts;
    let targets = valid(sparse.indices.component_type).and_then(|component| unsigned(component.0, indices));
    let count = data.len() / size;
    let mut last = None;
    for (target, value) in targets.into_iter().flatten().zip(values.chunks(size)) {
        if let Some(last) = last.replace(target).filter(|last| target <= *last) {
            let message = format!("sparse indices must rise strictly, and {target} follows {last}");
            return Err(Failure::model(message).at(at("indices")));
        }
        let place = data.chunks_exact_mut(size).nth(target as usize).ok_or_else(|| {
            Failure::model(format!("sparse index {target} is out of range: the accessor has {count} elements"))
                .at(at("indices"))
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
