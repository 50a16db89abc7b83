//! What the options promise of charts, sheets and textures, from files to files.

mod merge;
pub mod nudge;

use glam::{DVec2, DVec3, DVec4};
use image::DynamicImage;
use serde_json::{Value, json};

use super::pack::pack;
use super::refinement::STAGE_REVERTED;
use super::run::Run;
use super::stage::{SheetInfo, StageInput};
use super::{Input, Outcome, parse, refine};
use crate::asset::ReadOptions;
use crate::asset::{
    self, Document, File, Limits, TextureSet, mikktspace, read_indices, read_vec2, read_vec3, read_vec4, sample,
};
use crate::atlas::{Atlas, Charts, Topology};
use crate::context::Context;
use crate::texture::{Header, Role, decode, header, texel};

fn uploaded(name: &str) -> File {
    File { path: format!("{name}.glb"), bytes: sample::made(name).to_vec() }
}

fn run(name: &str, options: Value) -> (Outcome, Vec<String>) {
    run_on(uploaded(name), options, true)
}

fn run_on(file: File, options: Value, extras: bool) -> (Outcome, Vec<String>) {
    let context = Context::silent();
    let input = Input { models: vec![vec![file]], extras, ..Input::default() };
    let outcome = refine(&input, &parse::options(&options).unwrap(), &context).unwrap();
    (outcome, context.warnings().into_iter().map(|w| w.code).collect())
}

fn document(file: File) -> Document {
    asset::load(&[file], None, &Limits::default()).unwrap().0
}

fn model(outcome: &Outcome) -> Document {
    let found = outcome.artifacts.iter().find(|a| a.name == "model.glb").unwrap();
    document(File { path: found.name.clone(), bytes: found.bytes.clone() })
}

fn artifact<'a>(outcome: &'a Outcome, name: &str) -> &'a [u8] {
    &outcome.artifacts.iter().find(|a| a.name == name).unwrap().bytes
}

fn sets(doc: &Document) -> Vec<TextureSet> {
    let index = asset::MaterialIndex::new(doc).unwrap();
    asset::read(doc, &index, ReadOptions::default(), &Context::silent()).unwrap()
}

/// The files of the refined textures whose names contain `part`.
fn textures<'a>(outcome: &'a Outcome, part: &str) -> Vec<(&'a str, &'a [u8], Header)> {
    let found = outcome.artifacts.iter().filter(|a| a.role == "texture" && a.name.contains(part));
    found.map(|a| (a.media_type.as_str(), a.bytes.as_slice(), header(&a.bytes).unwrap())).collect()
}

fn options(texture: Value, pack: Value) -> Value {
    json!({ "texture": texture, "pack": pack, "atlas": { "if_larger": "accept" }, "work_budget": 2_000_000 })
}

/// The atlas of a sample as uploaded and packed, and the codes of the warnings.
fn packed(name: &str, options: Value) -> (Atlas, Atlas, Vec<String>) {
    let set = sets(&document(uploaded(name))).remove(0);
    let context = Context::silent();
    let (sheet_info, options) = (SheetInfo::new(&set), parse::options(&options).unwrap());
    let (atlas, sheet_info) = (&set.atlas, &sheet_info);
    let input = StageInput { atlas, sheet_info, importance: None, options: &options, context: &context };
    let staged = pack(&input).unwrap();
    (set.atlas, staged.atlas, context.warnings().into_iter().map(|w| w.code).collect())
}

