//! Receivers and the outbox, beside the queue in its database. A trigger of the schema fills the outbox.

use std::time::Duration;

use async_trait::async_trait;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::Sqlite;
use super::rows::{json, parsed};
use crate::error::Result;
use crate::jobs::record::Timestamp;
use crate::jobs::webhooks::{
    Delivery, DeliveryState, Due, MAX_WEBHOOKS, Replayed, Settled, StoredSecret, Webhook, WebhookStore,
};

#[async_trait]
impl WebhookStore for Sqlite {
    async fn add_webhook(&self, tenant: &str, webhook: &Webhook, secret: &str) -> Result<bool> {
        let done = sqlx::query(
            "INSERT INTO webhooks (id, tenant, url, events, secrets, created_at)
             SELECT ?1, ?2, ?3, ?4, ?5, ?6 WHERE (SELECT count(*) FROM webhooks WHERE tenant = ?2) < ?7",
        )
        .bind(&webhook.id)
        .bind(tenant)
        .bind(&webhook.url)
        .bind(json(&webhook.events)?)
        .bind(json(&[StoredSecret { secret: secret.to_owned(), until: None }])?)
        .bind(webhook.created_at.0)
        .bind(MAX_WEBHOOKS)
        .execute(self.pool()?)
        .await?;
        Ok(done.rows_affected() > 0)
    }

    async fn webhooks(&self, tenant: &str) -> Result<Vec<Webhook>> {
        let sql = "SELECT * FROM webhooks WHERE tenant = ?1 ORDER BY created_at DESC, id";
        let rows = sqlx::query(sql).bind(tenant).fetch_all(&self.pool).await?;
        rows.iter().map(webhook).collect()
    }

    async fn remove_webhook(&self, tenant: &str, id: &str) -> Result<bool> {
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let sql = "DELETE FROM webhooks WHERE id = ?1 AND tenant = ?2";
        let removed = sqlx::query(sql).bind(id).bind(tenant).execute(&mut *step).await?.rows_affected() > 0;
        if removed {
            sqlx::query("DELETE FROM deliveries WHERE webhook = ?1").bind(id).execute(&mut *step).await?;
        }
        step.commit().await?;
        Ok(removed)
    }

    async fn rotate_secret(&self, tenant: &str, id: &str, secret: &str, until: Timestamp) -> Result<bool> {
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let sql = "SELECT secrets FROM webhooks WHERE id = ?1 AND tenant = ?2";
        let Some(row) = sqlx::query(sql).bind(id).bind(tenant).fetch_optional(&mut *step).await? else {
            return Ok(false);
        };
        let before: Vec<StoredSecret> = parsed(&row, "secrets")?;
        // One that is replaced again and again keeps the last two beside the new one.
        let before = before.into_iter().take(2).map(|old| {
            let until = old.until.map_or(until.0, |at| at.min(until.0));
            StoredSecret { until: Some(until), ..old }
        });
        let mut secrets = vec![StoredSecret { secret: secret.to_owned(), until: None }];
        secrets.extend(before);
        let sql = "UPDATE webhooks SET secrets = ?2 WHERE id = ?1";
        sqlx::query(sql).bind(id).bind(json(&secrets)?).execute(&mut *step).await?;
        step.commit().await?;
        Ok(true)
    }

    async fn deliveries(
        &self,
        tenant: &str,
        webhook: &str,
        cursor: Option<i64>,
        limit: u32,
    ) -> Result<Option<(Vec<Delivery>, Option<i64>)>> {
        let sql = "SELECT 1 FROM webhooks WHERE id = ?1 AND tenant = ?2";
        if sqlx::query(sql).bind(webhook).bind(tenant).fetch_optional(&self.pool).await?.is_none() {
            return Ok(None);
        }
        let rows = sqlx::query(
            "SELECT * FROM deliveries WHERE webhook = ?1 AND (?2 IS NULL OR seq < ?2) ORDER BY seq DESC LIMIT ?3",
        )
        .bind(webhook)
        .bind(cursor)
        .bind(limit)
        .fetch_all(&self.pool)
        .await?;
        page(&rows, limit).map(Some)
    }

