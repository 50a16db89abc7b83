//! Whether a model came back with everything that packing need not touch: a walk over both documents by somebody who knows
//! glTF and not Intarsia. Accessors are compared by what they hold, wherever they lie; everything else by value and index.

use std::path::Path;

use serde_json::{Map, Value};

/// A model taken apart.
pub struct Model {
    json: Value,
    buffers: Vec<Vec<u8>>,
}

impl Model {
    /// Takes a GLB apart.
    pub fn new(bytes: &[u8]) -> Model {
        let glb = gltf::binary::Glb::from_slice(bytes).expect("a GLB");
        let json = serde_json::from_slice(&glb.json).expect("JSON");
        Model { json, buffers: vec![glb.bin.map(std::borrow::Cow::into_owned).unwrap_or_default()] }
    }

    /// Reads a .glb, or a .gltf with buffers beside it.
    pub fn open(path: &Path) -> Model {
        let bytes = std::fs::read(path).expect("the model");
        if bytes.starts_with(b"glTF") {
            return Model::new(&bytes);
        }
        let json: Value = serde_json::from_slice(&bytes).expect("JSON");
        let uris = json["buffers"].as_array().into_iter().flatten().filter_map(|b| b["uri"].as_str());
        let buffers = uris.map(|uri| std::fs::read(path.with_file_name(uri)).expect("a buffer beside the model"));
        Model { buffers: buffers.collect(), json }
    }

    fn list(&self, key: &str) -> &[Value] {
        self.json[key].as_array().map_or(&[], Vec::as_slice)
    }

    fn range(&self, view: &Value) -> &[u8] {
        let number = |key: &str| view[key].as_u64().unwrap_or(0) as usize;
        &self.buffers[number("buffer")][number("byteOffset")..number("byteOffset") + number("byteLength")]
    }

    /// What an accessor says and holds: its description without the places, and its elements byte by byte.
    fn accessor(&self, index: &Value) -> (Value, Vec<u8>) {
        let accessor = &self.list("accessors")[index.as_u64().expect("an index") as usize];
        let size = match accessor["componentType"].as_u64() {
            Some(5120 | 5121) => 1,
            Some(5122 | 5123) => 2,
            _ => 4,
        };
        let components = match accessor["type"].as_str() {
            Some("SCALAR") => 1,
            Some("VEC2") => 2,
            Some("VEC3") => 3,
            Some("MAT3") => 9,
            Some("MAT4") => 16,
            _ => 4,
        };
        let (element, count) = (size * components, accessor["count"].as_u64().expect("a count") as usize);
        let mut data = vec![0; element * count];
        if let Some(view) = accessor["bufferView"].as_u64().map(|v| &self.list("bufferViews")[v as usize]) {
            let stride = view["byteStride"].as_u64().map_or(element, |s| s as usize);
            let bytes = &self.range(view)[accessor["byteOffset"].as_u64().unwrap_or(0) as usize..];
            for (i, out) in data.chunks_exact_mut(element).enumerate() {
                out.copy_from_slice(&bytes[i * stride..i * stride + element]);
            }
        }
        let mut said = accessor.clone();
        for key in ["bufferView", "byteOffset", "sparse"] {
            said.as_object_mut().expect("an object").shift_remove(key);
        }
        (said, data)
    }
}

/// Everything that differs and should not, as sentences; empty where the model is whole.
pub fn differences(before: &Model, after: &Model) -> Vec<String> {
    let mut found = Walk { before, after, found: Vec::new() };
    found.roots();
    found.animations();
    found.skins();
    found.meshes();
    found.materials();
    found.textures();
    found.found
}

struct Walk<'a> {
    before: &'a Model,
    after: &'a Model,
    found: Vec<String>,
}

/// What a texture may get anew: its place, its sampler.
const TEXTURE: [&str; 2] = ["source", "sampler"];
/// What an image may get anew: its bytes.
const IMAGE: [&str; 3] = ["uri", "bufferView", "mimeType"];

fn without(value: &Value, keys: &[&str]) -> Value {
    let mut rest = value.clone();
    if let Some(object) = rest.as_object_mut() {
        keys.iter().for_each(|key| drop(object.shift_remove(*key)));
    }
    rest
}

