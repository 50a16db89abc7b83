//! What is counted for Prometheus.

use std::time::Duration;

use prometheus::{
    Encoder, Gauge, HistogramOpts, HistogramVec, IntCounter, IntCounterVec, IntGauge, IntGaugeVec, Opts, Registry,
    TextEncoder,
};

use super::queue::AttemptEnd;
use super::record::{JobState, Timestamp};
use super::trace::Spans;
use crate::error::{Failure, Result};

/// Upper bounds of the buckets of job and stage times, in seconds.
const JOB_BUCKETS: &[f64] = &[0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0];
/// The same of response times.
const RESPONSE_BUCKETS: &[f64] = &[0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0];

/// The figures of one service.
pub struct Telemetry {
    registry: Registry,
    jobs: IntGaugeVec,
    ended: IntCounterVec,
    job_seconds: HistogramVec,
    stage_seconds: HistogramVec,
    responses: IntCounterVec,
    response_seconds: HistogramVec,
    slots: IntGauge,
    memory: IntGauge,
    oldest: Gauge,
    /// What is told to a collector of traces.
    pub spans: Spans,
    /// Bytes that were uploaded.
    pub received: IntCounter,
    /// Bytes of artifacts that were published.
    pub published: IntCounter,
    /// Processes of single jobs that died.
    pub deaths: IntCounter,
    /// Jobs that have the result of an equal one.
    pub reused: IntCounter,
    /// Jobs that were taken back from workers.
    pub leases_lost: IntCounter,
}

impl Telemetry {
    /// All figures at zero.
    ///
    /// # Errors
    /// `internal`, should a name not be valid.
    pub fn new() -> Result<Self> {
        Self::register().map_err(|e| Failure::internal(format!("the metrics are broken: {e}")))
    }

    fn register() -> prometheus::Result<Self> {
        let registry = Registry::new();
        let opts = |name: &str, help: &str| Opts::new(format!("intarsia_{name}"), help);
        let histogram = |name: &str, help: &str, buckets: &[f64], labels: &[&str]| {
            let made = HistogramVec::new(HistogramOpts::from(opts(name, help)).buckets(buckets.to_vec()), labels)?;
            registry.register(Box::new(made.clone())).map(|()| made)
        };
        let counter = |name: &str, help: &str| {
            let made = IntCounter::with_opts(opts(name, help))?;
            registry.register(Box::new(made.clone())).map(|()| made)
        };
        let counters = |name: &str, help: &str, labels: &[&str]| {
            let made = IntCounterVec::new(opts(name, help), labels)?;
            registry.register(Box::new(made.clone())).map(|()| made)
        };
        let gauge = |name: &str, help: &str| {
            let made = IntGauge::with_opts(opts(name, help))?;
            registry.register(Box::new(made.clone())).map(|()| made)
        };
        let jobs = IntGaugeVec::new(opts("jobs", "Jobs that the queue holds, by state"), &["state"])?;
        registry.register(Box::new(jobs.clone()))?;
        Ok(Telemetry {
            jobs,
            ended: counters(
                "jobs_ended_total",
                "Attempts that this process ended, by state and code of the error",
                &["state", "code"],
            )?,
            job_seconds: histogram(
                "job_seconds",
                "Seconds from the start of an attempt to its end",
                JOB_BUCKETS,
                &["state"],
            )?,
            stage_seconds: histogram("stage_seconds", "Seconds of a stage", JOB_BUCKETS, &["stage"])?,
            responses: counters("http_requests_total", "Requests answered", &["method", "route", "status"])?,
            response_seconds: histogram(
                "http_request_seconds",
                "Seconds until the head of an answer",
                RESPONSE_BUCKETS,
                &["method", "route"],
            )?,
            slots: gauge("jobs_running", "Jobs that this process runs")?,
            memory: gauge("memory_reserved_bytes", "Bytes that the jobs of this process are expected to need")?,
            oldest: {
                let name = "queue_oldest_age_seconds";
                let made = Gauge::with_opts(opts(
                    name,
                    "Seconds that the job has waited that has waited longest, 0 where none does",
                ))?;
                registry.register(Box::new(made.clone())).map(|()| made)?
            },
            reused: counter("results_reused_total", "Jobs that were given the result of an equal one")?,
            leases_lost: counter(
                "leases_lost_total",
                "Jobs that this process took back because their worker was gone or did not renew its lease",
            )?,
            received: counter("upload_bytes_total", "Bytes of uploads")?,
            published: counter("artifact_bytes_total", "Bytes of published artifacts")?,
            deaths: counter("job_deaths_total", "Processes of single jobs that died under this one")?,
            spans: Spans::default(),
            registry,
        })
    }

