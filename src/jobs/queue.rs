//! The durable queue: one SQLite table. All SQL of jobs stands here and in the files beside it.
//!
//! A claim is one statement. Each claim gets a new attempt number, and whatever a worker writes afterwards names that
//! number (a fencing token): a worker that lost its job can change nothing. A lease says how long a silent worker is
//! believed to be alive.

use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use sqlx::Row;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};

use super::files::Manifest;
use super::record::{Entry, Job, JobError, Moment, State};
use super::rows::{job, json, parsed};
use crate::context::{Progress, Timing};
use crate::error::{Code, Failure, Result, Warning};

/// Version of the table, kept in the database's `user_version`.
const VERSION: i64 = 1;

/// The queue.
#[derive(Debug, Clone)]
pub struct Queue {
    pub(super) pool: SqlitePool,
}

/// A job that its worker holds.
#[derive(Debug, Clone)]
pub struct Claim {
    /// The job.
    pub id: String,
    /// Its attempt: the fencing token.
    pub attempt: u32,
    /// Its options, as stored.
    pub options: Value,
    /// What was uploaded.
    pub inputs: Manifest,
    /// The fraction that its users have seen.
    pub floor: f64,
}

/// What a heartbeat learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Beat {
    /// Go on.
    Held,
    /// The user wants it to stop.
    Cancel,
    /// The job is no longer the worker's.
    Lost,
}

/// How an attempt ended.
#[derive(Debug, Clone)]
pub struct End {
    /// A final state.
    pub state: State,
    /// Why it failed.
    pub error: Option<JobError>,
    /// Its results.
    pub artifacts: Vec<Entry>,
    /// Its last progress.
    pub progress: Progress,
    /// Seconds by stage.
    pub timings: Vec<Timing>,
    /// Its warnings.
    pub warnings: Vec<Warning>,
}

/// What became of a wish to cancel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Canceled {
    /// It was waiting and is cancelled.
    AtOnce,
    /// It runs and was told.
    Asked,
    /// Its state is final.
    Final,
    /// There is no such job.
    Unknown,
}

impl Queue {
    /// Opens the database, or makes it.
    ///
    /// # Errors
    /// `internal`: the disk, or a database of a newer version.
    pub async fn open(path: &Path) -> Result<Self> {
        let options = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            // A job is acknowledged only when it would survive a loss of power.
            .synchronous(SqliteSynchronous::Full)
            .busy_timeout(Duration::from_secs(20));
        let pool = SqlitePoolOptions::new().max_connections(4).connect_with(options).await?;
        let mut connection = pool.begin_with("BEGIN IMMEDIATE").await?;
        let version: i64 = sqlx::query("PRAGMA user_version").fetch_one(&mut *connection).await?.try_get(0)?;
        match version {
            VERSION => {}
            0 => {
                sqlx::raw_sql(include_str!("queue.sql")).execute(&mut *connection).await?;
                sqlx::raw_sql("PRAGMA user_version = 1").execute(&mut *connection).await?;
            }
            other => {
                return Err(Failure::internal(format!("the queue has version {other}; this program knows {VERSION}")));
            }
        }
        connection.commit().await?;
        Ok(Queue { pool })
    }

    /// Stores a new job. When this returns, the job survives anything.
    ///
    /// # Errors
    /// `queue_full` when `most` jobs wait; `internal`.
    pub async fn submit(&self, id: &str, options: &Value, inputs: &Manifest, most: u32) -> Result<()> {
        let done = sqlx::query(
            "INSERT INTO jobs (id, state, options, inputs, created_at)
             SELECT ?1, 'queued', ?2, ?3, ?4 WHERE (SELECT count(*) FROM jobs WHERE state = 'queued') < ?5",
        )
        .bind(id)
        .bind(options.to_string())
        .bind(json(inputs)?)
        .bind(Moment::now().0)
        .bind(most)
        .execute(&self.pool)
        .await?;
        if done.rows_affected() == 0 { Err(queue_full()) } else { Ok(()) }
    }

    /// Number of jobs that wait.
    ///
    /// # Errors
    /// `internal`.
    pub async fn waiting(&self) -> Result<u32> {
        let row = sqlx::query("SELECT count(*) FROM jobs WHERE state = 'queued'").fetch_one(&self.pool).await?;
        Ok(row.try_get(0)?)
    }

