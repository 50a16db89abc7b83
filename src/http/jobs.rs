//! `/v1/jobs`: submit, read, list, cancel, delete.

use std::time::Duration;

use axum::extract::{Path, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::IntoResponse;
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::{IntoParams, ToSchema};

use super::App;
use super::access::Caller;
use super::document::Binary;
use super::examples;
use super::prefer;
use super::problem::{HandlerResult, Problem};
use super::upload::{self, JsonSubmission, Received, Submission, Validation};
use crate::config::Auth;
use crate::error::{Code, Failure};
use crate::jobs::Taken;
use crate::jobs::queue::Listing;
use crate::jobs::record::{Job, JobState};

/// Seconds after which a job that is not final may be asked for again: soon when it runs, when its turn may come while it waits.
fn retry_after(app: &App, job: &Job) -> HeaderValue {
    job.queue_position.map_or(1, |position| app.jobs.seconds_until(position.saturating_sub(1))).into()
}

/// Submits a model. Container, options and limits are checked at once, everything else when the job runs: follow it.
#[utoipa::path(post, path = "/v1/jobs", tag = "jobs",
    params(("recipe" = Option<String>, Query, description = "With a raw model: a preset, or stages joined by commas", example = "pack"),
        ("validate_only" = Option<bool>, Query, description = "Check the submission as always, and store nothing"),
        ("Prefer" = Option<String>, Header, example = "wait=10",
            description = "`wait=N`: answer when the job is final, after N seconds at the latest"),
        ("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, example = "build-17",
            description = "The client's name for this request: sent again under it, it is answered with the job that it made"),
        ("traceparent" = Option<String>, Header, description = "The trace (W3C) that the job goes on with: in logs, in what is told to a collector, and in webhooks",
            example = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"),
        ("X-Request-Id" = Option<String>, Header, example = "build-17/step-2", description = "Stands in the logs beside everything that the job does")),
    request_body(description = "A form, the model alone, or the names of uploads. A part of the form that holds `upload:` and an id is that upload", content(
        (Submission = "multipart/form-data", encoding(("options" = (content_type = "application/json"))), examples(
            ("pack-gate" = (summary = "Packs, and fails where nothing is gained", value = json!(examples::pack()))),
            ("scan" = (summary = "Merges the charts of a scan", value = json!(examples::scan()))),
            ("box_cutter" = (summary = "Cuts charts along their edges", value = json!(examples::box_cutter()))))),
        (JsonSubmission = "application/json", example = json!(examples::by_reference())),
        (inline(Binary) = "model/gltf-binary"), (inline(Binary) = "application/zip"), (inline(Binary) = "application/octet-stream"),
        (serde_json::Map<String, serde_json::Value> = "model/gltf+json", example = json!({"asset": {"version": "2.0"}})))),
    responses(
        (status = 200, description = "Waited for: the job is final. With `validate_only`: what the job would be", body = SubmitAnswer,
            headers(("Location" = String, description = "The job"), ("Preference-Applied" = String, description = "The wait"),
                ("Result-Reused" = Option<String>, description = "`true`: the job has the result of an equal one (`reuse`)")), example = json!(examples::job())),
        (status = 202, description = "Stored", body = Job,
            headers(("Location" = String, description = "The job"), ("Retry-After" = u32, description = "Seconds"),
                ("Preference-Applied" = Option<String>, description = "The wait that was not long enough"),
                ("Idempotency-Replayed" = Option<String>, description = "`true`: the request was known by its key")), example = json!(examples::queued())),
        (status = 429, description = "A quota of the key is used up, or too many requests came", body = Problem,
            content_type = "application/problem+json", headers(("Retry-After" = u32, description = "Seconds"))),
        (status = 408, description = "The upload stood still", body = Problem, content_type = "application/problem+json"),
        (status = 400, description = "Not a model, or a malformed request", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "A limit is exceeded", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Neither a form, nor a model, nor JSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The options are not valid, or the key belongs to another request", body = Problem,
            content_type = "application/problem+json", example = json!(examples::invalid_options())),
        (status = 503, description = "The queue is full", body = Problem, content_type = "application/problem+json",
            headers(("Retry-After" = u32, description = "Seconds")))))]
