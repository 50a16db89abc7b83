//! Prints what the stage `optcuts` reaches on the bare surfaces at hand, against the authors' program: length of the seams E_s, distortion
//! E_d, user CPU seconds of a whole process, and the geometric means of the ratios; with every layout tested for overlaps exactly.
//!
//! `cargo bench --bench optcuts [-- PART-OF-A-NAME] [--quality=fast|balanced|best] [--bound=4.1] [--no-bijective] [--search=paper]`; models
//! lie in `meshes` of `INTARSIA_DATA`, or of `../shared/data`. Each model is refined once, by a process of its own, so that its CPU time is its own.

mod common;
mod surfaces;

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use intarsia::asset::{UvSet, read_paths};
use intarsia::atlas::{Charts, Topology, overlaps};
use intarsia::context::Context;
use intarsia::refine::optcuts::params::{MaxDistortion, OptCuts, Quality, Search};
use intarsia::refine::options::{Options, Recipe};
use serde_json::Value;

/// E_s and user CPU seconds of the authors' program (-O3, on a machine with 2 cores under other load), bijective, at a bound of 4.1.
/// Shuffling the faces of a mesh changes E_s by up to 8 %.
#[expect(clippy::approx_constant, reason = "it happens to be near pi")]
const BIJECTIVE: [(&str, f64, f64); 25] = [
    ("bishop_part", 3.579, 1.4),
    ("cathead", 2.387, 0.8),
    ("hand1", 7.519, 4.2),
    ("golf", 3.519, 1.3),
    ("girl1", 4.903, 5.4),
    ("cat", 1.906, 2.2),
    ("sphere_uniRemesh", 3.232, 8.0),
    ("planck_s1", 3.973, 6.6),
    ("bimba", 4.750, 9.4),
    ("venus", 2.462, 3.6),
    ("cone2.0_f1500", 1.336, 3.4),
    ("bunny_decim_noInputUV", 1.833, 6.4),
    ("cow_head", 7.256, 18.0),
    ("planck1", 3.140, 9.2),
    ("hand_1_i_f5000", 5.803, 32.0),
    ("triceratops_param_closed", 9.861, 104.0),
    ("camel_simple", 11.763, 80.0),
    ("octopus_mainComp_f6000", 15.801, 136.0),
    ("bunny", 5.744, 60.0),
    ("horse_f10000", 6.436, 100.0),
    ("armadillo_i_f10000", 5.977, 124.0),
    // It stops at once at surfaces with handles: nothing is said of its time.
    ("torus", 6.70, f64::NAN),
    ("torus_with_hole", 6.21, f64::NAN),
    ("gargoyle_i_f10000", f64::NAN, f64::NAN),
    ("feline_half", f64::NAN, f64::NAN),
];

/// The same at a bound of 4.1, overlaps allowed.
#[expect(clippy::approx_constant, reason = "it happens to be near pi")]
const NOT_BIJECTIVE: [(&str, f64, f64); 15] = [
    ("bimba", 4.230, 2.1),
    ("bishop_part", 3.579, 0.2),
    ("bunny", 4.882, 13.7),
    ("bunny_decim_noInputUV", 1.896, 1.8),
    ("camel_simple", 10.052, 28.9),
    ("cat", 1.906, 0.6),
    ("cathead", 2.241, 0.2),
    ("cow_head", 6.617, 4.9),
    ("girl1", 4.386, 1.2),
    ("golf", 3.480, 0.4),
    ("hand1", 6.837, 1.0),
    ("planck1", 3.140, 3.6),
    ("planck_s1", 3.927, 1.0),
    ("sphere_uniRemesh", 3.232, 1.2),
    ("venus", 2.462, 1.0),
];

/// The same at a bound of 4.05, bijective.
const TIGHT: [(&str, f64, f64); 8] = [
    ("bimba", 7.161, 16.8),
    ("bishop_part", 4.667, 2.2),
    ("bunny_decim_noInputUV", 4.572, 15.8),
    ("cat", 3.319, 3.7),
    ("cathead", 2.785, 0.9),
    ("cow_head", 9.228, 47.7),
    ("planck_s1", 5.631, 7.4),
    ("sphere_uniRemesh", 3.925, 9.2),
];

