//! The container and accessor level, from files to files.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::error::{Code, Failure, Result, Warning};

/// A PNG by its first bytes only: nothing here decodes it.
const PICTURE: &[u8] = b"\x89PNG\r\n\x1a\nnot really";

/// A triangle with UVs and indices; an image in a buffer view; things that nobody here knows of.
fn small() -> Document {
    let json = json!({ "asset": { "version": "2.0", "extras": { "long": 0.30000000000000004, "big": 1e300 } } });
    let mut doc = Document {
        json,
        buffers: Vec::new(),
        images: Vec::new(),
        name: "m".to_owned(),
        merging: Default::default(),
        tile: None,
        undefined: Default::default(),
        origins: Default::default(),
        compressed: None,
    };
    let positions = RawAccessor::from_floats(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.1, 0.0]]);
    let position = doc.append_accessor(&positions, Some(ARRAY_BUFFER), true);
    let uvs = RawAccessor::from_floats(&[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
    let uv = doc.append_accessor(&uvs, Some(ARRAY_BUFFER), false);
    let indices = doc.append_accessor(&RawAccessor::from_indices(&[0, 1, 2]), Some(ELEMENT_ARRAY_BUFFER), false);
    let view = doc.append_buffer_view(PICTURE, None);
    doc.push("images", json!({ "name": "p", "mimeType": "image/png", "bufferView": view }));
    doc.images.push(Some(PICTURE.to_vec()));
    let attributes = json!({ "POSITION": position, "TEXCOORD_0": uv });
    doc.push("meshes", json!({ "primitives": [{ "attributes": attributes, "indices": indices }] }));
    doc.push("nodes", json!({ "mesh": 0, "extras": { "z": 1, "a": [1, 2.5, null] } }));
    doc
}

fn file(path: &str, bytes: impl AsRef<[u8]>) -> File {
    File { path: path.to_owned(), bytes: bytes.as_ref().to_vec() }
}

fn open(files: &[File]) -> Result<(Document, Vec<Warning>)> {
    load(files, None, &Limits::default())
}

/// Loads the small model after a change to its JSON.
fn changed(pointer: &str, value: Value) -> Result<(Document, Vec<Warning>)> {
    let doc = small();
    let mut json = doc.json.clone();
    match json.pointer_mut(pointer) {
        Some(place) => *place = value,
        None => {
            let (parent, key) = pointer.rsplit_once('/').unwrap();
            match json.pointer_mut(parent).unwrap() {
                Value::Array(array) => array.push(value),
                object => object[key] = value,
            }
        }
    }
    let glb = glb::build(serde_json::to_vec(&json).unwrap(), &doc.buffers[0], 4).unwrap();
    open(&[file("m.glb", glb)])
}

fn failure(pointer: &str, value: Value) -> Failure {
    changed(pointer, value.clone()).map(|_| ()).expect_err(&format!("{pointer} = {value}"))
}

#[test]
fn a_round_trip_keeps_values_and_data() {
    let doc = small();
    let glb = doc.to_glb().unwrap();
    let (back, warnings) = open(&[file("dir/m.glb", &glb)]).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(back.json, doc.json);
    assert_eq!((&back.buffers, &back.images, &back.name), (&doc.buffers, &doc.images, &doc.name));
    assert_eq!(back.to_glb().unwrap(), glb);

    let files = back.to_gltf().unwrap();
    let names: Vec<&str> = files.iter().map(|f| f.path.as_str()).collect();
    assert_eq!(names, ["model.gltf", "model.bin", "image-0.png"]);
    let (third, _) = open(&files).unwrap();
    assert_eq!(third.images, doc.images);
    assert_eq!(third.json["nodes"], doc.json["nodes"]);
    for accessor in 0..3 {
        assert_eq!(raw_elements(&third, accessor).unwrap(), raw_elements(&doc, accessor).unwrap());
    }
}

#[test]
fn buffers_and_images_come_from_everywhere_and_go_into_one_chunk() {
    let json = json!({
        "asset": { "version": "2.0" },
        "buffers": [{ "byteLength": 3, "uri": "a%20b.bin", "name": "first" }, { "byteLength": 4, "uri": "data:;base64,AQIDBA==" }],
        "bufferViews": [{ "buffer": 0, "byteLength": 3 }, { "buffer": 1, "byteOffset": 1, "byteLength": 3 }],
        "accessors": [
            { "bufferView": 0, "componentType": 5121, "count": 3, "type": "SCALAR" },
            { "bufferView": 1, "componentType": 5121, "count": 3, "type": "SCALAR" },
        ],
        "images": [{ "uri": "t/x.png" }, { "uri": "data:image/png;base64,iVBORwE=" }, { "uri": "http://a/b.png" }, { "uri": "gone.jpg" }],
        "extensionsUsed": ["ACME_unknown"],
    });
    let files = [file("q/m.gltf", json.to_string()), file("q/a b.bin", [7, 8, 9, 10]), file("q/t/x.png", PICTURE)];
    let (doc, warnings) = open(&files).unwrap();
    let told: Vec<_> = warnings.iter().map(|w| (w.code.as_str(), w.pointer.as_deref().unwrap())).collect();
    assert_eq!(told, [("missing_image", "/images/2"), ("missing_image", "/images/3")]);
    let (back, _) = open(&[file("m.glb", doc.to_glb().unwrap())]).unwrap();
    assert_eq!(back.buffers.len(), 1);
    assert_eq!(back.json["buffers"][0]["name"], "first");
    assert_eq!(read_indices(&back, 0).unwrap(), [7, 8, 9]);
    assert_eq!(read_indices(&back, 1).unwrap(), [2, 3, 4]);
    assert_eq!(back.images, doc.images);
    assert_eq!(back.json["images"][0], json!({ "mimeType": "image/png", "bufferView": 2 }));
    assert_eq!(back.json["images"][3], json!({ "uri": "gone.jpg" }));
    let names: Vec<String> = doc.to_gltf().unwrap().into_iter().map(|f| f.path).collect();
    assert_eq!(names, ["model.gltf", "model.bin", "t/x.png", "image-1.png"]);
}

#[test]
fn what_nothing_refers_to_any_more_is_not_shipped() {
    let mut doc = small();
    let uvs = RawAccessor::from_floats(&[[0.5, 0.0], [1.0, 0.5], [0.0, 0.5]]);
    let uv = doc.append_accessor(&uvs, Some(ARRAY_BUFFER), false);
    doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(uv);
    doc.set_image(0, vec![0xFF, 0xD8, 0xFF, 5], "image/jpeg");
    let (back, warnings) = open(&[file("m.glb", doc.to_glb().unwrap())]).unwrap();
    assert!(warnings.is_empty(), "{warnings:?}");
    assert_eq!(back.json["accessors"].as_array().unwrap().len(), 3);
    assert_eq!(back.json["images"][0]["name"], "p");
    assert_eq!(back.json["images"][0]["mimeType"], "image/jpeg");
    assert_eq!(back.images, doc.images);
    let attributes = &back.json["meshes"][0]["primitives"][0]["attributes"];
    assert_eq!(raw_elements(&back, attributes["TEXCOORD_0"].as_u64().unwrap() as usize).unwrap(), uvs);
    assert!(!back.buffers[0].windows(PICTURE.len()).any(|w| w == PICTURE));

    doc.json["nodes"][0]["extensions"] = json!({ "ACME_unknown": { "bufferView": 1 } });
    let (kept, _) = open(&[file("m.glb", doc.to_glb().unwrap())]).unwrap();
    assert_eq!(kept.json["accessors"], doc.json["accessors"]);
    assert!(kept.buffers[0].windows(PICTURE.len()).any(|w| w == PICTURE));
}

#[test]
fn every_component_type_stride_and_sparseness_is_read() {
    let mut doc = small();
    let cases: [(ComponentType, bool, &[u8], [f32; 2]); 8] = [
        (ComponentType::I8, true, &[0x80, 127], [-1.0, 1.0]),
        (ComponentType::I8, false, &[0x80, 127], [-128.0, 127.0]),
        (ComponentType::U8, true, &[255, 51], [1.0, 0.2]),
        (ComponentType::I16, true, &[0, 0x80, 0xFF, 0x7F], [-1.0, 1.0]),
        (ComponentType::U16, true, &[0xFF, 0xFF, 0x33, 0x33], [1.0, 0.2]),
        (ComponentType::U16, false, &[1, 0, 0, 1], [1.0, 256.0]),
        (ComponentType::U32, false, &[1, 0, 0, 0, 0, 0, 1, 0], [1.0, 65536.0]),
        (ComponentType::F32, false, &[0, 0, 0xC0, 0x7F, 0, 0, 0x80, 0x3F], [f32::NAN, 1.0]),
    ];
    for (component, normalized, data, expected) in cases {
        let raw = RawAccessor::new(component, Kind::Vec2, normalized, data.to_vec());
        // Vertex attributes are padded to four bytes, and read back through the stride.
        let index = doc.append_accessor(&raw, Some(ARRAY_BUFFER), true);
        assert_eq!(raw_elements(&doc, index).unwrap(), raw);
        let [found] = read_vec2(&doc, index).unwrap()[..] else { panic!("one element") };
        assert!(found.iter().zip(expected).all(|(a, b)| a.to_bits() == b.to_bits()), "{found:?} {expected:?}");
    }
    let indices = doc.append_buffer_view(&[1, 3], None);
    let values = doc.append_buffer_view(&[1.0_f32, 2.0, 3.0, 4.0].map(f32::to_le_bytes).concat(), None);
    let sparse = json!({
        "componentType": 5126, "count": 4, "type": "VEC2",
        "sparse": { "count": 2, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values } },
    });
    let index = doc.push("accessors", sparse);
    assert_eq!(read_vec2(&doc, index).unwrap(), [[0.0, 0.0], [1.0, 2.0], [0.0, 0.0], [3.0, 4.0]]);
    for (bytes, word) in [([3_u8, 1], "rise"), ([1, 4], "out of range")] {
        let wrong = doc.append_buffer_view(&bytes, None);
        doc.json["accessors"][index]["sparse"]["indices"]["bufferView"] = json!(wrong);
        let failure = read_vec2(&doc, index).unwrap_err();
        assert!(failure.message.contains(word), "{failure}");
        assert_eq!(failure.pointer, Some(format!("/accessors/{index}/sparse/indices")));
    }
    assert!(read_vec3(&doc, index).is_err());
    assert_eq!(read_indices(&doc, index).unwrap_err().pointer, Some(format!("/accessors/{index}/type")));
    assert!(raw_elements(&doc, 999).is_err());
}

