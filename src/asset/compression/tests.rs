//! Documents with compressed geometry, from files to a plain [`Document`].

use std::time::{Duration, Instant};

use draco_core::{
    DataType, EncoderBuffer, EncoderOptions, FaceIndex, GeometryAttributeType, Mesh, MeshEncoder, PointAttribute,
    PointIndex,
};
use serde_json::{Value, json};

use crate::asset::{Document, File, Limits, load, load_while, read_indices, read_vec2, read_vec3};
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
        assert_eq!(codes(&warnings), ["decompressed"], "{warnings:?}");
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
    assert_eq!(codes(&warnings), ["accessor_count_corrected", "decompressed"]);
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
    assert_eq!(codes(&warnings), ["accessor_count_corrected", "decompressed"]);
    assert_eq!(warnings[0].pointer.as_deref(), Some("/meshes/0/primitives/0"));
    assert_eq!(doc.json["accessors"][0]["count"], 25);
    // Nor is it the accessors that say how many triangles there are, or how wide their indices.
    json["accessors"][2]["count"] = json!(6);
    let (doc, warnings) = open(&json, &stream).unwrap();
    assert_eq!(codes(&warnings), ["accessor_count_corrected", "decompressed"]);
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
    assert_eq!(codes(&open(&outside, &stream).unwrap().1), ["accessor_count_corrected", "decompressed"]);

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
        assert_eq!(codes(&warnings), ["decompressed"], "{warnings:?}");
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
