//! 3D Tiles 1.0: tiles were no model at all, and glTF cut out of one lost its tables.

use std::path::Path;
use std::process::Command;

use intarsia::asset::sample::sample;
use intarsia::asset::{
    ARRAY_BUFFER, ComponentType, Document, File, Kind, Limits, RawAccessor, accessor_shape, load, raw_elements,
    read_indices, read_vec3,
};
use intarsia::context::Context;
use intarsia::error::{Code, Result};
use intarsia::refine::{Input, Outcome, parse, refine};
use serde_json::{Value, json};

const BATCHES: &str = "{\"BATCH_LENGTH\":3,\"RTC_CENTER\":[1215013.5,-4736316.75,4081608.25]}";
const NAMES: &str = "{\"name\":[\"wall\",\"roof\",\"door\"],\"height\":{\"byteOffset\":0,\"componentType\":\"FLOAT\",\"type\":\"SCALAR\"}}";

fn word(value: usize) -> [u8; 4] {
    u32::try_from(value).unwrap().to_le_bytes()
}

/// A tile about a GLB; every table padded to a multiple of 8, as 3D Tiles wants it, or not.
fn tile(magic: &str, feature: &str, batch: &str, heights: &[u8], glb: &[u8], padded: bool) -> Vec<u8> {
    let header = if magic == "i3dm" { 32 } else { 28 };
    let mut body = Vec::new();
    let mut lengths = Vec::new();
    for (table, filler) in [(feature.as_bytes(), b' '), (&[], 0), (batch.as_bytes(), b' '), (heights, 0)] {
        let start = body.len();
        body.extend_from_slice(table);
        if padded && !table.is_empty() {
            body.resize((header + body.len()).next_multiple_of(8) - header, filler);
        }
        lengths.push(body.len() - start);
    }
    body.extend_from_slice(glb);
    let mut out = [magic.as_bytes(), &word(1), &word(header + body.len())].concat();
    lengths.into_iter().for_each(|n| out.extend(word(n)));
    if magic == "i3dm" {
        out.extend(word(1));
    }
    out.extend(body);
    out
}

