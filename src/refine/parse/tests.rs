//! Options as users write them, good and bad.

use serde_json::json;

use super::*;
use crate::packing::{Gutter, Pack, Rotation};
use crate::refine::box_cutter::params::BoxCutter;
use crate::refine::defrag::params::Defrag;
use crate::refine::erased::ErasedStage;
use crate::refine::recipe::{PRESETS, Recipe};
use crate::texture::Size;

#[test]
fn empty_options_are_the_defaults_and_every_default_reads_back() {
    assert_eq!(options(&json!({})).unwrap(), Options::default());
    let filled = serde_json::to_value(Options::default()).unwrap();
    assert_eq!(options(&filled).unwrap(), Options::default());
}

#[test]
fn every_problem_is_found_with_its_pointer() {
    let bad = json!({
        "pack": {"gutters": 2, "grid": 0, "rotation": "quater"}, "texture": {"jpeg_quality": 101, "mutliple_of": 4},
        "atlas": {"merge": 1, "uv_set": 9}, "importance": {"attribute": "COLOR_0.red"}, "time_limit_s": -1,
        "require": {"atlas.charts": {}, "model.x/y": {"minimum": 1}}, "recipe": [{"stage": "pack", "grid": 2}, {"stage": "bonded"}],
        "seed": "x", "colour": 1,
    });
    let problems = options(&bad).unwrap_err();
    let found: BTreeMap<&str, &str> = problems.iter().map(|p| (p.pointer.as_str(), p.message.as_str())).collect();
    for (pointer, part) in [
        ("/pack/gutters", "did you mean `gutter`?"),
        ("/pack/grid", "must be \"auto\" or a whole number in 1..=64"),
        ("/pack/rotation", "`quarter`"),
        ("/texture/jpeg_quality", "must be \"keep\" or a whole number in 1..=100"),
        ("/texture/mutliple_of", "`multiple_of`"),
        ("/atlas/merge", "boolean"),
        ("/atlas/uv_set", "outside 0..=7"),
        ("/importance/attribute", "such as COLOR_0.r"),
        ("/time_limit_s", "-1"),
        ("/require/atlas.charts", "at least one of"),
        ("/require/model.x~1y/minimum", "did you mean `min`?"),
        ("/recipe/0/grid", "beside the recipe"),
        ("/recipe/1/stage", "did you mean `bounded`?"),
        ("/seed", "invalid type"),
        ("/colour", "unknown option `colour`"),
    ] {
        let message = found.get(pointer).unwrap_or_else(|| panic!("{pointer} is missing in {found:#?}"));
        assert!(message.contains(part), "{pointer}: {message}");
    }
    assert_eq!(problems.len(), 15, "{problems:#?}");
}

#[test]
fn formats_are_given_for_all_slots_or_by_slot() {
    use crate::texture::{Role, TextureFormat};
    let read = |format: Value| options(&json!({ "texture": { "format": format } }));
    let formats = read(json!({"normal": "png", "base_color": "webp"})).unwrap().texture.format;
    assert_eq!(formats.of(Role::Normal), TextureFormat::Png);
    assert_eq!(formats.of(Role::Occlusion), TextureFormat::Keep);
    assert_eq!(serde_json::to_value(&formats).unwrap(), json!({"base_color": "webp", "normal": "png"}));
    assert_eq!(read(json!("jpeg")).unwrap().texture.format.of(Role::Normal), TextureFormat::Jpeg);
    for wrong in [json!({"normals": "png"}), json!({"normal": "gif"}), json!(3)] {
        assert_eq!(read(wrong).unwrap_err().remove(0).pointer, "/texture/format");
    }
    let both = options(&json!({"texture": {"size": "keep_size", "scale": 0.5}})).unwrap_err().remove(0);
    assert!(both.message.contains("`scale` is for"), "{both:?}");
}

