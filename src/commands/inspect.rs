//! `intarsia inspect`: the figures of every atlas in a model.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use intarsia::asset::{Demand, File, estimate};
use intarsia::config::Inspect;
use intarsia::context::Context;
use intarsia::error::{Code, Failure, Result};
use intarsia::metrics::Requirement;
use intarsia::refine::inspect_and_judge;
use intarsia::refine::run::Input;

use super::progress::Teller;
use super::table;

/// Measures and tells; exit code 4 where a requirement is not met, or there is a warning that `strict` names.
pub fn run(arguments: &Inspect) -> Result<()> {
    let mut options = super::read_options(&arguments.options, None)?;
    for text in &arguments.require {
        let (path, bound) = bound(text)?;
        let entry = options.require.entry(path).or_default();
        entry.min = bound.min.or(entry.min);
        entry.max = bound.max.or(entry.max);
    }
    let input = super::read_input(&arguments.input, &options)?;
    let pool = intarsia::jobs::slots::pool(arguments.threads)?;
    if arguments.memory {
        return super::print(&format!(
            "{}\n",
            memory(arguments, &input, options.demand(), pool.current_num_threads())?
        ));
    }
    let context = Context::new(Arc::new(Teller::Quiet), Arc::new(AtomicBool::new(false)), options.seed);
    let (report, verdict) = pool.install(|| inspect_and_judge(&input, &options, &context))?;
    let columns = table::columns(&report, "before");
    let text = if arguments.json { super::pretty(&report) } else { table::render(&columns) };
    super::print(&text)?;
    super::judge(&verdict, "")
}

/// The estimate for all models together, each with its files where they lie.
fn memory(arguments: &Inspect, input: &Input, demand: Demand, threads: usize) -> Result<u64> {
    let folders: Vec<&Path> = arguments.input.iter().map(|p| p.parent().unwrap_or(Path::new(""))).collect();
    let mut sum = 0u64;
    for files in &input.models {
        let place = |file: &File| folders.iter().map(|f| f.join(&file.path)).find(|p| p.is_file()).unwrap_or_default();
        let files: Vec<(&str, PathBuf)> = files.iter().map(|file| (file.path.as_str(), place(file))).collect();
        let files: Vec<(&str, &Path)> = files.iter().map(|(name, path)| (*name, path.as_path())).collect();
        let Some((model, files)) = files.split_first() else { continue };
        sum = sum.saturating_add(estimate(*model, files, &input.limits, threads, demand)?.bytes);
    }
    Ok(sum)
}

/// `PATH>=N` or `PATH<=N` as a requirement.
fn bound(text: &str) -> Result<(String, Requirement)> {
    let wrong = || {
        let message =
            format!("`{text}` is no bound such as atlas.packing_efficiency>=0.8 or model.texture_pixels<=1e6");
        Failure::new(Code::InvalidRequest, message)
    };
    let parts = text.split_once(">=").map(|p| (p, true)).or_else(|| text.split_once("<=").map(|p| (p, false)));
    let ((path, number), at_least) = parts.ok_or_else(wrong)?;
    let value: f64 = number.trim().parse().ok().filter(|n: &f64| n.is_finite()).ok_or_else(wrong)?;
    let requirement = match at_least {
        true => Requirement { min: Some(value), ..Requirement::default() },
        false => Requirement { max: Some(value), ..Requirement::default() },
    };
    Ok((path.trim().to_owned(), requirement))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_requirements() {
        let min = |v| Requirement { min: Some(v), ..Requirement::default() };
        assert_eq!(bound("atlas.x >= 0.5"), Ok(("atlas.x".to_owned(), min(0.5))));
        assert_eq!(bound("model.y<=1e2").map(|b| b.1.max), Ok(Some(100.0)));
        for wrong in ["atlas.x=1", "atlas.x>=nan", "atlas.x"] {
            assert_eq!(bound(wrong).unwrap_err().code, Code::InvalidRequest, "{wrong}");
        }
    }
}
