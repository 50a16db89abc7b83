//! Models with compressed geometry against the same models without.

use intarsia::asset::{ARRAY_BUFFER, Document, File, Limits, RawAccessor, load, read_indices, read_vec2, read_vec3};
use intarsia::context::Context;
use intarsia::packing::Grid;
use intarsia::refine::options::{IfLarger, Options};
use intarsia::refine::{Input, Outcome, refine};
use intarsia::texture::TextureFormat;
use sha2::{Digest, Sha256};

use super::{data, geometry, node};

fn open(files: &[File]) -> (Document, Vec<String>) {
    let (doc, warnings) = load(files, None, &Limits::default()).expect("the model loads");
    (doc, warnings.into_iter().map(|w| w.code).collect())
}

/// Positions and number of triangles of every primitive.
fn surfaces(doc: &Document) -> Vec<(Vec<[f32; 3]>, usize)> {
    let primitives = doc.json["meshes"].as_array().expect("meshes").iter().flat_map(|m| m["primitives"].as_array());
    let index = |value: &serde_json::Value| value.as_u64().expect("an index") as usize;
    primitives
        .flatten()
        .map(|p| {
            let positions = read_vec3(doc, index(&p["attributes"]["POSITION"])).expect("positions");
            let indices = read_indices(doc, index(&p["indices"])).expect("indices");
            assert!(indices.iter().all(|i| (*i as usize) < positions.len()), "indices are in range");
            (positions, indices.len() / 3)
        })
        .collect()
}

/// Places with the box that holds them moved and scaled to [0,1].
fn in_unit_box(positions: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let bound = |f: fn(f32, f32) -> f32, k: usize| positions.iter().map(|p| p[k]).reduce(f).expect("positions");
    let low = [0, 1, 2].map(|k| bound(f32::min, k));
    let size = [0, 1, 2].map(|k| bound(f32::max, k) - low[k]).into_iter().fold(0.0, f32::max);
    positions.iter().map(|p| [0, 1, 2].map(|k| (p[k] - low[k]) / size)).collect()
}

/// The greatest distance, along an axis, from a place of `a` to its nearest of `b`.
fn distance(a: &[[f32; 3]], b: &[[f32; 3]]) -> f32 {
    let far = |p: &[f32; 3], q: &[f32; 3]| (0..3).map(|k| (p[k] - q[k]).abs()).fold(0.0, f32::max);
    a.iter().map(|p| b.iter().map(|q| far(p, q)).fold(f32::INFINITY, f32::min)).fold(0.0, f32::max)
}

/// That both models have the same surfaces, within a part of the size of each.
fn same_surfaces(compressed: &Document, plain: &Document, within: f32) {
    let (compressed, plain) = (surfaces(compressed), surfaces(plain));
    assert_eq!(compressed.len(), plain.len());
    for ((a, faces), (b, expected)) in compressed.iter().zip(&plain) {
        assert_eq!(faces, expected);
        let (a, b) = (in_unit_box(a), in_unit_box(b));
        let found = distance(&a, &b).max(distance(&b, &a));
        assert!(found <= within, "{found} of the size of the model, and {within} is what quantisation may take");
    }
}

/// That the validator has nothing against a model as it is written; the duck's normals are short before and after.
fn is_valid(doc: &Document, name: &str) {
    let file = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}.decompressed.glb"));
    std::fs::write(&file, doc.to_glb().expect("a GLB")).expect("a file");
    if let Some(mut errors) = node::errors(&file) {
        errors.retain(|e| !e.contains("ACCESSOR_VECTOR3_NON_UNIT"));
        assert!(errors.is_empty(), "{name}: the validator finds {errors:?}");
    }
}

fn pack(files: Vec<File>) -> Outcome {
    let input = Input { models: vec![files], ..Input::default() };
    refine(&input, &Options::default(), &Context::silent()).expect("the model is refined")
}

#[test]
fn draco_and_plain_models_are_the_same() {
    let Some(files) = data::model("pbr/cesium_MilkTruck_draco/CesiumMilkTruck.gltf") else { return };
    let (compressed, warnings) = open(&files);
    // Its first primitive holds more vertices than its accessors declare.
    assert_eq!(warnings, ["accessor_count_corrected"]);
    is_valid(&compressed, "CesiumMilkTruck");
    let Some(plain) = data::model("pbr/khr_CesiumMilkTruck/CesiumMilkTruck.glb") else { return };
    same_surfaces(&compressed, &open(&plain).0, 1.0 / 2048.0);
}

#[test]
fn meshopt_and_plain_models_are_the_same() {
    let Some(files) = data::model("pbr/cesium_Duck_meshopt/Duck-vp-12-vt-12-vn-12.glb") else { return };
    let (compressed, warnings) = open(&files);
    assert!(warnings.is_empty(), "{warnings:?}");
    is_valid(&compressed, "Duck");
    let Some(plain) = data::model("pbr/khr_Duck/Duck.glb") else { return };
    same_surfaces(&compressed, &open(&plain).0, 1.0 / 4095.0);
}

