//! Prints Table 1 of *Texture Defragmentation* on the scans at hand: the published loop, its parameters and the parts of its appeal
//! varied, and our own search, each against the input and against the published loop; then what a chart costs on samples with 500 to
//! 10,000 of them.
//!
//! `cargo bench --bench defrag [-- PART-OF-A-NAME]`; scans lie in `INTARSIA_DATA`, or in `../shared/data`. The name `sample` leaves out
//! the first table, that of a scan the second.

mod common;

use common::{filter, run, short};
use intarsia::asset::sample::sample;
use intarsia::asset::{File, read_paths};
use intarsia::context::Context;
use intarsia::packing::Gutter;
use intarsia::refine::defrag::params::{Appeal, Defrag, Search};
use intarsia::refine::options::{IfLarger, Options};
use serde_json::Value;

/// Columns of the table: how each is called, and how wide it is.
const COLUMNS: [(&str, usize); 6] =
    [("s", 8), ("resampled", 10), ("replication", 12), ("texture", 9), ("solidity", 9), ("charts", 8)];

/// A row's figures, in the order of the columns; NaN where there is none.
type Row = [f64; 6];

fn main() {
    let filter = filter();
    ablation(&filter);
    if !"sample".contains(&filter) {
        return;
    }
    println!("\n{:12} {:>7} {:>7} {:>8} {:>12}", "sample", "charts", "to", "s", "ms a chart");
    for name in ["scan", "scan_2000", "scan_10000", "scan_20000", "scan_50000"] {
        let Ok(glb) = sample(name) else { continue };
        let files = vec![File { path: "scan.glb".to_owned(), bytes: glb }];
        match defragment(files, &Defrag::default()) {
            Err(error) => println!("{name:12} {error}"),
            Ok((report, seconds)) => {
                let [before, after] = ["before", "after"].map(|when| figure(&report, when, "charts"));
                println!("{name:12} {before:7} {after:7} {seconds:8.2} {:12.3}", 1e3 * seconds / before);
            }
        }
    }
}

/// The rows of Table 1, the one that the others are measured against first; then our own.
fn variants() -> Vec<(&'static str, Defrag)> {
    let paper = || Defrag { search: Search::Paper, ..Defrag::default() };
    vec![
        ("baseline", paper()),
        ("alpha = 2.5", Defrag { alpha: Some(2.5), ..paper() }),
        ("alpha = 10", Defrag { alpha: Some(10.0), ..paper() }),
        ("NoRetry", Defrag { retry: false, ..paper() }),
        ("NoBC", Defrag { appeal: Appeal::NoBenefitCost, ..paper() }),
        ("NoSB", Defrag { appeal: Appeal::NoSizeBonus, ..paper() }),
        ("Random", Defrag { appeal: Appeal::Random, ..paper() }),
        ("search: partial", Defrag::default()),
    ]
}

fn ablation(filter: &str) {
    let (folder, models) = common::models(&["scans"]);
    let variants = variants();
    // By variant: the rows of the scans.
    let mut rows: Vec<Vec<Row>> = vec![Vec::new(); variants.len()];
    for path in models {
        let name = path.strip_prefix(&folder).unwrap_or(&path).display().to_string();
        let Ok(files) = read_paths(std::slice::from_ref(&path)) else { continue };
        if !name.contains(filter) {
            continue;
        }
        println!("\n{}", heading(&short(&name)));
        for ((variant, params), rows) in variants.iter().zip(&mut rows) {
            match defragment(files.clone(), params) {
                Err(error) => {
                    println!("{variant:28} {error}");
                    rows.push([f64::NAN; 6]);
                }
                Ok((report, seconds)) => {
                    let row = changes(&report, seconds);
                    println!("{variant:28}{}", changes_in_words(&row, false));
                    rows.push(row);
                }
            }
        }
    }
    let count = rows[0].len();
    if count < 2 {
        return;
    }
    println!("\n{}", heading(&format!("mean of {count}, over the input")));
    for ((variant, _), rows) in variants.iter().zip(&rows) {
        println!("{variant:28}{}", changes_in_words(&mean(rows), false));
    }
    println!("\n{}", heading("the same, over the baseline"));
    for ((variant, _), own) in variants.iter().zip(&rows).skip(1) {
        let over: Vec<Row> = own.iter().zip(&rows[0]).map(|(row, baseline)| relative(row, baseline)).collect();
        println!("{variant:28}{}", changes_in_words(&mean(&over), true));
    }
}

fn heading(title: &str) -> String {
    let titles: String = COLUMNS.iter().map(|(name, width)| format!("{name:>width$}")).collect();
    format!("{title:28.28}{titles}")
}

/// Seconds are seconds where rows stand for themselves; all else is a change in percent.
fn changes_in_words(row: &Row, over_another: bool) -> String {
    let cell = |i: usize| match i {
        0 if !over_another => format!("{:>1$.1}", row[0], COLUMNS[0].1),
        _ => format!("{:>+1$.1}%", 100.0 * row[i], COLUMNS[i].1 - 1),
    };
    (0..row.len()).map(cell).collect()
}

/// What became of a scan: seconds, part of the surface resampled, and relative changes.
fn changes(report: &Value, seconds: f64) -> Row {
    let change = |key: &str| figure(report, "after", key) / figure(report, "before", key) - 1.0;
    [
        seconds,
        figure(report, "after", "resampled_area"),
        change("vertex_replication"),
        change("texture_pixels"),
        change("solidity"),
        change("charts"),
    ]
}

/// A row relative to another: what each figure has become, and not by how much it changed.
fn relative(row: &Row, baseline: &Row) -> Row {
    let mut over = [f64::NAN; 6];
    for (i, over) in over.iter_mut().enumerate() {
        // Seconds and resampled area are figures, the others changes of one.
        let whole = |x: f64| if i < 2 { x } else { 1.0 + x };
        let ratio = whole(row[i]) / whole(baseline[i]);
        *over = if whole(baseline[i]) > 0.0 { ratio - 1.0 } else { f64::NAN };
    }
    over
}

/// Column by column, over the rows that have a figure.
fn mean(rows: &[Row]) -> Row {
    let mut means = [f64::NAN; 6];
    for (i, mean) in means.iter_mut().enumerate() {
        let known: Vec<f64> = rows.iter().map(|r| r[i]).filter(|x| x.is_finite()).collect();
        *mean = known.iter().sum::<f64>() / known.len() as f64;
    }
    means
}

/// The report on a scan, and the seconds in the stage (merging and packing).
fn defragment(files: Vec<File>, params: &Defrag) -> Result<(Value, f64), String> {
    let mut options = Options::preset("scan");
    options.pack.gutter = Gutter::Texels(8);
    options.atlas.if_larger = IfLarger::Accept;
    options.stages.set(params.clone());
    let context = Context::silent();
    let (outcome, _) = run(files, &options, &context)?;
    let seconds = context.timings().iter().filter(|t| t.stage == "defrag").map(|t| t.seconds).sum();
    Ok((outcome.report, seconds))
}

fn figure(report: &Value, when: &str, key: &str) -> f64 {
    report["model"][when][key].as_f64().unwrap_or(f64::NAN)
}
