//! Prints what packing reaches on every model at hand: the default job (quarter turns, density kept), and the tightest
//! packing (any rotation, no gutter, every chart on its own).
//!
//! `cargo bench --bench models [-- PART-OF-A-NAME]`; models lie in `INTARSIA_DATA`, or in `../shared/data`.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use intarsia::asset::{File, read_paths};
use intarsia::context::Context;
use intarsia::refine::options::{Gutter, IfLarger, Options, OverlapMode, Rotation, TextureFormat};
use intarsia::refine::{Input, Outcome, refine};
use serde_json::Value;

fn main() {
    let filter = std::env::args().skip(1).find(|a| !a.starts_with("--")).unwrap_or_default();
    let folder = std::env::var_os("INTARSIA_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    let mut models = Vec::new();
    for part in ["pbr", "scans", "uv"] {
        collect(&folder.join(part), &mut models);
    }
    models.sort();
    if models.is_empty() {
        println!("skipped: no models at hand (set INTARSIA_DATA)");
        return;
    }
    println!("machine {} | commit {} | seed 0", machine(), commit());
    println!(
        "{:36} {:>6} {:>6} | default: {:>6} {:>11} {:>5} {:>8} {:>9} {:>7} {:>9} | any: {:>6} {:>7} {:>6}",
        "model", "charts", "before", "PE", "sheet", "s", "psnr", "max/255", "mip2", "angle p95", "PE", "psnr", "s"
    );
    for path in models {
        let name = path.strip_prefix(&folder).unwrap_or(&path).display().to_string();
        if !name.contains(&filter) {
            continue;
        }
        let Ok(files) = read_paths(std::slice::from_ref(&path)) else { continue };
        println!("{:36} {} | {}", short(&name), default_job(&files), tightest(files));
    }
}

fn short(name: &str) -> String {
    name.split_once('/').map_or(name, |n| n.1).chars().take(36).collect()
}

fn collect(folder: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            collect(&path, into);
        } else if path.extension().is_some_and(|e| e == "glb" || e == "gltf" || e == "obj") {
            into.push(path);
        }
    }
}

fn commit() -> String {
    let output =
        Command::new("git").args(["describe", "--always", "--dirty"]).current_dir(env!("CARGO_MANIFEST_DIR")).output();
    output.map(|o| String::from_utf8_lossy(&o.stdout).trim().to_owned()).unwrap_or_default()
}

fn machine() -> String {
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpu
        .lines()
        .find_map(|l| l.strip_prefix("model name"))
        .unwrap_or("unknown")
        .trim_start_matches(['\t', ' ', ':']);
    format!("{model}, {} threads", rayon::current_num_threads())
}

fn run(files: Vec<File>, options: &Options) -> Result<(Outcome, f64), String> {
    let start = Instant::now();
    let input = Input { models: vec![files], ..Input::default() };
    let outcome = refine(&input, options, &Context::silent()).map_err(|e| e.to_string())?;
    Ok((outcome, start.elapsed().as_secs_f64()))
}

/// The extreme of a figure over all textures of the report.
fn worst(report: &Value, key: &str, pick: fn(f64, f64) -> f64) -> f64 {
    let textures = report["textures"].as_array().map_or(&[][..], Vec::as_slice);
    textures.iter().filter_map(|t| t[key].as_f64()).reduce(pick).unwrap_or(f64::NAN)
}

fn default_job(files: &[File]) -> String {
    let mut options = Options::default();
    options.texture.format = TextureFormat::Png;
    match run(files.to_vec(), &options) {
        Err(error) => error,
        Ok((outcome, seconds)) => {
            let report = &outcome.report;
            let model = |when: &str, key: &str| report["model"][when][key].as_f64().unwrap_or(f64::NAN);
            let texture = &report["textures"][0]["after"];
            format!(
                "{:6} {:6.3} | {:15.3} {:>11} {:5.2} {:8.2} {:9.4} {:7.4} {:9.3}",
                report["model"]["before"]["charts"],
                model("before", "packing_efficiency"),
                model("after", "packing_efficiency"),
                format!("{}x{}", texture["width"], texture["height"]),
                seconds,
                worst(report, "psnr_db", f64::min),
                worst(report, "max_error", f64::max),
                worst(report, "mip2_mean_error", f64::max),
                worst(report, "angle_p95_deg", f64::max),
            )
        }
    }
}

fn tightest(files: Vec<File>) -> String {
    let mut options = Options::default();
    options.texture.format = TextureFormat::Png;
    options.pack.rotation = Rotation::Any;
    options.pack.gutter = Gutter::Texels(0);
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    match run(files, &options) {
        Err(error) => error,
        Ok((outcome, seconds)) => {
            let report = &outcome.report;
            let efficiency = report["model"]["after"]["packing_efficiency"].as_f64().unwrap_or(f64::NAN);
            format!("{efficiency:11.3} {:7.2} {seconds:6.2}", worst(report, "psnr_db", f64::min))
        }
    }
}
