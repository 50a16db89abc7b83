//! Jobs: what they are, their durable queue, their files, and the worker that runs them on the rayon pool.
//!
//! [`Jobs`] is what handlers call. A job is on the disk (files first, then its row in the queue) before it is
//! acknowledged; a worker claims it, computes, stores the files of the result and publishes them with one statement.

mod apart;
pub mod backup;
pub mod batches;
pub mod files;
mod health;
pub mod hub;
pub mod keys;
mod maintenance;
pub mod otlp;
pub mod queue;
pub mod record;
pub mod resumable;
pub mod slots;
mod space;
pub mod store;
mod stored_options;
mod system;
pub mod telemetry;
#[cfg(test)]
mod testing;
pub mod trace;
pub mod webhooks;
mod worker;

use std::io::Read;
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use sha2::{Digest, Sha256};
use tokio::sync::{Notify, OnceCell};
use tokio::time::{Instant, sleep, sleep_until};
use tokio_util::sync::CancellationToken;

use self::telemetry::Telemetry;
use crate::config::{Limits, Storage, Webhooks, Work};
use crate::error::{Code, Failure, Result};
pub use apart::attempt;
use batches::BatchStore;
use files::Files;
use health::Health;
use hub::Hub;
use keys::KeyStore;
use queue::open::Opened;
use queue::{CancelReply, Hint, NewJob, Queue, Submitted};
use record::{ArtifactEntry, Job, JobState};
use resumable::Resumable;
use slots::{SMALL, Slots};
use store::{Parts, Store};
use webhooks::Deliverer;

/// How often a job that this process does not run is polled.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// How a submission was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Taken {
    /// As a new job.
    New,
    /// As a new job, which has the result of an equal one.
    Reused,
    /// It was known by its key.
    Known,
}

/// What tells this build from all others: the hash of its program. `None` where it cannot be read.
pub async fn build() -> Option<&'static str> {
    static BUILD: OnceCell<Option<String>> = OnceCell::const_new();
    let hash = || {
        let mut program = std::fs::File::open(std::env::current_exe().ok()?).ok()?;
        let mut hash = Sha256::new();
        let mut part = vec![0; 1 << 20];
        loop {
            match program.read(&mut part).ok()? {
                0 => break,
                n => hash.update(part.get(..n)?),
            }
        }
        Some(hex::encode(hash.finalize()))
    };
    let build = BUILD.get_or_init(|| async { tokio::task::spawn_blocking(hash).await.ok().flatten() });
    build.await.as_deref()
}

/// The jobs of a service.
pub struct Jobs {
    /// The durable queue.
    pub queue: Arc<dyn Queue>,
    /// The API keys.
    pub keys: Arc<dyn KeyStore>,
    /// Who is told of jobs that have ended.
    pub webhooks: Arc<Deliverer>,
    /// Jobs that were submitted together.
    pub batches: Arc<dyn BatchStore>,
    /// Uploads that are sent in pieces.
    pub resumable: Arc<Resumable>,
    /// The data folder.
    pub files: Files,
    /// Where uploads wait and results are kept.
    pub store: Arc<dyn Store>,
    /// What is known between two writes.
    pub hub: Hub,
    /// What is refused, and what is kept how long.
    pub limits: Limits,
    /// Ends workers and streams.
    pub shutdown: CancellationToken,
    /// Capacity for running jobs.
    pub slots: Arc<Slots>,
    /// What is counted.
    pub telemetry: Telemetry,
    /// Seconds that a job takes, the last ones above all.
    seconds: Mutex<f64>,
    health: Health,
    /// Whether files are here that the queue does not know because it is new: nothing may be collected.
    foreign: bool,
    min_free: Option<u64>,
    lease: Duration,
    grace: Duration,
    wake: Notify,
}

