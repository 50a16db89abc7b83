//! OBJ faces as glTF primitives: triangles over vertices that are unique corners, in order of first use.

use std::collections::HashMap;

use glam::DVec3;
use serde_json::{Value, json};

use super::parse::{Corner, Face, NONE, ObjGeometry};
use super::polygon::Triangulator;
use crate::asset::append::{ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER};
use crate::asset::{Document, RawAccessor};
use crate::error::Warning;
use crate::texture::srgb_to_linear;

/// One primitive.
#[derive(Debug, Default)]
pub(crate) struct Part {
    /// Index into the OBJ's material names, or [`NONE`].
    pub(crate) material: u32,
    positions: Vec<[f32; 3]>,
    colors: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    indices: Vec<u32>,
    /// Normals without a direction that a face's own stands in for.
    replaced: usize,
    /// Vertex of each corner. Only asked, never walked: its order is nobody's.
    known: HashMap<Corner, u32>,
}

/// Builds the primitives: one for each material and kind of corner, in order of first use.
pub(crate) fn build(geometry: &ObjGeometry, warnings: &mut Vec<Warning>) -> Vec<Part> {
    let mut parts: Vec<Part> = Vec::new();
    let mut by_key: HashMap<(u32, bool, bool), usize> = HashMap::new();
    let mut triangulator = Triangulator::default();
    let mut points = Vec::new();
    let mut triangles = Vec::new();
    let mut vertices = Vec::new();
    for face in &geometry.faces {
        let corners = geometry.corners_of(face);
        let has = |slot: usize| corners.iter().all(|c| c.get(slot).is_some_and(|i| *i != NONE));
        let (textured, smooth) = (has(1), has(2));
        let key = (face.material, textured, smooth);
        let index = *by_key.entry(key).or_insert(parts.len());
        if index == parts.len() {
            parts.push(Part { material: face.material, ..Part::default() });
        }
        let Some(part) = parts.get_mut(index) else { continue };
        triangles.clear();
        if corners.len() == 3 {
            triangles.push([0, 1, 2]);
        } else {
            points.clear();
            points.extend(corners.iter().map(|c| position(geometry, c)));
            triangulator.triangulate(&points, &mut triangles);
        }
        vertices.clear();
        vertices.extend(corners.iter().map(|&[v, t, n]| {
            let corner = [v, if textured { t } else { NONE }, if smooth { n } else { NONE }];
            part.vertex(geometry, corner, face)
        }));
        let corner = |k: &u32| vertices.get(*k as usize).copied().unwrap_or(0);
        part.indices.extend(triangles.iter().flatten().map(corner));
    }
    let replaced: usize = parts.iter().map(|p| p.replaced).sum();
    if replaced > 0 {
        let message = format!("{replaced} vertices with a normal of no direction or NaN take the normal of a face");
        warnings.push(Warning::new("invalid_normals_replaced", message));
    }
    if triangulator.given_up > 0 {
        let message = format!("{} large concave polygons are cut into fans, which may overlap", triangulator.given_up);
        warnings.push(Warning::new("polygons_fanned", message));
    }
    parts
}

impl Part {
    /// Whether it has texture coordinates.
    pub(crate) fn has_uvs(&self) -> bool {
        !self.uvs.is_empty()
    }

    /// The vertex of a corner, made at its first use.
    fn vertex(&mut self, geometry: &ObjGeometry, corner: Corner, face: &Face) -> u32 {
        let next = self.positions.len() as u32;
        let index = *self.known.entry(corner).or_insert(next);
        if index < next {
            return index;
        }
        let [v, t, n] = corner.map(|i| i as usize);
        self.positions.push(geometry.positions.get(v).copied().unwrap_or_default());
        if !geometry.colors.is_empty() {
            // Positions after the last coloured one have no entry.
            self.colors.push(geometry.colors.get(v).copied().unwrap_or([1.0; 3]));
        }
        if corner[1] != NONE {
            let [u, v] = geometry.uvs.get(t).copied().unwrap_or_default();
            self.uvs.push([u, 1.0 - v]);
        }
        if corner[2] != NONE {
            let normal = geometry.normals.get(n).copied().unwrap_or_default();
            self.normals.push(unit(normal).unwrap_or_else(|| {
                self.replaced += 1;
                face_normal(geometry, face)
            }));
        }
        index
    }

    /// Appends the primitive's accessors to a document; gives its JSON. A material with a base colour map drops vertex
    /// colours: OBJ programs show the map alone, and glTF would multiply.
    pub(crate) fn write(
        self,
        doc: &mut Document,
        material: Option<usize>,
        textured: bool,
        warnings: &mut Vec<Warning>,
    ) -> Value {
        let mut attributes = json!({});
        let mut add = |name: &str, floats: RawAccessor| {
            attributes[name] = json!(doc.append_accessor(&floats, Some(ARRAY_BUFFER), name == "POSITION"));
        };
        add("POSITION", RawAccessor::from_floats(&self.positions));
        if !self.normals.is_empty() {
            add("NORMAL", RawAccessor::from_floats(&self.normals));
        }
        if !self.uvs.is_empty() {
            add("TEXCOORD_0", RawAccessor::from_floats(&self.uvs));
        }
        if !self.colors.is_empty() && textured {
            let message = "vertex colours beside a colour map are dropped: the map is meant alone";
            let warning = Warning::new("vertex_colors_dropped", message);
            // Primitives that follow one another say it once.
            if warnings.last() != Some(&warning) {
                warnings.push(warning);
            }
        } else if !self.colors.is_empty() {
            add("COLOR_0", RawAccessor::from_floats(&linear(&self.colors)));
        }
        let indices = RawAccessor::from_indices(&self.indices);
        let indices = doc.append_accessor(&indices, Some(ELEMENT_ARRAY_BUFFER), false);
        let mut primitive = json!({ "attributes": attributes, "indices": indices });
        if let Some(material) = material {
            primitive["material"] = json!(material);
        }
        primitive
    }
}

/// OBJ vertex colours are sRGB, of 0..1 or of 0..255; glTF's are linear.
fn linear(colors: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let bytes = colors.iter().flatten().any(|c| *c > 1.0);
    let scale = if bytes { 255.0 } else { 1.0 };
    let decode = |c: f32| srgb_to_linear((f64::from(c) / scale).clamp(0.0, 1.0)) as f32;
    colors.iter().map(|c| c.map(decode)).collect()
}

fn position(geometry: &ObjGeometry, corner: &Corner) -> DVec3 {
    let found = geometry.positions.get(corner[0] as usize).copied().unwrap_or_default();
    DVec3::from_array(found.map(f64::from))
}

/// A normal of length 1; none where it has no direction.
fn unit(normal: [f32; 3]) -> Option<[f32; 3]> {
    let normal = DVec3::from_array(normal.map(f64::from)).try_normalize()?;
    Some(normal.to_array().map(|v| v as f32))
}

fn face_normal(geometry: &ObjGeometry, face: &Face) -> [f32; 3] {
    let corners = geometry.corners_of(face);
    let [a, b, c] = [0, 1, 2].map(|k| corners.get(k).map_or(DVec3::ZERO, |c| position(geometry, c)));
    (b - a).cross(c - a).try_normalize().unwrap_or(DVec3::Z).to_array().map(|v| v as f32)
}