#[test]
fn a_stage_that_breaks_an_atlas_is_undone() {
    let input = Input { models: vec![vec![uploaded("textured")]], ..Input::default() };
    let of = |recipe: Value| {
        let (context, options) = (Context::silent(), parse::options(&json!({ "recipe": recipe })).unwrap());
        let outcome = Run::new(&input, &options, &context).walk().unwrap();
        (outcome, context.warnings())
    };
    let breaks = json!({"stage": "nudge", "breaks": true});
    let (broken, warnings) = of(json!([breaks]));
    assert_eq!(warnings.len(), 1);
    assert_eq!(warnings[0].code, STAGE_REVERTED);
    let told = &warnings[0].message;
    assert!(told.starts_with("nudge was undone for atlas 0, which is as it was before: "), "{told}");
    assert_eq!(broken.report["stages"][0], json!({"stage": "nudge", "atlas_id": 0, "stopped_by": "reverted", "by": 1}));
    assert_eq!(model(&broken).json, document(uploaded("textured")).json, "the model is as it was");

    // A chart that is spoilt is given back, and packed with the others, which keep what was made of them.
    let (mended, warnings) = of(json!([{"stage": "nudge", "spoils": true}]));
    let codes: Vec<&str> = warnings.iter().map(|w| w.code.as_str()).filter(|code| *code != "heavier_texture").collect();
    assert_eq!(codes, ["charts_given_back"]);
    // `faces 6398 and 6557 overlap and their sources did not` told nobody anything.
    let told = &warnings[0].message;
    assert!(told.starts_with("1 charts of atlas 0 keep their uploaded shape"), "{told}");
    assert!(told.contains(" triangles ") && !told.contains("faces "), "{told}");
    assert_eq!(
        mended.report["stages"][0],
        json!({"stage": "nudge", "atlas_id": 0, "stopped_by": "done", "by": 1, "charts_given_back": 1})
    );
    let (before, after) = (&mended.report["atlases"][0]["before"], &mended.report["atlases"][0]["after"]);
    assert_eq!((&after["charts"], &after["overlap_fraction"]), (&before["charts"], &json!(0.0)));

    // What the others did before and after stays.
    let nudge = |by: u32| json!({"stage": "nudge", "by": by});
    let (whole, _) = of(json!([nudge(2), nudge(3)]));
    let (reverted, _) = of(json!([nudge(2), breaks, nudge(3)]));
    let reasons: Vec<&Value> = reverted.report["stages"].as_array().unwrap().iter().map(|s| &s["stopped_by"]).collect();
    assert_eq!(reasons, ["done", "reverted", "done"]);
    let bytes = |outcome: &Outcome| outcome.artifacts.iter().find(|a| a.name == "model.glb").unwrap().bytes.clone();
    assert!(bytes(&reverted) == bytes(&whole) && bytes(&whole) != bytes(&broken));
}

#[test]
fn sheets_have_the_sizes_that_are_asked_for() {
    let of = |texture: Value| packed("textured", options(texture, json!({}))).1.sheets;
    let old = sets(&document(uploaded("textured")))[0].reference;
    let kept = of(json!({}));
    assert!(kept.len() == 1 && kept[0].iter().all(|s| s % 4 == 0));
    assert!(kept[0][0] * kept[0][1] < old[0] * old[1], "{kept:?} of {old:?}");
    assert_eq!(of(json!({ "size": "keep_size" })), [old]);
    assert_eq!(of(json!({ "size": [384, 640] })), [[384, 640]]);
    assert!(of(json!({ "multiple_of": 96 }))[0].iter().all(|s| s % 96 == 0));
    assert!(of(json!({ "power_of_two": true }))[0].iter().all(|s| s.is_power_of_two()));

    // On a sheet that is too small for all: further sheets, or charts made smaller.
    let max = (f64::from(kept[0][0] * kept[0][1]).sqrt() * 0.18) as u32 * 4;
    let pages = of(json!({ "max_size": max }));
    assert!(pages.len() > 1 && pages.iter().flatten().all(|s| *s <= max), "{pages:?} within {max}");
    let scale = |power: bool, aspect: Value| {
        let texture = json!({ "max_size": max, "overflow": "scale", "power_of_two": power });
        let (_, atlas, warnings) = packed("textured", options(texture, json!({ "aspect": aspect })));
        assert!(warnings.contains(&"scaled_to_fit".to_owned()), "{warnings:?}");
        atlas.sheets
    };
    assert_eq!(scale(false, Value::Null), [[max, max]]);
    assert_eq!(scale(true, Value::Null), [[1 << max.ilog2(); 2]]);
    assert_eq!(scale(false, json!(1.25)), [[max, (f64::from(max) / 5.0).floor() as u32 * 4]]);
}

#[test]
fn the_aspect_of_sheets_is_heeded() {
    for aspect in [0.5, 1.0, 3.0] {
        let sheet = packed("textured", options(json!({}), json!({ "aspect": aspect }))).1.sheets[0];
        let [w, h] = sheet.map(f64::from);
        // Both sides are rounded up to multiples of 4.
        assert!((w + 4.0) / h >= aspect && w / (h + 4.0) <= aspect, "{w} x {h} for {aspect}");
    }
}

