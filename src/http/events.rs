//! `/v1/jobs/{id}/events`: server-sent events of one job.
//!
//! Events are the differences between what the client has been told and how the job is now, so a slow client gets fewer
//! of them and never a queue of old ones; only stages and warnings are told one by one. An id is
//! `<attempt>.<stages told>.<warnings told>`: with it, a client that comes back is told those that it missed.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::time::Duration;

use axum::extract::{Path, State};
use axum::http::HeaderMap;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::stream::{Stream, unfold};
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

use super::App;
use super::problem::{Answer, Problem};
use crate::context::Progress;
use crate::error::Code;
use crate::jobs::hub::Live;
use crate::jobs::record::{Job, State as JobState};

/// Shortest time between two looks at the job.
const QUIET: Duration = Duration::from_millis(100);
/// Longest time without a look: another process may be computing the job.
const LOOK: Duration = Duration::from_secs(3);
/// A comment goes out when nothing else has for so long.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// The events of a job: `snapshot` first, then `progress`, `warning` and `state`, until it is final.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", tag = "jobs",
    params(("id" = String, Path, description = "Id of the job"),
        ("Last-Event-ID" = Option<String>, Header, description = "The last event that the client has")),
    responses(
        (status = 200, description = "`snapshot` and `state` carry the job, `progress` its progress, `warning` one warning",
            content_type = "text/event-stream", body = serde_json::Value),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn follow(
    State(app): State<App>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Answer<Sse<impl Stream<Item = Result<Event, Infallible>>>> {
    // The listener first, the job second: what happens in between is then not missed.
    let live = app.jobs.hub.follow(&id);
    let job = app.jobs.get(&id).await?;
    let heard = headers.get("last-event-id").and_then(|v| v.to_str().ok()).and_then(heard);
    let mut told = Told::of(&job);
    match heard {
        Some((attempt, stages, warnings)) if attempt == job.attempt => {
            told.stages = stages.min(job.stages.len());
            told.warnings = warnings.min(job.warnings.len());
        }
        Some(_) => told.warnings = 0,
        None => {}
    }
    let mut pending = VecDeque::from([told.event("snapshot", &job)]);
    pending.extend(told.news(&job));
    let follower = Follower { app, id, live, told, pending };
    let events = unfold(follower, |mut follower| async move {
        let event = follower.next().await?;
        Some((Ok(event), follower))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

struct Follower {
    app: App,
    id: String,
    live: Option<watch::Receiver<Live>>,
    told: Told,
    pending: VecDeque<Event>,
}

impl Follower {
    async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.pending.pop_front() {
                return Some(event);
            }
            if self.told.at_end() {
                return None;
            }
            let shutdown = self.app.jobs.shutdown.clone();
            tokio::select! {
                () = shutdown.cancelled() => return None,
                () = self.change() => {}
            }
            match self.app.jobs.get(&self.id).await {
                Ok(job) => self.pending.extend(self.told.news(&job)),
                Err(failure) if failure.code == Code::NotFound => {
                    self.told.state = Some(JobState::Canceled);
                    let gone = serde_json::json!({"id": self.id, "state": JobState::Canceled});
                    self.pending.push_back(self.told.event("state", &gone));
                }
                // The queue may come back.
                Err(_) => {}
            }
        }
    }

    /// Returns when the job may have changed.
    async fn change(&mut self) {
        sleep(QUIET).await;
        let alive = match &mut self.live {
            Some(live) => !matches!(timeout(LOOK, live.changed()).await, Ok(Err(_))),
            None => {
                sleep(LOOK).await;
                self.live = self.app.jobs.hub.follow(&self.id);
                true
            }
        };
        if !alive {
            self.live = None;
        }
    }
}

/// What an id says: attempt, stages and warnings.
fn heard(id: &str) -> Option<(u32, usize, usize)> {
    let mut parts = id.split('.');
    let (attempt, stages, warnings) = (parts.next()?, parts.next()?, parts.next()?);
    Some((attempt.parse().ok()?, stages.parse().ok()?, warnings.parse().ok()?))
}

/// What the client knows.
struct Told {
    /// `None`: only what the snapshot says.
    state: Option<JobState>,
    attempt: u32,
    progress: Progress,
    stages: usize,
    warnings: usize,
}

impl Told {
    /// What a snapshot tells: everything but the stages that have passed, and the end, which has an event of its own.
    fn of(job: &Job) -> Self {
        let state = (!job.state.is_final()).then_some(job.state);
        Told { state, attempt: job.attempt, progress: job.progress.clone(), stages: 0, warnings: job.warnings.len() }
    }

    fn at_end(&self) -> bool {
        self.state.is_some_and(JobState::is_final)
    }

    /// What the client does not know yet.
    fn news(&mut self, job: &Job) -> Vec<Event> {
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
    fn ids_are_read_and_what_is_none_is_not() {
        assert_eq!(heard("2.3.17"), Some((2, 3, 17)));
        for bad in ["", "1", "1.2", "a.b.c", "-1.0.0", "1..2"] {
            assert_eq!(heard(bad), None, "{bad}");
        }
    }
}
