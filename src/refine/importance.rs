//! How much each part of the surface matters: weights from a vertex attribute, a picture or the materials' names.
//!
//! A weight of 1 is ordinary, 100 matters a hundred times as much, 0 not at all. Values in 0..=1 (colours, pictures) are
//! spread over 1..=100, as w = 1 + 99 v; an attribute of floats with any value above 1 holds weights already, and all
//! its values are taken as they are.
//!
//! All stages take a weight for what a unit of length of a cut costs there, at an edge the mean of its ends.

use std::collections::{BTreeMap, BTreeSet};

use image::DynamicImage;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::openapi::schema::{AdditionalProperties, ObjectBuilder, OneOfBuilder, Type};
use utoipa::openapi::{Ref, RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::erased::NamedSchemas;
use crate::asset::{self, ComponentType, Document, File, Kind, Limits, PrimitiveRef, TextureSet};
use crate::atlas::Provenance;
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};
use crate::params::{Problem, child, listed, near_or_all, short};
use crate::texture::{Wrap, decode, texel};

/// Weight of what the source says nothing of.
const ORDINARY: f64 = 1.0;
/// What a value of 1 adds to the weight of a value of 0.
const SPAN: f64 = 99.0;

/// Where weights come from: 1 is ordinary, 100 matters a hundred times as much, 0 not at all.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImportanceSource {
    /// A vertex attribute and its component (r, g, b, a or x, y, z, w), such as `COLOR_0.r`: floats or normalised integers. Values
    /// in 0..=1 are the weights 1..=100; where any value is above 1, all are taken as they are. Primitives without it weigh 1.
    Attribute(String),
    /// A file that comes with the model, read at the uploaded texture coordinates (repeated): its first channel, linear,
    /// 0..=1, is the weights 1..=100.
    Texture(String),
    /// Weights by the materials' names, each at least 0; the others weigh 1.
    Materials(BTreeMap<String, f64>),
}

/// A schema with a name, because generators of clients stumble over one inside the others.
const MATERIAL_WEIGHTS: &str = "MaterialWeights";

/// By hand: what can be derived knows neither bounds nor that there is one key only.
impl PartialSchema for ImportanceSource {
    fn schema() -> RefOr<Schema> {
        let text = || ObjectBuilder::new().schema_type(Type::String);
        let attribute = text().pattern(Some(r"^.+\.[rgbaxyzw]$")).description(Some(
            "A vertex attribute and its component, such as `COLOR_0.r`: floats or normalised integers. Values in 0..=1 are the weights \
             1..=100; where any value is above 1, all are taken as they are. Primitives without it weigh 1.",
        ));
        let texture = text().min_length(Some(1)).description(Some(
            "A file that comes with the model, read at the uploaded texture coordinates (repeated): its first channel, linear, 0..=1, \
             is the weights 1..=100.",
        ));
        let mut weights = Ref::from_schema_name(MATERIAL_WEIGHTS);
        weights.description = "Weights by the materials' names; the others weigh 1.".to_owned();
        let closed = AdditionalProperties::<Schema>::FreeForm(false);
        let only = |title: &str, key: &str, value: RefOr<Schema>| {
            let object = ObjectBuilder::new().title(Some(title)).property(key, value).required(key);
            object.additional_properties(Some(closed.clone()))
        };
        OneOfBuilder::new()
            .item(only("ImportanceByAttribute", "attribute", attribute.into()))
            .item(only("ImportanceByTexture", "texture", texture.into()))
            .item(only("ImportanceByMaterials", "materials", weights.into()))
            .description(Some(
                "Where weights come from: 1 is ordinary, 100 matters a hundred times as much, 0 not at all.",
            ))
            .into()
    }
}

impl ToSchema for ImportanceSource {
    fn schemas(schemas: &mut NamedSchemas) {
        let weight = ObjectBuilder::new().schema_type(Type::Number).minimum(Some(0));
        let weights = ObjectBuilder::new().additional_properties(Some(weight));
        schemas.push((MATERIAL_WEIGHTS.to_owned(), weights.into()));
    }
}