    /// Counts the end of an attempt.
    pub fn record_attempt(&self, end: &AttemptEnd, took: Duration) {
        let code = end.error.as_ref().map_or("", |e| e.code.as_str());
        self.ended.with_label_values(&[end.state.as_str(), code]).inc();
        self.job_seconds.with_label_values(&[end.state.as_str()]).observe(took.as_secs_f64());
        for timing in &end.timings {
            self.stage_seconds.with_label_values(&[timing.stage.as_str()]).observe(timing.seconds);
        }
        self.published.inc_by(end.artifacts.iter().map(|a| a.bytes).sum());
    }

    /// Counts a response. `route` is the pattern, not the path.
    pub fn record_response(&self, method: &str, route: &str, status: u16, took: Duration) {
        self.responses.with_label_values(&[method, route, status.to_string().as_str()]).inc();
        self.response_seconds.with_label_values(&[method, route]).observe(took.as_secs_f64());
    }

    /// The text that Prometheus reads, with how the queue and the slots are now; `since` is when the oldest job began to wait, by
    /// the clock by which it is `now`.
    ///
    /// # Errors
    /// `internal`.
    pub fn text(
        &self,
        counts: &[(JobState, u64)],
        since: Option<Timestamp>,
        now: Timestamp,
        (slots, memory): (usize, u64),
    ) -> Result<String> {
        let age = since.map_or(0, |since| (now.0 - since.0).max(0));
        self.oldest.set(age as f64 / 1000.0);
        let whole = |n: u64| i64::try_from(n).unwrap_or(i64::MAX);
        for state in JobState::ALL {
            let count = counts.iter().find(|c| c.0 == state).map_or(0, |c| c.1);
            self.jobs.with_label_values(&[state.as_str()]).set(whole(count));
        }
        self.slots.set(whole(slots as u64));
        self.memory.set(whole(memory));
        let mut text = Vec::new();
        TextEncoder::new()
            .encode(&self.registry.gather(), &mut text)
            .map_err(|e| Failure::internal(format!("the metrics cannot be written: {e}")))?;
        String::from_utf8(text).map_err(|e| Failure::internal(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    /// Each metric that the alerts, the dashboard or the scaling name is one of those above.
    #[test]
    fn the_manifests_name_metrics_that_there_are() {
        let docker = Path::new(env!("CARGO_MANIFEST_DIR")).join("docker");
        let code = include_str!("telemetry.rs").split("mod tests").next().unwrap();
        let mut named = BTreeSet::new();
        for file in ["monitoring/alerts.yaml", "monitoring/dashboard.json", "kubernetes/keda.yaml"] {
            let text = std::fs::read_to_string(docker.join(file)).unwrap();
            for rest in text.split("intarsia_").skip(1) {
                let end = rest.find(|c: char| !c.is_ascii_lowercase() && c != '_').unwrap_or(rest.len());
                named.insert(rest[..end].trim_end_matches("_bucket").to_owned());
            }
        }
        assert!(named.len() > 10, "{named:?}");
        for name in named {
            assert!(code.contains(&format!("\"{name}\"")), "there is no intarsia_{name}");
        }
    }
}
