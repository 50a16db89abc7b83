//! Streams of triangles, each read once more before it is delivered.

use std::panic::{AssertUnwindSafe, catch_unwind};

use draco_core::{
    DataType, DecoderBuffer, EncoderBuffer, EncoderOptions, FaceIndex, GeometryAttributeType, Mesh, MeshDecoder,
    MeshEncoder, PointAttribute, PointIndex,
};

use super::grid::{Grid, Quantization, delivered_vector};
use super::{attribute, indices};
use crate::asset::accessor::RawAccessor;
use crate::asset::accessor_layout::AccessorLayout;
use crate::asset::{ComponentType, Kind};
use crate::texture::mix;

/// Speed of the encoder, 0 to 10; a stream does not tell with which it was made. On a scan 0 and 1 gain nothing over 3, and 5 costs an eighth more.
const SPEED: i32 = 3;
/// Draco's numbers of its two methods.
const SEQUENTIAL: i32 = 0;
const EDGEBREAKER: i32 = 1;

/// An attribute on its way into a stream.
pub(in crate::asset) struct Input {
    /// Its name in glTF.
    pub(in crate::asset) name: String,
    pub(in crate::asset) raw: RawAccessor,
    pub(in crate::asset) quantization: Quantization,
}

/// A stream, and what readers make of it.
pub(in crate::asset) struct Encoded {
    pub(in crate::asset) stream: Vec<u8>,
    /// In the order of the inputs, whose place is their number in the stream.
    pub(in crate::asset) attributes: Vec<RawAccessor>,
    pub(in crate::asset) indices: RawAccessor,
    /// Triangles with two corners at one place that are not in it.
    pub(in crate::asset) dropped: usize,
}

/// Encodes triangles. With `in_order` vertices keep their order and number, and edges are not made use of.
///
/// # Errors
/// Why there is no stream that gives the triangles again, in words.
pub(in crate::asset) fn encode(inputs: &[Input], triangles: &[[u32; 3]], in_order: bool) -> Result<Encoded, String> {
    let count = inputs.first().map_or(0, |i| i.raw.count);
    if triangles.is_empty() || inputs.iter().any(|i| i.raw.count != count) {
        return Err("it has no triangles, or attributes of different lengths".to_owned());
    }
    if triangles.iter().flatten().any(|v| *v as usize >= count) {
        return Err("an index is out of range".to_owned());
    }
    let mut why = String::new();
    // The other method takes more than twice the bytes, and whatever there is.
    for method in if in_order { &[SEQUENTIAL][..] } else { &[EDGEBREAKER, SEQUENTIAL] } {
        // A panic would be the encoder's fault, and the primitive can do without it.
        let made = catch_unwind(AssertUnwindSafe(|| attempt(inputs, triangles, *method, in_order)));
        match made.unwrap_or_else(|_| Err("the encoder breaks down".to_owned())) {
            Ok(encoded) => return Ok(encoded),
            Err(failure) => why = failure,
        }
    }
    Err(why)
}

