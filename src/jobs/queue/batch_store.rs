//! Batches, beside the queue in its database. SQLite and PostgreSQL read these statements alike; `$jobs` is what holds the jobs, and
//! `$progress` how far one of them is.

/// Makes a backend of the queue a [`BatchStore`](crate::jobs::batches::BatchStore); of it this needs what [`key_store`] does, and `insert`,
/// which submits a job within a transaction.
///
/// [`key_store`]: super::key_store
macro_rules! batch_store {
    ($backend:ident, $jobs:literal, $progress:literal) => {
        mod batch_store {
            use async_trait::async_trait;

            use crate::error::{Code, Result};
            use crate::jobs::batches::{BatchStore, BatchSubmitted, NewBatch, StoredBatch};
            use crate::jobs::queue::rows::{Columns, item};
            use crate::jobs::queue::{Queue, Submitted, mismatch, stored_key};
            use crate::jobs::record::Timestamp;

            #[async_trait]
            impl BatchStore for super::$backend {
                async fn submit_batch(&self, batch: &NewBatch, most: u32) -> Result<BatchSubmitted> {
                    let key = batch.key.as_ref().map(|(key, _)| stored_key(&batch.tenant, key));
                    let fingerprint = batch.key.as_ref().map(|(_, fingerprint)| fingerprint.as_str());
                    let now = Queue::now(self).await?;
                    // Each item has as long as a step may take, and not all of them together.
                    let mut step = self.step(self.begin()).await?;
                    let known = self.step(async {
                        let done = sqlx::query(
                            "INSERT INTO batches (id, tenant, key, fingerprint, metadata, created_at) VALUES ($1, $2, $3, $4, $5, $6)
                             ON CONFLICT (key) DO NOTHING",
                        )
                        .bind(&batch.id)
                        .bind(&batch.tenant)
                        .bind(&key)
                        .bind(fingerprint)
                        .bind(batch.metadata.to_string())
                        .bind(now.0)
                        .execute(&mut *step)
                        .await?;
                        if done.rows_affected() > 0 {
                            return Ok(None);
                        }
                        let sql = "SELECT id, fingerprint FROM batches WHERE key = $1";
                        let row = sqlx::query(sql).bind(&key).fetch_one(&mut *step).await?;
                        if row.text_or_null("fingerprint")?.as_deref() == fingerprint { row.text("id").map(Some) } else { Err(mismatch()) }
                    });
                    // What is not committed is rolled back when it is dropped.
                    if let Some(known) = known.await? {
                        return Ok(BatchSubmitted::Known(known));
                    }
                    let mut submitted = Vec::with_capacity(batch.jobs.len());
                    for (place, new) in batch.jobs.iter().enumerate() {
                        let one = self.step(async {
                            let one = Self::insert(&mut step, new, most).await.map_err(|failure| match failure.code {
                                Code::IdempotencyMismatch => failure.at(format!("/items/{place}/idempotency_key")),
                                _ => failure,
                            })?;
                            let (job, made) = match &one {
                                Submitted::Known(known) => (known, false),
                                _ => (&new.id, true),
                            };
                            sqlx::query("INSERT INTO batch_jobs (batch, item, job, made) VALUES ($1, $2, $3, $4)")
                                .bind(&batch.id)
                                .bind(i64::try_from(place).unwrap_or(i64::MAX))
                                .bind(job)
                                .bind(made)
                                .execute(&mut *step)
                                .await?;
                            Ok(one)
                        });
                        submitted.push(one.await?);
                    }
                    self.step(async { Ok(step.commit().await?) }).await?;
                    self.submitted();
                    Ok(BatchSubmitted::New(submitted))
                }

                async fn batch(&self, id: &str) -> Result<Option<StoredBatch>> {
                    self.step(async move {
                        let sql = "SELECT metadata, created_at FROM batches WHERE id = $1";
                        let Some(batch) = sqlx::query(sql).bind(id).fetch_optional(self.reader()).await? else { return Ok(None) };
                        let rows = sqlx::query(concat!(
                            "SELECT batch_jobs.job, made, state, jobs.attempt, outcome, ", $progress, " AS progress, finished_at, error
                             FROM batch_jobs LEFT JOIN ", $jobs, " ON jobs.id = batch_jobs.job WHERE batch = $1 ORDER BY item",
                        ))
                        .bind(id)
                        .fetch_all(self.reader())
                        .await?;
                        Ok(Some(StoredBatch {
                            id: id.to_owned(),
                            metadata: batch.parsed("metadata")?,
                            created_at: Timestamp(batch.integer("created_at")?),
                            items: rows.iter().map(item).collect::<Result<_>>()?,
                        }))
                    }).await
                }

                async fn tenant_of_batch(&self, id: &str) -> Result<Option<String>> {
                    self.step(async move {
                        let sql = "SELECT tenant FROM batches WHERE id = $1";
                        let row = sqlx::query(sql).bind(id).fetch_optional(self.reader()).await?;
                        row.map(|row| row.text("tenant")).transpose()
                    }).await
                }

                async fn delete_batch(&self, id: &str) -> Result<bool> {
                    self.step(async move {
                        let mut step = self.begin().await?;
                        let done = sqlx::query("DELETE FROM batches WHERE id = $1").bind(id).execute(&mut *step).await?;
                        sqlx::query("DELETE FROM batch_jobs WHERE batch = $1").bind(id).execute(&mut *step).await?;
                        step.commit().await?;
                        Ok(done.rows_affected() > 0)
                    }).await
                }

                async fn purge_batches(&self, before: Timestamp) -> Result<u64> {
                    // Most looks find nothing, and need not write.
                    let found = self.step(async move {
                        let sql = "SELECT id FROM batches WHERE created_at < $1 AND NOT EXISTS
                                     (SELECT 1 FROM batch_jobs JOIN jobs ON jobs.id = batch_jobs.job WHERE batch_jobs.batch = batches.id)";
                        let rows = sqlx::query(sql).bind(before.0).fetch_all(self.reader()).await?;
                        rows.iter().map(|row| row.text("id")).collect::<Result<Vec<_>>>()
                    });
                    let found = found.await?;
                    for id in &found {
                        self.delete_batch(id).await?;
                    }
                    Ok(found.len() as u64)
                }
            }
        }
    };
}

pub(super) use batch_store;