impl ImportanceSource {
    /// What its type allows and that makes no sense, for the source at `pointer`.
    pub fn problems(&self, pointer: &str) -> Vec<Problem> {
        match self {
            ImportanceSource::Attribute(name) if attribute_and_component(name).is_none() => {
                let text = format!("`{}` is not an attribute and a component, such as COLOR_0.r", short(name));
                vec![Problem::new(child(pointer, "attribute"), text)]
            }
            ImportanceSource::Texture(name) if name.is_empty() => {
                let text = "`texture` is the name of a file that comes with the model";
                vec![Problem::new(child(pointer, "texture"), text)]
            }
            ImportanceSource::Materials(weights) => {
                let wrong = weights.iter().filter(|(_, weight)| !weight.is_finite() || **weight < 0.0);
                let problem = |(name, weight): (&String, &f64)| {
                    let text = format!("the weight of `{}` is {weight}; it is at least 0", short(name));
                    Problem::new(child(&child(pointer, "materials"), name), text)
                };
                wrong.map(problem).collect()
            }
            _ => Vec::new(),
        }
    }
}

/// Weights at the corners of every uploaded face of an Atlas.
#[derive(Debug, Clone, PartialEq)]
pub struct Importance {
    /// By source face, in the order of its corners; finite and at least 0.
    corners: Vec<[f64; 3]>,
}

impl Importance {
    /// The weights at the corners of a face, whole or cut: interpolated in its source. A source that is not there is ordinary.
    pub fn at(&self, provenance: &Provenance) -> [f64; 3] {
        let [a, b, c] = self.corners.get(provenance.source.index()).copied().unwrap_or([ORDINARY; 3]);
        provenance.barycentric.map(|w| (a * w.x + b * w.y + c * w.z).max(0.0))
    }

    /// The weights of several Atlases joined in this order.
    pub(super) fn join<'a>(parts: impl IntoIterator<Item = &'a Importance>) -> Self {
        Importance { corners: parts.into_iter().flat_map(|p| p.corners.iter().copied()).collect() }
    }

    /// Least and greatest weight; none without faces.
    pub fn range(&self) -> Option<[f64; 2]> {
        let all = || self.corners.iter().flatten().copied();
        Some([all().reduce(f64::min)?, all().reduce(f64::max)?])
    }
}

/// A texture set, where it comes from, and the files that came with its model.
#[derive(Clone, Copy)]
pub(super) struct Subject<'a> {
    pub doc: &'a Document,
    pub files: &'a [File],
    pub set: &'a TextureSet,
}