fn attempt(inputs: &[Input], triangles: &[[u32; 3]], method: i32, in_order: bool) -> Result<Encoded, String> {
    let mut mesh = Mesh::new();
    let mut options = EncoderOptions::new();
    options.set_encoding_method(method);
    options.set_global_int("encoding_speed", SPEED);
    options.set_global_int("decoding_speed", SPEED);
    let count = inputs.first().map_or(0, |i| i.raw.count);
    mesh.set_num_points(count);
    let mut patches = Vec::new();
    for (id, input) in inputs.iter().enumerate() {
        let mut values = input.raw.data.clone();
        match &input.quantization {
            Quantization::Lossless => {}
            Quantization::Octahedral(bits) => options.set_attribute_quantization(id as i32, i32::from(*bits)),
            Quantization::Grid(grid) => {
                options.set_attribute_quantization(id as i32, i32::from(grid.bits));
                // The encoder takes its grid from all values, and two that no vertex has say which.
                values.extend(grid.origin.iter().flat_map(|o| o.to_le_bytes()));
                let end = |(k, o): (usize, &f32)| if k == 0 { o + grid.range } else { *o };
                values.extend(grid.origin.iter().enumerate().map(end).flat_map(|v| v.to_le_bytes()));
                patches.push(patch(grid, &values));
            }
        }
        let held = values.len() / input.raw.element_size;
        let mut attribute = PointAttribute::new();
        let (kind, multiplicity) = (kind(&input.name, &input.raw), input.raw.kind.multiplicity());
        attribute.init(kind, multiplicity as u8, data_type(input.raw.component_type), input.raw.normalized, held);
        attribute.buffer_mut().write(0, &values);
        mesh.add_attribute(attribute);
    }
    mesh.set_num_faces(triangles.len());
    for (index, triangle) in triangles.iter().enumerate() {
        mesh.set_face(FaceIndex(index as u32), triangle.map(PointIndex));
    }
    let mut encoder = MeshEncoder::new();
    encoder.set_mesh(mesh);
    let mut buffer = EncoderBuffer::new();
    encoder.encode(&options, &mut buffer).map_err(|e| e.message().to_owned())?;
    let mut stream = buffer.data().to_vec();
    for (found, wanted) in patches.iter().filter(|(found, wanted)| found != wanted) {
        // The range of the decoded values is that of the source but for their rounding.
        let places: Vec<usize> =
            (0..stream.len().saturating_sub(found.len() - 1)).filter(|at| stream[*at..].starts_with(found)).collect();
        let [at] = places[..] else { return Err("its grid is not found in the stream".to_owned()) };
        stream[at..at + wanted.len()].copy_from_slice(wanted);
    }
    read_again(stream, inputs, triangles, in_order)
}

/// The parameters of a grid as the encoder writes them, and as they are to be.
fn patch(grid: &Grid, values: &[u8]) -> (Vec<u8>, Vec<u8>) {
    let values: Vec<f32> = values.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let (low, high) = super::grid::bounds(&values, grid.origin.len());
    let range = low.iter().zip(&high).map(|(l, h)| h - l).fold(0.0, f32::max);
    let bytes = |origin: &[f32], range: f32| {
        let mut bytes: Vec<u8> = origin.iter().chain([&range]).flat_map(|v| v.to_le_bytes()).collect();
        bytes.push(grid.bits);
        bytes
    };
    (bytes(&low, range), bytes(&grid.origin, grid.range))
}

fn kind(name: &str, raw: &RawAccessor) -> GeometryAttributeType {
    match name {
        "POSITION" => GeometryAttributeType::Position,
        // What is not made octahedral predicts badly as a normal, or not at all.
        "NORMAL" if raw.component_type == ComponentType::F32 => GeometryAttributeType::Normal,
        _ if name.starts_with("TEXCOORD_") => GeometryAttributeType::TexCoord,
        _ if name.starts_with("COLOR_") => GeometryAttributeType::Color,
        _ => GeometryAttributeType::Generic,
    }
}

fn data_type(component: ComponentType) -> DataType {
    match component {
        ComponentType::I8 => DataType::Int8,
        ComponentType::U8 => DataType::Uint8,
        ComponentType::I16 => DataType::Int16,
        ComponentType::U16 => DataType::Uint16,
        ComponentType::U32 => DataType::Uint32,
        ComponentType::F32 => DataType::Float32,
    }
}