/// By chart, in reference texels: where its triangles were and are.
fn moves(old: &Atlas, new: &Atlas) -> Vec<Vec<([DVec2; 3], [DVec2; 3])>> {
    assert_eq!(old.face_count(), new.face_count());
    let charts = Charts::new(&Topology::new(old));
    charts.faces.iter().map(|f| f.iter().map(|f| (old.uv_triangle(*f), new.uv_triangle(*f))).collect()).collect()
}

#[test]
fn charts_move_on_the_grid_and_do_not_turn_where_they_must_not() {
    for grid in [1, 8, 12] {
        let pack = json!({ "rotation": "none", "grid": grid });
        let (old, new, _) = packed("fragmented", options(json!({}), pack));
        for chart in moves(&old, &new) {
            let (shift, grid) = (chart[0].1[0] - chart[0].0[0], f64::from(grid));
            assert!((shift / grid - (shift / grid).round()).abs().max_element() < 1e-6, "{shift} on {grid}");
            for (old, new) in chart {
                old.iter().zip(new).for_each(|(a, b)| assert!((b - *a - shift).length() < 1e-6));
            }
        }
    }
}

#[test]
fn charts_are_mirrored_only_where_they_may_be() {
    let orientation = |t: &[DVec2; 3]| (t[1] - t[0]).perp_dot(t[2] - t[0]);
    let mirrored = |mirror: bool| {
        let (old, new, _) = packed("fragmented", options(json!({}), json!({ "mirror": mirror })));
        let charts = moves(&old, &new);
        charts.iter().filter(|c| c.iter().any(|(a, b)| orientation(a) * orientation(b) < -1e-3)).count()
    };
    assert_eq!(mirrored(false), 0);
    assert!(mirrored(true) > 0);
}

/// Whether a triangle meets the inside of the unit cell at `cell`, by separating axes.
fn meets(triangle: &[DVec2; 3], cell: DVec2) -> bool {
    let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| cell + DVec2::new(x, y));
    let edges = (0..3).map(|k| (triangle[(k + 1) % 3] - triangle[k]).perp());
    let range = |points: &[DVec2], axis: DVec2| {
        let dots = points.iter().map(|p| p.dot(axis));
        dots.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], d| [low.min(d), high.max(d)])
    };
    [DVec2::X, DVec2::Y].into_iter().chain(edges).all(|axis| {
        let (a, b) = (range(triangle, axis), range(&corners, axis));
        let slack = 0.01 * axis.length();
        a[0] < b[1] - slack && b[0] < a[1] - slack
    })
}

#[test]
fn no_texel_of_the_last_protected_mip_level_mixes_two_charts() {
    for gutter in [1u32, 2, 4, 8] {
        let (_, atlas, _) = packed("fragmented", options(json!({}), json!({ "gutter": gutter })));
        let charts = Charts::new(&Topology::new(&atlas));
        let (side, sheet) = (1 << gutter.ilog2(), atlas.sheets[0]);
        let across = sheet[0].div_ceil(side) as usize;
        let mut owner = vec![usize::MAX; across * sheet[1].div_ceil(side) as usize];
        for (c, faces) in charts.faces.iter().enumerate() {
            for triangle in faces.iter().map(|f| atlas.uv_triangle(*f)) {
                let low = triangle[0].min(triangle[1]).min(triangle[2]).floor();
                let high = triangle[0].max(triangle[1]).max(triangle[2]).ceil();
                for (x, y) in (low.y as usize..high.y as usize)
                    .flat_map(|y| (low.x as usize..high.x as usize).map(move |x| (x, y)))
                {
                    if meets(&triangle, DVec2::new(x as f64, y as f64)) {
                        let mip = &mut owner[y / side as usize * across + x / side as usize];
                        assert!(*mip == usize::MAX || *mip == c, "gutter {gutter}: charts {mip} and {c} at {x}, {y}");
                        *mip = c;
                    }
                }
            }
        }
        assert!(charts.len() > 100);
    }
}

