//! Files made to break a reader, each with the answer that its owner gets.

use intarsia::asset::{File, Limits};
use intarsia::context::Context;
use intarsia::error::{Code, Failure};
use intarsia::refine::options::Options;
use intarsia::refine::{Input, Outcome, refine};
use serde_json::{Value, json};

use super::fixture::{file, glb, obj, parts, tiny, zip};
use super::guard::{MOST_SECONDS, measured};

/// Longest that any of these may take, in seconds: with all assertions, and on a machine that does other things too.
const LONGEST: f64 = 4.0 * MOST_SECONDS;
/// Most memory that any of these may take, in bytes: they are all small, or refused before they grow.
const MOST_BYTES: usize = 1 << 30;

fn refined(name: &str, files: Vec<File>) -> Result<Outcome, Failure> {
    let input = Input { models: vec![files], ..Input::default() };
    let mut best = f64::INFINITY;
    for _ in 0..2 {
        let (answer, cost) = measured(|| refine(&input, &Options::default(), &Context::silent()));
        let answer = answer.unwrap_or_else(|panic| panic!("{name} panics: {panic}"));
        assert!(cost.bytes < MOST_BYTES, "{name} takes {} bytes", cost.bytes);
        best = best.min(cost.seconds);
        if best <= LONGEST {
            return answer;
        }
    }
    panic!("{name} takes {best:.1} s");
}

#[track_caller]
fn refused(name: &str, files: Vec<File>, code: Code, words: &str) -> Failure {
    let failure = refined(name, files).map(|_| ()).expect_err(name);
    assert_eq!(failure.code, code, "{name}: {failure}");
    assert!(failure.message.contains(words), "{name}: `{words}` is not in: {failure}");
    failure
}

/// The codes of the warnings of a model that is taken.
#[track_caller]
fn warned(name: &str, files: Vec<File>) -> Vec<String> {
    let outcome = refined(name, files).unwrap_or_else(|failure| panic!("{name}: {failure}"));
    let warnings = outcome.report["warnings"].as_array().expect("warnings");
    warnings.iter().map(|w| w["code"].as_str().unwrap_or_default().to_owned()).collect()
}

/// The tiny model after a change to its JSON.
fn changed(change: impl FnOnce(&mut Value)) -> Vec<File> {
    let (mut json, bin) = parts(&tiny().to_glb().expect("a GLB"));
    change(&mut json);
    vec![file("m.glb", glb(json.to_string().as_bytes(), &bin))]
}

/// Shows the refusal of a change to the tiny model: its code, its pointer, its words.
#[track_caller]
fn wrong(pointer: &str, value: Value, code: Code, at: &str, words: &str) {
    let name = format!("{pointer} = {}", value.to_string().chars().take(60).collect::<String>());
    let files = changed(|json| match json.pointer_mut(pointer) {
        Some(found) => *found = value,
        None => {
            let (parent, key) = pointer.rsplit_once('/').expect("a parent");
            json.pointer_mut(parent).expect("a parent")[key] = value;
        }
    });
    let failure = refused(&name, files, code, words);
    assert_eq!(failure.pointer.as_deref(), Some(at), "{name}: {failure}");
}

#[test]
fn broken_containers() {
    use Code::InvalidModel;
    let whole = tiny().to_glb().expect("a GLB");
    let one = |bytes: &[u8]| vec![file("m.glb", bytes)];
    let patched = |at: usize, word: u32| {
        let mut bytes = whole.clone();
        bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
        one(&bytes)
    };
    refused("no bytes", one(b""), InvalidModel, "empty");
    refused("a header cut short", one(&whole[..11]), InvalidModel, "12 bytes are needed");
    refused("half of the file", one(&whole[..whole.len() / 2]), InvalidModel, "truncated");
    refused("a length too long", patched(8, u32::MAX), InvalidModel, "truncated");
    refused("a length too short", patched(8, 4), InvalidModel, "declares 4 bytes");
    refused("version 1", patched(4, 1), InvalidModel, "version 1");
    refused("a chunk too long", patched(12, u32::MAX), InvalidModel, "chunk 0 declares");
    refused("binary first", patched(16, 0x004E_4942), InvalidModel, "first GLB chunk");
    refused("not JSON", one(&glb(b"hello", b"")), InvalidModel, "cannot be parsed");
    let mut marked = b"\xEF\xBB\xBF".to_vec();
    marked.extend(parts(&whole).0.to_string().bytes());
    assert!(!warned("a byte order mark", one(&glb(&marked, &parts(&whole).1))).contains(&"invalid_model".to_owned()));
    let wide: Vec<u8> = "\u{FEFF}{\"asset\": {}}".encode_utf16().flat_map(u16::to_le_bytes).collect();
    refused("UTF-16 glTF", vec![file("m.gltf", &wide)], InvalidModel, "UTF-16");
    let wide: Vec<u8> = "\u{FEFF}v 0 0 0\n".encode_utf16().flat_map(u16::to_be_bytes).collect();
    refused("UTF-16 OBJ", vec![file("m.obj", &wide)], InvalidModel, "UTF-16");
    let deep = format!("{{\"asset\":{{\"version\":\"2.0\"}},\"extras\":{}", "[".repeat(1_000_000));
    refused("a million brackets", vec![file("m.gltf", deep)], InvalidModel, "recursion");
}

