//! Scans through `--recipe scan`: fewer charts and shorter seams than they came with, no texel coarser, nothing broken.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use intarsia::asset::sample::sample;
use intarsia::asset::{Compression, File, Limits, load};
use intarsia::context::{Context, Listener, Progress};
use intarsia::error::Code;
use intarsia::packing::Gutter;
use intarsia::refine::defrag::params::{Defrag, Search};
use intarsia::refine::options::{IfLarger, Options};
use intarsia::refine::{Input, Outcome, refine};
use intarsia::texture::TextureFormat;
use serde_json::Value;

use super::{data, every};

/// What a scan is to become.
struct Goal {
    name: &'static str,
    /// Fewer charts than this: what the authors' program leaves; where it fails, what the scan came with.
    charts: f64,
    /// At least this PSNR of each texture, in dB: that of the authors' program.
    psnr: f64,
}

/// A scan a line: name, charts, dB.
const GOALS: [Goal; 10] = [
    goal("scans/loaders_agi_ktx2.glb", 2220.0, 30.0),
    goal("scans/loaders_tile.glb", 677.0, 30.0),
    goal("scans/meshroom_esp32cam/texturedMesh.obj", 123.0, 41.1),
    goal(COPYROOM, 577.0, 33.9),
    goal("scans/ycb_002_master_chef_can/textured.obj", 214.0, 45.5),
    goal("scans/ycb_025_mug/textured.obj", 28.0, 49.8),
    goal("scans/ycb_035_power_drill/textured.obj", 21.0, 49.6),
    goal("scans/ycb_059_chain/textured.obj", 48.0, 47.9),
    goal("scans/ycb_061_foam_brick/textured.obj", 2.0, 62.2),
    goal("scans/ycb_072-a_toy_airplane/textured.obj", 25.0, 48.9),
];

/// A scan that is soon refined.
const COPYROOM: &str = "scans/planeopt_copyroom/copyroom_c2000_opt.obj";

/// Most of the surface whose texels may be resampled, on average over the scans.
const MOST_RESAMPLED: f64 = 0.5;

const fn goal(name: &'static str, charts: f64, psnr: f64) -> Goal {
    Goal { name, charts, psnr }
}

fn options() -> Options {
    let mut options = Options::preset("scan");
    options.pack.gutter = Gutter::Texels(4);
    options.texture.format = TextureFormat::Png.into();
    // The reader that the surface is compared by knows no codec.
    options.output.compression = Compression::None;
    options
}

