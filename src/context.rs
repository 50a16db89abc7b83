//! What a stage may know of the world: progress, cancellation, seed, budget and clock.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::error::{Code, Failure, Result, Warning};

/// Where progress and warnings go. Implementations must be cheap: they are called from loops.
pub trait Listener: Send + Sync {
    /// `fraction` in 0..=1 of the whole job; never falls.
    fn progress(&self, _progress: &Progress) {}
    /// A warning, as it is found.
    fn warning(&self, _warning: &Warning) {}
}

/// A listener that hears nothing.
pub struct Silent;
impl Listener for Silent {}

/// Where a job stands.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Progress {
    /// Fraction of the whole job in 0..=1; never falls.
    #[schema(minimum = 0, maximum = 1)]
    pub fraction: f64,
    /// Name of the current stage.
    pub stage: String,
    /// Index of the current stage, from 0.
    pub stage_index: u32,
    /// Number of stages.
    pub stage_count: u32,
    /// A few words on what is being done.
    pub message: String,
}

/// Seconds that a stage took.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Timing {
    /// Name of the stage.
    pub stage: String,
    /// Wall-clock seconds.
    #[schema(minimum = 0)]
    pub seconds: f64,
}

/// Warnings that are listed one by one; a broken model may give rise to millions.
const MOST_WARNINGS: usize = 1000;

/// Code of the warning that there are more.
const MORE_WARNINGS: &str = "more_warnings";

struct State {
    progress: Progress,
    weights: Vec<(String, f64)>,
    timings: Vec<Timing>,
    warnings: Vec<Warning>,
    /// The same, to be asked whether one is new. Never walked.
    known: HashSet<Warning>,
    /// Warnings beyond those that are listed.
    unlisted: u64,
    /// How many there are by code, those that are not listed among them.
    counts: BTreeMap<String, u64>,
    subject: Option<String>,
    started: Instant,
}

/// Carries progress, cancellation and the seed through a job; alone reads the clock.
pub struct Context {
    listener: Arc<dyn Listener>,
    cancel: Arc<AtomicBool>,
    deadline: Option<Instant>,
    /// Seed of every random choice.
    pub seed: u64,
    state: Mutex<State>,
}

impl Context {
    /// A context that reports to `listener` and stops when `cancel` becomes true.
    pub fn new(listener: Arc<dyn Listener>, cancel: Arc<AtomicBool>, seed: u64) -> Self {
        Context {
            listener,
            cancel,
            deadline: None,
            seed,
            state: Mutex::new(State {
                progress: Progress::default(),
                weights: Vec::new(),
                timings: Vec::new(),
                warnings: Vec::new(),
                known: HashSet::new(),
                unlisted: 0,
                counts: BTreeMap::new(),
                subject: None,
                started: Instant::now(),
            }),
        }
    }

    /// A context for tests and small calls: silent, never cancelled, seed 0.
    pub fn silent() -> Self {
        Self::new(Arc::new(Silent), Arc::new(AtomicBool::new(false)), 0)
    }

    /// Sets the wall-clock limit of the job, from now.
    pub fn with_time_limit(mut self, limit: Option<Duration>) -> Self {
        self.deadline = limit.map(|l| Instant::now() + l);
        self
    }

    /// Names the stages of the job in order, with their expected share of the work.
    pub fn plan(&self, stages: &[(&str, f64)]) {
        let total: f64 = stages.iter().map(|s| s.1).sum();
        let mut state = self.lock();
        state.weights = stages.iter().map(|(n, w)| ((*n).to_owned(), w / total.max(1e-9))).collect();
        state.progress.stage_count = stages.len() as u32;
    }

    /// Enters the planned stage `index`; the time of the one before ends here.
    pub fn enter(&self, index: usize) {
        let mut state = self.lock();
        self.close_stage(&mut state);
        state.started = Instant::now();
        state.progress.stage_index = index as u32;
        state.progress.stage = state.weights.get(index).map(|w| w.0.clone()).unwrap_or_default();
        state.progress.message.clear();
        let before = state.weights.iter().take(index).fold(0.0, |sum, w| sum + w.1);
        state.progress.fraction = state.progress.fraction.max(before.min(1.0));
        self.listener.progress(&state.progress);
    }

