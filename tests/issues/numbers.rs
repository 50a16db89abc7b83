//! Numbers that are none, and numbers that are too large to be told apart.

use intarsia::asset::{ARRAY_BUFFER, Document, File, Limits, RawAccessor, load, read_indices, read_vec2, read_vec3};
use intarsia::context::Context;
use intarsia::refine::{Input, Outcome, parse, refine};
use serde_json::{Value, json};

/// A strip of squares, each a chart, under a picture: positions are those of the corners, `side` long.
fn strip(squares: u32, side: f64) -> Document {
    let mut text = "mtllib a.mtl\nusemtl a\n".to_owned();
    for i in 0..=squares {
        let x = f64::from(i) * side;
        text += &format!("v {x} 0 0\nv {x} {side} 0\n");
    }
    for i in 0..squares {
        let (u, v) = (0.11 * f64::from(i % 8), 0.3 * f64::from(i % 3));
        for (x, y) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            text += &format!("vt {} {}\n", u + x * 0.09, v + y * 0.09);
        }
        let (p, t) = (2 * i + 1, 4 * i + 1);
        text += &format!("f {p}/{t} {}/{} {}/{} {}/{}\n", p + 2, t + 1, p + 3, t + 2, p + 1, t + 3);
    }
    let mut picture = image::RgbImage::new(256, 256);
    picture.enumerate_pixels_mut().for_each(|(x, y, p)| *p = image::Rgb([(x * 7) as u8, (y * 5) as u8, (x * y) as u8]));
    let mut png = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut png, image::ImageFormat::Png).unwrap();
    let file = |path: &str, bytes: &[u8]| File { path: path.to_owned(), bytes: bytes.to_vec() };
    let mtl = b"newmtl a\nmap_Kd t.png\n";
    let files = [file("m.obj", text.as_bytes()), file("a.mtl", mtl), file("t.png", png.get_ref())];
    load(&files, None, &Limits::default()).unwrap().0
}

fn attribute(doc: &Document, mesh: usize, name: &str) -> usize {
    doc.json["meshes"][mesh]["primitives"][0]["attributes"][name].as_u64().unwrap() as usize
}

fn set<const N: usize>(doc: &mut Document, name: &str, values: &[[f32; N]]) {
    let accessor = doc.append_accessor(&RawAccessor::from_floats(values), Some(ARRAY_BUFFER), name == "POSITION");
    doc.json["meshes"][0]["primitives"][0]["attributes"][name] = json!(accessor);
}

fn triangles(doc: &Document) -> Vec<[u32; 3]> {
    let indices = doc.json["meshes"][0]["primitives"][0]["indices"].as_u64().unwrap() as usize;
    read_indices(doc, indices).unwrap().as_chunks::<3>().0.to_vec()
}

fn refined(doc: &Document, options: Value) -> (Outcome, Document) {
    let model = File { path: "m.glb".to_owned(), bytes: doc.to_glb().unwrap() };
    let input = Input { models: vec![vec![model]], ..Input::default() };
    let outcome = refine(&input, &parse::options(&options).unwrap(), &Context::silent());
    let outcome = outcome.unwrap_or_else(|failure| panic!("{failure}"));
    let model = outcome.artifacts.iter().find(|a| a.role == "model").unwrap();
    let file = File { path: "m.glb".to_owned(), bytes: model.bytes.clone() };
    let doc = load(&[file], None, &Limits::default()).unwrap().0;
    (outcome, doc)
}

fn warnings(outcome: &Outcome) -> Vec<&Value> {
    outcome.report["warnings"].as_array().unwrap().iter().collect()
}

/// One NaN kept whole models from being refined.
#[test]
fn numbers_that_are_not_finite_hold_back_their_triangles_alone() {
    for (name, recipe) in [("TEXCOORD_0", "pack"), ("POSITION", "pack"), ("TEXCOORD_0", "bounded")] {
        let mut doc = strip(12, 1.0);
        let uploaded = triangles(&doc);
        let victim = uploaded[5][1];
        let mut positions = read_vec3(&doc, attribute(&doc, 0, "POSITION")).unwrap();
        let mut uvs = read_vec2(&doc, attribute(&doc, 0, "TEXCOORD_0")).unwrap();
        match name {
            "POSITION" => positions[victim as usize][2] = f32::NAN,
            _ => uvs[victim as usize] = [f32::NAN, f32::INFINITY],
        }
        set(&mut doc, "POSITION", &positions);
        set(&mut doc, "TEXCOORD_0", &uvs);
        let held: Vec<usize> = (0..uploaded.len()).filter(|t| uploaded[*t].contains(&victim)).collect();

        let options = json!({ "recipe": recipe, "pack": { "gutter": 2 }, "atlas": { "if_larger": "accept" } });
        let (outcome, written) = refined(&doc, options);
        let told = warnings(&outcome);
        let told = told.iter().find(|w| w["code"] == "non_finite_triangles").expect("a warning");
        assert_eq!(told["pointer"], "/meshes/0/primitives/0");
        let numbers: Vec<String> = held.iter().map(usize::to_string).collect();
        assert!(told["message"].as_str().unwrap().contains(&numbers.join(", ")), "{told}");
        let atlas = &outcome.report["atlases"][0];
        assert_eq!(atlas["refined"], true, "{}", outcome.report["warnings"]);
        let [before, after] = ["before", "after"].map(|when| atlas[when]["packing_efficiency"].as_f64().unwrap());
        assert!(after > before, "{recipe}: {before} became {after}");

        // They stand where they stood, with the vertices that they had.
        let all = triangles(&written);
        assert!(all.len() >= uploaded.len());
        assert!(held.iter().all(|t| all.contains(&uploaded[*t])), "{recipe}: {held:?} of {all:?}");
        if recipe == "pack" {
            assert!(held.iter().all(|t| all[*t] == uploaded[*t]) && all.len() == uploaded.len());
        }
        let uvs = read_vec2(&written, attribute(&written, 0, "TEXCOORD_0")).unwrap();
        assert!(uvs.iter().flatten().all(|x| x.is_finite()), "what is written is a number");
        let positions = read_vec3(&written, attribute(&written, 0, "POSITION")).unwrap();
        assert_eq!(positions[victim as usize][2].is_nan(), name == "POSITION", "a place is not made up");
    }
}