#[test]
fn broken_documents_are_refused_with_code_and_pointer() {
    use Code::{InvalidModel, MissingFile, TooLarge, UnsupportedExtension};
    let cases: Vec<(&str, Value, Code, &str)> = vec![
        ("/asset", json!(null), InvalidModel, "/asset"),
        ("/asset/version", json!("1.0"), InvalidModel, "/asset/version"),
        ("/asset/version", json!(2.0), InvalidModel, "/asset/version"),
        ("/asset/minVersion", json!("2.1"), InvalidModel, "/asset/minVersion"),
        (
            "/extensionsRequired",
            json!(["KHR_materials_unlit", "ACME_x"]),
            UnsupportedExtension,
            "/extensionsRequired/1",
        ),
        ("/meshes", json!({}), InvalidModel, "/meshes"),
        ("/nodes", json!([1]), InvalidModel, "/nodes/0"),
        ("/buffers/0/byteLength", json!(100_000), InvalidModel, "/buffers/0/byteLength"),
        ("/buffers/0/byteLength", json!(-1), InvalidModel, "/buffers/0/byteLength"),
        ("/buffers/0/uri", json!("x.bin"), MissingFile, "/buffers/0/uri"),
        ("/buffers/0/uri", json!("../x.bin"), InvalidModel, "/buffers/0/uri"),
        ("/buffers/0/uri", json!("https://a/x.bin"), InvalidModel, "/buffers/0/uri"),
        ("/buffers/0/uri", json!("data:;base64,%%"), InvalidModel, "/buffers/0/uri"),
        ("/buffers/1", json!({ "byteLength": 4 }), InvalidModel, "/buffers/1"),
        ("/bufferViews/0/buffer", json!(1), InvalidModel, "/bufferViews/0/buffer"),
        ("/bufferViews/0/byteLength", json!(u64::MAX), InvalidModel, "/bufferViews/0"),
        ("/bufferViews/0/byteOffset", json!(100_000), InvalidModel, "/bufferViews/0"),
        ("/bufferViews/0/byteStride", json!(8), InvalidModel, "/accessors/0"),
        ("/bufferViews/0/byteStride", json!(16), InvalidModel, "/accessors/0"),
        ("/accessors/0/bufferView", json!(77), InvalidModel, "/accessors/0/bufferView"),
        ("/accessors/0/componentType", json!(5124), InvalidModel, "/accessors/0/componentType"),
        ("/accessors/0/type", json!("VEC5"), InvalidModel, "/accessors/0/type"),
        ("/accessors/0/count", json!(4), InvalidModel, "/accessors/0"),
        ("/accessors/0/count", json!(1.5), InvalidModel, "/accessors/0/count"),
        ("/accessors/0/count", json!(u64::MAX), TooLarge, "/accessors/0/count"),
        ("/accessors/0/byteOffset", json!(u64::MAX), InvalidModel, "/accessors/0"),
        ("/accessors/0/sparse", json!([]), InvalidModel, "/accessors/0/sparse"),
        ("/accessors/0/sparse", json!({ "count": 1 }), InvalidModel, "/accessors/0/sparse"),
        ("/accessors/0/sparse", json!({ "count": 1, "indices": 1 }), InvalidModel, "/accessors/0/sparse/indices"),
        ("/accessors/0/bufferView", json!(1_u64 << 32), InvalidModel, "/accessors/0/bufferView"),
        ("/bufferViews/0/buffer", json!(1_u64 << 32), InvalidModel, "/bufferViews/0/buffer"),
        ("/images/0/bufferView", json!(99), InvalidModel, "/images/0/bufferView"),
        (
            "/accessors/3",
            json!({ "componentType": 5126, "type": "MAT4", "count": 60_000_000 }),
            TooLarge,
            "/accessors/3/count",
        ),
    ];
    for (pointer, value, code, at) in cases {
        let failure = failure(pointer, value.clone());
        assert_eq!((failure.code, failure.pointer.as_deref()), (code, Some(at)), "{pointer} = {value}: {failure}");
    }
    let sparse = |indices: Value, values: Value| json!({ "count": 3, "indices": indices, "values": values });
    let good = json!({ "bufferView": 2, "componentType": 5123 });
    let long = json!({ "bufferView": 2, "componentType": 5125 });
    let signed = json!({ "bufferView": 2, "componentType": 5122 });
    for (indices, values, at) in [
        (long, json!({ "bufferView": 0 }), "/accessors/0/sparse/indices"),
        (signed, json!({ "bufferView": 0 }), "/accessors/0/sparse/indices/componentType"),
        (good.clone(), json!({ "bufferView": 2 }), "/accessors/0/sparse/values"),
        (good, json!({ "bufferView": 88 }), "/accessors/0/sparse/values/bufferView"),
    ] {
        assert_eq!(failure("/accessors/0/sparse", sparse(indices, values)).pointer.as_deref(), Some(at));
    }
}