impl Walk<'_> {
    fn equal(&mut self, at: &str, before: &Value, after: &Value) {
        if before != after {
            let cut = |v: &Value| v.to_string().chars().take(200).collect::<String>();
            self.found.push(format!("{at}: {} became {}", cut(before), cut(after)));
        }
    }

    /// Objects that are compared one by one; more may have been appended.
    fn prefix(&mut self, key: &str, appended: bool, but: &[&str]) {
        let (before, after) = (self.before.list(key), self.after.list(key));
        if after.len() < before.len() || (!appended && after.len() > before.len()) {
            self.found.push(format!("{key}: {} became {}", before.len(), after.len()));
        }
        for (i, (b, a)) in before.iter().zip(after).enumerate() {
            self.equal(&format!("/{key}/{i}"), &without(b, but), &without(a, but));
        }
    }

    fn roots(&mut self) {
        const OTHERS: [&str; 12] = [
            "accessors",
            "animations",
            "buffers",
            "bufferViews",
            "extensionsRequired",
            "extensionsUsed",
            "images",
            "materials",
            "meshes",
            "samplers",
            "skins",
            "textures",
        ];
        let rest = |glb: &Model| without(&glb.json, &OTHERS);
        let (before, after) = (rest(self.before), rest(self.after));
        let keys: Vec<&String> = before.as_object().expect("an object").keys().collect();
        for key in keys {
            self.equal(&format!("/{key}"), &before[key], &after[key]);
        }
        for key in after.as_object().expect("an object").keys().filter(|key| before.get(*key).is_none()) {
            self.found.push(format!("/{key} is new"));
        }
        self.prefix("samplers", true, &[]);
        for key in ["extensionsUsed", "extensionsRequired"] {
            // What was undone (a compression, a transform) goes; nothing else does.
            let undone = [
                "KHR_draco_mesh_compression",
                "EXT_meshopt_compression",
                "KHR_texture_basisu",
                "EXT_texture_webp",
                "KHR_texture_transform",
                "EXT_texture_avif",
            ];
            let missing = |v: &&Value| !self.after.list(key).contains(v) && !undone.contains(&v.as_str().unwrap_or(""));
            let lost: Vec<&Value> = self.before.list(key).iter().filter(missing).collect();
            let lost = format!("{key} lost {lost:?}");
            if !lost.ends_with("[]") {
                self.found.push(lost);
            }
        }
    }

    fn held(&mut self, at: &str, before: &Value, after: &Value) {
        if before.is_null() || after.is_null() {
            return self.equal(at, before, after);
        }
        let (b, a) = (self.before.accessor(before), self.after.accessor(after));
        self.equal(at, &b.0, &a.0);
        if b.1 != a.1 {
            self.found.push(format!("{at}: the {} bytes that it holds are others", b.1.len()));
        }
    }

    fn animations(&mut self) {
        self.prefix("animations", false, &["samplers"]);
        for (i, (b, a)) in self.before.list("animations").iter().zip(self.after.list("animations")).enumerate() {
            let samplers = |v: &Value| v["samplers"].as_array().cloned().unwrap_or_default();
            let (b, a) = (samplers(b), samplers(a));
            if b.len() != a.len() {
                self.found.push(format!("/animations/{i}: {} samplers became {}", b.len(), a.len()));
            }
            for (s, (b, a)) in b.iter().zip(&a).enumerate() {
                let at = format!("/animations/{i}/samplers/{s}");
                self.equal(&at, &without(b, &["input", "output"]), &without(a, &["input", "output"]));
                for key in ["input", "output"] {
                    self.held(&format!("{at}/{key}"), &b[key], &a[key]);
                }
            }
        }
    }

    fn skins(&mut self) {
        self.prefix("skins", false, &["inverseBindMatrices"]);
        for (i, (b, a)) in self.before.list("skins").iter().zip(self.after.list("skins")).enumerate() {
            self.held(&format!("/skins/{i}/inverseBindMatrices"), &b["inverseBindMatrices"], &a["inverseBindMatrices"]);
        }
    }

    /// Meshes keep their primitives; clones for further pages follow. What the attributes hold is the corners' affair.
    fn meshes(&mut self) {
        self.prefix("meshes", false, &["primitives"]);
        for (m, (b, a)) in self.before.list("meshes").iter().zip(self.after.list("meshes")).enumerate() {
            let list = |v: &Value| v["primitives"].as_array().cloned().unwrap_or_default();
            let (b, a) = (list(b), list(a));
            if a.len() < b.len() {
                self.found.push(format!("/meshes/{m}: {} primitives became {}", b.len(), a.len()));
            }
            for (p, (b, a)) in b.iter().zip(&a).enumerate() {
                let at = format!("/meshes/{m}/primitives/{p}");
                let but = ["attributes", "indices", "targets", "mode", "extensions"];
                self.equal(&at, &without(b, &but), &without(a, &but));
                let extensions = |v: &Value| without(&v["extensions"], &["KHR_draco_mesh_compression"]);
                let (eb, ea) = (extensions(b), extensions(a));
                if eb.as_object().is_some_and(|e| !e.is_empty()) {
                    self.equal(&format!("{at}/extensions"), &eb, &ea);
                }
                let empty = Map::new();
                let names =
                    |v: &Value| v["attributes"].as_object().unwrap_or(&empty).keys().cloned().collect::<Vec<_>>();
                let now = names(a);
                for name in names(b).iter().filter(|name| !now.contains(name)) {
                    self.found.push(format!("{at}: the attribute {name} is gone"));
                }
                let targets = |v: &Value| v["targets"].as_array().map_or(0, Vec::len);
                if targets(b) != targets(a) {
                    self.found.push(format!("{at}: {} morph targets became {}", targets(b), targets(a)));
                }
            }
        }
    }

    fn materials(&mut self) {
        let (before, after) = (self.before.list("materials"), self.after.list("materials"));
        if after.len() < before.len() {
            self.found.push(format!("materials: {} became {}", before.len(), after.len()));
        }
        for (i, (b, a)) in before.iter().zip(after).enumerate() {
            let (mut b, mut a) = (b.clone(), a.clone());
            free_textures(&mut b);
            free_textures(&mut a);
            self.equal(&format!("/materials/{i}"), &b, &a);
        }
    }

    fn textures(&mut self) {
        self.prefix("textures", true, &[&TEXTURE[..], &["extensions"]].concat());
        self.prefix("images", true, &IMAGE);
    }
}

