//! What photogrammetry delivers, and what became of it.

use image::{DynamicImage, ImageFormat, RgbImage};
use intarsia::asset::File;
use intarsia::asset::sample::sample;
use intarsia::context::Context;
use intarsia::refine::{Input, Outcome, parse, refine};
use serde_json::{Value, json};

fn run(files: &[(&str, Vec<u8>)], options: Value) -> Outcome {
    let files = files.iter().map(|(path, bytes)| File { path: (*path).to_owned(), bytes: bytes.clone() }).collect();
    let input = Input { models: vec![files], ..Input::default() };
    let options = parse::options(&options).unwrap_or_else(|problems| panic!("{problems:#?}"));
    refine(&input, &options, &Context::silent()).unwrap_or_else(|failure| panic!("{failure}"))
}

fn codes(report: &Value) -> Vec<&str> {
    let codes = report["warnings"].as_array().unwrap().iter().map(|w| w["code"].as_str().unwrap());
    // Pictures of charts that were far apart have more in each texel.
    codes.filter(|code| *code != "heavier_texture").collect()
}

/// Two pairs of faces that overlapped by less than a thousandth of a texel, at a vertex of many charts, undid nine thousand good merges.
#[test]
fn a_scan_keeps_its_merges() {
    let report = run(&[("scan.glb", sample("scan_2000").unwrap())], json!({"recipe": "scan"})).report;
    assert_eq!((report["outcome"].as_str(), codes(&report)), (Some("refined"), vec![]));
    let charts = |when: &str| report["model"][when]["charts"].as_f64().unwrap();
    assert!(charts("after") < 0.1 * charts("before"), "{} of {}", charts("after"), charts("before"));
    // What lay on itself may do so still.
    let overlap = |when: &str| report["model"][when]["overlap_fraction"].as_f64().unwrap();
    assert!(overlap("after") <= overlap("before"), "{} after {}", overlap("after"), overlap("before"));
}

/// Five squares that fill their sheet but for one place become a cross when they are merged, and that needs a larger sheet.
#[test]
fn merging_does_not_make_a_sheet_larger_that_packing_alone_does_not() {
    let mut obj = "mtllib m.mtl\nusemtl m\n".to_owned();
    for (k, (x, y)) in [(1, 0), (0, 1), (1, 1), (2, 1), (1, 2)].into_iter().enumerate() {
        for (i, j) in [(0, 0), (1, 0), (1, 1), (0, 1)] {
            let (u, v) = (29 * (k % 3) + 2 + 24 * i, 30 * (k / 3) + 2 + 24 * j);
            obj += &format!("v {} {} 0\nvt {} {}\n", x + i, y + j, u as f64 / 88.0, v as f64 / 64.0);
        }
        obj += "f -4/-4 -3/-3 -2/-2 -1/-1\n";
    }
    let image = RgbImage::from_fn(88, 64, |x, y| image::Rgb([x * 2, y * 3, x ^ y].map(|v| v as u8)));
    let mut png = std::io::Cursor::new(Vec::new());
    DynamicImage::ImageRgb8(image).write_to(&mut png, ImageFormat::Png).unwrap();
    let library = b"newmtl m\nmap_Kd a.png\n".to_vec();
    let files = [("m.obj", obj.into_bytes()), ("m.mtl", library), ("a.png", png.into_inner())];
    let with =
        |size: Value| run(&files, json!({"recipe": "scan", "pack": {"gutter": 4}, "texture": {"size": size}})).report;
    let report = with(json!("keep_density"));
    assert_eq!(report["stages"][0]["stopped_by"], "packed_without_merging");
    assert_eq!(codes(&report), ["packed_without_merging"]);
    assert_eq!(report["model"]["after"]["charts"], 5);
    assert!(report["model"]["after"]["texture_pixels"].as_u64().unwrap() <= 88 * 64);
    // On a sheet of a given size they are merged.
    assert_eq!(with(json!("keep_size"))["model"]["after"]["charts"], 1);
}
