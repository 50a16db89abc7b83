//! Attributes and morph targets for the vertices of a pool: copied bit by bit, interpolated where a face was split.

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use super::blend::{copied, extend, interpolated, nearest, plain, unit, wide};
use super::skin::influences;
use super::vertices::Vertices;
use crate::asset::ComponentType;
use crate::asset::Document;
use crate::asset::accessor::{RawAccessor, accessor_shape, raw_elements, read_vec};
use crate::asset::append::ARRAY_BUFFER;
use crate::asset::json::{array, checked};
use crate::error::{Code, Failure, Result};

/// More appended bytes than a GLB can hold are refused before they are made.
const MOST_BYTES: u64 = u32::MAX as u64;

/// A primitive's attributes after refinement.
#[derive(Debug, Clone)]
pub(super) struct Attributes {
    /// The `attributes` object.
    pub(super) attributes: Value,
    /// The `targets` array, where there is one.
    pub(super) targets: Option<Value>,
}

/// Appends what the vertices of a pool need and gives the attributes that name it. `value` is the primitive as
/// uploaded, `layout` the numbers of the TEXCOORD set that was refined and of the one that is written.
///
/// # Errors
/// `invalid_model` for attributes whose counts differ, `too_large` beyond what a GLB can hold.
pub(super) fn emit(
    doc: &Document,
    out: &mut Document,
    value: &Value,
    pointer: &str,
    vertices: &Vertices,
    layout: [usize; 2],
) -> Result<Attributes> {
    let empty = Map::new();
    let attributes = value.get("attributes").and_then(Value::as_object).unwrap_or(&empty);
    let mut emitter = Emitter { doc, out, vertices, split: vertices.any_split(), frame: None };
    if vertices.any_turn() {
        emitter.frame = emitter.frame(attributes, pointer)?;
    }
    let mut skin = BTreeMap::new();
    if emitter.split {
        let checked = |name: &str, accessor: &Value| emitter.checked(accessor, &format!("{pointer}/attributes/{name}"));
        skin = influences(attributes, &vertices.appended, checked, doc)?;
    }
    let all = !vertices.appended.is_empty();
    let written = format!("TEXCOORD_{}", layout[1]);
    let source = format!("TEXCOORD_{}", layout[0]);
    let mut fresh = Map::new();
    let mut old_uvs = Vec::new();
    for (name, accessor) in attributes {
        let at = format!("{pointer}/attributes/{name}");
        if *name == source {
            old_uvs = read_vec::<2>(doc, emitter.checked(accessor, &at)?)?;
        }
        let mut new = accessor.clone();
        if *name != written && (all || (name == "TANGENT" && emitter.frame.is_some())) {
            let accessor = emitter.checked(accessor, &at)?;
            let raw = match skin.remove(name) {
                Some(raw) => raw,
                None => emitter.attribute(name, accessor)?,
            };
            new = emitter.append(&raw, name == "POSITION", Some(accessor));
        }
        fresh.insert(name.clone(), new);
    }
    if let Some(tangents) = emitter.made_tangents(attributes, pointer)? {
        fresh.insert("TANGENT".to_owned(), tangents);
    }
    fresh.insert(written, emitter.uvs(&old_uvs));
    let targets = match value.get("targets") {
        Some(targets) if all || emitter.frame.is_some() => Some(emitter.targets(targets, pointer, all)?),
        other => other.cloned(),
    };
    Ok(Attributes { attributes: Value::Object(fresh), targets })
}

/// What tangents turn about, by vertex of the pool.
struct TangentFrame {
    normals: Vec<[f32; 3]>,
    /// TANGENT.w as uploaded.
    hands: Vec<f32>,
}

struct Emitter<'a> {
    doc: &'a Document,
    out: &'a mut Document,
    vertices: &'a Vertices,
    /// Whether any vertex lies between uploaded ones.
    split: bool,
    /// Where tangents turn: with NORMAL and TANGENT both.
    frame: Option<TangentFrame>,
}

