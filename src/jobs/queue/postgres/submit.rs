//! How a job gets into the queue: within the transaction of whoever submits it, alone or with others.

use serde_json::Value;
use sqlx::PgConnection;

use super::{Postgres, collect};
use crate::context::Progress;
use crate::error::Result;
use crate::jobs::queue::rows::{Columns, integer, json};
use crate::jobs::queue::{NewJob, Submitted, mismatch, queue_full, quota_of_waiting};

impl Postgres {
    /// Stores a job, as [`Queue::submit`](crate::jobs::queue::Queue::submit) says.
    pub(super) async fn insert(step: &mut PgConnection, new: &NewJob, most: u32) -> Result<Submitted> {
        let (key, fingerprint) = (new.stored_key(), new.key.as_ref().map(|(_, fingerprint)| fingerprint.as_str()));
        let done = sqlx::query(
            "INSERT INTO jobs (id, state, options, inputs, memory, key, fingerprint, request, created_at, queued_at, progress, upload_bytes,
               tenant, size, max_running, result_key, webhook, metadata, trace)
             SELECT $1, 'queued', $2, $3, $4, $5, $6, $7, intarsia_now(), intarsia_now(), $9, $10, $11, CASE $11 WHEN '' THEN 0 ELSE $4 END,
               $12, $14, $15, $16, $17
             WHERE (SELECT count(*) FROM (SELECT 1 FROM jobs WHERE state = 'queued' LIMIT $8) waiting) < $8
               AND ($13::bigint IS NULL OR (SELECT count(*) FROM jobs WHERE state = 'queued' AND tenant = $11) < $13)
             ON CONFLICT (key) DO NOTHING",
        )
        .bind(&new.id)
        .bind(new.options.to_string())
        .bind(json(&new.inputs)?)
        .bind(integer(new.memory))
        .bind(&key)
        .bind(fingerprint)
        .bind(&new.request)
        .bind(i64::from(most))
        .bind(json(&Progress::default())?)
        .bind(integer(new.bytes))
        .bind(&new.tenant)
        .bind(new.max_running.map(i64::from))
        .bind(new.max_queued.map(i64::from))
        .bind(&new.result_key)
        .bind(new.options.get("webhook").and_then(Value::as_str))
        .bind(new.options.get("metadata").filter(|m| !m.is_null()).map_or("{}".to_owned(), Value::to_string))
        .bind(&new.trace)
        .execute(&mut *step)
        .await?;
        if done.rows_affected() > 0 {
            let reused = match &new.result_key {
                Some(key) => collect::reuse(&mut *step, new, key).await?,
                None => false,
            };
            return Ok(if reused { Submitted::Reused } else { Submitted::New });
        }
        let sql = "SELECT id, fingerprint FROM jobs WHERE key = $1";
        let Some(row) = sqlx::query(sql).bind(&key).fetch_optional(&mut *step).await? else {
            let sql = "SELECT count(*) AS count FROM jobs WHERE state = 'queued'";
            let waiting: u64 = sqlx::query(sql).fetch_one(&mut *step).await?.number("count")?;
            return Err(match new.max_queued {
                Some(of_tenant) if waiting < u64::from(most) => quota_of_waiting(of_tenant),
                _ => queue_full(),
            });
        };
        if row.text_or_null("fingerprint")?.as_deref() == fingerprint {
            Ok(Submitted::Known(row.text("id")?))
        } else {
            Err(mismatch())
        }
    }
}