#[test]
fn deviations_that_can_be_read_are_warnings() {
    for (pointer, value, code) in [
        ("/bufferViews/0/byteOffset", json!(1), "misaligned_accessor"),
        ("/images/0", json!({ "uri": "gone.png" }), "missing_image"),
        ("/images/0", json!({}), "missing_image"),
        ("/images/0", json!({ "uri": "data:image/png;base64,*" }), "invalid_image"),
        ("/images/0", json!({ "uri": "/etc/passwd" }), "missing_image"),
    ] {
        let (doc, warnings) = changed(pointer, value).unwrap();
        assert_eq!(warnings.iter().map(|w| w.code.as_str()).collect::<Vec<_>>(), [code]);
        assert!(doc.images[0].is_none() || code == "misaligned_accessor");
    }
    assert!(changed("/bufferViews/0/byteStride", json!(0)).unwrap().1.is_empty());
    // Writers without an integer type write floats, and extras may be anything.
    for (pointer, value) in [
        ("/accessors/0/count", json!(3.0)),
        ("/accessors/0/bufferView", json!(0.0)),
        ("/accessors/0/componentType", json!(5126.0)),
        ("/bufferViews/0/buffer", json!(0.0)),
        ("/bufferViews/0/extras", json!(7)),
        ("/accessors/0/extras", json!("mine")),
    ] {
        let (doc, warnings) = changed(pointer, value.clone()).unwrap();
        assert!(warnings.is_empty() && read_vec3(&doc, 0).unwrap().len() == 3, "{pointer} = {value}");
    }
}

