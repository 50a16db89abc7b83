//! The stage `bounded`: Liu, Fu, Ye, Chai and Liu 2019, *Atlas Refinement with Bounded Packing Efficiency*.
//!
//! Charts become disks ([`prepare`]) and then axis-aligned ([`construct`]: target angles in [`angles`], deformation in [`deform`]); straight trails
//! divide them ([`arrangement`]), of which those are cut ([`decomposition`], [`cut`]) that let the boxes about the parts pack as tightly as is
//! asked for; then the parts take back what shape the bound allows ([`reduce`]).

mod angles;
mod arrangement;
mod chart_map;
mod construct;
mod cut;
mod decomposition;
mod deform;
mod layer;
pub mod params;
mod prepare;
mod reduce;
mod sheet;
mod subdivide;
#[cfg(test)]
mod tests;

use glam::DVec2;
use rayon::prelude::*;
use serde_json::{Map, Value, json};

use self::construct::{Constructed, Construction, construct};
use self::decomposition::{Goal, search};
use self::params::{Bounded, Energy, Search};
use self::prepare::{NO_DISK, Prepared, Target, prepare};
use self::reduce::{Reduction, reduce};
use self::sheet::assemble;
use super::pack::{finished, lay_out};
use super::stage::{StageInput, Staged};
use crate::atlas::{Atlas, Charts, FaceId, OverlapMode, Topology, clusters, coverage};
use crate::error::{Result, Warning};
use crate::packing::{Random, RectangleRequest};

/// What corners cost in the constructions that are tried, in parts of the square root of a chart's area: few corners first.
const CORNERS: [f64; 2] = [0.02, 0.0025];
/// Packing efficiency of the boxes beyond the bound: what reduction may use up. In the order in which they are tried.
const SLACK: [f64; 3] = [0.04, 0.08, 0.13];
/// Highest packing efficiency that boxes are searched for.
const TIGHTEST: f64 = 0.985;
/// How much more distortion than in the input is no more, relative to it.
const AS_GOOD: f64 = 5e-4;
/// Rounds of reduction, and steps in each.
const ROUNDS: usize = 30;
const STEPS: usize = 2;
/// Widths of the box that are tried for each division, and for the final packing.
const WIDTHS: usize = 5;
const FINAL_WIDTHS: usize = 48;

/// An attempt.
struct Attempt {
    atlas: Atlas,
    efficiency: f64,
    distortion: f64,
    cut: f64,
    pieces: usize,
    fallbacks: usize,
    steps: usize,
}

