//! What is known of the jobs of this process between two writes to the queue: progress, warnings, cancellation.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;

use super::record::State;
use crate::context::{Listener, Progress};
use crate::error::Warning;

/// The smallest step of the fraction that is passed on.
const STEP: f64 = 0.002;

/// Where a job of this process stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Live {
    /// Its state.
    pub state: State,
    /// Number of its attempt; 0 before the first.
    pub attempt: u32,
    /// How far it is.
    pub progress: Progress,
    /// The warnings of this attempt.
    pub warnings: Vec<Warning>,
}

struct Entry {
    live: watch::Sender<Live>,
    cancel: Arc<AtomicBool>,
}

/// The jobs of this process that are not final.
#[derive(Default)]
pub struct Hub {
    jobs: Mutex<BTreeMap<String, Entry>>,
}

impl Hub {
    /// Registers a job that waits.
    pub fn queued(&self, job: &str) {
        let live = Live { state: State::Queued, attempt: 0, progress: Progress::default(), warnings: Vec::new() };
        let entry = Entry { live: watch::Sender::new(live), cancel: Arc::default() };
        self.lock().entry(job.to_owned()).or_insert(entry);
    }

    /// Registers that an attempt starts, whose fraction does not fall under `floor`.
    pub fn started(&self, job: &str, attempt: u32, floor: f64) -> Arc<Reporter> {
        self.queued(job);
        let mut jobs = self.lock();
        let cancel = Arc::new(AtomicBool::new(false));
        let progress = Progress { fraction: floor, ..Progress::default() };
        let live = Live { state: State::Running, attempt, progress, warnings: Vec::new() };
        let sender = match jobs.get_mut(job) {
            Some(entry) => {
                entry.cancel = cancel.clone();
                entry.live.send_replace(live);
                entry.live.clone()
            }
            None => watch::Sender::new(live),
        };
        Arc::new(Reporter { live: sender, cancel, floor })
    }

    /// Registers that a job goes back to the queue.
    pub fn requeued(&self, job: &str) {
        self.queued(job);
        if let Some(entry) = self.lock().get(job) {
            entry.live.send_modify(|live| live.state = State::Queued);
        }
    }

    /// Registers that a job is final, and forgets it. Call it after the queue knows.
    pub fn ended(&self, job: &str, state: State) {
        if let Some(entry) = self.lock().remove(job) {
            entry.live.send_modify(|live| live.state = state);
        }
    }

    /// Asks the job to stop, if it runs here.
    pub fn cancel(&self, job: &str) {
        if let Some(entry) = self.lock().get(job) {
            entry.cancel.store(true, Ordering::Relaxed);
        }
    }

    /// Follows a job, if it is known here.
    pub fn follow(&self, job: &str) -> Option<watch::Receiver<Live>> {
        self.lock().get(job).map(|entry| entry.live.subscribe())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Entry>> {
        self.jobs.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Takes the reports of one attempt.
pub struct Reporter {
    live: watch::Sender<Live>,
    /// Becomes true when the attempt shall stop.
    pub cancel: Arc<AtomicBool>,
    floor: f64,
}

impl Reporter {
    /// Where the attempt stands.
    pub fn live(&self) -> Live {
        self.live.borrow().clone()
    }
}

impl Listener for Reporter {
    fn progress(&self, progress: &Progress) {
        self.live.send_if_modified(|live| {
            let old = &live.progress;
            let fraction = progress.fraction.max(self.floor).max(old.fraction).min(1.0);
            let moved = fraction - old.fraction >= STEP || (fraction >= 1.0 && old.fraction < 1.0);
            let told = progress.stage != old.stage || progress.message != old.message;
            if !(moved || told) {
                return false;
            }
            live.progress = Progress { fraction, ..progress.clone() };
            true
        });
    }

    fn warning(&self, warning: &Warning) {
        self.live.send_modify(|live| live.warnings.push(warning.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_never_falls_and_small_steps_stay_quiet() {
        let hub = Hub::default();
        let reporter = hub.started("j", 2, 0.4);
        let mut follower = hub.follow("j").unwrap();
        follower.borrow_and_update();
        let at = |fraction: f64| Progress { fraction, ..Progress::default() };
        reporter.progress(&at(0.1));
        assert!(!follower.has_changed().unwrap());
        assert_eq!(reporter.live().progress.fraction, 0.4);
        reporter.progress(&at(0.5));
        assert!(follower.has_changed().unwrap());
        reporter.progress(&at(0.45));
        assert_eq!(follower.borrow_and_update().progress.fraction, 0.5);
    }

    #[test]
    fn followers_hear_the_end() {
        let hub = Hub::default();
        hub.queued("j");
        let reporter = hub.started("j", 1, 0.0);
        let mut follower = hub.follow("j").unwrap();
        hub.cancel("j");
        assert!(reporter.cancel.load(Ordering::Relaxed));
        hub.ended("j", State::Canceled);
        assert_eq!(follower.borrow_and_update().state, State::Canceled);
        assert!(hub.follow("j").is_none());
    }
}
