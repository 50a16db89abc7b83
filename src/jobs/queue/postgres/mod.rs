//! The queue in PostgreSQL: for any number of machines. Each method is one statement, or one short transaction; the database's clock alone
//! counts (`intarsia_now()`).
//!
//! A row of `heartbeats` is there exactly while an attempt holds its job: whatever takes the job from it removes the row in the same
//! statement, and whatever the attempt writes names its number.

mod claim;
mod collect;
mod hints;
mod migrations;
mod submit;
#[cfg(test)]
pub(in crate::jobs) mod testing;
#[cfg(test)]
mod tests;

use std::str::FromStr;
use std::time::Duration;

use async_trait::async_trait;
use sqlx::postgres::{PgConnectOptions, PgPool, PgPoolOptions, PgRow};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Row, Transaction};
use tokio::time::timeout;

use self::hints::Hints;
use super::failure::unavailable;
use super::rows::{self, Columns, artifact_bytes, integer, job, json, next_cursor, states};
use super::{
    AttemptEnd, AttemptStatus, CancelReply, Capacity, Claim, HeartbeatReply, Hint, Listing, MAX_DEATHS,
    MAX_PROGRESS_LEAD, NewJob, Queue, Remove, StoredBytes, Submitted, canceled, given_up,
};
use crate::config::Secret;
use crate::context::Progress;
use crate::error::{Code, Failure, Result};
use crate::jobs::record::{Job, JobState, Timestamp};
use crate::metrics::RefinementOutcome;

/// How long a step may take, with the way there and back: a connection whose other end is gone says nothing.
const PATIENCE: Duration = Duration::from_secs(10);
/// How long the database itself works on one statement.
const STATEMENT_TIMEOUT: &str = "8s";
/// Connections of one process: for all, and for heartbeats, which wait for nobody.
const CONNECTIONS: u32 = 8;
const HEARTBEAT_CONNECTIONS: u32 = 2;
/// How long a connection that was given back may take to answer.
const PING_PATIENCE: Duration = Duration::from_secs(2);
/// Milliseconds after the end of its lease from which on a job is taken back whose own process is alive and does not know that it has it: the
/// answer to its claim was lost.
const UNKNOWN_AFTER: i64 = 60_000;
/// Rows that are deleted in one statement.
const BATCH: i64 = 1000;

/// Jobs with what their last heartbeat said.
const JOBS: &str =
    "jobs LEFT JOIN heartbeats h ON h.job = jobs.id AND h.attempt = jobs.attempt AND jobs.state = 'running'";

/// The columns of a job as users see it. Small jobs do not wait for those that are not.
fn columns(small: u64) -> String {
    let small = integer(small);
    format!(
        "jobs.id, jobs.seq, jobs.state, jobs.options, jobs.outcome, jobs.attempt, jobs.created_at, jobs.started_at, jobs.finished_at,
         jobs.artifacts_expire_at, jobs.timings, jobs.error, jobs.artifacts, intarsia_now() AS now,
         coalesce(h.progress, jobs.progress) AS progress, coalesce(h.stages, jobs.stages) AS stages,
         coalesce(h.warnings, jobs.warnings) AS warnings, CASE WHEN h.progress IS NULL THEN jobs.lead ELSE 0 END AS lead,
         CASE jobs.state WHEN 'queued' THEN (SELECT count(*) FROM jobs other
           WHERE other.state = 'queued' AND other.tenant = jobs.tenant
             AND (other.size, other.turn, other.seq) <= (jobs.size, jobs.turn, jobs.seq)
             AND (jobs.memory > {small} OR other.memory <= {small})) END AS position"
    )
}

/// The queue.
pub struct Postgres {
    pool: PgPool,
    heartbeats: PgPool,
    /// What tells it from others.
    identity: String,
    /// Whether it was made when it was opened.
    fresh: bool,
    /// Jobs that are expected to need no more have a slot of their own.
    small: u64,
    hints: Hints,
}