pub(super) async fn submit(State(app): State<App>, request: Request) -> HandlerResult {
    let wait = prefer::wait(request.headers());
    let received = upload::receive(&app, request).await;
    let received = received.map_err(|problem| match problem.code {
        // A place is free when one of those that run has ended.
        Code::QueueFull | Code::QuotaExceeded => Problem { retry_after: Some(app.jobs.seconds_until(1)), ..problem },
        _ => problem,
    })?;
    let (mut job, taken) = match received {
        Received::Job(job, taken) => (*job, taken),
        Received::Valid(validation) => return Ok(Json(validation).into_response()),
    };
    if let Some(wait) = wait {
        job = app.jobs.wait_until_final(&job.id, wait).await?;
    }
    let location = HeaderValue::from_str(&format!("/v1/jobs/{}", job.id))
        .map_err(|e| Failure::internal(format!("an id cannot stand in a header: {e}")))?;
    let done = (wait.is_some() || taken != Taken::New) && job.state.is_final();
    let retry_after = retry_after(&app, &job);
    let mut response = (if done { StatusCode::OK } else { StatusCode::ACCEPTED }, Json(job)).into_response();
    let headers = response.headers_mut();
    headers.insert(header::LOCATION, location);
    if !done {
        headers.insert(header::RETRY_AFTER, retry_after);
    }
    if let Some(wait) = wait {
        prefer::applied(headers, wait);
    }
    let replayed = match taken {
        Taken::New => None,
        Taken::Reused => Some("result-reused"),
        Taken::Known => Some("idempotency-replayed"),
    };
    if let Some(name) = replayed {
        headers.insert(name, HeaderValue::from_static("true"));
    }
    Ok(response)
}

/// A job.
#[utoipa::path(get, path = "/v1/jobs/{id}", tag = "jobs",
    params(JobPath,
        ("Prefer" = Option<String>, Header, example = "wait=10",
            description = "`wait=N`: answer when the job is final, after N seconds at the latest"),
        ("If-None-Match" = Option<String>, Header, description = "ETags that the client has")),
    responses(
        (status = 200, description = "As it is now", body = Job, headers(("ETag" = String, description = "Of this answer"),
            ("Retry-After" = u32, description = "Seconds; until the job is final")), example = json!(examples::job())),
        (status = 304, description = "Nothing has changed"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn read(State(app): State<App>, Path(id): Path<String>, headers: HeaderMap) -> HandlerResult {
    let wait = prefer::wait(&headers);
    let job = match wait {
        Some(wait) => app.jobs.wait_until_final(&id, wait).await?,
        None => app.jobs.get(&id).await?,
    };
    polled(&headers, &job, (!job.state.is_final()).then(|| retry_after(&app, &job)), wait)
}

/// What a submission is answered.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "describes the answer in the OpenAPI document")]
pub(super) enum SubmitAnswer {
    /// The job.
    Job(Box<Job>),
    /// What it would be.
    Validation(Validation),
}

/// Which job is meant.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "describes the path in the OpenAPI document")]
pub(super) struct JobPath {
    /// Id of the job.
    #[param(example = "8c2f6d0b5e9a4c17b3d8f1a26e7c9054")]
    id: String,
}

/// Which jobs are wanted.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct ListQuery {
    /// Only those in this state.
    state: Option<JobState>,
    /// From the page before: its `next`.
    cursor: Option<i64>,
    /// Jobs on a page, 1..=200; 50 without it.
    #[param(minimum = 1, maximum = 200)]
    limit: Option<u32>,
}

/// A page of jobs, the newest first.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobPage {
    /// The jobs.
    jobs: Vec<Job>,
    /// Cursor of the next page; null at the end.
    next: Option<i64>,
}

