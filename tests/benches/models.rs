//! Prints what packing does to every model at hand: first the default job (quarter turns, density kept) and what it costs and
//! keeps, then the tightest packing (any rotation, no gutter, every chart on its own).
//!
//! `cargo bench --bench models [-- PART-OF-A-NAME]`; models lie in `INTARSIA_DATA`, or in `../shared/data`.

mod common;
#[allow(dead_code, reason = "single textures are not measured")]
#[path = "../models/node.rs"]
mod node;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{filter, run, short};
use intarsia::asset::{File, read_paths};
use intarsia::atlas::OverlapMode;
use intarsia::context::Context;
use intarsia::packing::{Gutter, Rotation};
use intarsia::refine::options::{IfLarger, Options};
use intarsia::texture::TextureFormat;
use serde_json::Value;

fn main() {
    let filter = filter();
    let (folder, models) = common::models(&["pbr", "scans", "uv"]);
    let named = |path: &PathBuf| path.strip_prefix(&folder).unwrap_or(path).display().to_string();
    let models: Vec<(String, PathBuf)> =
        models.into_iter().map(|p| (named(&p), p)).filter(|(n, _)| n.contains(&filter)).collect();
    if models.is_empty() {
        return;
    }
    println!(
        "\n{:28} {:>6} {:>6} {:>5} {:>5} {:>8} {:>8} {:>6} {:>7} {:>6} {:>5} {:>7}  slots: exact or dB",
        "default job", "tris", "charts", "PE", "to", "Mtexel", "to", "angle", "95 %", "s", "MiB", "errors"
    );
    for (name, path) in models.iter().filter(|(name, _)| !name.starts_with("uv/")) {
        println!("{:28.28} {}", short(name), default_job(path));
    }
    println!("\n{:28} {:>6} {:>7} {:>6}", "tightest", "PE", "dB", "s");
    for (name, path) in &models {
        if let Ok(files) = read_paths(std::slice::from_ref(path)) {
            println!("{:28.28} {}", short(name), tightest(files));
        }
    }
}

/// The extreme of a figure over all textures of the report.
fn worst(report: &Value, key: &str, pick: fn(f64, f64) -> f64) -> f64 {
    let textures = report["textures"].as_array().map_or(&[][..], Vec::as_slice);
    textures.iter().filter_map(|t| t[key].as_f64()).reduce(pick).unwrap_or(f64::NAN)
}

/// One row: the program itself on the model, in a process of its own.
fn default_job(path: &Path) -> String {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let (out, report) = (folder.join("bench.glb"), folder.join("bench.json"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_intarsia"));
    command.arg("refine").arg(path).arg("-o").arg(&out).arg("--report").arg(&report);
    let start = Instant::now();
    let child =
        command.args(["-q", "--set", "texture.format=png"]).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
    let Ok(mut child) = child else { return "the program does not start".to_owned() };
    let status = format!("/proc/{}/status", child.id());
    let mut kib = 0;
    while child.try_wait().is_ok_and(|s| s.is_none()) {
        kib = kib.max(peak(&status).unwrap_or(0));
        std::thread::sleep(Duration::from_millis(2));
    }
    let seconds = start.elapsed().as_secs_f64();
    let Ok(output) = child.wait_with_output() else { return "the program is lost".to_owned() };
    if !output.status.success() {
        let text = String::from_utf8_lossy(&output.stderr);
        return text.lines().find(|l| l.starts_with("error")).unwrap_or("error").chars().take(100).collect();
    }
    let report: Value =
        std::fs::read(&report).ok().and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default();
    let model = |when: &str, key: &str| report["model"][when][key].as_f64().unwrap_or(f64::NAN);
    let errors = new_errors(path, &out).map_or("-".to_owned(), |n| n.to_string());
    format!(
        "{:6} {:6} {:5.3} {:5.3} {:8.3} {:8.3} {:6.3} {:7.3} {:6.2} {:5} {errors:>7}  {}",
        model("before", "triangles"),
        model("before", "charts"),
        model("before", "packing_efficiency"),
        model("after", "packing_efficiency"),
        model("before", "texture_pixels") / 1e6,
        model("after", "texture_pixels") / 1e6,
        worst(&report, "angle_median_deg", f64::max),
        worst(&report, "angle_p95_deg", f64::max),
        seconds,
        kib >> 10,
        slots(&report)
    )
}

/// Most memory that a process has held so far, in KiB.
fn peak(status: &str) -> Option<u64> {
    let text = std::fs::read_to_string(status).ok()?;
    text.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.trim().strip_suffix(" kB")?.parse().ok()
}

/// What the validator and other readers find in the result, and not in the model as it came.
fn new_errors(before: &Path, after: &Path) -> Option<usize> {
    let broken = |of: &Value| of["broken"].as_array().map_or(0, Vec::len);
    let others = broken(&node::three(after)?) + broken(&node::transform(after)?);
    let before = match before.extension().is_some_and(|e| e == "obj") {
        true => BTreeSet::new(),
        false => node::errors(before)?,
    };
    Some(node::errors(after)?.difference(&before).count() + others)
}

/// The worst texture of each slot: exact, or its peak signal-to-noise ratio.
fn slots(report: &Value) -> String {
    let mut slots: Vec<(&str, bool, f64)> = Vec::new();
    for texture in report["textures"].as_array().into_iter().flatten() {
        let slot = texture["slot"].as_str().unwrap_or_default();
        let (exact, db) = (texture["exact"] == true, texture["psnr_db"].as_f64().unwrap_or(f64::INFINITY));
        match slots.iter_mut().find(|s| s.0 == slot) {
            Some(known) => (known.1, known.2) = (known.1 && exact, known.2.min(db)),
            None => slots.push((slot, exact, db)),
        }
    }
    let words = slots.iter().map(|(slot, exact, db)| match exact {
        true => format!("{slot} exact"),
        false => format!("{slot} {db:.1}"),
    });
    words.collect::<Vec<_>>().join(", ")
}

fn tightest(files: Vec<File>) -> String {
    let mut options = Options::default();
    options.texture.format = TextureFormat::Png.into();
    options.pack.rotation = Rotation::Any;
    options.pack.gutter = Gutter::Texels(0);
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    match run(files, &options, &Context::silent()) {
        Err(error) => error,
        Ok((outcome, seconds)) => {
            let report = &outcome.report;
            let efficiency = report["model"]["after"]["packing_efficiency"].as_f64().unwrap_or(f64::NAN);
            format!("{efficiency:6.3} {:7.2} {seconds:6.2}", worst(report, "psnr_db", f64::min))
        }
    }
}
