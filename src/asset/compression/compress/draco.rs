//! Primitives into Draco streams.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use rayon::prelude::*;
use serde_json::{Map, Value, json};

use super::{CompressedView, CompressedViews, push};
use crate::asset::accessor::{RawAccessor, raw_elements, read_indices};
use crate::asset::accessor_layout::accessor;
use crate::asset::append::set_bounds;
use crate::asset::compression::draco::{
    Encoded, Grid, Input, Quantization, bounds, common_exponent, encode, is_carried,
};
use crate::asset::compression::origin::{StreamOrigin, hash};
use crate::asset::extensions::DRACO;
use crate::asset::json::{array, list, number, object};
use crate::asset::primitive::primitive_pointer;
use crate::asset::{ComponentType, Document};
use crate::context::Context;
use crate::error::{Result, Warning};

/// Bits of positions that came uncompressed, over the longest side of their mesh.
const POSITION_BITS: i32 = 14;
/// Bits of normals that came uncompressed.
const NORMAL_BITS: u8 = 10;
/// Steps between 0 and 1, as a power of two: colours, weights and tangents that came uncompressed.
const COLOR_EXPONENT: i32 = -8;
const WEIGHT_EXPONENT: i32 = -12;
const TANGENT_EXPONENT: i32 = -11;
/// The same of texture coordinates: half a step is a quarter of a texel on a sheet of 16,384.
const TEXCOORD_EXPONENT: i32 = -15;

/// A primitive that is compressed.
struct Job<'a> {
    /// By mesh and number: those that are alike but for their materials.
    places: Vec<(usize, usize)>,
    /// Name and accessor.
    attributes: Vec<(String, usize)>,
    indices: Option<usize>,
    /// Whether something outside the stream goes with its vertices.
    in_order: bool,
    /// Whether it came in a stream.
    came: bool,
    origin: Option<&'a StreamOrigin>,
}

/// What a primitive becomes.
enum Done {
    /// It is as it came.
    Kept(Arc<[u8]>),
    Encoded(Vec<String>, Box<Encoded>),
    /// Why it stays as it is.
    Left(String),
}

