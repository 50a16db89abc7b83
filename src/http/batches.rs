//! `/v1/batches`: many models in one call, with one status.

use axum::Json;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::IntoResponse;
use serde::Serialize;
use tracing::Instrument;
use utoipa::{IntoParams, ToSchema};

use super::App;
use super::batch_request::{self, BatchForm, BatchRequest, ReceivedBatch};
use super::examples;
use super::jobs::polled;
use super::prefer;
use super::problem::{HandlerResult, Problem};
use super::upload::Validation;
use crate::error::{Code, Failure};
use crate::jobs::batches::Batch;

/// Longest time in seconds after which a batch should be asked for again.
const MAX_RETRY_AFTER: u64 = 10;

/// Seconds after which a batch that is not final may be asked for again.
fn retry_after(app: &App, batch: &Batch) -> HeaderValue {
    app.jobs.seconds_until(batch.counts.queued).min(MAX_RETRY_AFTER).into()
}

/// What a batch would be.
#[derive(Serialize, ToSchema)]
pub(super) struct BatchValidation {
    /// `true`.
    #[schema(default = true)]
    valid: bool,
    /// What each item would be as a job.
    items: Vec<Validation>,
}

/// What the submission of a batch is answered.
#[derive(ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "describes the answer in the OpenAPI document")]
pub(super) enum BatchAnswer {
    /// The batch.
    Batch(Box<Batch>),
    /// What it would be.
    Validation(BatchValidation),
}

/// Which batch is meant.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "describes the path in the OpenAPI document")]
struct BatchPath {
    /// Id of the batch.
    #[param(example = "c41f7e02d95b48a6a3d0f7b81e2c6945")]
    id: String,
}

/// Submits many models, all or none: each item is judged as a single submission would be, and where one cannot be taken, or the queue or a quota
/// has no room for all, nothing is stored. Each item becomes a job like any other.
#[utoipa::path(post, path = "/v1/batches", tag = "batches", operation_id = "submit_batch",
    params(("validate_only" = Option<bool>, Query, description = "Judge all items as always, and store nothing"),
        ("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, example = "night-17",
            description = "The client's name for this request: sent again under it, it is answered with the batch that it made"),
        ("traceparent" = Option<String>, Header, description = "The trace (W3C) that the jobs go on with",
            example = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"),
        ("X-Request-Id" = Option<String>, Header, example = "build-17/step-2", description = "Stands in the logs beside everything that its jobs do")),
    request_body(description = "A form, or a batch of uploads alone", content(
        (BatchForm = "multipart/form-data", encoding(("batch" = (content_type = "application/json"))), examples(
            ("two" = (summary = "Two models with the same options", value = json!(examples::batch_form()))))),
        (BatchRequest = "application/json", example = json!(examples::new_batch())))),
    responses(
        (status = 200, description = "With `validate_only`: what it would be. Known by its key: the batch, which has ended", body = BatchAnswer,
            example = json!(examples::batch())),
        (status = 202, description = "Stored", body = Batch,
            headers(("Location" = String, description = "The batch"), ("Retry-After" = u32, description = "Seconds"),
                ("Idempotency-Replayed" = Option<String>, description = "`true`: the request was known by its key")),
            example = json!(examples::batch())),
        (status = 400, description = "A malformed request", body = Problem, content_type = "application/problem+json"),
        (status = 408, description = "The upload stood still", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "A limit is exceeded", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "Neither a form nor JSON", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Items cannot be taken: each pointer begins with `/items/` and the item's place", body = Problem,
            content_type = "application/problem+json", example = json!(examples::invalid_batch())),
        (status = 429, description = "A quota of the key has no room for all items", body = Problem,
            content_type = "application/problem+json", headers(("Retry-After" = u32, description = "Seconds"))),
        (status = 503, description = "The queue has no room for all items", body = Problem, content_type = "application/problem+json",
            headers(("Retry-After" = u32, description = "Seconds")))))]