#[test]
fn the_model_is_found_by_content_and_name() {
    let glb = small().to_glb().unwrap();
    let message = |files: &[File]| open(files).unwrap_err().message;
    assert!(message(&[]).contains("no file"));
    assert!(message(&[file("m.glb", "")]).contains("empty"));
    assert!(message(&[file("m", "")]).contains("empty"));
    assert!(message(&[file("m.bin", "hello")]).contains("neither"));
    assert!(message(&[file("m.glb", "hello world!")]).contains("magic"));
    assert!(message(&[file("m.gltf", "{")]).contains("JSON"));
    assert!(message(&[file("m.gltf", "[]")]).contains("object"));
    assert!(message(&[file("a.glb", &glb), file("b.glb", &glb)]).contains("several"));
    let both = [file("a.glb", &glb), file("b.glb", &glb)];
    assert_eq!(load(&both, Some("b.glb"), &Limits::default()).unwrap().0.name, "b");
    assert_eq!(load(&both, Some("c.glb"), &Limits::default()).unwrap_err().code, Code::MissingFile);
    assert_eq!(open(&[file("blob", &glb), file("x.png", PICTURE)]).unwrap().0.name, "blob");
    assert_eq!(open(&[file("text", "# made by hand\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")]).unwrap().0.name, "text");

    let mut writer = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for side in small().to_gltf().unwrap() {
        writer.start_file(format!("folder/{}", side.path), zip::write::SimpleFileOptions::default()).unwrap();
        std::io::Write::write_all(&mut writer, &side.bytes).unwrap();
    }
    let zip = writer.finish().unwrap().into_inner();
    for main in [None, Some("up.zip"), Some("folder/model.gltf")] {
        let (doc, warnings) = load(&[file("up.zip", &zip)], main, &Limits::default()).unwrap();
        assert!(warnings.is_empty() && doc.images[0].is_some());
    }
}

