//! The stage `defrag`: Maggiordomo, Cignoni and Tarini 2021, *Texture Defragmentation for Photo-Reconstructed 3D Models*.
//!
//! Charts are merged along their seams, the most appealing operation first (Algorithm 1). A merge aligns the smaller chart to the
//! other, fuses the seam's vertices and lets the triangles near it find the shape that they had in the input again; what would
//! overlap, fold or be deformed too much is not done. Charts that keep their texels are placed so that they do.

mod attempt;
mod border;
mod commit;
mod grid;
mod mesh;
mod operation;
pub mod params;
mod place;
mod queue;
mod room;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use serde_json::{Map, Value, json};

use self::attempt::{Attempt, Pool, Quit, Reason, attempt};
use self::mesh::Mesh;
use self::params::{Defrag, Search};
use self::queue::Queue;
use self::room::Room;
use super::options::Options;
use super::pack::{keeps_input, largest_chart, lay_out};
use super::stage::{SheetInfo, Staged};
use crate::atlas::OverlapMode;
use crate::atlas::{Atlas, Charts, Topology, clusters};
use crate::context::Context;
use crate::error::{Result, Warning};
use crate::packing::Rotation;

/// Operations that are tried ahead of their turn at most.
const AHEAD: usize = 64;

/// Merges charts and packs them.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(crate) fn defrag(
    atlas: &Atlas,
    sheet_info: &SheetInfo,
    params: &Defrag,
    options: &Options,
    context: &Context,
) -> Result<Staged> {
    let charts = Charts::new(&Topology::new(atlas));
    let together = clusters(atlas, &charts, options.atlas.overlaps);
    let open: Vec<bool> =
        charts.ids().map(|c| together.charts[together.of_chart[c.index()] as usize].len() == 1).collect();
    let (mesh, room, mut figures) = merge_charts(atlas, &charts, &open, sheet_info, params, options, context)?;
    let held: f64 = held_back(atlas, &charts, &open);
    figures.insert("held_back".to_owned(), json!(held));
    if held > 0.0 && options.atlas.overlaps == OverlapMode::Stack {
        context.warn(Warning::new(
            "held_back",
            format!(
                "{:.1} % of the area of atlas {} is not merged: charts that share texels",
                100.0 * held,
                sheet_info.id
            ),
        ));
    }
    let whole_texels = options.pack.rotation != Rotation::Any;
    let placed = place::place(mesh, atlas, params.min_preserved, sheet_info, room, whole_texels);
    figures.insert("preserved_area".to_owned(), json!(placed.preserved));
    context.step(0.75, "packing")?;
    // Where charts came to lie others may lie already: they share no texels for that.
    let moved: Vec<bool> = atlas.faces().map(|f| atlas.uv_triangle(f) != placed.atlas.uv_triangle(f)).collect();
    let apart = placed.atlas.set_apart(&moved, f64::from(sheet_info.unit) * 64.0);
    let (laid, work) = lay_out(&apart, sheet_info, options, &[], &placed.free, 1.0, context)?;
    figures.insert("pack_work".to_owned(), json!(work));
    let staged = Staged { atlas: laid, stopped_by: "done", figures, kept: false };
    if keeps_input(atlas, &staged.atlas, sheet_info, options) {
        return Ok(staged.undone(atlas, sheet_info, context));
    }
    Ok(staged)
}

/// Part of the UV area whose charts may not be merged.
fn held_back(atlas: &Atlas, charts: &Charts, open: &[bool]) -> f64 {
    let (mut held, mut all) = (0.0, 0.0);
    for face in atlas.faces() {
        let area = atlas.uv_area(face).abs();
        all += area;
        if !open[charts.of_face[face.index()].index()] {
            held += area;
        }
    }
    held / f64::max(all, 1e-300)
}

