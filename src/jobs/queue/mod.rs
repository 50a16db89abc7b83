//! The durable queue behind one trait: what a backend must do, whatever it is made of.
//!
//! A claim is one step. Each claim gets a new attempt number, and whatever a worker writes afterwards names that number (a fencing
//! token): a worker that lost its job can change nothing. A lease says how long a silent worker is believed to be alive. All backends
//! pass one suite ([`conformance`]).

mod batch_store;
#[cfg(test)]
pub(super) mod conformance;
mod failure;
mod key_store;
pub mod open;
pub mod postgres;
mod rows;
mod schema;
pub mod sqlite;
mod upload_store;
mod webhook_store;

use std::time::Duration;

use async_trait::async_trait;
use futures_util::future::BoxFuture;
use serde_json::Value;

use self::batch_store::batch_store;
use self::key_store::key_store;
use self::upload_store::upload_store;
use self::webhook_store::webhook_store;
use super::files::Manifest;
use super::record::{ArtifactEntry, Job, JobError, JobState, Timestamp};
use crate::context::{Progress, Timing};
use crate::error::{Code, Failure, Result, Warning};
use crate::metrics::RefinementOutcome;

/// Deaths of a job's own process before it is given up: what kills its process twice does so always. That the service itself dies counts
/// against nobody.
pub const MAX_DEATHS: u32 = 2;

/// How far the fraction that users see may be ahead of what is stored: when a worker dies, its job goes on from there, so that the
/// fraction never falls.
pub const MAX_PROGRESS_LEAD: f64 = 0.2;

/// A durable queue of jobs. Every method fails with `insufficient_storage` or
/// `unavailable` when the backend does.
#[async_trait]
pub trait Queue: Send + Sync {
    /// What tells this store from all others, for as long as it lives: 128 random bits in hexadecimal digits.
    async fn identity(&self) -> Result<String>;

    /// The time by which the queue goes.
    async fn now(&self) -> Result<Timestamp>;

    /// Whether workers on other machines may take from it: what this machine knows of who lives is then not all.
    fn is_shared(&self) -> bool {
        false
    }

    /// Returns when another process says that something has changed. It is a hint: what counts is what the queue holds.
    async fn hint(&self) -> Hint {
        std::future::pending().await
    }

    /// Stores a new job, unless `most` jobs wait (`queue_full`), its tenant has as many waiting as it may (`quota_exceeded`), or its key is
    /// known to its tenant: then nothing is stored, and the job of the key is named (`idempotency_mismatch` when that was another request).
    /// When this returns, the job survives anything. Where a job of the same result key has a result, the new one has it too, and has ended.
    async fn submit(&self, job: &NewJob, most: u32) -> Result<Submitted>;

    /// A job.
    async fn get(&self, id: &str) -> Result<Option<Job>>;

    /// Whose a job is; empty for one of no tenant.
    async fn tenant_of(&self, id: &str) -> Result<Option<String>>;

