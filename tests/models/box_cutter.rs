//! `--recipe box_cutter` on real models: valid, whole, free of overlaps, and without a trace of the cuts in the picture.

use image::DynamicImage;
use intarsia::asset::{File, Limits, MaterialIndex, load, read};
use intarsia::atlas::OverlapMode;
use intarsia::atlas::{Atlas, HalfEdge, Topology};
use intarsia::context::Context;
use intarsia::packing::Rotation;
use intarsia::refine::options::{IfLarger, Options, Recipe};
use intarsia::refine::{Input, Outcome, refine};
use intarsia::texture::TextureFormat;
use intarsia::texture::{decode, texel};

use super::{data, every, geometry, node};

/// A skinned model, which is cut along its edges only.
const SKINNED: &str = "pbr/khr_CesiumMan/CesiumMan.glb";

fn options() -> Options {
    let mut options = Options { recipe: Recipe::Preset("box_cutter".to_owned()), ..Options::default() };
    options.texture.format = TextureFormat::Png.into();
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    options.work_budget = Some(20_000_000);
    options
}

fn run(files: Vec<File>, options: &Options) -> Outcome {
    let input = Input { models: vec![files], extras: true, ..Input::default() };
    refine(&input, options, &Context::silent()).expect("the model is refined")
}

fn model(outcome: &Outcome) -> &[u8] {
    &outcome.artifacts.iter().find(|a| a.role == "model").expect("a model").bytes
}