/// The same at a bound of 4.2, bijective.
const LOOSE: [(&str, f64, f64); 8] = [
    ("bimba", 2.888, 4.4),
    ("bishop_part", 2.406, 0.7),
    ("bunny_decim_noInputUV", 0.761, 7.6),
    ("cat", 1.507, 0.7),
    ("cathead", 2.165, 1.2),
    ("cow_head", 5.512, 8.9),
    ("planck_s1", 2.638, 1.2),
    ("sphere_uniRemesh", 2.531, 1.9),
];

/// How this process, started by itself, is told the one model that it shall refine.
const ONE: &str = "--one=";

fn main() {
    let flags: Vec<String> = std::env::args().skip(1).collect();
    let params = parameters(&flags);
    if let Some(path) = flags.iter().find_map(|f| f.strip_prefix(ONE)) {
        println!("{}", one(Path::new(path), &params));
        return;
    }
    let table = theirs(&params);
    let (folder, models) = common::models(&["meshes"]);
    let filter = common::filter();
    println!("{params:?}");
    println!(
        "{:26} {:>7} | {:>7} {:>7} {:>6} | {:>8} {:>8} {:>6} | {:>7} charts overlaps stopped by",
        "model", "faces", "E_s", "theirs", "ratio", "CPU s", "theirs", "times", "E_d"
    );
    let (mut lengths, mut speeds, mut wrong) = (Vec::new(), Vec::new(), 0);
    for path in models {
        let name = common::short(&path.strip_prefix(&folder).unwrap_or(&path).with_extension("").display().to_string());
        if !name.contains(&filter) {
            continue;
        }
        let Some((found, seconds)) = measured(&path, &flags) else {
            wrong += 1;
            println!("{name:26} failed");
            continue;
        };
        let figure = |key: &str| found[key].as_f64().unwrap_or(f64::NAN);
        let (length, time) = table.iter().find(|t| t.0 == name).map_or((f64::NAN, f64::NAN), |t| (t.1, t.2));
        let (ratio, times) = (figure("seam_length") / length, time / seconds);
        lengths.extend(Some(ratio).filter(|r| r.is_finite()));
        speeds.extend(Some(times).filter(|r| r.is_finite()));
        let bad = found["bound_met"] != true || params.bijective && found["overlaps"] != 0;
        wrong += u32::from(bad);
        println!(
            "{name:26} {:>7} | {:7.3} {length:7.3} {ratio:6.3} | {seconds:8.2} {time:8.1} {times:6.1} | {:7.4} {:>6} {:>8} {}{}",
            found["faces"],
            figure("seam_length"),
            figure("symmetric_dirichlet"),
            found["charts"],
            found["overlaps"],
            found["stopped_by"].as_str().unwrap_or_default(),
            if bad { " WRONG" } else { "" }
        );
    }
    println!(
        "geometric means over {} models: E_s {:.3} of theirs (largest {:.3}), {:.1} times as fast; {wrong} wrong",
        lengths.len(),
        geometric_mean(&lengths),
        lengths.iter().copied().fold(f64::NAN, f64::max),
        geometric_mean(&speeds)
    );
}

/// The figures of the authors' program for these parameters.
fn theirs(params: &OptCuts) -> &'static [(&'static str, f64, f64)] {
    match (params.max_distortion, params.bijective) {
        (MaxDistortion::AtMost(4.1), true) => &BIJECTIVE,
        (MaxDistortion::AtMost(4.1), false) => &NOT_BIJECTIVE,
        (MaxDistortion::AtMost(4.05), true) => &TIGHT,
        (MaxDistortion::AtMost(4.2), true) => &LOOSE,
        _ => &[],
    }
}

fn geometric_mean(values: &[f64]) -> f64 {
    (values.iter().map(|v| v.ln()).sum::<f64>() / values.len() as f64).exp()
}

