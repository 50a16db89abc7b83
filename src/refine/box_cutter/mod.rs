//! The stage `box_cutter`: Limper, Vining and Sheffer 2018, *Box Cutter: Atlas Refinement for Efficient Packing via Void Elimination*.
//!
//! Charts that overlap themselves are cut until they do not (4.1), charts are welded where that costs nothing (4.2); then cuts
//! along the sides of void boxes are searched for that make packing better (3), within a budget of boundary length. Panels, the
//! pieces of the search, are outlines in their chart's own coordinates: a candidate is executed and packed in
//! milliseconds, and only what the search chose is cut into the mesh.

mod arrange;
mod candidates;
mod edges;
mod field;
mod lines;
mod outline;
pub mod overlap;
mod panel;
pub mod params;
mod search;
mod start;
#[cfg(test)]
mod tests;
mod void;
mod weld;

use serde_json::{Map, Value, json};

use self::arrange::Sheet;
use self::edges::EdgeCutter;
use self::field::Field;
use self::panel::Raster;
use self::params::{BoxCutter, Cuts};
use self::search::{Limits, SearchContext, SearchResult, SearchState, search};
use super::options::Options;
use super::pack::{finished, lay_out};
use super::stage::{self, SheetInfo, StageInput, Staged};
use crate::atlas::OverlapMode;
use crate::atlas::bvh::Bounds;
use crate::atlas::{Atlas, ChartId, Charts, HalfEdge, Mesh, Topology, clusters};
use crate::error::{Failure, Result};
use crate::packing::Pitch;
use crate::packing::{Pack, PackSearch, Rotation};

/// Cells along the side of a square that would hold everything, by number of panels.
const CELLS: [(usize, f64); 3] = [(60, 160.0), (200, 208.0), (usize::MAX, 288.0)];
/// Words of occupancy that the search may look at: the more, the more the boundary may grow; and at most.
const WORK: f64 = 1e9;
/// See [`WORK`].
const MOST_WORK: f64 = 2e9;
/// Work of a search at which the final layouts get their full share.
const USUAL_WORK: f64 = 2e8;
/// States whose cuts are made and packed at the fine resolution.
const FINALS: usize = 3;
/// Share of a thorough packing's work that each of them gets.
const EFFORT: f64 = 0.1;

/// Cuts and repacks.
///
/// `weights` is the importance at the corners of each face.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(crate) fn box_cutter(input: &StageInput<'_>, weights: Option<&[[f64; 3]]>, params: &BoxCutter) -> Result<Staged> {
    let StageInput { atlas, sheet_info, options, context, .. } = *input;
    let unit = longest_side(atlas);
    let mut figures = Map::new();
    let clean = without_overlaps(input, weights, params, &mut figures)?;

    let mesh = Mesh::new(clean);
    let charts = Charts::new(mesh.topology());
    let together = clusters(mesh.atlas(), &charts, options.atlas.overlaps);
    let along_edges = params.cuts == Cuts::Edges || params.cuts == Cuts::Auto && sheet_info.along_edges;
    let rotation = options.pack.rotation;
    let panels = start::panels(mesh.atlas(), mesh.topology(), &charts, &together, along_edges, sheet_info, rotation);
    let held: f64 = panels.iter().filter(|p| !p.cuttable()).map(|p| p.area).fold(0.0, |a, b| a + b);
    let total: f64 = panels.iter().map(|p| p.area).sum();
    let length: f64 = panels.iter().map(|p| p.length).sum();
    let sheet = sheet(&panels, sheet_info, options);
    let (arrangement, _) = sheet.arrange(&panels, None, context);
    context.check()?;
    let Some(arrangement) = arrangement else { return Err(Failure::internal("no strip holds the panels")) };
    let growth = params.max_boundary_length.map_or(f64::INFINITY, |b| b - 1.0);
    let usual = || (WORK * growth.max(0.05) * (0.7 + growth)).min(MOST_WORK) as u64;
    let search_context = SearchContext {
        sheet,
        params,
        least: params.min_extent * unit,
        field: weights.filter(|_| !along_edges).map(|weights| Field::new(mesh.atlas(), &charts, weights)),
        edges: along_edges.then(|| EdgeCutter::new(&mesh, weights)),
        unit,
        weighted: weights.is_some(),
        limits: Limits {
            length: params.max_boundary_length.map_or(f64::INFINITY, |b| b * length),
            target: params.target_packing_efficiency.unwrap_or(f64::INFINITY),
            charts: params.max_charts.map_or(usize::MAX, |n| n as usize),
            work: options.work_budget.unwrap_or_else(usual),
        },
        context,
    };
    let start = SearchState { panels, arrangement, length, weighted: length, cuts: Vec::new() };
    let found = search(start, &search_context)?;
    let (state, laid, work) = finish((&mesh, &charts), &found, &search_context, input)?;
    figures.extend([
        ("work".to_owned(), json!(found.work + work)),
        ("candidates".to_owned(), json!(found.tried)),
        ("cuts".to_owned(), json!(state.cuts.len())),
        ("charts".to_owned(), json!(state.panels.len())),
        ("boundary_length_ratio".to_owned(), json!(state.length / length.max(1e-300))),
        ("held_back".to_owned(), json!(held / total.max(1e-300))),
    ]);
    if held > 0.0 {
        context.warn(stage::held_back_warning(input, held / total.max(1e-300), "layout", "cut"));
    }
    Ok(finished(input, laid, found.stopped_by, figures))
}

