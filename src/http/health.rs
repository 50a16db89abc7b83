//! `/healthz`, `/readyz`, `/metrics`, `/openapi.json`.

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::Serialize;
use utoipa::ToSchema;

use super::App;
use super::examples;
use super::problem::{HandlerResult, Problem};
use crate::error::Code;

/// That the service is there.
#[derive(Serialize, ToSchema)]
pub(super) struct Health {
    /// `ok`.
    status: &'static str,
    /// Version of Intarsia.
    version: &'static str,
}

const OK: Health = Health { status: "ok", version: env!("CARGO_PKG_VERSION") };

/// Alive: the process answers.
#[utoipa::path(get, path = "/healthz", tag = "service", responses(
    (status = 200, description = "It is there", body = Health, example = json!(examples::health()))))]
pub(super) async fn alive() -> Json<Health> {
    Json(OK)
}

/// Ready: the disk takes what is written, enough of it is free, the queue is what it was, and the service is not shutting down.
#[utoipa::path(get, path = "/readyz", tag = "service", responses(
    (status = 200, description = "It takes jobs", body = Health, example = json!(examples::health())),
    (status = 503, description = "Not now", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn ready(State(app): State<App>) -> HandlerResult<Json<Health>> {
    if app.jobs.shutdown.is_cancelled() {
        return Err(Problem::new(Code::Unavailable, "the service is shutting down"));
    }
    // A probe wants to know that it must not send anything: one status for every reason.
    app.jobs.ready().map_err(|why| Problem::from(why).with_status(StatusCode::SERVICE_UNAVAILABLE))?;
    Ok(Json(OK))
}

/// Figures for Prometheus.
#[utoipa::path(get, path = "/metrics", tag = "service", responses(
    (status = 200, description = "In the text format of Prometheus", content_type = "text/plain", body = String,
        example = "# TYPE intarsia_jobs_running gauge\nintarsia_jobs_running 0\n"),
    (status = 500, description = "The job queue does not answer", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn metrics(State(app): State<App>) -> HandlerResult {
    let queue = &app.jobs.queue;
    let (counts, since, now) = (queue.counts().await?, queue.waits_since().await?, queue.now().await?);
    let text = app.jobs.telemetry.text(&counts, since, now, app.jobs.slots.usage())?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
}

/// The OpenAPI document.
#[utoipa::path(get, path = "/openapi.json", tag = "service", responses(
    (status = 200, description = "This document", content_type = "application/json", body = serde_json::Map<String, serde_json::Value>,
        example = json!({"openapi": "3.1.0", "info": {"title": "Intarsia", "version": "0.1.0"}}))))]
pub(super) async fn contract() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], super::router::openapi_text())
}
