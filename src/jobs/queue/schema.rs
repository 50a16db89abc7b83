//! How a database of an earlier version becomes one of today's, whatever it is made of.

use crate::error::{Failure, Result};

/// The step from the schema before to that of `version`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Migration {
    /// The version that it leads to.
    pub(super) version: i64,
    /// What it does.
    pub(super) sql: &'static str,
}

/// The migrations that a store of that version lacks; 0 is a new one.
///
/// # Errors
/// `internal`: a version that this program does not know.
pub(super) fn outstanding(version: i64, migrations: &[Migration]) -> Result<&[Migration]> {
    let (Some(first), Some(last)) = (migrations.first(), migrations.last()) else { return Ok(migrations) };
    if version > last.version {
        let known = last.version;
        return Err(Failure::internal(format!(
            "the job queue was made by a newer version of Intarsia (schema {version}, this one knows {known})"
        )));
    }
    if version != 0 && version < first.version {
        let known = first.version;
        return Err(Failure::internal(format!(
            "the job queue was made by a version of Intarsia that is too old (schema {version}, this one reads {known} and later)"
        )));
    }
    Ok(migrations.get(migrations.partition_point(|m| m.version <= version)..).unwrap_or_default())
}
