//! `atlas.merge`, through the whole recipe.

use serde_json::json;

use crate::asset::merge::tests::{counts, model, scene};
use crate::asset::{File, Limits, Merged, load};
use crate::context::Context;
use crate::refine::options::Options;
use crate::refine::{Input, refine};

#[test]
fn a_merged_model_has_one_texture_and_looks_the_same() {
    let doc = model();
    let before = scene(&doc);
    let files = vec![File { path: "m.glb".to_owned(), bytes: doc.to_glb().unwrap() }];
    let mut options = Options::default();
    options.atlas.merge = true;
    let input = Input { models: vec![files], limits: Limits::default(), extras: false };
    let outcome = refine(&input, &options, &Context::silent()).unwrap();
    let merged: Vec<Merged> = serde_json::from_value(outcome.report["merged"].clone()).unwrap();
    assert_eq!((merged[0].draw_calls, merged[0].images, merged[0].textures), counts([5, 2], [2, 1], [2, 1]));
    assert_eq!(merged[0].materials[2].folded, ["baseColorFactor"]);
    assert!(merged[0].materials[2].rounding <= 0.5);
    let texture = &outcome.report["textures"][0];
    assert_eq!((&texture["exact"], &texture["psnr_db"]), (&json!(true), &json!(120.0)));
    let bytes = outcome.artifacts.iter().find(|a| a.name == "model.glb").unwrap().bytes.clone();
    let (out, _) = load(&[File { path: "m.glb".to_owned(), bytes }], None, &Limits::default()).unwrap();
    assert_eq!(scene(&out), before);
    assert_eq!(out.json["materials"].as_array().unwrap().len(), 3, "materials keep their numbers");
    assert_eq!((out.images.len(), out.json["meshes"][0]["primitives"].as_array().unwrap().len()), (1, 1));
}
