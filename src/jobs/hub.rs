//! What is known of the jobs of this process between two writes to the queue: progress, warnings, cancellation.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;

use super::queue::{AHEAD, Standing};
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
    /// Where the attempt stands.
    pub now: Standing,
}

struct Entry {
    live: watch::Sender<Live>,
    stop: Stop,
}

/// Says an attempt that it shall stop: to what computes by a flag, to what waits by a token.
#[derive(Clone, Default)]
pub struct Stop {
    /// True when it shall stop.
    pub flag: Arc<AtomicBool>,
    /// Cancelled when it shall stop.
    pub token: CancellationToken,
}

impl Stop {
    /// Says it.
    pub fn now(&self) {
        self.flag.store(true, Ordering::Relaxed);
        self.token.cancel();
    }
}

/// The jobs of this process that are not final.
#[derive(Default)]
pub struct Hub {
    jobs: Mutex<BTreeMap<String, Entry>>,
}

impl Hub {
    /// Registers a job that waits.
    pub fn queued(&self, job: &str) {
        let live = Live { state: State::Queued, attempt: 0, now: Standing::default() };
        let entry = Entry { live: watch::Sender::new(live), stop: Stop::default() };
        self.lock().entry(job.to_owned()).or_insert(entry);
    }

    /// Registers that an attempt starts, whose fraction does not fall under `floor`.
    pub fn started(&self, job: &str, attempt: u32, floor: f64) -> Arc<Reporter> {
        self.queued(job);
        let mut jobs = self.lock();
        let stop = Stop::default();
        let progress = Progress { fraction: floor, ..Progress::default() };
        let now = Standing { progress, ..Standing::default() };
        let live = Live { state: State::Running, attempt, now };
        let sender = match jobs.get_mut(job) {
            Some(entry) => {
                entry.stop = stop.clone();
                entry.live.send_replace(live);
                entry.live.clone()
            }
            None => watch::Sender::new(live),
        };
        Arc::new(Reporter { live: sender, stop, ahead: Notify::new(), floor, stored: Mutex::new(floor) })
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
            entry.stop.now();
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
    /// Says that the attempt shall stop.
    pub stop: Stop,
    /// Told when the fraction would run too far ahead of what is stored.
    pub ahead: Notify,
    floor: f64,
    /// The fraction that the queue knows.
    stored: Mutex<f64>,
}

impl Reporter {
    /// Where the attempt stands.
    pub fn now(&self) -> Standing {
        self.live.borrow().now.clone()
    }
}

impl Reporter {
    /// Notes that the queue knows this fraction.
    pub fn stored(&self, fraction: f64) {
        *self.stored.lock().unwrap_or_else(PoisonError::into_inner) = fraction;
    }
}

impl Listener for Reporter {
    fn progress(&self, progress: &Progress) {
        let most = *self.stored.lock().unwrap_or_else(PoisonError::into_inner) + AHEAD;
        if progress.fraction > most {
            self.ahead.notify_one();
        }
        self.live.send_if_modified(|live| {
            let old = &live.now.progress;
            let fraction = progress.fraction.min(most).max(self.floor).max(old.fraction).min(1.0);
            let moved = fraction - old.fraction >= STEP || (fraction >= 1.0 && old.fraction < 1.0);
            let told = progress.stage != old.stage || progress.message != old.message;
            if !(moved || told) {
                return false;
            }
            let now = Progress { fraction, ..progress.clone() };
            if now.stage != old.stage && !now.stage.is_empty() {
                live.now.stages.push(now.clone());
            }
            live.now.progress = now;
            true
        });
    }

    fn warning(&self, warning: &Warning) {
        self.live.send_modify(|live| live.now.warnings.push(warning.clone()));
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
        assert_eq!(reporter.now().progress.fraction, 0.4);
        reporter.stored(0.4);
        reporter.progress(&at(0.5));
        assert!(follower.has_changed().unwrap());
        reporter.progress(&at(0.45));
        assert_eq!(follower.borrow_and_update().now.progress.fraction, 0.5);
        // What is not stored is not told: it would be lost with the process.
        reporter.progress(&at(0.9));
        assert_eq!(reporter.now().progress.fraction, 0.4 + AHEAD);
        reporter.stored(0.6);
        reporter.progress(&at(0.9));
        assert_eq!(reporter.now().progress.fraction, 0.6 + AHEAD);
    }

    #[test]
    fn every_stage_is_kept_however_short_it_is() {
        let hub = Hub::default();
        let reporter = hub.started("j", 1, 0.0);
        for stage in ["read", "pack", "pack", "write"] {
            reporter.progress(&Progress { stage: stage.into(), ..Progress::default() });
        }
        let stages: Vec<String> = reporter.now().stages.into_iter().map(|s| s.stage).collect();
        assert_eq!(stages, ["read", "pack", "write"]);
    }

    #[test]
    fn followers_hear_the_end() {
        let hub = Hub::default();
        hub.queued("j");
        let reporter = hub.started("j", 1, 0.0);
        let mut follower = hub.follow("j").unwrap();
        hub.cancel("j");
        assert!(reporter.stop.flag.load(Ordering::Relaxed) && reporter.stop.token.is_cancelled());
        hub.ended("j", State::Canceled);
        assert_eq!(follower.borrow_and_update().state, State::Canceled);
        assert!(hub.follow("j").is_none());
    }
}
