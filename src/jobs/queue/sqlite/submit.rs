//! How a job gets into the queue: within the transaction of whoever submits it, alone or with others.

use sqlx::{Row, SqliteConnection};

use super::Sqlite;
use crate::context::Progress;
use crate::error::Result;
use crate::jobs::queue::rows::{self, integer, json};
use crate::jobs::queue::{NewJob, Submitted, mismatch, queue_full, quota_of_waiting};
use crate::jobs::record::Timestamp;

impl Sqlite {
    /// Stores a job, as [`crate::jobs::queue::Queue::submit`] says.
    pub(super) async fn insert(step: &mut SqliteConnection, job: &NewJob, most: u32) -> Result<Submitted> {
        let (key, fingerprint) = (job.stored_key(), job.key.as_ref().map(|(_, fingerprint)| fingerprint.as_str()));
        let done = sqlx::query(
            "INSERT INTO jobs (id, state, turn, options, inputs, memory, key, fingerprint, request, created_at, queued_at, progress,
               upload_bytes, tenant, size, max_running, result_key, trace)
             SELECT ?1, 'queued', (SELECT coalesce(max(turn), 0) + 1 FROM jobs WHERE state = 'queued'), ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?8, ?10, ?11,
               ?12, CASE ?12 WHEN '' THEN 0 ELSE ?4 END, ?13, ?15, ?16
             WHERE (SELECT count(*) FROM jobs WHERE state = 'queued') < ?9
               AND (?14 IS NULL OR (SELECT count(*) FROM jobs WHERE state = 'queued' AND tenant = ?12) < ?14)
             ON CONFLICT (key) DO NOTHING",
        )
        .bind(&job.id)
        .bind(job.options.to_string())
        .bind(json(&job.inputs)?)
        .bind(integer(job.memory))
        .bind(&key)
        .bind(fingerprint)
        .bind(&job.request)
        .bind(Timestamp::now().0)
        .bind(most)
        .bind(json(&Progress::default())?)
        .bind(integer(job.bytes))
        .bind(&job.tenant)
        .bind(job.max_running)
        .bind(job.max_queued)
        .bind(&job.result_key)
        .bind(&job.trace)
        .execute(&mut *step)
        .await?;
        if done.rows_affected() > 0 {
            let reused = match &job.result_key {
                Some(key) => reuse(&mut *step, job, key).await?,
                None => false,
            };
            return Ok(if reused { Submitted::Reused } else { Submitted::New });
        }
        let sql = "SELECT id, fingerprint FROM jobs WHERE key = ?1";
        let Some(row) = sqlx::query(sql).bind(&key).fetch_optional(&mut *step).await? else {
            let sql = "SELECT count(*) FROM jobs WHERE state = 'queued'";
            let waiting: i64 = sqlx::query(sql).fetch_one(&mut *step).await?.try_get(0)?;
            return Err(match job.max_queued {
                Some(of_tenant) if waiting < i64::from(most) => quota_of_waiting(of_tenant),
                _ => queue_full(),
            });
        };
        let before: Option<String> = row.try_get(1)?;
        if before.as_deref() == fingerprint { Ok(Submitted::Known(row.try_get(0)?)) } else { Err(mismatch()) }
    }
}

/// Gives a new job the result of an equal one, where there is one; its artifacts stay as long as either job needs them.
async fn reuse(step: &mut SqliteConnection, job: &NewJob, key: &str) -> Result<bool> {
    let now = Timestamp::now();
    let source = sqlx::query(
        "SELECT id, attempt, artifacts FROM jobs WHERE result_key = ?1 AND tenant = ?2 AND state = 'succeeded'
           AND artifacts_removed = 0 AND artifacts_expire_at > ?3 ORDER BY seq DESC LIMIT 1",
    )
    .bind(key)
    .bind(&job.tenant)
    .bind(now.0)
    .fetch_optional(&mut *step)
    .await?;
    let Some(source) = source else { return Ok(false) };
    let (id, attempt): (String, i64) = (source.try_get("id")?, source.try_get("attempt")?);
    sqlx::query(
        "INSERT INTO objects (sha256, job, attempt) SELECT sha256, ?1, 0 FROM objects WHERE job = ?2 AND attempt = ?3",
    )
    .bind(&job.id)
    .bind(&id)
    .bind(attempt)
    .execute(&mut *step)
    .await?;
    sqlx::query(
        "UPDATE jobs SET state = 'succeeded', finished_at = ?3, artifacts_expire_at = ?4, artifacts = ?5,
           (progress, stages, warnings, artifact_bytes, outcome)
             = (SELECT progress, stages, warnings, artifact_bytes, outcome FROM jobs WHERE id = ?2)
         WHERE id = ?1",
    )
    .bind(&job.id)
    .bind(&id)
    .bind(now.0)
    .bind(now.plus(job.keep).0)
    .bind(rows::reused(&source, job)?)
    .execute(&mut *step)
    .await?;
    Ok(true)
}
