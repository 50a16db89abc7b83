//! Prints what Box Cutter reaches on every model at hand: packing efficiency at boundary lengths of 130, 150 and 200 % of the
//! overlap-free start; the published loop with void boxes and with random lines (the experiment of section 5); cuts along edges;
//! and how overlap removal lengthens the boundary, against cutting along projected outlines.
//!
//! `cargo bench --bench box_cutter [-- PART-OF-A-NAME]`; models lie in `INTARSIA_DATA`, or in `../shared/data`.

mod common;
mod outlines;

use common::{filter, run, short};
use intarsia::asset::{File, read_paths};
use intarsia::atlas::OverlapMode;
use intarsia::context::Context;
use intarsia::packing::{Gutter, Rotation};
use intarsia::refine::box_cutter::params::{BoxCutter, Cuts, Search};
use intarsia::refine::options::{IfLarger, Options, Recipe};
use outlines::remove_overlaps_along_outlines;
use serde_json::Value;

const BUDGETS: [f64; 3] = [1.3, 1.5, 2.0];

fn main() {
    let filter = filter();
    let (folder, models) = common::models(&["pbr", "scans", "uv"]);
    println!(
        "{:28} | PE, boundary %, s at 130 | 150 | 200 % | paper PE at 130 150 200 % | random lines | along edges at 130 % | overlaps: boundary after removal and welding, along outlines",
        "model"
    );
    let mut sums = vec![Vec::new(); 13];
    for path in models {
        let name = path.strip_prefix(&folder).unwrap_or(&path).display().to_string();
        let Ok(files) = read_paths(std::slice::from_ref(&path)) else { continue };
        if !name.contains(&filter) {
            continue;
        }
        let mut line = format!("{:28}", short(&name).chars().take(28).collect::<String>());
        let mut at = 0;
        let mut add = |sums: &mut Vec<Vec<f64>>, value: f64| {
            sums[at].push(value);
            at += 1;
        };
        let mut first = None;
        for budget in BUDGETS {
            let Some(found) = cut(&files, budget, Search::Beam, Cuts::Straight) else { continue };
            line += &format!(" | {:.3} {:4.0} {:5.1}", found.efficiency, 100.0 * found.boundary, found.seconds);
            add(&mut sums, found.efficiency);
            add(&mut sums, found.seconds);
            first.get_or_insert(found);
        }
        let Some(first) = first else { continue };
        for search in [Search::Paper, Search::Random] {
            line += " |";
            for budget in BUDGETS {
                let efficiency = cut(&files, budget, search, Cuts::Straight).map_or(f64::NAN, |f| f.efficiency);
                line += &format!(" {efficiency:.3}");
                add(&mut sums, efficiency);
            }
        }
        let edges = cut(&files, 1.3, Search::Beam, Cuts::Edges).map_or(f64::NAN, |f| f.efficiency);
        line += &format!(" | {edges:.3}");
        add(&mut sums, edges);
        if first.overlapping > 0.0 {
            line += &format!(" | {:+.3} {:+.3}", first.overlap_free - 1.0, along_outlines(&files));
        }
        println!("{line}");
    }
    let means: Vec<String> = sums
        .iter()
        .map(|s| {
            let known: Vec<f64> = s.iter().copied().filter(|x| x.is_finite()).collect();
            format!("{:.3}", known.iter().sum::<f64>() / known.len().max(1) as f64)
        })
        .collect();
    println!("means in the order of the columns, overlaps apart: {}", means.join(" "));
}

struct Found {
    efficiency: f64,
    /// Boundary length after the cuts over that of the overlap-free start.
    boundary: f64,
    seconds: f64,
    /// Charts that overlapped themselves, and the boundary length without these overlaps over the input's.
    overlapping: f64,
    overlap_free: f64,
}

fn cut(files: &[File], budget: f64, search: Search, cuts: Cuts) -> Option<Found> {
    let mut options = Options { recipe: Recipe::Preset("box_cutter".to_owned()), ..Options::default() };
    options.pack.rotation = Rotation::Any;
    options.pack.gutter = Gutter::Texels(0);
    options.atlas.overlaps = OverlapMode::Separate;
    options.atlas.if_larger = IfLarger::Accept;
    options.stages.set(BoxCutter { max_boundary_length: Some(budget), search, cuts, ..BoxCutter::default() });
    let (outcome, seconds) = run(files.to_vec(), &options, &Context::silent()).ok()?;
    let stage = &outcome.report["stages"][0];
    let figure = |value: &Value| value.as_f64();
    Some(Found {
        efficiency: figure(&outcome.report["model"]["after"]["packing_efficiency"])?,
        boundary: figure(&stage["boundary_length_ratio"])?,
        seconds,
        overlapping: figure(&stage["overlapping_charts"]).unwrap_or(0.0),
        overlap_free: figure(&stage["overlap_free_length_ratio"]).unwrap_or(1.0),
    })
}

/// How cutting along projected outlines lengthens the boundary of the model's first atlas.
fn along_outlines(files: &[File]) -> f64 {
    let context = Context::silent();
    let cut = || {
        let (doc, _) = intarsia::asset::load(files, None, &intarsia::asset::Limits::default()).ok()?;
        let index = intarsia::asset::MaterialIndex::new(&doc).ok()?;
        let sets = intarsia::asset::read(&doc, &index, Options::default().atlas.reading(), &context).ok()?;
        let atlas = &sets.first()?.atlas;
        let after = remove_overlaps_along_outlines(atlas);
        Some(border(&after) / border(atlas) - 1.0)
    };
    cut().unwrap_or(f64::NAN)
}

fn border(atlas: &intarsia::atlas::Atlas) -> f64 {
    let topology = intarsia::atlas::Topology::new(atlas);
    let open = topology.half_edges().filter(|h| topology.is_border(*h));
    let end = |f: intarsia::atlas::FaceId, k: usize| atlas.uv[atlas.corners[f.index()][k].index()];
    open.map(|h| end(h.face(), h.corner()).distance(end(h.face(), h.end_corner()))).sum()
}