/// The atlases of a model, as they would be read.
fn atlases(glb: &[u8]) -> Vec<Atlas> {
    let files = [File { path: "model.glb".to_owned(), bytes: glb.to_vec() }];
    let (doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
    let index = MaterialIndex::new(&doc).expect("the model is indexed");
    let sets = read(&doc, &index, Options::default().atlas.reading(), &Context::silent()).expect("the model reads");
    sets.into_iter().map(|set| set.atlas).collect()
}

/// The first of them.
fn atlas(glb: &[u8]) -> Atlas {
    atlases(glb).swap_remove(0)
}

fn surface(atlas: &Atlas) -> f64 {
    atlas.faces().map(|f| atlas.area(f)).sum()
}

/// Triangles may have been divided, and nothing else has happened to the surface: no area came or went, no crack opened, and the
/// validator finds nothing new.
pub(super) fn whole_but_cut(name: &str, original: &[u8], glb: &[u8]) {
    let files = ["before", "after"]
        .map(|when| every::written(&format!("{name}.cut-{when}"), if when == "before" { original } else { glb }));
    if let [Some(before), Some(after)] = files.each_ref().map(|file| node::errors(file)) {
        let new: Vec<_> = after.difference(&before).collect();
        assert!(new.is_empty(), "{name}: the validator finds {new:?}");
    }
    // Of one atlas or several: what was apart may share one.
    let (before, after) = (atlases(original), atlases(glb));
    let area = |all: &[Atlas]| all.iter().map(surface).sum::<f64>();
    let (old, new) = (area(&before), area(&after));
    assert!((old - new).abs() <= 1e-6 * old, "{name}: a surface of {old} became {new}");
    let open = |a: &Atlas| {
        let topology = Topology::new(a);
        topology.half_edges().filter(|h| topology.surface_twin(*h).is_none()).count()
    };
    let borders = |all: &[Atlas]| all.iter().map(open).sum::<usize>();
    if borders(&before) == 0 {
        assert_eq!(borders(&after), 0, "{name}: a crack opened");
    }
}

#[test]
fn cut_models_are_valid_whole_and_free_of_overlaps() {
    let names = [
        "pbr/khr_Avocado/Avocado.gltf",
        "pbr/khr_WaterBottle/WaterBottle.gltf",
        SKINNED,
        "uv/derived_homer.obj",
        "uv/derived_octopus_mainComp_f6000.obj",
    ];
    for (name, files) in data::models(&names) {
        let (doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
        let original = doc.to_glb().expect("a GLB");
        let outcome = run(files, &options());
        let glb = model(&outcome);
        whole_but_cut(name, &original, glb);
        if name == SKINNED {
            assert_eq!(
                geometry::corners(glb),
                geometry::corners(&original),
                "{name}: skinned models are cut along edges"
            );
        } else {
            assert!(atlas(glb).face_count() > atlas(&original).face_count(), "{name}: straight cuts split triangles");
        }
        let figures = &outcome.report["atlases"][0];
        let figure = |when: &str, key: &str| figures[when][key].as_f64().unwrap_or(f64::NAN);
        assert!(figure("after", "overlap_fraction") < 1e-6, "{name}: {figures}");
        assert!(
            figure("after", "packing_efficiency") > figure("before", "packing_efficiency") + 0.05,
            "{name}: {figures}"
        );
        let stage = &outcome.report["stages"][0];
        assert!(stage["boundary_length_ratio"].as_f64().is_some_and(|b| b <= 1.5), "{name}: {stage}");
        let textures = outcome.report["textures"].as_array().expect("textures");
        assert!(!textures.is_empty() || name.starts_with("uv/"), "{name} has textures");
        for texture in textures {
            assert_eq!(texture["exact"], true, "{name}: {texture}");
            assert!(texture["angle_p95_deg"].as_f64().is_none_or(|a| a < 1.0), "{name}: {texture}");
        }
        println!("{name}: {} {stage}", figures["after"]["packing_efficiency"]);
    }
}

#[test]
fn both_sides_of_a_cut_have_one_colour() {
    for (name, files) in data::models(&["pbr/khr_Avocado/Avocado.gltf", "pbr/khr_WaterBottle/WaterBottle.gltf"]) {
        let (doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
        let before = atlas(&doc.to_glb().expect("a GLB"));
        let mut options = options();
        options.pack.rotation = Rotation::Any;
        let outcome = run(files, &options);
        let after = atlas(model(&outcome));
        let texture = outcome.artifacts.iter().find(|a| a.name.contains("base_color")).expect("a texture");
        let image = decode(&texture.bytes, 1 << 28).expect("a picture");

        let old = seams(&before);
        let mut differences = Vec::new();
        for ([a, b], sides) in seams(&after) {
            let middle = (a + b) * 0.5;
            let distance = |s: &([glam::DVec3; 2], [[glam::DVec2; 2]; 2])| {
                let d = s.0[1] - s.0[0];
                let t = ((middle - s.0[0]).dot(d) / d.length_squared()).clamp(0.0, 1.0);
                middle.distance(s.0[0] + d * t)
            };
            if old.iter().map(distance).fold(f64::INFINITY, f64::min) < 1e-4 * a.distance(b) {
                continue;
            }
            let colours = sides.map(|[p, q]| colour(&image, (p + q) * 0.5));
            differences.extend((0..3).map(|c| (colours[0][c] - colours[1][c]).abs()));
        }
        let mean = differences.iter().sum::<f64>() / differences.len().max(1) as f64;
        println!("{name}: {} samples on both sides of cuts differ by {mean:.3}/255 on average", differences.len());
        assert!(differences.len() > 30 && mean < 2.0, "{name}: {mean}");
    }
}

/// Seams: their ends on the surface, and their ends in UV on either side, in texels.
fn seams(atlas: &Atlas) -> Vec<([glam::DVec3; 2], [[glam::DVec2; 2]; 2])> {
    let topology = Topology::new(atlas);
    let ends = |h: HalfEdge| [h.corner(), h.end_corner()].map(|k| (h.face().index(), k));
    let across = |h: HalfEdge| Some((h, topology.across_seam(h).filter(|twin| h < *twin)?));
    topology
        .half_edges()
        .filter_map(across)
        .map(|(h, twin)| {
            let place = |(f, k): (usize, usize)| atlas.surface.positions[atlas.surface.triangles[f][k].index()];
            let uv = |(f, k): (usize, usize)| atlas.uv[atlas.corners[f][k].index()];
            (ends(h).map(place), [ends(h).map(uv), ends(twin).map(uv)])
        })
        .collect()
}

/// Bilinear, 0..=255.
fn colour(image: &DynamicImage, p: glam::DVec2) -> [f64; 3] {
    let at = p - glam::DVec2::splat(0.5);
    let (low, part) = (at.floor(), at - at.floor());
    let value = |x: f64, y: f64, c: usize| {
        let x = (x.max(0.0) as u32).min(image.width() - 1);
        let y = (y.max(0.0) as u32).min(image.height() - 1);
        texel(image, x, y)[c] * 255.0
    };
    [0, 1, 2].map(|c| {
        let row = |y: f64| value(low.x, y, c) * (1.0 - part.x) + value(low.x + 1.0, y, c) * part.x;
        row(low.y) * (1.0 - part.y) + row(low.y + 1.0) * part.y
    })
}
