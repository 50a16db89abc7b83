//! Documents with compressed geometry, from files to a plain [`Document`].

use std::time::{Duration, Instant};

use draco_core::{
    DataType, EncoderBuffer, EncoderOptions, FaceIndex, GeometryAttributeType, Mesh, MeshEncoder, PointAttribute,
    PointIndex,
};
use serde_json::{Value, json};

use crate::asset::{
    ARRAY_BUFFER, ComponentType, Compression, Document, ELEMENT_ARRAY_BUFFER, File, Kind, Limits, RawAccessor, load,
    load_while, raw_elements, read_indices, read_vec2, read_vec3,
};
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};

/// A grid of `n` x `n` squares: positions and UVs by vertex, triangles.
struct Grid {
    positions: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    faces: Vec<[u32; 3]>,
}

fn grid(n: u32) -> Grid {
    let all = || (0..=n).flat_map(|y| (0..=n).map(move |x| (x as f32 / n as f32, y as f32 / n as f32)));
    let corner = |x: u32, y: u32| y * (n + 1) + x;
    let squares = (0..n).flat_map(|y| (0..n).map(move |x| (x, y)));
    Grid {
        positions: all().map(|(x, y)| [x, y, (3.0 * x * y).sin()]).collect(),
        uvs: all().map(|(x, y)| [x, 1.0 - y]).collect(),
        faces: squares
            .flat_map(|(x, y)| {
                let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x + 1, y + 1), corner(x, y + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect(),
    }
}

/// The grid as a Draco stream: positions are attribute 0, UVs attribute 1. Method 0 is sequential, 1 edgebreaker.
fn draco(grid: &Grid, method: i32, speed: i32) -> Vec<u8> {
    let mut mesh = Mesh::new();
    let mut attribute = |kind, components: u8, values: Vec<u8>| {
        let count = values.len() / (4 * usize::from(components));
        let mut attribute = PointAttribute::new();
        attribute.init(kind, components, DataType::Float32, false, count);
        attribute.buffer_mut().write(0, &values);
        mesh.add_attribute(attribute);
    };
    let bytes = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    attribute(GeometryAttributeType::Position, 3, bytes(grid.positions.as_flattened()));
    attribute(GeometryAttributeType::TexCoord, 2, bytes(grid.uvs.as_flattened()));
    mesh.set_num_faces(grid.faces.len());
    for (index, face) in grid.faces.iter().enumerate() {
        mesh.set_face(FaceIndex(index as u32), face.map(PointIndex));
    }
    let mut options = EncoderOptions::new();
    options.set_encoding_method(method);
    options.set_compression_level(10 - speed);
    options.set_attribute_int(0, "quantization_bits", 14);
    options.set_attribute_int(1, "quantization_bits", 12);
    let mut encoder = MeshEncoder::new();
    encoder.set_mesh(mesh);
    let mut out = EncoderBuffer::new();
    encoder.encode(&options, &mut out).unwrap();
    out.data().to_vec()
}

/// A document with the grid as a Draco primitive, and its buffer.
fn draco_document(grid: &Grid, stream: &[u8]) -> Value {
    let vertices = grid.positions.len();
    json!({
        "asset": { "version": "2.0" },
        "extensionsUsed": ["KHR_draco_mesh_compression", "KHR_materials_unlit"],
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "buffers": [{ "byteLength": stream.len(), "uri": "m.bin" }],
        "bufferViews": [{ "buffer": 0, "byteLength": stream.len() }],
        "accessors": [
            { "componentType": 5126, "count": vertices, "type": "VEC3", "min": [0, 0, 0], "max": [9, 9, 9], "name": "p" },
            { "componentType": 5126, "count": vertices, "type": "VEC2" },
            { "componentType": 5123, "count": 3 * grid.faces.len(), "type": "SCALAR" },
        ],
        "meshes": [{ "primitives": [{
            "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "indices": 2,
            "extensions": { "KHR_draco_mesh_compression": { "bufferView": 0, "attributes": { "POSITION": 0, "TEXCOORD_0": 1 } } },
        }] }],
        "nodes": [{ "mesh": 0 }],
    })
}

fn files(json: &Value, buffer: &[u8]) -> Vec<File> {
    let file = |path: &str, bytes: Vec<u8>| File { path: path.to_owned(), bytes };
    vec![file("m.gltf", serde_json::to_vec(json).unwrap()), file("m.bin", buffer.to_vec())]
}

fn open(json: &Value, buffer: &[u8]) -> Result<(Document, Vec<Warning>)> {
    load(&files(json, buffer), None, &Limits::default())
}

fn failure(json: &Value, buffer: &[u8]) -> (Code, String, String) {
    let Failure { code, message, pointer } = open(json, buffer).map(|_| ()).expect_err("it is refused");
    (code, message, pointer.unwrap_or_default())
}

fn codes(warnings: &[Warning]) -> Vec<&str> {
    warnings.iter().map(|w| w.code.as_str()).collect()
}

/// The corners of every triangle, positions and UVs, in any order.
fn triangles(positions: &[[f32; 3]], uvs: &[[f32; 2]], indices: &[u32]) -> Vec<Vec<i64>> {
    let round = |v: f32| (f64::from(v) * 500.0).round() as i64;
    let corner =
        |i: &u32| positions[*i as usize].iter().chain(&uvs[*i as usize]).map(|v| round(*v)).collect::<Vec<_>>();
    let mut all: Vec<Vec<i64>> = indices
        .chunks(3)
        .map(|face| {
            let mut corners: Vec<_> = face.iter().map(corner).collect();
            let first = (0..3).min_by_key(|n| corners[*n].clone()).unwrap();
            corners.rotate_left(first);
            corners.concat()
        })
        .collect();
    all.sort();
    all
}

#[test]
fn draco_primitives_become_ordinary_ones() {
    // Coordinates are multiples of 1/500 but for quantisation, so that rounding tells whether they are the same.
    let grid = Grid { positions: grid(10).positions.iter().map(|[x, y, _]| [*x, *y, x * 0.5]).collect(), ..grid(10) };
    for (method, speed) in [(0, 10), (1, 0), (1, 3), (1, 5), (1, 10)] {
        let stream = draco(&grid, method, speed);
        let (doc, warnings) = open(&draco_document(&grid, &stream), &stream).unwrap();
        assert!(warnings.is_empty(), "{warnings:?}");
        assert_eq!(doc.json["extensionsUsed"], json!(["KHR_materials_unlit"]));
        assert_eq!(doc.json.get("extensionsRequired"), None);
        let primitive = &doc.json["meshes"][0]["primitives"][0];
        assert_eq!(*primitive, json!({ "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "indices": 2 }));
        assert_eq!(doc.json["accessors"][0]["name"], "p");
        let found = (read_vec3(&doc, 0).unwrap(), read_vec2(&doc, 1).unwrap(), read_indices(&doc, 2).unwrap());
        let expected = triangles(&grid.positions, &grid.uvs, grid.faces.as_flattened());
        assert_eq!(triangles(&found.0, &found.1, &found.2), expected, "method {method}, speed {speed}");
        let top = found.0.iter().map(|p| p[2]).fold(0.0, f32::max);
        assert_eq!(doc.json["accessors"][0]["max"][2], json!(top), "bounds are those of what was decoded");

        // What is written holds no stream, and is read as an ordinary model.
        let glb = File { path: "m.glb".to_owned(), bytes: doc.to_glb().unwrap() };
        let (again, warnings) = load(&[glb], None, &Limits::default()).unwrap();
        assert!(warnings.is_empty(), "{warnings:?}");
        assert_eq!(again.json["bufferViews"].as_array().unwrap().len(), 3);
        assert_eq!(read_vec3(&again, 0).unwrap(), found.0);
    }
}

#[test]
fn accessors_that_others_use_are_left_alone() {
    let (grid, other) = (grid(3), Grid { positions: vec![[9.0; 3], [8.0; 3], [7.0, 8.0, 9.0]], ..grid(1) });
    let other = Grid { uvs: vec![[0.5; 2]; 3], faces: vec![[0, 1, 2]], ..other };
    let (first, second) = (draco(&grid, 1, 5), draco(&other, 0, 10));
    let buffer = [&*first, &*second].concat();
    let mut json = draco_document(&grid, &buffer);
    json["bufferViews"] = json!([
        { "buffer": 0, "byteLength": first.len() },
        { "buffer": 0, "byteOffset": first.len(), "byteLength": second.len() },
    ]);
    let primitive = json["meshes"][0]["primitives"][0].clone();
    let mut changed = primitive.clone();
    changed["extensions"]["KHR_draco_mesh_compression"]["bufferView"] = json!(1);
    let mut plain = primitive.clone();
    plain.as_object_mut().unwrap().remove("indices");
    json["meshes"][0]["primitives"] = json!([primitive, changed, primitive, plain]);
    let (doc, warnings) = open(&json, &buffer).unwrap();
    assert_eq!(codes(&warnings), ["accessor_count_corrected"]);
    let primitives = &doc.json["meshes"][0]["primitives"];
    assert_eq!(primitives[0], primitives[2]);
    assert_eq!(primitives[0]["attributes"], json!({ "POSITION": 0, "TEXCOORD_0": 1 }));
    // The second has accessors of its own, the fourth only its indices.
    assert_eq!(primitives[1], json!({ "attributes": { "POSITION": 3, "TEXCOORD_0": 4 }, "indices": 5 }));
    assert_eq!(primitives[3], json!({ "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "indices": 6 }));
    assert_eq!(read_vec3(&doc, 0).unwrap().len(), 16);
    assert_eq!(read_vec3(&doc, 3).unwrap().len(), 3);
    assert_eq!(read_indices(&doc, 6).unwrap(), read_indices(&doc, 2).unwrap());
}

#[test]
fn uncompressed_contents_beside_a_stream_stay() {
    let grid = grid(3);
    let stream = draco(&grid, 1, 5);
    let mut buffer = stream.clone();
    buffer.resize(stream.len().next_multiple_of(4) + 1000, 0);
    let mut json = draco_document(&grid, &stream);
    json.as_object_mut().unwrap().remove("extensionsRequired");
    json["buffers"][0]["byteLength"] = json!(buffer.len());
    let zeros = json!({ "buffer": 0, "byteOffset": stream.len().next_multiple_of(4), "byteLength": 1000 });
    json["bufferViews"].as_array_mut().unwrap().push(zeros);
    for accessor in 0..3 {
        json["accessors"][accessor]["bufferView"] = json!(1);
    }
    let (doc, _) = open(&json, &buffer).unwrap();
    assert_eq!(doc.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"], 3);
    assert!(read_vec3(&doc, 0).unwrap().iter().all(|p| *p == [0.0; 3]));
    let near = |p: &[f32; 3]| (0..3).all(|k| (p[k] - grid.positions[15][k]).abs() < 1e-3);
    assert!(read_vec3(&doc, 3).unwrap().iter().any(near));

    // A strip is not read from the stream: what stands beside it is taken, or nothing.
    json["meshes"][0]["primitives"][0]["mode"] = json!(5);
    let (doc, warnings) = open(&json, &buffer).unwrap();
    assert_eq!(codes(&warnings), ["draco_ignored"]);
    let attributes = json!({ "POSITION": 0, "TEXCOORD_0": 1 });
    assert_eq!(doc.json["meshes"][0]["primitives"][0], json!({ "attributes": attributes, "indices": 2, "mode": 5 }));
    json["accessors"][1].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(failure(&json, &buffer).0, Code::UnsupportedExtension);
}

#[test]
fn the_stream_tells_how_many_vertices_there_are() {
    let [grid, large] = [4, 20].map(grid);
    let stream = draco(&grid, 1, 5);
    let mut json = draco_document(&grid, &stream);
    for accessor in 0..2 {
        json["accessors"][accessor]["count"] = json!(20);
    }
    let (doc, warnings) = open(&json, &stream).unwrap();
    assert_eq!(codes(&warnings), ["accessor_count_corrected"]);
    assert_eq!(warnings[0].pointer.as_deref(), Some("/meshes/0/primitives/0"));
    assert_eq!(doc.json["accessors"][0]["count"], 25);
    // Nor is it the accessors that say how many triangles there are, or how wide their indices.
    json["accessors"][2]["count"] = json!(6);
    let (doc, warnings) = open(&json, &stream).unwrap();
    assert_eq!(codes(&warnings), ["accessor_count_corrected"]);
    assert_eq!(read_indices(&doc, 2).unwrap().len(), 96);
    let wide = draco(&large, 1, 5);
    let mut narrow = draco_document(&large, &wide);
    narrow["accessors"][2]["componentType"] = json!(5121);
    let (doc, _) = open(&narrow, &wide).unwrap();
    assert_eq!(doc.json["accessors"][2]["componentType"], 5125);
    assert_eq!(read_indices(&doc, 2).unwrap().iter().max(), Some(&440));
    // What stands outside may be right where what stands inside is wrong.
    let mut outside = json.clone();
    outside["accessors"].as_array_mut().unwrap().push(json!({ "componentType": 5126, "count": 25, "type": "VEC3" }));
    outside["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": 3 }]);
    assert_eq!(codes(&open(&outside, &stream).unwrap().1), ["accessor_count_corrected"]);

    // Not where something outside the stream has as many elements.
    json["accessors"].as_array_mut().unwrap().push(json!({ "componentType": 5126, "count": 20, "type": "VEC3" }));
    json["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": 3 }]);
    let (code, message, _) = failure(&json, &stream);
    assert!(code == Code::InvalidModel && message.contains("25 vertices"), "{message}");
}

#[test]
fn broken_draco_primitives_are_refused_with_a_pointer() {
    let grid = grid(4);
    let stream = draco(&grid, 1, 5);
    let extension = "/meshes/0/primitives/0/extensions/KHR_draco_mesh_compression";
    let cases: [(&str, Value, Code, &str, &str); 8] = [
        (
            "/meshes/0/primitives/0/mode",
            json!(5),
            Code::UnsupportedExtension,
            "triangles",
            "/meshes/0/primitives/0/mode",
        ),
        (&format!("{extension}/bufferView"), json!(7), Code::InvalidModel, "bufferViews 7", extension),
        (&format!("{extension}/bufferView"), json!("x"), Code::InvalidModel, "bufferView", extension),
        (&format!("{extension}/attributes"), json!([]), Code::InvalidModel, "object", extension),
        (&format!("{extension}/attributes/POSITION"), json!(9), Code::InvalidModel, "no attribute 9", "/accessors/0"),
        (&format!("{extension}/attributes/NORMAL"), json!(1), Code::InvalidModel, "NORMAL", extension),
        ("/accessors/1/type", json!("VEC4"), Code::InvalidModel, "2 components", "/accessors/1"),
        ("/accessors/0/componentType", json!(5121), Code::InvalidModel, "does not fit", "/accessors/0"),
    ];
    for (pointer, value, code, words, at) in cases {
        let mut json = draco_document(&grid, &stream);
        match json.pointer_mut(pointer) {
            Some(place) => *place = value,
            None => {
                let (parent, key) = pointer.rsplit_once('/').unwrap();
                json.pointer_mut(parent).unwrap()[key] = value;
            }
        }
        let found = failure(&json, &stream);
        assert!(found.0 == code && found.1.contains(words) && found.2.starts_with(at), "{pointer}: {found:?}");
    }
    let found = failure(&draco_document(&grid, &stream[..40]), &stream[..40]);
    assert!(found.0 == Code::InvalidModel && found.2 == extension, "{found:?}");
}

#[test]
fn limits_and_cancellation_hold() {
    let grid = grid(4);
    let stream = draco(&grid, 1, 5);
    let json = draco_document(&grid, &stream);
    let with = |limits: Limits| load(&files(&json, &stream), None, &limits).map(|_| ()).unwrap_err().code;
    assert_eq!(with(Limits { max_triangles: 31, ..Limits::default() }), Code::TooLarge);
    let canceled = || Err(Failure::new(Code::Canceled, "stop"));
    let stopped = load_while(&files(&json, &stream), None, &Limits::default(), &canceled);
    assert_eq!(stopped.map(|_| ()).unwrap_err().code, Code::Canceled);
}

/// Elements as the meshopt attribute codec writes them when nothing can be saved: literal differences.
fn meshopt(data: &[u8], stride: usize) -> Vec<u8> {
    let mut stream = vec![0xA1];
    stream.extend(vec![0xFF; stride / 4]);
    for k in 0..stride {
        let mut last = 0;
        for element in data.chunks(stride) {
            let delta = element[k].wrapping_sub(last) as i8;
            stream.push(((delta << 1) ^ (delta >> 7)) as u8);
            last = element[k];
        }
    }
    stream.resize(stream.len() + (stride + stride / 4).max(24), 0);
    stream
}

/// A document whose positions (quantised) and indices are compressed and whose second buffer is nowhere; and its buffer.
fn meshopt_document() -> (Value, Vec<u8>) {
    let positions: Vec<u8> = [[0u16, 0, 0, 0], [4095, 0, 0, 0], [0, 4095, 7, 0]]
        .as_flattened()
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let stream = meshopt(&positions, 8);
    let mut buffer = b"plain".to_vec();
    buffer.resize(8, 0);
    buffer.extend(&stream);
    let indices = buffer.len();
    buffer.extend([0xE1, 0xF0]);
    buffer.extend([0; 16]);
    let source = |offset: usize, length: usize, stride: usize, mode: &str| {
        json!({ "EXT_meshopt_compression": {
        "buffer": 0, "byteOffset": offset, "byteLength": length, "byteStride": stride, "mode": mode, "count": 3,
    } })
    };
    let json = json!({
        "asset": { "version": "2.0" },
        "extensionsUsed": ["EXT_meshopt_compression", "KHR_mesh_quantization"],
        "extensionsRequired": ["EXT_meshopt_compression", "KHR_mesh_quantization"],
        "buffers": [
            { "byteLength": buffer.len(), "uri": "m.bin" },
            { "byteLength": 32, "extensions": { "EXT_meshopt_compression": { "fallback": true } } },
        ],
        "bufferViews": [
            { "buffer": 0, "byteLength": 5 },
            { "buffer": 1, "byteLength": 24, "byteStride": 8, "target": 34962, "extensions": source(8, stream.len(), 8, "ATTRIBUTES") },
            { "buffer": 1, "byteOffset": 24, "byteLength": 6, "target": 34963, "extensions": source(indices, 18, 2, "TRIANGLES") },
        ],
        "accessors": [
            { "bufferView": 1, "componentType": 5123, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [4095, 4095, 7] },
            { "bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR" },
        ],
        "images": [{ "bufferView": 0, "mimeType": "image/png" }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
    });
    (json, buffer)
}

#[test]
fn compressed_buffer_views_become_ordinary_ones() {
    let (json, buffer) = meshopt_document();
    let mut khr: Value = serde_json::from_str(&json.to_string().replace("EXT_meshopt", "KHR_meshopt")).unwrap();
    // The fallback may be named, and need not be there.
    khr["buffers"][1]["uri"] = json!("gone.bin");
    for json in [json, khr] {
        let (doc, warnings) = open(&json, &buffer).unwrap();
        assert!(warnings.is_empty(), "{warnings:?}");
        assert!(!doc.json.to_string().contains("meshopt"), "{}", doc.json);
        assert_eq!(doc.json["extensionsRequired"], json!(["KHR_mesh_quantization"]));
        assert_eq!(read_vec3(&doc, 0).unwrap(), [[0.0; 3], [4095.0, 0.0, 0.0], [0.0, 4095.0, 7.0]]);
        assert_eq!(read_indices(&doc, 1).unwrap(), [0, 1, 2]);
        assert_eq!(doc.json["accessors"][0]["componentType"], 5123, "quantised attributes stay so");
        assert_eq!(doc.buffers[0], b"plain", "the streams are gone");
        let glb = File { path: "m.glb".to_owned(), bytes: doc.to_glb().unwrap() };
        let (again, warnings) = load(&[glb], None, &Limits::default()).unwrap();
        assert!(warnings.is_empty(), "{warnings:?}");
        assert_eq!(read_vec3(&again, 0).unwrap(), read_vec3(&doc, 0).unwrap());
        assert_eq!(again.images, [Some(b"plain".to_vec())]);
    }
}

#[test]
fn broken_buffer_views_are_refused_with_a_pointer() {
    let extension = "/bufferViews/1/extensions/EXT_meshopt_compression";
    let cases = [
        ("mode", json!("FASTER"), "ATTRIBUTES", "mode"),
        ("mode", json!("TRIANGLES"), "byteStride", ""),
        ("filter", json!("OCTAHEDRAL "), "NONE", "filter"),
        ("buffer", json!(4), "buffer 4", ""),
        ("byteOffset", json!(1 << 20), "leave buffer 0", ""),
        ("byteLength", json!(30), "stream", ""),
        ("byteStride", json!(6), "byteStride 6", ""),
        ("count", json!(-3), "count", "count"),
    ];
    for (key, value, words, at) in cases {
        let (mut json, buffer) = meshopt_document();
        json.pointer_mut(extension).unwrap()[key] = value;
        let (code, message, pointer) = failure(&json, &buffer);
        let at = format!("{extension}/{at}");
        assert!(code == Code::InvalidModel && message.contains(words), "{key}: {message}");
        assert_eq!(pointer, at.trim_end_matches('/'), "{key}");
    }
    let (mut json, buffer) = meshopt_document();
    json.pointer_mut(extension).unwrap()["count"] = json!(4);
    assert_eq!(failure(&json, &buffer).2, "/bufferViews/1/byteLength");
    json.pointer_mut(extension).unwrap()["count"] = json!(1u64 << 40);
    json["bufferViews"][1]["byteLength"] = json!(8u64 << 40);
    assert_eq!(failure(&json, &buffer).0, Code::TooLarge);
}

/// The document saved and read again: what readers see, the JSON of the file, and the codes of all warnings.
fn delivered(doc: &Document, compression: Compression) -> (Document, Value, Vec<String>) {
    let context = Context::silent();
    let mut doc = doc.clone();
    doc.compress(compression, &context).unwrap();
    let bytes = doc.to_glb().unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    let (again, warnings) = load(&[File { path: "m.glb".to_owned(), bytes }], None, &Limits::default()).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    (again, json, context.warnings().into_iter().map(|w| w.code).collect())
}

/// The elements of an attribute, or of the indices, of the first primitive.
fn elements(doc: &Document, name: &str) -> RawAccessor {
    let primitive = &doc.json["meshes"][0]["primitives"][0];
    let index = if name == "indices" { &primitive["indices"] } else { &primitive["attributes"][name] };
    raw_elements(doc, index.as_u64().unwrap() as usize).unwrap()
}

const DRACO: &str = "KHR_draco_mesh_compression";

#[test]
fn what_did_not_change_leaves_by_its_own_bytes() {
    let grid = grid(10);
    let stream = draco(&grid, 1, 5);
    let (doc, _) = open(&draco_document(&grid, &stream), &stream).unwrap();
    let (again, json, _) = delivered(&doc, Compression::Keep);
    assert_eq!(json["extensionsRequired"], json!([DRACO]));
    assert_eq!(&*again.origins.streams[0].stream, &*stream);
    assert!(json["accessors"].as_array().unwrap().iter().all(|a| a.get("bufferView").is_none()), "{json}");
    for name in ["POSITION", "TEXCOORD_0", "indices"] {
        assert_eq!(elements(&again, name), elements(&doc, name));
    }

    let (view, buffer) = meshopt_document();
    for name in ["EXT_meshopt_compression", "KHR_meshopt_compression"] {
        let view: Value = serde_json::from_str(&view.to_string().replace("EXT_meshopt_compression", name)).unwrap();
        let (doc, _) = open(&view, &buffer).unwrap();
        let (again, json, _) = delivered(&doc, Compression::Keep);
        assert_eq!(json["extensionsRequired"], json!(["KHR_mesh_quantization", name]));
        assert_eq!(json["buffers"][1], json!({ "byteLength": 32, "extensions": { name: { "fallback": true } } }));
        for index in [1, 2] {
            assert_eq!(again.origins.views[&index].stream, doc.origins.views[&index].stream);
            assert_eq!(again.view_bytes(index).unwrap(), doc.view_bytes(index).unwrap());
        }
        assert_eq!(again.images, doc.images);
    }
}

#[test]
fn what_changed_keeps_its_grid() {
    let grid = grid(12);
    for method in [0, 1] {
        let stream = draco(&grid, method, 5);
        let (mut doc, _) = open(&draco_document(&grid, &stream), &stream).unwrap();
        // New texture coordinates on the grid of a sheet, as refining makes them.
        let uvs: Vec<[f32; 2]> =
            read_vec2(&doc, 1).unwrap().iter().map(|uv| uv.map(|x| (x * 3000.0).round() / 4096.0)).collect();
        let uv = doc.append_accessor(&RawAccessor::from_floats(&uvs), Some(ARRAY_BUFFER), false);
        doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
        let (again, json, warnings) = delivered(&doc, Compression::Keep);
        assert!(warnings.is_empty() && json["extensionsUsed"].to_string().contains(DRACO), "{warnings:?}");
        let found = (read_vec3(&again, position(&again)).unwrap(), read_vec2(&again, uv_of(&again)).unwrap());
        // To the bit: positions lie on the grid that they came on, texture coordinates on that of their sheet.
        let corners = |positions: &[[f32; 3]], uvs: &[[f32; 2]], indices: &RawAccessor| {
            let corner = |v: &u32| {
                let (p, uv) = (positions[*v as usize], uvs[*v as usize]);
                [p[0], p[1], p[2], uv[0], uv[1]].map(f32::to_bits)
            };
            let mut all: Vec<_> = indices.unsigned().unwrap().iter().map(corner).collect();
            all.sort();
            all
        };
        let before = corners(&read_vec3(&doc, 0).unwrap(), &uvs, &elements(&doc, "indices"));
        assert_eq!(corners(&found.0, &found.1, &elements(&again, "indices")), before, "method {method}");
    }
}

fn position(doc: &Document) -> usize {
    doc.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"].as_u64().unwrap() as usize
}

fn uv_of(doc: &Document) -> usize {
    doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"].as_u64().unwrap() as usize
}

/// A plain document with an attribute of every component type and shape.
fn every_type() -> Document {
    let mut random = Random(7);
    let grid = grid(9);
    let count = grid.positions.len();
    let (mut doc, _) = open(&json!({ "asset": { "version": "2.0" } }), &[]).unwrap();
    let mut attributes = serde_json::Map::new();
    let mut add = |doc: &mut Document, name: String, raw: &RawAccessor| {
        let index = doc.append_accessor(raw, Some(ARRAY_BUFFER), name == "POSITION");
        attributes.insert(name, json!(index));
    };
    add(&mut doc, "POSITION".to_owned(), &RawAccessor::from_floats(&grid.positions));
    add(&mut doc, "TEXCOORD_0".to_owned(), &RawAccessor::from_floats(&grid.uvs));
    for component in [
        ComponentType::I8,
        ComponentType::U8,
        ComponentType::I16,
        ComponentType::U16,
        ComponentType::U32,
        ComponentType::F32,
    ] {
        for kind in [Kind::Scalar, Kind::Vec2, Kind::Vec3, Kind::Vec4] {
            let size = component.size() * kind.multiplicity();
            // Floats are finite: their exponents stay small.
            let mut data: Vec<u8> = (0..count * size).map(|n| (n / size + random.below(40)) as u8).collect();
            if component == ComponentType::F32 {
                data.chunks_exact_mut(4).for_each(|b| b[3] = 0x3F);
            }
            add(&mut doc, format!("_{component:?}_{kind:?}"), &RawAccessor::new(component, kind, false, data));
        }
    }
    let indices =
        doc.append_accessor(&RawAccessor::from_indices(grid.faces.as_flattened()), Some(ELEMENT_ARRAY_BUFFER), false);
    doc.json["meshes"] = json!([{ "primitives": [{ "attributes": attributes, "indices": indices }] }]);
    doc
}

#[test]
fn every_component_type_comes_back() {
    let doc = every_type();
    let names: Vec<String> =
        doc.json["meshes"][0]["primitives"][0]["attributes"].as_object().unwrap().keys().cloned().collect();
    let (again, json, _) = delivered(&doc, Compression::Meshopt);
    assert!(json["bufferViews"].as_array().unwrap().iter().any(|v| v.get("extensions").is_some()));
    for name in &names {
        assert_eq!(elements(&again, name), elements(&doc, name), "{name}");
    }
    let triangles_of = |doc: &Document| {
        triangles(
            &read_vec3(doc, position(doc)).unwrap(),
            &read_vec2(doc, uv_of(doc)).unwrap(),
            &elements(doc, "indices").unsigned().unwrap(),
        )
    };
    assert_eq!(triangles_of(&again), triangles_of(&doc));

    let (again, _, warnings) = delivered(&doc, Compression::Draco);
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(again.origins.streams.len(), 1);
    // Vertices come in another order; integers and the user's own floats are what they were.
    for name in names.iter().filter(|name| name.starts_with('_')) {
        let sorted = |doc: &Document| {
            let raw = elements(doc, name);
            let mut all: Vec<Vec<u8>> = raw.data.chunks(raw.element_size).map(<[u8]>::to_vec).collect();
            all.sort();
            all
        };
        assert_eq!(sorted(&again), sorted(&doc), "{name}");
    }
    let low = |doc: &Document| read_vec3(doc, position(doc)).unwrap().iter().map(|p| p[2]).fold(f32::MAX, f32::min);
    assert!((low(&again) - low(&doc)).abs() < 1.0 / 16384.0);

    let (plain, json, _) = delivered(&again, Compression::None);
    assert!(json.get("extensionsUsed").is_none(), "{json}");
    assert_eq!(elements(&plain, "POSITION"), elements(&again, "POSITION"));
}

#[test]
fn what_draco_cannot_carry_stays_and_morph_targets_keep_their_vertices() {
    let mut doc = every_type();
    doc.json["meshes"][0]["primitives"][0]["targets"] = json!([{ "POSITION": position(&doc) }]);
    let mut strip = doc.json["meshes"][0]["primitives"][0].clone();
    strip["mode"] = json!(5);
    doc.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(strip);
    let (again, json, warnings) = delivered(&doc, Compression::Draco);
    assert_eq!(warnings, ["not_compressed"]);
    let primitives = &json["meshes"][0]["primitives"];
    assert!(primitives[0]["extensions"].get(DRACO).is_some() && primitives[1].get("extensions").is_none());
    for name in ["indices", "_U16_Vec4", "_F32_Vec3"] {
        assert_eq!(elements(&again, name).unsigned(), elements(&doc, name).unsigned(), "{name} is in order");
    }
    let target = again.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"].as_u64().unwrap() as usize;
    assert_eq!(raw_elements(&again, target).unwrap(), elements(&doc, "POSITION"));
}

#[test]
fn indices_that_something_may_name_unseen_stay() {
    let grid = grid(20);
    let stream = draco(&grid, 1, 5);
    let mut json = draco_document(&grid, &stream);
    json["extensionsUsed"].as_array_mut().unwrap().push(json!("ACME_tables"));
    json["extensions"] = json!({ "ACME_tables": { "bufferView": 0, "accessor": 2 } });
    let (mut doc, _) = open(&json, &stream).unwrap();
    let (_, kept, _) = delivered(&doc, Compression::Keep);
    let length = |json: &Value| json["buffers"][0]["byteLength"].as_u64().unwrap() as usize;
    assert_eq!(kept["accessors"].as_array().unwrap().len(), 3);
    assert!(length(&kept) < stream.len() + 8, "what was decoded is not there too: {kept}");
    // Another stream takes the place of the one that it replaces.
    let uvs = vec![[0.5f32; 2]; read_vec2(&doc, 1).unwrap().len()];
    let uv = doc.append_accessor(&RawAccessor::from_floats(&uvs), Some(ARRAY_BUFFER), false);
    doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
    let (_, changed, _) = delivered(&doc, Compression::Keep);
    assert_eq!(changed["meshes"][0]["primitives"][0]["extensions"][DRACO]["bufferView"], 0);
    assert!(length(&changed) < stream.len() + 8, "the old stream is gone: {changed}");
}

#[test]
fn triangles_with_two_corners_at_one_place_do_not_keep_a_mesh_from_its_codec() {
    let mut grid = grid(9);
    grid.positions.push(grid.positions[7]);
    grid.uvs.push([0.25; 2]);
    let last = grid.positions.len() as u32 - 1;
    grid.faces.extend([[7, last, 8], [7, 7, 8]]);
    let (mut doc, _) = open(&json!({ "asset": { "version": "2.0" } }), &[]).unwrap();
    let position = doc.append_accessor(&RawAccessor::from_floats(&grid.positions), Some(ARRAY_BUFFER), true);
    let uv = doc.append_accessor(&RawAccessor::from_floats(&grid.uvs), Some(ARRAY_BUFFER), false);
    let indices = RawAccessor::from_indices(grid.faces.as_flattened());
    let indices = doc.append_accessor(&indices, Some(ELEMENT_ARRAY_BUFFER), false);
    doc.json["meshes"] =
        json!([{ "primitives": [{ "attributes": { "POSITION": position, "TEXCOORD_0": uv }, "indices": indices }] }]);
    let (again, _, warnings) = delivered(&doc, Compression::Draco);
    assert_eq!(warnings, ["degenerate_faces_dropped"]);
    assert_eq!(again.origins.streams[0].stream[8], 1, "it makes use of edges");
    assert!(elements(&again, "indices").count < 3 * grid.faces.len());
}

#[test]
fn threads_do_not_matter() {
    let mut doc = every_type();
    let primitive = doc.json["meshes"][0]["primitives"][0].clone();
    for n in 0..6 {
        let mut other = primitive.clone();
        other["attributes"].as_object_mut().unwrap().retain(|name, _| name != &format!("_F32_Vec{n}"));
        doc.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(other);
    }
    let saved = |threads: usize, compression: Compression| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut doc = doc.clone();
        pool.install(|| doc.compress(compression, &Context::silent())).unwrap();
        doc.to_glb().unwrap()
    };
    for compression in [Compression::Meshopt, Compression::Draco] {
        assert_eq!(saved(1, compression), saved(4, compression));
    }
}

/// A sequence of bits that looks random and is the same on every machine (xorshift).
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % limit.max(1) as u64) as usize
    }

    /// A few bytes changed, set, inserted or cut off, more often near the beginning, where counts are.
    fn mutate(&mut self, stream: &mut Vec<u8>) {
        for _ in 0..1 + self.below(6) {
            let near = if self.below(2) == 0 { stream.len().min(60) } else { stream.len() };
            let at = self.below(near);
            let kind = self.below(6);
            match (kind, stream.get_mut(at)) {
                (0, Some(byte)) => *byte ^= 1 << self.below(8),
                (1, Some(byte)) => *byte = self.below(256) as u8,
                (2, Some(byte)) => *byte = 0xFF,
                (3, Some(byte)) => *byte = 0,
                (4, _) => stream.truncate(at),
                _ => stream.insert(at.min(stream.len()), self.below(256) as u8),
            }
        }
    }
}

/// Thousands more with INTARSIA_MUTATIONS.
#[test]
fn mutated_streams_are_answered_in_time() {
    let count = std::env::var("INTARSIA_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(600);
    let (view, buffer) = meshopt_document();
    let grids = [grid(1), grid(6)];
    let mut cases = vec![(view, buffer)];
    for grid in &grids {
        for (method, speed) in [(0, 10), (1, 0), (1, 3), (1, 10)] {
            let stream = draco(grid, method, speed);
            cases.push((draco_document(grid, &stream), stream));
        }
    }
    let mut random = Random(0x9E37_79B9_7F4A_7C15);
    let (mut read, mut slowest) = (0, Duration::ZERO);
    for _ in 0..count {
        let (mut json, mut buffer) = cases[random.below(cases.len())].clone();
        random.mutate(&mut buffer);
        json["buffers"][0]["byteLength"] = json!(buffer.len());
        if json["bufferViews"].as_array().unwrap().len() == 1 {
            json["bufferViews"][0]["byteLength"] = json!(buffer.len());
        }
        if random.below(4) == 0 {
            let last = json["accessors"].as_array().unwrap().len() - 1;
            json["accessors"][last]["count"] = json!(60_000_000);
        }
        let start = Instant::now();
        match open(&json, &buffer) {
            Ok((doc, _)) => {
                read += 1;
                doc.to_glb().unwrap();
                // What a hostile stream became is compressed again, or told of.
                let mut doc = doc;
                if doc.compress(Compression::Keep, &Context::silent()).is_ok() {
                    doc.to_glb().unwrap();
                }
            }
            Err(failure) => {
                assert!(matches!(failure.code, Code::InvalidModel | Code::TooLarge), "{failure}");
                assert!(!failure.message.contains("breaks its decoder"), "{failure}: {}", hex::encode(&buffer));
            }
        }
        slowest = slowest.max(start.elapsed());
    }
    assert!(slowest < Duration::from_secs(2), "{slowest:?}");
    assert!(read > 0 && read < count, "some are read, some are not");
}