/// Overlap removal and welding (section 4). What it changed lies apart from the rest afterwards.
fn without_overlaps(
    input: &StageInput<'_>,
    weights: Option<&[[f64; 3]]>,
    params: &BoxCutter,
    figures: &mut Map<String, Value>,
) -> Result<Atlas> {
    let StageInput { atlas, sheet_info, options, context, .. } = *input;
    let charts = Charts::new(&Topology::new(atlas));
    let together = clusters(atlas, &charts, options.atlas.overlaps);
    // Neither step makes, drops or renumbers faces: what holds of a chart is known by its faces.
    let alone: Vec<bool> =
        charts.of_face.iter().map(|c| together.charts[together.of_chart[c.index()] as usize].len() == 1).collect();
    let touchable = |charts: &Charts, chart: ChartId| charts.faces[chart.index()].iter().all(|f| alone[f.index()]);
    let mut next = atlas.clone();
    let mut tests = 0;
    if params.remove_overlaps {
        context.step(0.02, "removing overlaps")?;
        let edge_weight = weights.map(|w| {
            move |h: HalfEdge| {
                let own = w[h.face().index()];
                (own[h.corner()] + own[h.end_corner()]) * 0.5
            }
        });
        let weight = edge_weight.as_ref().map(|w| w as &(dyn Fn(HalfEdge) -> f64 + Sync));
        let removed = overlap::remove_overlaps(&next, &|c| touchable(&charts, c), weight, context)?;
        figures.insert("overlapping_charts".to_owned(), json!(removed.charts_touched));
        figures.insert("overlap_cuts".to_owned(), json!(removed.cut_length / border(atlas).max(1e-300)));
        tests += removed.work;
        next = removed.atlas;
    }
    // A weld turns a chart by any angle: texels that shall not be resampled stay where they are.
    if params.weld && (options.pack.rotation == Rotation::Any || sheet_info.is_virtual) {
        context.step(0.06, "welding")?;
        let charts = Charts::new(&Topology::new(&next));
        let efficiency = |a: &Atlas| packed_efficiency(a, input);
        let turns = |c: ChartId| !sheet_info.turns_by_half(&next, charts.faces[c.index()].iter().copied());
        let welded = weld::weld(&next, &|c| touchable(&charts, c) && turns(c), params.weld_loss, &efficiency, context)?;
        figures.insert("welds".to_owned(), json!(welded.welds));
        figures.insert("welds_undone".to_owned(), json!(welded.undone));
        figures.insert("weld_saved".to_owned(), json!(welded.boundary_saved / border(atlas).max(1e-300)));
        tests += welded.work;
        next = welded.atlas;
    }
    figures.insert("overlap_work".to_owned(), json!(tests));
    if next == *atlas {
        return Ok(next);
    }
    figures.insert("overlap_free_length_ratio".to_owned(), json!(border(&next) / border(atlas).max(1e-300)));
    let changed: Vec<bool> = next
        .faces()
        .map(|f| atlas.corners[f.index()] != next.corners[f.index()] || atlas.uv_triangle(f) != next.uv_triangle(f))
        .collect();
    let cut: std::collections::BTreeSet<ChartId> = changed
        .iter()
        .zip(&charts.of_face)
        .zip(&alone)
        .filter(|((c, _), alone)| **c && **alone)
        .map(|((_, chart), _)| *chart)
        .collect();
    let moved: Vec<bool> = charts.of_face.iter().map(|c| cut.contains(c)).collect();
    let step = f64::from(sheet_info.unit) * 64.0;
    Ok(next.set_apart(&moved, step))
}