/// Deforms, cuts, packs and relaxes.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(crate) fn bounded(input: &StageInput<'_>, params: &Bounded) -> Result<Staged> {
    let StageInput { atlas, sheet_info, options, context, .. } = *input;
    let charts = Charts::new(&Topology::new(atlas));
    let together = clusters(atlas, &charts, options.atlas.overlaps);
    let is_held = |f: FaceId| together.charts[together.of_chart[charts.of_face[f.index()].index()] as usize].len() > 1;
    let held: Vec<bool> = atlas.faces().map(is_held).collect();
    let cluster: Vec<u32> = atlas
        .faces()
        .map(|f| if held[f.index()] { together.of_chart[charts.of_face[f.index()].index()] } else { NO_DISK })
        .collect();
    let bound = params.packing_efficiency;

    // What can be packed well enough as it is stays as it is.
    context.step(0.02, "packing the charts as they are")?;
    if charts.len() > 1 {
        let (packed, work) = lay_out(input, &[], &[], 1.0)?;
        let efficiency = efficiency(&packed);
        if efficiency >= bound {
            let figures = Map::from_iter([
                ("work".to_owned(), Value::from(work)),
                ("packing_efficiency".to_owned(), json!(efficiency)),
                ("bound_met".to_owned(), json!(true)),
            ]);
            return Ok(finished(input, packed, "bound_met_as_it_is", figures));
        }
    }
    context.step(0.1, "opening charts into disks")?;
    let interrupt = || context.check();
    let prepared = prepare(atlas, &held, &interrupt)?;
    let target = match params.energy {
        Energy::Surface => Target::Surface,
        Energy::Uploaded => Target::Uploaded,
    };
    let before = distortion_of(&prepared, target);
    let seams = seam_length(atlas);
    let mut attempts: Vec<Attempt> = Vec::new();
    let mut work = 0;
    let total = CORNERS.len() * SLACK.len();
    'tries: for (k, corner) in CORNERS.into_iter().enumerate() {
        context.step(0.15 + 0.8 * k as f64 / CORNERS.len() as f64, "making charts axis-aligned")?;
        let how = Construction { sigma: params.sigma, corner, target };
        let constructed = construct(&prepared, &how, &|_, _| 1.0, &interrupt)?;
        let slacks: &[f64] = if params.search == Search::Paper { &SLACK[1..2] } else { &SLACK };
        for (s, slack) in slacks.iter().enumerate() {
            let done = (k * SLACK.len() + s) as f64 / total as f64;
            context.step(0.2 + 0.75 * done, "dividing, packing and relaxing")?;
            let goal = (bound + slack).min(TIGHTEST);
            let attempt = attempt(input, params, &constructed, &cluster, goal, [seams, before])?;
            work += attempt.steps as u64 * attempt.atlas.uv.len() as u64;
            let is_good = attempt.efficiency >= bound && attempt.distortion <= before * (1.0 + AS_GOOD);
            attempts.push(attempt);
            if is_good || context.out_of_time() {
                break 'tries;
            }
        }
    }
    let allowed = params.max_boundary_length.map_or(f64::INFINITY, |most| (most - 1.0) * seams);
    // The bound first, then the limit on seams, then distortion and seams together.
    let value = |a: &Attempt| {
        let missing = (bound - a.efficiency).max(0.0);
        let over = (a.cut - allowed).max(0.0) / seams.max(1e-300);
        let worse = (a.distortion / before - 1.0 - AS_GOOD).max(0.0);
        (missing, over, 5.0 * worse + a.cut / seams.max(1e-300))
    };
    let best = attempts.into_iter().min_by(|a, b| {
        let (a, b) = (value(a), value(b));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.total_cmp(&b.2))
    });
    let Some(best) = best else {
        return Ok(Staged { atlas: atlas.clone(), stopped_by: "nothing_to_pack", figures: Map::new(), kept: true });
    };
    let bound_met = best.efficiency >= bound;
    if !bound_met {
        let text = format!(
            "the packing efficiency of atlas {} is {:.4}; {bound} was asked for, and with its gutters no layout that was tried reaches that",
            sheet_info.id, best.efficiency
        );
        context.warn(Warning::new("bound_not_met", text));
    }
    let figures = Map::from_iter([
        ("work".to_owned(), json!(work)),
        ("packing_efficiency".to_owned(), json!(best.efficiency)),
        ("bound_met".to_owned(), json!(bound_met)),
        ("distortion_before".to_owned(), json!(before)),
        ("distortion".to_owned(), json!(best.distortion)),
        ("pieces".to_owned(), json!(best.pieces)),
        ("opened_charts".to_owned(), json!(prepared.opened)),
        ("flattened_charts".to_owned(), json!(prepared.flattened)),
        ("rectangle_fallbacks".to_owned(), json!(best.fallbacks)),
    ]);
    let stopped_by = if bound_met { "done" } else { "bound_not_met" };
    Ok(finished(input, best.atlas, stopped_by, figures))
}