impl Postgres {
    /// Opens the database at `url` (`postgres://user:password@host:port/name?sslmode=…`), and makes its tables where there are none.
    ///
    /// # Errors
    /// `invalid_request`: no such URL; `unavailable`; `internal`: tables of a version that this program does not know.
    pub async fn open(url: &Secret) -> Result<Self> {
        // What the parser says may hold parts of the URL, and so of the password.
        let invalid = |_| {
            let message = "--queue is no URL of PostgreSQL: postgres://USER:PASSWORD@HOST:PORT/DATABASE, with what is no letter or digit as %XX";
            Failure::new(Code::InvalidRequest, message)
        };
        let options = PgConnectOptions::from_str(url.text()).map_err(invalid)?;
        let options = options
            .application_name("intarsia")
            .options([
                ("statement_timeout", STATEMENT_TIMEOUT),
                ("idle_in_transaction_session_timeout", STATEMENT_TIMEOUT),
            ])
            .disable_statement_logging();
        let pool = |most: u32| {
            let options = PgPoolOptions::new().max_connections(most).acquire_timeout(PATIENCE);
            // Without a limit, a connection whose other end is gone would never leave its place.
            options.after_release(|connection, _| {
                Box::pin(async move { Ok(matches!(timeout(PING_PATIENCE, connection.ping()).await, Ok(Ok(())))) })
            })
        };
        let (pool, heartbeats) = (
            pool(CONNECTIONS).connect_lazy_with(options.clone()),
            pool(HEARTBEAT_CONNECTIONS).connect_lazy_with(options.clone()),
        );
        // A first connection without the pool, which would try again and again and not say what is wrong.
        within(async { Ok(options.connect().await?.close().await?) }).await?;
        let fresh = migrations::migrate(&pool).await?;
        let identity = sqlx::query("SELECT identity FROM store").fetch_one(&pool).await?.try_get(0)?;
        let hints = Hints::new(pool.clone());
        Ok(Postgres { pool, heartbeats, identity, fresh, small: u64::MAX, hints })
    }

    /// The same queue, for a service where jobs that are expected to need no more than `small` bytes have a slot of their own.
    pub fn with_small(self, small: u64) -> Self {
        Postgres { small, ..self }
    }

    /// Whether it was made when it was opened.
    pub fn is_fresh(&self) -> bool {
        self.fresh
    }

    /// Tells the workers that jobs wait.
    fn submitted(&self) {
        self.hints.send(Hint::Queued);
    }

    fn reader(&self) -> &PgPool {
        &self.pool
    }

    fn writer(&self) -> Result<&PgPool> {
        Ok(&self.pool)
    }

    async fn begin(&self) -> Result<Transaction<'_, sqlx::Postgres>> {
        Ok(self.pool.begin().await?)
    }

    async fn step<T>(&self, step: impl Future<Output = Result<T>> + Send) -> Result<T> {
        within(step).await
    }

    /// The one row of a statement about one job, where it found it.
    async fn row(&self, query: Statement<'_>) -> Result<Option<PgRow>> {
        within(async { Ok(query.fetch_optional(&self.pool).await?) }).await
    }

    async fn rows(&self, query: Statement<'_>) -> Result<Vec<PgRow>> {
        within(async { Ok(query.fetch_all(&self.pool).await?) }).await
    }
}

type Statement<'a> = sqlx::query::Query<'a, sqlx::Postgres, sqlx::postgres::PgArguments>;

/// Runs a step, for as long as it may take.
async fn within<T>(step: impl Future<Output = Result<T>> + Send) -> Result<T> {
    match timeout(PATIENCE, step).await {
        Ok(done) => done,
        Err(_) => Err(unavailable("PostgreSQL, which holds the job queue, does not answer")),
    }
}

fn millis(span: Duration) -> i64 {
    i64::try_from(span.as_millis()).unwrap_or(i64::MAX / 4).min(i64::MAX / 4)
}

/// A job from its row, with what users may have seen beyond the stored fraction.
fn seen(row: &PgRow) -> Result<Job> {
    let mut job = job(row, Timestamp(row.integer("now")?))?;
    let lead: f64 = row.try_get("lead")?;
    if lead > 0.0 {
        job.progress.fraction = (job.progress.fraction + lead).min(0.99);
    }
    Ok(job)
}

super::key_store!(Postgres);
super::webhook_store!(Postgres, " FOR UPDATE");
super::batch_store!(
    Postgres,
    "(jobs LEFT JOIN heartbeats h ON h.job = jobs.id AND h.attempt = jobs.attempt AND jobs.state = 'running')",
    "coalesce(h.progress, jobs.progress)"
);
super::upload_store!(Postgres);

