//! Every model through `--recipe pack`: nothing broken, nothing lost, and read by others as it was before.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use intarsia::asset::sample::{names, sample};
use intarsia::asset::{Compression, File, Limits, load};
use intarsia::context::Context;
use intarsia::refine::options::{IfLarger, Options};
use intarsia::refine::{Input, Outcome, refine};
use intarsia::texture::TextureFormat;
use serde_json::Value;

use super::expected::{AUTHORED, Expected, HOSTILE, SCANS};
use super::{data, geometry, lossless, node};

/// Warnings that do not tell a model from others.
const COMMON: [&str; 4] = ["heavier_texture", "kept_input", "lossy_reencode", "small_slot_resampled"];

#[test]
fn authored_models() {
    every(&AUTHORED);
}

#[test]
fn scans() {
    every(&SCANS);
}

#[test]
fn difficult_models() {
    every(&HOSTILE);
}

/// Models made by code are there when no others are.
#[test]
fn samples_are_read_by_others() {
    // The larger scans are the smallest once more.
    for name in names().iter().filter(|n| !n.starts_with("scan_")) {
        let glb = sample(name).expect("a sample");
        let path = written(&format!("sample-{name}.before"), &glb);
        let files = vec![File { path: "sample.glb".to_owned(), bytes: glb.clone() }];
        let outcome = pack(files, IfLarger::Accept).unwrap_or_else(|failure| panic!("{name}: {failure}"));
        whole(name, &path, &glb, &outcome);
    }
}

fn pack(files: Vec<File>, if_larger: IfLarger) -> Result<Outcome, intarsia::error::Failure> {
    let mut options = Options::default();
    options.texture.format = TextureFormat::Png.into();
    options.atlas.if_larger = if_larger;
    options.output.compression = Compression::None;
    refine(&Input { models: vec![files], ..Input::default() }, &options, &Context::silent())
}

/// A file for other programs to read.
pub(super) fn written(name: &str, glb: &[u8]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}.glb", name.replace('/', "_")));
    std::fs::write(&path, glb).expect("a file");
    path
}

fn every(table: &[(&str, Expected)]) {
    let names: Vec<&str> = table.iter().map(|(name, _)| *name).collect();
    for (name, files) in data::models(&names) {
        let (_, expected) = table.iter().find(|(known, _)| *known == name).expect("its line");
        model(name, files, *expected);
    }
}

