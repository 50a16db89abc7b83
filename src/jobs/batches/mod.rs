//! Batches: jobs that are submitted together, all or none, and have one status.

#[cfg(test)]
pub(super) mod conformance;

use std::time::Duration;

use async_trait::async_trait;
use serde::Serialize;
use serde_json::Value;
use tokio::time::{Instant, sleep, sleep_until};
use utoipa::ToSchema;

use super::queue::{NewJob, Submitted};
use super::record::{JobError, JobState, Timestamp};
use super::{Jobs, POLL_INTERVAL};
use crate::error::{Code, Failure, Result};
use crate::metrics::RefinementOutcome;

/// A batch to store.
#[derive(Debug, Clone)]
pub struct NewBatch {
    /// Its id.
    pub id: String,
    /// Whose it is; empty for nobody's.
    pub tenant: String,
    /// What its user wrote on it.
    pub metadata: Value,
    /// The client's key and the fingerprint of its request.
    pub key: Option<(String, String)>,
    /// Its jobs, in the order of the request.
    pub jobs: Vec<NewJob>,
}

/// What became of a new batch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BatchSubmitted {
    /// It is stored: what became of each job.
    New(Vec<Submitted>),
    /// The key is known, with the same request: this is its batch.
    Known(String),
}

/// A batch as it is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredBatch {
    /// Its id.
    pub id: String,
    /// What its user wrote on it.
    pub metadata: Value,
    /// When it was accepted.
    pub created_at: Timestamp,
    /// Its items, in the order of the request.
    pub items: Vec<StoredItem>,
}

/// An item of a stored batch.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredItem {
    /// The id of its job.
    pub id: String,
    /// Whether the job was made for it, or known before.
    pub made: bool,
    /// Its job; `None` when that was deleted.
    pub job: Option<StoredJob>,
}

/// What a batch tells of a job.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredJob {
    /// Where it stands.
    pub state: JobState,
    /// How often it was started.
    pub attempt: u32,
    /// What became of what it was given.
    pub outcome: Option<RefinementOutcome>,
    /// How far it is.
    pub fraction: f64,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
    /// Why it failed.
    pub error: Option<JobError>,
}

/// Where batches are kept, beside their jobs. Every method fails with `insufficient_storage` or `unavailable` when the backend does.
#[async_trait]
pub trait BatchStore: Send + Sync {
    /// Stores a batch with all its jobs in one step, each as [`super::queue::Queue::submit`] does: one that cannot be taken and nothing is
    /// stored. An item whose key belongs to another request is named by the pointer of the failure.
    async fn submit_batch(&self, batch: &NewBatch, most: u32) -> Result<BatchSubmitted>;

    /// A batch.
    async fn batch(&self, id: &str) -> Result<Option<StoredBatch>>;

    /// Whose a batch is; empty for one of no tenant.
    async fn tenant_of_batch(&self, id: &str) -> Result<Option<String>>;

    /// Forgets a batch, and none of its jobs. False where there is none.
    async fn delete_batch(&self, id: &str) -> Result<bool>;

    /// Forgets the batches from before `before` whose jobs are all gone.
    async fn purge_batches(&self, before: Timestamp) -> Result<u64>;
}

/// A batch.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct Batch {
    /// 128 random bits in hexadecimal digits. Knowing it is the right to read the batch.
    #[schema(pattern = "^[0-9a-f]{32}$")]
    pub id: String,
    /// Where all of it stands: `queued` until a job runs, `running` until each has ended; then `failed` where one failed, else `expired` or
    /// `canceled` where one was that, else `succeeded`.
    pub state: JobState,
    /// How far all of it is: the mean of its jobs, 1 when each has ended.
    #[schema(minimum = 0, maximum = 1)]
    pub fraction: f64,
    /// Jobs by state.
    pub counts: BatchCounts,
    /// Jobs by what became of what they were given.
    pub outcomes: BatchOutcomes,
    /// When it was accepted.
    pub created_at: Timestamp,
    /// When its last job ended.
    pub finished_at: Option<Timestamp>,
    /// Its jobs, in the order of the request.
    pub jobs: Vec<BatchJob>,
    /// What its user wrote on it.
    #[schema(value_type = serde_json::Map<String, Value>)]
    pub metadata: Value,
}

/// A job of a batch.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
pub struct BatchJob {
    /// Its place in the request, from 0.
    pub item: u64,
    /// Its id.
    pub id: String,
    /// Where it stands; null when it was deleted.
    pub state: Option<JobState>,
    /// How far it is.
    #[schema(minimum = 0, maximum = 1)]
    pub fraction: f64,
    /// What became of what it was given.
    pub outcome: Option<RefinementOutcome>,
    /// Why it failed.
    pub error: Option<JobError>,
    /// Where it is; null when it was deleted.
    pub href: Option<String>,
}

