//! `--recipe unwrap` and `polish`: surfaces as they come get a layout that others can read, and keep everything else.

use std::collections::{BTreeMap, BTreeSet};

use intarsia::asset::sample::sample;
use intarsia::asset::{
    ARRAY_BUFFER, Document, File, Limits, RawAccessor, load, read_indices, read_vec2, read_vec3, read_vec4,
};
use intarsia::context::Context;
use intarsia::refine::optcuts::params::{OptCuts, Quality};
use intarsia::refine::options::{ImportanceSource, Options};
use intarsia::refine::{Input, Outcome, refine};
use serde_json::Value;

use super::{data, every};

/// Packing is not what is tried here.
const WORK: u64 = 2_000_000;

fn run(name: &str, recipe: &str, files: Vec<File>) -> Outcome {
    let mut options = Options::preset(recipe);
    options.stages.set(OptCuts { quality: Quality::Fast, ..options.stages.get() });
    options.work_budget = Some(WORK);
    let input = Input { models: vec![files], extras: true, ..Input::default() };
    refine(&input, &options, &Context::silent()).unwrap_or_else(|failure| panic!("{name}: {failure}"))
}

fn opened(name: &str) -> Document {
    let file = File { path: format!("{name}.glb"), bytes: sample(name).expect("a sample") };
    load(&[file], None, &Limits::default()).expect("the sample loads").0
}