impl Jobs {
    /// Opens data folder, store and queue, and takes back what dead processes left running.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`: the disk, the queue or the store; `internal`: threads that cannot be had; `invalid_request`: an
    /// address that is none; `invalid_options`: a secret of webhooks that is none.
    pub async fn open(
        data: &Path,
        work: &Work,
        limits: Limits,
        storage: &Storage,
        webhooks: &Webhooks,
    ) -> Result<Arc<Self>> {
        let files = Files::open(data)?;
        let store = store::open(storage.store.as_deref(), &files, storage.min_free).await?;
        let slots = Slots::new(usize::from(work.jobs), work.threads, work.memory())?;
        let small = (slots.count() > 1).then_some(SMALL);
        let Opened { queue, keys, webhooks: outbox, batches, uploads, fresh } =
            queue::open::open(&storage.queue, data, small).await?;
        let identity = queue.identity().await?;
        let owned = store::ownership::own(&*store, &identity, fresh, storage.adopt_store).await?;
        tracing::info!(queue = identity, store = store.name(), shared = queue.is_shared(), "the job queue is open");
        let jobs = Jobs {
            queue,
            keys,
            batches,
            resumable: Arc::new(Resumable::new(uploads, store.pieces(), limits.keep_uploads)),
            webhooks: Arc::new(Deliverer::new(outbox, webhooks)?),
            files,
            store,
            hub: Hub::default(),
            limits,
            shutdown: CancellationToken::new(),
            slots,
            seconds: Mutex::new(1.0),
            telemetry: Telemetry::new()?,
            health: Health::default(),
            foreign: !owned,
            min_free: storage.min_free,
            lease: work.lease,
            grace: work.grace,
            wake: Notify::new(),
        };
        jobs.look(false).await;
        jobs.recover().await?;
        if owned {
            jobs.files.remove_dead_workers();
        }
        jobs.collect(None, true).await?;
        Ok(Arc::new(jobs))
    }

    /// Takes a job whose upload is complete in [`Files::incoming`]. When this returns, it survives anything. A job whose key is known
    /// is not stored again: the one of the key is given.
    ///
    /// # Errors
    /// `queue_full`, `quota_exceeded`, `idempotency_mismatch`, `internal`; then the upload is removed.
    pub async fn submit(&self, job: &NewJob) -> Result<(Job, Taken)> {
        let id = &job.id;
        let stored = async {
            self.store.accept(id, &self.files.incoming(id), &job.inputs).await?;
            // Known before a worker can claim it, so that nobody who follows it misses its start.
            self.hub.queued(&job.id);
            self.queue.submit(job, self.limits.max_queued).await
        };
        match stored.await {
            Ok(Submitted::New) => {
                let tenant = Some(&job.tenant).filter(|tenant| !tenant.is_empty());
                tracing::info!(job = %id, tenant, request = job.request, memory = job.memory, "job is queued");
                self.wake.notify_one();
                Ok((self.get(id).await?, Taken::New))
            }
            Ok(Submitted::Reused) => {
                tracing::info!(job = %id, request = job.request, "job has the result of an equal one");
                self.telemetry.reused.inc();
                self.hub.ended(id, JobState::Succeeded);
                self.remove_upload(id).await;
                Ok((self.get(id).await?, Taken::Reused))
            }
            Ok(Submitted::Known(known)) => {
                self.hub.ended(id, JobState::Canceled);
                self.remove_upload(id).await;
                Ok((self.get(&known).await?, Taken::Known))
            }
            Err(failure) => {
                self.not_taken(id, &failure).await;
                Err(failure)
            }
        }
    }

    /// Forgets a job that the queue did not take, or did not say that it took.
    async fn not_taken(&self, id: &str, failure: &Failure) {
        self.hub.ended(id, JobState::Canceled);
        self.files.remove_incoming(id);
        // Where the answer of a distant queue was lost, the job may be stored: maintenance looks, later.
        if !(self.queue.is_shared() && failure.is_of_the_machine()) {
            self.remove_upload(id).await;
        }
    }