    /// A page of jobs, the newest first, with the next cursor.
    async fn list(&self, wanted: Listing<'_>) -> Result<(Vec<Job>, Option<i64>)>;

    /// Number of jobs by state; states without a job may be left out.
    async fn counts(&self) -> Result<Vec<(JobState, u64)>>;

    /// Number of jobs that wait.
    async fn waiting(&self) -> Result<u64>;

    /// Since when the job waits that has waited longest.
    async fn waits_since(&self) -> Result<Option<Timestamp>>;

    /// Takes the job whose turn it is among those that there is capacity for and that their tenants may run. Tenants take turns: first who
    /// runs least, then who was served longest ago. Of one tenant, what has waited for longer than the patience of `capacity` comes first,
    /// then the smallest; jobs of no tenant run as they came.
    async fn claim(&self, owner: &str, lease: Duration, capacity: Capacity) -> Result<Option<Claim>>;

    /// Renews the lease and notes how far the job is.
    async fn heartbeat(&self, claim: &Claim, lease: Duration, status: &AttemptStatus) -> Result<HeartbeatReply>;

    /// Notes that the attempt is about to store objects with these hashes, so that nobody removes them, and says under which names. `None`
    /// when the job is not the worker's any more.
    async fn reserve(&self, claim: &Claim, objects: &[String]) -> Result<Option<Vec<String>>>;

    /// The name under which the object with this hash is stored.
    async fn place(&self, sha256: &str) -> Result<String>;

    /// Publishes how an attempt ended, in one step. False when the job is not the worker's any more, or when its user cancelled it and
    /// `end` is no cancellation.
    async fn finish(&self, claim: &Claim, end: &AttemptEnd, keep: Duration) -> Result<bool>;

    /// Puts a job back, first in its turn, because its process goes down in an orderly way. False when it is not the worker's any more,
    /// or when its user cancelled it.
    async fn release(&self, claim: &Claim, progress: &Progress) -> Result<bool>;

    /// Cancels a job that waits, or asks for it when it runs.
    async fn cancel(&self, id: &str) -> Result<CancelReply>;

    /// Deletes a job. False when there is none.
    async fn delete(&self, id: &str) -> Result<bool>;

    /// Takes back the running jobs of `owner`, if one is named, and those whose lease ran out, but for those of `living`, which is the
    /// caller and knows better. Returns them with their new states: cancelled where their user wanted that, else queued as suspects, behind
    /// all that wait and with [`MAX_PROGRESS_LEAD`] more than the stored fraction.
    async fn recover(&self, owner: Option<&str>, living: &str) -> Result<Vec<(String, JobState)>>;

    /// Notes that the attempt's own process died, and puts the job back as [`Queue::recover`] does, or ends it after [`MAX_DEATHS`].
    /// `None` when it is not the worker's any more.
    async fn died(&self, claim: &Claim) -> Result<Option<JobState>>;

    /// Bytes of the uploads of jobs that wait or run, and of all results that are kept: of one tenant, or of all.
    async fn stored_bytes(&self, tenant: Option<&str>) -> Result<StoredBytes>;

    /// Whether the queue is where and what it was, and can be read and written; `deep` reads all of it.
    async fn check(&self, deep: bool) -> Result<()>;

    /// The workers that hold jobs.
    async fn owners(&self) -> Result<Vec<String>>;

    /// Expires the jobs that have waited since before `before` and were never run.
    async fn expire(&self, before: Timestamp) -> Result<Vec<(String, JobState)>>;

    /// Marks the artifacts that have expired as removed. Returns the jobs.
    async fn expire_artifacts(&self) -> Result<Vec<String>>;

    /// Deletes the jobs that ended before `before` and whose artifacts are gone.
    async fn purge(&self, before: Timestamp) -> Result<u64>;

    /// Whether the job still needs what was uploaded for it: it waits or runs.
    async fn needs_upload(&self, id: &str) -> Result<bool>;

    /// Drops reservations that no running attempt and no result needs (of `job`, or of all), and calls `remove` with the name of every object
    /// that nothing is left of, and with those of `present` that nothing reserves. Nobody is given such a name again while it is removed.
    /// Where workers on other machines share the queue, an object is marked first, and goes when it has been for `grace`, unless somebody
    /// has reserved it.
    async fn collect(&self, job: Option<&str>, present: &[String], grace: Duration, remove: Remove<'_>) -> Result<()>;
}

/// Removes an object; false where that failed, and is to be tried again.
pub type Remove<'a> = &'a (dyn Fn(&str) -> BoxFuture<'static, bool> + Send + Sync);

/// What another process says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Hint {
    /// A job waits.
    Queued,
    /// This job has changed.
    Changed(String),
}

/// Which jobs are listed.
#[derive(Debug, Clone, Copy, Default)]
pub struct Listing<'a> {
    /// Only those of this tenant.
    pub tenant: Option<&'a str>,
    /// Only those in this state.
    pub state: Option<JobState>,
    /// Only those behind it.
    pub cursor: Option<i64>,
    /// At most so many.
    pub limit: u32,
}

/// A job to store.
#[derive(Debug, Clone, Default)]
pub struct NewJob {
    /// Its id.
    pub id: String,
    /// Its options, all defaults filled in.
    pub options: Value,
    /// What was uploaded.
    pub inputs: Manifest,
    /// Bytes that it is expected to need.
    pub memory: u64,
    /// Bytes of its upload.
    pub bytes: u64,
    /// The client's key and the fingerprint of its request.
    pub key: Option<(String, String)>,
    /// The request that brought it.
    pub request: Option<String>,
    /// Whose it is; empty for nobody's.
    pub tenant: String,
    /// Jobs of its tenant that may wait, with it.
    pub max_queued: Option<u32>,
    /// Jobs of its tenant that may run when it starts, with it.
    pub max_running: Option<u32>,
    /// What its result follows from, where it may be that of another job.
    pub result_key: Option<String>,
    /// The traceparent of the request that brought it.
    pub trace: Option<String>,
    /// How long artifacts of another job are kept for it.
    pub keep: Duration,
}

impl NewJob {
    /// The client's key as it is stored.
    pub(super) fn stored_key(&self) -> Option<String> {
        let (key, _) = self.key.as_ref()?;
        Some(stored_key(&self.tenant, key))
    }
}

/// A client's key as it is stored: each tenant has its own. No key of a client holds a line end.
pub(super) fn stored_key(tenant: &str, key: &str) -> String {
    if tenant.is_empty() { key.to_owned() } else { format!("{tenant}\n{key}") }
}

/// What became of a new job.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Submitted {
    /// It is stored.
    New,
    /// It is stored, and has the result of another.
    Reused,
    /// The key is known, with the same request: this is its job.
    Known(String),
}