/// The four tables of a tile, and its GLB.
fn parts(tile: &[u8]) -> ([&[u8]; 4], &[u8]) {
    let number = |at: usize| u32::from_le_bytes(tile[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((number(4), number(8)), (1, tile.len()), "version and byteLength");
    assert_eq!(tile.len() % 8, 0, "the tile ends on a multiple of 8");
    let mut at = if tile.starts_with(b"i3dm") { 32 } else { 28 };
    let tables = [12, 16, 20, 24].map(|field| {
        at += number(field);
        assert!(number(field) == 0 || at % 8 == 0, "tables end on multiples of 8");
        &tile[at - number(field)..at]
    });
    assert_eq!(at % 8, 0, "the GLB begins on a multiple of 8");
    let glb = &tile[at..];
    assert_eq!(u32::from_le_bytes(glb[8..12].try_into().unwrap()) as usize, glb.len());
    (tables, glb)
}

/// The sample with a batch id for each vertex, floating point as exporters write them: by the side that its triangle looks to.
fn batched(kind: ComponentType) -> Vec<u8> {
    let (mut doc, _) = opened("m.glb", &sample("fragmented").unwrap()).unwrap();
    let count = accessor_shape(&doc, position(&doc, 0)).unwrap().count;
    let mut ids = vec![0usize; count];
    for (i, t) in triangles(&doc, 0).iter().enumerate() {
        t.iter().for_each(|v| ids[*v as usize] = i % 3);
    }
    let raw = match kind {
        ComponentType::F32 => RawAccessor::from_floats(&ids.iter().map(|id| [*id as f32]).collect::<Vec<_>>()),
        _ => {
            let data = ids.iter().flat_map(|id| (*id as u16).to_le_bytes()).collect();
            RawAccessor::new(ComponentType::U16, Kind::Scalar, false, data)
        }
    };
    let accessor = doc.append_accessor(&raw, Some(ARRAY_BUFFER), false);
    doc.json["meshes"][0]["primitives"][0]["attributes"]["_BATCHID"] = json!(accessor);
    doc.json["extensionsUsed"] = json!(["CESIUM_RTC"]);
    doc.json["extensionsRequired"] = json!(["CESIUM_RTC"]);
    doc.json["extensions"] = json!({ "CESIUM_RTC": { "center": [6378137.0, 0.5, 0.0] } });
    doc.to_glb().unwrap()
}

fn opened(name: &str, bytes: &[u8]) -> Result<(Document, Vec<String>)> {
    let file = File { path: name.to_owned(), bytes: bytes.to_vec() };
    let (doc, warnings) = load(&[file], None, &Limits::default())?;
    Ok((doc, warnings.into_iter().map(|w| w.code).collect()))
}

fn position(doc: &Document, primitive: usize) -> usize {
    attribute(doc, primitive, "POSITION")
}

fn attribute(doc: &Document, primitive: usize, name: &str) -> usize {
    doc.json["meshes"][0]["primitives"][primitive]["attributes"][name].as_u64().unwrap() as usize
}

fn triangles(doc: &Document, primitive: usize) -> Vec<[u32; 3]> {
    let indices = doc.json["meshes"][0]["primitives"][primitive]["indices"].as_u64().unwrap() as usize;
    read_indices(doc, indices).unwrap().as_chunks::<3>().0.to_vec()
}

/// Batch ids of the corners of each triangle.
fn ids(doc: &Document) -> Vec<[u32; 3]> {
    let raw = raw_elements(doc, attribute(doc, 0, "_BATCHID")).unwrap();
    let id = |v: u32| {
        let element = &raw.data[v as usize * raw.element_size..][..raw.element_size];
        match element.try_into() {
            Ok(bytes) => f32::from_le_bytes(bytes) as u32,
            Err(_) => u32::from(u16::from_le_bytes(element.try_into().unwrap())),
        }
    };
    triangles(doc, 0).iter().map(|t| t.map(id)).collect()
}

fn refined(name: &str, bytes: Vec<u8>, options: Value) -> Result<Outcome> {
    let input = Input { models: vec![vec![File { path: name.to_owned(), bytes }]], ..Input::default() };
    refine(&input, &parse::options(&options).unwrap(), &Context::silent())
}

fn codes(outcome: &Outcome) -> Vec<&str> {
    let codes = outcome.report["warnings"].as_array().unwrap().iter().filter_map(|w| w["code"].as_str());
    codes.filter(|code| *code != "heavier_texture").collect()
}

/// A tile comes out as the tile that it was: its tables byte for byte, its lengths and its padding right, its batch ids on the faces that had them, its
/// centre far from the origin untouched.
#[test]
fn a_batched_tile_keeps_its_tables_and_its_batches() {
    let heights = [1.5f32, 9.25, 2.0].map(f32::to_le_bytes).concat();
    for (kind, padded) in [(ComponentType::F32, true), (ComponentType::U16, false)] {
        let glb = batched(kind);
        let uploaded = tile("b3dm", BATCHES, NAMES, &heights, &glb, padded);
        let options = json!({ "recipe": "pack", "atlas": { "if_larger": "accept" } });
        let outcome = refined("tile.b3dm", uploaded, options).unwrap();
        assert_eq!(outcome.report["atlases"][0]["refined"], true, "{}", outcome.report["warnings"]);
        let model = outcome.artifacts.iter().find(|a| a.role == "model").unwrap();
        assert_eq!((model.name.as_str(), model.media_type.as_str()), ("model.b3dm", "application/octet-stream"));
        let ([feature, _, batch, binary], own) = parts(&model.bytes);
        assert_eq!(std::str::from_utf8(feature).unwrap().trim_end(), BATCHES);
        assert_eq!(std::str::from_utf8(batch).unwrap().trim_end(), NAMES);
        assert_eq!(binary[..heights.len()], heights);
        let (doc, warnings) = opened("model.glb", own).unwrap();
        assert_eq!(warnings, Vec::<String>::new());
        assert_eq!(doc.json["extensions"]["CESIUM_RTC"]["center"], json!([6378137.0, 0.5, 0.0]));
        let uploaded = ids(&opened("m.glb", &glb).unwrap().0);
        assert!(ids(&doc) == uploaded && uploaded.iter().flatten().any(|id| *id == 2), "each triangle its batches");

        // What was refined is refined again: the written tile is one that is read.
        let (again, warnings) = opened("model.b3dm", &model.bytes).unwrap();
        assert_eq!((again.json, warnings), (doc.json, Vec::<String>::new()));
    }
}

/// Where triangles are divided, ids are copied and never averaged, whatever their type.
#[test]
fn batch_ids_are_names_and_not_amounts() {
    let (mut doc, _) = opened("m.glb", &sample("textured").unwrap()).unwrap();
    let count = accessor_shape(&doc, position(&doc, 0)).unwrap().count;
    // Neighbours of different batches share vertices nowhere in a sound tile; an unsound one must not get batches that nobody has.
    let values: Vec<[f32; 1]> = (0..count).map(|i| [if i % 2 == 0 { 2.0 } else { 40.0 }]).collect();
    let accessor = doc.append_accessor(&RawAccessor::from_floats(&values), Some(ARRAY_BUFFER), false);
    for name in ["_BATCHID", "_FEATURE_ID_0"] {
        doc.json["meshes"][0]["primitives"][0]["attributes"][name] = json!(accessor);
    }
    let glb = doc.to_glb().unwrap();
    let options = json!({
        "recipe": [{ "stage": "bounded" }], "pack": { "gutter": 0 },
        "atlas": { "overlaps": "separate", "if_larger": "accept" },
    });
    let outcome = refined("m.b3dm", tile("b3dm", BATCHES, "", &[], &glb, true), options).unwrap();
    let model = &outcome.artifacts.iter().find(|a| a.role == "model").unwrap().bytes;
    let (doc, _) = opened("m.b3dm", model).unwrap();
    assert!(read_vec3(&doc, position(&doc, 0)).unwrap().len() > count, "triangles were divided");
    for name in ["_BATCHID", "_FEATURE_ID_0"] {
        let raw = raw_elements(&doc, attribute(&doc, 0, name)).unwrap();
        assert_eq!(raw.component_type, ComponentType::F32);
        assert!(raw.data.as_chunks::<4>().0.iter().all(|b| [2.0, 40.0].contains(&f32::from_le_bytes(*b))), "{name}");
    }
}

#[test]
fn instances_keep_their_table_and_tiles_may_be_unwrapped() {
    let glb = sample("textured").unwrap();
    let places = "{\"INSTANCES_LENGTH\":1,\"POSITION\":{\"byteOffset\":0}}";
    let uploaded = tile("i3dm", places, "", &[], &glb, true);
    let pack = json!({ "recipe": "pack" });
    let outcome = refined("trees.i3dm", uploaded.clone(), pack.clone()).unwrap();
    let model = outcome.artifacts.iter().find(|a| a.role == "model").unwrap();
    assert_eq!(model.name, "model.i3dm");
    let ([feature, ..], _) = parts(&model.bytes);
    assert_eq!(std::str::from_utf8(feature).unwrap().trim_end(), places);
    assert_eq!(model.bytes[28..32], word(1), "the glTF is inside");

    let outcome = refined("trees.i3dm", uploaded.clone(), json!({ "recipe": "pack", "output": "glb" })).unwrap();
    assert!(outcome.artifacts.iter().any(|a| a.name == "model.glb"));
    assert_eq!(codes(&outcome), ["tile_unwrapped"]);
    for (bytes, name) in [(uploaded, "trees.i3dm"), (glb, "trees.glb")] {
        let failure = refined(name, bytes, json!({ "recipe": "pack", "output": "b3dm" })).unwrap_err();
        assert_eq!((failure.code, failure.pointer.as_deref()), (Code::InvalidOptions, Some("/output")), "{failure}");
    }
}

/// Headers of 2016, which are shorter, and files that are no tile to be refined: each is read, or told what it is.
#[test]
fn other_tiles_are_read_or_named() {
    let glb = sample("textured").unwrap();
    let names = "{\"name\":[\"a\"]} ";
    let first =
        [b"b3dm".as_slice(), &word(1), &word(20 + names.len() + glb.len()), &word(7), &word(names.len())].concat();
    let second =
        [b"b3dm".as_slice(), &word(1), &word(24 + names.len() + glb.len()), &word(names.len()), &word(0), &word(7)]
            .concat();
    for header in [first, second] {
        let (doc, warnings) = opened("old.b3dm", &[header.as_slice(), names.as_bytes(), &glb].concat()).unwrap();
        assert_eq!(warnings, Vec::<String>::new());
        let written = doc.to_tile().unwrap().unwrap();
        let ([feature, _, batch, _], _) = parts(&written);
        assert_eq!(std::str::from_utf8(feature).unwrap().trim_end(), "{\"BATCH_LENGTH\":7}");
        assert_eq!(std::str::from_utf8(batch).unwrap().trim_end(), names.trim_end());
    }

    let mut by_uri = tile("i3dm", "{}", "", &[], b"tree.glb", true);
    by_uri[28..32].copy_from_slice(&word(0));
    let composite = [b"cmpt".as_slice(), &word(1), &word(16), &word(2)].concat();
    let points = [b"pnts".as_slice(), &word(1), &word(28), &[0; 16]].concat();
    for (name, bytes, words) in
        [("a.i3dm", &by_uri, "gltfFormat 0"), ("a.cmpt", &composite, "splitCmpt"), ("a.pnts", &points, "no triangles")]
    {
        let failure = opened(name, bytes).unwrap_err();
        assert_eq!(failure.code, Code::UnsupportedMediaType);
        assert!(failure.message.contains(words), "{failure}");
    }
}

/// Truncated tiles, and lengths that overflow: a sentence, and never a crash.
#[test]
fn broken_tiles_are_refused() {
    let whole = tile("b3dm", BATCHES, NAMES, &[], &sample("textured").unwrap(), true);
    for end in (0..400).chain([whole.len() - 1]) {
        let failure = opened("a.b3dm", &whole[..end]).unwrap_err();
        assert_eq!(failure.code, Code::InvalidModel, "{end}: {failure}");
    }
    for (at, value) in [(4, 2), (8, 0), (8, u32::MAX), (12, u32::MAX), (16, u32::MAX), (24, 0x2100_0000), (12, 3)] {
        let mut broken = whole.clone();
        broken[at..at + 4].copy_from_slice(&value.to_le_bytes());
        let failure = opened("a.b3dm", &broken).unwrap_err();
        assert_eq!(failure.code, Code::InvalidModel, "{at} {value}: {failure}");
    }
}

#[test]
fn the_command_line_writes_tiles_where_tiles_came_in() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_intarsia"));
        let out = program.args(arguments).current_dir(folder.path()).output().unwrap();
        (out.status.code(), String::from_utf8(out.stderr).unwrap())
    };
    let at = |name: &str| folder.path().join(name);
    let glb = sample("textured").unwrap();
    std::fs::write(at("in.b3dm"), tile("b3dm", BATCHES, NAMES, &[], &glb, true)).unwrap();
    assert_eq!(run(&["refine", "in.b3dm", "-o", "out.b3dm", "-q"]).0, Some(0));
    assert_eq!(parts(&std::fs::read(at("out.b3dm")).unwrap()).0[0].len() % 4, 0);
    let (code, errors) = run(&["refine", "in.b3dm", "-o", "out.glb", "-q"]);
    assert!(code == Some(0) && errors.contains("tile_unwrapped"), "{errors}");
    assert!(std::fs::read(at("out.glb")).unwrap().starts_with(b"glTF"));
    let (code, errors) = run(&["refine", "in.b3dm", "-o", "out.i3dm", "-q"]);
    assert!(code == Some(2) && errors.contains("i3dm"), "{errors}");
    assert!(!Path::new(&at("out.i3dm")).exists());
    std::fs::write(at("in.cmpt"), b"cmpt\x01\0\0\0\x10\0\0\0\x02\0\0\0").unwrap();
    let (code, errors) = run(&["inspect", "in.cmpt"]);
    assert!(code == Some(3) && errors.contains("splitCmpt"), "{errors}");
}
