//! Receivers and the outbox, beside the queue in its database, which a trigger of the schema fills. SQLite and PostgreSQL read these
//! statements alike; `$for_update` is what keeps others from a row that is read to be written.

/// Makes a backend of the queue a [`WebhookStore`](crate::jobs::webhooks::WebhookStore); of it this needs what [`key_store`] does.
///
/// [`key_store`]: super::key_store
macro_rules! webhook_store {
    ($backend:ident, $for_update:literal) => {
        mod webhook_store {
            use std::time::Duration;

            use async_trait::async_trait;

            use crate::error::Result;
            use crate::jobs::queue::Queue;
            use crate::jobs::queue::rows::{Columns, delivery, due, json, next_cursor, webhook};
            use crate::jobs::record::Timestamp;
            use crate::jobs::webhooks::{
                Delivery, Due, MAX_WEBHOOKS, Replayed, Settled, StoredSecret, Webhook, WebhookStore,
            };

            #[async_trait]
            impl WebhookStore for super::$backend {
                async fn time(&self) -> Result<Timestamp> {
                    Queue::now(self).await
                }

                async fn add_webhook(&self, tenant: &str, webhook: &Webhook, secret: &str) -> Result<bool> {
                    self.step(async move {
                        let done = sqlx::query(
                            "INSERT INTO webhooks (id, tenant, url, events, secrets, created_at)
                             SELECT $1, $2, $3, $4, $5, $6 WHERE (SELECT count(*) FROM webhooks WHERE tenant = $2) < $7",
                        )
                        .bind(&webhook.id)
                        .bind(tenant)
                        .bind(&webhook.url)
                        .bind(json(&webhook.events)?)
                        .bind(json(&[StoredSecret { secret: secret.to_owned(), until: None }])?)
                        .bind(webhook.created_at.0)
                        .bind(i64::from(MAX_WEBHOOKS))
                        .execute(self.writer()?)
                        .await?;
                        Ok(done.rows_affected() > 0)
                    }).await
                }

                async fn webhooks(&self, tenant: &str) -> Result<Vec<Webhook>> {
                    self.step(async move {
                        let sql = "SELECT * FROM webhooks WHERE tenant = $1 ORDER BY created_at DESC, id";
                        let rows = sqlx::query(sql).bind(tenant).fetch_all(self.reader()).await?;
                        rows.iter().map(webhook).collect()
                    }).await
                }

                async fn remove_webhook(&self, tenant: &str, id: &str) -> Result<bool> {
                    self.step(async move {
                        let mut step = self.begin().await?;
                        let sql = "DELETE FROM webhooks WHERE id = $1 AND tenant = $2";
                        let removed = sqlx::query(sql).bind(id).bind(tenant).execute(&mut *step).await?.rows_affected() > 0;
                        if removed {
                            sqlx::query("DELETE FROM deliveries WHERE webhook = $1").bind(id).execute(&mut *step).await?;
                        }
                        step.commit().await?;
                        Ok(removed)
                    }).await
                }

                async fn rotate_secret(&self, tenant: &str, id: &str, secret: &str, until: Timestamp) -> Result<bool> {
                    self.step(async move {
                        let mut step = self.begin().await?;
                        let sql = concat!("SELECT secrets FROM webhooks WHERE id = $1 AND tenant = $2", $for_update);
                        let Some(row) = sqlx::query(sql).bind(id).bind(tenant).fetch_optional(&mut *step).await? else {
                            return Ok(false);
                        };
                        let before: Vec<StoredSecret> = row.parsed("secrets")?;
                        // One that is replaced again and again keeps the last two beside the new one.
                        let before = before.into_iter().take(2).map(|old| {
                            let until = old.until.map_or(until.0, |at| at.min(until.0));
                            StoredSecret { until: Some(until), ..old }
                        });
                        let mut secrets = vec![StoredSecret { secret: secret.to_owned(), until: None }];
                        secrets.extend(before);
                        let sql = "UPDATE webhooks SET secrets = $2 WHERE id = $1";
                        sqlx::query(sql).bind(id).bind(json(&secrets)?).execute(&mut *step).await?;
                        step.commit().await?;
                        Ok(true)
                    }).await
                }

                async fn deliveries(
                    &self,
                    tenant: &str,
                    webhook: &str,
                    cursor: Option<i64>,
                    limit: u32,
                ) -> Result<Option<(Vec<Delivery>, Option<i64>)>> {
                    self.step(async move {
                        let sql = "SELECT 1 FROM webhooks WHERE id = $1 AND tenant = $2";
                        if sqlx::query(sql).bind(webhook).bind(tenant).fetch_optional(self.reader()).await?.is_none() {
                            return Ok(None);
                        }
                        let rows = sqlx::query(
                            "SELECT * FROM deliveries WHERE webhook = $1 AND ($2 IS NULL OR seq < $2) ORDER BY seq DESC LIMIT $3",
                        )
                        .bind(webhook)
                        .bind(cursor)
                        .bind(i64::from(limit))
                        .fetch_all(self.reader())
                        .await?;
                                let next = next_cursor(&rows, limit)?;
                        Ok(Some((rows.iter().map(delivery).collect::<Result<_>>()?, next)))
                    }).await
                }

                async fn replay(&self, tenant: &str, webhook: &str, delivery: &str, now: Timestamp) -> Result<Replayed> {
                    self.step(async move {
                        let rows = sqlx::query(
                            "UPDATE deliveries SET attempts = 0, next_at = $4, delivered_at = NULL, status = NULL, error = NULL
                             WHERE id = $3 AND webhook = $2 AND tenant = $1
                               AND EXISTS (SELECT 1 FROM webhooks WHERE id = $2 AND disabled_at IS NULL)",
                        )
                        .bind(tenant)
                        .bind(webhook)
                        .bind(delivery)
                        .bind(now.0)
                        .execute(self.writer()?)
                        .await?;
                        if rows.rows_affected() > 0 {
                            return Ok(Replayed::Yes);
                        }
                        let sql = "SELECT 1 FROM deliveries WHERE id = $1 AND webhook = $2 AND tenant = $3";
                        let known = sqlx::query(sql).bind(delivery).bind(webhook).bind(tenant).fetch_optional(self.reader()).await?;
                        Ok(if known.is_some() { Replayed::Disabled } else { Replayed::Unknown })
                    }).await
                }

                async fn job_deliveries(&self, job: &str, cursor: Option<i64>, limit: u32) -> Result<(Vec<Delivery>, Option<i64>)> {
                    self.step(async move {
                        let rows = sqlx::query(
                            "SELECT * FROM deliveries WHERE job = $1 AND ($2 IS NULL OR seq < $2) ORDER BY seq DESC LIMIT $3",
                        )
                        .bind(job)
                        .bind(cursor)
                        .bind(i64::from(limit))
                        .fetch_all(self.reader())
                        .await?;
                        Ok((rows.iter().map(delivery).collect::<Result<_>>()?, next_cursor(&rows, limit)?))
                    }).await
                }

                async fn replay_of_job(&self, job: &str, delivery: &str, now: Timestamp) -> Result<Replayed> {
                    self.step(async move {
                        let done = sqlx::query(
                            "UPDATE deliveries SET attempts = 0, next_at = $3, delivered_at = NULL, status = NULL, error = NULL
                             WHERE id = $2 AND job = $1 AND (webhook IS NULL OR EXISTS
                               (SELECT 1 FROM webhooks WHERE webhooks.id = deliveries.webhook AND disabled_at IS NULL))",
                        )
                        .bind(job)
                        .bind(delivery)
                        .bind(now.0)
                        .execute(self.writer()?)
                        .await?;
                        if done.rows_affected() > 0 {
                            return Ok(Replayed::Yes);
                        }
                        let sql = "SELECT 1 FROM deliveries WHERE id = $1 AND job = $2";
                        let known = sqlx::query(sql).bind(delivery).bind(job).fetch_optional(self.reader()).await?;
                        Ok(if known.is_some() { Replayed::Disabled } else { Replayed::Unknown })
                    }).await
                }

                async fn due(&self, now: Timestamp, lease: Duration, limit: u32, per_tenant: u32) -> Result<Vec<Due>> {
                    self.step(async move {
                        // Most looks find nothing, and need not write.
                        let sql = "SELECT 1 FROM deliveries WHERE next_at <= $1 LIMIT 1";
                        if sqlx::query(sql).bind(now.0).fetch_optional(self.reader()).await?.is_none() {
                            return Ok(Vec::new());
                        }
                        let rows = sqlx::query(
                            "UPDATE deliveries SET attempts = attempts + 1, next_at = $2 WHERE seq IN (
                               SELECT seq FROM (
                                 SELECT seq, next_at, row_number() OVER (PARTITION BY tenant ORDER BY next_at, seq) AS place
                                 FROM deliveries WHERE next_at <= $1) due
                               WHERE place <= $4 ORDER BY next_at, seq LIMIT $3) AND next_at <= $1
                             RETURNING id, attempts, tenant, webhook, url, payload,
                               coalesce((SELECT secrets FROM webhooks WHERE webhooks.id = webhook), '[]') AS secrets,
                               (SELECT trace FROM jobs WHERE jobs.id = job) AS trace",
                        )
                        .bind(now.0)
                        .bind(now.plus(lease).0)
                        .bind(i64::from(limit))
                        .bind(i64::from(per_tenant))
                        .fetch_all(self.writer()?)
                        .await?;
                        rows.iter().map(due).collect()
                    }).await
                }

                async fn settle(&self, due: &Due, settled: &Settled) -> Result<bool> {
                    self.step(async move {
                        let mut step = self.begin().await?;
                        let done = sqlx::query(
                            "UPDATE deliveries SET next_at = $3, delivered_at = $4, status = $5, error = $6
                             WHERE id = $1 AND attempts = $2 AND delivered_at IS NULL AND next_at IS NOT NULL",
                        )
                        .bind(&due.id)
                        .bind(i64::from(due.attempt))
                        .bind(settled.next_at.map(|at| at.0))
                        .bind(settled.delivered_at.map(|at| at.0))
                        .bind(settled.status.map(i64::from))
                        .bind(&settled.error)
                        .execute(&mut *step)
                        .await?;
                        if let (Some(at), Some(webhook)) = (settled.gone, &due.webhook) {
                            sqlx::query(
                                "UPDATE webhooks SET disabled_at = $2, disabled_because = $3 WHERE id = $1 AND disabled_at IS NULL",
                            )
                            .bind(webhook)
                            .bind(at.0)
                            .bind(&settled.error)
                            .execute(&mut *step)
                            .await?;
                            sqlx::query("UPDATE deliveries SET next_at = NULL, error = $2 WHERE webhook = $1 AND next_at IS NOT NULL")
                                .bind(webhook)
                                .bind(&settled.error)
                                .execute(&mut *step)
                                .await?;
                        }
                        step.commit().await?;
                        Ok(done.rows_affected() > 0)
                    }).await
                }

                async fn purge_deliveries(&self, before: Timestamp) -> Result<u64> {
                    self.step(async move {
                        let sql = "DELETE FROM deliveries WHERE created_at < $1 AND next_at IS NULL";
                        Ok(sqlx::query(sql).bind(before.0).execute(self.writer()?).await?.rows_affected())
                    }).await
                }
            }
        }
    };
}

pub(super) use webhook_store;
