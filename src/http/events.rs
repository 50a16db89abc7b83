//! `/v1/jobs/{id}/events`: server-sent events of one job.
//!
//! Events are the differences between what the client has been sent and how the job is now, so a slow client gets fewer
//! of them and never a queue of old ones; only stages and warnings are sent one by one. An id is
//! `<attempt>.<stages sent>.<warnings sent>`: with it, a client that comes back gets those that it missed.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::time::Duration;

use axum::extract::{Path, State};
use axum::http::HeaderMap;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::stream::{Stream, unfold};
use serde::Serialize;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use utoipa::openapi::schema::{ObjectBuilder, Ref, Type};
use utoipa::openapi::{RefOr, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::App;
use super::examples;
use super::jobs::JobPath;
use super::problem::{HandlerResult, Problem};
use crate::context::Progress;
use crate::error::{Code, Warning};
use crate::jobs::hub::LiveJob;
use crate::jobs::record::{Job, JobState};

/// Shortest time between two reads of the job.
const MIN_INTERVAL: Duration = Duration::from_millis(100);
/// Longest time between two reads: another process may be computing the job.
const MAX_INTERVAL: Duration = Duration::from_secs(1);
/// A comment goes out when nothing else has for so long.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// An event of a job, by its name; the data is JSON.
#[derive(ToSchema)]
#[serde(tag = "event", content = "data", rename_all = "snake_case")]
#[expect(dead_code, reason = "describes the stream in the OpenAPI document")]
enum JobEvent {
    /// The job as it is when the stream begins.
    #[schema(title = "SnapshotEvent")]
    Snapshot(Box<Job>),
    /// The job has come further, or has entered a stage.
    #[schema(title = "ProgressEvent")]
    Progress(Progress),
    /// What the user should know, as it is found.
    #[schema(title = "WarningEvent")]
    Warning(Warning),
    /// The job has another state; the last event tells the final one.
    #[schema(title = "StateEvent")]
    State(ToldState),
}

/// The data of `state`.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "describes the stream in the OpenAPI document")]
enum ToldState {
    /// The job.
    Job(Box<Job>),
    /// A job that was deleted under the client's eyes.
    Deleted(DeletedJob),
}

/// What is left of a job that was deleted.
#[derive(Serialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct DeletedJob {
    /// Its id.
    id: String,
    /// `canceled`.
    state: JobState,
}

/// The text of the stream: `event`, `id` and `data` lines, an empty line after each event.
struct EventStreamText;

impl PartialSchema for EventStreamText {
    fn schema() -> RefOr<Schema> {
        let text = ObjectBuilder::new().schema_type(Type::String).content_media_type("text/event-stream");
        text.content_schema(Some(Ref::from_schema_name(JobEvent::name()))).into()
    }
}

impl ToSchema for EventStreamText {
    fn schemas(schemas: &mut Vec<(String, RefOr<Schema>)>) {
        schemas.push((JobEvent::name().into_owned(), JobEvent::schema()));
        JobEvent::schemas(schemas);
    }
}

