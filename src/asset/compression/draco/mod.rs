//! Draco streams, read by the crate `draco-core`: Rust without `unsafe`, which decodes bit for bit as Google's library.
//!
//! A stream is decoded on a thread of its own. Memory is bounded before by what the accessors declare; should the
//! decoder panic, the thread alone ends; should it not come to an end, nobody waits for it.

mod encode;
mod grid;

use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use draco_core::{DataType, DecodeLimits, DecoderBuffer, ErrorKind, Mesh, MeshDecoder, PointAttribute, PointIndex};

use crate::asset::accessor::RawAccessor;
use crate::asset::accessor_layout::{AccessorLayout, kind_name};
use crate::asset::{ComponentType, Kind};
use crate::error::{Failure, Result};

pub(in crate::asset) use encode::{Encoded, Input, encode, is_carried};
pub(in crate::asset) use grid::{Grid, Quantization, bounds, common_exponent};

/// How often cancellation is looked for.
const TICK: Duration = Duration::from_millis(20);
/// Ticks after which a stream is given up: three minutes, where twenty million triangles take some ten seconds.
const PATIENCE: usize = 9000;
/// Stack of a decoding thread, in bytes: metadata may nest a thousand deep.
const STACK: usize = 16 << 20;

/// What a stream may become.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    /// Number of triangles.
    pub(super) faces: u64,
    /// Bytes of all vertex attributes.
    pub(super) bytes: u64,
}

/// Decodes a stream within the first bounds, which its accessors declare; should it hold more than these, within the others.
///
/// # Errors
/// `invalid_model` for a broken stream or one beyond the bounds, and what `check` says.
pub(super) fn decode(stream: &[u8], [declared, most]: [Bounds; 2], check: &dyn Fn() -> Result<()>) -> Result<Mesh> {
    let (sender, receiver) = mpsc::channel();
    let stream = stream.to_vec();
    let work = move || {
        let decoded = read(&stream, declared).or_else(|failure| match failure {
            (ErrorKind::LimitExceeded, _) => read(&stream, most),
            other => Err(other),
        });
        // Nobody listens any more where the job was cancelled.
        let _ = sender.send(decoded.map_err(|(_, failure)| failure));
    };
    let thread = thread::Builder::new().name("draco".to_owned()).stack_size(STACK).spawn(work);
    thread.map_err(|e| Failure::internal(format!("no thread to decode on: {e}")))?;
    for _ in 0..PATIENCE {
        match receiver.recv_timeout(TICK) {
            Ok(decoded) => return decoded,
            Err(RecvTimeoutError::Timeout) => check()?,
            Err(RecvTimeoutError::Disconnected) => return Err(Failure::model("the Draco stream breaks its decoder")),
        }
    }
    Err(Failure::model("the Draco stream takes more than three minutes to decode"))
}

fn read(stream: &[u8], bounds: Bounds) -> std::result::Result<Mesh, (ErrorKind, Failure)> {
    let limits = DecodeLimits::default().with_max_faces(bounds.faces).with_max_decoded_bytes(bounds.bytes);
    let mut mesh = Mesh::new();
    let decoded = MeshDecoder::new().decode(&mut DecoderBuffer::new(stream).with_limits(limits), &mut mesh);
    decoded.map_err(|e| {
        let failure = Failure::model(match e.kind() {
            ErrorKind::LimitExceeded => format!("the Draco stream holds more than its accessors: {}", e.message()),
            _ => format!("the Draco stream is broken: {}", e.message()),
        });
        (e.kind(), failure)
    })?;
    Ok(mesh)
}

/// The triangles' indices, in the type that the accessor has, or a wider one where that is too narrow.
///
/// # Errors
/// An accessor that holds no indices, in words.
pub(super) fn indices(mesh: &Mesh, component: ComponentType) -> std::result::Result<RawAccessor, String> {
    let most = match component {
        ComponentType::U8 => u32::from(u8::MAX),
        ComponentType::U16 => u32::from(u16::MAX),
        ComponentType::U32 => u32::MAX,
        _ => return Err("indices have componentType 5121, 5123 or 5125".to_owned()),
    };
    let values: Vec<u32> = mesh.faces().iter().flatten().map(|point| point.0).collect();
    let fits = values.iter().all(|value| *value <= most);
    Ok(RawAccessor::from_unsigned(if fits { component } else { ComponentType::U32 }, Kind::Scalar, &values))
}

