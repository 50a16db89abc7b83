//! Maintenance, which the service does by itself: jobs of dead workers run again, jobs that waited too long expire, what is old goes.

use std::time::Duration;

use futures_util::FutureExt;

use super::Jobs;
use super::record::JobState;
use crate::error::Result;

/// Uploads without a job that nobody touched for so long are orphaned: a complete upload has its job within milliseconds.
const ORPHANED_AFTER: Duration = Duration::from_secs(60);
/// The same in a store that many machines share, which is far away, and has a clock of its own.
const DISTANT_ORPHANED_AFTER: Duration = Duration::from_secs(15 * 60);
/// What is stored in parts is finished by then, or never.
const UNFINISHED_AFTER: Duration = Duration::from_secs(24 * 3600);
/// For how many leases an object is kept that nobody needs, where workers on other machines may be about to need it.
const GRACE_IN_LEASES: u32 = 4;
/// A job that there is not.
const NO_JOB: &str = "";

impl Jobs {
    /// Takes back the jobs of processes that are gone: those whose lock can be had, and those whose lease ran out.
    ///
    /// # Errors
    /// `internal`.
    pub async fn recover(&self) -> Result<()> {
        let mut back = self.queue.recover(None, self.files.owner()).await?;
        for owner in self.queue.owners().await?.iter().filter(|o| *o != self.files.owner()) {
            // Whom this folder does not know may live on another machine.
            if self.files.worker_is_gone(owner).unwrap_or(!self.queue.is_shared()) {
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
                self.remove_upload(&job).await;
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
        let present = if sweep { self.store.places().await? } else { Vec::new() };
        let remove = |place: &str| {
            let (store, place) = (self.store.clone(), place.to_owned());
            let removed = async move {
                let removed = store.remove(&place).await;
                removed.inspect_err(|failure| tracing::warn!(%place, %failure, "an object stays for now")).is_ok()
            };
            removed.boxed()
        };
        self.queue.collect(job, &present, self.lease.saturating_mul(GRACE_IN_LEASES), &remove).await
    }

    /// One round of maintenance; `sweep` also looks for objects that belong to no job.
    ///
    /// # Errors
    /// `internal`.
    pub async fn maintain(&self, sweep: bool) -> Result<()> {
        self.recover().await?;
        let now = self.queue.now().await?;
        for (job, state) in self.queue.expire(now.minus(self.limits.max_wait)).await? {
            self.hub.ended(&job, state);
            self.remove_upload(&job).await;
        }
        let expired = self.queue.expire_artifacts().await?;
        if !self.foreign {
            self.files.remove_dead_workers();
        }
        let purged = self.queue.purge(now.minus(self.limits.keep_jobs)).await?;
        self.batches.purge_batches(now.minus(self.limits.keep_jobs)).await?;
        self.webhooks.store.purge_deliveries(now.minus(self.limits.keep_jobs)).await?;
        self.resumable.maintain(now, sweep && !self.foreign).await?;
        if !self.foreign && (sweep || self.store.is_local()) {
            self.remove_orphans().await?;
        }
        if sweep || (!self.queue.is_shared() && (!expired.is_empty() || purged > 0)) {
            return self.collect(None, sweep).await;
        }
        if self.queue.is_shared() {
            // Those that expired, and then what has been marked for long enough.
            for job in expired.iter().map(String::as_str).chain([NO_JOB]) {
                self.collect(Some(job), false).await?;
            }
        }
        Ok(())
    }

    /// Removes uploads without a job, and what is left of what was not finished.
    async fn remove_orphans(&self) -> Result<()> {
        let age = if self.store.is_local() { ORPHANED_AFTER } else { DISTANT_ORPHANED_AFTER };
        for job in self.store.untouched_uploads(age).await? {
            if !self.queue.needs_upload(&job).await? {
                self.remove_upload(&job).await;
            }
        }
        self.store.remove_unfinished(UNFINISHED_AFTER).await
    }
}
