//! Extensions of primitives that nobody here has heard of.

use intarsia::asset::File;
use intarsia::asset::sample::sample;
use intarsia::context::Context;
use intarsia::refine::{Input, Outcome, parse, refine};
use serde_json::{Value, json};

/// A GLB with its JSON changed.
fn edited(glb: &[u8], change: impl Fn(&mut Value)) -> Vec<u8> {
    let (mut json, rest) = parts(glb);
    change(&mut json);
    let mut text = serde_json::to_vec(&json).unwrap();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = |n: usize| u32::try_from(n).unwrap().to_le_bytes();
    let mut out =
        [&b"glTF"[..], &2u32.to_le_bytes(), &length(20 + text.len() + rest.len()), &length(text.len())].concat();
    out.extend(b"JSON");
    out.extend(text);
    out.extend(rest);
    out
}

/// The JSON of a GLB, and what follows its chunk.
fn parts(glb: &[u8]) -> (Value, &[u8]) {
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    (serde_json::from_slice(&glb[20..20 + length]).unwrap(), &glb[20 + length..])
}

fn refined(extension: &Value, recipe: &str) -> (Outcome, Value, Vec<String>) {
    let bytes = edited(&sample("textured").unwrap(), |json| {
        json["meshes"][0]["primitives"][0]["extensions"] = json!({ "ACME_bvh": extension });
        json["extensionsUsed"] = json!(["ACME_bvh"]);
    });
    let input = Input { models: vec![vec![File { path: "m.glb".to_owned(), bytes }]], ..Input::default() };
    let options = parse::options(&json!({
        "recipe": [{ "stage": recipe }], "pack": { "gutter": 0 }, "atlas": { "overlaps": "separate", "if_larger": "accept" },
    }))
    .unwrap();
    let outcome = refine(&input, &options, &Context::silent()).unwrap();
    let model = &outcome.artifacts.iter().find(|a| a.name == "model.glb").unwrap().bytes;
    let (json, _) = parts(model);
    let codes = outcome.report["warnings"].as_array().unwrap().iter();
    let codes = codes.filter_map(|w| w["code"].as_str().map(str::to_owned)).collect();
    (outcome, json, codes)
}

/// Fourteen of 45 scans carried a tree for ray casting in an extension of their primitives, and none of them was refined for it.
#[test]
fn an_extension_without_textures_does_not_stop_a_primitive() {
    let tree = json!({ "roots": [0], "heuristic": 2 });
    let (outcome, json, codes) = refined(&tree, "pack");
    assert_eq!(outcome.report["atlases"][0]["refined"], true, "{codes:?}");
    assert_eq!(json["meshes"][0]["primitives"][0]["extensions"]["ACME_bvh"], tree, "the triangles are the same");
    assert!(!codes.iter().any(|c| c.starts_with("primitive_extension") || c == "extension_dropped"), "{codes:?}");

    // Triangles that were divided are no longer those that it speaks of.
    let (_, json, codes) = refined(&tree, "bounded");
    assert!(codes.iter().any(|c| c == "extension_dropped"), "{codes:?}");
    assert!(json["meshes"][0]["primitives"][0].get("extensions").is_none());
    assert!(json.get("extensionsUsed").is_none_or(|used| !used.as_array().unwrap().contains(&json!("ACME_bvh"))));

    // What may read the layout holds it, and is named.
    let (outcome, _, codes) = refined(&json!({ "detailTexture": 0 }), "pack");
    assert_eq!(outcome.report["atlases"], json!([]));
    assert!(codes.iter().any(|c| c == "primitive_extension"), "{codes:?}");
    let warning = outcome.report["warnings"].as_array().unwrap().iter().find(|w| w["code"] == "primitive_extension");
    assert!(warning.unwrap()["message"].as_str().unwrap().contains("ACME_bvh"));
}
