//! The worker: claims a job, computes it on the rayon pool, publishes its result.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::{MissedTickBehavior, interval, sleep};

use super::Jobs;
use super::files::Manifest;
use super::hub::Reporter;
use super::queue::{Beat, Claim, End};
use super::record::{Entry, JobError, Missed, State};
use crate::context::{Context, Timing};
use crate::error::{Code, Failure, Result, Warning};
use crate::refine::options::Options;
use crate::refine::run::{self, Input};

/// How long a silent worker is believed to be alive.
const LEASE: Duration = Duration::from_secs(30);
/// How often the lease is renewed and progress is stored.
const BEAT: Duration = Duration::from_secs(2);
/// How often the queue is looked at without being woken: other processes may fill it.
const POLL: Duration = Duration::from_secs(1);
/// How often upkeep is done.
const TIDY: Duration = Duration::from_secs(15);
/// Every so many rounds of upkeep, files that belong to no job are looked for.
const SWEEP: u32 = 240;

/// What came of an attempt.
struct Computed {
    result: Result<(Vec<Entry>, Vec<Missed>)>,
    warnings: Vec<Warning>,
    timings: Vec<Timing>,
}

impl Jobs {
    /// Runs jobs, one at a time (each takes all threads), until the service shuts down.
    pub async fn work(self: Arc<Self>) {
        while !self.shutdown.is_cancelled() {
            match self.queue.claim(&self.owner, LEASE).await {
                Ok(Some(claim)) => self.run(claim).await,
                Ok(None) => tokio::select! {
                    () = self.wake.notified() => {}
                    () = sleep(POLL) => {}
                    () = self.shutdown.cancelled() => {}
                },
                Err(_) => sleep(POLL).await,
            }
        }
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

    async fn run(self: &Arc<Self>, claim: Claim) {
        tracing::info!(job = %claim.id, attempt = claim.attempt, "job starts");
        let reporter = self.hub.started(&claim.id, claim.attempt, claim.floor);
        let (done, mut result) = oneshot::channel();
        {
            let (jobs, claim, reporter) = (self.clone(), claim.clone(), reporter.clone());
            self.pool.spawn(move || drop(done.send(compute(&jobs, &claim, reporter))));
        }
        let mut ticks = interval(BEAT);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut stopping = false;
        let computed = loop {
            tokio::select! {
                computed = &mut result => break computed,
                _ = ticks.tick() => {
                    let live = reporter.live();
                    // A queue that fails for a moment is no reason to stop: the fence protects the result.
                    if let Ok(Beat::Cancel | Beat::Lost) = self.queue.beat(&claim, LEASE, &live.progress, &live.warnings).await {
                        reporter.cancel.store(true, Ordering::Relaxed);
                    }
                }
                () = self.shutdown.cancelled(), if !stopping => {
                    stopping = true;
                    reporter.cancel.store(true, Ordering::Relaxed);
                }
            }
        };
        let computed = computed.unwrap_or_else(|_| Computed {
            result: Err(Failure::internal("the computation was lost")),
            warnings: Vec::new(),
            timings: Vec::new(),
        });
        self.publish(&claim, &reporter, computed, stopping).await;
    }

    async fn publish(&self, claim: &Claim, reporter: &Reporter, computed: Computed, stopping: bool) {
        let stopped = matches!(&computed.result, Err(f) if f.code == Code::Canceled);
        if stopping && stopped && self.queue.release(claim, &reporter.live().progress).await == Ok(true) {
            tracing::info!(job = %claim.id, "job goes back to the queue");
            self.hub.requeued(&claim.id);
            return;
        }
        let mut end = ended(reporter, computed);
        let mut published = self.finish(claim, &end).await;
        if !published && end.state != State::Canceled {
            // The user may have cancelled while the result was being stored: the wish counts.
            let canceled = JobError::from(Failure::new(Code::Canceled, "the job was cancelled"));
            end = End { state: State::Canceled, error: Some(canceled), artifacts: Vec::new(), ..end };
            published = self.finish(claim, &end).await;
        }
        if end.artifacts.is_empty() || !published {
            self.files.remove_attempt(&claim.id, claim.attempt);
        }
        if published {
            tracing::info!(job = %claim.id, state = end.state.as_str(), "job ends");
            self.hub.ended(&claim.id, end.state);
            self.files.remove_uploads(&claim.id);
        } else {
            tracing::warn!(job = %claim.id, attempt = claim.attempt, "the job was taken from this worker");
            if matches!(self.queue.knows(&claim.id).await, Ok(false)) {
                self.files.remove_artifacts(&claim.id);
                self.files.remove_uploads(&claim.id);
            }
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

fn ended(reporter: &Reporter, computed: Computed) -> End {
    let Computed { result, warnings, timings } = computed;
    let progress = reporter.live().progress;
    let end = |state, error, artifacts| End { state, error, artifacts, progress, timings, warnings };
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
fn compute(jobs: &Jobs, claim: &Claim, reporter: Arc<Reporter>) -> Computed {
    let cancel = reporter.cancel.clone();
    let options = match super::stored_options(&claim.options) {
        Ok(options) => options,
        Err(failure) => return Computed { result: Err(failure), warnings: Vec::new(), timings: Vec::new() },
    };
    let limit = options.time_limit_s.and_then(|s| Duration::try_from_secs_f64(s).ok());
    let context = Context::new(reporter, cancel, options.seed).with_time_limit(limit);
    let result = guarded(&claim.id, || steps(jobs, claim, &claim.inputs, &options, &context));
    Computed { result, warnings: context.warnings(), timings: context.timings() }
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
) -> Result<(Vec<Entry>, Vec<Missed>)> {
    let input = Input { models: jobs.files.load(&claim.id, manifest)?, limits: jobs.limits.asset(), extras: true };
    let outcome = run::refine(&input, options, context)?;
    drop(input);
    context.check()?;
    let entries = jobs.files.store(&claim.id, claim.attempt, &outcome.artifacts)?;
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
        let end_of = |result| ended(&reporter, Computed { result, warnings: Vec::new(), timings: Vec::new() });
        let end = end_of(Ok((Vec::new(), vec![missed.clone()])));
        assert_eq!(end.state, State::Failed);
        let error = end.error.unwrap();
        assert_eq!((error.code, error.failures), (Code::RequirementNotMet, vec![missed]));
        assert_eq!(end_of(Ok((Vec::new(), Vec::new()))).state, State::Succeeded);
        assert_eq!(end_of(Err(Failure::new(Code::Canceled, "stop"))).state, State::Canceled);
        assert_eq!(end_of(Err(Failure::model("bad"))).error.unwrap().code, Code::InvalidModel);
    }
}
