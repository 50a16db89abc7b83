//! The worker: claims a job, computes it on the rayon pool, publishes its result.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use futures_util::future::BoxFuture;
use futures_util::stream::{StreamExt, TryStreamExt, iter};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, sleep, sleep_until};
use tracing::Instrument;

use super::Jobs;
use super::apart;
use super::files::{self, Files};
use super::hub::Reporter;
use super::queue::{AttemptEnd, Claim, HeartbeatReply, canceled};
use super::record::{ArtifactEntry, JobError, JobState};
use super::slots::Slot;
use super::stored_options;
use super::trace::AttemptTrace;
use crate::asset::{File, Limits};
use crate::context::{Context, Listener, Progress, Timing};
use crate::error::{Code, Failure, Result, Warning};
use crate::metrics::{RefinementOutcome, Verdict};
use crate::refine::run::{self, Artifact, Input, Outcome};

/// The lease is renewed, and progress stored, so many times while it lasts.
const HEARTBEATS_PER_LEASE: u32 = 15;
/// How often the queue is looked at without being woken: other processes may fill it.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// How often maintenance is done.
const MAINTENANCE_INTERVAL: Duration = Duration::from_secs(5);
/// Every so many rounds of maintenance, files that belong to no job are looked for.
const SWEEP_EVERY: u32 = 720;
/// Work that was told to stop and has not by then is left to itself: its result will not count.
const ABANDON_AFTER: Duration = Duration::from_millis(500);
/// Files of a result that are stored at the same time.
const PUTS_AT_ONCE: usize = 4;
/// How long to wait before the first tries to do again what the machine does not let be done, and before all later ones.
const BACKOFF: [Duration; 3] = [Duration::from_millis(200), Duration::from_millis(500), Duration::from_secs(1)];
const LONGEST_WAIT: Duration = Duration::from_secs(2);

/// What came of a job that was computed to its end: its files, as whoever holds them names them.
#[derive(Serialize, Deserialize)]
pub(super) struct Finished<F> {
    /// The files of the result.
    pub(super) files: Vec<F>,
    /// What became of what it was given.
    pub(super) outcome: RefinementOutcome,
    /// What it fails for.
    pub(super) verdict: Verdict,
}

impl<F> Finished<F> {
    /// The same with other files.
    pub(super) fn with<G>(self, files: impl FnOnce(Vec<F>) -> Result<Vec<G>>) -> Result<Finished<G>> {
        Ok(Finished { files: files(self.files)?, outcome: self.outcome, verdict: self.verdict })
    }
}

/// What the computing of a job gave.
pub(super) struct Computed {
    /// Its result.
    pub(super) result: Result<Finished<Artifact>>,
    /// All warnings.
    pub(super) warnings: Vec<Warning>,
    /// Seconds by stage.
    pub(super) timings: Vec<Timing>,
}

impl Computed {
    /// Nothing came of it.
    pub(super) fn failed(failure: Failure) -> Self {
        Computed { result: Err(failure), warnings: Vec::new(), timings: Vec::new() }
    }
}

/// What came of an attempt.
enum Attempt {
    /// It ended; its result is stored.
    Ended(Computation),
    /// Its own process died.
    Died,
}

struct Computation {
    result: Result<Finished<ArtifactEntry>>,
    /// All of them; `None` where only those are known that were reported on the way.
    warnings: Option<Vec<Warning>>,
    timings: Vec<Timing>,
}

