//! Layouts that were refused, and surfaces without one.

use intarsia::asset::{File, read_paths};
use intarsia::context::Context;
use intarsia::refine::optcuts::params::OptCuts;
use intarsia::refine::options::Options;
use intarsia::refine::{Input, Outcome, refine};
use serde_json::Value;

fn packed(files: Vec<File>) -> Outcome {
    let input = Input { models: vec![files], extras: true, ..Input::default() };
    refine(&input, &Options::default(), &Context::silent()).unwrap_or_else(|failure| panic!("{failure}"))
}

fn obj(text: &str) -> Vec<File> {
    vec![File { path: "m.obj".to_owned(), bytes: text.as_bytes().to_vec() }]
}

fn codes(report: &Value) -> Vec<&str> {
    report["warnings"].as_array().unwrap().iter().filter_map(|w| w["code"].as_str()).collect()
}

/// Four squares of a strip, far apart in the layout; `unit` UVs for each of its units.
fn strip(unit: f64) -> String {
    let mut text = String::new();
    for i in 0..5 {
        text += &format!("v {i} 0 0\nv {i} 1 0\n");
    }
    for i in 0..4 {
        let (u, v) = (f64::from(3 * i) * unit, f64::from(i % 2) * 2.0 * unit);
        for (x, y) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            text += &format!("vt {} {}\n", u + x * unit, v + y * unit);
        }
        let (p, t) = (2 * i + 1, 4 * i + 1);
        text += &format!("f {p}/{t} {}/{} {}/{} {}/{}\n", p + 2, t + 1, p + 3, t + 2, p + 1, t + 3);
    }
    text
}

/// UVs in millimetres, without an image, were refused as tiling: no image says what their unit is.
#[test]
fn a_layout_without_images_has_any_unit() {
    for unit in [0.05, 308.6, 1e6, 1e-4] {
        let outcome = packed(obj(&strip(unit)));
        assert_eq!(codes(&outcome.report), Vec::<&str>::new(), "{unit}");
        let atlas = &outcome.report["atlases"][0];
        let [before, after] =
            ["before", "after"].map(|when| atlas[when]["packing_efficiency"].as_f64().expect("a figure"));
        assert!(before < 0.2 && after > 0.85, "{unit}: {before} became {after}");
        assert_eq!((&atlas["refined"], &atlas["after"]["charts"]), (&Value::Bool(true), &Value::from(4)));
    }
}

#[test]
fn the_reported_layout_in_millimetres_is_packed() {
    let Some(path) = crate::reported("07-layout-in-other-units/bare.obj") else { return };
    let outcome = packed(read_paths(&[path]).unwrap());
    assert!(codes(&outcome.report).iter().all(|c| !c.contains("tiling")), "{}", outcome.report["warnings"]);
    let atlas = &outcome.report["atlases"][0];
    assert_eq!(atlas["refined"], true);
    assert!(atlas["after"]["packing_efficiency"].as_f64() > atlas["before"]["packing_efficiency"].as_f64());
}

/// A surface without texture coordinates stands in the report, and nothing else speaks of it.
#[test]
fn surfaces_without_a_layout_stand_in_the_report_alone() {
    let bare = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n";
    let outcome = packed(obj(bare));
    assert_eq!(codes(&outcome.report), ["nothing_to_refine"]);
    let atlas = &outcome.report["atlases"][0];
    assert_eq!((&atlas["refined"], &atlas["id"]), (&Value::Bool(false), &Value::from(0)));
    assert_eq!(atlas["before"]["triangles"], 2);
    assert!(atlas["before"]["packing_efficiency"].is_null());
    assert_eq!(atlas["before"]["undefined"]["texel_density.min"], "the surface has no layout");
    assert_eq!(outcome.report["model"]["before"]["triangles"], 0, "the model's figures are those of its layouts");
    assert!(outcome.artifacts.iter().all(|a| a.role != "picture"));

    // Beside a layout it comes last, whatever the order of the file, and is left out of what is required.
    let both = format!("{}g b\nusemtl other\nf 1 2 3\n", strip(0.05));
    let mut options = Options::default();
    let wanted = serde_json::from_value(serde_json::json!({ "min": 0.3 })).unwrap();
    options.require.insert("atlas.packing_efficiency".to_owned(), wanted);
    let input = Input { models: vec![obj(bare), obj(&both)], ..Input::default() };
    let outcome = refine(&input, &options, &Context::silent()).unwrap();
    let atlases = outcome.report["atlases"].as_array().unwrap();
    let refined: Vec<bool> = atlases.iter().map(|a| a["refined"] == true).collect();
    assert_eq!(refined, [true, false, false], "{atlases:#?}");
    assert!(atlases.iter().enumerate().all(|(i, a)| a["id"].as_u64() == Some(i as u64)));
    assert_eq!(outcome.verdict, Default::default());
}

/// A ramp of a turn and a half lies on itself once it is flat. Whoever allowed that got the surface back without a layout.
#[test]
fn a_layout_that_may_overlap_itself_is_delivered() {
    let mut ramp = String::new();
    let steps = 48;
    for i in 0..=steps {
        let turn = 3.0 * std::f64::consts::PI * f64::from(i) / f64::from(steps);
        for radius in [1.0, 1.5, 2.0] {
            ramp += &format!("v {} {} {}\n", radius * turn.cos(), radius * turn.sin(), 0.05 * turn);
        }
    }
    for i in 0..steps {
        for k in 1..3 {
            let v = 3 * i + k;
            ramp += &format!("f {v} {} {} {}\n", v + 1, v + 4, v + 3);
        }
    }
    let unwrapped = |bijective: bool| {
        let mut options = Options::preset("unwrap");
        let own = options.stages.get::<OptCuts>();
        options.stages.set(OptCuts { bijective, ..own });
        let input = Input { models: vec![obj(&ramp)], ..Input::default() };
        refine(&input, &options, &Context::silent()).unwrap_or_else(|failure| panic!("{failure}"))
    };
    let figure = |outcome: &Outcome, key: &str| outcome.report["model"]["after"][key].as_f64().expect("a figure");
    let over = unwrapped(false);
    assert_eq!((codes(&over.report), &over.report["outcome"]), (Vec::new(), &Value::from("refined")));
    assert!(figure(&over, "overlap_fraction") > 0.1 && figure(&over, "seam_length") == 0.0);
    assert!(figure(&over, "symmetric_dirichlet") < 4.001);
    let apart = unwrapped(true);
    assert_eq!(codes(&apart.report), Vec::<&str>::new());
    assert!(figure(&apart, "overlap_fraction") < 1e-6 && figure(&apart, "symmetric_dirichlet") > 4.01, "it is bent");
}
