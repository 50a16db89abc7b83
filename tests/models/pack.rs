//! `--recipe pack` on real models: figures that hold.

use intarsia::asset::File;
use intarsia::atlas::OverlapMode;
use intarsia::context::Context;
use intarsia::packing::{Gutter, Rotation};
use intarsia::refine::options::{IfLarger, Options};
use intarsia::refine::{Input, Outcome, refine};
use intarsia::texture::TextureFormat;

use super::data;

fn run(files: Vec<File>, options: &Options) -> Outcome {
    let input = Input { models: vec![files], ..Input::default() };
    refine(&input, options, &Context::silent()).expect("the model is refined")
}

fn png() -> Options {
    let mut options = Options::default();
    options.texture.format = TextureFormat::Png.into();
    options
}

#[test]
fn any_rotation_keeps_40_db() {
    let names = [
        "pbr/khr_Avocado/Avocado.gltf",
        "pbr/khr_CesiumMan/CesiumMan.glb",
        "pbr/khr_NormalTangentTest/NormalTangentTest.glb",
    ];
    for (name, files) in data::models(&names) {
        let mut options = png();
        options.pack.rotation = Rotation::Any;
        let outcome = run(files, &options);
        let textures = outcome.report["textures"].as_array().expect("textures");
        assert!(textures.iter().any(|t| t["slot"] == "base_color"), "{name}: {textures:?}");
        for texture in textures {
            let figure = |key: &str| texture[key].as_f64();
            match texture["slot"].as_str() {
                Some("base_color") => assert!(figure("psnr_db").is_some_and(|db| db >= 40.0), "{name}: {texture}"),
                Some("normal") => assert!(figure("angle_p95_deg").is_some_and(|a| a < 5.0), "{name}: {texture}"),
                _ => {}
            }
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
    for (name, files) in data::models(&rivals.map(|(name, _)| name)) {
        let (_, rival) = rivals.into_iter().find(|r| r.0 == name).expect("a rival");
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
    for (name, files) in data::models(&["pbr/khr_Avocado/Avocado.gltf", "pbr/draco_Fox/Fox.gltf"]) {
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| run(files.clone(), &Options::default()))
        };
        let (one, four) = (with(1), with(4));
        assert_eq!(one.artifacts.len(), four.artifacts.len(), "{name}");
        for (a, b) in one.artifacts.iter().zip(&four.artifacts) {
            assert!(a.name == b.name && a.bytes == b.bytes, "{name}: {} differs", a.name);
        }
    }
}
