//! Small documents made by code, for the tests of this room.

use image::{Rgb, RgbImage};
use serde_json::{Value, json};

use super::document::Merging;
use super::{ARRAY_BUFFER, Document, RawAccessor};
use crate::texture::{Alpha, Coding, Format, Header, Role, Wrap, encode};
use crate::texture::{Reading, Slot};

/// A base-colour slot that repeats.
pub(crate) fn slot(image: usize, size: [u32; 2]) -> Slot {
    Slot {
        image,
        role: Role::BaseColor,
        name: "base_color".to_owned(),
        header: Header { width: size[0], height: size[1], channels: 3, depth: 8, format: Format::Png },
        block: 1,
        readings: vec![Reading { wrap: [Wrap::Repeat; 2], primitives: vec![0] }],
        mipmaps: true,
        alpha: Alpha::Opaque,
        primitives: vec![0],
        exempt: false,
    }
}

/// A PNG of one colour.
pub(crate) fn png(width: u32, height: u32) -> Vec<u8> {
    encode(&RgbImage::from_pixel(width, height, Rgb([100; 3])).into(), &Coding::Png).unwrap()
}

/// A document without meshes: images of the sizes given, a texture for each, a material "m" that reads texture 0
/// as its base colour.
pub(crate) fn document(images: &[[u32; 2]]) -> Document {
    let mut json = json!({ "asset": { "version": "2.0" }, "materials": [{ "name": "m" }] });
    if !images.is_empty() {
        json["images"] = images.iter().map(|_| json!({ "mimeType": "image/png", "extras": 7 })).collect();
        json["textures"] = (0..images.len()).map(|i| json!({ "source": i })).collect();
        json["materials"][0]["pbrMetallicRoughness"] = json!({ "baseColorTexture": { "index": 0 } });
    }
    let images = images.iter().map(|[w, h]| Some(png(*w, *h))).collect();
    Document {
        json,
        buffers: Vec::new(),
        images,
        name: "model".to_owned(),
        merging: Merging::default(),
        tile: None,
        undefined: Default::default(),
        origins: Default::default(),
        compressed: None,
    }
}

/// Appends a vertex attribute.
pub(crate) fn attribute<const N: usize>(doc: &mut Document, values: &[[f32; N]]) -> usize {
    doc.append_accessor(&RawAccessor::from_floats(values), Some(ARRAY_BUFFER), false)
}

/// A primitive with material 0. Attributes by name, indices where there are any.
pub(crate) fn primitive(doc: &mut Document, attributes: &[(&str, usize)], indices: &[u32]) -> Value {
    let mut primitive = json!({ "attributes": {}, "material": 0 });
    for (name, accessor) in attributes {
        primitive["attributes"][*name] = Value::from(*accessor);
    }
    if !indices.is_empty() {
        primitive["indices"] = Value::from(doc.append_accessor(&RawAccessor::from_indices(indices), None, false));
    }
    primitive
}

/// Appends a mesh.
pub(crate) fn mesh(doc: &mut Document, primitives: Vec<Value>) {
    doc.push("meshes", json!({ "primitives": primitives }));
}

/// Two triangles of the plane z = 0 that share vertex 0 and no edge, u = x and v = 1 - y: two charts.
pub(crate) fn bowtie(doc: &mut Document) -> Value {
    let places = [[0.5, 0.5], [0.25, 0.75], [0.25, 0.25], [0.75, 0.25], [0.75, 0.75]];
    let positions = attribute(doc, &places.map(|[x, y]| [x, y, 0.0]));
    let normals = attribute(doc, &[[0.0, 0.0, 1.0]; 5]);
    let uvs = attribute(doc, &places.map(|[x, y]| [x, 1.0 - y]));
    primitive(doc, &[("POSITION", positions), ("NORMAL", normals), ("TEXCOORD_0", uvs)], &[0, 1, 2, 0, 3, 4])
}
