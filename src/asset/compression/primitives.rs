//! Primitives with a Draco stream.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Deserialize;
use serde_json::{Map, Value};

use super::draco::{self, Bounds};
use super::origin::{StreamOrigin, hash};
use super::{extension, remove_extension};
use crate::asset::accessor::RawAccessor;
use crate::asset::accessor_layout::{self, AccessorLayout};
use crate::asset::append::{ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, set_bounds};
use crate::asset::extensions::{DRACO, undeclare};
use crate::asset::json::{array, each_mut, list, number, object, read, read_key};
use crate::asset::limits::{Budget, Limits};
use crate::asset::{ComponentType, Document, Kind};
use crate::error::{Code, Failure, Result, Warning};

/// Bytes that the attributes of one vertex may take in a stream: it may hold more than the primitive names.
const MOST_VERTEX_BYTES: u64 = 1024;

/// Triangles that a byte of a stream may hold at most, where the accessors declare fewer than there are: encoders need a bit for each, and less only
/// for the plainest of grids.
const MOST_FACES_PER_BYTE: u64 = 64;

/// The extension of a primitive.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Stream {
    buffer_view: usize,
    attributes: Map<String, Value>,
}

/// A compressed primitive.
struct Job {
    mesh: usize,
    primitive: usize,
    /// JSON pointer of the extension.
    pointer: String,
    /// Buffer view of the stream.
    view: usize,
    /// Name, accessor and number in the stream of each attribute.
    attributes: Vec<(String, usize, u32)>,
    /// AccessorLayout of the indices.
    indices: Option<usize>,
    /// Accessors of attributes and morph targets outside the stream, whose elements go with those inside.
    outside: Vec<usize>,
}

/// What fills an accessor: a buffer view and an attribute's number in it, or its indices.
type Filler = (usize, Option<u32>);

/// Decodes every compressed primitive into the accessors that it names. One that has other contents too, because another
/// primitive shares it or because it is there uncompressed as well, is left alone, and the primitive gets its own.
///
/// # Errors
/// `invalid_model` with a pointer for a broken extension or stream, or one that holds more than the accessors declare;
/// `unsupported_extension` for anything but triangles; `too_large` beyond the limits; and what `check` says.
pub(crate) fn primitives(
    document: &mut Document,
    limits: &Limits,
    budget: &mut Budget,
    warnings: &mut Vec<Warning>,
    check: &dyn Fn() -> Result<()>,
) -> Result<()> {
    let jobs = jobs(&document.json, warnings)?;
    let mut filled: BTreeMap<usize, Filler> = BTreeMap::new();
    for job in &jobs {
        check()?;
        decode(document, job, limits, budget, &mut filled, warnings, check)?;
    }
    for mesh in each_mut(&mut document.json, "meshes") {
        each_mut(mesh, "primitives").for_each(|primitive| remove_extension(primitive, DRACO));
    }
    undeclare(&mut document.json, DRACO);
    Ok(())
}

fn jobs(json: &Value, warnings: &mut Vec<Warning>) -> Result<Vec<Job>> {
    let mut jobs = Vec::new();
    for (mesh, object) in list(json, "meshes")?.iter().enumerate() {
        for (primitive, object) in array(object, "primitives").iter().enumerate() {
            let own = format!("/meshes/{mesh}/primitives/{primitive}");
            let Some(job) = job(object, &own, mesh, primitive)? else { continue };
            if object.get("mode").is_none_or(|mode| mode.as_u64() == Some(4)) {
                jobs.push(job);
                continue;
            }
            let message = "only triangles are read from Draco streams, and the mode of the primitive is another";
            let failure = Failure::new(Code::UnsupportedExtension, message).at(format!("{own}/mode"));
            if !job.is_there_uncompressed(json) {
                return Err(failure);
            }
            let message = format!("{message}: what is there uncompressed is taken");
            warnings.push(Warning::new("draco_ignored", message).at(own));
        }
    }
    Ok(jobs)
}