pub(super) async fn submit(State(app): State<App>, request: Request) -> HandlerResult {
    let later = |problem: Problem| match problem.code {
        Code::QueueFull | Code::QuotaExceeded => Problem { retry_after: Some(app.jobs.seconds_until(1)), ..problem },
        _ => problem,
    };
    let new = match batch_request::receive(&app, request).await.map_err(later)? {
        ReceivedBatch::New(new) => new,
        ReceivedBatch::Valid(items) => return Ok(Json(BatchValidation { valid: true, items }).into_response()),
    };
    let jobs = app.jobs.clone();
    // A task of its own: a client that goes away now does not stop it half-way.
    let stored = tokio::spawn(async move { jobs.submit_batch(new).await }.in_current_span()).await;
    let stored = stored.map_err(|e| Failure::internal(format!("the batch was lost: {e}")))?;
    let (batch, known) = stored.map_err(|failure| later(failure.into()))?;
    let location = HeaderValue::from_str(&format!("/v1/batches/{}", batch.id))
        .map_err(|e| Failure::internal(format!("an id cannot stand in a header: {e}")))?;
    let (done, retry_after) = (batch.state.is_final(), retry_after(&app, &batch));
    let status = if done && known { StatusCode::OK } else { StatusCode::ACCEPTED };
    let mut response = (status, Json(batch)).into_response();
    let headers = response.headers_mut();
    headers.insert(header::LOCATION, location);
    if !done {
        headers.insert(header::RETRY_AFTER, retry_after);
    }
    if known {
        headers.insert("idempotency-replayed", HeaderValue::from_static("true"));
    }
    Ok(response)
}

/// A batch: how many of its jobs are where, and each of them.
#[utoipa::path(get, path = "/v1/batches/{id}", tag = "batches", operation_id = "read_batch",
    params(BatchPath,
        ("Prefer" = Option<String>, Header, example = "wait=10",
            description = "`wait=N`: answer when all jobs are final, after N seconds at the latest"),
        ("If-None-Match" = Option<String>, Header, description = "ETags that the client has")),
    responses(
        (status = 200, description = "As it is now", body = Batch, headers(("ETag" = String, description = "Of this answer"),
            ("Retry-After" = u32, description = "Seconds; until all jobs are final")), example = json!(examples::batch())),
        (status = 304, description = "Nothing has changed"),
        (status = 404, description = "No such batch", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn read(State(app): State<App>, Path(id): Path<String>, headers: HeaderMap) -> HandlerResult {
    let wait = prefer::wait(&headers);
    let batch = match wait {
        Some(wait) => app.jobs.wait_until_batch_is_final(&id, wait).await?,
        None => app.jobs.batch(&id).await?,
    };
    polled(&headers, &batch, (!batch.state.is_final()).then(|| retry_after(&app, &batch)), wait)
}

/// Cancels all jobs of a batch that have not ended: at once those that wait, soon those that run.
#[utoipa::path(post, path = "/v1/batches/{id}/cancel", tag = "batches", operation_id = "cancel_batch", params(BatchPath), responses(
    (status = 202, description = "They will stop, or have", body = Batch, example = json!(examples::batch())),
    (status = 404, description = "No such batch", body = Problem, content_type = "application/problem+json"),
    (status = 409, description = "All have ended", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn cancel(State(app): State<App>, Path(id): Path<String>) -> HandlerResult<(StatusCode, Json<Batch>)> {
    Ok((StatusCode::ACCEPTED, Json(app.jobs.cancel_batch(&id).await?)))
}

/// Deletes a batch with the jobs that it made, and their files; cancels those that run. Jobs that were there before it, by their keys, stay.
#[utoipa::path(delete, path = "/v1/batches/{id}", tag = "batches", operation_id = "delete_batch", params(BatchPath), responses(
    (status = 204, description = "It is gone"),
    (status = 404, description = "No such batch", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn delete(State(app): State<App>, Path(id): Path<String>) -> HandlerResult<StatusCode> {
    app.jobs.delete_batch(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}