/// Jobs by state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct BatchCounts {
    /// They wait.
    pub queued: u64,
    /// They are computed.
    pub running: u64,
    /// They are done.
    pub succeeded: u64,
    /// They failed.
    pub failed: u64,
    /// They were cancelled.
    pub canceled: u64,
    /// They waited for too long.
    pub expired: u64,
    /// They were deleted, by their user or because their time was up.
    pub deleted: u64,
}

/// Jobs by what became of what they were given.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct BatchOutcomes {
    /// All of it was refined.
    pub refined: u64,
    /// Some of it was.
    pub partly_refined: u64,
    /// The input was as good.
    pub kept_input: u64,
    /// There was nothing to refine.
    pub nothing_to_refine: u64,
}

impl From<StoredBatch> for Batch {
    fn from(stored: StoredBatch) -> Self {
        let (mut counts, mut outcomes) = (BatchCounts::default(), BatchOutcomes::default());
        let (mut jobs, mut finished_at) = (Vec::with_capacity(stored.items.len()), None);
        for (item, StoredItem { id, job, .. }) in (0..).zip(stored.items) {
            let Some(job) = job else {
                counts.deleted += 1;
                jobs.push(BatchJob { item, id, state: None, fraction: 1.0, outcome: None, error: None, href: None });
                continue;
            };
            *match job.state {
                JobState::Queued => &mut counts.queued,
                JobState::Running => &mut counts.running,
                JobState::Succeeded => &mut counts.succeeded,
                JobState::Failed => &mut counts.failed,
                JobState::Canceled => &mut counts.canceled,
                JobState::Expired => &mut counts.expired,
            } += 1;
            if let Some(outcome) = job.outcome {
                *match outcome {
                    RefinementOutcome::Refined => &mut outcomes.refined,
                    RefinementOutcome::PartlyRefined => &mut outcomes.partly_refined,
                    RefinementOutcome::KeptInput => &mut outcomes.kept_input,
                    RefinementOutcome::NothingToRefine => &mut outcomes.nothing_to_refine,
                } += 1;
            }
            finished_at = finished_at.max(job.finished_at);
            let fraction = if job.state.is_final() { 1.0 } else { job.fraction.min(1.0) };
            let href = Some(format!("/v1/jobs/{id}"));
            jobs.push(BatchJob {
                item,
                id,
                state: Some(job.state),
                fraction,
                outcome: job.outcome,
                error: job.error,
                href,
            });
        }
        let state = state(&counts);
        Batch {
            id: stored.id,
            state,
            fraction: jobs.iter().map(|job| job.fraction).sum::<f64>() / jobs.len().max(1) as f64,
            counts,
            outcomes,
            created_at: stored.created_at,
            finished_at: finished_at.filter(|_| state.is_final()),
            jobs,
            metadata: stored.metadata,
        }
    }
}

fn state(counts: &BatchCounts) -> JobState {
    let ended = counts.succeeded + counts.failed + counts.canceled + counts.expired + counts.deleted;
    match counts {
        BatchCounts { queued: 0, running: 0, .. } => {}
        BatchCounts { running: 0, .. } if ended == 0 => return JobState::Queued,
        _ => return JobState::Running,
    }
    match counts {
        BatchCounts { failed: 1.., .. } => JobState::Failed,
        BatchCounts { expired: 1.., .. } => JobState::Expired,
        BatchCounts { canceled: 1.., .. } => JobState::Canceled,
        BatchCounts { succeeded: 0, .. } => JobState::Canceled,
        _ => JobState::Succeeded,
    }
}

impl Jobs {
    /// Takes a batch whose uploads are complete in [`super::files::Files::incoming`], all or nothing. When this returns, it survives anything.
    /// True where it was known by its key.
    ///
    /// # Errors
    /// `queue_full`, `quota_exceeded`, `idempotency_mismatch`; then the uploads are removed.
    pub async fn submit_batch(&self, batch: NewBatch) -> Result<(Batch, bool)> {
        let ids: Vec<String> = batch.jobs.iter().map(|job| job.id.clone()).collect();
        let stored = async {
            for job in &batch.jobs {
                self.store.accept(&job.id, &self.files.incoming(&job.id), &job.inputs).await?;
            }
            // Known before a worker can claim them, so that nobody who follows one misses its start.
            batch.jobs.iter().for_each(|job| self.hub.queued(&job.id));
            self.batches.submit_batch(&batch, self.limits.max_queued).await
        };
        let forget = async |id: &str, state: JobState| {
            self.hub.ended(id, state);
            self.remove_upload(id).await;
        };
        match stored.await {
            Ok(BatchSubmitted::New(submitted)) => {
                for (id, one) in ids.iter().zip(&submitted) {
                    match one {
                        Submitted::New => {}
                        Submitted::Reused => {
                            self.telemetry.reused.inc();
                            forget(id, JobState::Succeeded).await;
                        }
                        Submitted::Known(_) => forget(id, JobState::Canceled).await,
                    }
                }
                tracing::info!(batch = batch.id, jobs = ids.len(), "a batch is queued");
                self.wake.notify_one();
                Ok((self.batch(&batch.id).await?, false))
            }
            Ok(BatchSubmitted::Known(known)) => {
                for id in &ids {
                    forget(id, JobState::Canceled).await;
                }
                Ok((self.batch(&known).await?, true))
            }
            Err(failure) => {
                for id in &ids {
                    self.not_taken(id, &failure).await;
                }
                Err(failure)
            }
        }
    }

