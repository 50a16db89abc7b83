//! Prints what packing reaches on every model at hand: the default job (quarter turns, density kept), and the tightest
//! packing (any rotation, no gutter, every chart on its own).
//!
//! `cargo bench --bench models [-- PART-OF-A-NAME]`; models lie in `INTARSIA_DATA`, or in `../shared/data`.

mod common;

use common::{filter, run, short};
use intarsia::asset::{File, read_paths};
use intarsia::refine::options::{Gutter, IfLarger, Options, OverlapMode, Rotation, TextureFormat};
use serde_json::Value;

fn main() {
    let filter = filter();
    let (folder, models) = common::models(&["pbr", "scans", "uv"]);
    if models.is_empty() {
        return;
    }
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