/// What a worker has capacity for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Capacity {
    /// Bytes that all its jobs may need together; a job that is expected to need more counts as this much.
    pub total: u64,
    /// Bytes of them that are free.
    pub free: u64,
    /// Only jobs that are expected to need no more than this.
    pub most: u64,
    /// A job for which there is no capacity is overtaken by smaller ones for so long.
    pub patience: Duration,
}

impl Capacity {
    /// Capacity for anything.
    pub const ANY: Capacity = Capacity { total: u64::MAX, free: u64::MAX, most: u64::MAX, patience: Duration::ZERO };
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
    /// Bytes that it is expected to need.
    pub memory: u64,
    /// The request that brought it.
    pub request: Option<String>,
    /// The traceparent of that request.
    pub trace: Option<String>,
    /// Since when it waited.
    pub queued_at: Timestamp,
    /// Whether a process died while it computed this job: it runs in a process of its own.
    pub suspect: bool,
}

/// What jobs take of the disk. A file that several jobs have counts for each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StoredBytes {
    /// Uploads of jobs that wait or run.
    pub uploads: u64,
    /// Artifacts that are kept.
    pub artifacts: u64,
}

/// Where an attempt stands.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct AttemptStatus {
    /// How far it is.
    pub progress: Progress,
    /// The stages that it has entered, each with its first progress.
    pub stages: Vec<Progress>,
    /// Its warnings.
    pub warnings: Vec<Warning>,
}

/// What a heartbeat is answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeartbeatReply {
    /// Go on.
    Held,
    /// Stop: the user has cancelled it.
    Cancel,
    /// The job is no longer the worker's.
    Lost,
}

/// How an attempt ended.
#[derive(Debug, Clone)]
pub struct AttemptEnd {
    /// A final state.
    pub state: JobState,
    /// Why it failed.
    pub error: Option<JobError>,
    /// What became of what it was given, where it has a result.
    pub outcome: Option<RefinementOutcome>,
    /// Its results.
    pub artifacts: Vec<ArtifactEntry>,
    /// Where it stood at the end.
    pub status: AttemptStatus,
    /// Seconds by stage.
    pub timings: Vec<Timing>,
}

/// What became of a request to cancel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CancelReply {
    /// It was waiting and is cancelled.
    AtOnce,
    /// It runs and was asked to stop.
    Asked,
    /// Its state is final.
    Final,
    /// There is no such job.
    Unknown,
}

/// What a full queue answers.
pub fn queue_full() -> Failure {
    Failure::new(Code::QueueFull, "the queue is full; try again later")
}

/// What a tenant is answered that has as many jobs waiting as its key allows.
pub(super) fn quota_of_waiting(most: u32) -> Failure {
    let message = format!("this key lets {most} jobs wait, and so many do; submit again when some have started");
    Failure::new(Code::QuotaExceeded, message)
}

/// The error of a job that was cancelled.
pub(super) fn canceled() -> JobError {
    JobError::from(Failure::new(Code::Canceled, "the job was cancelled"))
}

/// The error of a job that was given up.
pub(super) fn given_up() -> JobError {
    JobError::from(Failure::internal(format!(
        "the process that computed this job, and nothing else, died {MAX_DEATHS} times: Intarsia fails on this model, or it needs more memory than there is"
    )))
}

/// What another request under a known key is answered.
pub(super) fn mismatch() -> Failure {
    Failure::new(Code::IdempotencyMismatch, "this Idempotency-Key was used for another request")
}
