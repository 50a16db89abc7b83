//! Estimates of the samples, of every container, and of files that lie.

use std::io::Write;
use std::num::Saturating;
use std::path::PathBuf;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::super::fixture::png;
use super::super::{File, glb, load, sample};
use super::*;
use crate::texture::{Format, Header, decode};

/// What `pack` does.
const PACKS: Demand = Demand { bakes: true, unwraps: false, copies: false, ktx2: false };

/// Stores files under numbers, as uploads are, and estimates the first with the others.
fn of(files: &[(&str, &[u8])], limits: &Limits) -> Result<Estimate> {
    let folder = TempDir::new().unwrap();
    let stored: Vec<(&str, PathBuf)> = files
        .iter()
        .enumerate()
        .map(|(number, (name, bytes))| {
            let path = folder.path().join(number.to_string());
            std::fs::write(&path, bytes).unwrap();
            (*name, path)
        })
        .collect();
    let all: Vec<(&str, &Path)> = stored.iter().map(|(name, path)| (*name, path.as_path())).collect();
    estimate(all[0], &all[1..], limits, 2, PACKS)
}

fn estimated(files: &[(&str, &[u8])]) -> Estimate {
    of(files, &Limits::default()).unwrap()
}

fn zip(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut writer = ::zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in files {
        writer.start_file(*name, ::zip::write::SimpleFileOptions::default()).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

fn data_uri(bytes: &[u8]) -> String {
    use base64::Engine;
    format!("data:application/octet-stream;base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes))
}

fn gltf(images: &Value, others: Value) -> Vec<u8> {
    let mut json = json!({ "asset": { "version": "2.0" }, "images": images });
    json.as_object_mut().unwrap().extend(others.as_object().unwrap().clone());
    serde_json::to_vec(&json).unwrap()
}

#[test]
fn samples_count_what_is_decoded_of_them() {
    for name in ["textured", "two_materials", "strips", "scan"] {
        let bytes = sample::made(name).to_vec();
        let (document, _) =
            load(&[File { path: "m.glb".into(), bytes: bytes.clone() }], None, &Limits::default()).unwrap();
        let images: Vec<_> = document.images.iter().flatten().map(|i| decode(i, u64::MAX).unwrap()).collect();
        let texels: u64 = images.iter().map(|i| u64::from(i.width()) * u64::from(i.height())).sum();
        let held: usize = images.iter().map(|i| i.as_bytes().len()).sum();
        let found = estimated(&[("m.glb", &bytes)]);
        assert_eq!(found.texels, texels, "{name}");
        assert!(found.triangles > 10 && found.bytes > (held + bytes.len()) as u64, "{name}: {found:?}");
    }
}

#[test]
fn compressed_views_count_decoded_under_either_name() {
    let bytes = |name: &str| {
        let mut view = json!({ "buffer": 0, "byteLength": 90_000_000 });
        view["extensions"][name] = json!({ "buffer": 0, "byteLength": 9 });
        let json = gltf(&json!([]), json!({ "buffers": [{ "byteLength": 9 }], "bufferViews": [view] }));
        estimated(&[("m.gltf", &json)]).bytes
    };
    let [ext, khr] = ["EXT_meshopt_compression", "KHR_meshopt_compression"].map(bytes);
    assert_eq!(ext, khr);
    assert!(ext > bytes("ACME_compression") + 90_000_000);
}

#[test]
fn an_archive_needs_what_is_in_it_and_itself() {
    let model = sample::made("textured").to_vec();
    let plain = estimated(&[("m.glb", &model)]);
    let archive = zip(&[("a/m.glb", &model), ("a/readme.txt", b"hello")]);
    let packed = estimated(&[("m.zip", &archive)]);
    assert_eq!((packed.texels, packed.triangles), (plain.texels, plain.triangles));
    assert!(packed.bytes >= plain.bytes + archive.len() as u64);
    // A megabyte of zeros counts as one, however small it is packed and whatever it is declared to be.
    let zeros = vec![0; 1 << 20];
    let honest = zip(&[("m.glb", &model), ("zeros", &zeros)]);
    let bytes = estimated(&[("m.zip", &honest)]).bytes;
    assert!(honest.len() < archive.len() + 5000 && bytes >= packed.bytes + (1 << 20));
    let declared = (zeros.len() as u32).to_le_bytes();
    let places: Vec<usize> = (0..honest.len() - 4).filter(|at| honest[*at..at + 4] == declared).collect();
    assert!(!places.is_empty());
    let mut lying = honest.clone();
    places.iter().for_each(|at| lying[*at..at + 4].copy_from_slice(&0x3000_0000u32.to_le_bytes()));
    assert_eq!(estimated(&[("m.zip", &lying)]).bytes, bytes);
    // Two that hold more than the limit together are refused, whatever they declare.
    let limits = |max_input_bytes| Limits { max_input_bytes, ..Limits::default() };
    let both = [("m.zip", &honest[..]), ("zeros.zip", &lying)];
    let unpacked = 2 * (model.len() + zeros.len()) as u64;
    assert!(of(&both, &limits(unpacked)).is_ok());
    assert_eq!(of(&both, &limits(unpacked - 1)).unwrap_err().code, crate::error::Code::TooLarge);
}

#[test]
fn images_are_found_wherever_they_are() {
    let [first, second, third] = [png(64, 32), png(16, 16), png(8, 128)];
    // What begins as an image does would count as one itself.
    let buffer = [&[0; 4], &first[..], &third[..]].concat();
    let views = |uri: Option<&str>| {
        let mut buffers = json!([{ "byteLength": buffer.len() }]);
        if let Some(uri) = uri {
            buffers[0]["uri"] = Value::from(uri);
        }
        let view = |offset: usize| json!({ "buffer": 0, "byteOffset": offset, "byteLength": 40 });
        json!({ "buffers": buffers, "bufferViews": [view(4 + first.len()), view(4)] })
    };
    let inside = json!([{ "bufferView": 0 }, { "bufferView": 1 }]);
    let (both, one) = (64 * 32 + 8 * 128, 16 * 16);
    let texels = |files: &[(&str, &[u8])]| estimated(files).texels;

    let beside = gltf(&json!([{ "uri": "t/a%20b.png" }, { "uri": data_uri(&second) }]), json!({}));
    assert_eq!(texels(&[("m.gltf", &beside), ("t/a b.png", &first)]), 64 * 32 + one);
    let in_bin = gltf(&inside, views(Some("x.bin")));
    assert_eq!(texels(&[("m.gltf", &in_bin), ("x.bin", &buffer)]), both);
    assert_eq!(texels(&[("m.zip", &zip(&[("m.gltf", &in_bin), ("x.bin", &buffer)]))]), both);
    assert_eq!(texels(&[("m.gltf", &gltf(&inside, views(Some(&data_uri(&buffer)))))]), both);
    let glb = glb::build(gltf(&inside, views(None)), &buffer, 4).unwrap();
    assert_eq!(texels(&[("m.glb", &glb)]), both);
    // A tile without tables: its header is shorter than what is read to tell it.
    let word = |n: usize| (n as u32).to_le_bytes();
    let tile = [b"b3dm".as_slice(), &word(1), &word(28 + glb.len()), &[0; 16], &glb].concat();
    assert_eq!(texels(&[("m.b3dm", &tile)]), both);
    assert_eq!(texels(&[("m.zip", &zip(&[("m.b3dm", &tile)]))]), both);
    // Behind the part of a string that is read at first.
    let far = [vec![0; 200_000], first.clone()].concat();
    let mut deep = views(Some(&data_uri(&far)));
    deep["bufferViews"][0]["byteOffset"] = Value::from(200_000);
    assert_eq!(texels(&[("m.gltf", &gltf(&json!([{ "bufferView": 0 }]), deep))]), 64 * 32);
}

#[test]
fn a_header_beyond_the_limit_is_refused_as_the_job_would_refuse_it() {
    let mut file = png(4, 4);
    file[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
    let model = gltf(&json!([{ "uri": "a.png" }]), json!({}));
    let limits = Limits { max_image_pixels: 1_000_000, ..Limits::default() };
    let refused = of(&[("m.gltf", &model), ("a.png", &file)], &limits).unwrap_err();
    assert_eq!(refused.code, crate::error::Code::TooLarge);
    assert!(refused.message.contains("4294836225 pixels"), "{refused}");
}

#[test]
fn triangles_are_counted_by_mode_and_too_many_refused() {
    let parts = json!({
        "accessors": [{ "count": 30 }, { "count": 12 }, { "count": 18446744073709551615u64 }],
        "meshes": [{ "primitives": [
            { "attributes": { "POSITION": 0 }, "indices": 1 },
            { "attributes": { "POSITION": 0 }, "mode": 5 },
            { "attributes": { "POSITION": 0 }, "mode": 1 },
        ] }],
        "nodes": [{ "mesh": 0 }, { "mesh": 0 }],
    });
    let model = gltf(&json!([]), parts.clone());
    assert_eq!(estimated(&[("m.gltf", &model)]).triangles, 4 + 28);
    let mut large = parts;
    large["meshes"][0]["primitives"][0]["indices"] = Value::from(2);
    let refused = of(&[("m.gltf", &gltf(&json!([]), large))], &Limits::default()).unwrap_err();
    assert_eq!(refused.code, crate::error::Code::TooLarge);
}

#[test]
fn faces_of_an_obj_are_counted() {
    let text =
        b"mtllib m.mtl\nv 0 0 0\nvt 0 0\n# f 1 2 3\nf 1 2 3\nf  1/1/1\t2 3 4 \r\nfoo 1 2 3\nf 1 2 \\\n 3 4 5\nf 1 2 3";
    let image = png(32, 16);
    let found = estimated(&[("m.obj", text), ("m.mtl", b"newmtl a\nmap_Kd a.png\n"), ("a.png", &image)]);
    assert_eq!((found.triangles, found.texels), (1 + 2 + 3 + 1, 32 * 16));
}

#[test]
fn what_is_allocated_of_a_texel_and_of_its_file_is_in_it() {
    // A header alone tells: no such image is decoded here.
    let head = |width: u32, height: u32, kind: u8, depth: u8| {
        let mut file = png(4, 4);
        file[16..20].copy_from_slice(&width.to_be_bytes());
        file[20..24].copy_from_slice(&height.to_be_bytes());
        (file[24], file[25]) = (depth, kind);
        file
    };
    let parts = json!({
        "accessors": [{ "count": 30 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "TEXCOORD_0": 0 } }] }],
    });
    let of = |images: &[Vec<u8>]| {
        let names: Vec<String> = (0..images.len()).map(|n| format!("{n}.png")).collect();
        let listed: Vec<Value> = names.iter().map(|name| json!({ "uri": name })).collect();
        let model = gltf(&Value::from(listed), parts.clone());
        let mut files = vec![("m.gltf", &model[..])];
        files.extend(names.iter().zip(images).map(|(name, image)| (name.as_str(), &image[..])));
        estimated(&files).bytes as f64
    };
    let process = 19e6;
    // By texel: as decoded, and of nearly as large a page its samples, and what is larger: a state and a pyramid of floats with a weight a
    // forty-eighth its size, or the samples once more, filtered, of 16 bits twice.
    for (kind, depth, samples, channels) in [(0, 8, 1.0, 1.0), (2, 8, 3.0, 3.0), (6, 8, 4.0, 4.0), (6, 16, 8.0, 4.0)] {
        let texels = 16_000.0 * 16_000.0;
        let filling: f64 = 1.0 + (channels + 1.0) * 4.0 / 48.0;
        let encoding = if depth == 16 { 2.0 * samples } else { samples };
        let held = texels * (samples + 0.9 * (samples + filling.max(encoding)));
        let one = of(&[head(16_000, 16_000, kind, depth)]) - process;
        assert!(one > held && one < 1.15 * held, "{kind} {depth}: {one} of {held}");
        // One slot is baked at a time: four of them take the room of one, and of their files.
        let four = of(&vec![head(16_000, 16_000, kind, depth); 4]) - process;
        assert!(four < 1.05 * one, "{kind} {depth}: {four} of {one}");
    }
    // A file that does not compress is in memory six times at the end, and twice as uploaded.
    let noise = [head(3300, 3300, 2, 8), vec![7; 3 * 3300 * 3300]].concat();
    let copies = (of(std::slice::from_ref(&noise)) - process) / noise.len() as f64;
    assert!(copies > 7.5 && copies < 8.5, "{copies}");
}

#[test]
fn the_charts_of_a_document_are_measured_where_they_can_be_read() {
    let file = File { path: "m.glb".into(), bytes: sample::made("scan").to_vec() };
    let (mut document, _) = load(&[file], None, &Limits::default()).unwrap();
    let mut image = png(4, 4);
    image[16..24].copy_from_slice(&[0, 0, 0x20, 0, 0, 0, 0x20, 0]);
    document.images.iter_mut().for_each(|own| *own = Some(image.clone()));
    let of = |document: &crate::asset::Document| estimated(&[("m.glb", &document.to_glb().unwrap())]).bytes;
    let plain = of(&document);
    // Under an extension that gives coordinates another meaning, they may cover everything.
    document.json["extensionsUsed"] = json!(["KHR_texture_transform"]);
    assert!(of(&document) > plain + 10_000_000);
}

#[test]
fn what_the_recipe_does_counts() {
    let mut image = png(4, 4);
    image[16..24].copy_from_slice(&[0, 0, 0x20, 0, 0, 0, 0x20, 0]);
    let of = |attributes: Value, demand: Demand| {
        let parts = json!({
            "accessors": [{ "count": 300_000 }],
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
        });
        let model = gltf(&json!([{ "uri": "a.png" }]), parts);
        let folder = TempDir::new().unwrap();
        let [at, beside] = ["m.gltf", "a.png"].map(|name| folder.path().join(name));
        std::fs::write(&at, model).unwrap();
        std::fs::write(&beside, &image).unwrap();
        estimate(("m.gltf", &at), &[("a.png", &beside)], &Limits::default(), 2, demand).unwrap().bytes
    };
    let (plain, bare) = (json!({ "POSITION": 0, "TEXCOORD_0": 0 }), json!({ "POSITION": 0 }));
    let demand = |bakes, unwraps| Demand { bakes, unwraps, copies: false, ktx2: false };
    let texels = 3 * 8192 * 8192;
    // Cutting and flattening takes some thousand bytes of each triangle, with a layout or without.
    assert!(of(bare.clone(), demand(false, true)) > of(bare, demand(false, false)) + 3_000 * 100_000);
    assert!(of(plain.clone(), demand(false, true)) > of(plain.clone(), demand(false, false)) + 2_000 * 100_000);
    // Images that stay as they are are not decoded.
    assert!(of(plain.clone(), demand(true, false)) > of(plain.clone(), demand(false, false)) + texels);
    assert!(of(plain.clone(), demand(false, true)) < 19_000_000 + 4_000 * 100_000 + texels);
    assert!(of(plain.clone(), demand(true, true)) > of(plain, demand(false, true)) + texels);
}

/// Pages of a JPEG whose texels are only moved are not held.
#[test]
fn a_large_jpeg_whose_charts_only_move_needs_little_more_than_itself() {
    let header = |format| Header { width: 16_384, height: 16_384, channels: 3, depth: 8, format };
    let bytes = |format, copies| {
        let mut sum = Sum::default();
        (sum.triangles, sum.has_layout, sum.covered) = (Saturating(1000), true, 0.7);
        sum.image(header(format), 10_000_000, &Limits::default());
        sum.estimate(&Limits::default(), 2, Demand { copies, ..PACKS }).bytes
    };
    let decoded = 3 * 16_384 * 16_384;
    assert!((decoded..decoded + 300_000_000).contains(&bytes(Format::Jpeg, true)), "{}", bytes(Format::Jpeg, true));
    assert!(bytes(Format::Jpeg, false) > 2 * decoded && bytes(Format::Png, true) > 2 * decoded);
}

#[test]
fn charts_that_cover_little_of_their_sheet_need_less() {
    let mut image = png(4, 4);
    image[16..24].copy_from_slice(&[0, 0, 0x20, 0, 0, 0, 0x20, 0]);
    let of = |side: f64| {
        let text = format!(
            "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt {side} 0\nvt {side} {side}\nvt 0 {side}\n\
             usemtl a\nf 1/1 2/2 \\\n 3/3 4/-1\n"
        );
        estimated(&[("m.obj", text.as_bytes()), ("m.mtl", b"newmtl a\nmap_Kd a.png\n"), ("a.png", &image)]).bytes
    };
    let (texels, [none, little, half, all]) = (8192u64 * 8192, [0.0, 0.1, 0.5, 1.0].map(of));
    assert!(none < little && little < half && half < all);
    // The image is decoded whatever is made of it.
    assert!(little > 3 * texels && all > 2 * little, "{little} {all}");
    assert!(none < 25_000_000, "nothing is made of charts without area: {none}");
    let bare = estimated(&[("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")]).bytes;
    assert!(bare < 25_000_000, "nothing is drawn of what has no layout: {bare}");
}

#[test]
fn what_is_cut_short_or_broken_counts_by_its_length() {
    let model = sample::made("two_materials").to_vec();
    let archive = zip(&[("m.glb", &model)]);
    let whole = estimated(&[("m.glb", &model)]);
    for (name, bytes) in [("m.glb", &model), ("m.zip", &archive)] {
        for end in (0..200).chain((200..bytes.len()).step_by(bytes.len() / 20)) {
            let found = estimated(&[(name, &bytes[..end])]);
            assert!(found.bytes >= end as u64 && found.bytes <= whole.bytes + bytes.len() as u64, "{name} {end}");
        }
    }
    for bad in [&b"{"[..], b"[[[[", b"{\"images\": 3, \"meshes\": [{\"primitives\": {}}]}", b"glTF", b"PK\x03\x04"] {
        assert_eq!(estimated(&[("m.gltf", bad)]).texels, 0);
    }
    let missing = Path::new("/nowhere/at/all");
    assert_eq!(estimate(("m.glb", missing), &[], &Limits::default(), 2, PACKS).unwrap().triangles, 0);
    // As the loader takes it: the last of two keys counts, and what is of the wrong type is passed over.
    let twice = br#"{"images": [], "extra": {"images": 1}, "images": [7, {"uri": 5}, {"uri": "a.png"}]}"#;
    assert_eq!(estimated(&[("m.gltf", twice), ("a.png", &png(8, 8))]).texels, 64);
}
