//! Merging small documents made by code.

use std::collections::BTreeMap;

use glam::{DMat4, DVec3};
use serde_json::{Value, json};

use super::*;
use crate::asset::fixture::{attribute, bowtie, document, mesh, primitive};
use crate::asset::{File, Limits, load, read_indices, read_vec3};

/// Corner positions in the scene, and whether normals point to the side that the corners turn about, by triangle, sorted.
pub(crate) fn scene(doc: &Document) -> Vec<([[i64; 3]; 3], bool)> {
    fn walk(doc: &Document, n: usize, parent: DMat4, out: &mut Vec<([[i64; 3]; 3], bool)>) {
        let node = &doc.json["nodes"][n];
        let numbers = |k: &str| node[k].as_array().map(|a| a.iter().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>());
        let three = |k: &str, d: DVec3| numbers(k).map_or(d, |v| DVec3::new(v[0], v[1], v[2]));
        let turn =
            numbers("rotation").map_or(glam::DQuat::IDENTITY, |v| glam::DQuat::from_xyzw(v[0], v[1], v[2], v[3]));
        let (scale, shift) = (three("scale", DVec3::ONE), three("translation", DVec3::ZERO));
        let world = parent * DMat4::from_scale_rotation_translation(scale, turn, shift);
        if let Some(m) = node["mesh"].as_u64() {
            for p in doc.json["meshes"][m as usize]["primitives"].as_array().unwrap() {
                let get = |name: &str| p["attributes"][name].as_u64().unwrap() as usize;
                let at = read_vec3(doc, get("POSITION")).unwrap();
                let normals = read_vec3(doc, get("NORMAL")).unwrap();
                let indices = read_indices(doc, p["indices"].as_u64().unwrap() as usize).unwrap();
                let wide = |v: [f32; 3]| DVec3::from(v.map(f64::from));
                let inverse = world.inverse().transpose();
                for t in indices.as_chunks::<3>().0 {
                    let c = t.map(|v| world.transform_point3(wide(at[v as usize])));
                    let n = inverse.transform_vector3(wide(normals[t[0] as usize]));
                    let turned = (c[1] - c[0]).cross(c[2] - c[0]);
                    // A mirrored node is drawn with its corners turned back.
                    let sense = if world.determinant() < 0.0 { -1.0 } else { 1.0 };
                    let mut c = c.map(|p| (p * 1e4).round().to_array().map(|x| x as i64));
                    c.sort();
                    out.push((c, turned.dot(n) * sense > 0.0));
                }
            }
        }
        for child in node["children"].as_array().into_iter().flatten() {
            walk(doc, child.as_u64().unwrap() as usize, world, out);
        }
    }
    let mut out = Vec::new();
    for root in doc.json["scenes"][0]["nodes"].as_array().unwrap() {
        walk(doc, root.as_u64().unwrap() as usize, DMat4::IDENTITY, &mut out);
    }
    out.sort();
    out
}