#[test]
fn textures_have_the_format_that_is_asked_for() {
    let of = |format: &str| run("textured", options(json!({ "format": format }), json!({}))).0;
    let (png, webp, jpeg) = (of("png"), of("webp"), of("jpeg"));
    for (outcome, media_type) in [(&png, "image/png"), (&webp, "image/webp"), (&jpeg, "image/jpeg")] {
        let all = textures(outcome, "atlas-");
        assert!(
            all.len() > 2
                && all.iter().all(|(found, _, h)| *found == media_type && h.format.media_type() == media_type)
        );
    }
    for ((_, a, _), (_, b, _)) in textures(&png, "atlas-").into_iter().zip(textures(&webp, "atlas-")) {
        assert_eq!(decode(a, 1 << 24).unwrap(), decode(b, 1 << 24).unwrap());
    }
    let at = |quality: u32| {
        let (outcome, _) = run("textured", options(json!({ "format": "jpeg", "jpeg_quality": quality }), json!({})));
        textures(&outcome, "base_color")[0].1.len()
    };
    assert!(3 * at(20) < at(95));
}

#[test]
fn ktx2_is_named_by_its_extension_and_stays_ktx2() {
    let (first, _) = run("textured", options(json!({ "format": "ktx2" }), json!({})));
    let source = |outcome: &Outcome| {
        let json = model(outcome).json;
        let textures = json["textures"].as_array().unwrap().clone();
        let named = textures.iter().all(|t| {
            t.get("source").is_none() && t.pointer("/extensions/KHR_texture_basisu/source").is_some_and(Value::is_u64)
        });
        (named, json["extensionsRequired"].clone())
    };
    assert_eq!(source(&first), (true, json!(["KHR_texture_basisu"])));
    let again = File { path: "again.glb".to_owned(), bytes: artifact(&first, "model.glb").to_vec() };
    let (second, warnings) = run_on(again, options(json!({}), json!({})), true);
    assert_eq!(source(&second), source(&first));
    assert!(!warnings.iter().any(|w| w == "reencoded_png" || w == "kept_png"), "{warnings:?}");
    for (media_type, _, head) in textures(&second, "atlas-") {
        assert_eq!((media_type, head.width % 4, head.height % 4), ("image/ktx2", 0, 0));
    }
}

#[test]
fn what_would_become_heavier_stays_where_bytes_are_weighed() {
    let (light, _) = run("textured", options(json!({ "format": "jpeg", "jpeg_quality": 20 }), json!({ "gutter": 12 })));
    let light = || File { path: "light.glb".to_owned(), bytes: artifact(&light, "model.glb").to_vec() };
    let as_png = |weighed: Value| {
        let asked =
            json!({ "texture": { "format": "png" }, "pack": { "gutter": 1 }, "atlas": { "if_larger_by": weighed } });
        run_on(light(), asked, false)
    };
    let (taken, _) = as_png(json!(["pixels", "gpu_bytes"]));
    let (kept, warnings) = as_png(json!(["bytes"]));
    assert_eq!(taken.report["atlases"][0]["outcome"], "refined");
    assert_eq!(
        (&kept.report["atlases"][0]["outcome"], warnings),
        (&json!("kept_input"), vec!["kept_input".to_owned()])
    );
    assert!(kept.report["model"]["before"] == kept.report["model"]["after"]);
}

#[test]
fn a_scale_makes_all_textures_smaller() {
    let at = |scale: f64| run("textured", options(json!({ "scale": scale }), json!({}))).0;
    let (whole, half) = (at(1.0), at(0.5));
    let (whole, half) = (&whole.report["atlases"][0]["after"], &half.report["atlases"][0]["after"]);
    let ratio = |key: &str| half[key].as_f64().unwrap() / whole[key].as_f64().unwrap();
    // Gutters do not become smaller.
    assert!((0.25..0.4).contains(&ratio("texture_pixels")), "{}", ratio("texture_pixels"));
    let median = |m: &Value| m["texel_density"]["median"].as_f64().unwrap();
    assert!((median(half) / median(whole) - 0.5).abs() < 0.01, "{half:#}");
    assert_eq!((&half["overlap_fraction"], &half["resampled_area"]), (&whole["overlap_fraction"], &json!(1.0)));
}