/// Decodes a stream and compares every triangle, to the bit, with what was to be delivered. Those with two corners at one place, of which nothing is
/// drawn, may be left out.
fn read_again(stream: Vec<u8>, inputs: &[Input], triangles: &[[u32; 3]], in_order: bool) -> Result<Encoded, String> {
    let mut mesh = Mesh::new();
    MeshDecoder::new().decode(&mut DecoderBuffer::new(&stream), &mut mesh).map_err(|e| e.message().to_owned())?;
    let mut attributes = Vec::with_capacity(inputs.len());
    for (id, input) in inputs.iter().enumerate() {
        let RawAccessor { component_type, kind, normalized, .. } = input.raw;
        let layout = AccessorLayout {
            component_type,
            kind,
            normalized,
            count: mesh.num_points(),
            view: None,
            offset: 0,
            sparse: None,
        };
        attributes.push(attribute(&mesh, id as u32, &layout)?);
    }
    let wide = mesh.num_points() > 0xFFFF;
    let indices = indices(&mesh, if wide { ComponentType::U32 } else { ComponentType::U16 })?;
    let faces = indices.unsigned().unwrap_or_default();
    let (faces, _) = faces.as_chunks::<3>();
    let wanted: Vec<RawAccessor> = inputs.iter().map(delivered).collect();
    if faces.len() > triangles.len() || sum(&wanted, triangles) != sum(&attributes, faces) {
        return Err("the stream does not give its triangles again".to_owned());
    }
    if in_order && wanted.iter().zip(&attributes).any(|(a, b)| a.data != b.data) {
        return Err("its vertices would change their order".to_owned());
    }
    let dropped = triangles.len() - faces.len();
    Ok(Encoded { stream, attributes, indices, dropped })
}

/// What readers make of an attribute.
fn delivered(input: &Input) -> RawAccessor {
    let floats = input.raw.data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
    let values: Vec<f32> = match &input.quantization {
        Quantization::Lossless => return input.raw.clone(),
        Quantization::Grid(grid) => floats.enumerate().map(|(n, v)| grid.delivered(n % grid.origin.len(), v)).collect(),
        Quantization::Octahedral(bits) => {
            let floats: Vec<f32> = floats.collect();
            floats.as_chunks::<3>().0.iter().flat_map(|v| delivered_vector(*bits, *v)).collect()
        }
    };
    RawAccessor { data: values.iter().flat_map(|v| v.to_le_bytes()).collect(), ..input.raw.clone() }
}

/// The number of triangles with three corners at different places, and a sum over them of what their corners hold, whatever the order of triangles and
/// vertices and whichever corner is the first. The first attribute is the positions.
fn sum(attributes: &[RawAccessor], triangles: &[[u32; 3]]) -> (usize, u64) {
    let count = attributes.first().map_or(0, |a| a.count);
    let (mut vertices, mut places) = (vec![0u64; count], Vec::new());
    for (n, raw) in attributes.iter().enumerate() {
        for (vertex, element) in vertices.iter_mut().zip(raw.data.chunks_exact(raw.element_size)) {
            let mut all = mix(*vertex);
            match raw.component_type {
                // -0 and 0 are one.
                ComponentType::F32 => element.as_chunks::<4>().0.iter().for_each(|b| {
                    all = mix(all ^ u64::from((f32::from_le_bytes(*b) + 0.0).to_bits()));
                }),
                _ => element.iter().for_each(|b| all = mix(all ^ u64::from(*b))),
            }
            *vertex = all;
        }
        if n == 0 {
            places = vertices.clone();
        }
    }
    let at = |of: &[u64], v: u32| of.get(v as usize).copied().unwrap_or_default();
    let (mut number, mut total) = (0, 0u64);
    for t in triangles {
        let [a, b, c] = t.map(|v| at(&places, v));
        if a == b || b == c || c == a {
            continue;
        }
        number += 1;
        let [a, b, c] = t.map(|v| at(&vertices, v));
        let turned = |[a, b, c]: [u64; 3]| mix(mix(mix(a) ^ b) ^ c);
        for turn in [[a, b, c], [b, c, a], [c, a, b]] {
            total = total.wrapping_add(turned(turn));
        }
    }
    (number, total)
}

/// Whether an accessor of this shape may lie in a stream.
pub(in crate::asset) fn is_carried(kind: Kind) -> bool {
    matches!(kind, Kind::Scalar | Kind::Vec2 | Kind::Vec3 | Kind::Vec4)
}