/// Bytes of a GLB without its images.
fn geometry_bytes(glb: &[u8]) -> usize {
    let parsed = gltf::binary::Glb::from_slice(glb).expect("a GLB");
    let json: serde_json::Value = serde_json::from_slice(&parsed.json).expect("JSON");
    let number = |value: &serde_json::Value| value.as_u64().unwrap_or(0) as usize;
    let images = json["images"].as_array().into_iter().flatten().map(|i| number(&i["bufferView"]));
    let images: usize = images.map(|view| number(&json["bufferViews"][view]["byteLength"])).sum();
    parsed.bin.map_or(0, |bin| bin.len()) - images
}

#[test]
fn compressed_models_leave_as_they_came() {
    let names = [
        "pbr/cesium_MilkTruck_draco/CesiumMilkTruck.gltf",
        "scans/loaders_tile.glb",
        "pbr/cesium_Duck_meshopt/Duck-vp-12-vt-12-vn-12.glb",
    ];
    for (name, files) in data::models(&names) {
        let (original, _) = open(&files);
        let outcome = pack(files);
        let model = outcome.artifacts.iter().find(|a| a.role == "model").expect("a model");
        let codec = if name.contains("Duck") { "EXT_meshopt_compression" } else { "KHR_draco_mesh_compression" };
        assert!(String::from_utf8_lossy(&model.bytes).contains(codec), "{name} is compressed with {codec}");
        let (delivered, warnings) = open(&[File { path: "out.glb".to_owned(), bytes: model.bytes.clone() }]);
        assert!(warnings.is_empty(), "{name}: {warnings:?}");
        // To the bit: whatever the codec rounds was rounded so when it came.
        let corners = |doc: &Document| {
            let all = geometry::corners(&doc.to_glb().expect("a GLB"));
            let mut all: Vec<String> = all.into_iter().flatten().map(|corner| format!("{corner:?}")).collect();
            all.sort();
            all
        };
        assert!(corners(&delivered) == corners(&original), "{name}: the surface changed");
        let plain = geometry_bytes(&original.to_glb().expect("a GLB"));
        let compressed = geometry_bytes(&model.bytes);
        println!("{name}: {compressed} bytes of geometry, {plain} without a codec");
        assert!(compressed * 2 < plain, "{name}: {compressed} of {plain} bytes");
        for texture in outcome.report["textures"].as_array().expect("textures") {
            assert!(
                texture["layout_psnr_db"].as_f64().or(texture["psnr_db"].as_f64()).is_some_and(|db| db > 60.0),
                "{name}: {texture}"
            );
        }
        let file = std::path::Path::new(env!("CARGO_TARGET_TMPDIR"))
            .join(format!("{}.compressed.glb", name.replace('/', "_")));
        std::fs::write(&file, &model.bytes).expect("a file");
        let Some((errors, read)) = node::errors(&file).zip(node::transform(&file)) else { continue };
        assert!(errors.is_empty(), "{name}: the validator finds {errors:?}");
        // Other decoders than ours: Google's and that of meshoptimizer.
        assert_eq!(read["broken"], serde_json::json!([]), "{name}: {read}");
    }
}

#[test]
fn quantised_attributes_stay_quantised() {
    let Some(files) = data::model("pbr/cesium_Duck_meshopt/Duck-vp-12-vt-12-vn-12.glb") else { return };
    let (mut doc, _) = open(&files);
    // The texture transform goes into the UVs, so that they are refined in any case.
    let texture = doc.json.pointer_mut("/materials/0/pbrMetallicRoughness/baseColorTexture").expect("a texture");
    let transform = texture.as_object_mut().and_then(|t| t.shift_remove("extensions")).expect("a texture transform");
    let number =
        |key: &str, axis: usize| transform["KHR_texture_transform"][key][axis].as_f64().expect("a number") as f32;
    let uvs = read_vec2(&doc, 2).expect("UVs");
    let uvs: Vec<_> = uvs.iter().map(|uv| [0, 1].map(|k| uv[k] * number("scale", k) + number("offset", k))).collect();
    let uv = doc.append_accessor(&RawAccessor::from_floats(&uvs), Some(ARRAY_BUFFER), false);
    doc.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = uv.into();
    let original = doc.to_glb().expect("a GLB");
    let outcome = pack(vec![File { path: "duck.glb".to_owned(), bytes: original.clone() }]);
    let model = outcome.artifacts.iter().find(|a| a.role == "model").expect("a model");
    let (refined, _) = open(&[File { path: "out.glb".to_owned(), bytes: model.bytes.clone() }]);
    for (attribute, component) in [("POSITION", 5123), ("NORMAL", 5122)] {
        let accessor = refined.json["meshes"][0]["primitives"][0]["attributes"][attribute].as_u64().expect("an index");
        assert_eq!(refined.json["accessors"][accessor as usize]["componentType"], component, "{attribute}");
    }
    same_surfaces(&refined, &doc, 0.0);
}

