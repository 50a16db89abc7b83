//! What is known of the jobs of this process between two writes to the queue: progress, warnings, cancellation.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;

use super::queue::{AttemptStatus, MAX_PROGRESS_LEAD};
use super::record::JobState;
use crate::context::{Listener, Progress};
use crate::error::Warning;

/// The smallest step of the fraction that is passed on.
pub(super) const STEP: f64 = 0.002;

/// Where a job of this process stands.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveJob {
    /// Its state.
    pub state: JobState,
    /// Number of its attempt; 0 before the first.
    pub attempt: u32,
    /// Where the attempt stands.
    pub status: AttemptStatus,
}

/// A job of this process, for those who follow it and those who stop it.
struct TrackedJob {
    live: watch::Sender<LiveJob>,
    stop: StopSignal,
}

/// Asks an attempt to stop: what computes by a flag, what waits by a token.
#[derive(Clone, Default)]
pub struct StopSignal {
    /// True when it shall stop.
    pub flag: Arc<AtomicBool>,
    /// Cancelled when it shall stop.
    pub token: CancellationToken,
}

impl StopSignal {
    /// Asks for it.
    pub fn trigger(&self) {
        self.flag.store(true, Ordering::Relaxed);
        self.token.cancel();
    }
}

/// The jobs of this process that are not final.
#[derive(Default)]
pub struct Hub {
    jobs: Mutex<BTreeMap<String, TrackedJob>>,
}

impl Hub {
    /// Registers a job that waits.
    pub fn queued(&self, job: &str) {
        let live = LiveJob { state: JobState::Queued, attempt: 0, status: AttemptStatus::default() };
        let tracked = TrackedJob { live: watch::Sender::new(live), stop: StopSignal::default() };
        self.lock().entry(job.to_owned()).or_insert(tracked);
    }

    /// Registers that an attempt starts, whose fraction does not fall under `floor`.
    pub fn started(&self, job: &str, attempt: u32, floor: f64) -> Arc<Reporter> {
        self.queued(job);
        let mut jobs = self.lock();
        let stop = StopSignal::default();
        let progress = Progress { fraction: floor, ..Progress::default() };
        let status = AttemptStatus { progress, ..AttemptStatus::default() };
        let live = LiveJob { state: JobState::Running, attempt, status };
        let sender = match jobs.get_mut(job) {
            Some(tracked) => {
                tracked.stop = stop.clone();
                tracked.live.send_replace(live);
                tracked.live.clone()
            }
            None => watch::Sender::new(live),
        };
        let (entered, stored) = (Mutex::default(), Mutex::new(floor));
        Arc::new(Reporter { live: sender, stop, ahead: Notify::new(), floor, entered, stored })
    }

    /// Registers that a job goes back to the queue.
    pub fn requeued(&self, job: &str) {
        self.queued(job);
        if let Some(tracked) = self.lock().get(job) {
            tracked.live.send_modify(|live| live.state = JobState::Queued);
        }
    }

    /// Registers that a job is final, and forgets it. Call it after the queue knows.
    pub fn ended(&self, job: &str, state: JobState) {
        if let Some(tracked) = self.lock().remove(job) {
            tracked.live.send_modify(|live| live.state = state);
        }
    }

    /// Asks the job to stop, if it runs here.
    pub fn cancel(&self, job: &str) {
        if let Some(tracked) = self.lock().get(job) {
            tracked.stop.trigger();
        }
    }