/// The events of a job: `snapshot` first, then `progress`, `warning` and `state`, until it is final.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", tag = "jobs",
    params(JobPath,
        ("Last-Event-ID" = Option<String>, Header, example = "1.2.0", description = "The last event that the client has")),
    responses(
        (status = 200, description = "`snapshot` and `state` carry the job, `progress` its progress, `warning` one warning",
            content_type = "text/event-stream", body = inline(EventStreamText), example = json!(examples::events())),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn follow(
    State(app): State<App>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> HandlerResult<Sse<impl Stream<Item = Result<Event, Infallible>>>> {
    // Subscribed first, read second: what happens in between is then not missed.
    let live = app.jobs.hub.follow(&id);
    let job = app.jobs.get(&id).await?;
    let last = headers.get("last-event-id").and_then(|v| v.to_str().ok()).and_then(parse_event_id);
    let mut cursor = SseCursor::after_snapshot(&job);
    match last {
        Some((attempt, stages, warnings)) if attempt == job.attempt => {
            cursor.stages = stages.min(job.stages.len());
            cursor.warnings = warnings.min(job.warnings.len());
        }
        Some(_) => cursor.warnings = 0,
        None => {}
    }
    let mut pending = VecDeque::from([cursor.event("snapshot", &job)]);
    pending.extend(cursor.advance(&job));
    let stream = EventStream { app, id, live, cursor, pending };
    let events = unfold(stream, |mut stream| async move {
        let event = stream.next().await?;
        Some((Ok(event), stream))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

struct EventStream {
    app: App,
    id: String,
    live: Option<watch::Receiver<LiveJob>>,
    cursor: SseCursor,
    pending: VecDeque<Event>,
}

impl EventStream {
    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.pending.pop_front() {
                return Some(event);
            }
            if self.cursor.at_end() {
                return None;
            }
            let shutdown = self.app.jobs.shutdown.clone();
            tokio::select! {
                () = shutdown.cancelled() => return None,
                () = self.change() => {}
            }
            match self.app.jobs.get(&self.id).await {
                Ok(job) => self.pending.extend(self.cursor.advance(&job)),
                Err(failure) if failure.code == Code::NotFound => {
                    self.cursor.state = Some(JobState::Canceled);
                    let gone = DeletedJob { id: self.id.clone(), state: JobState::Canceled };
                    self.pending.push_back(self.cursor.event("state", &gone));
                }
                // The queue may come back.
                Err(_) => {}
            }
        }
    }

    /// Returns when the job may have changed.
    async fn change(&mut self) {
        sleep(MIN_INTERVAL).await;
        let alive = match &mut self.live {
            Some(live) => !matches!(timeout(MAX_INTERVAL, live.changed()).await, Ok(Err(_))),
            None => {
                sleep(MAX_INTERVAL).await;
                self.live = self.app.jobs.hub.follow(&self.id);
                true
            }
        };
        if !alive {
            self.live = None;
        }
    }
}

/// Attempt, stages and warnings of an event's id.
fn parse_event_id(id: &str) -> Option<(u32, usize, usize)> {
    let mut parts = id.split('.');
    let (attempt, stages, warnings) = (parts.next()?, parts.next()?, parts.next()?);
    Some((attempt.parse().ok()?, stages.parse().ok()?, warnings.parse().ok()?))
}

/// What the client has been sent.
struct SseCursor {
    /// `None`: only what the snapshot says.
    state: Option<JobState>,
    attempt: u32,
    progress: Progress,
    stages: usize,
    warnings: usize,
}

impl SseCursor {
    /// A snapshot has everything but the stages that have passed, and the end, which has an event of its own.
    fn after_snapshot(job: &Job) -> Self {
        let state = (!job.state.is_final()).then_some(job.state);
        SseCursor {
            state,
            attempt: job.attempt,
            progress: job.progress.clone(),
            stages: 0,
            warnings: job.warnings.len(),
        }
    }

    fn at_end(&self) -> bool {
        self.state.is_some_and(JobState::is_final)
    }

    /// Events of what the client has not been sent yet.
    fn advance(&mut self, job: &Job) -> Vec<Event> {
        let mut events = Vec::new();
        if job.attempt != self.attempt {
            self.attempt = job.attempt;
            (self.stages, self.warnings) = (0, 0);
        }
        for stage in job.stages.iter().skip(self.stages) {
            self.stages += 1;
            // The fraction that a client sees never falls.
            let fraction = stage.fraction.max(self.progress.fraction);
            self.progress = Progress { fraction, ..stage.clone() };
            events.push(self.event("progress", &self.progress));
        }
        for warning in job.warnings.iter().skip(self.warnings) {
            self.warnings += 1;
            events.push(self.event("warning", warning));
        }
        if job.progress != self.progress {
            self.progress = job.progress.clone();
            events.push(self.event("progress", &job.progress));
        }
        if self.state != Some(job.state) {
            self.state = Some(job.state);
            events.push(self.event("state", job));
        }
        events
    }

    fn event<T: serde::Serialize>(&self, name: &str, data: &T) -> Event {
        let text = serde_json::to_string(data).unwrap_or_default();
        Event::default().event(name).id(format!("{}.{}.{}", self.attempt, self.stages, self.warnings)).data(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn event_ids_are_parsed_and_malformed_ones_are_not() {
        assert_eq!(parse_event_id("2.3.17"), Some((2, 3, 17)));
        for bad in ["", "1", "1.2", "a.b.c", "-1.0.0", "1..2"] {
            assert_eq!(parse_event_id(bad), None, "{bad}");
        }
    }
}
