//! Fits the pieces into sheets of a given size by scaling them.

use super::{Packing, Request, Rounding, pack};
use crate::context::Context;
use crate::error::Result;

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

/// Scales the pieces, at most by `largest`, so that they fill one sheet of `sheet` texels as well as possible.
///
/// # Errors
/// `canceled`.
pub fn pack_into(request: &Request<'_>, sheet: [f64; 2], largest: f64, context: &Context) -> Result<Option<Fitted>> {
    let area: f64 = request.pieces.iter().map(|p| p.area).sum::<f64>().max(1e-12);
    // No packing covers more than everything.
    let mut high = (sheet[0] * sheet[1] / area).sqrt().min(largest);
    let mut low = 0.0;
    let mut best = None;
    let mut scale = (high * 0.8).min(largest);
    for _ in 0..STEPS {
        context.check()?;
        let packing = at_scale(request, sheet, scale, context)?;
        let fits = packing.sheets.len() == 1
            && packing.sheets[0][0] <= sheet[0] + 1e-9
            && packing.sheets[0][1] <= sheet[1] + 1e-9;
        if fits {
            // What is left over tells how far the scale may grow at once.
            let slack = (sheet[0] / packing.sheets[0][0]).min(sheet[1] / packing.sheets[0][1]);
            low = scale;
            best = Some(Fitted { packing: Packing { sheets: vec![sheet], ..packing }, scale });
            if low >= largest {
                break;
            }
            scale = (scale * slack).max((low + high) / 2.0).min(high);
        } else {
            high = scale;
            scale = (low + high) / 2.0;
        }
        if high - low < 1e-3 * high {
            break;
        }
    }
    Ok(best)
}

fn at_scale(request: &Request<'_>, sheet: [f64; 2], scale: f64, context: &Context) -> Result<Packing> {
    let request = Request {
        scale: request.scale * scale,
        aspect: Some(sheet[0] / sheet[1]),
        max: [f64::INFINITY; 2],
        round: Rounding::Free,
        effort: request.effort / STEPS as f64,
        ..request.clone()
    };
    pack(&request, context)
}
