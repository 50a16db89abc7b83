//! Between rows of the queue and values.

use serde::de::DeserializeOwned;
use serde_json::Value;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use crate::error::{Failure, Result};
use crate::jobs::record::{ArtifactEntry, Job, JobState, Timestamp};

/// A value as a column holds it.
pub(super) fn json<T: serde::Serialize>(value: &T) -> Result<String> {
    serde_json::to_string(value).map_err(|e| Failure::internal(format!("the queue cannot store this: {e}")))
}

/// The value that a column holds.
pub(super) fn parsed<T: DeserializeOwned>(row: &SqliteRow, column: &str) -> Result<T> {
    let text: String = row.try_get(column)?;
    serde_json::from_str(&text).map_err(|e| {
        tracing::error!(column, error = %e, "the queue holds a broken value");
        Failure::internal("the job queue holds a broken value")
    })
}

/// A job from its row, with `position` beside the columns of the table.
pub(super) fn job(row: &SqliteRow) -> Result<Job> {
    let options: Value = parsed(row, "options")?;
    let timestamp = |column: &str| row.try_get::<Option<i64>, _>(column).map(|m| m.map(Timestamp));
    let state: String = row.try_get("state")?;
    let position: Option<i64> = row.try_get("position")?;
    let error: Option<String> = row.try_get("error")?;
    let outcome: Option<String> = row.try_get("outcome")?;
    let artifacts_expire_at = timestamp("artifacts_expire_at")?;
    let mut artifacts: Vec<ArtifactEntry> = parsed(row, "artifacts")?;
    if artifacts_expire_at.is_some_and(|at| at <= Timestamp::now()) {
        artifacts.iter_mut().for_each(|a| (a.href, a.expired) = (None, true));
    }
    Ok(Job {
        id: row.try_get("id")?,
        state: JobState::from_name(&state).ok_or_else(|| Failure::internal("the job queue holds a broken state"))?,
        recipe: options.get("recipe").cloned().unwrap_or_default(),
        metadata: options.get("metadata").cloned().unwrap_or_default(),
        options,
        outcome: outcome.and_then(|name| serde_json::from_value(Value::String(name)).ok()),
        progress: parsed(row, "progress")?,
        queue_position: position.and_then(|p| u64::try_from(p).ok()),
        attempt: row.try_get("attempt")?,
        created_at: Timestamp(row.try_get("created_at")?),
        started_at: timestamp("started_at")?,
        finished_at: timestamp("finished_at")?,
        artifacts_expire_at,
        stages: parsed(row, "stages")?,
        timings: parsed(row, "timings")?,
        warnings: parsed(row, "warnings")?,
        error: error.and_then(|text| serde_json::from_str(&text).ok()),
        artifacts,
    })
}

/// Jobs with their states.
pub(super) fn states(rows: &[SqliteRow]) -> Result<Vec<(String, JobState)>> {
    let state = |name: String| JobState::from_name(&name).ok_or_else(|| Failure::internal("a broken state"));
    rows.iter().map(|row| Ok((row.try_get(0)?, state(row.try_get(1)?)?))).collect()
}
