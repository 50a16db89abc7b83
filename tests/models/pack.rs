//! `--recipe pack` on real models: nothing broken, nothing lost, and figures that hold.

use intarsia::asset::{File, Limits, load};
use intarsia::context::Context;
use intarsia::refine::options::{Gutter, IfLarger, Options, OverlapMode, Rotation, TextureFormat};
use intarsia::refine::{Input, Outcome, refine};

use super::{data, geometry, validator};

fn run(files: Vec<File>, options: &Options) -> Outcome {
    let input = Input { models: vec![files], ..Input::default() };
    refine(&input, options, &Context::silent()).expect("the model is refined")
}

fn model(outcome: &Outcome) -> &[u8] {
    &outcome.artifacts.iter().find(|a| a.role == "model").expect("a model").bytes
}

fn png() -> Options {
    let mut options = Options::default();
    options.texture.format = TextureFormat::Png;
    options
}

#[test]
fn packed_models_are_valid_whole_and_exact() {
    for (name, files) in data::models() {
        let (doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
        let original = doc.to_glb().expect("a GLB");
        let outcome = run(files, &png());
        let glb = model(&outcome);
        assert_eq!(geometry::corners(glb), geometry::corners(&original), "{name}: the surface changed");

        let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR"));
        let file = |kind: &str| folder.join(format!("{}.{kind}.glb", name.replace('/', "_")));
        std::fs::write(file("before"), &original).expect("a file");
        std::fs::write(file("after"), glb).expect("a file");
        if let (Some(before), Some(after)) = (validator::errors(&file("before")), validator::errors(&file("after"))) {
            let new: Vec<_> = after.difference(&before).collect();
            assert!(new.is_empty(), "{name}: the validator finds {new:?}");
        }

        for atlas in outcome.report["atlases"].as_array().expect("atlases") {
            let figure = |when: &str, key: &str| atlas[when][key].as_f64();
            assert!(
                figure("after", "overlap_fraction") <= figure("before", "overlap_fraction").map(|f| f + 1e-6),
                "{name}: {atlas}"
            );
            let kept = atlas["after"]["texture_pixels"] == atlas["before"]["texture_pixels"];
            assert!(kept || figure("after", "gutter_texels").is_none_or(|g| g >= 4.0), "{name}: {atlas}");
        }
        for texture in outcome.report["textures"].as_array().expect("textures") {
            assert_eq!(texture["exact"], true, "{name}: {texture}");
            assert!(texture["max_error"].as_f64().is_some_and(|e| e < 0.05), "{name}: {texture}");
            assert!(texture["mip2_mean_error"].as_f64().is_some_and(|e| e < 2.0), "{name}: {texture}");
            assert!(texture["angle_p95_deg"].as_f64().is_none_or(|a| a < 5.0), "{name}: {texture}");
            assert!(texture["angle_median_deg"].as_f64().is_none_or(|a| a < 1.0), "{name}: {texture}");
        }
        println!("{name}: {}", outcome.report["model"]["after"]["packing_efficiency"]);
    }
}

#[test]
fn any_rotation_keeps_40_db() {
    for name in [
        "pbr/khr_Avocado/Avocado.gltf",
        "pbr/khr_CesiumMan/CesiumMan.glb",
        "pbr/khr_NormalTangentTest/NormalTangentTest.glb",
    ] {
        let Some(files) = data::model(name) else { continue };
        let mut options = png();
        options.pack.rotation = Rotation::Any;
        let outcome = run(files, &options);
        for texture in outcome.report["textures"].as_array().expect("textures") {
            if texture["slot"] == "base_color" {
                assert!(texture["psnr_db"].as_f64().is_some_and(|db| db >= 40.0), "{name}: {texture}");
            }
            assert!(texture["angle_p95_deg"].as_f64().is_none_or(|a| a < 5.0), "{name}: {texture}");
        }
    }
}

#[test]
fn packing_leads_xatlas_and_blender() {
    // Packing efficiency of the better of the two, gutter 0, every chart on its own.
    let rivals = [
        ("pbr/khr_Avocado/Avocado.gltf", 0.768),
        ("pbr/khr_WaterBottle/WaterBottle.gltf", 0.803),
        ("pbr/khr_Suzanne/Suzanne.gltf", 0.832),
        ("pbr/khr_CesiumMan/CesiumMan.glb", 0.689),
        ("pbr/draco_Fox/Fox.gltf", 0.660),
        ("scans/ycb_025_mug/textured.obj", 0.587),
    ];
    for (name, rival) in rivals {
        let Some(files) = data::model(name) else { continue };
        let mut options = png();
        options.pack.rotation = Rotation::Any;
        options.pack.gutter = Gutter::Texels(0);
        options.atlas.overlaps = OverlapMode::Separate;
        options.atlas.if_larger = IfLarger::Accept;
        let outcome = run(files, &options);
        let reached = outcome.report["atlases"][0]["after"]["packing_efficiency"].as_f64().expect("a figure");
        assert!(reached >= rival, "{name}: {reached} against {rival}");
    }
}

#[test]
fn one_thread_and_four_give_the_same_bytes() {
    for name in ["pbr/khr_Avocado/Avocado.gltf", "pbr/draco_Fox/Fox.gltf"] {
        let Some(files) = data::model(name) else { continue };
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| run(files.clone(), &Options::default()))
        };
        let (one, four) = (with(1), with(4));
        for (a, b) in one.artifacts.iter().zip(&four.artifacts) {
            assert!(a.name == b.name && a.bytes == b.bytes, "{name}: {} differs", a.name);
        }
    }
}