    async fn replay(&self, tenant: &str, webhook: &str, delivery: &str, now: Timestamp) -> Result<Replayed> {
        let rows = sqlx::query(
            "UPDATE deliveries SET attempts = 0, next_at = ?4, delivered_at = NULL, status = NULL, error = NULL
             WHERE id = ?3 AND webhook = ?2 AND tenant = ?1
               AND EXISTS (SELECT 1 FROM webhooks WHERE id = ?2 AND disabled_at IS NULL)",
        )
        .bind(tenant)
        .bind(webhook)
        .bind(delivery)
        .bind(now.0)
        .execute(self.pool()?)
        .await?;
        if rows.rows_affected() > 0 {
            return Ok(Replayed::Yes);
        }
        let sql = "SELECT 1 FROM deliveries WHERE id = ?1 AND webhook = ?2 AND tenant = ?3";
        let known = sqlx::query(sql).bind(delivery).bind(webhook).bind(tenant).fetch_optional(&self.pool).await?;
        Ok(if known.is_some() { Replayed::Disabled } else { Replayed::Unknown })
    }

    async fn job_deliveries(&self, job: &str, cursor: Option<i64>, limit: u32) -> Result<(Vec<Delivery>, Option<i64>)> {
        let sql = "SELECT * FROM deliveries WHERE job = ?1 AND (?2 IS NULL OR seq < ?2) ORDER BY seq DESC LIMIT ?3";
        let rows = sqlx::query(sql).bind(job).bind(cursor).bind(limit).fetch_all(&self.pool).await?;
        page(&rows, limit)
    }

    async fn replay_of_job(&self, job: &str, delivery: &str, now: Timestamp) -> Result<Replayed> {
        let done = sqlx::query(
            "UPDATE deliveries SET attempts = 0, next_at = ?3, delivered_at = NULL, status = NULL, error = NULL
             WHERE id = ?2 AND job = ?1
               AND (webhook IS NULL OR EXISTS (SELECT 1 FROM webhooks WHERE id = webhook AND disabled_at IS NULL))",
        )
        .bind(job)
        .bind(delivery)
        .bind(now.0)
        .execute(self.pool()?)
        .await?;
        if done.rows_affected() > 0 {
            return Ok(Replayed::Yes);
        }
        let sql = "SELECT 1 FROM deliveries WHERE id = ?1 AND job = ?2";
        let known = sqlx::query(sql).bind(delivery).bind(job).fetch_optional(&self.pool).await?;
        Ok(if known.is_some() { Replayed::Disabled } else { Replayed::Unknown })
    }