/// Compresses the primitives that came compressed, or `all`.
///
/// # Errors
/// `invalid_model` for a broken primitive, `canceled`.
pub(super) fn compress(document: &Document, all: bool, out: &mut CompressedViews, context: &Context) -> Result<()> {
    let mut jobs: BTreeMap<String, Job<'_>> = BTreeMap::new();
    for (mesh, value) in list(&document.json, "meshes")?.iter().enumerate() {
        for (index, primitive) in array(value, "primitives").iter().enumerate() {
            let positions = primitive.pointer("/attributes/POSITION").and_then(number);
            let came = positions.is_some_and(|accessor| document.origins.quantization(accessor).is_some());
            if !(all || came) {
                continue;
            }
            match job(document, primitive, came) {
                Ok((key, job)) => jobs.entry(key).or_insert(job).places.push((mesh, index)),
                Err(why) => context.warn(left(came, mesh, index, &why)),
            }
        }
    }
    // In the order of the document.
    let mut jobs: Vec<Job<'_>> = jobs.into_values().collect();
    jobs.sort_by(|a, b| a.places.cmp(&b.places));
    let done: Vec<Result<Done>> = jobs
        .par_iter()
        .map(|job| {
            context.check()?;
            run(document, job)
        })
        .collect();
    let mut carried = Vec::new();
    for (job, done) in jobs.iter().zip(done) {
        match done? {
            Done::Left(why) => job.places.iter().for_each(|(mesh, index)| {
                context.warn(left(job.came, *mesh, *index, &why));
            }),
            done => carried.push((job, done)),
        }
    }
    let places: BTreeSet<(usize, usize)> = carried.iter().flat_map(|(job, _)| &job.places).copied().collect();
    let plain = read_plain(&out.json, &places);
    // What streams filled needs no place of its own any more, whether something reads it or not.
    let filled = document.origins.attributes.keys().copied().chain(document.origins.streams.iter().map(|s| s.indices));
    filled.filter(|accessor| !plain.contains(accessor)).for_each(|accessor| empty(out, accessor));
    for (job, done) in carried {
        let own_view = job.attributes.first().and_then(|(_, accessor)| document.origins.stream_view(*accessor));
        let (attributes, indices, view) = match done {
            Done::Left(_) => continue,
            Done::Kept(stream) => {
                let view = place(out, stream, own_view);
                let mut place =
                    |accessor: usize| if plain.contains(&accessor) { bare(out, accessor, None) } else { accessor };
                let origin = job.origin.into_iter().flat_map(|origin| &origin.attributes);
                let attributes: Vec<_> =
                    origin.map(|(name, accessor, id)| (name.clone(), place(*accessor), *id)).collect();
                (attributes, job.indices.map(place), view)
            }
            Done::Encoded(names, encoded) => {
                if encoded.dropped > 0 {
                    let text = format!(
                        "{} triangles with two corners at one place, of which nothing is drawn, are left out: Draco does not carry them",
                        encoded.dropped
                    );
                    for (mesh, index) in &job.places {
                        context.warn(
                            Warning::new("degenerate_faces_dropped", text.clone()).at(primitive_pointer(*mesh, *index)),
                        );
                    }
                }
                let view = place(out, encoded.stream.into(), own_view);
                let mut attributes = Vec::new();
                for (id, (name, raw)) in names.into_iter().zip(&encoded.attributes).enumerate() {
                    let accessor =
                        job.attributes.iter().find(|(own, _)| *own == name).map_or(0, |(_, accessor)| *accessor);
                    attributes.push((name, bare(out, accessor, Some(raw)), id as u32));
                }
                let indices = match job.indices {
                    Some(accessor) => bare(out, accessor, Some(&encoded.indices)),
                    None => {
                        let RawAccessor { component_type, count, .. } = encoded.indices;
                        push(
                            &mut out.json,
                            "accessors",
                            json!({ "componentType": component_type, "count": count, "type": "SCALAR" }),
                        )
                    }
                };
                (attributes, Some(indices), view)
            }
        };
        let ids: Map<String, Value> = attributes.iter().map(|(name, _, id)| (name.clone(), Value::from(*id))).collect();
        for (mesh, index) in &job.places {
            let pointer = primitive_pointer(*mesh, *index);
            let Some(primitive) = out.json.pointer_mut(&pointer) else { continue };
            for (name, accessor, _) in &attributes {
                primitive["attributes"][name.as_str()] = Value::from(*accessor);
            }
            if let Some(indices) = indices {
                primitive["indices"] = Value::from(indices);
            }
            primitive["extensions"][DRACO] = json!({ "bufferView": view, "attributes": ids });
        }
    }
    Ok(())
}

/// Says that a primitive, which `came` in a stream or not, is written without one.
fn left(came: bool, mesh: usize, index: usize, why: &str) -> Warning {
    let message = format!("the primitive is written uncompressed, because Draco cannot carry it: {why}");
    Warning::new(if came { "decompressed" } else { "not_compressed" }, message).at(primitive_pointer(mesh, index))
}

/// A buffer view of a stream: the one that it came in, or that whose stream it replaces, where that is not taken by another.
fn place(out: &mut CompressedViews, stream: Arc<[u8]>, own: Option<usize>) -> usize {
    let object = json!({ "buffer": 0, "byteLength": stream.len() });
    let view = match own.map(|view| (view, out.views.get(&view))) {
        Some((view, Some(taken))) if taken.bytes == stream => view,
        Some((view, None)) => {
            out.json["bufferViews"][view] = object;
            view
        }
        _ => push(&mut out.json, "bufferViews", object),
    };
    out.views.insert(view, CompressedView { bytes: stream, extension: None });
    view
}

/// Accessors that something reads which no stream holds.
fn read_plain(json: &Value, carried: &BTreeSet<(usize, usize)>) -> BTreeSet<usize> {
    let mut plain = BTreeSet::new();
    for (mesh, value) in array(json, "meshes").iter().enumerate() {
        for (index, primitive) in array(value, "primitives").iter().enumerate() {
            let targets = array(primitive, "targets").iter().filter_map(Value::as_object).flat_map(|t| t.values());
            plain.extend(targets.filter_map(number));
            if !carried.contains(&(mesh, index)) {
                let attributes = object(primitive, "attributes").into_iter().flat_map(|a| a.values());
                plain.extend(attributes.chain(primitive.get("indices")).filter_map(number));
            }
        }
    }
    let samplers = array(json, "animations").iter().flat_map(|animation| array(animation, "samplers"));
    plain.extend(samplers.flat_map(|s| [s.get("input"), s.get("output")]).flatten().filter_map(number));
    plain.extend(array(json, "skins").iter().filter_map(|skin| skin.get("inverseBindMatrices")).filter_map(number));
    plain
}