#[async_trait]
impl Queue for Postgres {
    async fn now(&self) -> Result<Timestamp> {
        let row = within(async { Ok(sqlx::query("SELECT intarsia_now()").fetch_one(&self.pool).await?) }).await?;
        Ok(Timestamp(row.try_get(0)?))
    }

    fn is_shared(&self) -> bool {
        true
    }

    async fn hint(&self) -> Hint {
        self.hints.next().await
    }

    async fn identity(&self) -> Result<String> {
        Ok(self.identity.clone())
    }

    /// Submissions at the same time do not see each other: there may be as many jobs too many as there are of them.
    async fn submit(&self, new: &NewJob, most: u32) -> Result<Submitted> {
        let submitted = self.step(async {
            let mut step = self.begin().await?;
            let submitted = Self::insert(&mut step, new, most).await;
            match submitted {
                Ok(Submitted::New | Submitted::Reused) => step.commit().await?,
                _ => step.rollback().await?,
            }
            submitted
        });
        let submitted = submitted.await?;
        match submitted {
            Submitted::New => self.hints.send(Hint::Queued),
            Submitted::Reused => self.hints.send(Hint::Changed(new.id.clone())),
            Submitted::Known(_) => {}
        }
        Ok(submitted)
    }

    async fn get(&self, id: &str) -> Result<Option<Job>> {
        let sql = format!("SELECT {} FROM {JOBS} WHERE jobs.id = $1", columns(self.small));
        self.row(sqlx::query(AssertSqlSafe(sql)).bind(id)).await?.as_ref().map(seen).transpose()
    }

    async fn tenant_of(&self, id: &str) -> Result<Option<String>> {
        let row = self.row(sqlx::query("SELECT tenant FROM jobs WHERE id = $1").bind(id)).await?;
        row.map(|row| row.text("tenant")).transpose()
    }

    async fn list(&self, wanted: Listing<'_>) -> Result<(Vec<Job>, Option<i64>)> {
        let Listing { tenant, state, cursor, limit } = wanted;
        // Said only where it is wanted, so that an index that fits is used.
        let of_tenant = if tenant.is_some() { "jobs.tenant = $3" } else { "$3::text IS NULL" };
        let in_state = if state.is_some() { "jobs.state = $4" } else { "$4::text IS NULL" };
        let sql = format!(
            "SELECT {} FROM {JOBS} WHERE jobs.seq < $1 AND {of_tenant} AND {in_state} ORDER BY jobs.seq DESC LIMIT $2",
            columns(self.small)
        );
        let query = sqlx::query(AssertSqlSafe(sql))
            .bind(cursor.unwrap_or(i64::MAX))
            .bind(i64::from(limit))
            .bind(tenant)
            .bind(state.map(JobState::as_str));
        let rows = self.rows(query).await?;
        Ok((rows.iter().map(seen).collect::<Result<_>>()?, next_cursor(&rows, limit)?))
    }

    async fn counts(&self) -> Result<Vec<(JobState, u64)>> {
        rows::counts(&self.rows(sqlx::query("SELECT state, count(*) AS count FROM jobs GROUP BY state")).await?)
    }

    async fn waiting(&self) -> Result<u64> {
        let row = self.row(sqlx::query("SELECT count(*) AS count FROM jobs WHERE state = 'queued'")).await?;
        row.map_or(Ok(0), |row| row.number("count"))
    }

    async fn waits_since(&self) -> Result<Option<Timestamp>> {
        let row = self.row(sqlx::query("SELECT min(queued_at) AS since FROM jobs WHERE state = 'queued'")).await?;
        row.map_or(Ok(None), |row| row.time_or_null("since"))
    }

    async fn claim(&self, owner: &str, lease: Duration, capacity: Capacity) -> Result<Option<Claim>> {
        self.take(owner, lease, capacity).await
    }