impl Emitter<'_> {
    /// An accessor's index, once it is known to have one element for each vertex and its copy to be small enough.
    fn checked(&self, value: &Value, at: &str) -> Result<usize> {
        let accessor = checked(value, array(&self.doc.json, "accessors").len(), || at.to_owned())?;
        let shape = accessor_shape(self.doc, accessor)?;
        let count = self.vertices.uvs.len() - self.vertices.appended.len();
        if shape.count != count {
            let text = format!("the attribute has {} elements, POSITION has {count}", shape.count);
            return Err(Failure::model(text).at(at));
        }
        // Floats at the most.
        let size = 4 * shape.kind.multiplicity() as u64;
        let held = self.out.buffers.first().map_or(0, |b| b.len() as u64);
        if held.saturating_add(size.saturating_mul(self.vertices.uvs.len() as u64)) > MOST_BYTES {
            return Err(Failure::new(Code::TooLarge, "the refined vertices are more than a GLB can hold").at(at));
        }
        Ok(accessor)
    }

    /// Appends an accessor; `source` is the one that it was made of.
    fn append(&mut self, raw: &RawAccessor, bounds: bool, source: Option<usize>) -> Value {
        let accessor = self.out.append_accessor(raw, Some(ARRAY_BUFFER), bounds);
        if let Some(source) = source {
            self.out.origins.derive(accessor, source);
        }
        Value::from(accessor)
    }

    fn frame(&self, attributes: &Map<String, Value>, pointer: &str) -> Result<Option<TangentFrame>> {
        let (Some(normal), Some(tangent)) = (attributes.get("NORMAL"), attributes.get("TANGENT")) else {
            return Ok(None);
        };
        let normals = self.normals(self.checked(normal, &format!("{pointer}/attributes/NORMAL"))?)?;
        let tangent = self.checked(tangent, &format!("{pointer}/attributes/TANGENT"))?;
        let mut hands: Vec<f32> = read_vec::<4>(self.doc, tangent)?.iter().map(|t| t[3]).collect();
        for point in &self.vertices.appended {
            hands.push(hands.get(nearest(point) as usize).copied().unwrap_or(1.0));
        }
        Ok(Some(TangentFrame { normals, hands }))
    }

    /// NORMAL of every vertex of the pool.
    fn normals(&self, accessor: usize) -> Result<Vec<[f32; 3]>> {
        let mut normals = read_vec(self.doc, accessor)?;
        extend(&mut normals, &self.vertices.appended, unit);
        Ok(normals)
    }

    fn uvs(&mut self, old: &[[f32; 2]]) -> Value {
        let uvs = self.vertices.uvs.iter().enumerate();
        let values: Vec<[f32; 2]> = uvs
            .map(|(i, uv)| uv.or_else(|| old.get(i).copied()).unwrap_or_default())
            .map(|uv| uv.map(|x| if x.is_finite() { x } else { 0.0 }))
            .collect();
        self.append(&RawAccessor::from_floats(&values), false, None)
    }

    /// An attribute other than joints and weights, for every vertex of the pool.
    fn attribute(&self, name: &str, accessor: usize) -> Result<RawAccessor> {
        match name {
            "NORMAL" if self.split => Ok(RawAccessor::from_floats(&self.normals(accessor)?)),
            "TANGENT" if self.split || self.frame.is_some() => self.tangents(accessor),
            _ => self.other(name, accessor),
        }
    }

    /// Elements copied, or interpolated where some vertex lies between others; plain integers of the user's own
    /// attributes are names more often than amounts, and always copied, as are the ids of batches and features whatever their type.
    fn other(&self, name: &str, accessor: usize) -> Result<RawAccessor> {
        let shape = accessor_shape(self.doc, accessor)?;
        let is_id = name == "_BATCHID" || name.starts_with("_FEATURE_ID_");
        let amount = !name.starts_with('_') || shape.normalized || shape.component_type == ComponentType::F32;
        let amount = amount && !is_id;
        let points = &self.vertices.appended;
        if self.split && amount {
            interpolated(self.doc, accessor, shape.kind, points)
        } else {
            Ok(copied(raw_elements(self.doc, accessor)?, points))
        }
    }

    /// TANGENT of every vertex: interpolated, and turned with its faces.
    fn tangents(&self, accessor: usize) -> Result<RawAccessor> {
        let mut tangents = read_vec::<4>(self.doc, accessor)?;
        extend(&mut tangents, &self.vertices.appended, |v| {
            let [x, y, z] = unit([v[0], v[1], v[2]]);
            [x, y, z, if v[3] < 0.0 { -1.0 } else { 1.0 }]
        });
        for (i, tangent) in tangents.iter_mut().enumerate() {
            let [x, y, z, w] = *tangent;
            let [x, y, z] = self.turned(i, [x, y, z]);
            let mirrored = self.vertices.turns.get(i).is_some_and(|t| t.mirrored) && self.frame.is_some();
            *tangent = [x, y, z, if mirrored { -w } else { w }];
        }
        Ok(RawAccessor::from_floats(&tangents))
    }

    /// TANGENT where it was not uploaded and charts were cut or joined: that of the uploaded layout, turned.
    fn made_tangents(&mut self, attributes: &Map<String, Value>, pointer: &str) -> Result<Option<Value>> {
        let Some(normal) = attributes.get("NORMAL").filter(|_| self.vertices.has_tangents()) else { return Ok(None) };
        let normals = self.normals(self.checked(normal, &format!("{pointer}/attributes/NORMAL"))?)?;
        let made = self.vertices.tangents.iter().zip(&self.vertices.turns).zip(&normals);
        let tangents: Vec<[f32; 4]> = made
            .map(|((tangent, turn), normal)| {
                let [x, y, z, w] = tangent.unwrap_or([1.0, 0.0, 0.0, 1.0]);
                let turned = turn.apply(wide([x, y, z]), f64::from(w), wide(*normal));
                let [x, y, z] = unit(turned.to_array());
                [x, y, z, if turn.mirrored { -w } else { w }]
            })
            .collect();
        Ok(Some(self.append(&RawAccessor::from_floats(&tangents), false, None)))
    }

    /// A tangent, or a morph target's step of one, turned with the faces of vertex `i`.
    fn turned(&self, i: usize, tangent: [f32; 3]) -> [f32; 3] {
        let Some(frame) = &self.frame else { return tangent };
        match (self.vertices.turns.get(i), frame.normals.get(i), frame.hands.get(i)) {
            (Some(turn), Some(normal), Some(w)) if !turn.is_none() => {
                plain(turn.apply(wide(tangent), f64::from(*w), wide(*normal)).to_array())
            }
            _ => tangent,
        }
    }

    fn targets(&mut self, targets: &Value, pointer: &str, all: bool) -> Result<Value> {
        let mut fresh = Vec::new();
        for (i, target) in targets.as_array().into_iter().flatten().enumerate() {
            let mut new = Map::new();
            for (name, value) in target.as_object().into_iter().flatten() {
                let turned = name == "TANGENT" && self.frame.is_some();
                let mut replaced = value.clone();
                if all || turned {
                    let accessor = self.checked(value, &format!("{pointer}/targets/{i}/{name}"))?;
                    let raw = if turned { self.steps(accessor)? } else { self.other(name, accessor)? };
                    replaced = self.append(&raw, name == "POSITION", Some(accessor));
                }
                new.insert(name.clone(), replaced);
            }
            fresh.push(Value::Object(new));
        }
        Ok(Value::Array(fresh))
    }

    /// A morph target's steps of TANGENT turn as the tangents do: turning is linear.
    fn steps(&self, accessor: usize) -> Result<RawAccessor> {
        let mut steps = read_vec::<3>(self.doc, accessor)?;
        extend(&mut steps, &self.vertices.appended, plain);
        let steps: Vec<[f32; 3]> = steps.iter().enumerate().map(|(i, step)| self.turned(i, *step)).collect();
        Ok(RawAccessor::from_floats(&steps))
    }
}
