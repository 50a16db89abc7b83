//! `intarsia refine`: from file to file.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use intarsia::config::Refine;
use intarsia::context::Context;
use intarsia::error::{Code, Failure, Result};
use intarsia::http::page;
use intarsia::refine::options::Container;
use intarsia::refine::run::{Artifact, Input, Outcome, refine};
use serde_json::Value;

use super::progress::Teller;
use super::table;

/// Figures of the summary.
const SUMMARY: [&str; 5] = ["charts", "packing_efficiency", "utilisation", "texture_pixels", "texture_bytes"];

/// Refines, writes, tells.
pub fn run(arguments: &Refine) -> Result<()> {
    let output = container(&arguments.output)?;
    super::check_output(&arguments.output)?;
    arguments.report.iter().chain(&arguments.html).try_for_each(|path| super::check_output(path))?;
    arguments.pictures.iter().try_for_each(|path| super::check_output_folder(path))?;
    let options = super::read_options(&arguments.options, Some(output))?;
    let input = Input {
        extras: arguments.pictures.is_some() || arguments.html.is_some(),
        ..super::read_input(&arguments.input, &options)?
    };
    let limit = options.time_limit_s.and_then(|s| Duration::try_from_secs_f64(s).ok());
    let teller = Arc::new(Teller::new(arguments.quiet));
    let context = Context::new(teller.clone(), Arc::new(AtomicBool::new(false)), options.seed).with_time_limit(limit);
    let pool = intarsia::jobs::slots::pool(arguments.threads)?;
    let outcome = pool.install(|| refine(&input, &options, &context));
    teller.end();
    let outcome = outcome?;

    let written = write_models(arguments, &input, &outcome)?;
    if let Some(path) = &arguments.report {
        super::write(path, super::pretty(&outcome.report).as_bytes())?;
    }
    if let Some(folder) = &arguments.pictures {
        write_pictures(folder, &outcome)?;
    }
    if let Some(path) = &arguments.html {
        let preview = outcome.artifacts.iter().find(|a| a.role == "preview");
        let preview = preview.ok_or_else(|| Failure::internal("the result has no preview"))?;
        super::write(path, page::standalone(&outcome.report, &preview.bytes)?.as_bytes())?;
    }
    if arguments.json {
        super::print(&super::pretty(&outcome.report))?;
    }
    if !arguments.quiet {
        eprint!("{}", summary(&outcome.report));
        let times: Vec<String> = context.timings().iter().map(|t| format!("{} {:.2} s", t.stage, t.seconds)).collect();
        eprintln!("{}", times.join(", "));
        for (path, bytes) in written {
            eprintln!("wrote {} ({bytes} bytes)", path.display());
        }
    }
    super::judge(&outcome.verdict, "; the output is written all the same")
}

/// The container that the output's name asks for.
fn container(path: &Path) -> Result<Container> {
    match path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).as_deref() {
        Some("glb") => Ok(Container::Glb),
        Some("gltf") => Ok(Container::Gltf),
        Some("b3dm") => Ok(Container::B3dm),
        Some("i3dm") => Ok(Container::I3dm),
        _ => {
            let text = format!(
                "the output {} is no model: its name ends in .glb or .gltf, or as the input's in .b3dm or .i3dm",
                path.display()
            );
            Err(Failure::new(Code::InvalidRequest, text))
        }
    }
}

/// Writes the models under the name of the output, several as NAME-0, NAME-1, … in the order of the input, the files that a .gltf names beside it. These go first, so that a
/// model is never there without them.
fn write_models(arguments: &Refine, input: &Input, outcome: &Outcome) -> Result<Vec<(PathBuf, usize)>> {
    let output = &arguments.output;
    let extension = output.extension().unwrap_or_default();
    let folder = output.parent().unwrap_or(Path::new(""));
    let is_model = |a: &&Artifact| {
        a.role == "model" && Path::new(&a.name).extension().is_some_and(|e| e.eq_ignore_ascii_case(extension))
    };
    let models: Vec<&Artifact> = outcome.artifacts.iter().filter(is_model).collect();
    if models.is_empty() {
        return Err(Failure::internal("the result has no model"));
    }
    let mut plan: Vec<(PathBuf, &Artifact)> = Vec::new();
    if extension.eq_ignore_ascii_case("gltf") {
        let side =
            |a: &&Artifact| matches!(a.role.as_str(), "model" | "side_file" | "buffer" | "image") && !is_model(a);
        for artifact in outcome.artifacts.iter().filter(side) {
            let path = folder.join(&artifact.name);
            if is_input(arguments, input, &path) {
                let message =
                    format!("{} would overwrite a file of the input; write to another folder", path.display());
                return Err(Failure::new(Code::InvalidRequest, message));
            }
            plan.push((path, artifact));
        }
    }
    for (i, model) in models.iter().enumerate() {
        let path = if models.len() == 1 {
            output.clone()
        } else {
            let stem = output.file_stem().unwrap_or_default().to_string_lossy();
            output.with_file_name(format!("{stem}-{i}.{}", extension.to_string_lossy()))
        };
        plan.push((path, model));
    }
    let stem = output.file_stem().unwrap_or_default().to_string_lossy();
    let panels = outcome.artifacts.iter().filter(|a| a.role == "fabrication");
    plan.extend(panels.map(|a| (output.with_file_name(format!("{stem}.{}", a.name)), a)));
    let mut written = Vec::new();
    for (path, artifact) in plan {
        if let Some(folder) = path.parent().filter(|f| *f != folder) {
            fs::create_dir_all(folder).map_err(|e| Failure::internal(format!("{}: {e}", folder.display())))?;
        }
        super::write(&path, &artifact.bytes)?;
        written.push((path, artifact.bytes.len()));
    }
    Ok(written)
}

/// Whether writing `path` would destroy a file that the input was read from.
fn is_input(arguments: &Refine, input: &Input, path: &Path) -> bool {
    let Ok(target) = path.canonicalize() else { return false };
    let folders = arguments.input.iter().map(|p| p.parent().unwrap_or(Path::new("")));
    let same = |read: PathBuf| read.canonicalize().is_ok_and(|r| r == target);
    arguments.input.iter().cloned().any(same)
        || folders.flat_map(|f| input.models.iter().flatten().map(move |file| f.join(&file.path))).any(same)
}

fn write_pictures(folder: &Path, outcome: &Outcome) -> Result<()> {
    fs::create_dir_all(folder).map_err(|e| Failure::internal(format!("{}: {e}", folder.display())))?;
    for artifact in outcome.artifacts.iter().filter(|a| a.role == "picture") {
        let name = Path::new(&artifact.name).file_name().unwrap_or_default();
        super::write(&folder.join(name), &artifact.bytes)?;
    }
    Ok(())
}

/// What was gained, in a few lines.
fn summary(report: &Value) -> String {
    let (before, after) = (table::columns(report, "before"), table::columns(report, "after"));
    let mut out = report["outcome"].as_str().map(|word| format!("outcome: {word}\n")).unwrap_or_default();
    for (before, after) in before.iter().zip(&after) {
        let change = |name: &str| {
            let (old, new) = (before.figures.get(name)?, after.figures.get(name)?);
            Some(format!("{name} {} → {}", table::figure(old), table::figure(new)))
        };
        let changes: Vec<String> = SUMMARY.iter().filter_map(|name| change(name)).collect();
        if !changes.is_empty() {
            out.push_str(&format!("{}: {}\n", before.name.trim(), changes.join(", ")));
        }
    }
    out
}
