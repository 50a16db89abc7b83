//! Between rows of the queue's tables and values: the same columns whatever database holds them.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::{AttemptEnd, Claim, NewJob};
use crate::error::{Failure, Result};
use crate::jobs::batches::{StoredItem, StoredJob};
use crate::jobs::files;
use crate::jobs::keys::Key;
use crate::jobs::record::{ArtifactEntry, Job, JobState, Timestamp};
use crate::jobs::resumable::{PREFIX, Piece, Upload};
use crate::jobs::webhooks::{Delivery, DeliveryState, Due, Webhook};

/// A row, by the names of its columns.
pub(super) trait Columns {
    /// A text.
    fn text(&self, column: &str) -> Result<String>;
    /// A text, or null.
    fn text_or_null(&self, column: &str) -> Result<Option<String>>;
    /// An integer.
    fn integer(&self, column: &str) -> Result<i64>;
    /// An integer, or null.
    fn integer_or_null(&self, column: &str) -> Result<Option<i64>>;
    /// Whether it holds.
    fn flag(&self, column: &str) -> Result<bool>;

    /// The value that a column of JSON holds.
    fn parsed<T: DeserializeOwned>(&self, column: &str) -> Result<T> {
        serde_json::from_str(&self.text(column)?).map_err(|e| {
            tracing::error!(column, error = %e, "the queue holds a broken value");
            Failure::internal("the job queue holds a broken value")
        })
    }

    /// A number that is not negative.
    fn number<T: TryFrom<i64>>(&self, column: &str) -> Result<T> {
        T::try_from(self.integer(column)?).map_err(|_| Failure::internal("the job queue holds a broken number"))
    }

    /// A time, or null.
    fn time_or_null(&self, column: &str) -> Result<Option<Timestamp>> {
        Ok(self.integer_or_null(column)?.map(Timestamp))
    }
}

macro_rules! columns_of {
    ($row:ty) => {
        impl Columns for $row {
            fn text(&self, column: &str) -> Result<String> {
                Ok(sqlx::Row::try_get(self, column)?)
            }
            fn text_or_null(&self, column: &str) -> Result<Option<String>> {
                Ok(sqlx::Row::try_get(self, column)?)
            }
            fn integer(&self, column: &str) -> Result<i64> {
                Ok(sqlx::Row::try_get(self, column)?)
            }
            fn integer_or_null(&self, column: &str) -> Result<Option<i64>> {
                Ok(sqlx::Row::try_get(self, column)?)
            }
            fn flag(&self, column: &str) -> Result<bool> {
                Ok(sqlx::Row::try_get(self, column)?)
            }
        }
    };
}

columns_of!(sqlx::sqlite::SqliteRow);
columns_of!(sqlx::postgres::PgRow);

/// A value as a column of JSON holds it.
pub(super) fn json<T: Serialize>(value: &T) -> Result<String> {
    serde_json::to_string(value).map_err(|e| Failure::internal(format!("the queue cannot store this: {e}")))
}