/// Makes the cuts of the best few states, packs each, and gives the best packing.
fn finish(
    (mesh, charts): (&Mesh, &Charts),
    found: &SearchResult,
    search_context: &SearchContext<'_>,
    input: &StageInput<'_>,
) -> Result<(SearchState, Atlas, u64)> {
    let StageInput { options, context, .. } = *input;
    let finals = &found.states[..found.states.len().min(FINALS)];
    // The layouts that the search ended with are improved, all a little, the best more.
    // When time is up, one packing as it was asked for is all that there is.
    let search = if context.out_of_time() { options.pack.search } else { PackSearch::Thorough };
    let pack = Pack { search, ..options.pack.clone() };
    let own = Options { pack, work_budget: None, ..options.clone() };
    let mut best: Option<(f64, &SearchState, Atlas)> = None;
    let mut work = 0;
    for (n, state) in finals.iter().enumerate() {
        if best.is_some() && context.out_of_time() {
            break;
        }
        context.step(0.7 + 0.3 * n as f64 / finals.len() as f64, "packing the best")?;
        let (cut, origin) = start::apply(mesh, charts, &state.cuts, search_context.unit);
        let layout = start::layout(&cut, &origin, options.atlas.overlaps, state, &search_context.sheet.raster);
        let effort = if options.pack.search == PackSearch::Thorough { 1.0 / FINALS as f64 } else { EFFORT };
        // A small budget of work is small for all that is done.
        let effort = effort * (search_context.limits.work as f64 / USUAL_WORK).min(1.0);
        let (laid, own) =
            lay_out(&StageInput { atlas: &cut, options: &own, ..*input }, layout.as_slice(), &[], effort)?;
        work += own;
        // What packing made of it, weighed as in the search.
        let worth = state.worth(search_context) / state.arrangement.efficiency.max(1e-300) * efficiency(&laid);
        if best.as_ref().is_none_or(|(most, ..)| worth > *most) {
            best = Some((worth, state, laid));
        }
    }
    let Some((_, state, laid)) = best else { return Err(Failure::internal("a search without a state")) };
    Ok((state.clone(), laid, work))
}

/// How panels are rasterised and on which strips they are tried.
fn sheet(panels: &[std::sync::Arc<panel::Panel>], sheet_info: &SheetInfo, options: &Options) -> Sheet {
    let gutter = f64::from(sheet_info.gutter(&options.pack)) * f64::from(sheet_info.unit);
    let grown: f64 = panels.iter().map(|p| p.area + 0.5 * gutter * p.length).sum();
    let side = (grown / 0.75).sqrt().max(1e-9);
    let cells = CELLS.iter().find(|(n, _)| panels.len() <= *n).map_or(160.0, |(_, c)| *c);
    let cell = side / cells;
    let longest = panels.iter().map(|p| {
        let bounds = p.outline.bounds();
        if bounds.min.is_finite() { (bounds.size().length() + gutter) / cell } else { 0.0 }
    });
    let longest = longest.fold(0.0, f64::max).min(1e5) as usize + 4;
    let aspect = options.pack.aspect;
    let count = if panels.len() > 60 { 4 } else { 6 };
    let base = aspect.map_or(1.0, f64::sqrt);
    let (narrow, wide): (f64, f64) = if aspect.is_some() { (0.95, 1.2) } else { (0.7, 1.5) };
    let mut widths: Vec<usize> = (0..count)
        .map(|k| cells * base * narrow * (wide / narrow).powf(f64::from(k) / f64::from(count - 1)))
        .map(|w| w as usize)
        .collect();
    widths.push(longest);
    let widest = widths.iter().copied().max().unwrap_or(longest);
    let raster = Raster {
        cell,
        inflate: gutter / 2.0,
        pitch: Pitch::new(widest, widest, 1),
        rotation: options.pack.rotation,
        mirror: options.pack.mirror,
    };
    Sheet { raster, widths, aspect, height: 8 * cells as usize + longest }
}

/// Packing efficiency at the resolution of the search.
fn packed_efficiency(atlas: &Atlas, input: &StageInput<'_>) -> Result<f64> {
    let StageInput { sheet_info, options, context, .. } = *input;
    let topology = Topology::new(atlas);
    let charts = Charts::new(&topology);
    // Where charts were cut or moved they may lie on each other: each is its own.
    let together = clusters(atlas, &charts, OverlapMode::Separate);
    let panels = start::panels(atlas, &topology, &charts, &together, false, sheet_info, options.pack.rotation);
    context.check()?;
    Ok(sheet(&panels, sheet_info, options).arrange(&panels, None, context).0.map_or(0.0, |a| a.efficiency))
}

/// Area of the charts over the area of their boxes, page by page.
fn efficiency(atlas: &Atlas) -> f64 {
    let mut boxes = vec![Bounds::EMPTY; atlas.sheets.len()];
    let mut area = 0.0;
    for face in atlas.faces() {
        area += atlas.uv_area(face).abs();
        let own = &mut boxes[usize::from(atlas.page[face.index()])];
        *own = own.union(Bounds::of(&atlas.uv_triangle(face)));
    }
    let whole: f64 = boxes.iter().filter(|b| b.min.is_finite()).map(|b| b.size().element_product()).sum();
    area / whole.max(1e-300)
}

fn longest_side(atlas: &Atlas) -> f64 {
    let points = atlas.corners.iter().flatten().map(|u| atlas.uv[u.index()]).filter(|p| p.is_finite());
    let bounds = Bounds::around(points);
    if bounds.min.is_finite() { bounds.size().max_element().max(1e-9) } else { 1.0 }
}

fn border(atlas: &Atlas) -> f64 {
    crate::atlas::seams::border_length(atlas, &Topology::new(atlas))
}