fn model(name: &str, files: Vec<File>, expected: Expected) {
    let start = std::time::Instant::now();
    let (outcome, codes) = match (expected, pack(files.clone(), IfLarger::KeepInput)) {
        (_, Err(failure)) => panic!("{name}: {failure}"),
        (Expected::Refined(codes) | Expected::Left(codes), Ok(outcome)) => (outcome, codes),
    };
    let told: BTreeSet<&str> = list(&outcome.report["warnings"]).iter().filter_map(|w| w["code"].as_str()).collect();
    let told: BTreeSet<&str> = told.into_iter().filter(|code| !COMMON.contains(code)).collect();
    assert_eq!(told, codes.iter().copied().collect(), "{name}: {:#}", outcome.report["warnings"]);
    let refined = list(&outcome.report["atlases"]).iter().any(|a| a["refined"] == true);
    assert_eq!(refined, matches!(expected, Expected::Refined(_)), "{name}: {:#}", outcome.report["atlases"]);

    let (doc, _) = load(&files, None, &Limits::default()).expect("the model loads");
    let original = doc.to_glb().expect("a GLB");
    let converted = written(&format!("{name}.before"), &original);
    // Values are compared as they were when they came out of their compression; `compressed` looks at codecs.
    let readable = !name.ends_with(".obj") && !doc.is_compressed(Compression::Keep);
    let path = data::folder().map(|f| f.join(name)).filter(|_| readable).unwrap_or(converted);
    whole(name, &path, &original, &outcome);
    figures(name, &outcome.report);
    println!("{name}: {:.1} s", start.elapsed().as_secs_f64());
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// Nothing is broken and nothing is lost. `path` is the model as it came, `original` the same as GLB.
pub(super) fn whole(name: &str, path: &Path, original: &[u8], outcome: &Outcome) {
    let glb = &outcome.artifacts.iter().find(|a| a.role == "model").expect("a model").bytes;
    assert_eq!(geometry::corners(glb), geometry::corners(original), "{name}: the surface changed");
    let lost = lossless::differences(&lossless::Model::open(path), &lossless::Model::new(glb));
    assert!(lost.is_empty(), "{name}: {lost:#?}");

    let after = written(&format!("{name}.after"), glb);
    if let (Some(before), Some(after)) = (node::errors(path), node::errors(&after)) {
        let new: Vec<_> = after.difference(&before).collect();
        assert!(new.is_empty(), "{name}: the validator finds {new:?}");
    }
    let Some((before, transform)) = node::transform(path).zip(node::transform(&after)) else { return };
    let three = node::three(&after).expect("three.js beside glTF Transform");
    let clones = list(&outcome.report["atlases"]).iter().any(|a| a["pages"].as_u64().is_some_and(|p| p > 1));
    let readers = [("glTF Transform", &transform), ("three.js", &three)];
    for (reader, now) in readers {
        // Of several files that are missing any may be named, with its folder or without.
        let named = |b: &Value| {
            let b = b.as_str()?;
            let missing = b.starts_with("ENOENT").then_some("ENOENT");
            missing.or_else(|| b.rsplit(['/', '\'']).find(|p| !p.is_empty())).map(str::to_owned)
        };
        let known: Vec<_> = list(&before["broken"]).iter().map(named).collect();
        let broken: Vec<_> = list(&now["broken"]).iter().filter(|b| !known.contains(&named(b))).collect();
        assert!(broken.is_empty(), "{name}: {reader} finds {broken:?}");
        if before.get("drawn").is_none() {
            // It could not be read before either.
            continue;
        }
        for key in ["triangles", "morphs", "skinned", "animations", "nodes", "meshes", "skins", "joints", "cameras"] {
            let known = now.get(key).is_some();
            assert!(!known || now[key] == before[key], "{name}: {reader}: {key}: {} became {}", before[key], now[key]);
        }
        let equal = now["drawn"] == before["drawn"];
        assert!(equal || clones, "{name}: {reader} draws {} meshes, of {}", now["drawn"], before["drawn"]);
    }
    assert_eq!(transform["channels"], before["channels"], "{name}: animations lost channels");
    let materials = |of: &Value| of["materials"].as_u64();
    assert!(materials(&transform) == materials(&before) || clones, "{name}: materials went or came");
    assert!(list(&three["complaints"]).is_empty() || !list(&before["broken"]).is_empty(), "{name}: {three}");
}

/// What the report says of atlases and textures: no new overlap, gutters kept, colours and directions kept.
fn figures(name: &str, report: &Value) {
    for atlas in list(&report["atlases"]) {
        let figure = |when: &str, key: &str| {
            let value = atlas[when].get(key).unwrap_or_else(|| panic!("{name}: there is no {key} in {atlas}"));
            value.as_f64()
        };
        let [before, after] = ["before", "after"].map(|when| figure(when, "overlap_fraction"));
        assert!(after.is_some() == before.is_some() && after <= before.map(|f| f + 1e-6), "{name}: {atlas}");
        let kept = atlas["after"]["texture_pixels"] == atlas["before"]["texture_pixels"];
        assert!(kept || figure("after", "gutter_texels").is_none_or(|g| g >= 2.0), "{name}: {atlas}");
    }
    for texture in list(&report["textures"]) {
        assert_eq!(texture["exact"], true, "{name}: {texture}");
        assert!(texture["max_error"].as_f64().is_some_and(|e| e < 0.05), "{name}: {texture}");
        // The gutter of 2 of a sampler without mipmaps promises nothing of them.
        let atlas = list(&report["atlases"]).iter().find(|a| a["id"] == texture["atlas_id"]);
        let wide = atlas.and_then(|a| a["after"]["gutter_texels"].as_f64()).is_none_or(|g| g >= 4.0);
        assert!(!wide || texture["mip2_mean_error"].as_f64().is_some_and(|e| e < 2.0), "{name}: {texture}");
        assert!(texture["angle_p95_deg"].as_f64().is_none_or(|a| a < 5.0), "{name}: {texture}");
        assert!(texture["angle_median_deg"].as_f64().is_none_or(|a| a < 1.0), "{name}: {texture}");
    }
}
