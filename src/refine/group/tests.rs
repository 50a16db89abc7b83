//! Models that share an atlas, from files to files.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use image::DynamicImage;
use serde_json::{Value, json};

use crate::asset::ReadOptions;
use crate::asset::{self, Document, File, Limits, TextureSet, fixture, sample};
use crate::atlas::{Charts, FaceId, Topology, overlapping_charts};
use crate::context::Context;
use crate::refine::options::Options;
use crate::refine::{Input, Outcome, parse, refine};
use crate::texture::{Format, Role, decode, texel};

fn input(names: &[&str]) -> Input {
    let file = |name: &&str| File { path: format!("{name}.glb"), bytes: sample::made(name).to_vec() };
    Input { models: names.iter().map(|n| vec![file(n)]).collect(), extras: true, ..Input::default() }
}

fn options(value: Value) -> Options {
    parse::options(&value).unwrap()
}

fn run(names: &[&str], value: Value) -> (Outcome, Vec<String>) {
    let context = Context::silent();
    let outcome = refine(&input(names), &options(value), &context).unwrap();
    (outcome, context.warnings().into_iter().map(|w| format!("{} {}", w.code, w.message)).collect())
}

fn document(files: &[File]) -> Document {
    asset::load(files, None, &Limits::default()).unwrap().0
}

fn artifact(outcome: &Outcome, name: &str) -> File {
    let found = outcome.artifacts.iter().find(|a| a.name == name).unwrap_or_else(|| panic!("no {name}"));
    File { path: found.name.clone(), bytes: found.bytes.clone() }
}

fn sets(doc: &Document) -> Vec<TextureSet> {
    let index = asset::MaterialIndex::new(doc).unwrap();
    let mut sets = asset::read(doc, &index, ReadOptions::default(), &Context::silent()).unwrap();
    sets.retain(|set| set.atlas.has_layout());
    sets
}

/// Positions and base colours at points of a triangle.
type Looks = Vec<(DVec3, [f64; 3])>;

/// The looks of every triangle, by mesh, primitive and number.
fn colours(doc: &Document) -> BTreeMap<(usize, usize, usize), Looks> {
    let mut out = BTreeMap::new();
    for set in sets(doc) {
        for (p, primitive) in set.primitives.iter().enumerate() {
            let slot = set.slots.iter().find(|s| s.role == Role::BaseColor && s.primitives.contains(&(p as u32)));
            let slot = slot.unwrap();
            let image = decode(doc.images[slot.image].as_ref().unwrap(), 1 << 30).unwrap();
            for t in 0..primitive.face_count {
                let face = FaceId::new(primitive.first_face + t);
                let (x, uv) = (set.atlas.triangle(face), set.atlas.uv_triangle(face));
                let scale = DVec2::new(f64::from(slot.header.width), f64::from(slot.header.height))
                    / DVec2::new(f64::from(set.reference[0]), f64::from(set.reference[1]));
                let points = [[0.34, 0.33, 0.33], [0.8, 0.1, 0.1], [0.05, 0.15, 0.8]].map(|[a, b, c]| {
                    let texel = (uv[0] * a + uv[1] * b + uv[2] * c) * scale;
                    (x[0] * a + x[1] * b + x[2] * c, bilinear(&image, texel))
                });
                out.insert((primitive.mesh, primitive.primitive, t), points.to_vec());
            }
        }
    }
    out
}

/// In 0..=255.
fn bilinear(image: &DynamicImage, point: DVec2) -> [f64; 3] {
    let last = usize::from(image.color().channel_count()) - 1;
    let p = point - 0.5;
    let (base, t) = (p.floor(), p - p.floor());
    let mut out = [0.0; 3];
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let wrap = |v: f64, d: i64, n: u32| (v as i64 + d).rem_euclid(i64::from(n)) as u32;
        let value = texel(image, wrap(base.x, dx, image.width()), wrap(base.y, dy, image.height()));
        let weight = (if dx == 1 { t.x } else { 1.0 - t.x }) * (if dy == 1 { t.y } else { 1.0 - t.y });
        (0..3).for_each(|c| out[c] += weight * value[c.min(last)] * 255.0);
    }
    out
}

/// The surface and its colours are those of the upload; `tolerance` in 1/255.
fn looks_alike(before: &Document, after: &Document, tolerance: f64) {
    let (old, new) = (colours(before), colours(after));
    assert_eq!(old.keys().collect::<Vec<_>>(), new.keys().collect::<Vec<_>>());
    for (key, points) in &old {
        for ((p, a), (q, b)) in points.iter().zip(&new[key]) {
            assert!((*p - *q).length() < 1e-5, "{key:?}: {p} has become {q}");
            let off = (0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f64::max);
            assert!(off <= tolerance, "{key:?}: {a:?} has become {b:?}");
        }
    }
}

