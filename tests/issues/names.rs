//! Names in other encodings than UTF-8, and files that are named and missing.

use std::io::Write;
use std::process::Command;

use encoding_rs::{GBK, SHIFT_JIS, WINDOWS_1252};
use intarsia::asset::{Document, File, Limits, load, read_vec2};
use intarsia::context::Context;
use intarsia::refine::{Input, Outcome, parse, refine};
use serde_json::{Value, json};

/// A square under a picture; the names of library, material and picture are those given.
fn square(library: &[u8], material: &[u8], picture: &[u8]) -> [Vec<u8>; 3] {
    let faces = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt .1 .1\nvt .6 .1\nvt .6 .6\nvt .1 .6\nf 1/1 2/2 3/3 4/4\n";
    let obj = [b"mtllib ", library, b"\nusemtl ", material, b"\n", faces].concat();
    let mtl = [b"newmtl ", material, b"\nmap_Kd -texres 512 ", picture, b"\n"].concat();
    let mut pixels = image::RgbImage::new(64, 64);
    pixels.enumerate_pixels_mut().for_each(|(x, y, p)| *p = image::Rgb([(x * 4) as u8, (y * 4) as u8, (x * y) as u8]));
    let mut png = std::io::Cursor::new(Vec::new());
    pixels.write_to(&mut png, image::ImageFormat::Png).unwrap();
    [obj, mtl, png.into_inner()]
}

/// A zip whose names are these bytes and do not say that they are UTF-8: spaces stand in for them while it is written.
fn zip(files: &[(&[u8], &[u8])]) -> Vec<u8> {
    let mut writer = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let stand_in = |i: usize, name: &[u8]| format!("{i}{}", "_".repeat(name.len() - 1));
    for (i, (name, bytes)) in files.iter().enumerate() {
        writer.start_file(stand_in(i, name), stored).unwrap();
        writer.write_all(bytes).unwrap();
    }
    let mut bytes = writer.finish().unwrap().into_inner();
    for (i, (name, _)) in files.iter().enumerate() {
        let stand_in = stand_in(i, name).into_bytes();
        let places: Vec<usize> =
            bytes.windows(name.len()).enumerate().filter(|(_, w)| *w == stand_in).map(|(at, _)| at).collect();
        assert_eq!(places.len(), 2, "once before the file and once in the directory");
        places.into_iter().for_each(|at| bytes[at..at + name.len()].copy_from_slice(name));
    }
    bytes
}

fn opened(files: &[(&str, &[u8])]) -> (Document, Vec<String>) {
    let files: Vec<File> =
        files.iter().map(|(path, bytes)| File { path: (*path).to_owned(), bytes: bytes.to_vec() }).collect();
    let (doc, warnings) = load(&files, None, &Limits::default()).unwrap();
    (doc, warnings.into_iter().map(|w| format!("{}: {}", w.code, w.message)).collect())
}

fn refined(files: Vec<File>) -> (Outcome, Document) {
    let options = parse::options(&json!({ "recipe": "pack", "atlas": { "if_larger": "accept" } })).unwrap();
    let outcome = refine(&Input { models: vec![files], ..Input::default() }, &options, &Context::silent()).unwrap();
    let model = outcome.artifacts.iter().find(|a| a.role == "model").unwrap().bytes.clone();
    let doc = load(&[File { path: "m.glb".to_owned(), bytes: model }], None, &Limits::default()).unwrap().0;
    (outcome, doc)
}

/// Library and picture were not found, and names came out as replacement characters.
#[test]
fn names_in_other_encodings_are_found_and_come_out_as_utf_8() {
    for (encoding, library, material, picture) in [
        (WINDOWS_1252, "größe.mtl", "Außenwand", "grün é.png"),
        (GBK, "贴图材质.mtl", "红色砖墙", "红色砖墙贴图.png"),
        (SHIFT_JIS, "表面.mtl", "テクスチャ", "表示ソフト.png"),
    ] {
        let encode = |text: &str| encoding.encode(text).0.into_owned();
        let [obj, mtl, png] = square(&encode(library), &encode(material), &encode(picture));
        let check = |doc: &Document, warnings: &[String], how: &str| {
            assert_eq!(warnings, Vec::<String>::new(), "{how}");
            assert_eq!(doc.json["materials"][0]["name"], material, "{how}");
            let uri = doc.json["images"][0]["uri"].as_str().unwrap();
            let decoded = percent_encoding::percent_decode_str(uri).decode_utf8().unwrap();
            assert_eq!((&*decoded, doc.images[0].as_ref()), (picture, Some(&png)), "{how}");
        };
        // In a zip as it is encoded, or as UTF-8, with or without saying so; beside it, as a browser sends names.
        let packed = zip(&[(b"m.obj", &obj), (&encode(library), &mtl), (&encode(picture), &png)]);
        let (doc, warnings) = opened(&[("m.zip", &packed)]);
        check(&doc, &warnings, "in its own encoding");
        let packed = zip(&[(b"m.obj", &obj), (library.as_bytes(), &mtl), (picture.as_bytes(), &png)]);
        let (doc, warnings) = opened(&[("m.zip", &packed)]);
        check(&doc, &warnings, "as UTF-8");
        let (doc, warnings) = opened(&[("m.obj", &obj), (library, &mtl), (picture, &png)]);
        check(&doc, &warnings, "loose");
    }
    // Windows packs a name of the Latin alphabet in the code page of its consoles.
    let [obj, mtl, png] = square(b"gr\xF6\xDFe.mtl", b"wall", b"gr\xFCn.png");
    let packed = zip(&[(b"m.obj", &obj), (b"gr\x94\xE1e.mtl", &mtl), (b"gr\x81n.png", &png)]);
    let (doc, warnings) = opened(&[("m.zip", &packed)]);
    assert_eq!((warnings, &doc.images), (Vec::new(), &vec![Some(png.clone())]));
    // A backslash behind a letter of such a name is a separator where nothing else is found.
    let [obj, mtl, png] = square(b"caf\xE9\\a.mtl", b"wall", b"t.png");
    let packed = zip(&[(b"m.obj", &obj), (b"caf\xE9/a.mtl", &mtl), (b"caf\xE9/t.png", &png)]);
    let (doc, warnings) = opened(&[("m.zip", &packed)]);
    assert_eq!((warnings, doc.images), (Vec::new(), vec![Some(png)]));
}