/// Jobs, page by page: those of the key's tenant, or all where the service was started with `--list-jobs` and without keys.
#[utoipa::path(get, path = "/v1/jobs", tag = "jobs", params(ListQuery), responses(
    (status = 200, description = "A page of them", body = JobPage, example = json!(examples::page())),
    (status = 400, description = "A malformed query", body = Problem, content_type = "application/problem+json"),
    (status = 404, description = "The service does not list jobs", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    query: Result<Query<ListQuery>, axum::extract::rejection::QueryRejection>,
) -> HandlerResult {
    if !app.access.list_jobs && app.access.auth == Auth::None {
        return Err(Problem::new(Code::NotFound, "this service does not list its jobs"));
    }
    let Query(query) = query.map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))?;
    let limit = page_limit(query.limit)?;
    let wanted = Listing { tenant: caller.tenant_if_any(), state: query.state, cursor: query.cursor, limit };
    let (jobs, next) = app.jobs.queue.list(wanted).await?;
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(JobPage { jobs, next })).into_response())
}

/// How many entries a page has.
pub(super) fn page_limit(wanted: Option<u32>) -> HandlerResult<u32> {
    let limit = wanted.unwrap_or(50);
    if (1..=200).contains(&limit) {
        Ok(limit)
    } else {
        Err(Problem::new(Code::InvalidRequest, "`limit` is in 1..=200"))
    }
}

/// Cancels a job: at once while it waits, soon when it runs.
#[utoipa::path(post, path = "/v1/jobs/{id}/cancel", tag = "jobs",
    params(JobPath),
    responses(
        (status = 202, description = "It will stop, or has", body = Job, example = json!(examples::canceled())),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It has ended", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn cancel(State(app): State<App>, Path(id): Path<String>) -> HandlerResult<(StatusCode, Json<Job>)> {
    Ok((StatusCode::ACCEPTED, Json(app.jobs.cancel(&id).await?)))
}

/// Deletes a job and its files; cancels it when it runs.
#[utoipa::path(delete, path = "/v1/jobs/{id}", tag = "jobs",
    params(JobPath),
    responses(
        (status = 204, description = "It is gone"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn delete(State(app): State<App>, Path(id): Path<String>) -> HandlerResult<StatusCode> {
    app.jobs.delete(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// The ETag of a body.
fn etag(body: &[u8]) -> String {
    format!("\"{}\"", hex::encode(Sha256::digest(body).get(..16).unwrap_or_default()))
}

/// The answer to who asks again and again how something stands: none where nothing has changed, and when to ask again until it is final.
pub(super) fn polled(
    asked: &HeaderMap,
    status: &impl Serialize,
    retry_after: Option<HeaderValue>,
    wait: Option<Duration>,
) -> HandlerResult {
    let body = serde_json::to_vec(status).map_err(|e| Failure::internal(e.to_string()))?;
    let etag = etag(&body);
    let mut response = if matches(asked, &etag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        ([(header::CONTENT_TYPE, "application/json")], body).into_response()
    };
    let headers = response.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if let Ok(etag) = HeaderValue::from_str(&etag) {
        headers.insert(header::ETAG, etag);
    }
    if let Some(seconds) = retry_after {
        headers.insert(header::RETRY_AFTER, seconds);
    }
    if let Some(wait) = wait {
        prefer::applied(headers, wait);
    }
    Ok(response)
}

/// Whether `If-None-Match` names the tag (weak comparison, RFC 9110, 13.1.2).
pub(super) fn matches(headers: &HeaderMap, etag: &str) -> bool {
    let given = headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok());
    given.flat_map(|v| v.split(',')).map(str::trim).any(|t| t == "*" || t.strip_prefix("W/").unwrap_or(t) == etag)
}