    /// Follows a job, if it is known here.
    pub fn follow(&self, job: &str) -> Option<watch::Receiver<LiveJob>> {
        self.lock().get(job).map(|tracked| tracked.live.subscribe())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, TrackedJob>> {
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Receives progress and warnings of one attempt.
pub struct Reporter {
    live: watch::Sender<LiveJob>,
    /// Asks the attempt to stop.
    pub stop: StopSignal,
    /// Notified when the fraction would run too far ahead of what is stored.
    pub ahead: Notify,
    floor: f64,
    /// When each stage was entered.
    entered: Mutex<Vec<(String, SystemTime)>>,
    /// The fraction that the queue knows.
    stored: Mutex<f64>,
}

impl Reporter {
    /// Where the attempt stands.
    pub fn status(&self) -> AttemptStatus {
        self.live.borrow().status.clone()
    }

    /// The stages with the times at which they were entered.
    pub(super) fn entered(&self) -> Vec<(String, SystemTime)> {
        self.entered.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Notes that the queue knows this fraction.
    pub fn stored(&self, fraction: f64) {
        *self.stored.lock().unwrap_or_else(PoisonError::into_inner) = fraction;
    }
}

impl Listener for Reporter {
    fn progress(&self, progress: &Progress) {
        let most = *self.stored.lock().unwrap_or_else(PoisonError::into_inner) + MAX_PROGRESS_LEAD;
        if progress.fraction > most {
            self.ahead.notify_one();
        }
        self.live.send_if_modified(|live| {
            let old = &live.status.progress;
            let fraction = progress.fraction.min(most).max(self.floor).max(old.fraction).min(1.0);
            let moved = fraction - old.fraction >= STEP || (fraction >= 1.0 && old.fraction < 1.0);
            let renamed = progress.stage != old.stage || progress.message != old.message;
            if !(moved || renamed) {
                return false;
            }
            let now = Progress { fraction, ..progress.clone() };
            if now.stage != old.stage && !now.stage.is_empty() {
                let mut entered = self.entered.lock().unwrap_or_else(PoisonError::into_inner);
                entered.push((now.stage.clone(), SystemTime::now()));
                live.status.stages.push(now.clone());
            }
            live.status.progress = now;
            true
        });
    }

    fn warning(&self, warning: &Warning) {
        self.live.send_modify(|live| live.status.warnings.push(warning.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_never_falls_and_small_steps_are_not_passed_on() {
        let hub = Hub::default();
        let reporter = hub.started("j", 2, 0.4);
        let mut follower = hub.follow("j").unwrap();
        follower.borrow_and_update();
        let at = |fraction: f64| Progress { fraction, ..Progress::default() };
        reporter.progress(&at(0.1));
        assert!(!follower.has_changed().unwrap());
        assert_eq!(reporter.status().progress.fraction, 0.4);
        reporter.stored(0.4);
        reporter.progress(&at(0.5));
        assert!(follower.has_changed().unwrap());
        reporter.progress(&at(0.45));
        assert_eq!(follower.borrow_and_update().status.progress.fraction, 0.5);
        // What is not stored is not shown: it would be lost with the process.
        reporter.progress(&at(0.9));
        assert_eq!(reporter.status().progress.fraction, 0.4 + MAX_PROGRESS_LEAD);
        reporter.stored(0.6);
        reporter.progress(&at(0.9));
        assert_eq!(reporter.status().progress.fraction, 0.6 + MAX_PROGRESS_LEAD);
    }

    #[test]
    fn every_stage_is_kept_however_short_it_is() {
        let hub = Hub::default();
        let reporter = hub.started("j", 1, 0.0);
        for stage in ["read", "pack", "pack", "write"] {
            reporter.progress(&Progress { stage: stage.into(), ..Progress::default() });
        }
        let stages: Vec<String> = reporter.status().stages.into_iter().map(|s| s.stage).collect();
        assert_eq!(stages, ["read", "pack", "write"]);
    }

    #[test]
    fn followers_see_the_end() {
        let hub = Hub::default();
        hub.queued("j");
        let reporter = hub.started("j", 1, 0.0);
        let mut follower = hub.follow("j").unwrap();
        hub.cancel("j");
        assert!(reporter.stop.flag.load(Ordering::Relaxed) && reporter.stop.token.is_cancelled());
        hub.ended("j", JobState::Canceled);
        assert_eq!(follower.borrow_and_update().state, JobState::Canceled);
        assert!(hub.follow("j").is_none());
    }
}
