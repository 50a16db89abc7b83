//! `--recipe bounded` and the presets that end in it: the packing efficiency that is asked for is there, and nothing else is lost.

use std::collections::BTreeSet;
use std::time::Instant;

use intarsia::asset::sample::sample;
use intarsia::asset::{Document, File, Limits, UvSet, load, read_vec2, read_vec3};
use intarsia::atlas::OverlapMode;
use intarsia::context::Context;
use intarsia::packing::Gutter;
use intarsia::refine::bounded::params::Bounded;
use intarsia::refine::optcuts::params::{OptCuts, Quality};
use intarsia::refine::options::{IfLarger, Options};
use intarsia::refine::{Input, Outcome, inspect, refine};
use intarsia::texture::TextureFormat;
use serde_json::Value;

use super::box_cutter::whole_but_cut;
use super::data;
use super::lossless::{Model, differences};

/// Options with which every bound can be had.
fn options(recipe: &str, bound: f64) -> Options {
    let mut options = Options::preset(recipe);
    options.pack.gutter = Gutter::Texels(0);
    options.texture.format = TextureFormat::Png.into();
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    options.stages.set(Bounded { packing_efficiency: bound, ..options.stages.get() });
    options
}

fn run(name: &str, models: Vec<Vec<File>>, options: &Options) -> Outcome {
    let start = Instant::now();
    let outcome = refine(&Input { models, ..Input::default() }, options, &Context::silent())
        .unwrap_or_else(|failure| panic!("{name}: {failure}"));
    println!("{name}: {:.1} s, {}", start.elapsed().as_secs_f64(), outcome.report["stages"]);
    outcome
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn made(name: &str) -> Vec<File> {
    vec![File { path: format!("{name}.glb"), bytes: sample(name).expect("a sample") }]
}

fn opened(files: &[File]) -> Document {
    load(files, None, &Limits::default()).expect("the model loads").0
}

fn warned(outcome: &Outcome, code: &str) -> bool {
    list(&outcome.report["warnings"]).iter().any(|w| w["code"] == code)
}

/// The models of the result, in order.
fn delivered(outcome: &Outcome) -> Vec<&[u8]> {
    outcome.artifacts.iter().filter(|a| a.role == "model").map(|a| a.bytes.as_slice()).collect()
}

/// Everything of the model is there still, and others can read it.
fn whole(name: &str, original: &[u8], glb: &[u8]) {
    whole_but_cut(name, original, glb);
    let lost = differences(&Model::new(original), &Model::new(glb));
    assert!(lost.is_empty(), "{name}: {lost:#?}");
}

/// Every atlas with a layout was refined, lies on itself nowhere, and covers at least this part of its box.
fn is_packed(name: &str, outcome: &Outcome, bound: f64) {
    let atlases = list(&outcome.report["atlases"]);
    let (with, without): (Vec<&Value>, Vec<&Value>) = atlases.iter().partition(|a| a["refined"] == true);
    assert!(!with.is_empty(), "{name}: there is no atlas");
    assert!(without.iter().all(|a| a["before"]["packing_efficiency"].is_null()), "{name}: {without:#?}");
    for atlas in with {
        let after = &atlas["after"];
        let figure = |key: &str| after[key].as_f64().unwrap_or(f64::NAN);
        assert_eq!(after["flipped_triangles"], 0, "{name}: {after}");
        assert!(figure("overlap_fraction") < 1e-6 && figure("stacked_fraction") < 1e-6, "{name}: {after}");
        assert!(figure("packing_efficiency") >= bound - 1e-6, "{name}: {after}");
        println!("{name}: {} to {}", atlas["before"]["packing_efficiency"], after["packing_efficiency"]);
    }
}

#[test]
fn real_models_reach_the_bound() {
    for (name, files) in data::models(&["uv/spot.obj", "pbr/draco_Fox/Fox.gltf", "pbr/trimesh_fuze/fuze.obj"]) {
        let original = opened(&files).to_glb().expect("a GLB");
        let outcome = run(name, vec![files], &options("bounded", 0.8));
        is_packed(name, &outcome, 0.8);
        assert!(!warned(&outcome, "bound_not_met"), "{name}: {:#}", outcome.report["warnings"]);
        whole(name, &original, delivered(&outcome)[0]);
    }
}

/// Without real models too, and where what is drawn is a texture.
#[test]
fn samples_reach_the_bound_with_their_textures() {
    for name in ["textured", "skinned"] {
        let outcome = run(name, vec![made(name)], &options("bounded", 0.8));
        is_packed(name, &outcome, 0.8);
        whole(&format!("bounded-{name}"), &sample(name).expect("a sample"), delivered(&outcome)[0]);
        let textures = list(&outcome.report["textures"]);
        assert!(!textures.is_empty(), "{name}: its textures are drawn anew");
        for texture in textures {
            assert!(texture["psnr_db"].as_f64().is_none_or(|p| p > 30.0), "{name}: {texture}");
        }
    }
}

/// Several models share an atlas, and the bound is on that.
#[test]
fn a_collection_reaches_the_bound_in_one_atlas() {
    let names = ["skinned", "two_materials"];
    let outcome = run("collection", names.map(made).to_vec(), &options("bounded", 0.8));
    let atlases = list(&outcome.report["atlases"]);
    assert!(atlases.iter().any(|a| a["models"] == serde_json::json!([0, 1])), "{atlases:#?}");
    is_packed("collection", &outcome, 0.8);
    let models = delivered(&outcome);
    assert_eq!(models.len(), names.len());
    for (name, glb) in names.iter().zip(models) {
        whole_but_cut(&format!("collection-{name}"), &sample(name).expect("a sample"), glb);
    }
}

/// By vertex of all primitives: where it is, and where in the first TEXCOORD set.
fn textured_vertices(doc: &Document) -> BTreeSet<[u32; 5]> {
    let meshes = list(&doc.json["meshes"]).iter();
    let mut vertices = BTreeSet::new();
    for attributes in meshes.flat_map(|m| list(&m["primitives"])).map(|p| &p["attributes"]) {
        let index = |name: &str| attributes[name].as_u64().expect("an accessor") as usize;
        let positions = read_vec3(doc, index("POSITION")).expect("positions");
        let uvs = read_vec2(doc, index("TEXCOORD_0")).expect("UVs");
        vertices.extend(positions.iter().zip(&uvs).map(|([x, y, z], [u, v])| [*x, *y, *z, *u, *v].map(f32::to_bits)));
    }
    vertices
}

/// The images that a model holds.
fn images(doc: &Document) -> Vec<Option<&[u8]>> {
    doc.images.iter().map(Option::as_deref).collect()
}

/// Texels of the sheet of set 1: its UVs as they are written say how long a unit of the surface is in parts of a sheet, and the report, in texels.
fn sheet_texels(outcome: &Outcome, glb: &[u8]) -> f64 {
    let mut options = Options::default();
    options.atlas.uv_set = UvSet::Number(1);
    let files = vec![File { path: "lightmap.glb".to_owned(), bytes: glb.to_vec() }];
    let input = Input { models: vec![files], ..Input::default() };
    let written = inspect(&input, &options, &Context::silent()).expect("it is read");
    let density =
        |report: &Value| report["atlases"][0]["after"]["texel_density"]["median"].as_f64().expect("a density");
    // Without textures a sheet is taken for one of 1024 x 1024.
    (1024.0 * density(&outcome.report) / density(&written)).powi(2)
}

#[test]
fn light_maps_get_a_set_of_their_own() {
    for name in ["textured", "skinned"] {
        let outcome = run(name, vec![made(name)], &Options::preset("lightmap"));
        let glb = delivered(&outcome)[0];
        whole(&format!("lightmap-{name}"), &sample(name).expect("a sample"), glb);
        let before = opened(&made(name));
        let after = opened(&[File { path: "lightmap.glb".to_owned(), bytes: glb.to_vec() }]);
        // Cuts add vertices; those that were there are as they were.
        let (old, new) = (textured_vertices(&before), textured_vertices(&after));
        assert!(old.is_subset(&new), "{name}: {} vertices changed", old.difference(&new).count());
        assert_eq!(images(&before), images(&after), "{name}: no texture changes");
        assert_eq!(before.json["materials"], after.json["materials"], "{name}");
        assert_eq!(list(&outcome.report["textures"]).len(), 0, "{name}: no texture is drawn anew");
        for atlas in list(&outcome.report["atlases"]) {
            let figures = &atlas["after"];
            assert_eq!(atlas["uv_sets"], serde_json::json!([1]), "{name}: {atlas}");
            assert!(figures["gutter_texels"].as_f64().is_none_or(|g| g >= 4.0), "{name}: {figures}");
        }
        let texels = sheet_texels(&outcome, glb);
        assert!((texels.log2() - texels.log2().round()).abs() < 1e-4, "{name}: {texels} texels are no power of two");
        let bound = if warned(&outcome, "bound_not_met") { 0.0 } else { 0.9 };
        is_packed(name, &outcome, bound);
    }
}

#[test]
fn what_has_no_layout_gets_one_that_reaches_the_bound() {
    let mut options = options("unwrap_tight", 0.8);
    options.stages.set(OptCuts { quality: Quality::Fast, ..options.stages.get() });
    let outcome = run("bare", vec![made("bare")], &options);
    is_packed("bare", &outcome, 0.8);
    let stages: Vec<&Value> = list(&outcome.report["stages"]).iter().map(|s| &s["stage"]).collect();
    assert_eq!(stages, ["optcuts", "bounded"]);
    whole_but_cut("bare", &sample("bare").expect("a sample"), delivered(&outcome)[0]);
}

/// Both bounds at once, where they can be had.
#[test]
fn tight_bounds_seams_too() {
    let models = std::iter::once(("skinned", made("skinned"))).chain(data::models(&["uv/spot.obj"]));
    for (name, files) in models {
        let original = opened(&files).to_glb().expect("a GLB");
        let outcome = run(name, vec![files], &options("tight", 0.8));
        is_packed(name, &outcome, 0.8);
        whole(&format!("tight-{name}"), &original, delivered(&outcome)[0]);
        let atlas = &outcome.report["atlases"][0];
        let [before, after] = ["before", "after"].map(|when| atlas[when]["seam_length"].as_f64().expect("a length"));
        assert!(after <= 1.35 * before + 1e-6, "{name}: {before} became {after}");
    }
}
