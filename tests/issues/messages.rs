//! Messages that nobody could act on.

use std::fs;
use std::path::Path;
use std::process::Command;

use image::{DynamicImage, ImageFormat, RgbImage};
use intarsia::asset::File;
use intarsia::context::Context;
use intarsia::error::Code;
use intarsia::refine::{Input, parse, refine};
use serde_json::{Value, json};

fn png() -> Vec<u8> {
    let image = RgbImage::from_fn(64, 64, |x, y| image::Rgb([x, y, x ^ y].map(|v| v as u8 * 3)));
    let mut bytes = std::io::Cursor::new(Vec::new());
    DynamicImage::ImageRgb8(image).write_to(&mut bytes, ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// The warnings of squares side by side, each with these texture coordinates, in one material with a texture.
fn warnings(squares: &[[f64; 4]], options: Value) -> Vec<(String, String)> {
    let mut text = "mtllib m.mtl\nusemtl m\n".to_owned();
    for (i, [u, v, width, height]) in squares.iter().enumerate() {
        for (x, y) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            text += &format!("v {} {y} 0\nvt {} {}\n", 2.0 * i as f64 + x, u + x * width, v + y * height);
        }
        text += "f -4/-4 -3/-3 -2/-2 -1/-1\n";
    }
    let files = [("m.obj", text.into_bytes()), ("m.mtl", b"newmtl m\nmap_Kd a.png\n".to_vec()), ("a.png", png())];
    let files = files.map(|(path, bytes)| File { path: path.to_owned(), bytes });
    let input = Input { models: vec![files.to_vec()], ..Input::default() };
    let context = Context::silent();
    refine(&input, &parse::options(&options).unwrap(), &context).unwrap();
    context.warnings().into_iter().map(|w| (w.code, w.message)).collect()
}

fn message(of: &[(String, String)], code: &str) -> String {
    of.iter().find(|w| w.0 == code).unwrap_or_else(|| panic!("{code} is missing: {of:#?}")).1.clone()
}

fn problem(options: Value) -> String {
    parse::options(&options).unwrap_err().remove(0).message
}

/// For `gutter` the neighbour `box_cutter` was named, for `quality` others that are none.
#[test]
fn a_neighbour_is_named_only_if_it_is_one() {
    let gutter = problem(json!({"gutter": 2}));
    assert!(gutter.contains("`pack.gutter`") && !gutter.contains("box_cutter"), "{gutter}");
    let quality = problem(json!({"quality": 2}));
    assert!(quality.contains("`optcuts.quality`"), "{quality}");
    let listed = problem(json!({"resolution": 2}));
    assert!(!listed.contains("did you mean") && listed.contains("pack") && listed.contains("metadata"), "{listed}");
    let recipe = problem(json!({"recipe": "shrink"}));
    assert!(!recipe.contains("did you mean") && recipe.contains("scan_tight"), "{recipe}");
    let figure = problem(json!({"require": {"atlas.beauty": {"min": 1}}}));
    assert!(!figure.contains("did you mean") && figure.contains("packing_efficiency"), "{figure}");
    assert!(problem(json!({"recipe": "unwarp"})).contains("did you mean `unwrap`?"));
}

/// `99.7 % of the area of atlas 0 is not merged: charts that share texels` told neither what that means nor what to do.
#[test]
fn what_is_held_back_names_the_option_that_changes_it() {
    let told = message(&warnings(&[[0.1, 0.1, 0.3, 0.3]; 2], json!({"recipe": "defrag"})), "held_back");
    assert!(told.contains("100.0 % of the layout") && told.contains("atlas.overlaps to \"separate\""), "{told}");
}

/// Charts `spread over 9999999360571395151855616.0 sheets`.
#[test]
fn wild_coordinates_are_told_without_their_digits() {
    for size in [3.0, 1e3, 1e12] {
        let all = warnings(&[[0.0, 0.0, size, size], [0.25, 0.25, 0.5, 0.5]], json!({}));
        for (code, told) in &all {
            let digits = told.split(|c: char| !c.is_ascii_digit()).map(str::len).max().unwrap_or(0);
            assert!(digits < 9, "{size} {code}: {told}");
        }
    }
    let repeated = message(&warnings(&[[0.0, 0.0, 40.0, 40.0]], json!({})), "tiling_too_large");
    assert!(repeated.contains("1600.0 times as large") && repeated.contains("a material of its own"), "{repeated}");
}

/// What was not there was not said where it could be had from.
#[test]
fn nothing_to_refine_says_what_to_do() {
    let input = |bytes: &[u8]| {
        let files = vec![File { path: "m.obj".to_owned(), bytes: bytes.to_vec() }];
        let context = Context::silent();
        let input = Input { models: vec![files], ..Input::default() };
        refine(&input, &parse::options(&json!({})).unwrap(), &context).unwrap();
        context.warnings().into_iter().map(|w| (w.code, w.message)).collect::<Vec<_>>()
    };
    let told = message(&input(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "nothing_to_refine");
    assert!(told.contains("unwrap"), "{told}");
}

/// `no input is a model`, for a tile that holds one.
#[test]
fn a_file_that_is_not_read_is_told_what_it_is() {
    for (name, bytes, what) in [
        ("a.ply", &b"ply\nformat ascii 1.0\n"[..], "PLY: export it"),
        ("a.fbx", b"Kaydara FBX Binary  \0", "export it as .glb"),
    ] {
        let files = vec![File { path: name.to_owned(), bytes: bytes.to_vec() }];
        let input = Input { models: vec![files], ..Input::default() };
        let failure = refine(&input, &parse::options(&json!({})).unwrap(), &Context::silent()).unwrap_err();
        assert!(failure.code == Code::InvalidModel && failure.message.contains(what), "{failure}");
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(name), bytes).unwrap();
        let (code, told) = call(folder.path(), &["refine", name, "-o", "out.glb"]);
        assert!(code == Some(2) && told.contains(name) && told.contains(what), "{code:?} {told}");
    }
}

fn call(folder: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let done = Command::new(env!("CARGO_BIN_EXE_intarsia")).args(arguments).current_dir(folder).output().unwrap();
    (done.status.code(), String::from_utf8_lossy(&done.stderr).into_owned())
}

/// A folder that was not there was told of when all work had been done, and the result was lost.
#[test]
fn an_output_that_cannot_be_written_is_told_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    // Had the work begun, it would have failed for the model.
    fs::write(folder.path().join("broken.glb"), b"glTF").unwrap();
    fs::write(folder.path().join("file"), b"").unwrap();
    fs::create_dir(folder.path().join("folder.glb")).unwrap();
    let cases: [(&[&str], &str); 6] = [
        (&["-o", "gone/out.glb"], "gone/out.glb: the folder gone does not exist"),
        (&["-o", "folder.glb"], "it is a folder"),
        (&["-o", "out.glb", "--report", "gone/report.json"], "gone/report.json"),
        (&["-o", "out.glb", "--pictures", "file/pictures"], "file is a file"),
        (&["-o", "out.glb", "--pictures", "file"], "file is a file"),
        (&["-o", "out.obj"], "out.obj is no model"),
    ];
    for (arguments, what) in cases {
        let (code, told) = call(folder.path(), &[&["refine", "broken.glb"], arguments].concat());
        assert!(code == Some(2) && told.contains(what), "{arguments:?}: {code:?} {told}");
    }
    let (code, told) = call(folder.path(), &["refine", "broken.glb", "-o", "out.glb", "--pictures", "new/pictures"]);
    assert_eq!(code, Some(3), "{told}");
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 3, "{left:?}");
}