    /// A job, as of now.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn get(&self, id: &str) -> Result<Job> {
        // Subscribed first, read second: an end in between is still seen. What is stored may be behind what is live.
        let live = self.hub.follow(id);
        let mut job = self.queue.get(id).await?.ok_or_else(|| unknown(id))?;
        if job.state == JobState::Running
            && let Some(live) = live.map(|f| f.borrow().clone())
            && live.attempt == job.attempt
        {
            job.progress = live.status.progress;
            job.stages = live.status.stages;
            job.warnings = live.status.warnings;
        }
        if job.state.is_final() {
            // It may have ended elsewhere.
            self.hub.ended(id, job.state);
        }
        Ok(job)
    }

    /// A job when it is final, or after `limit`.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn wait_until_final(&self, id: &str, limit: Duration) -> Result<Job> {
        let until = Instant::now() + limit;
        loop {
            // Subscribed first, read second: what happens in between is then not missed.
            let live = self.hub.follow(id);
            let job = self.get(id).await?;
            if job.state.is_final() || Instant::now() >= until || self.shutdown.is_cancelled() {
                return Ok(job);
            }
            let ends = async {
                match live {
                    Some(mut live) => live.wait_for(|live| live.state.is_final()).await.map_or((), |_| ()),
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = ends => {}
                // Another process may run it.
                () = sleep(POLL_INTERVAL) => {}
                () = sleep_until(until) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
    }

    /// Whole seconds until the job at that place of the queue may be expected to start, or to have made room: 1 to 60.
    pub fn seconds_until(&self, position: u64) -> u64 {
        let seconds = *self.seconds.lock().unwrap_or_else(PoisonError::into_inner);
        (seconds * position as f64 / self.slots.count() as f64).ceil().clamp(1.0, 60.0) as u64
    }

    /// Notes how long a job took.
    fn took(&self, seconds: f64) {
        let mut mean = self.seconds.lock().unwrap_or_else(PoisonError::into_inner);
        *mean += (seconds - *mean) / 8.0;
    }

    /// Number of jobs that wait.
    ///
    /// # Errors
    /// `internal`.
    pub async fn waiting(&self) -> Result<u64> {
        self.queue.waiting().await
    }

    /// Cancels a job: at once when it waits, as soon as it checks when it runs.
    ///
    /// # Errors
    /// `not_found`, `conflict` when it is final, `internal`.
    pub async fn cancel(&self, id: &str) -> Result<Job> {
        match self.queue.cancel(id).await? {
            CancelReply::Unknown => return Err(unknown(id)),
            CancelReply::Final => return Err(Failure::new(Code::Conflict, "the job has ended; its state is final")),
            CancelReply::Asked => self.hub.cancel(id),
            CancelReply::AtOnce => {
                self.hub.ended(id, JobState::Canceled);
                self.remove_upload(id).await;
            }
        }
        self.get(id).await
    }

    /// Deletes a job and removes its files; stops it when it runs.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn delete(&self, id: &str) -> Result<()> {
        if !self.queue.delete(id).await? {
            return Err(unknown(id));
        }
        self.hub.cancel(id);
        self.hub.ended(id, JobState::Canceled);
        self.remove_upload(id).await;
        self.collect(Some(id), false).await
    }

    /// What an artifact of a job is.
    ///
    /// # Errors
    /// `not_found`, `gone`, `internal`.
    pub async fn artifact(&self, id: &str, name: &str) -> Result<ArtifactEntry> {
        let job = self.queue.get(id).await?.ok_or_else(|| unknown(id))?;
        match job.artifacts.into_iter().find(|e| e.name == name) {
            None => Err(Failure::new(Code::NotFound, format!("the job has no artifact `{name}`"))),
            Some(entry) if entry.expired => {
                Err(Failure::new(Code::Gone, "the artifacts of this job have been removed"))
            }
            Some(entry) => Ok(entry),
        }
    }

    /// The bytes of an artifact in that range. Where it is all of them, they are held against their hash.
    ///
    /// # Errors
    /// `gone`, `unavailable`, `internal`.
    pub async fn bytes(&self, entry: &ArtifactEntry, range: Range<u64>) -> Result<Parts> {
        let whole = range == (0..entry.bytes);
        let parts = self.store.get(&self.queue.place(&entry.sha256).await?, range).await?;
        Ok(if whole { store::verified(parts, entry.sha256.clone()) } else { parts })
    }

    /// Removes what was uploaded for a job. What stays is removed by maintenance.
    async fn remove_upload(&self, job: &str) {
        self.files.remove_incoming(job);
        if let Err(failure) = self.store.remove_upload(job).await {
            tracing::warn!(job, %failure, "the upload of a job stays for now");
        }
    }

    /// Passes on what other processes tell, until the service shuts down.
    pub async fn listen(self: Arc<Self>) {
        loop {
            let hint = tokio::select! {
                hint = self.queue.hint() => hint,
                () = self.shutdown.cancelled() => break,
            };
            match hint {
                Hint::Queued => self.wake.notify_one(),
                // Whoever follows it here learns of its end at once.
                Hint::Changed(job) if self.hub.follow(&job).is_some() => match self.queue.get(&job).await {
                    Ok(Some(found)) if found.state.is_final() => self.hub.ended(&job, found.state),
                    Ok(None) => self.hub.ended(&job, JobState::Canceled),
                    _ => {}
                },
                Hint::Changed(_) => {}
            }
        }
    }
}

/// What is answered where there is no such job, or none that the caller may know of.
pub fn unknown(id: &str) -> Failure {
    Failure::new(Code::NotFound, format!("there is no job `{}`", id.chars().take(64).collect::<String>()))
}