/// The weights of each texture set, in the order of `subjects`.
///
/// # Errors
/// `invalid_options` at the name that nothing in the job has, or where the attribute is of the wrong kind;
/// `invalid_model` at an accessor with values that are negative or not finite; `invalid_image`, `too_large`; `canceled`.
pub(super) fn importances(
    source: &ImportanceSource,
    subjects: &[Subject<'_>],
    limits: &Limits,
    context: &Context,
) -> Result<Vec<Importance>> {
    match source {
        ImportanceSource::Attribute(name) => from_attribute(name, subjects, context),
        ImportanceSource::Texture(name) => from_texture(name, subjects, limits, context),
        ImportanceSource::Materials(weights) => from_materials(weights, subjects),
    }
}

/// An attribute's name and the index of the component that is read, from `COLOR_0.r`; none where the text is something else.
fn attribute_and_component(text: &str) -> Option<(&str, usize)> {
    let (name, component) = text.rsplit_once('.')?;
    let index = match component {
        "r" | "x" => 0,
        "g" | "y" => 1,
        "b" | "z" => 2,
        "a" | "w" => 3,
        _ => return None,
    };
    (!name.is_empty()).then_some((name, index))
}

fn from_attribute(text: &str, subjects: &[Subject<'_>], context: &Context) -> Result<Vec<Importance>> {
    let at = "/importance/attribute";
    let wrong = |message: String| Failure::new(Code::InvalidOptions, message).at(at);
    let (name, component) = attribute_and_component(text)
        .ok_or_else(|| wrong(format!("`{text}` is not an attribute and a component, such as COLOR_0.r")))?;
    // By set and face; none where the primitive has no such attribute.
    let mut raw: Vec<Vec<Option<[f64; 3]>>> = Vec::new();
    let mut are_weights = false;
    for subject in subjects {
        let mut faces = vec![None; subject.set.atlas.face_count()];
        for primitive in &subject.set.primitives {
            context.check()?;
            let Some(values) = attribute_values(subject.doc, primitive, name, component).map_err(|e| match e.code {
                Code::InvalidOptions => e.at(at),
                _ => e,
            })?
            else {
                continue;
            };
            are_weights |= values.iter().any(|v| *v > 1.0);
            for (face, corners) in faces.iter_mut().skip(primitive.first_face).zip(&primitive.corners) {
                *face = Some(corners.map(|v| values.get(v as usize).copied().unwrap_or(0.0)));
            }
        }
        raw.push(faces);
    }
    if raw.iter().flatten().all(Option::is_none) {
        return Err(wrong(format!("no primitive that is refined has an attribute `{name}`; {}", attributes(subjects))));
    }
    for (subject, faces) in subjects.iter().zip(&raw) {
        for primitive in &subject.set.primitives {
            if faces.get(primitive.first_face).is_some_and(Option::is_none) {
                let text = format!(
                    "the primitive has no attribute `{name}`: its weight is {ORDINARY}, as anything ordinary (give it the attribute if parts of it matter more)"
                );
                let pointer = format!("/meshes/{}/primitives/{}", primitive.mesh, primitive.primitive);
                context.warn(Warning::new("importance_missing", text).at(pointer));
            }
        }
    }
    let weight = |v: f64| if are_weights { v } else { spread(v) };
    let of = |face: &Option<[f64; 3]>| face.map_or([ORDINARY; 3], |values| values.map(weight));
    Ok(raw.iter().map(|faces| Importance { corners: faces.iter().map(of).collect() }).collect())
}

/// One component of an attribute by glTF vertex; none where the primitive has no such attribute.
fn attribute_values(
    doc: &Document,
    primitive: &PrimitiveRef,
    name: &str,
    component: usize,
) -> Result<Option<Vec<f64>>> {
    let pointer = format!("/meshes/{}/primitives/{}/attributes", primitive.mesh, primitive.primitive);
    let Some(value) = doc.json.pointer(&pointer).and_then(|a| a.get(name)) else { return Ok(None) };
    let accessor = value.as_u64().and_then(|n| usize::try_from(n).ok());
    let accessor = accessor.ok_or_else(|| Failure::model("an accessor's index is expected here").at(&*pointer))?;
    let shape = asset::accessor_shape(doc, accessor)?;
    if shape.component_type != ComponentType::F32 && !shape.normalized {
        let message = format!("`{name}` holds plain integers; weights are floats or normalised integers");
        return Err(Failure::new(Code::InvalidOptions, message));
    }
    fn nth<const N: usize>(doc: &Document, accessor: usize, n: usize) -> Result<Vec<f64>> {
        let values = asset::read_vec::<N>(doc, accessor)?;
        Ok(values.iter().filter_map(|v| v.get(n).map(|x| f64::from(*x))).collect())
    }
    let values = match shape.kind {
        Kind::Scalar => nth::<1>(doc, accessor, component)?,
        Kind::Vec2 => nth::<2>(doc, accessor, component)?,
        Kind::Vec3 => nth::<3>(doc, accessor, component)?,
        Kind::Vec4 => nth::<4>(doc, accessor, component)?,
        Kind::Mat2 | Kind::Mat3 | Kind::Mat4 => Vec::new(),
    };
    if values.is_empty() && shape.count > 0 {
        let message =
            format!("`{name}` is a {}, which has no component number {}", asset::kind_name(shape.kind), component + 1);
        return Err(Failure::new(Code::InvalidOptions, message));
    }
    if let Some(bad) = values.iter().position(|v| !v.is_finite() || *v < 0.0) {
        let text = format!("element {bad} of {name} is {}, no weight: weights are finite and at least 0", values[bad]);
        return Err(Failure::model(text).at(format!("/accessors/{accessor}")));
    }
    Ok(Some(values))
}

fn from_texture(name: &str, subjects: &[Subject<'_>], limits: &Limits, context: &Context) -> Result<Vec<Importance>> {
    let at = "/importance/texture";
    let mut found = None;
    for subject in subjects {
        found = asset::side_file(subject.files, name, limits)?;
        if found.is_some() {
            break;
        }
    }
    let bytes = found.ok_or_else(|| {
        Failure::new(
            Code::InvalidOptions,
            format!("no file `{name}` came with the model: send it along, as a further file"),
        )
        .at(at)
    })?;
    let image = decode(&bytes, limits.max_image_pixels).map_err(|f| f.at(at))?;
    let mut all = Vec::new();
    for subject in subjects {
        context.check()?;
        let atlas = &subject.set.atlas;
        if !atlas.has_layout() {
            let text = format!(
                "{} has no texture coordinates to read weights at: its weight is {ORDINARY}, as anything ordinary (weights by attribute or material need none)",
                subject.set.name
            );
            context.warn(Warning::new("importance_missing", text).at(at));
            all.push(Importance { corners: vec![[ORDINARY; 3]; atlas.face_count()] });
            continue;
        }
        let size = subject.set.reference.map(|n| f64::from(n.max(1)));
        let weights =
            |corners: [glam::DVec2; 3]| corners.map(|uv| spread(first_channel(&image, uv / glam::DVec2::from(size))));
        all.push(Importance { corners: atlas.faces().map(|f| weights(atlas.uv_triangle(f))).collect() });
    }
    Ok(all)
}

/// The first channel (red, or grey) at a point in units of the image, which repeats; bilinear, in 0..=1.
fn first_channel(image: &DynamicImage, uv: glam::DVec2) -> f64 {
    let size = [i64::from(image.width()), i64::from(image.height())];
    let p = uv.rem_euclid(glam::DVec2::ONE) * glam::DVec2::new(size[0] as f64, size[1] as f64) - 0.5;
    let base = p.floor();
    let t = p - base;
    let value = |dx: i64, dy: i64| {
        let x = Wrap::Repeat.texel(base.x as i64 + dx, size[0]);
        let y = Wrap::Repeat.texel(base.y as i64 + dy, size[1]);
        texel(image, x as u32, y as u32)[0]
    };
    let row = |dy: i64| value(0, dy) * (1.0 - t.x) + value(1, dy) * t.x;
    row(0) * (1.0 - t.y) + row(1) * t.y
}

/// The attributes that weights could be read from, in words.
fn attributes(subjects: &[Subject<'_>]) -> String {
    let of = |subject: &Subject<'_>, p: &PrimitiveRef| {
        let pointer = format!("/meshes/{}/primitives/{}/attributes", p.mesh, p.primitive);
        let found = subject.doc.json.pointer(&pointer).and_then(Value::as_object);
        found.into_iter().flat_map(|all| all.keys().cloned()).collect::<Vec<_>>()
    };
    let all = subjects.iter().flat_map(|s| s.set.primitives.iter().flat_map(move |p| of(s, p)));
    let all: BTreeSet<String> = all.collect();
    listed(&all.iter().map(String::as_str).collect::<Vec<_>>())
}

fn from_materials(weights: &BTreeMap<String, f64>, subjects: &[Subject<'_>]) -> Result<Vec<Importance>> {
    let mut known: Vec<String> = Vec::new();
    for subject in subjects {
        let count = subject.doc.json.get("materials").and_then(Value::as_array).map_or(0, Vec::len);
        known.extend((0..count).map(|m| material_name(subject.doc, m)));
    }
    for (name, weight) in weights {
        let at = format!("/importance/materials/{}", name.replace('~', "~0").replace('/', "~1"));
        let wrong = |message: String| Err(Failure::new(Code::InvalidOptions, message).at(&*at));
        if !known.contains(name) {
            let names: Vec<&str> = known.iter().map(String::as_str).collect();
            let hint = near_or_all(name, &names);
            return wrong(format!("no material is called `{name}`; {hint}"));
        }
        if !weight.is_finite() || *weight < 0.0 {
            return wrong(format!("the weight of `{name}` is {weight}; weights are finite and at least 0"));
        }
    }
    let of_set = |subject: &Subject<'_>| {
        let mut corners = vec![[ORDINARY; 3]; subject.set.atlas.face_count()];
        for primitive in &subject.set.primitives {
            let name = primitive.material.map(|m| material_name(subject.doc, m));
            let weight = name.and_then(|n| weights.get(&n).copied()).unwrap_or(ORDINARY);
            corners.iter_mut().skip(primitive.first_face).take(primitive.face_count).for_each(|c| *c = [weight; 3]);
        }
        Importance { corners }
    };
    Ok(subjects.iter().map(of_set).collect())
}

/// A material's name, or `material N` where it has none.
pub(super) fn material_name(doc: &Document, material: usize) -> String {
    let name = doc.json.pointer(&format!("/materials/{material}/name")).and_then(Value::as_str);
    name.map_or_else(|| format!("material {material}"), str::to_owned)
}

fn spread(value: f64) -> f64 {
    ORDINARY + SPAN * value
}

#[cfg(test)]
mod tests;