#[test]
fn limits_hold() {
    let glb = small().to_glb().unwrap();
    let open = |limits: &Limits| load(&[file("m.glb", &glb)], None, limits).map(|_| ()).unwrap_err().code;
    let limits = Limits::default();
    assert_eq!(open(&Limits { max_input_bytes: 100, ..limits }), Code::TooLarge);
    assert_eq!(open(&Limits { max_json_bytes: 100, ..limits }), Code::TooLarge);
    assert_eq!(open(&Limits { max_triangles: 0, ..limits }), Code::TooLarge);
    let deep = format!("{{\"asset\":{}", "[".repeat(100_000));
    assert_eq!(super::load(&[file("m.gltf", deep)], None, &limits).unwrap_err().code, Code::InvalidModel);
    let wide = format!("{{\"asset\":[{}0]}}", "0,".repeat(9_000_000));
    assert_eq!(super::load(&[file("m.gltf", wide)], None, &limits).unwrap_err().code, Code::TooLarge);
    // One file named many times counts many times.
    let image = json!({ "uri": "x.png" });
    let json = json!({ "asset": { "version": "2.0" }, "images": vec![image; 100] }).to_string();
    let files = [file("m.gltf", json), file("x.png", vec![0; 1000])];
    let limits = Limits { max_input_bytes: 5000, ..limits };
    assert_eq!(super::load(&files, None, &limits).unwrap_err().code, Code::TooLarge);
}

#[test]
fn side_files_are_read_from_disk() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let obj = write("in/m.obj", b"mtllib m m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    write("in/m m.mtl", b"newmtl a\nmap_Kd t/a b.png\nnorm ../secret.png\nmap_Ke gone.png\n");
    write("in/t/a b.png", PICTURE);
    write("secret.png", PICTURE);
    let files = read_paths(std::slice::from_ref(&obj)).unwrap();
    let names: Vec<&str> = files.iter().map(|f| f.path.as_str()).collect();
    assert_eq!(names, ["m.obj", "t/a b.png", "m m.mtl"]);
    let (doc, _) = open(&files).unwrap();
    assert_eq!(doc.images[0].as_deref(), Some(PICTURE));
    assert_eq!(read_paths(&[folder.path().join("none.obj")]).unwrap_err().code, Code::MissingFile);
}

proptest! {
    #[test]
    fn mutated_models_are_answered(changes in proptest::collection::vec((0_usize..2000, any::<u8>()), 1..4), end in 0_usize..4000) {
        let mut glb = small().to_glb().unwrap();
        let length = glb.len();
        for (at, byte) in changes {
            glb[at % length] = byte;
        }
        glb.truncate(end);
        let mut failures = Vec::new();
        match open(&[file("m.glb", &glb)]) {
            Ok((doc, _)) => {
                failures.extend((0..4).filter_map(|accessor| read_vec3(&doc, accessor).err()));
                failures.extend((0..4).filter_map(|accessor| read_indices(&doc, accessor).err()));
                failures.extend(doc.to_glb().err());
                failures.extend(doc.to_gltf().err());
            }
            Err(failure) => failures.push(failure),
        }
        prop_assert!(failures.iter().all(|f| f.code != Code::Internal), "{:?}", failures);
    }
}