#[test]
fn two_models_share_one_atlas() {
    let names = ["textured", "two_materials"];
    let (outcome, warnings) = run(&names, json!({}));
    let report = &outcome.report;
    let refined: Vec<bool> = report["atlases"].as_array().unwrap().iter().map(|a| a["refined"] == true).collect();
    assert_eq!(refined, [true, false], "one of the second model's primitives has no texture coordinates: {warnings:?}");
    assert_eq!(report["atlases"][0]["models"], json!([0, 1]));
    assert_eq!(report["input"]["models"].as_array().unwrap().len(), 2);
    assert_eq!(report["atlases"][0]["after"]["overlap_fraction"], 0.0);
    let docs: Vec<Document> =
        ["model-0.glb", "model-1.glb"].map(|n| document(&[artifact(&outcome, n)])).into_iter().collect();
    for (n, (name, doc)) in names.iter().zip(&docs).enumerate() {
        gltf::Gltf::from_slice(&artifact(&outcome, &format!("model-{n}.glb")).bytes).unwrap();
        let before = document(&[File { path: "a.glb".into(), bytes: sample::made(name).to_vec() }]);
        looks_alike(&before, doc, 1.01);
    }
    // One image, the same bytes in both; both texture sets of the second model read it.
    let base = |doc: &Document| -> Vec<Vec<u8>> {
        let sets = sets(doc);
        let slots = sets.iter().flat_map(|s| s.slots.iter().filter(|s| s.role == Role::BaseColor));
        slots.map(|s| doc.images[s.image].clone().unwrap()).collect()
    };
    let shared = artifact(&outcome, "atlas-0.page-0.base_color.png").bytes;
    assert_eq!(base(&docs[0]), std::slice::from_ref(&shared));
    assert_eq!(base(&docs[1]), std::slice::from_ref(&shared));
    assert_eq!(docs[1].images.iter().filter(|i| i.as_ref() == Some(&shared)).count(), 1);
    no_chart_meets_another_models(&docs);
    assert!(report["textures"][0]["sources"].as_array().unwrap().len() >= 2);
}

/// The layouts of several documents laid on one sheet.
fn no_chart_meets_another_models(docs: &[Document]) {
    let mut joint = crate::atlas::Atlas::default();
    let mut model = Vec::new();
    for (m, doc) in docs.iter().enumerate() {
        for set in sets(doc) {
            joint = crate::atlas::testing::join(&joint, &set.atlas);
            model.resize(joint.face_count(), m);
        }
    }
    let charts = Charts::new(&Topology::new(&joint));
    for (a, b) in overlapping_charts(&joint, &charts) {
        let of = |c: crate::atlas::ChartId| model[charts.faces[c.index()][0].index()];
        assert_eq!(of(a), of(b), "charts of two models overlap");
    }
}

#[test]
fn sets_of_different_slots_are_resampled_closely() {
    // Any rotation: every texel is resampled.
    let (outcome, _) = run(&["textured", "skinned", "tiled"], json!({"pack": {"rotation": "any"}}));
    for (n, name) in ["textured", "skinned", "tiled"].iter().enumerate() {
        let before = document(&[File { path: "a.glb".into(), bytes: sample::made(name).to_vec() }]);
        let after = document(&[artifact(&outcome, &format!("model-{n}.glb"))]);
        looks_alike(&before, &after, 60.0);
    }
    let textures = outcome.report["textures"].as_array().unwrap();
    assert!(textures.iter().any(|t| t["psnr_db"].is_number()), "{textures:#?}");
    for texture in textures {
        let psnr = texture["psnr_db"].as_f64();
        assert!(psnr.is_none_or(|p| p > 35.0), "{texture:#}");
    }
}

#[test]
fn the_finest_texels_and_the_widest_format_count() {
    let model = |normal: [u32; 2], size: [u32; 2]| {
        let mut doc = fixture::document(&[size, normal]);
        doc.json["materials"][0]["normalTexture"] = json!({ "index": 1 });
        let primitive = fixture::bowtie(&mut doc);
        fixture::mesh(&mut doc, vec![primitive]);
        sets(&doc).remove(0)
    };
    let (mut a, mut b) = (model([64, 64], [64, 64]), model([48, 24], [96, 48]));
    a.slots[0].header.channels = 4;
    b.slots[1].header.depth = 16;
    b.slots[0].header.format = Format::Jpeg;
    let group = super::Group::new(5, vec![(0, a), (1, b)]);
    let set = group.set();
    assert_eq!((set.id, set.slots.len(), set.primitives[1].first_face), (5, 2, 2));
    // One above the other, tall first: 64 and 96 wide.
    assert_eq!(group.members.iter().map(|m| m.place).collect::<Vec<_>>(), [DVec2::ZERO, DVec2::new(0.0, 64.0)]);
    assert_eq!(set.reference, [96, 112]);
    let header = |slot: usize| {
        let h = set.slots[slot].header;
        ([h.width, h.height], h.channels, h.depth, h.format)
    };
    assert_eq!(header(0), ([96, 112], 4, 8, Format::Png));
    assert_eq!(header(1), ([96, 112], 3, 16, Format::Png));
    let warnings = group.warnings();
    assert_eq!(warnings.len(), 1);
    assert_eq!((warnings[0].0, warnings[0].1.code.as_str()), (1, "slot_refined"));
    assert_eq!(warnings[0].1.pointer.as_deref(), Some("/images/1"));
}

