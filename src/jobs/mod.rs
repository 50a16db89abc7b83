//! Jobs: what they are, their durable queue, their files, and the worker that runs them on the rayon pool.
//!
//! [`Jobs`] is what handlers call. A job is on the disk (files first, then its row in the queue) before it is
//! acknowledged; a worker claims it, computes, stores the files of the result and publishes them with one statement.

pub mod files;
pub mod hub;
pub mod queue;
pub mod record;
mod rows;
mod upkeep;
mod worker;

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use serde_json::Value;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use crate::config::Limits;
use crate::error::{Code, Failure, Result};
use crate::refine::options::Options;
use files::{Files, Manifest};
use hub::Hub;
use queue::{Canceled, Queue};
use record::{Entry, Job, State};

/// The jobs of a service.
pub struct Jobs {
    /// The durable queue.
    pub queue: Queue,
    /// The data folder.
    pub files: Files,
    /// What is known between two writes.
    pub hub: Hub,
    /// What is refused, and what is kept how long.
    pub limits: Limits,
    /// Ends workers and streams.
    pub shutdown: CancellationToken,
    owner: String,
    wake: Notify,
    pool: rayon::ThreadPool,
    /// Locked as long as this process lives, so that others can see when it is gone.
    _lock: File,
}

impl Jobs {
    /// Opens the data folder and takes back what a dead process left running.
    ///
    /// # Errors
    /// `internal`: the disk, or threads that cannot be had.
    pub async fn open(data: &Path, threads: usize, limits: Limits) -> Result<Arc<Self>> {
        let files = Files::open(data)?;
        let queue = Queue::open(&files.queue()).await?;
        let owner = record::new_id()?;
        let lock = files.register_worker(&owner)?;
        let jobs = Jobs {
            queue,
            files,
            hub: Hub::default(),
            limits,
            shutdown: CancellationToken::new(),
            owner,
            wake: Notify::new(),
            pool: pool(threads)?,
            _lock: lock,
        };
        jobs.recover().await?;
        Ok(Arc::new(jobs))
    }

    /// Threads that compute.
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Takes a job whose upload is complete in [`Files::incoming`]. When this returns, it survives anything.
    ///
    /// # Errors
    /// `queue_full`, `internal`; then the upload is removed.
    pub async fn submit(&self, id: &str, options: &Options, manifest: &Manifest) -> Result<Job> {
        let stored = async {
            let options = serde_json::to_value(options).map_err(|e| Failure::internal(e.to_string()))?;
            let (files, job) = (self.files.clone(), id.to_owned());
            let accepted = tokio::task::spawn_blocking(move || files.accept(&job)).await;
            accepted.map_err(|e| Failure::internal(format!("the upload was lost: {e}")))??;
            // Known before a worker can claim it, so that nobody who follows it misses its start.
            self.hub.queued(id);
            self.queue.submit(id, &options, manifest, self.limits.max_queued).await
        };
        if let Err(failure) = stored.await {
            self.hub.ended(id, State::Canceled);
            self.files.remove_uploads(id);
            return Err(failure);
        }
        self.wake.notify_one();
        self.get(id).await
    }

    /// A job, as of now.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn get(&self, id: &str) -> Result<Job> {
        let mut job = self.queue.get(id).await?.ok_or_else(|| unknown(id))?;
        if job.state == State::Running
            && let Some(live) = self.hub.follow(id).map(|f| f.borrow().clone())
            && live.attempt == job.attempt
        {
            job.progress = live.progress;
            job.warnings = live.warnings;
        }
        Ok(job)
    }

    /// Cancels a job: at once when it waits, as soon as it listens when it runs.
    ///
    /// # Errors
    /// `not_found`, `conflict` when it is final, `internal`.
    pub async fn cancel(&self, id: &str) -> Result<Job> {
        match self.queue.cancel(id).await? {
            Canceled::Unknown => return Err(unknown(id)),
            Canceled::Final => return Err(Failure::new(Code::Conflict, "the job has ended; its state is final")),
            Canceled::Asked => self.hub.cancel(id),
            Canceled::AtOnce => {
                self.hub.ended(id, State::Canceled);
                self.files.remove_uploads(id);
            }
        }
        self.get(id).await
    }

    /// Forgets a job and removes its files; stops it when it runs.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn delete(&self, id: &str) -> Result<()> {
        if !self.queue.delete(id).await? {
            return Err(unknown(id));
        }
        self.hub.cancel(id);
        self.hub.ended(id, State::Canceled);
        self.files.remove_uploads(id);
        self.files.remove_artifacts(id);
        Ok(())
    }

    /// An artifact and where its file is.
    ///
    /// # Errors
    /// `not_found`, `gone`, `internal`.
    pub async fn artifact(&self, id: &str, name: &str) -> Result<(Entry, std::path::PathBuf)> {
        let (attempt, entries, removed) = self.queue.result(id).await?.ok_or_else(|| unknown(id))?;
        let number = entries.iter().position(|e| e.name == name);
        let found = number.and_then(|n| Some((entries.get(n)?.clone(), self.files.artifact(id, attempt, n))));
        match found {
            None => Err(Failure::new(Code::NotFound, format!("the job has no artifact `{name}`"))),
            Some(_) if removed => Err(Failure::new(Code::Gone, "the artifacts of this job have been removed")),
            Some(found) => Ok(found),
        }
    }
}

/// The pool that computes; 0 threads means one for each core.
///
/// # Errors
/// `internal` when the system has no threads to give.
pub fn pool(threads: usize) -> Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("compute-{i}"))
        .stack_size(8 << 20)
        .build()
        .map_err(|e| Failure::internal(format!("no threads: {e}")))
}

/// The options of a job as its row holds them.
fn stored_options(value: &Value) -> Result<Options> {
    serde_json::from_value(value.clone()).map_err(|e| Failure::internal(format!("the stored options are broken: {e}")))
}

fn unknown(id: &str) -> Failure {
    Failure::new(Code::NotFound, format!("there is no job `{}`", id.chars().take(64).collect::<String>()))
}