/// The values of a vertex attribute by vertex, in the accessor's type.
///
/// # Errors
/// What does not fit, in words.
pub(super) fn attribute(mesh: &Mesh, id: u32, accessor: &AccessorLayout) -> std::result::Result<RawAccessor, String> {
    let found = mesh.attribute_by_unique_id(id).ok_or_else(|| format!("the Draco stream has no attribute {id}"))?;
    let components = usize::from(found.num_components());
    let packed = accessor.element_size() == components * accessor.component_type.size();
    if components != accessor.kind.multiplicity() || !packed {
        let kind = kind_name(accessor.kind);
        return Err(format!("the Draco attribute has {components} components, and its accessor is a {kind}"));
    }
    let size = components * found.data_type().byte_length();
    let stride = usize::try_from(found.byte_stride()).unwrap_or(0).max(size);
    let mut data = Vec::with_capacity(mesh.num_points() * accessor.element_size());
    for point in 0..mesh.num_points() {
        let value = found.mapped_index(PointIndex(point as u32)).0 as usize;
        let start = value.checked_mul(stride);
        let bytes = start.and_then(|start| found.buffer().data().get(start..start.checked_add(size)?));
        let bytes = bytes.ok_or("the Draco attribute has fewer values than the stream has vertices")?;
        convert(found, bytes, accessor.component_type, &mut data)?;
    }
    Ok(RawAccessor::new(accessor.component_type, accessor.kind, accessor.normalized, data))
}

/// How an attribute lies in its stream.
pub(super) fn quantization(mesh: &Mesh, id: u32, stream: &[u8]) -> Quantization {
    mesh.attribute_by_unique_id(id).map_or(Quantization::Lossless, |found| grid::quantization(found, stream))
}

/// Appends one value in the accessor's type: its bits where the types are the same, its number where they are not.
fn convert(
    attribute: &PointAttribute,
    bytes: &[u8],
    to: ComponentType,
    out: &mut Vec<u8>,
) -> std::result::Result<(), &'static str> {
    let from = attribute.data_type();
    let same = matches!(
        (from, to),
        (DataType::Int8, ComponentType::I8)
            | (DataType::Uint8 | DataType::Bool, ComponentType::U8)
            | (DataType::Int16, ComponentType::I16)
            | (DataType::Uint16, ComponentType::U16)
            | (DataType::Uint32, ComponentType::U32)
            | (DataType::Float32, ComponentType::F32)
    );
    if same {
        out.extend_from_slice(bytes);
        return Ok(());
    }
    for component in bytes.chunks_exact(from.byte_length().max(1)) {
        let (value, greatest) =
            number(from, component).ok_or("the Draco attribute's type is none that an accessor has")?;
        let cast =
            |least: f64, most: f64| (value.fract() == 0.0 && (least..=most).contains(&value)).then_some(value as i64);
        let whole = match to {
            ComponentType::F32 => {
                let value = if attribute.normalized() { value / greatest } else { value };
                out.extend((value as f32).to_le_bytes());
                continue;
            }
            ComponentType::I8 => cast(-128.0, 127.0),
            ComponentType::U8 => cast(0.0, 255.0),
            ComponentType::I16 => cast(-32768.0, 32767.0),
            ComponentType::U16 => cast(0.0, 65535.0),
            ComponentType::U32 => cast(0.0, 4_294_967_295.0),
        };
        let whole = whole.ok_or("a value of the Draco attribute does not fit the accessor's componentType")?;
        out.extend_from_slice(whole.to_le_bytes().get(..to.size()).unwrap_or_default());
    }
    Ok(())
}

/// A component as a number, and what stands for 1 in its type.
fn number(from: DataType, bytes: &[u8]) -> Option<(f64, f64)> {
    Some(match (from, bytes) {
        (DataType::Int8, [a]) => (f64::from(*a as i8), 127.0),
        (DataType::Uint8, [a]) => (f64::from(*a), 255.0),
        (DataType::Bool, [a]) => (f64::from(*a), 1.0),
        (DataType::Int16, [a, b]) => (f64::from(i16::from_le_bytes([*a, *b])), 32767.0),
        (DataType::Uint16, [a, b]) => (f64::from(u16::from_le_bytes([*a, *b])), 65535.0),
        (DataType::Int32, bytes) => (f64::from(i32::from_le_bytes(bytes.try_into().ok()?)), 2_147_483_647.0),
        (DataType::Uint32, bytes) => (f64::from(u32::from_le_bytes(bytes.try_into().ok()?)), 4_294_967_295.0),
        (DataType::Float32, bytes) => (f64::from(f32::from_le_bytes(bytes.try_into().ok()?)), 1.0),
        (DataType::Float64, bytes) => (f64::from_le_bytes(bytes.try_into().ok()?), 1.0),
        _ => return None,
    })
}