/// Two textured materials with images of one content, an untextured one, and three nodes: one mirrored, one turned, one animated.
pub(crate) fn model() -> Document {
    let mut doc = document(&[[32, 32], [32, 32]]);
    doc.json["materials"] = json!([
        { "name": "a", "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "metallicFactor": 0 } },
        { "name": "b", "pbrMetallicRoughness": { "metallicFactor": 0.0, "baseColorTexture": { "index": 1 } } },
        { "name": "c", "pbrMetallicRoughness": { "metallicFactor": 0, "baseColorFactor": [0.5, 0.25, 0, 1] } },
    ]);
    let mut first = bowtie(&mut doc);
    let mut second = bowtie(&mut doc);
    second["material"] = json!(1);
    let positions = attribute(&mut doc, &[[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]);
    let normals = attribute(&mut doc, &[[0.0, 0.0, 1.0]; 3]);
    let mut third = primitive(&mut doc, &[("POSITION", positions), ("NORMAL", normals)], &[0, 1, 2]);
    third["material"] = json!(2);
    mesh(&mut doc, vec![first.clone(), second.clone(), third]);
    first["material"] = json!(1);
    mesh(&mut doc, vec![first]);
    mesh(&mut doc, vec![second]);
    doc.json["nodes"] = json!([
        { "mesh": 0, "translation": [1, 2, 3], "children": [1], "name": "host" },
        { "mesh": 1, "scale": [-1, 2, 1], "rotation": [0, 0.6, 0, 0.8], "name": "gone" },
        { "mesh": 2, "translation": [5, 0, 0] },
    ]);
    doc.json["scenes"] = json!([{ "nodes": [0, 2] }]);
    let input = crate::asset::RawAccessor::from_floats(&[[0.0f32], [1.0]]);
    let input = doc.append_accessor(&input, None, true);
    let output = attribute(&mut doc, &[[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]]);
    doc.json["animations"] = json!([{
        "samplers": [{ "input": input, "output": output }],
        "channels": [{ "sampler": 0, "target": { "node": 2, "path": "translation" } }],
    }]);
    doc
}

#[test]
fn what_is_drawn_alike_is_drawn_at_once() {
    let mut doc = model();
    let before = scene(&doc);
    let uploaded = doc.json.clone();
    let mut index = MaterialIndex::new(&doc).unwrap();
    let merge = prepare(&mut doc, &mut index, 0).unwrap().unwrap();
    // The equal images are one, the factors are a texture.
    assert_eq!(doc.json["textures"], json!([{ "source": 0 }, { "source": 2 }]));
    assert_eq!(doc.merging.constants, BTreeSet::from([2]));
    let uvs = doc.json["meshes"][0]["primitives"][2]["attributes"]["TEXCOORD_0"].as_u64().unwrap();
    assert_eq!(crate::asset::read_vec2(&doc, uvs as usize).unwrap(), [[0.5, 0.5]; 3]);
    let texel = crate::texture::decode(doc.images[2].as_ref().unwrap(), 100).unwrap();
    assert_eq!(texel.as_bytes()[..3], [188, 137, 0]);
    let merged = finish(&mut doc, merge).unwrap();
    assert_eq!(scene(&doc), before);
    // a and b are one material now; c still reads a texture of its own.
    assert_eq!(merged.materials.iter().map(|m| m.now).collect::<Vec<_>>(), [0, 0, 2]);
    assert_eq!((merged.draw_calls, merged.images, merged.textures), counts([5, 3], [2, 2], [2, 2]));
    assert_eq!(doc.json["nodes"][1]["name"], "gone");
    assert!(doc.json["nodes"][1].get("mesh").is_none());
    assert_eq!((doc.json["nodes"][2]["mesh"].as_u64(), doc.json["meshes"].as_array().unwrap().len()), (Some(1), 2));
    for key in ["animations", "scenes", "asset"] {
        assert_eq!(doc.json[key], uploaded[key]);
    }
    let file = File { path: "m.glb".to_owned(), bytes: doc.to_glb().unwrap() };
    load(&[file], None, &Limits::default()).unwrap();
}

pub(crate) fn counts(draws: [u64; 2], images: [u64; 2], textures: [u64; 2]) -> (Counts, Counts, Counts) {
    let one = |[before, after]: [u64; 2]| Counts { before, after };
    (one(draws), one(images), one(textures))
}

#[test]
fn what_differs_stays_and_says_why() {
    let reason = |change: &dyn Fn(&mut Value)| {
        let mut doc = model();
        change(&mut doc.json);
        let mut index = MaterialIndex::new(&doc).unwrap();
        let merge = prepare(&mut doc, &mut index, 0).unwrap();
        merge.map(|m| m.0.materials[2].kept.clone().unwrap_or_default())
    };
    let different = Some("no textured material differs in nothing but factors".to_owned());
    assert_eq!(reason(&|_| {}), Some(String::new()));
    assert_eq!(reason(&|j| j["materials"][2]["doubleSided"] = json!(true)), different);
    assert_eq!(reason(&|j| j["materials"][2]["pbrMetallicRoughness"]["metallicFactor"] = json!(0.5)), different);
    assert_eq!(reason(&|j| j["materials"][2]["emissiveFactor"] = json!([0.5, 0, 0])), different);
    let dark = |j: &mut Value| {
        for m in 0..2 {
            j["materials"][m]["pbrMetallicRoughness"]["baseColorFactor"] = json!([0.1, 1, 1, 1]);
        }
    };
    assert_eq!(reason(&dark), different, "a texel cannot make a factor brighter");
    let unused = |j: &mut Value| j["meshes"][0]["primitives"][2]["material"] = json!(0);
    assert_eq!(reason(&unused), Some("nothing is drawn with it".to_owned()));
    assert_eq!(reason(&|j| j["extensionsUsed"] = json!(["ACME_thing"])), None);
    // Transparent things are drawn one after the other, and nothing is put together with them.
    let mut doc = model();
    for m in 0..3 {
        doc.json["materials"][m]["alphaMode"] = json!("BLEND");
    }
    let mut index = MaterialIndex::new(&doc).unwrap();
    let merge = prepare(&mut doc, &mut index, 0).unwrap().unwrap();
    assert_eq!(finish(&mut doc, merge).unwrap().draw_calls, Counts { before: 5, after: 5 });
}

#[test]
fn many_small_meshes_of_many_nodes() {
    // Nodes at random that share four meshes of two materials: every scene triangle is still there.
    let mut doc = document(&[[8, 8]]);
    doc.push("materials", json!({ "name": "n", "doubleSided": true }));
    for m in 0..4 {
        let mut p = bowtie(&mut doc);
        p["material"] = json!(m % 2);
        mesh(&mut doc, vec![p]);
    }
    let mut seed = 7u64;
    let mut random = || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 40) as f64 / 16_777_216.0
    };
    let mut children: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    let mut nodes = Vec::new();
    for n in 0..60usize {
        let v: [f64; 6] = std::array::from_fn(|_| random() * 4.0 - 2.0);
        nodes
            .push(json!({ "mesh": n % 4, "translation": v[..3], "scale": [v[3].signum() * 1.5, 0.5 + v[4].abs(), 1] }));
        if n > 0 {
            children.entry((random() * n as f64) as usize).or_default().push(n);
        }
    }
    children.into_iter().for_each(|(n, c)| nodes[n]["children"] = json!(c));
    doc.json["nodes"] = Value::Array(nodes);
    doc.json["scenes"] = json!([{ "nodes": [0] }]);
    let before = scene(&doc);
    let mut index = MaterialIndex::new(&doc).unwrap();
    let merge = prepare(&mut doc, &mut index, 0).unwrap().unwrap();
    let merged = finish(&mut doc, merge).unwrap();
    assert_eq!(merged.draw_calls, Counts { before: 60, after: 2 });
    let after = scene(&doc);
    assert_eq!(before.len(), after.len());
    for (a, b) in before.iter().zip(&after) {
        let far = a.0.iter().flatten().zip(b.0.iter().flatten()).map(|(x, y)| (x - y).abs()).max().unwrap();
        assert!(far <= 200 && a.1 == b.1, "{a:?} {b:?}");
    }
}