/// A model whose triangles are all none is left as it is, and said to be so.
#[test]
fn a_model_of_nothing_finite_passes_through() {
    let mut doc = strip(2, 1.0);
    let count = read_vec2(&doc, attribute(&doc, 0, "TEXCOORD_0")).unwrap().len();
    set(&mut doc, "TEXCOORD_0", &vec![[f32::NAN; 2]; count]);
    let (outcome, _) = refined(&doc, json!({ "recipe": "pack" }));
    assert!(warnings(&outcome).iter().any(|w| w["code"] == "non_finite_triangles"));
    assert_eq!(outcome.report["atlases"], json!([]));
}

/// Figures that a place far away may not change.
const FIGURES: [&str; 8] = [
    "packing_efficiency",
    "boundary_length",
    "seam_length",
    "seam_length_diagonal",
    "symmetric_dirichlet",
    "smallest_chart",
    "charts",
    "triangles",
];

/// The same model near the origin and five million units away, where 32 bits hold halves: what is measured and where charts are placed follows from the
/// shape alone, and cuts that would need points between those that 32 bits hold run along edges.
#[test]
fn far_from_the_origin_nothing_is_different() {
    for recipe in ["pack", "defrag", "box_cutter", "bounded"] {
        let options = json!({ "recipe": recipe, "atlas": { "if_larger": "accept", "overlaps": "separate" } });
        let near = strip(12, 64.0);
        let mut far = near.clone();
        let moved: Vec<[f32; 3]> = read_vec3(&near, attribute(&near, 0, "POSITION"))
            .unwrap()
            .into_iter()
            .map(|[x, y, z]| [x + 400_000.0, y + 5_500_000.0, z + 120.0])
            .collect();
        set(&mut far, "POSITION", &moved);
        let ((near, a), (far, b)) = (refined(&near, options.clone()), refined(&far, options));
        for when in ["before", "after"] {
            for figure in FIGURES {
                let of = |o: &Outcome| o.report["atlases"][0][when][figure].as_f64();
                let (near, far) = (of(&near), of(&far));
                let same = near.zip(far).map_or(near == far, |(n, f)| (n - f).abs() <= 1e-6 * n.abs());
                assert!(same, "{recipe} {when} {figure}: {near:?} and {far:?}");
            }
            let density = |o: &Outcome| o.report["atlases"][0][when]["texel_density"]["median"].as_f64().unwrap();
            let (near, far) = (density(&near), density(&far));
            assert!((near - far).abs() <= 1e-6 * near, "{recipe} {when}: {near} and {far}");
        }
        let uvs = |doc: &Document| read_vec2(doc, attribute(doc, 0, "TEXCOORD_0")).unwrap();
        println!("{recipe}: {} {}", uvs(&a).len(), uvs(&b).len());
    }
}

/// Two nodes far from each other were drawn at once in the space of one of them, where 32 bits do not hold the other's shape.
#[test]
fn what_lies_far_apart_is_not_drawn_at_once() {
    for (away, meshes) in [(500.0, 1), (6_000_000.0, 2)] {
        let mut doc = strip(4, 0.25);
        let copy = doc.json["meshes"][0].clone();
        doc.json["meshes"].as_array_mut().unwrap().push(copy);
        doc.json["nodes"] = json!([{ "mesh": 0 }, { "mesh": 1, "translation": [away, 0.0, 0.0] }]);
        doc.json["scenes"] = json!([{ "nodes": [0, 1] }]);
        let options = json!({ "recipe": "pack", "atlas": { "merge": true, "if_larger": "accept" } });
        let (outcome, written) = refined(&doc, options);
        assert_eq!(outcome.report["atlases"][0]["refined"], true, "{}", outcome.report["warnings"]);
        assert_eq!(written.json["meshes"].as_array().unwrap().len(), meshes, "{away}");
        for mesh in 0..meshes {
            let positions = read_vec3(&written, attribute(&written, mesh, "POSITION")).unwrap();
            let [low, high] = [f32::min, f32::max].map(|f| positions.iter().map(|p| p[0]).reduce(f).unwrap());
            assert!(meshes == 1 || (low, high) == (0.0, 1.0), "{low} to {high}");
        }
    }
}
