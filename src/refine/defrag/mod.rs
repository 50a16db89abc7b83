//! The stage `defrag`: Maggiordomo, Cignoni and Tarini 2021, *Texture Defragmentation for Photo-Reconstructed 3D Models*.
//!
//! Charts are merged along their seams, the most appealing operation first (Algorithm 1). A merge aligns the smaller chart to the
//! other, fuses the seam's vertices and lets the triangles near it find the shape that they had in the input again; what would
//! overlap, fold or be deformed too much is not done. Charts that keep their texels are placed so that they do.

mod account;
mod attempt;
mod face_grid;
mod links;
mod mergeable;
mod mesh;
mod operation;
pub mod params;
mod place;
mod queue;
mod retry;
mod seam;
mod sheet_limit;
mod speculation;
#[cfg(test)]
mod tests;
mod topology;

use serde_json::{Map, Value, json};

use self::account::Account;
use self::attempt::{Attempt, Reason};
use self::mergeable::Mergeable;
use self::mesh::MergeMesh;
use self::params::Defrag;
use self::queue::OperationQueue;
use self::sheet_limit::SheetLimit;
use self::speculation::Speculation;
use super::pack::{finished, largest_chart, lay_out};
use super::stage::{StageInput, Staged};
use crate::atlas::{Charts, Topology};
use crate::error::{Result, Warning};
use crate::packing::Rotation;
use crate::texture::Size;

/// Merges charts and packs them.
///
/// # Errors
/// `too_large` when a chart fits on no sheet, `canceled`.
pub(crate) fn defrag(input: &StageInput<'_>, params: &Defrag) -> Result<Staged> {
    let StageInput { atlas, sheet_info, options, context, .. } = *input;
    let charts = Charts::new(&Topology::new(atlas));
    let mergeable = Mergeable::new(input, &charts);
    context.step(0.02, "finding seams")?;
    let mut mesh = MergeMesh::new(atlas, &charts, &mergeable.charts, !sheet_info.directions);
    let limit = largest_chart(sheet_info, options).and_then(|sides| SheetLimit::new(&mesh, sides));
    let mut figures = merge_charts(&mut mesh, limit, params, input)?;
    figures.insert("held_back".to_owned(), json!(mergeable.held_back));

    let whole_texels = options.pack.rotation != Rotation::Any;
    let placed = place::place(&mesh, atlas, params.min_preserved, sheet_info, limit, whole_texels);
    drop(mesh);
    figures.insert("preserved_area".to_owned(), json!(placed.preserved));
    context.step(0.75, "packing")?;
    // Where charts came to lie others may lie already: they share no texels for that.
    let moved: Vec<bool> = atlas.faces().map(|f| atlas.uv_triangle(f) != placed.atlas.uv_triangle(f)).collect();
    let apart = placed.atlas.set_apart(&moved, f64::from(sheet_info.unit) * 64.0);
    let (laid, work) = lay_out(&StageInput { atlas: &apart, ..*input }, &[], &placed.free, 1.0)?;
    figures.insert("pack_work".to_owned(), json!(work));
    // Large charts may pack worse than the small ones that they are made of.
    if options.texture.size == Size::KeepDensity && !sheet_info.is_virtual && laid.pixels() > atlas.pixels() {
        let (alone, work) = lay_out(input, &[], &[], 1.0)?;
        if alone.pixels() <= atlas.pixels() {
            let text = format!(
                "merged charts would make the sheet of atlas {} larger than it was ({} pixels, now {}); packed as they are they do not ({}): they were not merged (set texture.size to \"keep_size\" to have them merged on a sheet of the same size)",
                sheet_info.id,
                laid.pixels(),
                atlas.pixels(),
                alone.pixels()
            );
            context.warn(Warning::new("packed_without_merging", text));
            let figures = Map::from_iter([("work".to_owned(), json!(work))]);
            return Ok(finished(input, alone, "packed_without_merging", figures));
        }
    }
    Ok(finished(input, laid, "done", figures))
}

/// Algorithm 1 up to its last line; gives its figures.
fn merge_charts(
    mesh: &mut MergeMesh,
    limit: Option<SheetLimit>,
    params: &Defrag,
    input: &StageInput<'_>,
) -> Result<Map<String, Value>> {
    let StageInput { sheet_info, options, context, .. } = *input;
    let mut queue = OperationQueue::new(mesh, params, f64::from(sheet_info.unit), context.seed);
    let mut account = Account::new(mesh, params, options.work_budget.unwrap_or(u64::MAX));
    let mut attempts = Speculation::new(params);
    let all = queue.len().max(1);
    let mut stopped_by = "done";
    while let Some(id) = queue.pop() {
        let done = 1.0 - (queue.len() as f64 / all as f64).min(1.0);
        context.step(0.05 + 0.65 * done, "merging charts")?;
        if account.is_spent() || context.out_of_time() {
            stopped_by = if account.is_spent() { "work_budget" } else { "time_limit" };
            break;
        }
        let op = queue.operation(id).clone();
        let Attempt { outcome, footprint, work } = if !attempts.stays_planar(mesh, &op) {
            Attempt::not_planar(mesh, &op, params)
        } else if limit.is_some_and(|limit| !limit.allows(mesh, &op)) {
            Attempt::failed(mesh, &op, params, Reason::Size)
        } else {
            attempts.attempt(mesh, &queue, id)
        };
        account.tried(work);
        match outcome.and_then(|merge| account.admit(mesh, &op, merge)) {
            Ok(merge) => {
                mesh.commit(&op, &merge, footprint.region);
                queue.merged(mesh, id, &merge, footprint.region);
            }
            Err(reason) => {
                account.failed(reason);
                queue.failed(mesh, id, reason, footprint, work);
            }
        }
    }
    Ok(account.figures(mesh, stopped_by))
}