/// Unwraps what `files` are, given as GLB too: nothing is lost, nothing overlaps, and every triangle has texture coordinates.
fn unwrap(name: &str, files: Vec<File>, glb: &[u8]) -> Outcome {
    let start = std::time::Instant::now();
    let outcome = run(name, "unwrap", files);
    let path = every::written(&format!("{name}.bare"), glb);
    every::whole(name, &path, glb, &outcome);
    let codes: Vec<&str> = list(&outcome.report["warnings"]).iter().filter_map(|w| w["code"].as_str()).collect();
    assert!(codes.iter().all(|c| *c == "bound_not_met"), "{name}: {:#}", outcome.report["warnings"]);
    let atlases = list(&outcome.report["atlases"]);
    assert!(!atlases.is_empty() && atlases.iter().all(|a| a["refined"] == true), "{name}: {atlases:#?}");
    for (atlas, stage) in atlases.iter().zip(list(&outcome.report["stages"])) {
        let after = &atlas["after"];
        assert_eq!(after["flipped_triangles"], 0, "{name}: {after}");
        assert!(after["overlap_fraction"].as_f64().is_some_and(|o| o < 1e-6), "{name}: {after}");
        assert_eq!(after["stacked_fraction"].as_f64(), Some(0.0), "{name}: {after}");
        let met = stage["bound_met"] == true && stage["symmetric_dirichlet"].as_f64().is_some_and(|e| e <= 4.1 + 1e-6);
        assert!(met || codes.contains(&"bound_not_met"), "{name}: {stage}");
    }
    let model = outcome.artifacts.iter().find(|a| a.role == "model").expect("a model");
    let model = gltf::Gltf::from_slice_without_validation(&model.bytes).expect("a GLB");
    for primitive in model.meshes().flat_map(|m| m.primitives().collect::<Vec<_>>()) {
        let uvs = primitive.get(&gltf::Semantic::TexCoords(0)).unwrap_or_else(|| panic!("{name} has no TEXCOORD_0"));
        let positions = primitive.get(&gltf::Semantic::Positions).expect("positions");
        assert_eq!(uvs.count(), positions.count(), "{name}");
    }
    let pictures: Vec<&str> =
        outcome.artifacts.iter().filter(|a| a.role == "picture").map(|a| a.name.as_str()).collect();
    assert!(pictures.contains(&"atlas-0.after.png"), "{name}: {pictures:?}");
    println!("{name}: {:.1} s, {}", start.elapsed().as_secs_f64(), outcome.report["stages"]);
    outcome
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn unwrapped_document(name: &str, doc: &Document) -> Outcome {
    let glb = doc.to_glb().expect("a GLB");
    unwrap(name, vec![File { path: "bare.glb".to_owned(), bytes: glb.clone() }], &glb)
}

#[test]
fn bare_samples_get_a_layout() {
    let outcome = unwrapped_document("bare", &opened("bare"));
    assert!(outcome.report["atlases"][0]["before"]["packing_efficiency"].is_null());
    let outcome = unwrapped_document("defects", &opened("defects"));
    assert_eq!(outcome.report["stages"][0]["degenerate_faces"], 3);
}

/// What a primitive is made of is kept, whatever it is: skins and morph targets, quantised positions, strips, fans, no indices.
#[test]
fn whatever_a_primitive_is_made_of_stays() {
    for name in ["skinned", "quantized", "strips", "textured"] {
        let mut doc = opened(name);
        for primitive in doc.json["meshes"].as_array_mut().expect("meshes").iter_mut() {
            for primitive in primitive["primitives"].as_array_mut().expect("primitives") {
                let primitive = primitive.as_object_mut().expect("an object");
                primitive.shift_remove("material");
                // Every other sample without indices is what its vertices are in order.
                if name == "textured" {
                    primitive.shift_remove("indices");
                }
                let attributes = primitive["attributes"].as_object_mut().expect("attributes");
                attributes.shift_remove("TEXCOORD_0");
                attributes.shift_remove("TANGENT");
            }
        }
        unwrapped_document(&format!("bare-{name}"), &doc);
    }
}

#[test]
fn surfaces_of_research_and_broken_ones_are_unwrapped() {
    let names = [
        "meshes/bishop_part.obj",
        "meshes/bunny_decim_noInputUV.obj",
        "meshes/cathead.obj",
        "meshes/double_triangles.obj",
        "meshes/sphere_uniRemesh.obj",
        "meshes/torus_with_hole.obj",
        "meshes/multiComp.obj",
        "hostile/ArtDemo.obj",
        "hostile/toy.obj",
        "hostile/cube.obj",
        "hostile/triangle_clockwise.obj",
    ];
    for (name, files) in data::models(&names) {
        let (doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
        unwrap(name, files, &doc.to_glb().expect("a GLB"));
    }
}

/// The textured model is polished with its textures.
#[test]
fn textures_come_along() {
    let glb = sample("strips").expect("a sample");
    let outcome = run("strips", "polish", vec![File { path: "strips.glb".to_owned(), bytes: glb.clone() }]);
    every::whole("polish", &every::written("strips.polish", &glb), &glb, &outcome);
    let report = &outcome.report;
    assert!(list(&report["warnings"]).iter().all(|w| w["code"] == "heavier_texture"), "{:#}", report["warnings"]);
    assert_eq!(report["atlases"][0]["uv_sets"], serde_json::json!([0]));
    let texture = &report["textures"][0];
    assert!(texture["psnr_db"].as_f64().is_some_and(|p| p > 30.0), "{texture}");
    let density = |when: &str| report["atlases"][0][when]["texel_density"]["median"].as_f64().expect("a density");
    let ratio = density("after") / density("before");
    assert!((0.5..2.0).contains(&ratio), "texels by length changed by {ratio}");
}

/// What has a layout keeps it, with its textures, and gets one more.
#[test]
fn textured_models_get_a_layout_beside_their_own() {
    for name in ["textured", "skinned", "two_materials"] {
        let glb = sample(name).expect("a sample");
        let outcome = run(name, "unwrap", vec![File { path: format!("{name}.glb"), bytes: glb.clone() }]);
        every::whole(name, &every::written(&format!("{name}.new"), &glb), &glb, &outcome);
        let report = &outcome.report;
        assert_eq!(list(&report["textures"]).len(), 0, "{name}: no texture is drawn anew");
        for atlas in list(&report["atlases"]) {
            assert!(
                atlas["refined"] == true && atlas["after"]["overlap_fraction"].as_f64() < Some(1e-6),
                "{name}: {atlas}"
            );
        }
    }
}

/// Length of the seams of the first primitive between painted vertices.
fn painted_seams(glb: &[u8]) -> f64 {
    let file = File { path: "unwrapped.glb".to_owned(), bytes: glb.to_vec() };
    let (doc, _) = load(&[file], None, &Limits::default()).expect("the model loads");
    let primitive = &doc.json["meshes"][0]["primitives"][0];
    let index = |value: &Value| value.as_u64().expect("an index") as usize;
    let attribute = |name: &str| index(&primitive["attributes"][name]);
    let positions = read_vec3(&doc, attribute("POSITION")).expect("positions");
    let uvs = read_vec2(&doc, attribute("TEXCOORD_0")).expect("UVs");
    let colours = read_vec4(&doc, attribute("COLOR_0")).expect("colours");
    let indices = read_indices(&doc, index(&primitive["indices"])).expect("indices");
    // By edge, with its ends in order: the UVs of its ends in each of its faces.
    let mut edges: BTreeMap<[[u32; 3]; 2], Vec<[[u32; 2]; 2]>> = BTreeMap::new();
    let mut length = BTreeMap::new();
    for (face, k) in indices.chunks_exact(3).flat_map(|face| [0, 1, 2].map(|k| (face, k))) {
        let mut ends = [face[k], face[(k + 1) % 3]].map(|v| v as usize);
        ends.sort_by_key(|v| positions[*v].map(f32::to_bits));
        let edge = ends.map(|v| positions[v].map(f32::to_bits));
        edges.entry(edge).or_default().push(ends.map(|v| uvs[v].map(f32::to_bits)));
        if ends.iter().all(|v| colours[*v][0] > 0.5) {
            let [a, b] = ends.map(|v| glam::Vec3::from(positions[v]));
            length.insert(edge, f64::from(a.distance(b)));
        }
    }
    let is_seam = |faces: &[[[u32; 2]; 2]]| faces.windows(2).any(|pair| pair[0] != pair[1]);
    length.iter().filter(|(edge, _)| is_seam(&edges[*edge])).map(|(_, length)| length).sum()
}

/// A face that is painted keeps its seams elsewhere.
#[test]
fn seams_stay_out_of_a_painted_face() {
    for (_, files) in data::models(&["meshes/salience/face_f10000.obj"]) {
        let list = data::folder().expect("the folder").join("meshes/salience/face_f10000_selected.txt");
        let list = std::fs::read_to_string(list).expect("its list");
        let selected: Vec<usize> = list.split_whitespace().map(|n| n.parse().expect("a number")).collect();
        let text = String::from_utf8(files[0].bytes.clone()).expect("an OBJ text");
        let place = |line: &str| -> Option<[u32; 3]> {
            let mut words = line.strip_prefix("v ")?.split_whitespace();
            Some([(); 3].map(|()| words.next().and_then(|w| w.parse::<f32>().ok()).expect("a number").to_bits()))
        };
        let places: Vec<[u32; 3]> = text.lines().filter_map(place).collect();
        let painted: BTreeSet<[u32; 3]> = selected.iter().map(|v| places[*v]).collect();
        let (mut doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
        let primitive = &doc.json["meshes"][0]["primitives"][0];
        let positions = primitive["attributes"]["POSITION"].as_u64().expect("an index") as usize;
        let positions = read_vec3(&doc, positions).expect("positions");
        let red = |p: &[f32; 3]| if painted.contains(&p.map(f32::to_bits)) { 1.0 } else { 0.01 };
        let colours: Vec<[f32; 4]> = positions.iter().map(|p| [red(p), 0.0, 0.0, 1.0]).collect();
        let colours = doc.append_accessor(&RawAccessor::from_floats(&colours), Some(ARRAY_BUFFER), false);
        doc.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = colours.into();
        let glb = doc.to_glb().expect("a GLB");
        let inside = |importance: Option<ImportanceSource>| {
            let mut options = Options::preset("unwrap");
            options.importance = importance;
            options.stages.set(OptCuts { quality: Quality::Fast, ..options.stages.get() });
            let files = vec![File { path: "face.glb".to_owned(), bytes: glb.clone() }];
            let input = Input { models: vec![files], ..Input::default() };
            let outcome = refine(&input, &options, &Context::silent()).expect("it is unwrapped");
            assert_eq!(outcome.report["stages"][0]["bound_met"], true);
            painted_seams(&outcome.artifacts.iter().find(|a| a.role == "model").expect("a model").bytes)
        };
        let (free, kept) = (inside(None), inside(Some(ImportanceSource::Attribute("COLOR_0.r".to_owned()))));
        assert!(free > 0.0 && kept <= 0.2 * free, "{kept} of {free}");
    }
}
