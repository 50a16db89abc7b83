//! What the queue does by itself: jobs of dead workers run again, jobs that waited too long expire, what is old goes.

use std::time::Duration;

use sqlx::Row;

use super::Jobs;
use super::queue::Queue;
use super::record::{JobError, Moment, State};
use crate::error::{Code, Failure, Result};

/// Attempts that may die before a job is given up.
const MAX_DEATHS: u32 = 3;
/// Uploads without a job that nobody touched for so long are left over.
const LEFT_OVER: Duration = Duration::from_secs(6 * 3600);

impl Queue {
    /// Takes back the running jobs of `owner`, if one is named, and those whose lease ran out. Returns them with their
    /// new states: queued, or final after too many deaths.
    ///
    /// # Errors
    /// `internal`.
    pub async fn recover(&self, owner: Option<&str>) -> Result<Vec<(String, State)>> {
        let died = format!("the process that computed this job died {MAX_DEATHS} times");
        let died = serde_json::json!(JobError::from(Failure::internal(died))).to_string();
        let canceled = Failure::new(Code::Canceled, "the job was cancelled");
        let canceled = serde_json::json!(JobError::from(canceled)).to_string();
        let rows = sqlx::query(
            "UPDATE jobs SET deaths = deaths + 1, owner = NULL, lease_until = NULL,
               state = CASE WHEN cancel_requested THEN 'canceled' WHEN deaths + 1 >= ?2 THEN 'failed' ELSE 'queued' END,
               finished_at = CASE WHEN cancel_requested OR deaths + 1 >= ?2 THEN ?3 END,
               error = CASE WHEN cancel_requested THEN ?5 WHEN deaths + 1 >= ?2 THEN ?4 END
             WHERE state = 'running' AND (owner = ?1 OR lease_until < ?3) RETURNING id, state",
        )
        .bind(owner)
        .bind(MAX_DEATHS)
        .bind(Moment::now().0)
        .bind(died)
        .bind(canceled)
        .fetch_all(&self.pool)
        .await?;
        states(&rows)
    }

    /// The workers that hold jobs.
    ///
    /// # Errors
    /// `internal`.
    pub async fn owners(&self) -> Result<Vec<String>> {
        let rows =
            sqlx::query("SELECT DISTINCT owner FROM jobs WHERE state = 'running' AND owner IS NOT NULL ORDER BY owner")
                .fetch_all(&self.pool)
                .await?;
        rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    /// Expires the jobs that have waited since before `before`.
    ///
    /// # Errors
    /// `internal`.
    pub async fn expire(&self, before: Moment) -> Result<Vec<(String, State)>> {
        let rows = sqlx::query(
            "UPDATE jobs SET state = 'expired', finished_at = ?2
             WHERE state = 'queued' AND attempt = 0 AND created_at < ?1 RETURNING id, state",
        )
        .bind(before.0)
        .bind(Moment::now().0)
        .fetch_all(&self.pool)
        .await?;
        states(&rows)
    }

    /// The jobs whose artifacts have expired; they count as removed from now on.
    ///
    /// # Errors
    /// `internal`.
    pub async fn expire_artifacts(&self) -> Result<Vec<String>> {
        let rows = sqlx::query(
            "UPDATE jobs SET artifacts_removed = 1 WHERE artifacts_removed = 0 AND artifacts_expire_at <= ?1 RETURNING id",
        )
        .bind(Moment::now().0)
        .fetch_all(&self.pool)
        .await?;
        rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    /// Forgets the jobs that ended before `before` and whose artifacts are gone.
    ///
    /// # Errors
    /// `internal`.
    pub async fn forget(&self, before: Moment) -> Result<u64> {
        let done = sqlx::query(
            "DELETE FROM jobs WHERE finished_at < ?1 AND (artifacts_removed = 1 OR artifacts_expire_at IS NULL)",
        )
        .bind(before.0)
        .execute(&self.pool)
        .await?;
        Ok(done.rows_affected())
    }

    /// Whether there is a job of that id.
    ///
    /// # Errors
    /// `internal`.
    pub async fn knows(&self, id: &str) -> Result<bool> {
        let row = sqlx::query("SELECT 1 FROM jobs WHERE id = ?1").bind(id).fetch_optional(&self.pool).await?;
        Ok(row.is_some())
    }
}

fn states(rows: &[sqlx::sqlite::SqliteRow]) -> Result<Vec<(String, State)>> {
    let state = |name: String| State::from_name(&name).ok_or_else(|| Failure::internal("a broken state"));
    rows.iter().map(|row| Ok((row.try_get(0)?, state(row.try_get(1)?)?))).collect()
}

impl Jobs {
    /// Takes back the jobs of processes that are gone: those whose lock can be had, and those whose lease ran out.
    ///
    /// # Errors
    /// `internal`.
    pub async fn recover(&self) -> Result<()> {
        let mut back = self.queue.recover(None).await?;
        for owner in self.queue.owners().await?.iter().filter(|o| **o != self.owner) {
            if self.files.worker_is_gone(owner) {
                back.extend(self.queue.recover(Some(owner)).await?);
            }
        }
        for (job, state) in back {
            tracing::warn!(%job, state = state.as_str(), "took back a job whose worker is gone");
            if state == State::Queued {
                self.hub.requeued(&job);
                self.wake.notify_one();
            } else {
                self.hub.cancel(&job);
                self.hub.ended(&job, state);
                self.files.remove_uploads(&job);
            }
        }
        Ok(())
    }

    /// One round of upkeep; `sweep` also looks for files that belong to no job.
    ///
    /// # Errors
    /// `internal`.
    pub async fn tidy(&self, sweep: bool) -> Result<()> {
        self.recover().await?;
        let now = Moment::now();
        for (job, state) in self.queue.expire(now.minus(self.limits.max_wait)).await? {
            self.hub.ended(&job, state);
            self.files.remove_uploads(&job);
        }
        for job in self.queue.expire_artifacts().await? {
            self.files.remove_artifacts(&job);
        }
        self.files.forget_workers();
        self.queue.forget(now.minus(self.limits.keep_jobs)).await?;
        for job in if sweep { self.files.untouched(LEFT_OVER) } else { Vec::new() } {
            if !self.queue.knows(&job).await? {
                self.files.remove_uploads(&job);
                self.files.remove_artifacts(&job);
            }
        }
        Ok(())
    }
}