/// The images of a GLB.
fn images(glb: &[u8]) -> Vec<Vec<u8>> {
    let model = gltf::Gltf::from_slice_without_validation(glb).expect("a GLB");
    let blob = model.blob.as_deref().unwrap_or_default();
    let json: serde_json::Value =
        serde_json::from_slice(&gltf::binary::Glb::from_slice(glb).expect("a GLB").json).expect("JSON");
    let number = |value: &serde_json::Value| value.as_u64().unwrap_or(0) as usize;
    let view = |image: &serde_json::Value| {
        let view = &json["bufferViews"][number(&image["bufferView"])];
        let start = number(&view["byteOffset"]);
        blob[start..start + number(&view["byteLength"])].to_vec()
    };
    json["images"].as_array().into_iter().flatten().map(view).collect()
}

/// Reads the KTX2 files of a delivered model by Binomial's transcoder, which shows what ours shows; gives whether they are UASTC, and levels.
fn read_basis(name: &str, glb: &[u8]) -> Vec<(bool, u64)> {
    let images = images(glb);
    let mut told = Vec::new();
    for (i, image) in images.iter().enumerate().filter(|(_, image)| image.starts_with(b"\xabKTX 20")) {
        let file =
            std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}.{i}.ktx2", name.replace('/', "_")));
        std::fs::write(&file, image).expect("a file");
        let Some(read) = node::basis(&file) else { continue };
        assert_eq!(read["broken"], serde_json::Value::Null, "{name}: {read}");
        let shown = intarsia::texture::decode(image, 1 << 26).expect("an image").to_rgba8();
        assert_eq!(
            (read["width"].as_u64(), read["height"].as_u64()),
            (Some(shown.width().into()), Some(shown.height().into()))
        );
        let hash: String = Sha256::digest(shown.as_raw()).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(read["sha256"], hash, "{name}: Binomial's transcoder shows something else");
        told.push((read["uastc"] == true, read["levels"].as_u64().unwrap_or(0)));
    }
    told
}

#[test]
fn ktx2_leaves_as_ktx2() {
    for (name, files) in data::models(&["scans/loaders_agi_ktx2.glb"]) {
        let original = open(&files).0.to_glb().expect("a GLB");
        let [before] = &images(&original)[..] else { panic!("{name} has one image") };
        let outcome = pack(files.clone());
        let model = &outcome.artifacts.iter().find(|a| a.role == "model").expect("a model").bytes;
        let [after] = &images(model)[..] else { panic!("{name} has one image") };
        let size = |file: &[u8]| {
            intarsia::texture::header(file).map(|h| f64::from(h.width) * f64::from(h.height)).expect("a header")
        };
        let (was, is) = (before.len() as f64 / size(before), after.len() as f64 / size(after));
        println!("{name}: {} bytes, {} before: {:.3} of its bytes a texel", after.len(), before.len(), is / was);
        assert!(is < 1.1 * was, "{name}: {is} bytes a texel, {was} before");
        for (uastc, levels) in read_basis(name, model) {
            assert!(!uastc && levels > 1, "{name}");
        }
        let db = |outcome: &Outcome| outcome.report["textures"][0]["psnr_db"].as_f64().unwrap_or(0.0);
        assert!(db(&outcome) > 31.0, "{:#}", outcome.report["textures"]);
        // Charts that move by whole blocks keep them, turned or not.
        let mut options = Options::default();
        options.pack.grid = Grid::Texels(4);
        let input = Input { models: vec![files], ..Input::default() };
        let outcome = refine(&input, &options, &Context::silent()).expect("the model is refined");
        assert!(db(&outcome) > 44.0, "{:#}", outcome.report["textures"]);
    }
}

#[test]
fn others_become_ktx2_where_that_is_asked_for() {
    let glb = intarsia::asset::sample::sample("textured").expect("a sample");
    let files = vec![File { path: "sample.glb".to_owned(), bytes: glb }];
    for (format, uastc) in
        [(TextureFormat::Ktx2Etc1s, Some(false)), (TextureFormat::Ktx2Uastc, Some(true)), (TextureFormat::Ktx2, None)]
    {
        let mut options = Options::default();
        options.texture.format = format.into();
        options.atlas.if_larger = IfLarger::Accept;
        let input = Input { models: vec![files.clone()], ..Input::default() };
        let outcome = refine(&input, &options, &Context::silent()).expect("the model is refined");
        let model = &outcome.artifacts.iter().find(|a| a.role == "model").expect("a model").bytes;
        assert!(String::from_utf8_lossy(model).contains("KHR_texture_basisu"));
        let told = read_basis(&format!("sample-{uastc:?}"), model);
        assert!(told.iter().all(|(is, levels)| uastc.is_none_or(|wanted| *is == wanted) && *levels > 1), "{told:?}");
        let file = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("sample-{uastc:?}.ktx2.glb"));
        std::fs::write(&file, model).expect("a file");
        let Some(((errors, transform), three)) =
            node::errors(&file).zip(node::transform(&file)).zip(node::three(&file))
        else {
            continue;
        };
        assert!(errors.is_empty(), "the validator finds {errors:?}");
        for read in [transform, three] {
            assert_eq!(read["broken"], serde_json::json!([]), "{read}");
        }
    }
}