    async fn due(&self, now: Timestamp, lease: Duration, limit: u32, per_tenant: u32) -> Result<Vec<Due>> {
        // Most looks find nothing, and need not write.
        let sql = "SELECT 1 FROM deliveries WHERE next_at <= ?1 LIMIT 1";
        if sqlx::query(sql).bind(now.0).fetch_optional(&self.pool).await?.is_none() {
            return Ok(Vec::new());
        }
        let rows = sqlx::query(
            "UPDATE deliveries SET attempts = attempts + 1, next_at = ?2 WHERE seq IN (
               SELECT seq FROM (
                 SELECT seq, next_at, row_number() OVER (PARTITION BY tenant ORDER BY next_at, seq) AS place
                 FROM deliveries WHERE next_at <= ?1)
               WHERE place <= ?4 ORDER BY next_at, seq LIMIT ?3)
             RETURNING id, attempts, tenant, webhook, url, payload,
               coalesce((SELECT secrets FROM webhooks WHERE webhooks.id = webhook), '[]') AS secrets,
               (SELECT trace FROM jobs WHERE jobs.id = job) AS trace",
        )
        .bind(now.0)
        .bind(now.plus(lease).0)
        .bind(limit)
        .bind(per_tenant)
        .fetch_all(self.pool()?)
        .await?;
        let due = |row: &SqliteRow| {
            Ok(Due {
                id: row.try_get("id")?,
                attempt: row.try_get("attempts")?,
                tenant: row.try_get("tenant")?,
                webhook: row.try_get("webhook")?,
                url: row.try_get("url")?,
                secrets: parsed(row, "secrets")?,
                payload: row.try_get("payload")?,
                trace: row.try_get("trace")?,
            })
        };
        rows.iter().map(due).collect()
    }

    async fn settle(&self, due: &Due, settled: &Settled) -> Result<bool> {
        let mut step = self.pool()?.begin_with("BEGIN IMMEDIATE").await?;
        let done = sqlx::query(
            "UPDATE deliveries SET next_at = ?3, delivered_at = ?4, status = ?5, error = ?6
             WHERE id = ?1 AND attempts = ?2 AND delivered_at IS NULL AND next_at IS NOT NULL",
        )
        .bind(&due.id)
        .bind(due.attempt)
        .bind(settled.next_at.map(|at| at.0))
        .bind(settled.delivered_at.map(|at| at.0))
        .bind(settled.status)
        .bind(&settled.error)
        .execute(&mut *step)
        .await?;
        if let (Some(at), Some(webhook)) = (settled.gone, &due.webhook) {
            sqlx::query(
                "UPDATE webhooks SET disabled_at = ?2, disabled_because = ?3 WHERE id = ?1 AND disabled_at IS NULL",
            )
            .bind(webhook)
            .bind(at.0)
            .bind(&settled.error)
            .execute(&mut *step)
            .await?;
            sqlx::query("UPDATE deliveries SET next_at = NULL, error = ?2 WHERE webhook = ?1 AND next_at IS NOT NULL")
                .bind(webhook)
                .bind(&settled.error)
                .execute(&mut *step)
                .await?;
        }
        step.commit().await?;
        Ok(done.rows_affected() > 0)
    }

    async fn purge_deliveries(&self, before: Timestamp) -> Result<u64> {
        let sql = "DELETE FROM deliveries WHERE created_at < ?1 AND next_at IS NULL";
        Ok(sqlx::query(sql).bind(before.0).execute(self.pool()?).await?.rows_affected())
    }
}

/// A page of deliveries, and the cursor of the next.
fn page(rows: &[SqliteRow], limit: u32) -> Result<(Vec<Delivery>, Option<i64>)> {
    let full = rows.len() as u64 == u64::from(limit);
    let next = rows.last().filter(|_| full).map(|row| row.try_get("seq")).transpose()?;
    Ok((rows.iter().map(delivery).collect::<Result<_>>()?, next))
}

fn webhook(row: &SqliteRow) -> Result<Webhook> {
    Ok(Webhook {
        id: row.try_get("id")?,
        url: row.try_get("url")?,
        events: parsed(row, "events")?,
        created_at: Timestamp(row.try_get("created_at")?),
        disabled_at: row.try_get::<Option<i64>, _>("disabled_at")?.map(Timestamp),
        disabled_because: row.try_get("disabled_because")?,
    })
}

fn delivery(row: &SqliteRow) -> Result<Delivery> {
    let time = |column: &str| row.try_get::<Option<i64>, _>(column).map(|at| at.map(Timestamp));
    let (next_attempt_at, delivered_at) = (time("next_at")?, time("delivered_at")?);
    let state = match (next_attempt_at, delivered_at) {
        (Some(_), _) => DeliveryState::Pending,
        (None, Some(_)) => DeliveryState::Delivered,
        (None, None) => DeliveryState::Failed,
    };
    Ok(Delivery {
        id: row.try_get("id")?,
        job: row.try_get("job")?,
        webhook: row.try_get("webhook")?,
        event: row.try_get("event")?,
        state,
        attempts: row.try_get("attempts")?,
        next_attempt_at,
        created_at: Timestamp(row.try_get("created_at")?),
        delivered_at,
        status: row.try_get("status")?,
        error: row.try_get("error")?,
    })
}
