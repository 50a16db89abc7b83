//! Nothing broken ships: every stage's result is checked, and so is what was written.

use crate::atlas::{Atlas, Exactness, check};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Rounding UVs to 32 bits moves them by so many texels at most, for each texel of the sheet's longest side.
const ROUNDING: f64 = 1.2e-7;

/// Checks a stage's result against the Atlas as uploaded; the inner error says what is wrong.
///
/// # Errors
/// `canceled`.
pub(super) fn stage(before: &Atlas, after: &Atlas, context: &Context) -> Result<std::result::Result<(), String>> {
    context.check()?;
    Ok(verdict(before, after, Exactness::Exact))
}

/// Checks the Atlas that was read back from the written document.
///
/// # Errors
/// `internal` when it is broken, `canceled`.
pub(super) fn written(before: &Atlas, after: &Atlas, context: &Context) -> Result<()> {
    context.check()?;
    let longest = after.sheets.iter().flatten().copied().max().unwrap_or(1);
    verdict(before, after, Exactness::Rounded(ROUNDING * f64::from(longest)))
        .map_err(|text| Failure::internal(format!("the written model failed its check: {text}")))
}

fn verdict(before: &Atlas, after: &Atlas, exactness: Exactness) -> std::result::Result<(), String> {
    check(before, after, exactness).map_err(|violations| {
        let first = violations.first().map(ToString::to_string).unwrap_or_default();
        format!("{first} ({} in all)", violations.len())
    })
}