/// A number as a column holds it.
pub(super) fn integer(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

/// A job from its row at `now`, with `position` beside the columns of the table.
pub(super) fn job(row: &impl Columns, now: Timestamp) -> Result<Job> {
    let options: Value = row.parsed("options")?;
    let error = row.text_or_null("error")?;
    let outcome = row.text_or_null("outcome")?;
    let artifacts_expire_at = row.time_or_null("artifacts_expire_at")?;
    let mut artifacts: Vec<ArtifactEntry> = row.parsed("artifacts")?;
    if artifacts_expire_at.is_some_and(|at| at <= now) {
        artifacts.iter_mut().for_each(|a| (a.href, a.expired) = (None, true));
    }
    Ok(Job {
        id: row.text("id")?,
        state: state(&row.text("state")?)?,
        recipe: options.get("recipe").cloned().unwrap_or_default(),
        metadata: options.get("metadata").cloned().unwrap_or_default(),
        options,
        outcome: outcome.and_then(|name| serde_json::from_value(Value::String(name)).ok()),
        progress: row.parsed("progress")?,
        queue_position: row.integer_or_null("position")?.and_then(|p| u64::try_from(p).ok()),
        attempt: row.number("attempt")?,
        created_at: Timestamp(row.integer("created_at")?),
        started_at: row.time_or_null("started_at")?,
        finished_at: row.time_or_null("finished_at")?,
        artifacts_expire_at,
        stages: row.parsed("stages")?,
        timings: row.parsed("timings")?,
        warnings: row.parsed("warnings")?,
        error: error.and_then(|text| serde_json::from_str(&text).ok()),
        artifacts,
    })
}

fn state(name: &str) -> Result<JobState> {
    JobState::from_name(name).ok_or_else(|| Failure::internal("the job queue holds a broken state"))
}

/// Jobs with their states.
pub(super) fn states(rows: &[impl Columns]) -> Result<Vec<(String, JobState)>> {
    rows.iter().map(|row| Ok((row.text("id")?, state(&row.text("state")?)?))).collect()
}

/// States with the number of their jobs.
pub(super) fn counts(rows: &[impl Columns]) -> Result<Vec<(JobState, u64)>> {
    rows.iter().map(|row| Ok((state(&row.text("state")?)?, row.number("count")?))).collect()
}

/// A page of jobs at `now`, with the next cursor where it is as long as it may be.
pub(super) fn page(rows: &[impl Columns], now: Timestamp, limit: u32) -> Result<(Vec<Job>, Option<i64>)> {
    let jobs = rows.iter().map(|row| job(row, now)).collect::<Result<Vec<_>>>()?;
    Ok((jobs, next_cursor(rows, limit)?))
}

/// Where the page behind a full one begins.
pub(super) fn next_cursor(rows: &[impl Columns], limit: u32) -> Result<Option<i64>> {
    let full = rows.len() as u64 == u64::from(limit);
    rows.last().filter(|_| full).map(|row| row.integer("seq")).transpose()
}

/// A job that was just claimed.
pub(super) fn claim(row: &impl Columns) -> Result<Claim> {
    let progress: Value = row.parsed("progress")?;
    Ok(Claim {
        id: row.text("id")?,
        attempt: row.number("attempt")?,
        options: row.parsed("options")?,
        inputs: row.parsed("inputs")?,
        floor: progress.get("fraction").and_then(Value::as_f64).unwrap_or(0.0),
        memory: row.number("memory")?,
        request: row.text_or_null("request")?,
        trace: row.text_or_null("trace")?,
        queued_at: Timestamp(row.integer("queued_at")?),
        suspect: row.flag("suspect")?,
    })
}

/// The artifacts of `source`, as those of a job that has its result.
pub(super) fn reused(source: &impl Columns, job: &NewJob) -> Result<String> {
    let mut artifacts: Vec<ArtifactEntry> = source.parsed("artifacts")?;
    for entry in &mut artifacts {
        entry.href = Some(files::href(&job.id, &entry.name));
    }
    json(&artifacts)
}

/// Bytes of what an attempt publishes.
pub(super) fn artifact_bytes(end: &AttemptEnd) -> i64 {
    integer(end.artifacts.iter().map(|a| a.bytes).sum())
}

/// A key.
pub(super) fn key(row: &impl Columns) -> Result<Key> {
    Ok(Key {
        id: row.text("id")?,
        name: row.text("name")?,
        tenant: row.text("tenant")?,
        scopes: row.parsed("scopes")?,
        quotas: row.parsed("quotas")?,
        created_at: Timestamp(row.integer("created_at")?),
        revoked_at: row.time_or_null("revoked_at")?,
    })
}

/// A receiver.
pub(super) fn webhook(row: &impl Columns) -> Result<Webhook> {
    Ok(Webhook {
        id: row.text("id")?,
        url: row.text("url")?,
        events: row.parsed("events")?,
        created_at: Timestamp(row.integer("created_at")?),
        disabled_at: row.time_or_null("disabled_at")?,
        disabled_because: row.text_or_null("disabled_because")?,
    })
}

/// What a receiver was or is to be told.
pub(super) fn delivery(row: &impl Columns) -> Result<Delivery> {
    let (next_attempt_at, delivered_at) = (row.time_or_null("next_at")?, row.time_or_null("delivered_at")?);
    let state = match (next_attempt_at, delivered_at) {
        (Some(_), _) => DeliveryState::Pending,
        (None, Some(_)) => DeliveryState::Delivered,
        (None, None) => DeliveryState::Failed,
    };
    Ok(Delivery {
        id: row.text("id")?,
        job: row.text("job")?,
        webhook: row.text_or_null("webhook")?,
        event: row.text("event")?,
        state,
        attempts: row.number("attempts")?,
        next_attempt_at,
        created_at: Timestamp(row.integer("created_at")?),
        delivered_at,
        status: row.integer_or_null("status")?.and_then(|status| u16::try_from(status).ok()),
        error: row.text_or_null("error")?,
    })
}

/// A delivery whose time has come.
pub(super) fn due(row: &impl Columns) -> Result<Due> {
    Ok(Due {
        id: row.text("id")?,
        attempt: row.number("attempts")?,
        tenant: row.text("tenant")?,
        webhook: row.text_or_null("webhook")?,
        url: row.text("url")?,
        secrets: row.parsed("secrets")?,
        payload: row.text("payload")?,
        trace: row.text_or_null("trace")?,
    })
}

/// An item of a batch, with its job where there still is one.
pub(super) fn item(row: &impl Columns) -> Result<StoredItem> {
    let job = match row.text_or_null("state")? {
        None => None,
        Some(name) => {
            let (progress, outcome): (Value, _) = (row.parsed("progress")?, row.text_or_null("outcome")?);
            Some(StoredJob {
                state: state(&name)?,
                attempt: row.number("attempt")?,
                outcome: outcome.and_then(|name| serde_json::from_value(Value::String(name)).ok()),
                fraction: progress.get("fraction").and_then(Value::as_f64).unwrap_or(0.0),
                finished_at: row.time_or_null("finished_at")?,
                error: row.text_or_null("error")?.and_then(|text| serde_json::from_str(&text).ok()),
            })
        }
    };
    Ok(StoredItem { id: row.text("job")?, made: row.flag("made")?, job })
}

/// An upload that is sent in pieces.
pub(super) fn upload(row: &impl Columns) -> Result<Upload> {
    let (id, sha256) = (row.text("id")?, row.text_or_null("sha256")?);
    Ok(Upload {
        reference: format!("{PREFIX}{id}"),
        id,
        filename: row.text_or_null("filename")?,
        length: row.number("length")?,
        offset: row.number("received")?,
        complete: sha256.is_some(),
        sha256: match sha256 {
            Some(found) => Some(found),
            None => row.text_or_null("declared")?,
        },
        created_at: Timestamp(row.integer("created_at")?),
        expires_at: Timestamp(row.integer("expires_at")?),
        tenant: row.text("tenant")?,
        metadata: row.text("metadata")?,
    })
}

/// A piece of an upload.
pub(super) fn piece(row: &impl Columns) -> Result<Piece> {
    Ok(Piece { start: row.number("start")?, bytes: row.number("bytes")?, name: row.text("name")? })
}