impl Job {
    /// Whether every accessor that the stream would fill has contents of its own.
    fn is_there_uncompressed(&self, json: &Value) -> bool {
        let mut accessors = self.attributes.iter().map(|(_, index, _)| *index).chain(self.indices);
        accessors.all(|index| accessor_layout::accessor(json, index).is_ok_and(|a| a.view.is_some()))
    }
}

fn job(value: &Value, own: &str, mesh: usize, primitive: usize) -> Result<Option<Job>> {
    let Some(stream) = extension::<Stream>(value, DRACO, own)? else { return Ok(None) };
    let pointer = format!("{own}/extensions/{DRACO}");
    let plain = value.get("attributes").unwrap_or(&Value::Null);
    let mut attributes = Vec::new();
    for (name, id) in &stream.attributes {
        let id = read(id, || format!("{pointer}/attributes/{name}"))?;
        let accessor = read_key(plain, name, &format!("{own}/attributes"))?.ok_or_else(|| {
            Failure::model(format!("{name} is compressed, and the primitive has no such attribute")).at(&*pointer)
        })?;
        attributes.push((name.clone(), accessor, id));
    }
    let indices = read_key(value, "indices", own)?;
    let own_names = object(value, "attributes").into_iter().flatten();
    let plain = own_names.filter(|(name, _)| !stream.attributes.contains_key(name.as_str()));
    let targets = array(value, "targets").iter().filter_map(Value::as_object).flatten();
    let outside = plain.chain(targets).filter_map(|(_, accessor)| number(accessor)).collect();
    Ok(Some(Job { mesh, primitive, pointer, view: stream.buffer_view, attributes, indices, outside }))
}