fn run(files: Vec<File>, options: &Options) -> Outcome {
    let input = Input { models: vec![files], ..Input::default() };
    refine(&input, options, &Context::silent()).expect("the scan is refined")
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn figure(of: &Value, when: &str, key: &str) -> f64 {
    let key = key.split('.').fold(&of[when], |at, part| &at[part]);
    key.as_f64().unwrap_or(f64::NAN)
}

#[test]
fn scans_have_fewer_charts_and_shorter_seams() {
    let goal = |name: &str| GOALS.iter().find(|goal| goal.name == name).expect("a goal");
    let scans = data::models(&GOALS.each_ref().map(|goal| goal.name));
    let reports: Vec<(&Goal, Value)> =
        scans.map(|(name, files)| (goal(name), defragmented(goal(name), files))).collect();
    let missed: Vec<String> = reports.iter().flat_map(|(goal, report)| missed(goal, report)).collect();
    assert!(missed.is_empty(), "{missed:#?}");
    let resampled: f64 = reports.iter().map(|(_, report)| resampled(report)).sum();
    assert!(resampled <= MOST_RESAMPLED * reports.len() as f64, "{resampled} of {}", reports.len());
}

/// A scan made by code is there when no others are.
#[test]
fn so_has_a_scan_made_by_code() {
    let goal = goal("sample.scan", 100.0, 35.0);
    let missed = missed(&goal, &defragmented(&goal, made("scan")));
    assert!(missed.is_empty(), "{missed:#?}");
}

fn made(name: &str) -> Vec<File> {
    vec![File { path: "sample.glb".to_owned(), bytes: sample(name).expect("a sample") }]
}

/// Refines a scan, reads it as others do, and gives its report.
fn defragmented(goal: &Goal, files: Vec<File>) -> Value {
    let (doc, _) = load(&files, None, &Limits::default()).expect("the scan loads");
    let original = doc.to_glb().expect("a GLB");
    let start = Instant::now();
    let outcome = run(files, &options());
    println!("{}: {:.1} s", tell(goal.name, &outcome.report), start.elapsed().as_secs_f64());
    // Under a name of its own: other tests write their files at the same time.
    let name = format!("scan.{}", goal.name);
    every::whole(&name, &every::written(&format!("{name}.before"), &original), &original, &outcome);
    outcome.report
}

/// Share of the surface whose texels were resampled.
fn resampled(report: &Value) -> f64 {
    figure(&report["model"], "after", "resampled_area")
}

/// The figures of a report that do not hold.
fn missed(goal: &Goal, report: &Value) -> Vec<String> {
    let mut missed = Vec::new();
    let mut hold = |holds: bool, what: String| {
        if !holds {
            missed.push(format!("{}: {what}", goal.name));
        }
    };
    let [charts, before, after] = [("after", "charts"), ("before", "texture_pixels"), ("after", "texture_pixels")]
        .map(|(when, key)| figure(&report["model"], when, key));
    hold(charts < goal.charts, format!("charts {charts}, of less than {}", goal.charts));
    hold(after < before, format!("texture_pixels: {before} became {after}"));
    for atlas in list(&report["atlases"]) {
        let id = &atlas["id"];
        let mut compare = |key: &str, holds: fn(f64, f64) -> bool| {
            let [before, after] = ["before", "after"].map(|when| figure(atlas, when, key));
            hold(holds(before, after), format!("atlas {id}: {key}: {before} became {after}"));
        };
        compare("charts", |before, after| after < before);
        compare("seam_length", |before, after| after < before);
        compare("solidity", |before, after| after > before);
        compare("vertex_replication", |before, after| after <= before);
        compare("flipped_triangles", |before, after| after <= before);
        // A fraction of the area covered, which itself may become a little smaller.
        compare("overlap_fraction", |before, after| after <= before * 1.01 + 1e-6);
        compare("texel_density.median", |before, after| (after / before - 1.0).abs() <= 0.01);
        // One chart alone has no neighbour.
        compare("gutter_texels", |_, after| after.is_nan() || after >= 4.0);
    }
    for texture in list(&report["textures"]) {
        let psnr = texture["psnr_db"].as_f64().unwrap_or(f64::NAN);
        hold(psnr >= goal.psnr, format!("atlas {}: {psnr:.1} dB, of {}", texture["atlas_id"], goal.psnr));
    }
    for warning in list(&report["warnings"]) {
        hold(warning["code"] != "stage_reverted", format!("{}", warning["message"]));
    }
    missed
}

/// What was reached, in a line.
fn tell(name: &str, report: &Value) -> String {
    let mut line = name.to_owned();
    for key in ["charts", "seam_length", "solidity", "vertex_replication", "texture_pixels"] {
        let [before, after] = ["before", "after"].map(|when| figure(&report["model"], when, key));
        line += &format!(", {key} {before:.6} -> {after:.6}");
    }
    let psnr = list(&report["textures"]).iter().filter_map(|t| t["psnr_db"].as_f64()).reduce(f64::min);
    let resampled = resampled(report);
    format!("{line}, resampled {resampled:.3}, {:.1} dB", psnr.unwrap_or(f64::NAN))
}

/// Charts before and after.
fn charts(report: &Value) -> [f64; 2] {
    ["before", "after"].map(|when| figure(&report["model"], when, "charts"))
}

#[test]
fn one_thread_and_two_give_the_same_bytes() {
    for (name, files) in std::iter::once(("sample.scan", made("scan"))).chain(data::models(&[COPYROOM])) {
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| run(files.clone(), &options()))
        };
        let (one, two) = (with(1), with(2));
        let [before, after] = charts(&one.report);
        assert!(after < before, "{name}: nothing was merged: {:#}", one.report["warnings"]);
        assert_eq!(one.artifacts.len(), two.artifacts.len());
        for (a, b) in one.artifacts.iter().zip(&two.artifacts) {
            assert!(a.name == b.name && a.bytes == b.bytes, "{name}: {} differs", a.name);
        }
    }
}