#[test]
fn lying_json() {
    use Code::{InvalidModel, MissingFile, TooLarge};
    wrong("/accessors/0/count", json!(u64::MAX), TooLarge, "/accessors/0/count", "more than any buffer holds");
    wrong("/accessors/0/count", json!(1e15), TooLarge, "/accessors/0/count", "more than any buffer holds");
    wrong("/accessors/0/count", json!(1_000_000), InvalidModel, "/accessors/0", "1000000 elements");
    wrong("/accessors/0/byteOffset", json!(u32::MAX), InvalidModel, "/accessors/0", "bufferView has");
    wrong("/bufferViews/0/byteStride", json!(1), InvalidModel, "/accessors/0", "byteStride 1");
    wrong("/bufferViews/0/byteStride", json!(u64::MAX), InvalidModel, "/accessors/0", "apart");
    wrong("/bufferViews/0/byteLength", json!(-5), InvalidModel, "/bufferViews/0/byteLength", "at least 0");
    wrong("/buffers/0/byteLength", json!(1_u64 << 40), InvalidModel, "/buffers/0/byteLength", "declares");
    wrong("/buffers/0/uri", json!("../../etc/passwd"), InvalidModel, "/buffers/0/uri", "leaves the folder");
    wrong("/buffers/0/uri", json!("%2e%2e/secret.bin"), InvalidModel, "/buffers/0/uri", "leaves the folder");
    wrong("/buffers/0/uri", json!("file:///etc/passwd"), InvalidModel, "/buffers/0/uri", "not a relative path");
    wrong("/buffers/0/uri", json!("gone.bin"), MissingFile, "/buffers/0/uri", "was not uploaded");
    wrong("/buffers/0/uri", json!("data:;base64,@@@@"), InvalidModel, "/buffers/0/uri", "base64");
    wrong("/buffers/0/uri", json!("data:nothing"), InvalidModel, "/buffers/0/uri", "comma");
    wrong("/nodes/1/children", json!([0]), InvalidModel, "/nodes/1/children/0", "circle");
    wrong("/nodes/2/children", json!([2]), InvalidModel, "/nodes/2/children/0", "circle");
    wrong("/nodes/0/children/1", json!(77), InvalidModel, "/nodes/0/children/1", "out of range");
    wrong("/nodes/1/mesh", json!(2), InvalidModel, "/nodes/1/mesh", "out of range");
    wrong("/scenes/0/nodes/0", json!(3), InvalidModel, "/scenes/0/nodes/0", "out of range");
    wrong("/skins/0/joints/0", json!("a"), InvalidModel, "/skins/0/joints/0", "is none");
    let at = "/meshes/0/primitives/0";
    wrong(&format!("{at}/attributes/POSITION"), json!(99), InvalidModel, &format!("{at}/attributes/POSITION"), "range");
    wrong(&format!("{at}/mode"), json!(9), InvalidModel, &format!("{at}/mode"), "out of range");
    wrong(&format!("{at}/material"), json!(-1), InvalidModel, &format!("{at}/material"), "is none");
}