    /// Ends the last stage; the fraction becomes 1.
    pub fn finish(&self) {
        let mut state = self.lock();
        self.close_stage(&mut state);
        state.progress.stage = state.weights.last().map(|w| w.0.clone()).unwrap_or_default();
        state.progress.message = "done".to_owned();
        state.progress.fraction = 1.0;
        self.listener.progress(&state.progress);
    }

    fn close_stage(&self, state: &mut State) {
        if !state.progress.stage.is_empty() {
            let timing = Timing { stage: state.progress.stage.clone(), seconds: state.started.elapsed().as_secs_f64() };
            state.timings.push(timing);
            state.progress.stage.clear();
        }
    }

    /// Reports that `fraction` (0..=1) of the current stage is done, and checks for cancellation.
    pub fn step(&self, fraction: f64, message: &str) -> Result<()> {
        self.check()?;
        let mut state = self.lock();
        let index = state.progress.stage_index as usize;
        let before = state.weights.iter().take(index).fold(0.0, |sum, w| sum + w.1);
        let own = state.weights.get(index).map_or(0.0, |w| w.1);
        let whole = (before + own * fraction.clamp(0.0, 1.0)).min(1.0);
        state.progress.fraction = state.progress.fraction.max(whole);
        if state.progress.message != message {
            state.progress.message = message.to_owned();
        }
        self.listener.progress(&state.progress);
        Ok(())
    }

    /// Fails with `canceled` once the job was cancelled. Call it in every long loop.
    pub fn check(&self) -> Result<()> {
        if self.cancel.load(Ordering::Relaxed) {
            return Err(Failure::new(Code::Canceled, "the job was cancelled"));
        }
        Ok(())
    }

    /// Whether the user's wall-clock limit has passed: search loops stop with their best.
    pub fn out_of_time(&self) -> bool {
        self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Says what the warnings that follow are about, where a job has several models: their messages begin with it.
    pub fn speak_of(&self, subject: Option<&str>) {
        self.lock().subject = subject.map(str::to_owned);
    }

    /// Records a warning, once. Those beyond the first thousand are counted.
    pub fn warn(&self, mut warning: Warning) {
        let mut state = self.lock();
        if let Some(subject) = &state.subject {
            warning.message = format!("{subject}: {}", warning.message);
        }
        tracing::debug!(code = %warning.code, message = %warning.message, "warning");
        if state.known.contains(&warning) {
            return;
        }
        *state.counts.entry(warning.code.clone()).or_default() += 1;
        if state.warnings.len() >= MOST_WARNINGS {
            state.unlisted += 1;
            state.counts.insert(MORE_WARNINGS.to_owned(), 1);
            return;
        }
        self.listener.warning(&warning);
        state.known.insert(warning.clone());
        state.warnings.push(warning);
    }

    /// The warnings so far, in the order in which they were found; the last tells how many more there are.
    pub fn warnings(&self) -> Vec<Warning> {
        let state = self.lock();
        let mut warnings = state.warnings.clone();
        if state.unlisted > 0 {
            let text = format!("{} further warnings are not listed", state.unlisted);
            warnings.push(Warning::new(MORE_WARNINGS, text));
        }
        warnings
    }

    /// How many warnings there are so far, by code: those that are not listed count too.
    pub fn warning_counts(&self) -> BTreeMap<String, u64> {
        self.lock().counts.clone()
    }

    /// Seconds by stage so far.
    pub fn timings(&self) -> Vec<Timing> {
        self.lock().timings.clone()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_are_told_once_and_only_the_first_are_listed() {
        let context = Context::silent();
        for n in (0..MOST_WARNINGS + 7).chain(0..10) {
            context.warn(Warning::new("kept_input", n.to_string()));
        }
        let warnings = context.warnings();
        assert_eq!(warnings.len(), MOST_WARNINGS + 1);
        let last = &warnings[MOST_WARNINGS];
        assert_eq!((last.code.as_str(), last.message.as_str()), ("more_warnings", "7 further warnings are not listed"));
        let counts = context.warning_counts();
        assert_eq!((counts["kept_input"], counts["more_warnings"]), (MOST_WARNINGS as u64 + 7, 1));
    }
}