/// Without resampling, and told so.
fn exact(files: Vec<File>) -> Value {
    let mut options = options();
    options.stages.set(Defrag { max_resampled: 0.0, ..Defrag::default() });
    options.atlas.if_larger = IfLarger::Accept;
    let report = run(files, &options).report;
    assert_eq!(resampled(&report), 0.0, "{:#}", report["stages"]);
    assert_eq!(report["stages"][0]["stopped_by"], "done", "{:#}", report["warnings"]);
    let textures = list(&report["textures"]);
    assert!(!textures.is_empty() && textures.iter().all(|t| t["exact"] == true), "{textures:#?}");
    report
}

#[test]
fn nothing_is_resampled_where_nothing_may_be() {
    for (name, files) in data::models(&[COPYROOM, "scans/ycb_002_master_chef_can/textured.obj"]) {
        let report = exact(files);
        println!("{}", tell(name, &report));
        let [before, after] = charts(&report);
        assert!(after <= before, "{name}: {before} charts became {after}");
    }
}

/// Seams whose two sides have the same texels need no resampling: those of cuts.
#[test]
fn cuts_heal_without_resampling() {
    let mut options = Options::preset("box_cutter");
    options.texture.format = TextureFormat::Png.into();
    options.atlas.if_larger = IfLarger::Accept;
    options.work_budget = Some(5_000_000);
    let cut = run(made("textured"), &options);
    let [whole, pieces] = charts(&cut.report);
    assert!(pieces > whole, "cutting leaves {pieces} charts of {whole}");
    let glb = cut.artifacts.into_iter().find(|a| a.role == "model").expect("a model");
    let [_, healed] = charts(&exact(vec![File { path: glb.name, bytes: glb.bytes }]));
    println!("{whole} charts, cut to {pieces}, became {healed}");
    assert!(healed <= whole, "{whole} charts, cut to {pieces}, became {healed}");
}

#[test]
fn the_published_search_merges_too() {
    for (name, files) in std::iter::once(("sample.scan", made("scan"))).chain(data::models(&[COPYROOM])) {
        let mut options = options();
        options.stages.set(Defrag { search: Search::Paper, ..Defrag::default() });
        let report = run(files, &options).report;
        println!("{}", tell(name, &report));
        // Whole seams, whatever that resamples.
        let [before, after] = charts(&report);
        assert!(after < 0.75 * before, "{name}: {before} charts became {after}: {:#}", report["warnings"]);
        let [before, after] = ["before", "after"].map(|when| figure(&report["model"], when, "overlap_fraction"));
        assert!(after <= before + 1e-6, "{name}: overlaps of {before} became {after}");
    }
}

/// Cancels its job when the stage says `message` for the `turn`th time.
struct Impatient {
    message: &'static str,
    turn: usize,
    state: Mutex<(usize, Option<Instant>)>,
    cancel: Arc<AtomicBool>,
}

impl Listener for Impatient {
    fn progress(&self, progress: &Progress) {
        let mut state = self.state.lock().expect("a listener that has not panicked");
        if progress.stage == "defrag" && progress.message == self.message {
            state.0 += 1;
            if state.0 == self.turn {
                state.1 = Some(Instant::now());
                self.cancel.store(true, Ordering::Relaxed);
            }
        }
    }
}

#[test]
fn a_cancelled_job_ends_within_a_second() {
    let input = Input { models: vec![made("scan_2000")], ..Input::default() };
    for (message, turn) in [("finding seams", 1), ("merging charts", 1), ("merging charts", 50), ("packing", 1)] {
        let cancel = Arc::new(AtomicBool::new(false));
        let state = Mutex::new((0, None));
        let listener = Arc::new(Impatient { message, turn, state, cancel: cancel.clone() });
        let failure = refine(&input, &options(), &Context::new(listener.clone(), cancel, 0))
            .expect_err("the job is cancelled while its charts are merged");
        assert_eq!(failure.code, Code::Canceled, "{message}: {failure}");
        let since = listener.state.lock().expect("the listener").1.expect("the stage has begun").elapsed();
        println!("{message}, {turn}: ended after {since:?}");
        assert!(since < Duration::from_secs(1), "{message}, {turn}: {since:?}");
    }
}
