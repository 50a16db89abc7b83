//! The worker: claims a job, computes it on the rayon pool, publishes its result.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval, sleep, sleep_until};
use tracing::Instrument;

use super::Jobs;
use super::files::Manifest;
use super::hub::Reporter;
use super::queue::{Beat, Claim, End, canceled};
use super::record::{Entry, JobError, Missed, State};
use super::slots::Slot;
use super::stored_options;
use crate::context::{Context, Timing};
use crate::error::{Code, Failure, Result, Warning};
use crate::refine::options::Options;
use crate::refine::run::{self, Input};

/// The lease is renewed, and progress stored, so many times while it lasts.
const BEATS: u32 = 15;
/// How often the queue is looked at without being woken: other processes may fill it.
const POLL: Duration = Duration::from_secs(1);
/// How often upkeep is done.
const TIDY: Duration = Duration::from_secs(5);
/// Every so many rounds of upkeep, files that belong to no job are looked for.
const SWEEP: u32 = 720;
/// Work that was told to stop and has not by then is left to itself: its result will not count.
const LATE: Duration = Duration::from_millis(500);

/// What came of an attempt.
struct Computed {
    result: Result<(Vec<Entry>, Vec<Missed>)>,
    /// All of them; none where only those are known that were told on the way.
    warnings: Option<Vec<Warning>>,
    timings: Vec<Timing>,
}

impl Jobs {
    /// Runs jobs, as many at once as there is room for, until the service shuts down and they have ended.
    pub async fn work(self: Arc<Self>) {
        let mut running = JoinSet::new();
        while !self.shutdown.is_cancelled() {
            let claimed = match self.slots.room() {
                Some(room) => self.queue.claim(self.files.owner(), self.lease, room).await,
                None => Ok(None),
            };
            match claimed {
                Ok(Some(claim)) => {
                    // There is room: nobody else takes any.
                    let Some(slot) = self.slots.take(claim.memory) else { continue };
                    let span =
                        tracing::info_span!("job", id = %claim.id, attempt = claim.attempt, request = claim.request);
                    running.spawn(self.clone().run(claim, slot).instrument(span));
                }
                Ok(None) => tokio::select! {
                    () = self.wake.notified() => {}
                    () = self.slots.freed.notified() => {}
                    () = sleep(POLL) => {}
                    () = self.shutdown.cancelled() => {}
                },
                Err(_) => sleep(POLL).await,
            }
            while running.try_join_next().is_some() {}
        }
        running.join_all().await;
    }