    /// A job.
    ///
    /// # Errors
    /// `internal`.
    pub async fn get(&self, id: &str) -> Result<Option<Job>> {
        let row = sqlx::query(
            "SELECT *, CASE state WHEN 'queued' THEN
               (SELECT count(*) FROM jobs other WHERE other.state = 'queued' AND other.seq <= jobs.seq) END AS position
             FROM jobs WHERE id = ?1",
        )
        .bind(id)
        .fetch_optional(&self.pool)
        .await?;
        row.as_ref().map(job).transpose()
    }

    /// A page of jobs, the newest first: those under `cursor`, and the next cursor.
    ///
    /// # Errors
    /// `internal`.
    pub async fn list(&self, state: Option<State>, cursor: Option<i64>, limit: u32) -> Result<(Vec<Job>, Option<i64>)> {
        let rows = sqlx::query(
            "SELECT *, CASE state WHEN 'queued' THEN
               (SELECT count(*) FROM jobs other WHERE other.state = 'queued' AND other.seq <= jobs.seq) END AS position
             FROM jobs WHERE (?1 IS NULL OR state = ?1) AND (?2 IS NULL OR seq < ?2) ORDER BY seq DESC LIMIT ?3",
        )
        .bind(state.map(State::as_str))
        .bind(cursor)
        .bind(limit)
        .fetch_all(&self.pool)
        .await?;
        let jobs = rows.iter().map(job).collect::<Result<Vec<_>>>()?;
        let full = jobs.len() as u64 == u64::from(limit);
        let next = rows.last().filter(|_| full).map(|row| row.try_get("seq")).transpose()?;
        Ok((jobs, next))
    }

    /// The attempt that an artifact's files stand under, and whether they have been removed.
    ///
    /// # Errors
    /// `internal`.
    pub async fn result(&self, id: &str) -> Result<Option<(u32, Vec<Entry>, bool)>> {
        let row =
            sqlx::query("SELECT attempt, artifacts, artifacts_removed, artifacts_expire_at FROM jobs WHERE id = ?1")
                .bind(id)
                .fetch_optional(&self.pool)
                .await?;
        let Some(row) = row else { return Ok(None) };
        let removed: bool = row.try_get("artifacts_removed")?;
        let expires: Option<i64> = row.try_get("artifacts_expire_at")?;
        let expired = expires.is_some_and(|at| at <= Moment::now().0);
        Ok(Some((row.try_get("attempt")?, parsed(&row, "artifacts")?, removed || expired)))
    }

    /// Takes the job that waited longest.
    ///
    /// # Errors
    /// `internal`.
    pub async fn claim(&self, owner: &str, lease: Duration) -> Result<Option<Claim>> {
        let now = Moment::now();
        let rows = sqlx::query(
            "UPDATE jobs SET state = 'running', attempt = attempt + 1, owner = ?1, lease_until = ?2, started_at = ?3,
               warnings = '[]', timings = '[]'
             WHERE seq = (SELECT seq FROM jobs WHERE state = 'queued' ORDER BY seq LIMIT 1) AND state = 'queued'
             RETURNING id, attempt, options, inputs, progress",
        )
        .bind(owner)
        .bind(now.plus(lease).0)
        .bind(now.0)
        .fetch_all(&self.pool)
        .await?;
        let Some(row) = rows.first() else { return Ok(None) };
        let progress: Value = parsed(row, "progress")?;
        Ok(Some(Claim {
            id: row.try_get("id")?,
            attempt: row.try_get("attempt")?,
            options: parsed(row, "options")?,
            inputs: parsed(row, "inputs")?,
            floor: progress.get("fraction").and_then(Value::as_f64).unwrap_or(0.0),
        }))
    }