/// Decodes one primitive, and notes how it came.
fn decode(
    document: &mut Document,
    job: &Job,
    limits: &Limits,
    budget: &mut Budget,
    filled: &mut BTreeMap<usize, Filler>,
    warnings: &mut Vec<Warning>,
    check: &dyn Fn() -> Result<()>,
) -> Result<()> {
    let own = format!("/meshes/{}/primitives/{}", job.mesh, job.primitive);
    let accessor = |index: usize| accessor_layout::accessor(&document.json, index);
    let accessors = job.attributes.iter().map(|(_, index, _)| accessor(*index)).collect::<Result<Vec<_>>>()?;
    let indices = match job.indices {
        Some(index) => accessor(index)?,
        None => AccessorLayout {
            component_type: ComponentType::U32,
            kind: Kind::Scalar,
            normalized: false,
            count: usize::try_from(limits.max_triangles.saturating_mul(3)).unwrap_or(usize::MAX),
            view: None,
            offset: 0,
            sparse: None,
        },
    };
    let vertices = accessors.iter().map(|a| a.count).max().unwrap_or(0);
    let stream = document.view_bytes(job.view).map_err(|e| e.at(format!("{}/bufferView", job.pointer)))?;
    let most = (vertices.max(indices.count) as u64).saturating_mul(MOST_VERTEX_BYTES);
    let declared = Bounds { faces: indices.count as u64 / 3, bytes: most.min(limits.max_input_bytes) };
    // Accessors may declare fewer than there are: what the stream can hold by its length counts then.
    let faces = (stream.len() as u64).saturating_mul(MOST_FACES_PER_BYTE).min(limits.max_triangles);
    let bytes = faces.saturating_mul(3 * MOST_VERTEX_BYTES).min(limits.max_input_bytes);
    let held = Bounds { faces: faces.max(declared.faces), bytes: bytes.max(declared.bytes) };
    let stream: Arc<[u8]> = stream.into();
    let mesh = draco::decode(&stream, [declared, held], check).map_err(|e| match e.code {
        Code::Canceled => e,
        _ => e.at(job.pointer.clone()),
    })?;
    let (points, corners) = (mesh.num_points(), 3 * mesh.num_faces());
    let vertex: usize = accessors.iter().map(|a| a.element_size().next_multiple_of(4)).sum();
    budget.charge(points.saturating_mul(vertex).saturating_add(4 * corners), &job.pointer)?;
    // Encoders split vertices at seams and drop triangles, and not all of them write the new numbers down.
    if accessors.iter().any(|a| a.count != points) || (job.indices.is_some() && indices.count != corners) {
        let message = format!(
            "the Draco stream holds {points} vertices and {corners} indices, and the accessors declare {vertices} and {}",
            indices.count
        );
        // What stands outside has as many elements as the stream, or nobody knows which belongs to which.
        if job.outside.iter().any(|index| accessor(*index).is_ok_and(|a| a.count != points)) {
            return Err(Failure::model(message).at(job.pointer.clone()));
        }
        warnings.push(Warning::new("accessor_count_corrected", message).at(own.clone()));
    }

    let (mut attributes, mut filling) = (Vec::new(), Vec::new());
    for ((name, index, id), accessor) in job.attributes.iter().zip(&accessors) {
        let raw = draco::attribute(&mesh, *id, accessor).map_err(|why| mismatch(*index, name, &why))?;
        let bounds = name == "POSITION" || document.json["accessors"][*index].get("min").is_some();
        let place = fill(document, *index, &raw, ARRAY_BUFFER, bounds, (job.view, Some(*id)), filled);
        document.json["meshes"][job.mesh]["primitives"][job.primitive]["attributes"][name.as_str()] =
            Value::from(place);
        document.origins.attributes.entry(place).or_insert_with(|| draco::quantization(&mesh, *id, &stream));
        attributes.push((name.clone(), place, *id));
        filling.push(raw);
    }
    let raw = draco::indices(&mesh, indices.component_type).map_err(|why| match job.indices {
        Some(index) => mismatch(index, "indices", &why),
        None => Failure::model(why).at(own.clone()),
    })?;
    let place = match job.indices {
        Some(index) => {
            let bounds = document.json["accessors"][index].get("min").is_some();
            fill(document, index, &raw, ELEMENT_ARRAY_BUFFER, bounds, (job.view, None), filled)
        }
        None => document.append_accessor(&raw, Some(ELEMENT_ARRAY_BUFFER), false),
    };
    document.json["meshes"][job.mesh]["primitives"][job.primitive]["indices"] = Value::from(place);
    filling.push(raw);
    let hash = hash(filling.iter());
    let view = accessor_layout::view(&document.json, job.view)?;
    let range = [view.buffer, view.offset, view.offset + view.length];
    document.origins.streams.push(StreamOrigin { stream, attributes, indices: place, view: job.view, range, hash });
    Ok(())
}

fn mismatch(accessor: usize, name: &str, why: &str) -> Failure {
    Failure::model(format!("{name}: {why}")).at(format!("/accessors/{accessor}"))
}

/// Puts elements into an accessor that is empty, or into a copy of one that is not; gives its index.
fn fill(
    document: &mut Document,
    index: usize,
    raw: &RawAccessor,
    target: u32,
    bounds: bool,
    filler: Filler,
    filled: &mut BTreeMap<usize, Filler>,
) -> usize {
    if filled.get(&index) == Some(&filler) {
        return index;
    }
    let mut object = document.json["accessors"][index].clone();
    let view = document.append_elements(raw, Some(target));
    let taken = object.get("bufferView").is_some();
    if let Some(fields) = object.as_object_mut() {
        fields.shift_remove("byteOffset");
    }
    object["bufferView"] = Value::from(view);
    object["count"] = Value::from(raw.count);
    object["componentType"] = Value::from(raw.component_type.as_gl_enum());
    if bounds {
        set_bounds(&mut object, raw);
    }
    if taken {
        return document.push("accessors", object);
    }
    filled.insert(index, filler);
    document.json["accessors"][index] = object;
    index
}