/// Messages show what the file probably says.
#[test]
fn missing_files_are_named_readably() {
    let [obj, ..] = square(b"gr\xF6\xDFe.mtl", b"wall", b"gr\xFCn.png");
    let (_, warnings) = opened(&[("m.obj", &obj)]);
    assert!(warnings.iter().any(|w| w.contains("größe.mtl")), "{warnings:?}");
}

/// Coordinates of a model whose library or picture was forgotten were moved about, so that the picture fitted no more when it came.
#[test]
fn what_reads_a_missing_file_keeps_its_coordinates() {
    let file = |path: &str, bytes: &[u8]| File { path: path.to_owned(), bytes: bytes.to_vec() };
    let [obj, mtl, _] = square(b"a.mtl", b"wall", b"t.png");
    for (files, code) in [
        (vec![file("m.obj", &obj)], "missing_material_library"),
        (vec![file("m.obj", &obj), file("a.mtl", &mtl)], "missing_image"),
    ] {
        let (outcome, doc) = refined(files);
        let told = outcome.report["warnings"].as_array().unwrap();
        assert!(told.iter().any(|w| w["code"] == code), "{told:?}");
        let accessor = doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"].as_u64().unwrap();
        let uvs = read_vec2(&doc, accessor as usize).unwrap();
        let [low, high] = [0.1f32, 0.6].map(|v| 1.0 - v);
        assert_eq!(uvs, [[0.1, low], [0.6, low], [0.6, high], [0.1, high]], "{code}");
        assert_eq!(outcome.report["atlases"], json!([]), "{code}");
    }
    // Where no library is named none is missing.
    let bare = String::from_utf8(obj).unwrap().replace("mtllib a.mtl\n", "");
    let (outcome, _) = refined(vec![file("m.obj", bare.as_bytes())]);
    assert_eq!(outcome.report["atlases"][0]["refined"], Value::Bool(true), "{}", outcome.report["warnings"]);
}

#[cfg(unix)]
#[test]
fn the_command_line_finds_files_by_the_bytes_of_their_names() {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;
    let folder = tempfile::tempdir().unwrap();
    let [obj, mtl, png] = square(b"gr\xF6\xDFe.mtl", b"W\xE4nde", b"gr\xFCn.png");
    for (name, bytes) in [(&b"m\xF6bel.obj"[..], &obj), (b"gr\xF6\xDFe.mtl", &mtl), (b"gr\xFCn.png", &png)] {
        if std::fs::write(folder.path().join(OsStr::from_bytes(name)), bytes).is_err() {
            return println!("the file system takes no such names");
        }
    }
    let mut program = Command::new(env!("CARGO_BIN_EXE_intarsia"));
    let program = program.arg("refine").arg(OsStr::from_bytes(b"m\xF6bel.obj")).args(["-o", "out/m.gltf"]);
    std::fs::create_dir(folder.path().join("out")).unwrap();
    let out = program.args(["--set", "atlas.if_larger=accept"]).current_dir(folder.path()).output().unwrap();
    let errors = String::from_utf8(out.stderr).unwrap();
    assert!(out.status.success() && !errors.contains("missing"), "{errors}");
    let json: Value = serde_json::from_slice(&std::fs::read(folder.path().join("out/m.gltf")).unwrap()).unwrap();
    assert_eq!(json["materials"][0]["name"], "Wände");
    assert_eq!(json["meshes"][0]["name"], "möbel");
}

/// Some file systems write accents apart from their letters, most editors together with them: neither found the other's files.
#[test]
fn accents_apart_from_their_letters_are_the_same_name() {
    let (together, apart) = ("gr\u{f6}\u{df}e.mtl", "gro\u{308}\u{df}e.mtl");
    for (named, stored) in [(together, apart), (apart, together)] {
        let [obj, mtl, png] = square(named.as_bytes(), b"wall", b"t.png");
        let files = [("m.obj", &obj[..]), (stored, &mtl), ("T\u{301}/t.png", &png)];
        let (doc, warnings) = opened(&files);
        assert_eq!((warnings, doc.images.len()), (Vec::new(), 1), "{named:?}");
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in [("m.obj", &obj), (stored, &mtl), ("t.png", &png)] {
            std::fs::write(folder.path().join(name), bytes).unwrap();
        }
        let read = intarsia::asset::read_paths(&[folder.path().join("m.obj")]).unwrap();
        assert_eq!(read.len(), 3, "{named:?}: {:?}", read.iter().map(|f| &f.path).collect::<Vec<_>>());
    }
}
