//! The queue in one SQLite file (WAL): for one machine, any number of processes. All SQL of jobs stands here and beside it.

mod migrations;
mod submit;

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Row, Transaction};

use self::migrations::MIGRATIONS;
use super::failure::{DAMAGED, unavailable};
use super::rows::{self, artifact_bytes, integer, job, json, states};
use super::{
    AttemptEnd, AttemptStatus, CancelReply, Capacity, Claim, HeartbeatReply, Listing, MAX_DEATHS, MAX_PROGRESS_LEAD,
    NewJob, Queue, Remove, StoredBytes, Submitted, canceled, given_up,
};
use crate::context::Progress;
use crate::error::{Failure, Result};
use crate::jobs::files::disk;
use crate::jobs::record::{Job, JobState, Timestamp};
use crate::metrics::RefinementOutcome;

/// The place of a job among those of its tenant that wait: 1 is next. Small jobs do not wait for those that are not.
fn position(small: u64) -> String {
    let small = integer(small);
    format!(
        "CASE state WHEN 'queued' THEN (SELECT count(*) FROM jobs other
           WHERE other.state = 'queued' AND other.tenant = jobs.tenant
             AND (other.size, other.turn, other.seq) <= (jobs.size, jobs.turn, jobs.seq)
             AND (jobs.memory > {small} OR other.memory <= {small})) END AS position"
    )
}

/// The job whose turn it is, as [`Queue::claim`] says. Each tenant offers one job, found by an index, so that a long queue of one costs the
/// others nothing. A job for which there is no capacity, and which has waited for too long, is overtaken by nobody.
const NEXT: &str = "
  WITH RECURSIVE
  names(name) AS (
    SELECT min(tenant) FROM jobs WHERE state = 'queued'
    UNION ALL SELECT (SELECT min(tenant) FROM jobs WHERE state = 'queued' AND tenant > name) FROM names WHERE name IS NOT NULL),
  tenants(name, running, served) AS MATERIALIZED (
    SELECT name, (SELECT count(*) FROM jobs WHERE state = 'running' AND tenant = name),
      (SELECT max(started_at) FROM jobs WHERE tenant = name) FROM names WHERE name IS NOT NULL),
  first(turn, seq) AS MATERIALIZED (
    SELECT turn, seq FROM jobs WHERE ?5 < ?4 AND state = 'queued' AND min(memory, ?4) > ?5 AND queued_at < ?7
      AND (max_running IS NULL OR max_running > (SELECT running FROM tenants WHERE name = jobs.tenant))
    ORDER BY turn, seq LIMIT 1),
  free(seq, turn, tenant, size, queued_at) AS NOT MATERIALIZED (
    SELECT seq, turn, tenant, size, queued_at FROM jobs own WHERE state = 'queued' AND min(memory, ?4) <= ?5 AND memory <= ?6
      AND NOT EXISTS (SELECT 1 FROM first WHERE (first.turn, first.seq) < (own.turn, own.seq))
      AND (max_running IS NULL OR max_running > (SELECT running FROM tenants WHERE name = own.tenant))),
  offers(seq, running, served) AS (
    SELECT coalesce(
        (SELECT seq FROM free WHERE tenant = name AND name <> '' AND queued_at < ?7 ORDER BY queued_at, turn, seq LIMIT 1),
        (SELECT seq FROM free WHERE tenant = name ORDER BY size, turn, seq LIMIT 1)), running, served
    FROM tenants)
  SELECT seq FROM offers WHERE seq IS NOT NULL ORDER BY running, served, seq LIMIT 1";

/// The queue.
#[derive(Debug)]
pub struct Sqlite {
    pool: SqlitePool,
    /// For heartbeats. They need not survive a loss of power, and hold the database's lock only for as long as it takes to write to
    /// the page cache: a process that is stopped in the middle of one would keep all others waiting.
    heartbeats: SqlitePool,
    options: SqliteConnectOptions,
    /// Which file it was when it was opened.
    file: FileId,
    /// Bytes that it has had at least: it is never vacuumed, and so it only grows.
    length: AtomicU64,
    /// Jobs that are expected to need no more have a slot of their own.
    small: u64,
    /// Whether what a lost file held has been written beside it.
    rescued: AtomicBool,
    /// Whether it has been told that this cannot be done.
    told: AtomicBool,
}