impl Jobs {
    /// Runs jobs, as many at once as there is capacity for, until the service shuts down and they have ended. With `exit_when_idle` it is
    /// this that shuts the service down, when there is nothing to run.
    pub async fn work(self: Arc<Self>, exit_when_idle: bool) {
        let mut running = JoinSet::new();
        while !self.shutdown.is_cancelled() {
            // What cannot be stored is not begun.
            let claimed = match self.slots.capacity().filter(|_| self.ready().is_ok()) {
                Some(capacity) => self.queue.claim(self.files.owner(), self.lease, capacity).await,
                None => Ok(None),
            };
            match claimed {
                Ok(Some(claim)) => {
                    // There is capacity: nobody else takes any.
                    let Some(slot) = self.slots.take(claim.memory) else { continue };
                    let trace = AttemptTrace::new(&claim);
                    let span = tracing::info_span!(
                        "job",
                        id = %claim.id,
                        attempt = claim.attempt,
                        request = claim.request,
                        trace_id = trace.context.trace_id(),
                        span_id = trace.context.span_id()
                    );
                    running.spawn(self.clone().run(claim, slot, trace).instrument(span));
                }
                Ok(None) if exit_when_idle && running.is_empty() && self.ready().is_ok() => {
                    tracing::info!("no job waits; stopping");
                    self.shutdown.cancel();
                }
                Ok(None) => tokio::select! {
                    () = self.wake.notified() => {}
                    () = self.slots.freed.notified() => {}
                    () = sleep(POLL_INTERVAL) => {}
                    () = self.shutdown.cancelled() => {}
                },
                Err(_) => sleep(POLL_INTERVAL).await,
            }
            while running.try_join_next().is_some() {}
        }
        running.join_all().await;
    }