/// Takes out what packing may change about a texture that a material reads: which, through which coordinates.
fn free_textures(value: &mut Value) {
    match value {
        Value::Object(object) => {
            for (key, child) in object.iter_mut() {
                if key.ends_with("exture") {
                    let mut rest = without(child, &["index", "texCoord"]);
                    if let Some(extensions) = rest.get_mut("extensions").and_then(Value::as_object_mut) {
                        extensions.shift_remove("KHR_texture_transform");
                        if extensions.is_empty() {
                            rest = without(&rest, &["extensions"]);
                        }
                    }
                    *child = rest;
                }
                free_textures(child);
            }
        }
        Value::Array(all) => all.iter_mut().for_each(free_textures),
        _ => {}
    }
}

/// The walk sees what is lost: otherwise it would prove nothing.
#[test]
fn the_walk_sees_what_is_lost() {
    let bytes = intarsia::asset::sample::sample("skinned").expect("a sample");
    let (before, mut after) = (Model::new(&bytes), Model::new(&bytes));
    assert_eq!(differences(&before, &after), Vec::<String>::new());
    let keep = after.json.clone();
    for (pointer, value) in [
        ("/nodes/0", serde_json::json!({})),
        ("/animations/0/samplers/0/input", serde_json::json!(0)),
        ("/animations/0/samplers/0/interpolation", serde_json::json!("STEP")),
        ("/skins/0/joints/0", serde_json::json!(99)),
        ("/skins/0/inverseBindMatrices", serde_json::json!(0)),
        ("/materials/0/name", serde_json::json!("other")),
        ("/meshes/0/primitives/0/material", serde_json::json!(99)),
        ("/meshes/0/primitives/0/attributes", serde_json::json!({})),
        ("/meshes/0/primitives/0/targets", serde_json::json!([])),
        ("/asset/extras", serde_json::json!(1)),
    ] {
        match after.json.pointer_mut(pointer) {
            Some(found) => *found = value,
            None => {
                let (parent, key) = pointer.rsplit_once('/').expect("a parent");
                after.json.pointer_mut(parent).expect("a parent")[key] = value;
            }
        }
        assert!(!differences(&before, &after).is_empty(), "{pointer} may change unseen");
        after.json = keep.clone();
    }
    after.buffers[0].iter_mut().for_each(|b| *b ^= 1);
    assert!(!differences(&before, &after).is_empty(), "data may change unseen");
}