/// What tells a file from another of its name: volume and number, where the system has them.
type FileId = Option<(u64, u64)>;

/// Which file has a name now, and how long it is.
fn file_id(path: &Path) -> std::io::Result<(FileId, u64)> {
    let found = std::fs::metadata(path)?;
    #[cfg(unix)]
    let id = Some((std::os::unix::fs::MetadataExt::dev(&found), std::os::unix::fs::MetadataExt::ino(&found)));
    #[cfg(not(unix))]
    let id = found.is_file().then_some((0, 0));
    Ok((id, found.len()))
}

impl Sqlite {
    /// Opens the database, or makes it. One of an earlier version is copied, then migrated ([`migrations`]).
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`: the disk, or a file that is damaged; `internal`: a database of a version that this program
    /// does not know.
    pub async fn open(path: &Path) -> Result<Self> {
        Self::open_file(path).await.map_err(|failure| {
            let hint = if failure.is_of_the_machine() {
                "; nothing was changed: put a copy from a backup in its place, or move it away to begin a new queue"
            } else {
                ""
            };
            Failure { message: format!("{}: {}{hint}", path.display(), failure.message), ..failure }
        })
    }

    async fn open_file(path: &Path) -> Result<Self> {
        let options = SqliteConnectOptions::new().filename(path).busy_timeout(Duration::from_secs(20));
        migrations::check(&options, MIGRATIONS).await?;
        let options = options
            .journal_mode(SqliteJournalMode::Wal)
            // A job is acknowledged only when it would survive a loss of power.
            .synchronous(SqliteSynchronous::Full);
        options.clone().create_if_missing(true).connect().await?.close().await?;
        // One connection is always open: where the file is removed under the service, it still has the contents.
        let pool = SqlitePoolOptions::new().max_connections(4).min_connections(1).idle_timeout(None).max_lifetime(None);
        // A transaction that a full disk has ended leaves its connection between two states: another takes its place.
        let pool = pool.after_release(|connection, _| {
            Box::pin(async move {
                match connection.begin_with("BEGIN").await {
                    Ok(empty) => Ok(empty.rollback().await.is_ok()),
                    Err(_) => Ok(false),
                }
            })
        });
        let pool = pool.connect_with(options.clone()).await?;
        migrations::migrate(&pool, path, MIGRATIONS).await?;
        let (file, length) = file_id(path).map_err(|e| disk(path, &e))?;
        let heartbeats = options.clone().synchronous(SqliteSynchronous::Normal);
        let heartbeats = SqlitePoolOptions::new().max_connections(1).idle_timeout(None).connect_lazy_with(heartbeats);
        let (length, small) = (AtomicU64::new(length), u64::MAX);
        let (rescued, told) = (AtomicBool::new(false), AtomicBool::new(false));
        Ok(Sqlite { pool, heartbeats, options, file, length, small, rescued, told })
    }

    /// The same queue, for a service where jobs that are expected to need no more than `small` bytes have a slot of their own.
    pub fn with_small(self, small: u64) -> Self {
        Sqlite { small, ..self }
    }

    /// Workers of this process are told by it, those of others look by themselves.
    fn submitted(&self) {}

    fn reader(&self) -> &SqlitePool {
        &self.pool
    }

    /// The connections for what writes: a file that is no longer the queue's would take it without complaint.
    fn writer(&self) -> Result<&SqlitePool> {
        let path = self.options.get_filename();
        let lost = |how: &str| {
            let message = format!(
                "{} was {how} while the service runs: stop it, remove that file with its -wal and -shm, rename {} to it (or put a copy from a \
                 backup there), start it again",
                path.display(),
                rescue_path(path).display()
            );
            Err(unavailable(&message))
        };
        match file_id(path) {
            Ok((file, _)) if file != self.file => lost("replaced"),
            Ok((_, length)) if length < self.length.fetch_max(length, Ordering::Relaxed) => lost("cut short"),
            Ok(_) => Ok(&self.pool),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => lost("removed"),
            Err(e) => Err(disk(path, &e)),
        }
    }

    /// A transaction that writes: while it is open, nobody else does.
    async fn begin(&self) -> Result<Transaction<'_, sqlx::Sqlite>> {
        Ok(self.writer()?.begin_with("BEGIN IMMEDIATE").await?)
    }

    /// Runs a step. The file is at hand: it needs no limit on time but that of the lock.
    async fn step<T>(&self, step: impl Future<Output = Result<T>> + Send) -> Result<T> {
        step.await
    }

    /// Writes a copy of the queue to the file `to`, which must not exist, as of a moment at which `meanwhile` runs and nothing changes.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub async fn copy(&self, to: &Path, meanwhile: &(dyn Fn() -> Result<()> + Send + Sync)) -> Result<()> {
        // Nobody can write until this is dropped.
        let _still = self.begin().await?;
        migrations::copy(&self.pool, to).await?;
        meanwhile()
    }

    /// Writes what a file held that was removed, replaced or cut short beside its place, once.
    async fn rescue(&self) {
        let to = rescue_path(self.options.get_filename());
        if !self.rescued.load(Ordering::Relaxed) {
            match migrations::copy(&self.pool, &to).await {
                Ok(()) => {
                    self.rescued.store(true, Ordering::Relaxed);
                    tracing::error!("the file of the job queue is lost; what it held was written to {}", to.display());
                }
                Err(failure) if !self.told.swap(true, Ordering::Relaxed) => {
                    tracing::error!(%failure, "what the lost file of the job queue held cannot be written to {}", to.display())
                }
                Err(_) => {}
            }
        }
    }
}

fn rescue_path(path: &Path) -> std::path::PathBuf {
    path.with_extension("sqlite.rescued")
}

super::key_store!(Sqlite);
super::webhook_store!(Sqlite, "");
super::batch_store!(Sqlite, "jobs", "jobs.progress");
super::upload_store!(Sqlite);

#[async_trait]
impl Queue for Sqlite {
    async fn now(&self) -> Result<Timestamp> {
        Ok(Timestamp::now())
    }

    async fn identity(&self) -> Result<String> {
        Ok(sqlx::query("SELECT identity FROM store").fetch_one(&self.pool).await?.try_get(0)?)
    }

    async fn submit(&self, job: &NewJob, most: u32) -> Result<Submitted> {
        let mut step = self.begin().await?;
        let submitted = Self::insert(&mut step, job, most).await;
        match submitted {
            Ok(Submitted::New | Submitted::Reused) => step.commit().await?,
            _ => step.rollback().await?,
        }
        submitted
    }

    async fn get(&self, id: &str) -> Result<Option<Job>> {
        let sql = format!("SELECT *, {} FROM jobs WHERE id = ?1", position(self.small));
        let row = sqlx::query(AssertSqlSafe(sql)).bind(id).fetch_optional(&self.pool).await?;
        row.as_ref().map(|row| job(row, Timestamp::now())).transpose()
    }

    async fn tenant_of(&self, id: &str) -> Result<Option<String>> {
        let row = sqlx::query("SELECT tenant FROM jobs WHERE id = ?1").bind(id).fetch_optional(&self.pool).await?;
        Ok(row.map(|row| row.try_get(0)).transpose()?)
    }

    async fn list(&self, wanted: Listing<'_>) -> Result<(Vec<Job>, Option<i64>)> {
        let Listing { tenant, state, cursor, limit } = wanted;
        // A tenant's jobs have an index of their own; without one, all are looked through.
        let of_tenant = if tenant.is_some() { "tenant = ?4" } else { "?4 IS NULL" };
        let sql = format!(
            "SELECT *, {} FROM jobs WHERE (?1 IS NULL OR state = ?1) AND (?2 IS NULL OR seq < ?2) AND {of_tenant}
             ORDER BY seq DESC LIMIT ?3",
            position(self.small)
        );
        let rows = sqlx::query(AssertSqlSafe(sql))
            .bind(state.map(JobState::as_str))
            .bind(cursor)
            .bind(limit)
            .bind(tenant)
            .fetch_all(&self.pool)
            .await?;
        rows::page(&rows, Timestamp::now(), limit)
    }

    async fn counts(&self) -> Result<Vec<(JobState, u64)>> {
        let sql = "SELECT state, count(*) AS count FROM jobs GROUP BY state";
        rows::counts(&sqlx::query(sql).fetch_all(&self.pool).await?)
    }

    async fn waiting(&self) -> Result<u64> {
        let sql = "SELECT count(*) FROM jobs WHERE state = 'queued'";
        let row = sqlx::query(sql).fetch_one(&self.pool).await?;
        Ok(row.try_get::<i64, _>(0)?.unsigned_abs())
    }

    async fn waits_since(&self) -> Result<Option<Timestamp>> {
        let sql = "SELECT min(queued_at) FROM jobs WHERE state = 'queued'";
        let row = sqlx::query(sql).fetch_one(&self.pool).await?;
        Ok(row.try_get::<Option<i64>, _>(0)?.map(Timestamp))
    }

    async fn claim(&self, owner: &str, lease: Duration, capacity: Capacity) -> Result<Option<Claim>> {
        let now = Timestamp::now();
        let sql = format!(
            "UPDATE jobs SET state = 'running', attempt = attempt + 1, owner = ?1, lease_until = ?2, started_at = ?3,
               warnings = '[]', timings = '[]', stages = '[]'
             WHERE state = 'queued' AND seq = ({NEXT})
             RETURNING id, attempt, options, inputs, progress, memory, request, suspect, trace, queued_at",
        );
        let rows = sqlx::query(AssertSqlSafe(sql))
            .bind(owner)
            .bind(now.plus(lease).0)
            .bind(now.0)
            .bind(integer(capacity.total))
            .bind(integer(capacity.free))
            .bind(integer(capacity.most))
            .bind(now.minus(capacity.patience).0)
            .fetch_all(self.writer()?)
            .await?;
        let Some(row) = rows.first() else { return Ok(None) };
        Ok(Some(rows::claim(row)?))
    }

    async fn heartbeat(&self, claim: &Claim, lease: Duration, status: &AttemptStatus) -> Result<HeartbeatReply> {
        let rows = sqlx::query(
            "UPDATE jobs SET lease_until = ?3, progress = ?4, stages = ?5, warnings = ?6
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' RETURNING cancel_requested",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(Timestamp::now().plus(lease).0)
        .bind(json(&status.progress)?)
        .bind(json(&status.stages)?)
        .bind(json(&status.warnings)?)
        .fetch_all(&self.heartbeats)
        .await?;
        match rows.first() {
            None => Ok(HeartbeatReply::Lost),
            Some(row) if row.try_get(0)? => Ok(HeartbeatReply::Cancel),
            Some(_) => Ok(HeartbeatReply::Held),
        }
    }

    async fn reserve(&self, claim: &Claim, objects: &[String]) -> Result<Option<Vec<String>>> {
        let mut step = self.begin().await?;
        let held = sqlx::query(
            "SELECT 1 FROM jobs WHERE id = ?1 AND attempt = ?2 AND state = 'running' AND cancel_requested = 0",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .fetch_optional(&mut *step)
        .await?;
        if held.is_none() {
            return Ok(None);
        }
        for object in objects {
            sqlx::query("INSERT OR IGNORE INTO objects (sha256, job, attempt) VALUES (?1, ?2, ?3)")
                .bind(object)
                .bind(&claim.id)
                .bind(claim.attempt)
                .execute(&mut *step)
                .await?;
        }
        step.commit().await?;
        Ok(Some(objects.to_vec()))
    }

    async fn place(&self, sha256: &str) -> Result<String> {
        Ok(sha256.to_owned())
    }

    async fn finish(&self, claim: &Claim, end: &AttemptEnd, keep: Duration) -> Result<bool> {
        let now = Timestamp::now();
        let done = sqlx::query(
            "UPDATE jobs SET state = ?3, finished_at = ?4, artifacts_expire_at = ?5, progress = ?6, timings = ?7, warnings = ?8,
               error = ?9, artifacts = ?10, stages = ?11, artifact_bytes = ?12, outcome = ?13, owner = NULL, lease_until = NULL
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' AND (cancel_requested = 0 OR ?3 = 'canceled')",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(end.state.as_str())
        .bind(now.0)
        .bind((!end.artifacts.is_empty()).then(|| now.plus(keep).0))
        .bind(json(&end.status.progress)?)
        .bind(json(&end.timings)?)
        .bind(json(&end.status.warnings)?)
        .bind(end.error.as_ref().map(json).transpose()?)
        .bind(json(&end.artifacts)?)
        .bind(json(&end.status.stages)?)
        .bind(artifact_bytes(end))
        .bind(end.outcome.map(RefinementOutcome::as_str))
        .execute(self.writer()?)
        .await?;
        Ok(done.rows_affected() > 0)
    }

    async fn release(&self, claim: &Claim, progress: &Progress) -> Result<bool> {
        let done = sqlx::query(
            "UPDATE jobs SET state = 'queued', owner = NULL, lease_until = NULL, progress = ?3, queued_at = ?4
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' AND cancel_requested = 0",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(json(progress)?)
        .bind(Timestamp::now().0)
        .execute(self.writer()?)
        .await?;
        Ok(done.rows_affected() > 0)
    }

    async fn cancel(&self, id: &str) -> Result<CancelReply> {
        let rows = sqlx::query(
            "UPDATE jobs SET cancel_requested = 1,
               finished_at = CASE state WHEN 'queued' THEN ?2 END, error = CASE state WHEN 'queued' THEN ?3 END,
               state = CASE state WHEN 'queued' THEN 'canceled' ELSE state END
             WHERE id = ?1 AND state IN ('queued', 'running') RETURNING state",
        )
        .bind(id)
        .bind(Timestamp::now().0)
        .bind(json(&canceled())?)
        .fetch_all(self.writer()?)
        .await?;
        if let Some(row) = rows.first() {
            let state: String = row.try_get(0)?;
            return Ok(if state == "running" { CancelReply::Asked } else { CancelReply::AtOnce });
        }
        let known = sqlx::query("SELECT 1 FROM jobs WHERE id = ?1").bind(id).fetch_optional(self.writer()?).await?;
        Ok(if known.is_some() { CancelReply::Final } else { CancelReply::Unknown })
    }

    async fn delete(&self, id: &str) -> Result<bool> {
        let done = sqlx::query("DELETE FROM jobs WHERE id = ?1").bind(id).execute(self.writer()?).await?;
        Ok(done.rows_affected() > 0)
    }

    async fn recover(&self, owner: Option<&str>, living: &str) -> Result<Vec<(String, JobState)>> {
        let rows = sqlx::query(
            "UPDATE jobs SET suspect = 1, owner = NULL, lease_until = NULL, queued_at = ?2,
               turn = (SELECT coalesce(max(turn), 0) + 1 FROM jobs),
               progress = json_set(progress, '$.fraction', min(0.99, json_extract(progress, '$.fraction') + ?4)),
               state = CASE WHEN cancel_requested THEN 'canceled' ELSE 'queued' END,
               finished_at = CASE WHEN cancel_requested THEN ?2 END,
               error = CASE WHEN cancel_requested THEN ?3 END
             WHERE state = 'running' AND (owner = ?1 OR (lease_until < ?2 AND owner IS NOT ?5)) RETURNING id, state",
        )
        .bind(owner)
        .bind(Timestamp::now().0)
        .bind(json(&canceled())?)
        .bind(MAX_PROGRESS_LEAD)
        .bind(living)
        .fetch_all(self.writer()?)
        .await?;
        states(&rows)
    }

    async fn died(&self, claim: &Claim) -> Result<Option<JobState>> {
        let rows = sqlx::query(
            "UPDATE jobs SET suspect = 1, deaths = deaths + 1, owner = NULL, lease_until = NULL, queued_at = ?3,
               turn = (SELECT coalesce(max(turn), 0) + 1 FROM jobs),
               progress = json_set(progress, '$.fraction', min(0.99, json_extract(progress, '$.fraction') + ?7)),
               state = CASE WHEN cancel_requested THEN 'canceled' WHEN deaths + 1 >= ?4 THEN 'failed' ELSE 'queued' END,
               finished_at = CASE WHEN cancel_requested OR deaths + 1 >= ?4 THEN ?3 END,
               error = CASE WHEN cancel_requested THEN ?6 WHEN deaths + 1 >= ?4 THEN ?5 END
             WHERE id = ?1 AND attempt = ?2 AND state = 'running' RETURNING id, state",
        )
        .bind(&claim.id)
        .bind(claim.attempt)
        .bind(Timestamp::now().0)
        .bind(MAX_DEATHS)
        .bind(json(&given_up())?)
        .bind(json(&canceled())?)
        .bind(MAX_PROGRESS_LEAD)
        .fetch_all(self.writer()?)
        .await?;
        Ok(states(&rows)?.pop().map(|(_, state)| state))
    }

    async fn stored_bytes(&self, tenant: Option<&str>) -> Result<StoredBytes> {
        let of_tenant = if tenant.is_some() { "tenant = ?1" } else { "?1 IS NULL" };
        let row = sqlx::query(AssertSqlSafe(format!(
            "SELECT (SELECT coalesce(sum(upload_bytes), 0) FROM jobs WHERE state IN ('queued', 'running') AND {of_tenant}),
               (SELECT coalesce(sum(artifact_bytes), 0) FROM jobs WHERE artifacts_removed = 0 AND {of_tenant})",
        )))
        .bind(tenant)
        .fetch_one(&self.pool)
        .await?;
        let bytes = |column: usize| Ok::<_, Failure>(row.try_get::<i64, _>(column)?.unsigned_abs());
        Ok(StoredBytes { uploads: bytes(0)?, artifacts: bytes(1)? })
    }

    async fn check(&self, deep: bool) -> Result<()> {
        if let Err(failure) = self.writer() {
            self.rescue().await;
            return Err(failure);
        }
        self.rescued.store(false, Ordering::Relaxed);
        self.told.store(false, Ordering::Relaxed);
        // A connection of its own, which knows nothing from before.
        let mut reader = self.options.clone().read_only(true).connect().await?;
        let found = async {
            let identity: String =
                sqlx::query("SELECT identity FROM store").fetch_one(&mut reader).await?.try_get(0)?;
            if identity != self.identity().await? {
                return Err(unavailable(
                    "the file of the job queue holds another queue: stop the service, put the right file there, start it again",
                ));
            }
            if deep {
                let said: String = sqlx::query("PRAGMA quick_check(1)").fetch_one(&mut reader).await?.try_get(0)?;
                if said != "ok" {
                    tracing::debug!(said, "the queue is damaged");
                    return Err(unavailable(DAMAGED));
                }
            }
            Ok(())
        };
        let found = found.await;
        reader.close().await?;
        found?;
        sqlx::query("UPDATE store SET identity = identity").execute(&self.heartbeats).await?;
        Ok(())
    }

    async fn owners(&self) -> Result<Vec<String>> {
        let sql = "SELECT DISTINCT owner FROM jobs WHERE state = 'running' AND owner IS NOT NULL ORDER BY owner";
        let rows = sqlx::query(sql).fetch_all(&self.pool).await?;
        rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    async fn expire(&self, before: Timestamp) -> Result<Vec<(String, JobState)>> {
        let rows = sqlx::query(
            "UPDATE jobs SET state = 'expired', finished_at = ?2
             WHERE state = 'queued' AND attempt = 0 AND created_at < ?1 RETURNING id, state",
        )
        .bind(before.0)
        .bind(Timestamp::now().0)
        .fetch_all(self.writer()?)
        .await?;
        states(&rows)
    }

    async fn expire_artifacts(&self) -> Result<Vec<String>> {
        let rows = sqlx::query(
            "UPDATE jobs SET artifacts_removed = 1 WHERE artifacts_removed = 0 AND artifacts_expire_at <= ?1 RETURNING id",
        )
        .bind(Timestamp::now().0)
        .fetch_all(self.writer()?)
        .await?;
        rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    async fn purge(&self, before: Timestamp) -> Result<u64> {
        let done = sqlx::query(
            "DELETE FROM jobs WHERE finished_at < ?1 AND (artifacts_removed = 1 OR artifacts_expire_at IS NULL)",
        )
        .bind(before.0)
        .execute(self.writer()?)
        .await?;
        Ok(done.rows_affected())
    }

    async fn needs_upload(&self, id: &str) -> Result<bool> {
        let row = sqlx::query("SELECT 1 FROM jobs WHERE id = ?1 AND state IN ('queued', 'running')")
            .bind(id)
            .fetch_optional(&self.pool)
            .await?;
        Ok(row.is_some())
    }

    async fn collect(&self, of: Option<&str>, present: &[String], _: Duration, remove: Remove<'_>) -> Result<()> {
        // Whoever wants to reserve an object waits until this step is done.
        let mut step = self.begin().await?;
        let rows = sqlx::query(
            "DELETE FROM objects WHERE (?1 IS NULL OR job = ?1) AND NOT EXISTS (
               SELECT 1 FROM jobs WHERE jobs.id = objects.job AND jobs.attempt = objects.attempt AND (jobs.state = 'running'
                 OR jobs.finished_at IS NOT NULL AND jobs.artifacts_removed = 0 AND jobs.artifacts <> '[]'))
             RETURNING sha256",
        )
        .bind(of)
        .fetch_all(&mut *step)
        .await?;
        let mut objects = rows.iter().map(|row| Ok(row.try_get(0)?)).collect::<Result<Vec<String>>>()?;
        objects.extend_from_slice(present);
        objects.sort_unstable();
        objects.dedup();
        for object in objects {
            let sql = "SELECT 1 FROM objects WHERE sha256 = ?1 LIMIT 1";
            if sqlx::query(sql).bind(&object).fetch_optional(&mut *step).await?.is_none() {
                remove(&object).await;
            }
        }
        Ok(step.commit().await?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::queue::conformance;

    #[tokio::test]
    async fn small_jobs_have_places_of_their_own() {
        let root = tempfile::tempdir().unwrap();
        let queue = Sqlite::open(&root.path().join("q")).await.unwrap();
        let submit = async |queue: &Sqlite, id: &str, memory| {
            queue.submit(&NewJob { id: id.into(), memory, ..NewJob::default() }, 9).await.unwrap()
        };
        for (id, memory) in [("large", 100), ("a", 1), ("huge", 200), ("b", 10)] {
            submit(&queue, id, memory).await;
        }
        let place = async |queue: &Sqlite, id: &str| queue.get(id).await.unwrap().unwrap().queue_position;
        assert_eq!((place(&queue, "a").await, place(&queue, "b").await), (Some(2), Some(4)), "one line for all");
        let queue = queue.with_small(10);
        assert_eq!((place(&queue, "a").await, place(&queue, "b").await), (Some(1), Some(2)));
        assert_eq!((place(&queue, "large").await, place(&queue, "huge").await), (Some(1), Some(3)));
        assert_eq!(queue.list(Listing { limit: 9, ..Listing::default() }).await.unwrap().0[0].queue_position, Some(2));
    }

    #[tokio::test]
    async fn a_copy_holds_all_and_nothing_changes_while_it_is_made() {
        let folder = tempfile::tempdir().unwrap();
        let queue = Sqlite::open(&folder.path().join("q")).await.unwrap();
        queue.submit(&NewJob { id: "j".into(), ..NewJob::default() }, 9).await.unwrap();
        let ran = std::sync::Mutex::new(false);
        let meanwhile = || {
            *ran.lock().unwrap() = true;
            Ok(())
        };
        queue.copy(&folder.path().join("copy"), &meanwhile).await.unwrap();
        assert!(*ran.lock().unwrap() && folder.path().join("copy").exists());
        assert_eq!(queue.check(true).await, Ok(()));
        assert!(queue.claim("w", Duration::from_secs(9), Capacity::ANY).await.unwrap().is_some(), "it goes on");
    }

    #[tokio::test]
    async fn it_keeps_keys() {
        let root = tempfile::tempdir().unwrap();
        crate::jobs::keys::conformance::suite(&Sqlite::open(&root.path().join("q")).await.unwrap()).await;
    }

    #[tokio::test]
    async fn it_keeps_batches_and_uploads() {
        let root = tempfile::tempdir().unwrap();
        crate::jobs::batches::conformance::suite(&Sqlite::open(&root.path().join("b")).await.unwrap()).await;
        crate::jobs::resumable::conformance::suite(&Sqlite::open(&root.path().join("u")).await.unwrap()).await;
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 4)]
    async fn it_conforms() {
        let root = tempfile::tempdir().unwrap();
        let mut number = 0;
        conformance::suite(async || {
            number += 1;
            Sqlite::open(&root.path().join(format!("{number}.sqlite"))).await.unwrap()
        })
        .await;
    }
}