/// Algorithm 1: the mesh with merged charts, each in its own coordinates, and the room that they were kept to.
fn merge_charts(
    atlas: &Atlas,
    charts: &Charts,
    open: &[bool],
    sheet_info: &SheetInfo,
    params: &Defrag,
    options: &Options,
    context: &Context,
) -> Result<(Mesh, Option<Room>, Map<String, Value>)> {
    context.step(0.02, "finding seams")?;
    let mut mesh = Mesh::new(atlas, charts, open, !sheet_info.directions);
    let mut queue = Queue::new(&mesh, params, f64::from(sheet_info.unit), context.seed ^ options.seed);
    let room = largest_chart(sheet_info, options).and_then(|sides| Room::new(&mesh, sides));
    let pool = Pool::default();
    let weight: f64 = mesh.weight.iter().sum::<f64>().max(1e-300);
    let surface: f64 = mesh.area.iter().sum();
    // Length of all seams, each once.
    let border: f64 = 0.5
        * (0..mesh.link.len() as u32)
            .filter(|&h| mesh.link[h as usize] != mesh::NONE)
            .map(|h| mesh.length(h))
            .sum::<f64>();
    let border = border.max(1e-300);
    let mut energy = 0.0;
    let mut kept: f64 = mesh.charts.iter().map(|c| c.kept).sum();
    let (mut merges, mut tried, mut work) = (0u64, 0u64, 0u64);
    let mut failures: BTreeMap<Reason, u64> = BTreeMap::new();
    let budget = options.work_budget.unwrap_or(u64::MAX);
    let start = queue.len().max(1);
    let mut stopped_by = "done";
    while let Some(entry) = queue.pop() {
        context.check()?;
        if work > budget || context.out_of_time() {
            stopped_by = if work > budget { "work_budget" } else { "time_limit" };
            break;
        }
        // Whether the chart stays flat is a matter of its whole border, and its size one of all of it: what was found out ahead of its
        // turn does not count.
        let op = &queue.entries[entry as usize].op;
        let refused = |attempt: &Attempt| matches!(attempt.outcome, Err(Reason::Topology | Reason::Size));
        if !attempt::stays_flat(&mesh, op, &pool) {
            let attempt = Attempt::not_flat(&mesh, op, params);
            queue.remember(&mesh, entry, attempt);
        } else if room.is_some_and(|room| !room.holds(&mesh, op)) {
            let attempt = Attempt::failed(&mesh, op, params, Reason::Size);
            queue.remember(&mesh, entry, attempt);
        } else if queue.known(&mesh, entry).is_none_or(refused) {
            look_ahead(&mesh, &mut queue, entry, params, &pool);
            let done = 1.0 - (queue.len() as f64 / start as f64).min(1.0);
            context.step(0.05 + 0.65 * done, "merging charts")?;
        }
        tried += 1;
        let known = queue.known(&mesh, entry).cloned();
        let Some(Attempt { outcome, region, work: spent, .. }) = known else { continue };
        work += spent;
        let op = queue.entries[entry as usize].op.clone();
        let verdict = outcome.and_then(|merge| {
            if energy + merge.energy > params.global_energy() * weight && merge.energy > 0.0 {
                return Err(Reason::Global);
            }
            let before = mesh.charts[op.kept as usize].kept
                + if op.kept == op.moved { 0.0 } else { mesh.charts[op.moved as usize].kept };
            let after = kept - before + mesh.kept_after(&op, &merge);
            if params.max_resampled < 1.0 && after < (1.0 - params.max_resampled - 1e-9) * surface && after < kept {
                return Err(Reason::Resampled);
            }
            let lost = (kept - after) / surface;
            let gained = 0.5 * op.lengths.iter().sum::<f64>() / border;
            if params.search == Search::Partial && lost > params.resampling_rate * gained + 0.001 {
                return Err(Reason::Resampled);
            }
            Ok((merge, after))
        });
        match verdict {
            Ok((merge, after)) => {
                energy += merge.energy;
                kept = after;
                merges += 1;
                mesh.commit(&op, &merge, region);
                queue.merged(&mesh, entry, &merge, region);
            }
            Err(reason) => {
                *failures.entry(reason).or_default() += 1;
                queue.failed(&mesh, entry, reason);
            }
        }
    }
    let total: f64 = mesh.energy.iter().sum();
    let failures: Map<String, Value> =
        failures.into_iter().map(|(reason, n)| (reason.name().to_owned(), Value::from(n))).collect();
    let left = mesh.charts.iter().filter(|c| !c.faces.is_empty()).count();
    let figures = Map::from_iter([
        ("charts_before".to_owned(), json!(charts.len())),
        ("charts".to_owned(), json!(left)),
        ("merges".to_owned(), json!(merges)),
        ("attempts".to_owned(), json!(tried)),
        ("failures".to_owned(), Value::Object(failures)),
        ("energy".to_owned(), json!(total / weight)),
        ("work".to_owned(), json!(work)),
        ("merging_stopped_by".to_owned(), json!(stopped_by)),
    ]);
    Ok((mesh, room, figures))
}

/// Tries an operation and, while that takes long, those that follow: an attempt changes nothing, and stands as long as nothing changes
/// that it depends on. So the result is that of trying one after the other.
fn look_ahead(mesh: &Mesh, queue: &mut Queue<'_>, entry: u32, params: &Defrag, pool: &Pool) {
    let known = &*queue;
    let attempted = |e: u32, quit: Quit<'_>, heavy: &(dyn Fn() + Sync)| {
        attempt(mesh, &known.entries[e as usize].op, params, pool, quit, heavy)
    };
    let (started, done) = (AtomicBool::new(rayon::current_num_threads() == 1), AtomicBool::new(false));
    let found: Mutex<Vec<(u32, Option<Attempt>)>> = Mutex::new(Vec::new());
    let add = |e, attempt| found.lock().unwrap_or_else(PoisonError::into_inner).push((e, attempt));
    rayon::scope(|scope| {
        let meanwhile = || {
            if started.swap(true, Ordering::Relaxed) {
                return;
            }
            for e in known.upcoming(mesh, AHEAD) {
                let (attempted, add, done) = (&attempted, &add, &done);
                scope.spawn(move |_| {
                    let flat = || attempt::stays_flat(mesh, &known.entries[e as usize].op, pool);
                    if !done.load(Ordering::Relaxed) && flat() {
                        add(e, attempted(e, Quit::when(done), &|| {}));
                    }
                });
            }
        };
        add(entry, attempted(entry, Quit::default(), &meanwhile));
        done.store(true, Ordering::Relaxed);
    });
    for (e, attempt) in found.into_inner().unwrap_or_else(PoisonError::into_inner) {
        match attempt {
            Some(attempt) => queue.remember(mesh, e, attempt),
            None => queue.entries[e as usize].dear = true,
        }
    }
}