    async fn stored_batch(&self, id: &str) -> Result<StoredBatch> {
        self.batches.batch(id).await?.ok_or_else(|| unknown_batch(id))
    }

    /// A batch, as of now.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn batch(&self, id: &str) -> Result<Batch> {
        let mut stored = self.stored_batch(id).await?;
        for StoredItem { id, job, .. } in &mut stored.items {
            // What is stored may be behind what is live.
            if let Some(job) = job.as_mut().filter(|job| job.state == JobState::Running)
                && let Some(live) = self.hub.follow(id)
                && live.borrow().attempt == job.attempt
            {
                job.fraction = job.fraction.max(live.borrow().status.progress.fraction);
            }
        }
        Ok(stored.into())
    }

    /// A batch when all its jobs are final, or after `limit`.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn wait_until_batch_is_final(&self, id: &str, limit: Duration) -> Result<Batch> {
        let until = Instant::now() + limit;
        loop {
            let batch = self.batch(id).await?;
            if batch.state.is_final() || Instant::now() >= until || self.shutdown.is_cancelled() {
                return Ok(batch);
            }
            tokio::select! {
                () = sleep(POLL_INTERVAL) => {}
                () = sleep_until(until) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
    }

    /// Cancels each job of a batch that has not ended.
    ///
    /// # Errors
    /// `not_found`; `conflict` when all have ended; `internal`.
    pub async fn cancel_batch(&self, id: &str) -> Result<Batch> {
        let mut canceled = 0;
        for item in self.stored_batch(id).await?.items {
            if item.job.is_some_and(|job| !job.state.is_final()) {
                match self.cancel(&item.id).await {
                    Ok(_) => canceled += 1,
                    // It has ended meanwhile.
                    Err(failure) if matches!(failure.code, Code::Conflict | Code::NotFound) => {}
                    Err(failure) => return Err(failure),
                }
            }
        }
        if canceled == 0 {
            return Err(Failure::new(Code::Conflict, "all jobs of the batch have ended; their states are final"));
        }
        self.batch(id).await
    }

    /// Deletes a batch with the jobs that it made; those that were known before by their keys stay.
    ///
    /// # Errors
    /// `not_found`, `internal`.
    pub async fn delete_batch(&self, id: &str) -> Result<()> {
        for item in self.stored_batch(id).await?.items.into_iter().filter(|item| item.made && item.job.is_some()) {
            match self.delete(&item.id).await {
                Err(failure) if failure.code != Code::NotFound => return Err(failure),
                _ => {}
            }
        }
        if self.batches.delete_batch(id).await? { Ok(()) } else { Err(unknown_batch(id)) }
    }
}

/// What is answered where there is no such batch, or none that the caller may know of.
pub fn unknown_batch(id: &str) -> Failure {
    Failure::new(Code::NotFound, format!("there is no batch `{}`", id.chars().take(64).collect::<String>()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_of_a_batch_follows_from_those_of_its_jobs() {
        let of = |states: &[Option<JobState>]| {
            let item = |state: &Option<JobState>| StoredItem {
                id: "j".into(),
                made: true,
                job: state.map(|state| StoredJob {
                    state,
                    attempt: 1,
                    outcome: (state == JobState::Succeeded).then_some(RefinementOutcome::Refined),
                    fraction: 0.5,
                    finished_at: state.is_final().then_some(Timestamp(7)),
                    error: None,
                }),
            };
            let items = states.iter().map(item).collect();
            let batch =
                Batch::from(StoredBatch { id: "b".into(), metadata: Value::Null, created_at: Timestamp(0), items });
            (batch.state, batch.fraction, batch.finished_at.is_some())
        };
        use JobState::{Canceled, Expired, Failed, Queued, Running, Succeeded};
        assert_eq!(of(&[Some(Queued), Some(Queued)]), (Queued, 0.5, false));
        assert_eq!(of(&[Some(Queued), Some(Succeeded)]), (Running, 0.75, false));
        assert_eq!(of(&[Some(Running), Some(Queued)]).0, Running);
        assert_eq!(of(&[Some(Succeeded), None]), (Succeeded, 1.0, true));
        assert_eq!(of(&[Some(Succeeded), Some(Canceled)]).0, Canceled);
        assert_eq!(of(&[Some(Expired), Some(Canceled)]).0, Expired);
        assert_eq!(of(&[Some(Expired), Some(Failed), Some(Succeeded)]).0, Failed);
        assert_eq!(of(&[None]), (Canceled, 1.0, false));
    }
}