    /// Renews the lease and notes how far the job is.
    ///
    /// # Errors
    /// `internal`.
    pub async fn beat(
        &self,
        claim: &Claim,
        lease: Duration,
        progress: &Progress,
        warnings: &[Warning],
    ) -> Result<Beat> {
        let rows = sqlx::query(
            "UPDATE jobs SET lease_until = ?3, progress = ?4, warnings = ?5
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' RETURNING cancel_requested",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(Moment::now().plus(lease).0)
        .bind(json(progress)?)
        .bind(json(&warnings)?)
        .fetch_all(&self.pool)
        .await?;
        match rows.first() {
            None => Ok(Beat::Lost),
            Some(row) if row.try_get(0)? => Ok(Beat::Cancel),
            Some(_) => Ok(Beat::Held),
        }
    }

    /// Publishes how an attempt ended, in one step. False when the job is not the worker's any more, or when its user
    /// cancelled it and `end` is no cancellation.
    ///
    /// # Errors
    /// `internal`.
    pub async fn finish(&self, claim: &Claim, end: &End, keep: Duration) -> Result<bool> {
        let now = Moment::now();
        let done = sqlx::query(
            "UPDATE jobs SET state = ?3, finished_at = ?4, artifacts_expire_at = ?5, progress = ?6, timings = ?7, warnings = ?8,
               error = ?9, artifacts = ?10, owner = NULL, lease_until = NULL
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' AND (cancel_requested = 0 OR ?3 = 'canceled')",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(end.state.as_str())
        .bind(now.0)
        .bind((!end.artifacts.is_empty()).then(|| now.plus(keep).0))
        .bind(json(&end.progress)?)
        .bind(json(&end.timings)?)
        .bind(json(&end.warnings)?)
        .bind(end.error.as_ref().map(json).transpose()?)
        .bind(json(&end.artifacts)?)
        .execute(&self.pool)
        .await?;
        Ok(done.rows_affected() > 0)
    }

    /// Puts a job back because its process goes down in an orderly way. False when it is not the worker's any more, or
    /// when its user cancelled it.
    ///
    /// # Errors
    /// `internal`.
    pub async fn release(&self, claim: &Claim, progress: &Progress) -> Result<bool> {
        let done = sqlx::query(
            "UPDATE jobs SET state = 'queued', owner = NULL, lease_until = NULL, progress = ?3
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' AND cancel_requested = 0",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(json(progress)?)
        .execute(&self.pool)
        .await?;
        Ok(done.rows_affected() > 0)
    }

    /// Cancels a job that waits, or asks for it when it runs.
    ///
    /// # Errors
    /// `internal`.
    pub async fn cancel(&self, id: &str) -> Result<Canceled> {
        let error = JobError::from(Failure::new(Code::Canceled, "the job was cancelled before it ran"));
        let rows = sqlx::query(
            "UPDATE jobs SET cancel_requested = 1,
               finished_at = CASE state WHEN 'queued' THEN ?2 END, error = CASE state WHEN 'queued' THEN ?3 END,
               state = CASE state WHEN 'queued' THEN 'canceled' ELSE state END
             WHERE id = ?1 AND state IN ('queued', 'running') RETURNING state",
        )
        .bind(id)
        .bind(Moment::now().0)
        .bind(json(&error)?)
        .fetch_all(&self.pool)
        .await?;
        if let Some(row) = rows.first() {
            let state: String = row.try_get(0)?;
            return Ok(if state == "running" { Canceled::Asked } else { Canceled::AtOnce });
        }
        let known = sqlx::query("SELECT 1 FROM jobs WHERE id = ?1").bind(id).fetch_optional(&self.pool).await?;
        Ok(if known.is_some() { Canceled::Final } else { Canceled::Unknown })
    }

    /// Forgets a job. False when there is none.
    ///
    /// # Errors
    /// `internal`.
    pub async fn delete(&self, id: &str) -> Result<bool> {
        let done = sqlx::query("DELETE FROM jobs WHERE id = ?1").bind(id).execute(&self.pool).await?;
        Ok(done.rows_affected() > 0)
    }
}

/// What a full queue answers.
pub fn queue_full() -> Failure {
    Failure::new(Code::QueueFull, "the queue is full; try again later")
}

impl From<sqlx::Error> for Failure {
    fn from(error: sqlx::Error) -> Self {
        tracing::error!(%error, "the queue failed");
        Failure::internal("the job queue failed")
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const LEASE: Duration = Duration::from_secs(60);

    async fn queue() -> (tempfile::TempDir, Queue) {
        let root = tempfile::tempdir().unwrap();
        let queue = Queue::open(&root.path().join("queue.sqlite")).await.unwrap();
        (root, queue)
    }

    async fn submit(queue: &Queue, id: &str) {
        let options = json!({"recipe": "pack", "metadata": {"a": 1}});
        queue.submit(id, &options, &Manifest::default(), 100).await.unwrap();
    }

    fn succeeded() -> End {
        End {
            state: State::Succeeded,
            error: None,
            artifacts: Vec::new(),
            progress: Progress { fraction: 1.0, ..Progress::default() },
            timings: Vec::new(),
            warnings: Vec::new(),
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 4)]
    async fn every_job_is_claimed_once_and_in_order() {
        let (_root, queue) = queue().await;
        for n in 0..40 {
            submit(&queue, &format!("{n:02}")).await;
        }
        let workers = (0..4).map(|w| {
            let queue = queue.clone();
            tokio::spawn(async move {
                let mut mine = Vec::new();
                while let Some(claim) = queue.claim(&format!("w{w}"), LEASE).await.unwrap() {
                    mine.push(claim.id);
                }
                mine
            })
        });
        let mut all = Vec::new();
        for worker in workers.collect::<Vec<_>>() {
            let mine = worker.await.unwrap();
            assert!(mine.is_sorted(), "{mine:?}");
            all.extend(mine);
        }
        all.sort();
        assert_eq!(all, (0..40).map(|n| format!("{n:02}")).collect::<Vec<_>>());
    }

    #[tokio::test]
    async fn a_worker_that_lost_its_job_changes_nothing() {
        let (_root, queue) = queue().await;
        submit(&queue, "j").await;
        let stale = queue.claim("a", LEASE).await.unwrap().unwrap();
        assert_eq!(queue.recover(Some("a")).await.unwrap(), [("j".to_owned(), State::Queued)]);
        let fresh = queue.claim("b", LEASE).await.unwrap().unwrap();
        assert_eq!((stale.attempt, fresh.attempt), (1, 2));
        assert_eq!(queue.beat(&stale, LEASE, &Progress::default(), &[]).await, Ok(Beat::Lost));
        assert_eq!(queue.finish(&stale, &succeeded(), LEASE).await, Ok(false));
        assert_eq!(queue.release(&stale, &Progress::default()).await, Ok(false));
        assert_eq!(queue.beat(&fresh, LEASE, &Progress::default(), &[]).await, Ok(Beat::Held));
        assert_eq!(queue.finish(&fresh, &succeeded(), LEASE).await, Ok(true));
        assert_eq!(queue.finish(&fresh, &End { state: State::Failed, ..succeeded() }, LEASE).await, Ok(false));
        let job = queue.get("j").await.unwrap().unwrap();
        assert_eq!((job.state, job.attempt, job.metadata["a"].as_i64()), (State::Succeeded, 2, Some(1)));
    }

    #[tokio::test]
    async fn a_silent_worker_loses_its_job_and_a_poisonous_job_is_given_up() {
        let (_root, queue) = queue().await;
        submit(&queue, "j").await;
        for death in 1..=3 {
            queue.claim("a", Duration::ZERO).await.unwrap().unwrap();
            tokio::time::sleep(Duration::from_millis(5)).await;
            let wanted = if death < 3 { State::Queued } else { State::Failed };
            assert_eq!(queue.recover(None).await.unwrap(), [("j".to_owned(), wanted)]);
        }
        let job = queue.get("j").await.unwrap().unwrap();
        assert_eq!(job.error.unwrap().code, Code::Internal);
        assert!(queue.claim("a", LEASE).await.unwrap().is_none());
    }

    #[tokio::test]
    async fn cancelling_waits_for_nobody_and_wins_over_a_late_result() {
        let (_root, queue) = queue().await;
        submit(&queue, "runs").await;
        submit(&queue, "waits").await;
        let claim = queue.claim("a", LEASE).await.unwrap().unwrap();
        assert_eq!(queue.get("waits").await.unwrap().unwrap().queue_position, Some(1));
        assert_eq!(queue.cancel("waits").await, Ok(Canceled::AtOnce));
        assert_eq!(queue.cancel("waits").await, Ok(Canceled::Final));
        assert_eq!(queue.cancel("none").await, Ok(Canceled::Unknown));
        assert_eq!(queue.cancel("runs").await, Ok(Canceled::Asked));
        assert_eq!(queue.beat(&claim, LEASE, &Progress::default(), &[]).await, Ok(Beat::Cancel));
        assert_eq!(queue.finish(&claim, &succeeded(), LEASE).await, Ok(false));
        assert_eq!(queue.finish(&claim, &End { state: State::Canceled, ..succeeded() }, LEASE).await, Ok(true));
    }

    #[tokio::test]
    async fn a_full_queue_takes_no_more_and_old_jobs_expire() {
        let (_root, queue) = queue().await;
        submit(&queue, "a").await;
        let full = queue.submit("b", &json!({}), &Manifest::default(), 1).await.unwrap_err();
        assert_eq!(full.code, Code::QueueFull);
        assert_eq!(queue.expire(Moment::now().minus(LEASE)).await.unwrap(), []);
        assert_eq!(queue.expire(Moment::now().plus(LEASE)).await.unwrap(), [("a".to_owned(), State::Expired)]);
        let (jobs, next) = queue.list(Some(State::Expired), None, 1).await.unwrap();
        assert_eq!((jobs.len(), next), (1, Some(1)));
        assert_eq!(queue.list(None, next, 1).await.unwrap().0.len(), 0);
        assert_eq!(queue.forget(Moment::now().plus(LEASE)).await, Ok(1));
        assert_eq!(queue.knows("a").await, Ok(false));
    }
}
