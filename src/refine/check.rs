//! Nothing broken ships: every stage's result is checked, and so is what was written.

use crate::atlas::rounding::is_rounded;
use crate::atlas::{Atlas, Exactness, Violation, check_with};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Rounding UVs to 32 bits moves them by so many texels at most, for each texel of the sheet's longest side.
const ROUNDING: f64 = 1.2e-7;

/// Checks a stage's result against the Atlas as uploaded, and one that is rounded already as what is written; the inner error says what is wrong.
/// `self_overlaps` as in [`check_with`], here as below.
///
/// # Errors
/// `canceled`.
pub(super) fn violations(
    before: &Atlas,
    after: &Atlas,
    self_overlaps: bool,
    context: &Context,
) -> Result<std::result::Result<(), Vec<Violation>>> {
    context.check()?;
    let exactness = if is_rounded(after) { rounded(after, 0.0) } else { Exactness::Exact };
    Ok(check_with(before, after, exactness, self_overlaps))
}

/// What is wrong, as far as it says something to people: how many triangles would show what they should not. The rest goes to the log.
pub(super) fn told(violations: &[Violation]) -> String {
    for violation in violations {
        tracing::debug!(%violation, "a layout is broken");
    }
    let count = |of: fn(&Violation) -> bool| violations.iter().filter(|v| of(v)).count();
    let kinds = [
        (count(|v| matches!(v, Violation::Overlap(..))), "pairs of triangles overlap that did not before"),
        (count(|v| matches!(v, Violation::TooManyOverlaps)), "searches for overlaps found too many"),
        (count(|v| matches!(v, Violation::Flipped(_))), "triangles are turned over or have lost their area"),
        (count(|v| matches!(v, Violation::OutsideSheet(..))), "triangles leave their sheet"),
        (count(|v| matches!(v, Violation::NotFinite(_))), "triangles have texture coordinates that are no numbers"),
    ];
    let known: usize = kinds.iter().map(|k| k.0).sum();
    let others = (violations.len() - known, "triangles are not those of the surface any more");
    let told = kinds.into_iter().chain([others]).filter(|k| k.0 > 0).map(|(n, what)| format!("{n} {what}"));
    told.collect::<Vec<_>>().join(", ")
}

/// Whether an Atlas is sound whose texture coordinates were rounded to a grid of `step` texels: what touched may overlap by that.
///
/// # Errors
/// `canceled`.
pub(super) fn within(before: &Atlas, after: &Atlas, step: f64, self_overlaps: bool, context: &Context) -> Result<bool> {
    context.check()?;
    Ok(check_with(before, after, rounded(after, step), self_overlaps).is_ok())
}

/// Checks the Atlas that was read back from the written document, with texture coordinates on a grid of `step` texels, or on none.
///
/// # Errors
/// `internal` when it is broken, `canceled`.
pub(super) fn written(before: &Atlas, after: &Atlas, step: f64, self_overlaps: bool, context: &Context) -> Result<()> {
    context.check()?;
    check_with(before, after, rounded(after, step), self_overlaps)
        .map_err(|wrong| Failure::internal(format!("the refined model is broken ({}), and is not delivered: the fault is Intarsia's, please report it with the model", told(&wrong))))
}

/// As texture coordinates of 32 bits are known, on a grid of `step` texels.
fn rounded(atlas: &Atlas, step: f64) -> Exactness {
    let longest = atlas.sheets.iter().flatten().copied().max().unwrap_or(1);
    Exactness::Rounded(step.max(ROUNDING * f64::from(longest)))
}
