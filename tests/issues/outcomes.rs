//! What is said of a job that did less than it was asked to.

use std::fs;
use std::path::Path;
use std::process::Command;

use image::{DynamicImage, ImageFormat, RgbImage};
use intarsia::asset::File;
use intarsia::context::Context;
use intarsia::error::Code;
use intarsia::refine::{Input, Outcome, parse, refine};
use serde_json::{Value, json};

fn run(files: &[(&str, Vec<u8>)], options: Value) -> Outcome {
    let files = files.iter().map(|(path, bytes)| File { path: (*path).to_owned(), bytes: bytes.clone() }).collect();
    let input = Input { models: vec![files], extras: true, ..Input::default() };
    let options = parse::options(&options).unwrap_or_else(|problems| panic!("{problems:#?}"));
    refine(&input, &options, &Context::silent()).unwrap_or_else(|failure| panic!("{failure}"))
}

fn png(side: u32) -> Vec<u8> {
    let image = RgbImage::from_fn(side, side, |x, y| image::Rgb([x * 3 % 256, y * 5 % 256, x ^ y].map(|v| v as u8)));
    let mut bytes = std::io::Cursor::new(Vec::new());
    DynamicImage::ImageRgb8(image).write_to(&mut bytes, ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// Two squares, each with a material of its own: one that covers all of its sheet, and one on a corner of its own.
fn squares() -> Vec<u8> {
    let mut text = "mtllib m.mtl\n".to_owned();
    for (name, z, side) in [("full", 0, 1.0), ("small", 1, 0.25)] {
        text += &format!("usemtl {name}\n");
        for (x, y) in [(0, 0), (1, 0), (1, 1), (0, 1)] {
            text += &format!("v {x} {y} {z}\nvt {} {}\n", f64::from(x) * side, f64::from(y) * side);
        }
        text += "f -4/-4 -3/-3 -2/-2 -1/-1\n";
    }
    text.into_bytes()
}

fn materials(full: &str, small: &str) -> Vec<u8> {
    format!("newmtl full\nmap_Kd {full}\nnewmtl small\nmap_Kd {small}\n").into_bytes()
}

/// What became of the job, and of each atlas.
fn words<'a>(report: &'a Value) -> (&'a str, Vec<&'a str>) {
    let word = |value: &'a Value| value["outcome"].as_str().unwrap_or("none");
    let atlases = report["atlases"].as_array().unwrap().iter();
    (word(report), atlases.map(word).collect())
}

/// `stopped_by: no_improvement` stood both for a search that found nothing better and for a result that was thrown away, and nothing said
/// which atlases were as they had been.
#[test]
fn one_word_says_what_became_of_a_job_and_of_each_atlas() {
    let both = [("m.obj", squares()), ("m.mtl", materials("a.png", "b.png")), ("a.png", png(64)), ("b.png", png(32))];
    let outcome = run(&both, json!({}));
    assert_eq!(words(&outcome.report), ("partly_refined", vec!["kept_input", "refined"]));
    let reasons: Vec<&str> =
        outcome.report["stages"].as_array().unwrap().iter().map(|s| s["stopped_by"].as_str().unwrap()).collect();
    assert_eq!(reasons, ["not_smaller", "done"]);
    let taken = run(&both, json!({"atlas": {"if_larger": "accept"}}));
    assert_eq!(words(&taken.report), ("refined", vec!["refined", "refined"]));
    let alone = [("m.obj", squares()), ("m.mtl", materials("a.png", "a.png")), ("a.png", png(64))];
    assert_eq!(words(&run(&alone, json!({})).report), ("kept_input", vec!["kept_input"]));
}

/// A model whose images had gone missing came back as it was, and its job had succeeded.
#[test]
fn an_image_that_is_missing_fails_the_gate_and_the_result_is_there() {
    let half = [("m.obj", squares()), ("m.mtl", materials("gone.png", "b.png")), ("b.png", png(32))];
    let outcome = run(&half, json!({}));
    assert_eq!(words(&outcome.report), ("partly_refined", vec!["refined"]), "the other square is left");
    assert_eq!(outcome.verdict.failure(), None);
    let gated = run(&half, json!({"recipe": "gate"}));
    let failure = gated.verdict.failure().unwrap();
    assert_eq!((failure.code, failure.pointer.as_deref()), (Code::StrictWarning, Some("/strict")));
    assert!(failure.message.contains("missing_image"), "{failure}");
    assert!(gated.artifacts.iter().any(|a| a.role == "model"));
    // What users say goes on top of the preset.
    assert_eq!(run(&half, json!({"recipe": "gate", "strict": ["unused_file"]})).verdict.failure(), None);

    let unreadable = [("m.obj", squares()), ("m.mtl", materials("b.png", "b.png")), ("b.png", b"no image".to_vec())];
    let gated = run(&unreadable, json!({"recipe": "gate"}));
    assert_eq!(words(&gated.report), ("nothing_to_refine", vec![]));
    let message = gated.verdict.failure().unwrap().message;
    assert!(message.contains("invalid_image") && message.contains("nothing_to_refine"), "{message}");

    let bare = [("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".to_vec())];
    let gated = run(&bare, json!({"recipe": "gate"}));
    assert_eq!(words(&gated.report), ("nothing_to_refine", vec!["nothing_to_refine"]));
    assert_eq!(gated.verdict.strict.keys().collect::<Vec<_>>(), ["nothing_to_refine"]);
}

#[test]
fn a_code_that_no_warning_has_is_named() {
    let wrong = |strict: Value| parse::options(&json!({ "strict": strict })).unwrap_err().remove(0);
    let near = wrong(json!(["invalid_image", "mising_image"]));
    assert_eq!(near.pointer, "/strict/1");
    assert!(near.message.contains("did you mean `missing_image`?"), "{near:?}");
    assert!(wrong(json!(["x"])).message.contains("nothing_to_refine"), "all are listed");
    assert_eq!(wrong(json!("missing_image")).pointer, "/strict");
}

#[test]
fn the_command_line_ends_with_4_and_writes_the_result() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("m.obj"), squares()).unwrap();
    fs::write(at("m.mtl"), materials("gone.png", "b.png")).unwrap();
    fs::write(at("b.png"), png(32)).unwrap();
    let call = |folder: &Path, arguments: &[&str]| {
        let done = Command::new(env!("CARGO_BIN_EXE_intarsia")).args(arguments).current_dir(folder).output().unwrap();
        (done.status.code(), String::from_utf8_lossy(&done.stderr).into_owned())
    };
    let (code, told) = call(folder.path(), &["refine", "m.obj", "-o", "out.glb", "--recipe", "gate"]);
    assert_eq!(code, Some(4), "{told}");
    assert!(at("out.glb").exists());
    assert!(told.contains("outcome: partly_refined") && told.contains("error: strict_warning"), "{told}");
    let (code, told) = call(folder.path(), &["inspect", "m.obj", "--recipe", "gate"]);
    assert_eq!(code, Some(4), "{told}");
}