#[test]
fn sizes_must_agree() {
    let bad = |texture: Value| options(&json!({ "texture": texture })).unwrap_err().remove(0).pointer;
    assert_eq!(bad(json!({"size": [64, 64], "max_size": 32})), "/texture/size");
    assert_eq!(bad(json!({"size": [63, 64]})), "/texture/size");
    assert_eq!(bad(json!({"size": [0, 64]})), "/texture/size");
    assert_eq!(bad(json!({"size": [96, 64], "power_of_two": true})), "/texture/size");
    assert_eq!(bad(json!({"max_size": 15})), "/texture/max_size");
    assert_eq!(bad(json!({"format": "tiff"})), "/texture/format");
    assert!(options(&json!({"texture": {"size": [64, 32]}})).is_ok());
}

#[test]
fn what_is_neutral_is_accepted() {
    assert!(options(&json!({"importance": null, "atlas": {"merge": false}, "work_budget": null})).is_ok());
}

#[test]
fn presets_and_stages_have_their_parameters() {
    let panels = options(&json!({"recipe": "fabrication", "pack": {"gutter": 3}})).unwrap();
    assert_eq!((panels.pack.rotation, panels.pack.gutter), (Rotation::Any, Gutter::Texels(3)));
    assert!(panels.fabrication.is_some());
    assert_eq!(panels.steps()[0].stage.name(), "box_cutter");

    let recipe = json!([{"stage": "box_cutter", "max_charts": 9}, {"stage": "pack"}]);
    let listed = options(&json!({"recipe": recipe, "box_cutter": {"max_boundary_length": 1.2}})).unwrap();
    let steps = listed.steps();
    let params: &BoxCutter = steps[0].stage.get().unwrap();
    assert_eq!((params.max_charts, params.max_boundary_length), (Some(9), Some(1.2)), "the stage's own come first");

    let scan = options(&json!({"recipe": "scan_tight", "box_cutter": {"beam": 2}})).unwrap();
    let names: Vec<(&str, bool)> = scan.steps().iter().map(|s| (s.stage.name(), s.only_if_smaller)).collect();
    assert_eq!(names, [("defrag", false), ("box_cutter", true)]);
    let cutter = scan.stages.get::<BoxCutter>();
    assert_eq!((cutter.beam, cutter.max_boundary_length), (2, Some(1.3)), "what users say goes on top of the preset");

    let bad = json!({"recipe": [{"stage": "box_cutter", "max_chart": 9}, {"stage": "box_cutter", "beam": 0}], "box_cutter": {"alpha": 9}});
    let found: Vec<String> = options(&bad).unwrap_err().into_iter().map(|p| p.pointer).collect();
    assert_eq!(found, ["/recipe/0/max_chart", "/box_cutter/alpha", "/recipe/1/alpha", "/recipe/1/beam"]);
}

#[test]
fn every_preset_is_valid_and_reads_back() {
    for preset in PRESETS {
        let mut written: Value = serde_json::from_str(preset.options).unwrap();
        written["recipe"] = json!(preset.name);
        let options = options(&written).unwrap();
        assert_eq!(options, Options::preset(preset.name), "what it says is what users could say");
        assert_eq!(options.steps().len(), preset.stages.len(), "{} names a stage that there is not", preset.name);
        let filled = serde_json::to_value(&options).unwrap();
        assert_eq!(super::options(&filled).unwrap(), options);
        assert_eq!(serde_json::from_value::<Options>(filled).unwrap(), options);
    }
}

#[test]
fn options_in_json_are_one_flat_object_and_strict() {
    let listed = options(&json!({"recipe": [{"stage": "box_cutter", "beam": 2}, {"stage": "pack"}]})).unwrap();
    let mut written = serde_json::to_value(&listed).unwrap();
    assert_eq!((&written["recipe"][0]["beam"], &written["recipe"][1]), (&json!(2), &json!({"stage": "pack"})));
    assert_eq!((&written["box_cutter"]["beam"], &written["defrag"]["retry"]), (&json!(6), &json!(true)));
    assert_eq!(serde_json::from_value::<Options>(written.clone()).unwrap(), listed);
    for (pointer, name) in [("", "colour"), ("/defrag", "retri"), ("/recipe/0", "beams"), ("/recipe/1", "grid")] {
        let mut wrong = written.clone();
        wrong.pointer_mut(pointer).unwrap()[name] = json!(1);
        assert!(serde_json::from_value::<Options>(wrong).is_err(), "{pointer}/{name}");
    }
    written["defrag"]["max_resampled"] = json!(0.5);
    assert_eq!(serde_json::from_value::<Options>(written).unwrap().stages.get::<Defrag>().max_resampled, 0.5);
}