/// World-space normals at points of every triangle, from TANGENT (or what renderers compute where there is none), NORMAL and the normal
/// map, whose x and y count `scale` times.
fn shading(doc: &Document, scale: f64) -> Vec<DVec3> {
    let set = &sets(doc)[0];
    let slot = set.slots.iter().find(|s| s.role == Role::Normal).unwrap();
    let image = decode(doc.images[slot.image].as_ref().unwrap(), 1 << 24).unwrap();
    let mut out = Vec::new();
    for primitive in &set.primitives {
        let json = &doc.json["meshes"][primitive.mesh]["primitives"][primitive.primitive];
        let accessor = |name: &str| json["attributes"][name].as_u64().unwrap() as usize;
        let normals = read_vec3(doc, accessor("NORMAL")).unwrap();
        let uvs = read_vec2(doc, accessor("TEXCOORD_0")).unwrap();
        let indices = read_indices(doc, json["indices"].as_u64().unwrap() as usize).unwrap();
        let faces: Vec<[usize; 3]> = indices.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|i| i as usize)).collect();
        let by_corner = if json["attributes"].get("TANGENT").is_some() {
            let by_vertex = read_vec4(doc, accessor("TANGENT")).unwrap();
            faces.iter().map(|face| face.map(|v| by_vertex[v])).collect()
        } else {
            mikktspace(doc, primitive).unwrap().unwrap()
        };
        for (corners, tangents) in faces.iter().zip(by_corner) {
            for weights in [[0.34, 0.33, 0.33], [0.7, 0.2, 0.1]] {
                let blend = |of: &dyn Fn(usize) -> DVec4| (0..3).map(|k| of(k) * weights[k]).sum::<DVec4>();
                let n = blend(&|k| DVec3::from(normals[corners[k]].map(f64::from)).extend(0.0)).truncate().normalize();
                let t = blend(&|k| DVec4::from(tangents[k].map(f64::from)));
                let (t, w) = (t.truncate().normalize(), t.w.signum());
                let uv = blend(&|k| DVec2::from(uvs[corners[k]].map(f64::from)).extend(0.0).extend(0.0));
                let size = DVec2::new(f64::from(image.width()), f64::from(image.height()));
                let v = bilinear(&image, uv.truncate().truncate() * size);
                let v = DVec3::new(v.x * scale, v.y * scale, v.z);
                out.push((t * v.x + n.cross(t) * w * v.y + n * v.z).normalize());
            }
        }
    }
    out
}

/// The direction at a point, in texels; the image repeats.
fn bilinear(image: &DynamicImage, point: DVec2) -> DVec3 {
    let (base, t) = ((point - 0.5).floor(), point - 0.5 - (point - 0.5).floor());
    let mut out = DVec3::ZERO;
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let wrap = |v: f64, d: i64, n: u32| (v as i64 + d).rem_euclid(i64::from(n)) as u32;
        let [x, y, z, _] = texel(image, wrap(base.x, dx, image.width()), wrap(base.y, dy, image.height()));
        let weight = (if dx == 1 { t.x } else { 1.0 - t.x }) * (if dy == 1 { t.y } else { 1.0 - t.y });
        out += weight * DVec3::new(x, y, z);
    }
    out * 2.0 - 1.0
}

#[test]
fn shading_stays_when_charts_turn_are_mirrored_or_scaled() {
    let with = document(uploaded("textured"));
    let mut without = with.clone();
    for primitive in without.json["meshes"][0]["primitives"].as_array_mut().unwrap() {
        primitive["attributes"].as_object_mut().unwrap().shift_remove("TANGENT").unwrap();
    }
    for doc in [with, without] {
        let before = shading(&doc, 1.6);
        for (texture, pack, limit) in [
            (json!({}), json!({ "rotation": "quarter", "mirror": true }), 1.0),
            (json!({}), json!({ "rotation": "any", "mirror": true }), 4.0),
            (json!({ "size": "keep_size" }), json!({ "mirror": true }), 4.0),
        ] {
            let file = File { path: "model.glb".to_owned(), bytes: doc.to_glb().unwrap() };
            let (outcome, _) = run_on(file, options(texture.clone(), pack.clone()), false);
            let after = shading(&model(&outcome), 1.6);
            assert_eq!(before.len(), after.len());
            let angle = |(a, b): (&DVec3, &DVec3)| a.cross(*b).length().atan2(a.dot(*b)).to_degrees();
            let mut off: Vec<f64> = before.iter().zip(&after).map(angle).collect();
            off.sort_by(f64::total_cmp);
            let p99 = off[off.len() * 99 / 100];
            assert!(p99 < limit, "{texture} {pack}: {p99} degrees");
        }
    }
}
