//! A glTF document in the making.

use glam::{DVec2, DVec3};
use serde_json::{Value, json};

use super::surface::Unwrapped;
use crate::asset::{ARRAY_BUFFER, Document, ELEMENT_ARRAY_BUFFER, RawAccessor};

/// A document with one scene.
pub(crate) struct Scene {
    /// The document.
    pub(crate) document: Document,
}

impl Scene {
    /// An empty scene.
    pub(crate) fn new(name: &str) -> Self {
        let json = json!({ "asset": { "version": "2.0", "generator": "intarsia sample" }, "scene": 0, "scenes": [{ "nodes": [] }] });
        let (buffers, images) = (Vec::new(), Vec::new());
        Scene {
            document: Document {
                json,
                buffers,
                images,
                name: name.to_owned(),
                merging: Default::default(),
                tile: None,
                undefined: Default::default(),
                origins: Default::default(),
                compressed: None,
            },
        }
    }

    /// Adds an object to a top-level array; gives its index.
    pub(crate) fn push(&mut self, key: &str, object: Value) -> usize {
        self.document.push(key, object)
    }

    /// Adds a node to the scene.
    pub(crate) fn root(&mut self, node: Value) -> usize {
        let index = self.push("nodes", node);
        if let Some(nodes) = self.document.json.pointer_mut("/scenes/0/nodes").and_then(Value::as_array_mut) {
            nodes.push(json!(index));
        }
        index
    }

    /// Adds a PNG as an image and a texture of it, repeating, with mipmaps; gives the texture's index.
    pub(crate) fn texture(&mut self, name: &str, png: Vec<u8>) -> usize {
        let image = self.push("images", json!({ "name": name, "mimeType": "image/png" }));
        self.document.images.push(Some(png));
        if self.document.json.get("samplers").is_none() {
            self.push("samplers", json!({ "magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497 }));
        }
        self.push("textures", json!({ "sampler": 0, "source": image }))
    }

    /// Adds a material with a base colour texture.
    pub(crate) fn material(&mut self, name: &str, base_color: usize) -> usize {
        let pbr = json!({ "baseColorTexture": { "index": base_color }, "metallicFactor": 0.0, "roughnessFactor": 0.8 });
        self.push("materials", json!({ "name": name, "pbrMetallicRoughness": pbr }))
    }

    /// Adds a POSITION accessor with its bounds.
    pub(crate) fn positions(&mut self, values: &[DVec3]) -> usize {
        self.document.append_accessor(&RawAccessor::from_floats(&floats3(values)), Some(ARRAY_BUFFER), true)
    }

    /// Adds a float attribute.
    pub(crate) fn attribute<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        self.document.append_accessor(&RawAccessor::from_floats(values), Some(ARRAY_BUFFER), false)
    }

    /// Adds indices.
    pub(crate) fn indices(&mut self, values: &[usize]) -> usize {
        let values: Vec<u32> = values.iter().map(|v| *v as u32).collect();
        self.document.append_accessor(&RawAccessor::from_indices(&values), Some(ELEMENT_ARRAY_BUFFER), false)
    }

    /// A primitive of an unwrapped surface; `normals` and `tangents` as wanted.
    pub(crate) fn primitive(&mut self, shape: &Unwrapped, material: usize, normals: bool, tangents: bool) -> Value {
        let mut attributes = json!({ "POSITION": self.positions(&shape.positions) });
        if normals {
            attributes["NORMAL"] = json!(self.attribute(&floats3(&shape.normals)));
        }
        if tangents {
            let values: Vec<[f32; 4]> = shape.tangents.iter().map(|(t, w)| t.extend(*w).as_vec4().to_array()).collect();
            attributes["TANGENT"] = json!(self.attribute(&values));
        }
        attributes["TEXCOORD_0"] = json!(self.attribute(&floats2(&shape.uvs)));
        let indices = self.indices(shape.triangles.as_flattened());
        json!({ "attributes": attributes, "indices": indices, "material": material })
    }

    /// Adds a mesh of primitives and a node of it to the scene.
    pub(crate) fn mesh(mut self, name: &str, primitives: Vec<Value>) -> Self {
        let mesh = self.push("meshes", json!({ "name": name, "primitives": primitives }));
        self.root(json!({ "name": name, "mesh": mesh }));
        self
    }
}

/// 32-bit vectors.
pub(crate) fn floats3(values: &[DVec3]) -> Vec<[f32; 3]> {
    values.iter().map(|v| v.as_vec3().to_array()).collect()
}

/// 32-bit vectors.
pub(crate) fn floats2(values: &[DVec2]) -> Vec<[f32; 2]> {
    values.iter().map(|v| v.as_vec2().to_array()).collect()
}
