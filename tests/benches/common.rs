//! What the benchmarks share: the models at hand, and the line that says where figures come from.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use intarsia::asset::File;
use intarsia::context::Context;
use intarsia::refine::options::Options;
use intarsia::refine::{Input, Outcome, refine};

/// The folder of the models, and those in its parts, sorted; empty with a word on the output where there are none.
pub fn models(parts: &[&str]) -> (PathBuf, Vec<PathBuf>) {
    let folder = std::env::var_os("INTARSIA_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    let mut models = Vec::new();
    for part in parts {
        collect(&folder.join(part), &mut models);
    }
    models.sort();
    if models.is_empty() {
        println!("skipped: no models at hand (set INTARSIA_DATA)");
    } else {
        println!("machine {} | commit {} | seed 0", machine(), commit());
    }
    (folder, models)
}

/// The last argument that is no flag.
pub fn filter() -> String {
    std::env::args().skip(1).find(|a| !a.starts_with("--")).unwrap_or_default()
}

/// The name without its first folder, cut short.
pub fn short(name: &str) -> String {
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

/// Refines a model; the result and the seconds. `context` knows those of each stage.
pub fn run(files: Vec<File>, options: &Options, context: &Context) -> Result<(Outcome, f64), String> {
    let start = Instant::now();
    let input = Input { models: vec![files], ..Input::default() };
    let outcome = refine(&input, options, context).map_err(|e| e.to_string())?;
    Ok((outcome, start.elapsed().as_secs_f64()))
}
