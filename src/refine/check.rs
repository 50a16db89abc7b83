//! Nothing broken ships: every stage's result is checked, and so is what was written.

use crate::atlas::rounding::is_rounded;
use crate::atlas::{Atlas, Exactness, Violation, check};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Rounding UVs to 32 bits moves them by so many texels at most, for each texel of the sheet's longest side.
const ROUNDING: f64 = 1.2e-7;

/// Checks a stage's result against the Atlas as uploaded, and one that is rounded already as what is written; the inner error says what is wrong.
///
/// # Errors
/// `canceled`.
pub(super) fn violations(
    before: &Atlas,
    after: &Atlas,
    context: &Context,
) -> Result<std::result::Result<(), Vec<Violation>>> {
    context.check()?;
    Ok(check(before, after, if is_rounded(after) { rounded(after) } else { Exactness::Exact }))
}

/// What is wrong, in words.
pub(super) fn told(violations: &[Violation]) -> String {
    let first = violations.first().map(ToString::to_string).unwrap_or_default();
    format!("{first} ({} in all)", violations.len())
}

/// Checks the Atlas that was read back from the written document.
///
/// # Errors
/// `internal` when it is broken, `canceled`.
pub(super) fn written(before: &Atlas, after: &Atlas, context: &Context) -> Result<()> {
    context.check()?;
    check(before, after, rounded(after))
        .map_err(|wrong| Failure::internal(format!("the written model failed its check: {}", told(&wrong))))
}

/// As texture coordinates of 32 bits are known.
fn rounded(atlas: &Atlas) -> Exactness {
    let longest = atlas.sheets.iter().flatten().copied().max().unwrap_or(1);
    Exactness::Rounded(ROUNDING * f64::from(longest))
}
