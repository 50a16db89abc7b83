//! What scripts hold on to: the command line's exit codes, its streams, its files.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use intarsia::asset::{Document, File, Limits, load, raw_elements, read_indices, read_vec2};
use serde_json::{Value, json};

fn intarsia(folder: &Path, arguments: &[&str]) -> (i32, String, String) {
    let program = Command::new(env!("CARGO_BIN_EXE_intarsia")).args(arguments).current_dir(folder).output().unwrap();
    let Output { status, stdout, stderr } = program;
    (status.code().unwrap(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A folder with the sample in it.
fn with_sample() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let (code, _, errors) = intarsia(folder.path(), &["sample", "textured", "-o", "in.glb"]);
    assert_eq!(code, 0, "{errors}");
    folder
}

#[test]
fn a_model_is_refined_from_file_to_file() {
    let folder = with_sample();
    let at = |name: &str| folder.path().join(name);
    let all = ["refine", "in.glb", "-o", "out.glb", "--report", "report.json", "--pictures", "pictures", "--json"];
    let (code, out, errors) = intarsia(folder.path(), &all);
    assert_eq!(code, 0, "{errors}");
    assert!(fs::read(at("out.glb")).unwrap().starts_with(b"glTF"));
    let report: Value = serde_json::from_slice(&fs::read(at("report.json")).unwrap()).unwrap();
    assert_eq!(report, serde_json::from_str::<Value>(&out).unwrap(), "--json is the report, and nothing else");
    assert!(fs::read_dir(at("pictures")).unwrap().count() > 0, "pictures are written");
    assert!(errors.lines().any(|l| l.starts_with("[1/")), "progress in lines: {errors}");
    let (_, out, errors) = intarsia(folder.path(), &["refine", "in.glb", "-o", "again.glb", "-q"]);
    assert!(out.is_empty() && !errors.contains("wrote"), "{out}{errors}");
    assert_eq!(fs::read(at("out.glb")).unwrap(), fs::read(at("again.glb")).unwrap());
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(!left.iter().any(|n| n.to_string_lossy().contains("tmp")), "{left:?}");
}

#[test]
fn another_seed_is_another_layout_and_the_same_seed_the_same() {
    let folder = with_sample();
    let refined = |seed: &str| {
        let set = format!("seed={seed}");
        let (code, _, errors) = intarsia(folder.path(), &["refine", "in.glb", "-o", "out.glb", "-q", "--set", &set]);
        assert_eq!(code, 0, "{errors}");
        fs::read(folder.path().join("out.glb")).unwrap()
    };
    let [zero, one, two] = ["0", "1", "2"].map(refined);
    assert!(zero != one && one != two && two != zero);
    assert_eq!(one, refined("1"));
}

#[test]
fn several_models_come_out_as_several() {
    let folder = with_sample();
    let at = |name: &str| folder.path().join(name);
    let (code, _, errors) = intarsia(folder.path(), &["sample", "two_materials", "-o", "other.glb"]);
    assert_eq!(code, 0, "{errors}");
    let panels = "fabrication.seams=allowance";
    let all = ["refine", "in.glb", "other.glb", "-o", "out.gltf", "--report", "report.json", "--set", panels];
    let (code, _, errors) = intarsia(folder.path(), &all);
    assert_eq!(code, 0, "{errors}");
    let texture = fs::read(at("atlas-0.page-0.base_color.png")).unwrap();
    assert!(texture.starts_with(b"\x89PNG"));
    for model in ["out-0.gltf", "out-1.gltf"] {
        let json: Value = serde_json::from_slice(&fs::read(at(model)).unwrap()).unwrap();
        let buffer = json["buffers"][0]["uri"].as_str().unwrap();
        assert!(at(buffer).exists(), "{buffer}");
        let uris: Vec<&str> = json["images"].as_array().unwrap().iter().filter_map(|i| i["uri"].as_str()).collect();
        assert!(uris.contains(&"atlas-0.page-0.base_color.png"), "{uris:?}");
        assert!(uris.iter().all(|u| at(u).exists()));
        let (code, _, errors) = intarsia(folder.path(), &["inspect", model]);
        assert_eq!(code, 0, "{errors}");
    }
    assert!(fs::read_to_string(at("out.panels-0.svg")).unwrap().contains("class=\"allowance\""));
    // The picture is found by its path; every model is measured as it is.
    let picture = "importance.texture=atlas-0.page-0.base_color.png";
    let (code, out, errors) = intarsia(folder.path(), &["inspect", "in.glb", "other.glb", "--json", "--set", picture]);
    assert_eq!(code, 0, "{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    let mut atlases = report["atlases"].as_array().unwrap().clone();
    // One of the primitives has no texture coordinates.
    atlases.retain(|a| a["refined"] == true);
    assert!(atlases.len() > 1 && atlases.iter().all(|a| a["importance"].is_array()), "{out}");
}

/// The UVs at the corners of all triangles of a primitive, as bits.
fn corners(doc: &Document, primitive: &Value, set: &str) -> Vec<[u32; 2]> {
    let index = |value: &Value| value.as_u64().unwrap() as usize;
    let uvs = read_vec2(doc, index(&primitive["attributes"][set])).unwrap();
    let indices = read_indices(doc, index(&primitive["indices"])).unwrap();
    indices.iter().map(|i| uvs[*i as usize].map(f32::to_bits)).collect()
}

#[test]
fn unwrapping_a_textured_model_leaves_its_textures_alone() {
    let folder = with_sample();
    let run = |arguments: &[&str]| {
        let (code, _, errors) = intarsia(folder.path(), arguments);
        assert_eq!(code, 0, "{errors}");
    };
    let json = |name: &str| -> Value { serde_json::from_slice(&fs::read(folder.path().join(name)).unwrap()).unwrap() };
    let fast = ["--recipe", "unwrap", "--set", "optcuts.quality=fast", "-q"];
    run(&[&["refine", "in.glb", "-o", "out.glb", "--report", "report.json"][..], &fast].concat());
    let opened = |name: &str| {
        let file = File { path: name.to_owned(), bytes: fs::read(folder.path().join(name)).unwrap() };
        load(&[file], None, &Limits::default()).unwrap().0
    };
    let (before, after) = (opened("in.glb"), opened("out.glb"));
    for key in ["materials", "textures", "samplers"] {
        assert_eq!(after.json[key], before.json[key]);
    }
    assert_eq!(after.images, before.images);
    let [old, new] = [&before, &after].map(|doc| doc.json["meshes"][0]["primitives"][0].clone());
    // The uploaded coordinates are the same bytes, those of vertices that are doubled at seams behind them.
    let bytes = |doc: &Document, primitive: &Value| {
        raw_elements(doc, primitive["attributes"]["TEXCOORD_0"].as_u64().unwrap() as usize).unwrap().data
    };
    assert!(bytes(&after, &new).starts_with(&bytes(&before, &old)));
    assert_eq!(corners(&after, &new, "TEXCOORD_0"), corners(&before, &old, "TEXCOORD_0"));
    assert_ne!(corners(&after, &new, "TEXCOORD_1"), corners(&after, &new, "TEXCOORD_0"));
    let report = json("report.json");
    assert_eq!((&report["atlases"][0]["uv_sets"], &report["textures"]), (&json!([1]), &json!([])));

    // Read back, it is a layout without an overlap.
    let (code, out, errors) = intarsia(folder.path(), &["inspect", "out.glb", "--json", "--set", "atlas.uv_set=1"]);
    assert_eq!(code, 0, "{errors}");
    let read: Value = serde_json::from_str(&out).unwrap();
    let measures = &read["atlases"][0]["after"];
    assert_eq!(measures["charts"], report["atlases"][0]["after"]["charts"]);
    assert!(measures["overlap_fraction"].as_f64() < Some(1e-6) && measures["flipped_triangles"] == 0, "{measures}");

    // Asked for by its number, the uploaded set is replaced, and its textures are drawn anew.
    run(&[&["refine", "in.glb", "-o", "in_place.glb", "--set", "atlas.uv_set=0"][..], &fast].concat());
    let in_place = opened("in_place.glb");
    assert!(in_place.json["meshes"][0]["primitives"][0]["attributes"].get("TEXCOORD_1").is_none());
    assert_ne!(in_place.images, before.images);
}

#[test]
fn exit_codes_tell_whose_fault_it_is() {
    let folder = with_sample();
    fs::write(folder.path().join("broken.glb"), b"glTF").unwrap();
    fs::write(folder.path().join("options.json"), b"{\"pack\": {\"grid\": 0}}").unwrap();
    for (arguments, wanted, part) in [
        (&["refine", "in.glb"][..], 2, "--output"),
        (&["refine", "in.glb", "-o", "out.png"], 2, ".glb"),
        (&["refine", "in.glb", "-o", "nowhere/out.glb"], 2, "folder"),
        (&["refine", "in.glb", "-o", "out.glb", "--set", "pack.guter=1"], 2, "did you mean `gutter`?"),
        (&["refine", "in.glb", "-o", "out.glb", "--recipe", "pak"], 2, "did you mean `pack`?"),
        (&["refine", "in.glb", "-o", "out.glb", "--set", "atlas.uv_set=9"], 2, "outside 0..=7"),
        (
            &["refine", "in.glb", "-o", "out.glb", "--recipe", "unwrap", "--set", "atlas.merge=true"],
            2,
            "no image changes",
        ),
        (&["refine", "in.glb", "-o", "out.glb", "--options", "options.json"], 2, "/pack/grid"),
        (&["refine", "none.glb", "-o", "out.glb"], 3, "none.glb"),
        (&["refine", "broken.glb", "-o", "out.glb"], 3, "invalid_model"),
        (&["inspect", "broken.glb"], 3, "invalid_model"),
        (&["inspect", "in.glb", "--require", "atlas.packing_efficiency>=1.5"], 4, "packing_efficiency"),
        (&["inspect", "in.glb", "--require", "atlas.packing_eficiency>=0.5"], 2, "did you mean"),
        (&["inspect", "in.glb", "--require", "atlas.packing_efficiency<=1.5"], 0, ""),
        (&["sample", "texture", "-o", "x.glb"], 2, "did you mean `textured`?"),
    ] {
        let (code, _, errors) = intarsia(folder.path(), arguments);
        assert_eq!(code, wanted, "{arguments:?}: {errors}");
        assert!(errors.contains(part), "{arguments:?}: `{part}` is not in {errors}");
    }
    assert!(!folder.path().join("out.glb").exists(), "nothing is written on failure");
}

#[test]
fn a_missed_requirement_is_told_and_the_output_is_written_all_the_same() {
    let folder = with_sample();
    let gate = "require.atlas.packing_efficiency.min=0.9999";
    let (code, _, errors) = intarsia(folder.path(), &["refine", "in.glb", "-o", "out.glb", "--set", gate]);
    assert_eq!(code, 4, "{errors}");
    assert!(errors.contains("not met: atlas.packing_efficiency"), "{errors}");
    assert!(folder.path().join("out.glb").exists());
}

#[test]
fn figures_are_shown_for_people_and_for_programs() {
    let folder = with_sample();
    let (code, table, errors) = intarsia(folder.path(), &["inspect", "in.glb"]);
    assert_eq!(code, 0, "{errors}");
    assert!(table.contains("packing_efficiency") && table.contains("model"), "{table}");
    let (_, json, _) = intarsia(folder.path(), &["inspect", "in.glb", "--json"]);
    let report: Value = serde_json::from_str(&json).unwrap();
    assert!(report["atlases"][0]["before"]["packing_efficiency"].as_f64().is_some());
}

#[test]
fn the_contract_on_file_is_what_is_printed() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("api/openapi.json");
    let (code, text, _) = intarsia(Path::new("."), &["openapi"]);
    assert_eq!(code, 0);
    if std::env::var_os("INTARSIA_BLESS").is_some() {
        fs::write(&path, &text).unwrap();
    }
    let on_file = fs::read_to_string(&path).unwrap_or_default();
    assert!(on_file == text, "api/openapi.json is out of date; INTARSIA_BLESS=1 cargo test writes it anew");
}

#[test]
fn every_recipe_is_named_in_the_help_and_in_the_readme() {
    let readme = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md")).unwrap();
    let (code, help, _) = intarsia(Path::new("."), &["refine", "--help"]);
    assert_eq!(code, 0);
    for (name, description) in intarsia::refine::recipe::recipes() {
        assert!(help.contains(&format!("  {name} ")) && help.contains(description), "{name} is not in {help}");
        assert!(readme.contains(&format!("| `{name}` |")), "{name} is not in the table of recipes");
    }
}

#[test]
fn an_address_of_the_queue_is_never_repeated() {
    let folder = tempfile::tempdir().unwrap();
    let secret = "hunter2";
    for (address, says) in [
        (format!("mysql://me:{secret}@127.0.0.1/x"), "neither `sqlite` nor `postgres://"),
        (format!("postgres://me:{secret}@127.0.0.1:1/x"), "cannot be reached"),
        (format!("postgres://me:{secret}@127.0.0.1:port/x"), "no URL of PostgreSQL"),
    ] {
        let flags: [&[&str]; 3] = [
            &["serve", "--listen", "127.0.0.1:0", "--queue", &address],
            &["keys", "list", "--queue", &address],
            &["serve", "--log-level", "trace", "--listen", "127.0.0.1:0", "--queue", &address],
        ];
        for flags in flags {
            let (code, out, errors) = intarsia(folder.path(), flags);
            assert!(code != 0 && errors.contains(says), "{errors}");
            assert!(!out.contains(secret) && !errors.contains(secret), "{out}{errors}");
        }
    }
    for command in ["serve", "keys"] {
        let mut program = Command::new(env!("CARGO_BIN_EXE_intarsia"));
        let help = program
            .args([command, "--help"])
            .env("INTARSIA_QUEUE", format!("postgres://me:{secret}@x/y"))
            .output()
            .unwrap();
        let help = String::from_utf8(help.stdout).unwrap();
        assert!(help.contains("INTARSIA_QUEUE") && !help.contains(secret), "{help}");
    }
    let (code, _, errors) = intarsia(folder.path(), &["serve", "--listen", "127.0.0.1:0", "--store", "ftp://x"]);
    assert!(code == 2 && errors.contains("s3://BUCKET/PREFIX"), "{code}: {errors}");
}