    async fn heartbeat(&self, claim: &Claim, lease: Duration, status: &AttemptStatus) -> Result<HeartbeatReply> {
        let query = sqlx::query(
            "UPDATE heartbeats SET lease_until = intarsia_now() + $3, progress = $4, stages = $5, warnings = $6, beaten = true
             WHERE job = $1 AND attempt = $2 RETURNING (SELECT cancel_requested FROM jobs WHERE id = $1) AS cancel",
        );
        let query = query
            .bind(&claim.id)
            .bind(i64::from(claim.attempt))
            .bind(millis(lease))
            .bind(json(&status.progress)?)
            .bind(json(&status.stages)?)
            .bind(json(&status.warnings)?);
        let row = within(async { Ok(query.fetch_optional(&self.heartbeats).await?) }).await?;
        let Some(row) = row else { return Ok(HeartbeatReply::Lost) };
        Ok(if row.flag("cancel")? { HeartbeatReply::Cancel } else { HeartbeatReply::Held })
    }

    async fn reserve(&self, claim: &Claim, objects: &[String]) -> Result<Option<Vec<String>>> {
        self.step(collect::reserve(&self.pool, claim, objects)).await
    }

    async fn place(&self, sha256: &str) -> Result<String> {
        let row = self.row(sqlx::query("SELECT place FROM blobs WHERE sha256 = $1").bind(sha256)).await?;
        // What nobody knows is nowhere.
        row.map_or_else(|| Ok(sha256.to_owned()), |row| row.text("place"))
    }