/// Every reference to millions of bytes costs a few bytes of JSON: they are counted before they are followed.
#[test]
fn many_references_to_the_same_bytes() {
    let accessor = json!({ "bufferView": 0, "componentType": 5126, "count": 1_000_000, "type": "VEC3" });
    let many = |n: usize| {
        let primitive = |i: usize| json!({ "attributes": { "POSITION": i, "TEXCOORD_0": n }, "indices": n + 1 });
        let mut accessors = vec![accessor.clone(); n];
        accessors.push(json!({ "bufferView": 0, "componentType": 5126, "count": 1_000_000, "type": "VEC2" }));
        accessors.push(json!({ "bufferView": 0, "componentType": 5125, "count": 3, "type": "SCALAR" }));
        let json = json!({
            "asset": { "version": "2.0" },
            "buffers": [{ "byteLength": 12_000_000 }],
            "bufferViews": [{ "buffer": 0, "byteLength": 12_000_000 }],
            "accessors": accessors,
            "meshes": (0..n).map(|i| json!({ "primitives": [primitive(i)] })).collect::<Vec<_>>(),
        });
        vec![file("m.glb", glb(json.to_string().as_bytes(), &vec![0; 12_000_000]))]
    };
    let failure = refused("accessors without end", many(1000), Code::TooLarge, "together");
    assert!(failure.pointer.is_some_and(|p| p.starts_with("/accessors/")));

    // One accessor, and meshes that each use three of its vertices.
    let meshes = 2000;
    let json = json!({
        "asset": { "version": "2.0" },
        "buffers": [{ "byteLength": 12_000_000 }],
        "bufferViews": [{ "buffer": 0, "byteLength": 12_000_000 }],
        "accessors": [
            accessor,
            { "bufferView": 0, "componentType": 5126, "count": 1_000_000, "type": "VEC2" },
            { "bufferView": 0, "componentType": 5125, "count": 3, "type": "SCALAR" },
        ],
        "meshes": vec![json!({ "primitives": [{ "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "indices": 2 }] }); meshes],
    });
    let files = vec![file("m.glb", glb(json.to_string().as_bytes(), &vec![0; 12_000_000]))];
    assert_eq!(warned("meshes without end", files), ["nothing_to_refine"]);
}

#[test]
fn millions_of_complaints() {
    // Each accessor is misaligned, and each of 60,000 warnings is another one.
    let files = changed(|json| {
        let mut odd = json["accessors"][0].clone();
        odd["byteOffset"] = json!(1);
        odd["count"] = json!(1);
        let accessors = json["accessors"].as_array_mut().expect("accessors");
        accessors.extend(vec![odd; 60_000]);
    });
    let codes = warned("misaligned accessors", files);
    assert!(codes.len() < 1100 && codes.contains(&"more_warnings".to_owned()), "{} warnings", codes.len());
    let mut text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n".to_owned();
    for i in 0..1500 {
        text.push_str(&format!("usemtl material {i}\nf 1/1 2/2 3/3\n"));
    }
    let codes = warned("materials without a library", vec![file("m.obj", &text)]);
    assert!(codes.len() < 1100 && codes.contains(&"more_warnings".to_owned()), "{} warnings", codes.len());
}

#[test]
fn numbers_that_are_none() {
    let with = |accessor: usize, value: f32| {
        let (json, mut bin) = parts(&tiny().to_glb().expect("a GLB"));
        let view = json["accessors"][accessor]["bufferView"].as_u64().expect("a view") as usize;
        let at = json["bufferViews"][view]["byteOffset"].as_u64().unwrap_or(0) as usize;
        bin[at..at + 4].copy_from_slice(&value.to_le_bytes());
        vec![file("m.glb", glb(json.to_string().as_bytes(), &bin))]
    };
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for accessor in [0, 3] {
            // The triangles that read them are held back, and no others.
            let codes = warned("not finite", with(accessor, value));
            assert!(codes.contains(&"non_finite_triangles".to_owned()), "{value} in accessor {accessor}: {codes:?}");
        }
    }
    for value in [f32::MAX, f32::MIN, 1e-45, -1e20] {
        for accessor in [0, 3] {
            // Extreme but finite: whatever can be made of it, it is an answer.
            if let Err(failure) = refined("extreme numbers", with(accessor, value)) {
                assert!(failure.code != Code::Internal, "{value} in accessor {accessor}: {failure}");
            }
        }
    }
    let failure = refused("an index too high", changed_index(5), Code::InvalidModel, "index 5 is out of range");
    assert!(failure.pointer.is_some_and(|p| p.starts_with("/accessors/")));
    refused("the restart index", changed_index(0xFFFF), Code::InvalidModel, "index 65535 is out of range");
}

/// The tiny model with another first index.
fn changed_index(index: u16) -> Vec<File> {
    let (json, mut bin) = parts(&tiny().to_glb().expect("a GLB"));
    let accessor = json["meshes"][0]["primitives"][0]["indices"].as_u64().expect("indices") as usize;
    let view = json["accessors"][accessor]["bufferView"].as_u64().expect("a view") as usize;
    let at = json["bufferViews"][view]["byteOffset"].as_u64().unwrap_or(0) as usize;
    bin[at..at + 2].copy_from_slice(&index.to_le_bytes());
    vec![file("m.glb", glb(json.to_string().as_bytes(), &bin))]
}

#[test]
fn sparse_accessors_out_of_order() {
    let with = |first: u16, second: u16| {
        let (json, mut bin) = parts(&tiny().to_glb().expect("a GLB"));
        let target = json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"].as_u64().expect("a target") as usize;
        let sparse = json["accessors"][target]["sparse"].clone();
        let view = sparse["indices"]["bufferView"].as_u64().expect("a view") as usize;
        let at = json["bufferViews"][view]["byteOffset"].as_u64().unwrap_or(0) as usize;
        bin[at..at + 4].copy_from_slice(&[first.to_le_bytes(), second.to_le_bytes()].concat());
        let mut json = json;
        // As positions, so that they are read.
        json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = json!(target);
        vec![file("m.glb", glb(json.to_string().as_bytes(), &bin))]
    };
    refused("falling", with(4, 1), Code::InvalidModel, "must rise strictly");
    refused("equal", with(1, 1), Code::InvalidModel, "must rise strictly");
    refused("too high", with(1, 5), Code::InvalidModel, "out of range");
}

#[test]
fn archives() {
    let bomb = zip(&[file("m.glb", tiny().to_glb().expect("a GLB")), file("zeros", vec![0; 64 << 20])]);
    assert!(bomb.len() < 1 << 20);
    let input = Input {
        models: vec![vec![file("m.zip", &bomb)]],
        limits: Limits { max_input_bytes: 1 << 20, ..Limits::default() },
        extras: false,
    };
    let (answer, cost) = measured(|| refine(&input, &Options::default(), &Context::silent()));
    let failure = answer.expect("an answer").map(|_| ()).expect_err("a bomb");
    assert!(failure.code == Code::TooLarge && failure.message.contains("unpacks to more"), "{failure}");
    assert!(cost.bytes < 8 << 20, "a refused bomb takes {} bytes", cost.bytes);

    for name in ["../m.glb", "/m.glb", "a/../../m.glb", "..\\m.glb"] {
        let zip = zip(&[file(name, tiny().to_glb().expect("a GLB"))]);
        refused(name, vec![file("m.zip", zip)], Code::InvalidModel, "leaves its folder");
    }
    let many: Vec<File> = (0..10_001).map(|i| file(&i.to_string(), b"")).collect();
    refused("many entries", vec![file("m.zip", zip(&many))], Code::TooLarge, "more than 10000 entries");
    refused("no model", vec![file("m.zip", zip(&[file("a.txt", b"x")]))], Code::InvalidModel, "neither");
    refused("nothing", vec![file("m.zip", zip(&[]))], Code::InvalidModel, "no file");
    let inner = zip(&[file("m.glb", tiny().to_glb().expect("a GLB"))]);
    refused("a zip in a zip", vec![file("m.zip", zip(&[file("m.zip", inner)]))], Code::InvalidModel, "neither");
}

#[test]
fn obj_texts() {
    use Code::InvalidModel;
    let text = |text: &str| vec![file("m.obj", text)];
    let base = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n";
    let with = |line: &str| text(&format!("{base}{line}\n"));
    refused("an index too high", with("f 1/1 2/2 4/3"), InvalidModel, "line 7: position 4 is out of range");
    refused("an index too low", with("f -1 -2 -4"), InvalidModel, "line 7: position -4 is out of range");
    refused("index 0", with("f 0 1 2"), InvalidModel, "line 7: position 0 is out of range");
    refused("a huge index", with("f 1 2 99999999999999999999"), InvalidModel, "is not a position index");
    refused("4294967295", with("f 1 2 4294967295"), InvalidModel, "line 7");
    refused("a texture index too high", with("f 1/1 2/2 3/9"), InvalidModel, "line 7: texture coordinate 9");
    refused("a word", with("f a b c"), InvalidModel, "line 7: \"a\" is not a position index");
    for line in ["v nan 0 0\nf 1/1 2/2 4/3", "v 0 1e999 0\nf 1/1 2/2 4/3", "vt -inf 0\nf 1/1 2/2 3/4"] {
        let codes = warned(line, with(line));
        assert!(codes.contains(&"non_finite_triangles".to_owned()), "{line}: {codes:?}");
    }
    refused("half a vertex", text("v 0 1\n"), InvalidModel, "three coordinates");
    refused("only comments", text("# nothing\n"), InvalidModel, "no OBJ vertices");
    for (name, files) in [
        ("no faces", text(base)),
        ("no texture coordinates", with("f 1 2 3")),
        ("some texture coordinates", with("f 1/1 2 3/3")),
    ] {
        assert!(warned(name, files).contains(&"nothing_to_refine".into()), "{name}");
    }

    assert!(warned("a line and a point", with("f 1/1 2/2 3/3\nl 1 2\np 1")).contains(&"obj_elements_dropped".into()));
    let thin = warned("two corners", with("f 1/1 2/2\nf 1/1 2/2 3/3"));
    assert!(thin.contains(&"degenerate_faces_dropped".into()), "{thin:?}");
    let lost = warned("libraries", with("mtllib gone.mtl\nmtllib gone.mtl\nusemtl a b\nf 1/1 2/2 3/3"));
    // Once of the library, whose name stands there twice, and once of what is left as it is without it.
    assert_eq!(lost.iter().filter(|code| *code == "missing_material_library").count(), 2, "{lost:?}");
    // Several materials, names with blanks, polygons: nothing is wrong with those.
    assert!(refined("a good model", obj()).is_ok());
}

#[test]
fn obj_of_a_million() {
    // A curl around a circle: every corner turns back, so that no ear is ever found.
    let corners = 300_000;
    let mut curl = String::new();
    for i in 0..corners {
        let (large, small) = (std::f64::consts::TAU * f64::from(i) / f64::from(corners), 0.8 * f64::from(i));
        let (x, y) = (large.cos() + 1e-3 * small.cos(), large.sin() - 1e-3 * small.sin());
        curl.push_str(&format!("v {x} {y} 0\nvt {x} {y}\n"));
    }
    curl.push('f');
    for i in 1..=corners {
        curl.push_str(&format!(" {i}/{i}"));
    }
    let files = vec![file("m.obj", &curl)];
    let (answer, cost) = measured(|| intarsia::asset::load(&files, None, &Limits::default()));
    let (_, warnings) = answer.expect("no panic").expect("a model");
    assert!(warnings.iter().any(|w| w.code == "polygons_fanned"), "{warnings:?}");
    assert!(cost.seconds < 60.0 && cost.bytes < MOST_BYTES, "{cost:?}");

    // A million corners that go round and round a triangle.
    let corners = 1_000_000;
    let text = format!("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf{}", " 1/1 2/2 3/3".repeat(corners / 3));
    let files = vec![file("m.obj", &text)];
    let (answer, cost) = measured(|| intarsia::asset::load(&files, None, &Limits::default()));
    assert!(answer.expect("no panic").is_ok());
    assert!(cost.seconds < 60.0 && cost.bytes < MOST_BYTES, "{cost:?}");

    // A library that is named without end is read once.
    let library = format!("newmtl a\n{}", "Kd 1 1 1\n".repeat(20_000));
    let text =
        format!("{}v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n", "mtllib a.mtl\n".repeat(100_000));
    let files = vec![file("m.obj", &text), file("a.mtl", &library)];
    let (answer, cost) = measured(|| intarsia::asset::load(&files, None, &Limits::default()));
    assert!(answer.expect("no panic").is_ok());
    assert!(cost.seconds < 5.0, "{cost:?}");
}