/// Divides the charts of a construction, packs the parts, and relaxes them.
fn attempt(
    input: &StageInput<'_>,
    params: &Bounded,
    constructed: &Constructed,
    cluster: &[u32],
    goal: f64,
    [seams, before]: [f64; 2],
) -> Result<Attempt> {
    let context = input.context;
    let gap = sheet::gap(input);
    let charts: Vec<_> = constructed.disks.iter().map(|d| d.arrangement.clone()).collect();
    let diagonal = bounds(input.atlas).length();
    let padding = gap.max(params.padding * diagonal);
    let aspect = sheet::aspect(input);
    let wanted = Goal {
        efficiency: goal,
        padding,
        seams: seams.max(1e-3 * diagonal),
        request: RectangleRequest { turns: sheet::turns(input), aspect, widths: WIDTHS },
        tries: params.candidates as usize,
        is_published: params.search == Search::Paper,
    };
    let mut mesh = constructed.mesh.clone();
    let mut labels = constructed.labels.clone();
    if let Some(chosen) = search(&charts, &wanted, &mut Random::stream(context.seed, 0)) {
        for ((own, division), d) in constructed.disks.iter().zip(&chosen.divisions).zip(0..) {
            context.check()?;
            cut::cut_chart(&mut mesh, &own.map, &own.arrangement, division, &mut labels, d);
        }
    }
    let final_request = RectangleRequest { widths: FINAL_WIDTHS, ..wanted.request };
    let mut packed = sheet::pack(&mesh, &labels, constructed, cluster, [padding, gap], &final_request);
    let mut steps = 0;
    let mut distortion = packed.charts.energy();
    if !params.keep_mapping && packed.charts.has_layers {
        let goal = Reduction {
            efficiency: params.packing_efficiency,
            enough: if params.stop_at_input { before } else { 0.0 },
            gap,
            rounds: ROUNDS,
            steps: STEPS,
        };
        let reduced = reduce(&mut packed.charts, &goal, &|| context.check())?;
        (steps, distortion) = (reduced.steps, reduced.energy);
    }
    let efficiency = packed.charts.efficiency();
    let pieces = packed.pieces.len();
    let fallbacks = constructed.disks.iter().filter(|d| d.is_fallback).count();
    let cut = (seam_length(mesh.atlas()) - seams).max(0.0);
    let atlas = assemble(input, &mesh, &packed);
    Ok(Attempt { atlas, efficiency, distortion, cut, pieces, fallbacks, steps })
}

/// The distortion of all disks as they are, by their area.
fn distortion_of(prepared: &Prepared, target: Target) -> f64 {
    let own: Vec<(f64, f64)> = prepared
        .disks
        .par_iter()
        .filter_map(|d| {
            let map = prepared.map(d, target)?;
            let energy = map.distortion();
            energy.is_finite().then_some((energy * d.area, d.area))
        })
        .collect();
    let (sum, area) = own.iter().fold((0.0, 0.0), |(s, a), (x, y)| (s + x, a + y));
    if area > 0.0 { sum / area } else { 1.0 }
}

/// Length of the seams on the surface, each once, its boundary apart.
fn seam_length(atlas: &Atlas) -> f64 {
    super::optcuts::seam_length(atlas)
}

/// Area covered over area of the box about all charts, over all pages.
fn efficiency(atlas: &Atlas) -> f64 {
    let mut boxes = 0.0;
    for page in 0..atlas.sheets.len() {
        let points =
            atlas.faces().filter(|f| usize::from(atlas.page[f.index()]) == page).flat_map(|f| atlas.uv_triangle(f));
        let (low, high) = points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
        boxes += (high - low).max(DVec2::ZERO).element_product();
    }
    let charts = Charts::new(&Topology::new(atlas));
    let apart = clusters(atlas, &charts, OverlapMode::Separate);
    coverage(atlas, &charts, &apart).covered / boxes
}

/// Sides of the box about the layout.
fn bounds(atlas: &Atlas) -> DVec2 {
    let points = atlas.corners.iter().flatten().map(|u| atlas.uv[u.index()]);
    let (low, high) = points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
    if low.is_finite() { high - low } else { DVec2::ONE }
}