    async fn finish(&self, claim: &Claim, end: &AttemptEnd, keep: Duration) -> Result<bool> {
        let query = sqlx::query(
            "WITH ended AS (
               UPDATE jobs SET state = $3, finished_at = intarsia_now(), artifacts_expire_at = intarsia_now() + $4, progress = $5, lead = 0,
                 timings = $6, warnings = $7, error = $8, artifacts = $9, stages = $10, artifact_bytes = $11, outcome = $12, owner = NULL
               WHERE id = $1 AND attempt = $2 AND state = 'running' AND (NOT cancel_requested OR $3 = 'canceled') RETURNING id),
             gone AS (DELETE FROM heartbeats USING ended WHERE job = ended.id)
             SELECT id FROM ended",
        );
        let query = query
            .bind(&claim.id)
            .bind(i64::from(claim.attempt))
            .bind(end.state.as_str())
            .bind((!end.artifacts.is_empty()).then(|| millis(keep)))
            .bind(json(&end.status.progress)?)
            .bind(json(&end.timings)?)
            .bind(json(&end.status.warnings)?)
            .bind(end.error.as_ref().map(json).transpose()?)
            .bind(json(&end.artifacts)?)
            .bind(json(&end.status.stages)?)
            .bind(artifact_bytes(end))
            .bind(end.outcome.map(RefinementOutcome::as_str));
        let done = self.row(query).await?.is_some();
        if done {
            self.hints.send(Hint::Changed(claim.id.clone()));
        }
        Ok(done)
    }

    async fn release(&self, claim: &Claim, progress: &Progress) -> Result<bool> {
        let query = sqlx::query(
            "WITH back AS (
               UPDATE jobs SET state = 'queued', owner = NULL, progress = $3, lead = 0, queued_at = intarsia_now()
               WHERE id = $1 AND attempt = $2 AND state = 'running' AND NOT cancel_requested RETURNING id),
             gone AS (DELETE FROM heartbeats USING back WHERE job = back.id)
             SELECT id FROM back",
        );
        let query = query.bind(&claim.id).bind(i64::from(claim.attempt)).bind(json(progress)?);
        let done = self.row(query).await?.is_some();
        if done {
            self.hints.send(Hint::Queued);
        }
        Ok(done)
    }

    async fn cancel(&self, id: &str) -> Result<CancelReply> {
        let query = sqlx::query(
            "UPDATE jobs SET cancel_requested = true,
               finished_at = CASE state WHEN 'queued' THEN intarsia_now() END, error = CASE state WHEN 'queued' THEN $2 END,
               state = CASE state WHEN 'queued' THEN 'canceled' ELSE state END
             WHERE id = $1 AND state IN ('queued', 'running') RETURNING state",
        );
        if let Some(row) = self.row(query.bind(id).bind(json(&canceled())?)).await? {
            self.hints.send(Hint::Changed(id.to_owned()));
            return Ok(if row.text("state")? == "running" { CancelReply::Asked } else { CancelReply::AtOnce });
        }
        let known = self.row(sqlx::query("SELECT id FROM jobs WHERE id = $1").bind(id)).await?;
        Ok(if known.is_some() { CancelReply::Final } else { CancelReply::Unknown })
    }

    async fn delete(&self, id: &str) -> Result<bool> {
        let sql = "WITH gone AS (DELETE FROM jobs WHERE id = $1 RETURNING id),
             silent AS (DELETE FROM heartbeats USING gone WHERE job = gone.id)
             SELECT id FROM gone";
        let done = self.row(sqlx::query(sql).bind(id)).await?.is_some();
        if done {
            self.hints.send(Hint::Changed(id.to_owned()));
        }
        Ok(done)
    }

    async fn recover(&self, owner: Option<&str>, living: &str) -> Result<Vec<(String, JobState)>> {
        let query = sqlx::query(
            "WITH lost AS MATERIALIZED (
               SELECT jobs.id, jobs.attempt, h.progress, h.stages, h.warnings FROM jobs
                 LEFT JOIN heartbeats h ON h.job = jobs.id AND h.attempt = jobs.attempt
               WHERE jobs.state = 'running' AND (jobs.owner = $1 OR coalesce(h.lease_until, 0) < intarsia_now()
                 AND (jobs.owner IS DISTINCT FROM $2 OR NOT coalesce(h.beaten, false) AND coalesce(h.lease_until, 0) + $5 < intarsia_now()))
               FOR UPDATE OF jobs SKIP LOCKED),
             back AS (
               UPDATE jobs SET suspect = true, owner = NULL, queued_at = intarsia_now(), turn = nextval('turns'),
                 progress = coalesce(lost.progress, jobs.progress), stages = coalesce(lost.stages, jobs.stages),
                 warnings = coalesce(lost.warnings, jobs.warnings), lead = $4 + CASE WHEN lost.progress IS NULL THEN lead ELSE 0 END,
                 state = CASE WHEN cancel_requested THEN 'canceled' ELSE 'queued' END,
                 finished_at = CASE WHEN cancel_requested THEN intarsia_now() END, error = CASE WHEN cancel_requested THEN $3 END
               FROM lost WHERE jobs.id = lost.id AND jobs.attempt = lost.attempt AND jobs.state = 'running' RETURNING jobs.id, jobs.state),
             gone AS (DELETE FROM heartbeats USING back WHERE job = back.id)
             SELECT id, state FROM back",
        );
        let query = query.bind(owner).bind(living).bind(json(&canceled())?).bind(MAX_PROGRESS_LEAD).bind(UNKNOWN_AFTER);
        let back = states(&self.rows(query).await?)?;
        self.tell(&back);
        Ok(back)
    }

    async fn died(&self, claim: &Claim) -> Result<Option<JobState>> {
        let query = sqlx::query(
            "WITH last AS (
               SELECT job, progress, stages, warnings FROM heartbeats WHERE job = $1 AND attempt = $2),
             back AS (
               UPDATE jobs SET suspect = true, deaths = deaths + 1, owner = NULL, queued_at = intarsia_now(), turn = nextval('turns'),
                 progress = coalesce(last.progress, jobs.progress), stages = coalesce(last.stages, jobs.stages),
                 warnings = coalesce(last.warnings, jobs.warnings), lead = $6 + CASE WHEN last.progress IS NULL THEN lead ELSE 0 END,
                 state = CASE WHEN cancel_requested THEN 'canceled' WHEN deaths + 1 >= $3 THEN 'failed' ELSE 'queued' END,
                 finished_at = CASE WHEN cancel_requested OR deaths + 1 >= $3 THEN intarsia_now() END,
                 error = CASE WHEN cancel_requested THEN $5 WHEN deaths + 1 >= $3 THEN $4 END
               FROM last WHERE id = $1 AND attempt = $2 AND state = 'running' RETURNING id, state),
             gone AS (DELETE FROM heartbeats USING back WHERE heartbeats.job = back.id)
             SELECT id, state FROM back",
        );
        let query = query
            .bind(&claim.id)
            .bind(i64::from(claim.attempt))
            .bind(i64::from(MAX_DEATHS))
            .bind(json(&given_up())?)
            .bind(json(&canceled())?)
            .bind(MAX_PROGRESS_LEAD);
        let back = states(&self.rows(query).await?)?;
        self.tell(&back);
        Ok(back.into_iter().next().map(|(_, state)| state))
    }

    async fn stored_bytes(&self, tenant: Option<&str>) -> Result<StoredBytes> {
        let of_tenant = if tenant.is_some() { "tenant = $1" } else { "$1::text IS NULL" };
        let sql = format!(
            "SELECT (SELECT coalesce(sum(upload_bytes), 0) FROM jobs WHERE state IN ('queued', 'running') AND {of_tenant})::bigint AS uploads,
               (SELECT coalesce(sum(artifact_bytes), 0) FROM jobs WHERE NOT artifacts_removed AND artifact_bytes > 0 AND {of_tenant})::bigint
                 AS artifacts"
        );
        let row = self.row(sqlx::query(AssertSqlSafe(sql)).bind(tenant)).await?;
        let row = row.ok_or_else(|| Failure::internal("the job queue does not count"))?;
        Ok(StoredBytes { uploads: row.number("uploads")?, artifacts: row.number("artifacts")? })
    }

    async fn check(&self, _deep: bool) -> Result<()> {
        let sql = "SELECT identity, pg_is_in_recovery() AS standby FROM store";
        let row = self.row(sqlx::query(sql)).await?;
        let row = row.ok_or_else(|| unavailable("the database of --queue holds no queue any more"))?;
        if row.text("identity")? != self.identity {
            return Err(unavailable(
                "the database of --queue holds another queue than when the service was started: start the service again",
            ));
        }
        if row.flag("standby")? {
            return Err(unavailable(
                "PostgreSQL, which holds the job queue, can only be read: --queue must name the primary",
            ));
        }
        Ok(())
    }

    async fn owners(&self) -> Result<Vec<String>> {
        let sql = "SELECT DISTINCT owner FROM jobs WHERE state = 'running' AND owner IS NOT NULL ORDER BY owner";
        self.rows(sqlx::query(sql)).await?.iter().map(|row| row.text("owner")).collect()
    }

    async fn expire(&self, before: Timestamp) -> Result<Vec<(String, JobState)>> {
        // What was never run has waited since it came.
        let query = sqlx::query(
            "UPDATE jobs SET state = 'expired', finished_at = intarsia_now()
             WHERE state = 'queued' AND attempt = 0 AND queued_at < $1 AND created_at < $1 RETURNING id, state",
        );
        let ended = states(&self.rows(query.bind(before.0)).await?)?;
        self.tell(&ended);
        Ok(ended)
    }

    async fn expire_artifacts(&self) -> Result<Vec<String>> {
        let sql = "UPDATE jobs SET artifacts_removed = true
             WHERE NOT artifacts_removed AND artifacts_expire_at <= intarsia_now() RETURNING id";
        self.rows(sqlx::query(sql)).await?.iter().map(|row| row.text("id")).collect()
    }

    async fn purge(&self, before: Timestamp) -> Result<u64> {
        let mut purged = 0;
        loop {
            let query = sqlx::query(
                "DELETE FROM jobs WHERE seq IN (SELECT seq FROM jobs
                   WHERE finished_at < $1 AND (artifacts_removed OR artifacts_expire_at IS NULL) LIMIT $2)",
            );
            let query = query.bind(before.0).bind(BATCH);
            let done = within(async { Ok(query.execute(&self.pool).await?.rows_affected()) }).await?;
            purged += done;
            if done < BATCH.unsigned_abs() {
                return Ok(purged);
            }
        }
    }

    async fn needs_upload(&self, id: &str) -> Result<bool> {
        let sql = "SELECT id FROM jobs WHERE id = $1 AND state IN ('queued', 'running')";
        Ok(self.row(sqlx::query(sql).bind(id)).await?.is_some())
    }

    async fn collect(&self, of: Option<&str>, present: &[String], grace: Duration, remove: Remove<'_>) -> Result<()> {
        collect::collect(self, of, present, grace, remove).await
    }
}

impl Postgres {
    /// Tells other processes what has become of jobs.
    fn tell(&self, jobs: &[(String, JobState)]) {
        for (id, state) in jobs {
            self.hints.send(if *state == JobState::Queued { Hint::Queued } else { Hint::Changed(id.clone()) });
        }
    }
}