#[test]
fn side_files_are_shared_by_name() {
    let (outcome, _) = run(&["textured", "two_materials"], json!({"output": "gltf"}));
    let uri = |model: &str| -> Vec<String> {
        let json: Value = serde_json::from_slice(&artifact(&outcome, model).bytes).unwrap();
        let images = json["images"].as_array().unwrap();
        assert_eq!(json["buffers"][0]["uri"], model.replace("gltf", "bin"));
        images.iter().filter_map(|i| i["uri"].as_str().map(str::to_owned)).collect()
    };
    let (a, b) = (uri("model-0.gltf"), uri("model-1.gltf"));
    let shared = "atlas-0.page-0.base_color.png".to_owned();
    assert!(a.contains(&shared) && b.contains(&shared), "{a:?} {b:?}");
    let names: Vec<&str> = outcome.artifacts.iter().map(|a| a.name.as_str()).collect();
    let mut once = names.clone();
    once.sort_unstable();
    once.dedup();
    assert_eq!(once.len(), names.len(), "{names:?}");
    let files: Vec<File> = names.iter().filter(|n| !n.contains("model-0")).map(|n| artifact(&outcome, n)).collect();
    let doc = asset::load(&files, Some("model-1.gltf"), &Limits::default()).unwrap().0;
    assert!(doc.images.iter().all(Option::is_some));
}

#[test]
fn a_joint_atlas_is_parted_and_joined_without_loss() {
    let docs = ["textured", "two_materials"]
        .map(|n| document(&[File { path: format!("{n}.glb"), bytes: sample::made(n).to_vec() }]));
    let all = docs.iter().enumerate().flat_map(|(m, doc)| sets(doc).into_iter().map(move |s| (m, s))).collect();
    let group = super::Group::new(3, all);
    let joint = &group.set().atlas;
    assert!(crate::atlas::check(joint, joint, crate::atlas::Exactness::Exact).is_ok());
    let parts = group.part(joint).unwrap();
    assert_eq!(parts.len(), group.members.len());
    for ((part, faces), member) in parts.iter().zip(&group.members) {
        assert_eq!(part.face_count(), member.set.atlas.face_count());
        for (i, face) in faces.iter().enumerate() {
            let i = FaceId::new(i);
            assert_eq!(part.triangle(i), joint.triangle(*face));
            assert_eq!(part.provenance[i.index()], member.set.atlas.provenance[i.index()]);
            let own = member.set.atlas.uv_triangle(i).map(|uv| uv + member.place);
            assert_eq!(part.uv_triangle(i), own);
        }
    }
    let parts = parts.into_iter().map(|(own, faces)| (own.into_owned(), faces)).collect();
    let again = group.rejoin(joint, parts);
    for face in joint.faces() {
        assert_eq!((again.triangle(face), again.uv_triangle(face)), (joint.triangle(face), joint.uv_triangle(face)));
    }
    assert!(crate::atlas::check(joint, &again, crate::atlas::Exactness::Exact).is_ok());
}

#[test]
fn weights_follow_their_faces_into_the_joint_atlas() {
    let value = json!({"importance": {"materials": {"material 0": 1.0}}});
    let failure = refine(&input(&["textured", "tiled"]), &options(value), &Context::silent()).err();
    // The samples' materials have names, so that there is none without.
    assert_eq!(failure.unwrap().pointer.as_deref(), Some("/importance/materials/material 0"));
    let doc = document(&[File { path: "a.glb".into(), bytes: sample::made("tiled").to_vec() }]);
    let name = doc.json["materials"][0]["name"].as_str().unwrap().to_owned();
    let (outcome, _) = run(&["textured", "tiled"], json!({"importance": {"materials": {name: 9.0}}}));
    let range = &outcome.report["atlases"][0]["importance"];
    assert_eq!(range[1], 9.0, "{range}");
}
