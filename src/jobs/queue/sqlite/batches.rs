//! Batches, beside the queue in its database.

use async_trait::async_trait;
use serde_json::Value;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::rows::parsed;
use super::{Sqlite, submit};
use crate::error::{Code, Failure, Result};
use crate::jobs::batches::{BatchStore, BatchSubmitted, NewBatch, StoredBatch, StoredItem, StoredJob};
use crate::jobs::queue::{Submitted, mismatch, stored_key};
use crate::jobs::record::{JobState, Timestamp};

#[async_trait]
impl BatchStore for Sqlite {
    async fn submit_batch(&self, batch: &NewBatch, most: u32) -> Result<BatchSubmitted> {
        let key = batch.key.as_ref().map(|(key, _)| stored_key(&batch.tenant, key));
        let fingerprint = batch.key.as_ref().map(|(_, fingerprint)| fingerprint);
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let done = sqlx::query(
            "INSERT INTO batches (id, tenant, key, fingerprint, metadata, created_at) VALUES (?1, ?2, ?3, ?4, ?5, ?6)
             ON CONFLICT (key) DO NOTHING",
        )
        .bind(&batch.id)
        .bind(&batch.tenant)
        .bind(&key)
        .bind(fingerprint)
        .bind(batch.metadata.to_string())
        .bind(Timestamp::now().0)
        .execute(&mut *step)
        .await?;
        if done.rows_affected() == 0 {
            let sql = "SELECT id, fingerprint FROM batches WHERE key = ?1";
            let row = sqlx::query(sql).bind(&key).fetch_one(&mut *step).await?;
            step.rollback().await?;
            let before: Option<String> = row.try_get(1)?;
            return if before.as_ref() == fingerprint {
                Ok(BatchSubmitted::Known(row.try_get(0)?))
            } else {
                Err(mismatch())
            };
        }
        let mut submitted = Vec::with_capacity(batch.jobs.len());
        for (item, new) in batch.jobs.iter().enumerate() {
            let one = submit::insert(&mut step, new, most).await.map_err(|failure| match failure.code {
                Code::IdempotencyMismatch => failure.at(format!("/items/{item}/idempotency_key")),
                _ => failure,
            });
            let one = match one {
                Ok(one) => one,
                Err(failure) => {
                    step.rollback().await?;
                    return Err(failure);
                }
            };
            let (job, made) = match &one {
                Submitted::Known(known) => (known, false),
                _ => (&new.id, true),
            };
            sqlx::query("INSERT INTO batch_jobs (batch, item, job, made) VALUES (?1, ?2, ?3, ?4)")
                .bind(&batch.id)
                .bind(i64::try_from(item).unwrap_or(i64::MAX))
                .bind(job)
                .bind(made)
                .execute(&mut *step)
                .await?;
            submitted.push(one);
        }
        step.commit().await?;
        Ok(BatchSubmitted::New(submitted))
    }

    async fn batch(&self, id: &str) -> Result<Option<StoredBatch>> {
        let sql = "SELECT metadata, created_at FROM batches WHERE id = ?1";
        let Some(batch) = sqlx::query(sql).bind(id).fetch_optional(&self.pool).await? else { return Ok(None) };
        let rows = sqlx::query(
            "SELECT job, made, state, attempt, outcome, progress, finished_at, error FROM batch_jobs LEFT JOIN jobs ON jobs.id = job
             WHERE batch = ?1 ORDER BY item",
        )
        .bind(id)
        .fetch_all(&self.pool)
        .await?;
        Ok(Some(StoredBatch {
            id: id.to_owned(),
            metadata: parsed(&batch, "metadata")?,
            created_at: Timestamp(batch.try_get("created_at")?),
            items: rows.iter().map(item).collect::<Result<_>>()?,
        }))
    }

    async fn tenant_of_batch(&self, id: &str) -> Result<Option<String>> {
        let row = sqlx::query("SELECT tenant FROM batches WHERE id = ?1").bind(id).fetch_optional(&self.pool).await?;
        Ok(row.map(|row| row.try_get(0)).transpose()?)
    }

    async fn delete_batch(&self, id: &str) -> Result<bool> {
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let done = sqlx::query("DELETE FROM batches WHERE id = ?1").bind(id).execute(&mut *step).await?;
        sqlx::query("DELETE FROM batch_jobs WHERE batch = ?1").bind(id).execute(&mut *step).await?;
        step.commit().await?;
        Ok(done.rows_affected() > 0)
    }

    async fn purge_batches(&self, before: Timestamp) -> Result<u64> {
        // Most looks find nothing, and need not write.
        let sql = "SELECT id FROM batches WHERE created_at < ?1 AND NOT EXISTS
                     (SELECT 1 FROM batch_jobs JOIN jobs ON jobs.id = job WHERE batch = batches.id)";
        let rows = sqlx::query(sql).bind(before.0).fetch_all(&self.pool).await?;
        for row in &rows {
            self.delete_batch(row.try_get(0)?).await?;
        }
        Ok(rows.len() as u64)
    }
}

fn item(row: &SqliteRow) -> Result<StoredItem> {
    let state: Option<String> = row.try_get("state")?;
    let job = match state {
        None => None,
        Some(state) => {
            let (progress, outcome): (Value, Option<String>) = (parsed(row, "progress")?, row.try_get("outcome")?);
            let error: Option<String> = row.try_get("error")?;
            Some(StoredJob {
                state: JobState::from_name(&state)
                    .ok_or_else(|| Failure::internal("the job queue holds a broken state"))?,
                attempt: row.try_get("attempt")?,
                outcome: outcome.and_then(|name| serde_json::from_value(Value::String(name)).ok()),
                fraction: progress.get("fraction").and_then(Value::as_f64).unwrap_or(0.0),
                finished_at: row.try_get::<Option<i64>, _>("finished_at")?.map(Timestamp),
                error: error.and_then(|text| serde_json::from_str(&text).ok()),
            })
        }
    };
    Ok(StoredItem { id: row.try_get("job")?, made: row.try_get("made")?, job })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn it_keeps_batches() {
        let root = tempfile::tempdir().unwrap();
        let queue = Sqlite::open(&root.path().join("q")).await.unwrap();
        crate::jobs::batches::conformance::suite(&queue).await;
    }
}