    /// Does maintenance until the service shuts down.
    pub async fn run_maintenance(self: Arc<Self>) {
        for round in 0u32.. {
            if self.shutdown.is_cancelled() {
                break;
            }
            if self.ready().is_ok()
                && let Err(failure) = self.maintain(round % SWEEP_EVERY == 0).await
                && !failure.is_of_the_machine()
            {
                tracing::error!(%failure, "maintenance failed");
            }
            tokio::select! {
                () = sleep(MAINTENANCE_INTERVAL) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
    }

    async fn run(self: Arc<Self>, claim: Claim, slot: Slot, trace: AttemptTrace) {
        tracing::info!("job starts");
        let started = Instant::now();
        let reporter = self.hub.started(&claim.id, claim.attempt, claim.floor);
        let (done, mut result) = oneshot::channel();
        {
            let (jobs, claim, reporter) = (self.clone(), claim.clone(), reporter.clone());
            let (runtime, span) = (Handle::current(), tracing::Span::current());
            slot.spawn(move || drop(done.send(span.in_scope(|| compute(&jobs, &claim, &reporter, &runtime)))));
        }
        let mut ticks = interval(self.lease / HEARTBEATS_PER_LEASE);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // When it is told to stop because the service does, and when it is waited for no longer because its user wants it to.
        let (mut release_at, mut abandon_at) = (None, None);
        let attempt = loop {
            let at = |deadline: Option<tokio::time::Instant>| async move {
                match deadline {
                    Some(deadline) => sleep_until(deadline).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                attempt = &mut result => break attempt.unwrap_or_else(|_| Attempt::failed(Failure::internal("the computation was lost"))),
                () = async { tokio::select! { _ = ticks.tick() => {}, () = reporter.ahead.notified() => {} } } => {
                    let status = reporter.status();
                    match self.queue.heartbeat(&claim, self.lease, &status).await {
                        Ok(HeartbeatReply::Cancel | HeartbeatReply::Lost) => reporter.stop.trigger(),
                        Ok(HeartbeatReply::Held) => reporter.stored(status.progress.fraction),
                        // A queue that fails for a moment is no reason to stop: the fence protects the result.
                        Err(_) => {}
                    }
                }
                () = reporter.stop.token.cancelled(), if abandon_at.is_none() && release_at.is_none() => {
                    abandon_at = Some(tokio::time::Instant::now() + ABANDON_AFTER);
                }
                () = at(abandon_at) => {
                    tracing::warn!("the computation did not stop in time; it is left to itself");
                    break Attempt::failed(Failure::new(Code::Canceled, "the job was cancelled"));
                }
                () = self.shutdown.cancelled(), if release_at.is_none() => {
                    release_at = Some(tokio::time::Instant::now() + self.grace);
                }
                () = at(release_at), if !reporter.stop.token.is_cancelled() => reporter.stop.trigger(),
            }
        };
        let end = match attempt {
            Attempt::Ended(computation) => {
                self.publish(&claim, &reporter, computation, release_at.is_some(), started).await
            }
            Attempt::Died => {
                self.bury(&claim, &reporter).await;
                None
            }
        };
        trace.tell(&self.telemetry.spans, &claim, &reporter, end.as_ref());
    }

    /// Puts a job back whose own process died, or ends it; when the service goes down, that may be why it died.
    async fn bury(&self, claim: &Claim, reporter: &Reporter) {
        if self.shutdown.is_cancelled() && self.release(claim, reporter).await {
            return;
        }
        self.telemetry.deaths.inc();
        let state = self.persistently(|| self.queue.died(claim)).await.flatten();
        match state {
            Some(JobState::Queued) => {
                self.hub.requeued(&claim.id);
                self.wake.notify_one();
            }
            Some(state) => {
                tracing::error!(state = state.as_str(), "job ends: its process died again");
                self.hub.ended(&claim.id, state);
                self.remove_upload(&claim.id).await;
            }
            None => {}
        }
    }

    async fn release(&self, claim: &Claim, reporter: &Reporter) -> bool {
        let progress = reporter.status().progress;
        let released = self.persistently(|| self.queue.release(claim, &progress)).await == Some(true);
        if released {
            tracing::info!("job goes back to the queue");
            self.hub.requeued(&claim.id);
        }
        released
    }

    /// Publishes what came of an attempt, and returns it where it counts.
    async fn publish(
        &self,
        claim: &Claim,
        reporter: &Reporter,
        computation: Computation,
        stopping: bool,
        started: Instant,
    ) -> Option<AttemptEnd> {
        let stopped = matches!(&computation.result, Err(f) if f.code == Code::Canceled);
        if stopping && stopped && self.release(claim, reporter).await {
            return None;
        }
        let mut end = attempt_end(reporter, computation);
        let mut finished = self.finish(claim, &end).await;
        // The user may have cancelled while the result was being stored: cancelling wins. What the queue cannot hold is a failure of ours.
        let instead = match finished {
            Some(false) if end.state != JobState::Canceled => Some((JobState::Canceled, canceled())),
            None if !self.shutdown.is_cancelled() => {
                Some((JobState::Failed, Failure::internal("the result cannot be published").into()))
            }
            _ => None,
        };
        if let Some((state, error)) = instead {
            end = AttemptEnd { state, error: Some(error), outcome: None, artifacts: Vec::new(), ..end };
            finished = self.finish(claim, &end).await;
        }
        let Some(published) = finished else {
            tracing::warn!("the end of this attempt could not be stored; the job runs again at the next start");
            return None;
        };
        if published {
            let code = end.error.as_ref().map_or("", |e| e.code.as_str());
            tracing::info!(state = end.state.as_str(), code, seconds = started.elapsed().as_secs_f64(), "job ends");
            self.telemetry.record_attempt(&end, started.elapsed());
            self.took(started.elapsed().as_secs_f64());
            self.hub.ended(&claim.id, end.state);
            self.remove_upload(&claim.id).await;
        } else {
            tracing::warn!("the job was taken from this worker; its result does not count");
            // It was deleted, or it had ended and the answer was lost.
            if matches!(self.queue.needs_upload(&claim.id).await, Ok(false)) {
                self.remove_upload(&claim.id).await;
            }
        }
        if (end.artifacts.is_empty() || !published)
            && let Err(failure) = self.collect(Some(&claim.id), false).await
        {
            tracing::error!(%failure, "files of the attempt are left for maintenance");
        }
        published.then_some(end)
    }

    async fn finish(&self, claim: &Claim, end: &AttemptEnd) -> Option<bool> {
        let keep = self.limits.keep_artifacts;
        self.persistently(|| self.queue.finish(claim, end, keep)).await
    }

    /// Does something with the queue, again and again while the machine is in trouble: a result is expensive. `None` when it fails for
    /// another reason, or the service shuts down.
    async fn persistently<'a, T>(&self, mut step: impl FnMut() -> BoxFuture<'a, Result<T>>) -> Option<T> {
        for wait in BACKOFF.into_iter().chain(std::iter::repeat(LONGEST_WAIT)) {
            match step().await {
                Ok(done) => return Some(done),
                Err(failure) if failure.is_of_the_machine() && !self.shutdown.is_cancelled() => {}
                Err(failure) => {
                    tracing::error!(%failure, "the end of this attempt cannot be stored");
                    return None;
                }
            }
            tokio::select! {
                () = sleep(wait) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
        None
    }
}

impl Attempt {
    fn failed(failure: Failure) -> Self {
        Attempt::Ended(Computation { result: Err(failure), warnings: None, timings: Vec::new() })
    }
}

fn attempt_end(reporter: &Reporter, computation: Computation) -> AttemptEnd {
    let Computation { result, warnings, timings } = computation;
    let mut status = reporter.status();
    status.warnings = warnings.unwrap_or(status.warnings);
    if result.is_ok() {
        status.progress.fraction = 1.0;
    }
    let (state, error, outcome, artifacts) = match result {
        Ok(Finished { files, outcome, verdict }) => match verdict.failure() {
            None => (JobState::Succeeded, None, Some(outcome), files),
            Some(failure) => {
                let error = JobError { failures: verdict.unmet, ..JobError::from(failure) };
                (JobState::Failed, Some(error), Some(outcome), files)
            }
        },
        Err(failure) => {
            let state = if failure.code == Code::Canceled { JobState::Canceled } else { JobState::Failed };
            (state, Some(failure.into()), None, Vec::new())
        }
    };
    AttemptEnd { state, error, outcome, artifacts, status, timings }
}

/// The synchronous part, on the rayon pool: here, or in a process of its own.
fn compute(jobs: &Jobs, claim: &Claim, reporter: &Arc<Reporter>, runtime: &Handle) -> Attempt {
    let limits = (&jobs.limits).into();
    let brought = jobs.files.incoming(&format!("{}.{}.upload", claim.id, claim.attempt));
    let fetch = || runtime.block_on(jobs.store.fetch(&claim.id, &claim.inputs, &brought));
    let upload = match patiently(reporter, fetch) {
        Ok(upload) => upload,
        Err(failure) => return Attempt::failed(failure),
    };
    let computed = if claim.suspect {
        let request = apart::Request {
            options: claim.options.clone(),
            inputs: claim.inputs.clone(),
            uploads: upload.folder().to_owned(),
            results: jobs.files.incoming(&format!("{}.{}", claim.id, claim.attempt)),
            limits,
            threads: jobs.slots.threads(),
        };
        match patiently(reporter, || apart::compute(&claim.id, &request, reporter, runtime)) {
            Ok(Some(computed)) => computed,
            Ok(None) => return Attempt::Died,
            Err(failure) => Computed::failed(failure),
        }
    } else {
        let load = || patiently(reporter, || Files::load(upload.folder(), &claim.inputs));
        refine(&claim.options, load, limits, reporter.clone(), reporter.stop.flag.clone())
    };
    drop(upload);
    let Computed { result, warnings, timings } = computed;
    let stored = result.and_then(|finished| {
        finished.with(|artifacts| {
            let entries = files::entries(&claim.id, &artifacts);
            let bytes: Vec<Bytes> = artifacts.into_iter().map(|artifact| artifact.bytes.into()).collect();
            patiently(reporter, || runtime.block_on(store(jobs, claim, &entries, &bytes)))?;
            Ok(entries)
        })
    });
    Attempt::Ended(Computation { result: stored, warnings: Some(warnings), timings })
}

/// Computes a job from its stored options and what `load` reads.
pub(super) fn refine(
    options: &Value,
    load: impl FnOnce() -> Result<Vec<Vec<File>>>,
    limits: Limits,
    listener: Arc<dyn Listener>,
    stop: Arc<AtomicBool>,
) -> Computed {
    let (options, ignored) = match stored_options::read(options) {
        Ok(read) => read,
        Err(failure) => return Computed::failed(failure),
    };
    let limit = options.time_limit_s.and_then(|s| Duration::try_from_secs_f64(s).ok());
    let context = Context::new(listener, stop, options.seed).with_time_limit(limit);
    ignored.into_iter().for_each(|warning| context.warn(warning));
    let result = catch_panic(|| {
        let input = Input { models: load()?, limits, extras: true };
        let Outcome { artifacts, outcome, verdict, .. } = run::refine(&input, &options, &context)?;
        context.check()?;
        Ok(Finished { files: artifacts, outcome, verdict })
    });
    Computed { result, warnings: context.warnings(), timings: context.timings() }
}

/// Stores the files of a result, so that they can be published.
async fn store(jobs: &Jobs, claim: &Claim, entries: &[ArtifactEntry], bytes: &[Bytes]) -> Result<()> {
    let objects: Vec<String> = entries.iter().map(|e| e.sha256.clone()).collect();
    let Some(places) = jobs.queue.reserve(claim, &objects).await? else {
        return Err(Failure::new(Code::Canceled, "the job was taken from this worker"));
    };
    let puts = places.iter().zip(bytes).map(|(place, bytes)| jobs.store.put(place, bytes.clone()));
    iter(puts).map(Ok).try_for_each_concurrent(PUTS_AT_ONCE, |put| put).await
}

/// Does a step again and again while the machine is in trouble, until it is told to stop: the job waits, and its user sees why.
fn patiently<T>(reporter: &Reporter, mut step: impl FnMut() -> Result<T>) -> Result<T> {
    let mut waited = false;
    for wait in BACKOFF.into_iter().chain(std::iter::repeat(LONGEST_WAIT)) {
        let failure = match step() {
            Err(failure) if failure.is_of_the_machine() => failure,
            done => {
                if waited {
                    tracing::info!("job goes on");
                }
                return done;
            }
        };
        if !waited {
            tracing::warn!(%failure, "job waits until the machine's trouble is over");
        }
        waited = true;
        let message = format!("waits: {}", failure.message);
        reporter.progress(&Progress { message, ..reporter.status().progress });
        let until = Instant::now() + wait;
        while Instant::now() < until {
            if reporter.stop.flag.load(Ordering::Relaxed) {
                return Err(Failure::new(Code::Canceled, "the job was cancelled"));
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }
    Err(Failure::internal("the machine's trouble never ends"))
}

/// A panic is a failure of this job and of nothing else.
fn catch_panic<T>(work: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| {
        tracing::error!("the computation panicked");
        Err(Failure::internal("Intarsia failed on this model; the fault is ours"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::Unmet;

    #[test]
    fn a_panic_is_a_failure_of_ours() {
        let failure = catch_panic::<()>(|| panic!("as the test wants")).unwrap_err();
        assert_eq!(failure.code, Code::Internal);
        assert_eq!(catch_panic(|| Ok(1)), Ok(1));
    }

    #[test]
    fn a_job_that_misses_its_requirement_fails_with_its_artifacts() {
        let reporter = crate::jobs::hub::Hub::default().started("j", 1, 0.0);
        let unmet = Unmet { path: "atlas.charts".into(), wanted: "max 1".into(), got: Some(2.0), detail: None };
        let end_of = |result| attempt_end(&reporter, Computation { result, warnings: None, timings: Vec::new() });
        let finished = |unmet: Vec<Unmet>, strict: &[&str]| {
            let strict = strict.iter().map(|code| ((*code).to_owned(), 1)).collect();
            Ok(Finished { files: Vec::new(), outcome: RefinementOutcome::Refined, verdict: Verdict { unmet, strict } })
        };
        let end = end_of(finished(vec![unmet.clone()], &[]));
        assert_eq!((end.state, end.outcome), (JobState::Failed, Some(RefinementOutcome::Refined)));
        let error = end.error.unwrap();
        assert_eq!((error.code, error.failures), (Code::RequirementNotMet, vec![unmet.clone()]));
        let error = end_of(finished(vec![unmet.clone()], &["missing_image"])).error.unwrap();
        assert_eq!((error.code, error.failures), (Code::StrictWarning, vec![unmet]));
        assert_eq!(end_of(finished(Vec::new(), &[])).state, JobState::Succeeded);
        assert_eq!(end_of(Err(Failure::new(Code::Canceled, "stop"))).state, JobState::Canceled);
        assert_eq!(end_of(Err(Failure::model("bad"))).error.unwrap().code, Code::InvalidModel);
    }
}