/// Takes an accessor's contents away: a stream holds them.
fn empty(out: &mut CompressedViews, accessor: usize) {
    let fields = out.json["accessors"].get_mut(accessor).and_then(Value::as_object_mut);
    for fields in fields.into_iter() {
        ["bufferView", "byteOffset", "sparse"].into_iter().for_each(|key| drop(fields.shift_remove(key)));
    }
}

/// A copy of an accessor without contents: a stream holds them. With `raw` it has the length and the bounds of that.
fn bare(out: &mut CompressedViews, accessor: usize, raw: Option<&RawAccessor>) -> usize {
    let mut object = array(&out.json, "accessors").get(accessor).cloned().unwrap_or_else(|| json!({}));
    if let Some(raw) = raw {
        object["count"] = Value::from(raw.count);
        object["componentType"] = Value::from(raw.component_type.as_gl_enum());
        if object.get("min").is_some() || object.get("max").is_some() {
            set_bounds(&mut object, raw);
        }
    }
    let copy = push(&mut out.json, "accessors", object);
    empty(out, copy);
    copy
}

/// What is to be done for a primitive, and what names those with the same vertices and triangles.
fn job<'a>(document: &'a Document, primitive: &Value, came: bool) -> std::result::Result<(String, Job<'a>), String> {
    if primitive.get("mode").is_some_and(|mode| mode.as_u64() != Some(4)) {
        return Err("it is no list of triangles".to_owned());
    }
    let mut attributes = Vec::new();
    for (name, value) in object(primitive, "attributes").into_iter().flatten() {
        let index = number(value).ok_or("an attribute of it is broken")?;
        let layout = accessor(&document.json, index).map_err(|e| e.message)?;
        if !is_carried(layout.kind) {
            return Err(format!("{name} is a matrix"));
        }
        attributes.push((name.clone(), index));
    }
    // What others are predicted from comes first.
    attributes.sort_by_key(|(name, _)| name != "POSITION");
    if attributes.first().is_none_or(|(name, _)| name != "POSITION") {
        return Err("it has no POSITION".to_owned());
    }
    let indices = primitive.get("indices").and_then(number);
    let in_order = !array(primitive, "targets").is_empty();
    let origin = document.origins.streams.iter().find(|origin| {
        let own =
            |(name, accessor): &(String, usize)| origin.attributes.iter().any(|(n, a, _)| n == name && a == accessor);
        Some(origin.indices) == indices && origin.attributes.len() == attributes.len() && attributes.iter().all(own)
    });
    let key = format!("{attributes:?}{indices:?}{in_order}");
    Ok((key, Job { places: Vec::new(), attributes, indices, in_order, came, origin }))
}

fn run(document: &Document, job: &Job<'_>) -> Result<Done> {
    if let Some(origin) = job.origin {
        let own = origin.attributes.iter().map(|(_, accessor, _)| *accessor).chain([origin.indices]);
        let raw = own.map(|accessor| raw_elements(document, accessor)).collect::<Result<Vec<_>>>()?;
        if hash(raw.iter()) == origin.hash {
            return Ok(Done::Kept(origin.stream.clone()));
        }
    }
    let mut inputs = Vec::new();
    for (name, accessor) in &job.attributes {
        let raw = raw_elements(document, *accessor)?;
        let quantization = match quantization(document, name, *accessor, &raw) {
            Ok(quantization) => quantization,
            Err(why) => return Ok(Done::Left(why)),
        };
        inputs.push(Input { name: name.clone(), raw, quantization });
    }
    let count = inputs.first().map_or(0, |i| i.raw.count);
    let mut corners = match job.indices {
        Some(accessor) => read_indices(document, accessor)?,
        None => (0..u32::try_from(count).unwrap_or(u32::MAX)).collect(),
    };
    corners.truncate(corners.len() / 3 * 3);
    if !job.in_order {
        compact(&mut inputs, &mut corners);
    }
    Ok(match encode(&inputs, corners.as_chunks().0, job.in_order) {
        Ok(encoded) => Done::Encoded(inputs.into_iter().map(|i| i.name).collect(), Box::new(encoded)),
        Err(why) => Done::Left(why),
    })
}

