//! Maintenance, which the service does by itself: jobs of dead workers run again, jobs that waited too long expire, what is old goes.

use std::time::Duration;

use super::Jobs;
use super::record::{JobState, Timestamp};
use crate::error::{Failure, Result};

/// Uploads without a job that nobody touched for so long are orphaned: a complete upload has its job within milliseconds.
const ORPHANED_AFTER: Duration = Duration::from_secs(60);

impl Jobs {
    /// Takes back the jobs of processes that are gone: those whose lock can be had, and those whose lease ran out.
    ///
    /// # Errors
    /// `internal`.
    pub async fn recover(&self) -> Result<()> {
        let mut back = self.queue.recover(None, self.files.owner()).await?;
        for owner in self.queue.owners().await?.iter().filter(|o| *o != self.files.owner()) {
            if self.files.worker_is_gone(owner) {
                back.extend(self.queue.recover(Some(owner), self.files.owner()).await?);
            }
        }
        self.telemetry.leases_lost.inc_by(back.len() as u64);
        for (job, state) in back {
            tracing::warn!(%job, state = state.as_str(), "took back a job whose worker is gone");
            if state == JobState::Queued {
                self.hub.requeued(&job);
                self.wake.notify_one();
            } else {
                self.hub.cancel(&job);
                self.hub.ended(&job, state);
                self.files.remove_uploads(&job);
            }
            // What the dead attempt has stored.
            self.collect(Some(&job), false).await?;
        }
        Ok(())
    }

    /// Removes the objects that nobody needs any more: of one job or of all, and with `sweep` those that nobody ever has.
    ///
    /// # Errors
    /// `internal`.
    pub(super) async fn collect(&self, job: Option<&str>, sweep: bool) -> Result<()> {
        if self.foreign {
            return Ok(());
        }
        let files = self.files.clone();
        let present = match sweep {
            true => tokio::task::spawn_blocking(move || files.objects()).await,
            false => Ok(Vec::new()),
        };
        let present = present.map_err(|e| Failure::internal(format!("the objects cannot be listed: {e}")))?;
        self.queue.collect(job, &present, &|object| self.files.remove_object(object)).await
    }

    /// One round of maintenance; `sweep` also looks for objects that belong to no job.
    ///
    /// # Errors
    /// `internal`.
    pub async fn maintain(&self, sweep: bool) -> Result<()> {
        self.recover().await?;
        let now = Timestamp::now();
        for (job, state) in self.queue.expire(now.minus(self.limits.max_wait)).await? {
            self.hub.ended(&job, state);
            self.files.remove_uploads(&job);
        }
        let expired = self.queue.expire_artifacts().await?;
        if !self.foreign {
            self.files.remove_dead_workers();
        }
        let purged = self.queue.purge(now.minus(self.limits.keep_jobs)).await?;
        self.batches.purge_batches(now.minus(self.limits.keep_jobs)).await?;
        self.webhooks.store.purge_deliveries(now.minus(self.limits.keep_jobs)).await?;
        self.resumable.maintain(now, sweep && !self.foreign).await?;
        for job in self.files.untouched(ORPHANED_AFTER).iter().filter(|_| !self.foreign) {
            if !self.queue.needs_upload(job).await? {
                self.files.remove_uploads(job);
            }
        }
        if sweep || !expired.is_empty() || purged > 0 {
            self.collect(None, sweep).await?;
        }
        Ok(())
    }
}