fn parameters(flags: &[String]) -> OptCuts {
    let value = |name: &str| flags.iter().find_map(|f| f.strip_prefix(name)?.strip_prefix('='));
    OptCuts {
        max_distortion: MaxDistortion::AtMost(value("--bound").and_then(|b| b.parse().ok()).unwrap_or(4.1)),
        bijective: !flags.iter().any(|f| f == "--no-bijective"),
        quality: match value("--quality") {
            Some("fast") => Quality::Fast,
            Some("best") => Quality::Best,
            _ => Quality::Balanced,
        },
        search: if value("--search") == Some("paper") { Search::Paper } else { Search::Default },
        ..OptCuts::default()
    }
}

/// Refines one model in a process of its own: what [`one`] says of it, and the user CPU seconds of that process.
fn measured(path: &Path, flags: &[String]) -> Option<(Value, f64)> {
    let before = children_seconds();
    let own = std::env::current_exe().ok()?;
    let output = Command::new(own).args(flags).arg(format!("{ONE}{}", path.display())).output().ok()?;
    let seconds = children_seconds() - before;
    let text = String::from_utf8_lossy(&output.stdout);
    Some((serde_json::from_str(text.lines().last()?).ok()?, seconds))
}

/// User CPU seconds of the processes that this one started and that have ended; not a number where that cannot be told.
fn children_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // Behind the name, which may hold anything; in hundredths of a second.
    let ticks = stat.rsplit_once(')').and_then(|(_, rest)| rest.split_whitespace().nth(13)?.parse::<f64>().ok());
    ticks.map_or(f64::NAN, |ticks| ticks / 100.0)
}

/// Unwraps a model and says what came of it.
fn one(path: &Path, params: &OptCuts) -> Value {
    let mut options = Options { recipe: Recipe::Preset("unwrap".to_owned()), ..Options::preset("unwrap") };
    options.stages.set(OptCuts { start: options.stages.get::<OptCuts>().start, ..params.clone() });
    let mut files = read_paths(&[path.to_owned()]).expect("a model");
    files.iter_mut().filter(|f| f.path.ends_with(".obj")).for_each(|f| f.bytes = vertices_apart(&f.bytes));
    let (outcome, _) = common::run(files, &options, &Context::silent()).expect("a layout");
    let model = outcome.artifacts.iter().find(|a| a.role == "model").expect("a model");
    let set = outcome.report["atlases"][0]["uv_sets"][0].as_u64().and_then(|set| u32::try_from(set).ok());
    let set = UvSet::Number(set.expect("a layout of its own"));
    let atlas = surfaces::written(model.bytes.clone(), set).expect("the model reads");
    let charts = Charts::new(&Topology::new(&atlas));
    let found = overlaps(&atlas, &charts, 1000);
    let deep =
        |pair: &&(_, _)| intarsia::atlas::penetration(&atlas.uv_triangle(pair.0), &atlas.uv_triangle(pair.1)) > 1e-4;
    let mut figures = outcome.report["stages"][0].clone();
    figures["faces"] = atlas.face_count().into();
    // In texels of 1024: what 32 bits round is no overlap.
    figures["overlaps"] = found.intra.iter().chain(&found.inter).filter(deep).count().into();
    figures
}

/// An OBJ file in which no two vertices are at one place. The authors' program knows vertices by their number: where two stand at one place its surface is
/// open, and what is told of it is told of that surface. Each further one is moved by a millionth of the extent for each that it is.
fn vertices_apart(obj: &[u8]) -> Vec<u8> {
    let text = String::from_utf8_lossy(obj);
    let extent = text.lines().filter_map(surfaces::vertex).flatten().fold(0.0, |most: f64, x| most.max(x.abs()));
    let mut known: BTreeMap<[u64; 3], u32> = BTreeMap::new();
    let mut line = |line: &str| {
        let Some([x, y, z]) = surfaces::vertex(line) else { return format!("{line}\n") };
        let count = known.entry([x, y, z].map(f64::to_bits)).or_default();
        *count += 1;
        format!("v {} {y} {z}\n", x + f64::from(*count - 1) * 1e-6 * extent)
    };
    text.lines().map(&mut line).collect::<String>().into_bytes()
}