/// Leaves the vertices that triangles have, in the order in which they have them.
fn compact(inputs: &mut [Input], corners: &mut [u32]) {
    let count = inputs.first().map_or(0, |i| i.raw.count);
    let mut places = vec![u32::MAX; count];
    let mut order = Vec::new();
    for corner in corners.iter_mut() {
        let Some(place) = places.get_mut(*corner as usize) else { continue };
        if *place == u32::MAX {
            *place = order.len() as u32;
            order.push(*corner as usize);
        }
        *corner = *place;
    }
    for Input { raw, .. } in inputs {
        let size = raw.element_size;
        let element = |v: &usize| raw.data.get(v * size..(v + 1) * size).unwrap_or_default();
        raw.data = order.iter().flat_map(element).copied().collect();
        raw.count = order.len();
    }
}

/// How an attribute is to lie in a stream.
fn quantization(
    document: &Document,
    name: &str,
    accessor: usize,
    raw: &RawAccessor,
) -> std::result::Result<Quantization, String> {
    if raw.component_type != ComponentType::F32 {
        return Ok(Quantization::Lossless);
    }
    let values: Vec<f32> = raw.data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    if values.iter().any(|v| !v.is_finite()) {
        return Err(format!("{name} holds what is no number"));
    }
    let (low, high) = bounds(&values, raw.kind.multiplicity());
    let grid = |grid: Option<Grid>| grid.map_or(Quantization::Lossless, Quantization::Grid);
    match document.origins.quantization(accessor) {
        Some(Quantization::Grid(source)) => return Ok(grid(source.holding(&low, &high))),
        Some(known) => return Ok(known.clone()),
        None => {}
    }
    let of_power = |exponent: i32| grid(Grid::dyadic(&low, &high, exponent));
    let is_new = document.origins.decoded.is_some_and(|[accessors, _]| accessor >= accessors);
    Ok(match name {
        "POSITION" => {
            let extent =
                extent_of_mesh(document, accessor).max(low.iter().zip(&high).map(|(l, h)| h - l).fold(0.0, f32::max));
            // Primitives of one mesh have one grid, so that no crack opens between them.
            let exponent = (f64::from(extent) / (2f64.powi(POSITION_BITS) - 1.0)).log2().floor();
            if exponent.is_finite() { of_power(exponent as i32) } else { Quantization::Lossless }
        }
        "NORMAL" => Quantization::Octahedral(NORMAL_BITS),
        "TANGENT" => of_power(TANGENT_EXPONENT),
        // What was refined lies on the grid of its sheet, and comes back to the bit.
        _ if name.starts_with("TEXCOORD_") && is_new => {
            common_exponent(values.iter().copied()).map_or(Quantization::Lossless, of_power)
        }
        _ if name.starts_with("TEXCOORD_") => of_power(TEXCOORD_EXPONENT),
        _ if name.starts_with("COLOR_") => of_power(COLOR_EXPONENT),
        _ if name.starts_with("WEIGHTS_") => of_power(WEIGHT_EXPONENT),
        // The user's own: what it means is not known.
        _ => Quantization::Lossless,
    })
}

/// The longest side of the mesh with a primitive that has these positions, as its accessors tell; 0 where they do not.
fn extent_of_mesh(document: &Document, accessor: usize) -> f32 {
    let accessors = array(&document.json, "accessors");
    let positions = |mesh: &Value| -> Vec<usize> {
        array(mesh, "primitives").iter().filter_map(|p| p.pointer("/attributes/POSITION").and_then(number)).collect()
    };
    let Some(own) = array(&document.json, "meshes").iter().map(positions).find(|p| p.contains(&accessor)) else {
        return 0.0;
    };
    let bound = |key: &str, axis: usize, pick: fn(f64, f64) -> f64| {
        let of = |a: &usize| accessors.get(*a)?.get(key)?.get(axis)?.as_f64();
        own.iter().filter_map(of).reduce(pick).unwrap_or(0.0)
    };
    let sides = (0..3).map(|axis| bound("max", axis, f64::max) - bound("min", axis, f64::min));
    sides.fold(0.0, f64::max) as f32
}