    /// Does upkeep until the service shuts down.
    pub async fn keep(self: Arc<Self>) {
        for round in 0u32.. {
            if self.shutdown.is_cancelled() {
                break;
            }
            if let Err(failure) = self.tidy(round % SWEEP == 0).await {
                tracing::error!(%failure, "upkeep failed");
            }
            tokio::select! {
                () = sleep(TIDY) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
    }

    async fn run(self: Arc<Self>, claim: Claim, slot: Slot) {
        tracing::info!("job starts");
        let started = Instant::now();
        let reporter = self.hub.started(&claim.id, claim.attempt, claim.floor);
        let (done, mut result) = oneshot::channel();
        {
            let (jobs, claim, reporter) = (self.clone(), claim.clone(), reporter.clone());
            let (runtime, span) = (Handle::current(), tracing::Span::current());
            slot.spawn(move || drop(done.send(span.in_scope(|| compute(&jobs, &claim, reporter, &runtime)))));
        }
        let mut ticks = interval(self.lease / BEATS);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // When it is told to stop because the service does, and when it is waited for no longer because its user wants it to.
        let (mut hand_back, mut late) = (None, None);
        let computed = loop {
            let at = |moment: Option<tokio::time::Instant>| async move {
                match moment {
                    Some(moment) => sleep_until(moment).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                computed = &mut result => break computed.unwrap_or_else(|_| Computed::failed(Failure::internal("the computation was lost"))),
                () = async { tokio::select! { _ = ticks.tick() => {}, () = reporter.ahead.notified() => {} } } => {
                    let now = reporter.now();
                    match self.queue.beat(&claim, self.lease, &now).await {
                        Ok(Beat::Cancel | Beat::Lost) => reporter.stop.now(),
                        Ok(Beat::Held) => reporter.stored(now.progress.fraction),
                        // A queue that fails for a moment is no reason to stop: the fence protects the result.
                        Err(_) => {}
                    }
                }
                () = reporter.stop.token.cancelled(), if late.is_none() && hand_back.is_none() => {
                    late = Some(tokio::time::Instant::now() + LATE);
                }
                () = at(late) => {
                    tracing::warn!("the computation did not stop in time; it is left to itself");
                    break Computed::failed(Failure::new(Code::Canceled, "the job was cancelled"));
                }
                () = self.shutdown.cancelled(), if hand_back.is_none() => {
                    hand_back = Some(tokio::time::Instant::now() + self.grace);
                }
                () = at(hand_back), if !reporter.stop.token.is_cancelled() => reporter.stop.now(),
            }
        };
        self.publish(&claim, &reporter, computed, hand_back.is_some(), started).await;
    }

    async fn publish(&self, claim: &Claim, reporter: &Reporter, computed: Computed, stopping: bool, started: Instant) {
        let stopped = matches!(&computed.result, Err(f) if f.code == Code::Canceled);
        if stopping && stopped && self.queue.release(claim, &reporter.now().progress).await == Ok(true) {
            tracing::info!("job goes back to the queue");
            self.hub.requeued(&claim.id);
            return;
        }
        let mut end = ended(reporter, computed);
        let mut published = self.finish(claim, &end).await;
        if !published && end.state != State::Canceled {
            // The user may have cancelled while the result was being stored: the wish counts.
            end = End { state: State::Canceled, error: Some(canceled()), artifacts: Vec::new(), ..end };
            published = self.finish(claim, &end).await;
        }
        if published {
            let code = end.error.as_ref().map_or("", |e| e.code.as_str());
            tracing::info!(state = end.state.as_str(), code, seconds = started.elapsed().as_secs_f64(), "job ends");
            self.telemetry.ended(&end, started.elapsed());
            self.hub.ended(&claim.id, end.state);
            self.files.remove_uploads(&claim.id);
        } else {
            tracing::warn!("the job was taken from this worker; its result does not count");
            if matches!(self.queue.get(&claim.id).await, Ok(None)) {
                self.files.remove_uploads(&claim.id);
            }
        }
        if (end.artifacts.is_empty() || !published)
            && let Err(failure) = self.collect(Some(&claim.id), false).await
        {
            tracing::error!(%failure, "files of the attempt are left for upkeep");
        }
    }

    /// Publishes, and tries again for a while when the queue fails: a result is dear.
    async fn finish(&self, claim: &Claim, end: &End) -> bool {
        for wait in [0, 1, 2, 4, 8] {
            sleep(Duration::from_secs(wait)).await;
            if let Ok(published) = self.queue.finish(claim, end, self.limits.keep_artifacts).await {
                return published;
            }
        }
        false
    }
}

impl Computed {
    fn failed(failure: Failure) -> Self {
        Computed { result: Err(failure), warnings: None, timings: Vec::new() }
    }
}

fn ended(reporter: &Reporter, computed: Computed) -> End {
    let Computed { result, warnings, timings } = computed;
    let mut standing = reporter.now();
    standing.warnings = warnings.unwrap_or(standing.warnings);
    if result.is_ok() {
        standing.progress.fraction = 1.0;
    }
    let end = |state, error, artifacts| End { state, error, artifacts, standing, timings };
    match result {
        Ok((artifacts, failures)) if failures.is_empty() => end(State::Succeeded, None, artifacts),
        Ok((artifacts, failures)) => {
            let paths: Vec<&str> = failures.iter().map(|f| f.path.as_str()).collect();
            let message = format!("not met: {}", paths.join(", "));
            let (code, pointer) = (Code::RequirementNotMet, Some("/require".to_owned()));
            end(State::Failed, Some(JobError { code, message, pointer, failures }), artifacts)
        }
        Err(failure) if failure.code == Code::Canceled => end(State::Canceled, Some(failure.into()), Vec::new()),
        Err(failure) => end(State::Failed, Some(failure.into()), Vec::new()),
    }
}

/// The synchronous part, on the rayon pool.
fn compute(jobs: &Jobs, claim: &Claim, reporter: Arc<Reporter>, runtime: &Handle) -> Computed {
    let stop = reporter.stop.flag.clone();
    let (options, ignored) = match stored_options::read(&claim.options) {
        Ok(read) => read,
        Err(failure) => return Computed::failed(failure),
    };
    let limit = options.time_limit_s.and_then(|s| Duration::try_from_secs_f64(s).ok());
    let context = Context::new(reporter, stop, options.seed).with_time_limit(limit);
    ignored.into_iter().for_each(|warning| context.warn(warning));
    let result = guarded(&claim.id, || steps(jobs, claim, &claim.inputs, &options, &context, runtime));
    Computed { result, warnings: Some(context.warnings()), timings: context.timings() }
}

/// A panic is a failure of this job and of nothing else.
fn guarded<T>(job: &str, work: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| {
        tracing::error!(job, "the computation panicked");
        Err(Failure::internal("Intarsia failed on this model; the fault is ours"))
    })
}

fn steps(
    jobs: &Jobs,
    claim: &Claim,
    manifest: &Manifest,
    options: &Options,
    context: &Context,
    runtime: &Handle,
) -> Result<(Vec<Entry>, Vec<Missed>)> {
    let input = Input { models: jobs.files.load(&claim.id, manifest)?, limits: (&jobs.limits).into(), extras: true };
    let outcome = run::refine(&input, options, context)?;
    drop(input);
    context.check()?;
    let parcel = jobs.files.pack(&claim.id, claim.attempt, &outcome.artifacts)?;
    let objects: Vec<String> = parcel.entries.iter().map(|e| e.sha256.clone()).collect();
    match runtime.block_on(jobs.queue.reserve(claim, &objects)) {
        Ok(true) => jobs.files.store(&parcel, &outcome.artifacts)?,
        other => {
            jobs.files.discard(&parcel);
            other?;
            return Err(Failure::new(Code::Canceled, "the job was taken from this worker"));
        }
    }
    let entries = parcel.entries;
    let missed = outcome.failures.into_iter().map(|f| Missed { path: f.path, wanted: f.wanted, got: f.got });
    Ok((entries, missed.collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_a_failure_of_ours() {
        let failure = guarded::<()>("j", || panic!("as the test wants")).unwrap_err();
        assert_eq!(failure.code, Code::Internal);
        assert_eq!(guarded("j", || Ok(1)), Ok(1));
    }

    #[test]
    fn a_job_that_misses_its_requirement_fails_with_its_artifacts() {
        let reporter = crate::jobs::hub::Hub::default().started("j", 1, 0.0);
        let missed = Missed { path: "atlas.charts".into(), wanted: "max 1".into(), got: Some(2.0) };
        let end_of = |result| ended(&reporter, Computed { result, warnings: None, timings: Vec::new() });
        let end = end_of(Ok((Vec::new(), vec![missed.clone()])));
        assert_eq!(end.state, State::Failed);
        let error = end.error.unwrap();
        assert_eq!((error.code, error.failures), (Code::RequirementNotMet, vec![missed]));
        assert_eq!(end_of(Ok((Vec::new(), Vec::new()))).state, State::Succeeded);
        assert_eq!(end_of(Err(Failure::new(Code::Canceled, "stop"))).state, State::Canceled);
        assert_eq!(end_of(Err(Failure::model("bad"))).error.unwrap().code, Code::InvalidModel);
    }
}