#[test]
fn fabrication_is_asked_for() {
    assert_eq!(options(&json!({"fabrication": null})).unwrap().fabrication, None);
    assert_eq!(options(&json!({"recipe": "fabrication", "fabrication": null})).unwrap().fabrication, None);
    let asked = options(&json!({"fabrication": {"width_mm": 5}})).unwrap().fabrication;
    assert_eq!(asked.unwrap().width_mm, 5.0);
    let wrong = options(&json!({"fabrication": {"fold_angle": 4, "seam": "flaps"}})).unwrap_err();
    let found: Vec<&str> = wrong.iter().map(|p| p.pointer.as_str()).collect();
    assert_eq!(found, ["/fabrication/seam", "/fabrication/fold_angle"]);
}

#[test]
fn importance_has_one_source() {
    let pointer = |value: Value| options(&json!({ "importance": value })).unwrap_err().remove(0).pointer;
    assert_eq!(pointer(json!({"attribute": "COLOR_0.r", "texture": "x.png"})), "/importance");
    assert_eq!(pointer(json!({"materials": {"a/b": -1}})), "/importance/materials/a~1b");
    assert_eq!(pointer(json!({"texture": ""})), "/importance/texture");
    assert!(pointer(json!({"vertex": 1})).starts_with("/importance"));
    assert!(options(&json!({"importance": {"materials": {"skin": 20}}})).is_ok());
}

#[test]
fn paths_set_values() {
    let mut value = json!({});
    for text in [
        "pack.rotation=any",
        "pack.gutter=3",
        "texture.size=[64, 32]",
        "require.atlas.packing_efficiency.min=0.8",
        "metadata.who=me=you",
    ] {
        set(&mut value, text).unwrap();
    }
    let options = options(&value).unwrap();
    assert_eq!(options.pack.rotation, Rotation::Any);
    assert_eq!(options.pack.gutter, Gutter::Texels(3));
    assert_eq!(options.texture.size, Size::Fixed([64, 32]));
    assert_eq!(options.require["atlas.packing_efficiency"].min, Some(0.8));
    assert_eq!(options.metadata["who"], "me=you");
    assert!(set(&mut value, "pack").is_err());
    assert!(set(&mut value, "pack..x=1").is_err());
    assert!(set(&mut value, "pack.rotation.x=1").is_err());
    set(&mut value, "box_cutter.max_boundary_length=1.3").unwrap();
    assert_eq!(super::options(&value).unwrap().stages.get::<BoxCutter>().max_boundary_length, Some(1.3));
    set(&mut value, "bounded.packing_efficiency=0.99").unwrap();
    assert!(super::options(&value).unwrap_err()[0].message.contains("outside 0.01..=0.97"));
}

#[test]
fn recipes_are_names_or_stages() {
    let named = |name: &str| options(&json!({ "recipe": recipe_named(name) }));
    let pack = ErasedStage::of::<Pack>;
    assert_eq!(named("pack").unwrap().recipe, Recipe::Preset("pack".to_owned()));
    assert_eq!(named("pack, pack").unwrap().recipe, Recipe::Stages(vec![pack(), pack()]));
    assert!(named("pak").unwrap_err()[0].message.contains("did you mean `pack`?"));
    assert!(named("scan,pack").unwrap_err()[0].message.contains("is a recipe"));
    let defrag = ErasedStage::new(Defrag { retry: false, ..Defrag::default() });
    let listed = options(&json!({ "recipe": recipe_named("defrag,pack"), "defrag": {"retry": false} })).unwrap();
    assert_eq!(listed.recipe, Recipe::Stages(vec![defrag, pack()]));
    assert!(options(&json!({"recipe": []})).is_err());
    assert!(options(&json!({"recipe": 1})).is_err());
}
