//! Fits the pieces into sheets of a given size by scaling them.

use super::{Packing, Request, Rounding, pack};
use crate::context::Context;
use crate::error::Result;
use crate::packing::PackSearch;

/// A packing and the scale at which it was made.
#[derive(Debug, Clone, PartialEq)]
pub struct Fitted {
    /// The packing, on one sheet of the size asked for.
    pub packing: Packing,
    /// Factor on all pieces.
    pub scale: f64,
}

/// Bisection steps on the scale: under half a percent is left.
const STEPS: usize = 7;
/// What a piece that is alone may leave of a sheet's side, in parts of it.
const ALONE: f64 = 1e-3;
/// Thorough searches after the bisection, each at the scale that the one before made room for.
const REFINED: usize = 2;

/// Scales the pieces, at most by `largest`, so that they fill one sheet of `sheet` texels as well as possible.
///
/// # Errors
/// `canceled`.
pub fn pack_into(request: &Request<'_>, sheet: [f64; 2], largest: f64, context: &Context) -> Result<Option<Fitted>> {
    let area: f64 = request.pieces.iter().map(|p| p.area).sum::<f64>().max(1e-12);
    // No packing covers more than everything.
    let mut high = (sheet[0] * sheet[1] / area).sqrt().min(largest);
    let mut low = 0.0;
    let mut best: Option<Fitted> = None;
    // The fast search brackets the scale; the thorough one then makes the most of it.
    let fast = request.work_budget.filter(|_| request.search == PackSearch::Fast);
    let effort = request.effort / STEPS as f64;
    let bisection = Request { search: PackSearch::Fast, work_budget: fast, effort, ..request.clone() };
    let mut scale = (high * 0.8).min(largest);
    for _ in 0..STEPS {
        context.check()?;
        let packing = at_scale(&bisection, sheet, scale, context)?;
        if let Some(slack) = slack(&packing, sheet) {
            low = scale;
            best = Some(Fitted { packing: Packing { sheets: vec![sheet], ..packing }, scale });
            // What is left over tells how far the scale may grow at once.
            // And a piece that is alone lies the same at every scale.
            if low >= largest || request.pieces.len() == 1 && slack < 1.0 + ALONE {
                break;
            }
            let middle = if request.pieces.len() == 1 { 0.0 } else { (low + high) / 2.0 };
            scale = (scale * slack).max(middle).min(high);
        } else {
            high = scale;
            scale = (low + high) / 2.0;
        }
        if high - low < 1e-3 * high {
            break;
        }
    }
    if request.search == PackSearch::Thorough {
        let thorough = Request { effort: request.effort / REFINED as f64, ..request.clone() };
        for _ in 0..REFINED {
            let Some(scale) = best.as_ref().map(|b| b.scale) else { break };
            if context.out_of_time() {
                break;
            }
            let mut packing = at_scale(&thorough, sheet, scale, context)?;
            let Some(slack) = slack(&packing, sheet).filter(|s| *s > 1.0) else { break };
            // The same layout, enlarged: gutters grow with it.
            let factor = slack.min(largest / scale);
            for p in &mut packing.placements {
                p.linear *= factor;
                p.translate *= factor;
            }
            best = Some(Fitted { packing: Packing { sheets: vec![sheet], ..packing }, scale: scale * factor });
        }
    }
    Ok(best)
}

/// How far the packing may grow on the sheet, if it fits.
fn slack(packing: &Packing, sheet: [f64; 2]) -> Option<f64> {
    let [w, h] = *packing.sheets.first().filter(|_| packing.sheets.len() == 1)?;
    (w <= sheet[0] + 1e-9 && h <= sheet[1] + 1e-9).then(|| (sheet[0] / w).min(sheet[1] / h))
}

fn at_scale(request: &Request<'_>, sheet: [f64; 2], scale: f64, context: &Context) -> Result<Packing> {
    let request = Request {
        scale: request.scale * scale,
        aspect: Some(sheet[0] / sheet[1]),
        max: [f64::INFINITY; 2],
        round: Rounding::Free,
        ..request.clone()
    };
    pack(&request, context)
}
