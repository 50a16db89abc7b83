//! What a job is, as users read it.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;
use utoipa::ToSchema;

use crate::context::{Progress, Timing};
use crate::error::{Code, Failure, Warning};
use crate::metrics::{RefinementOutcome, Unmet};

/// Where a job stands. A final state never changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for a worker.
    Queued,
    /// A worker computes it.
    Running,
    /// Done; its artifacts are there.
    Succeeded,
    /// It failed; `error` says why.
    Failed,
    /// Cancelled by its user.
    Canceled,
    /// It waited too long and was never run.
    Expired,
}

impl JobState {
    /// All states.
    pub const ALL: [JobState; 6] = [
        JobState::Queued,
        JobState::Running,
        JobState::Succeeded,
        JobState::Failed,
        JobState::Canceled,
        JobState::Expired,
    ];

    /// The name in JSON and in the queue.
    pub fn as_str(self) -> &'static str {
        match self {
            JobState::Queued => "queued",
            JobState::Running => "running",
            JobState::Succeeded => "succeeded",
            JobState::Failed => "failed",
            JobState::Canceled => "canceled",
            JobState::Expired => "expired",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<JobState> {
        Self::ALL.into_iter().find(|s| s.as_str() == name)
    }

    /// Whether it never changes again.
    pub fn is_final(self) -> bool {
        !matches!(self, JobState::Queued | JobState::Running)
    }
}

/// Milliseconds since 1970, UTC; RFC 3339 in JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ToSchema)]
#[schema(value_type = String, format = DateTime)]
pub struct Timestamp(pub i64);

impl Timestamp {
    /// The present.
    pub fn now() -> Self {
        Timestamp((OffsetDateTime::now_utc().unix_timestamp_nanos() / 1_000_000) as i64)
    }

    /// This time and `span` more.
    pub fn plus(self, span: std::time::Duration) -> Self {
        Timestamp(self.0.saturating_add(i64::try_from(span.as_millis()).unwrap_or(i64::MAX)))
    }

    /// This time and `span` less.
    pub fn minus(self, span: std::time::Duration) -> Self {
        Timestamp(self.0.saturating_sub(i64::try_from(span.as_millis()).unwrap_or(i64::MAX)))
    }
}

impl std::fmt::Display for Timestamp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let time = OffsetDateTime::from_unix_timestamp_nanos(i128::from(self.0) * 1_000_000);
        let text = time.ok().and_then(|t| t.format(&Rfc3339).ok());
        f.write_str(text.as_deref().unwrap_or("9999-12-31T23:59:59Z"))
    }
}

impl Serialize for Timestamp {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// A job.
#[derive(Debug, Clone, Serialize, ToSchema)]
pub struct Job {
    /// 128 random bits in hexadecimal digits. Knowing it is the right to read the job.
    #[schema(pattern = "^[0-9a-f]{32}$")]
    pub id: String,
    /// Where it stands.
    pub state: JobState,
    /// The recipe of its options.
    #[schema(value_type = crate::refine::options::Recipe)]
    pub recipe: Value,
    /// Its options, all defaults filled in.
    #[schema(value_type = crate::refine::options::OptionsSchema)]
    pub options: Value,
    /// What became of what it was given; null until it has a result.
    pub outcome: Option<RefinementOutcome>,
    /// How far it is.
    pub progress: Progress,
    /// Its place among the jobs that wait: 1 for the one that runs next, among those of its tenant; null unless queued.
    #[schema(minimum = 1)]
    pub queue_position: Option<u64>,
    /// How often it was started.
    pub attempt: u32,
    /// When it was accepted.
    pub created_at: Timestamp,
    /// When its last attempt started.
    pub started_at: Option<Timestamp>,
    /// When it reached its final state.
    pub finished_at: Option<Timestamp>,
    /// When its artifacts are removed.
    pub artifacts_expire_at: Option<Timestamp>,
    /// The stages that the attempt has entered, each with the progress at that time.
    #[serde(skip)]
    pub stages: Vec<Progress>,
    /// Seconds by stage.
    pub timings: Vec<Timing>,
    /// What its user should know.
    pub warnings: Vec<Warning>,
    /// Why it failed.
    pub error: Option<JobError>,
    /// Its results.
    pub artifacts: Vec<ArtifactEntry>,
    /// The `metadata` of its options.
    #[schema(value_type = serde_json::Map<String, Value>)]
    pub metadata: Value,
}

/// Why a job failed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct JobError {
    /// Stable code.
    pub code: Code,
    /// One sentence for a person.
    pub message: String,
    /// JSON pointer into the glTF document or the options.
    pub pointer: Option<String>,
    /// The requirements that are not met.
    pub failures: Vec<Unmet>,
}

impl From<Failure> for JobError {
    fn from(failure: Failure) -> Self {
        JobError { code: failure.code, message: failure.message, pointer: failure.pointer, failures: Vec::new() }
    }
}

/// One file of a result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Artifact)]
pub struct ArtifactEntry {
    /// File name.
    pub name: String,
    /// What it is: model, report, texture, picture, archive, …
    pub role: String,
    /// Media type.
    pub media_type: String,
    /// Length in bytes.
    pub bytes: u64,
    /// SHA-256 in hexadecimal digits.
    #[schema(pattern = "^[0-9a-f]{64}$")]
    pub sha256: String,
    /// Where it can be fetched, relative to the service; null when it has been removed.
    pub href: Option<String>,
    /// Whether it has been removed, because its time was up.
    #[serde(default)]
    pub expired: bool,
}

/// A new job's id.
///
/// # Errors
/// `internal` when the system has no randomness.
pub fn new_id() -> crate::error::Result<String> {
    let mut bytes = [0u8; 16];
    getrandom::fill(&mut bytes).map_err(|e| Failure::internal(format!("no randomness: {e}")))?;
    Ok(hex::encode(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timestamps_are_rfc_3339_in_utc() {
        assert_eq!(Timestamp(1_700_000_000_250).to_string(), "2023-11-14T22:13:20.25Z");
        assert_eq!(Timestamp(i64::MAX).to_string(), "9999-12-31T23:59:59Z");
    }

    #[test]
    fn states_keep_their_names() {
        for state in JobState::ALL {
            assert_eq!(JobState::from_name(state.as_str()), Some(state));
            assert_eq!(serde_json::to_value(state).unwrap(), state.as_str());
        }
        assert!(!JobState::Queued.is_final() && !JobState::Running.is_final() && JobState::Expired.is_final());
    }
}
