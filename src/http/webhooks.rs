//! `/v1/webhooks`: where a tenant is told that its jobs have ended.

use std::time::Duration;

use axum::extract::{Path, Query, Request, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::access::Caller;
use super::examples;
use super::jobs::JobPath;
use super::problem::{HandlerResult, Problem};
use super::{App, body};
use crate::error::Code;
use crate::jobs::record::{Timestamp, new_id};
use crate::jobs::webhooks::{Delivery, MAX_WEBHOOKS, Replayed, Webhook, WebhookEvent, new_secret};

/// How long the secret before still signs beside a new one.
const ROTATION: Duration = Duration::from_secs(24 * 3600);

/// A receiver to make.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewWebhook {
    /// Where to: https:// or http://, at an address of the open internet or one that the service allows.
    #[schema(max_length = 2048)]
    url: String,
    /// What it is told of; without them, everything.
    #[serde(default)]
    #[schema(required = false, max_items = 4)]
    events: Vec<WebhookEvent>,
}

/// The receivers of a tenant.
#[derive(Serialize, ToSchema)]
pub(super) struct WebhookList {
    /// The receivers, the newest first.
    webhooks: Vec<Webhook>,
    /// The secret of what is told to the `webhook` of a job; null where the service takes none.
    job_secret: Option<String>,
}

/// A receiver that was made just now.
#[derive(Serialize, ToSchema)]
pub(super) struct MadeWebhook {
    /// The receiver.
    webhook: Webhook,
    /// With it, the receiver checks what it is told (`whsec_…`). It is told this once.
    secret: String,
}

/// A secret that was made just now.
#[derive(Serialize, ToSchema)]
pub(super) struct NewSecret {
    /// The secret. It is told this once.
    secret: String,
    /// Until then deliveries are signed with the one before too.
    previous_until: Timestamp,
}

/// A page of deliveries, the newest first.
#[derive(Serialize, ToSchema)]
pub(super) struct DeliveryPage {
    /// The deliveries.
    deliveries: Vec<Delivery>,
    /// Cursor of the next page; null at the end.
    next: Option<i64>,
}

/// Which deliveries are wanted.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct DeliveryQuery {
    /// From the page before: its `next`.
    cursor: Option<i64>,
    /// Deliveries on a page, 1..=200; 50 without it.
    #[param(minimum = 1, maximum = 200)]
    limit: Option<u32>,
}

/// Which receiver is meant.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "describes the path in the OpenAPI document")]
struct WebhookPath {
    /// Id of the receiver.
    #[param(example = "51c7a9d0e3b84f6298d1f0a7b3c5e2d4")]
    id: String,
}

/// The tenant that calls. Without keys there are none: whoever made a receiver would be told of everybody's jobs.
fn tenant(caller: &Caller) -> HandlerResult<&str> {
    caller.tenant_if_any().ok_or_else(|| {
        let detail = "this service keeps no receivers: it was started without `--auth keys`; the option `webhook` of a job names one for that job";
        Problem::new(Code::NotFound, detail)
    })
}

fn unknown() -> Problem {
    Problem::new(Code::NotFound, "there is no such receiver")
}

/// Lists the receivers of the key's tenant.
#[utoipa::path(get, path = "/v1/webhooks", tag = "webhooks", operation_id = "list_webhooks", responses(
    (status = 200, description = "All of them", body = WebhookList, example = json!(examples::webhooks())),
    (status = 404, description = "The service has no keys", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list(State(app): State<App>, Extension(caller): Extension<Caller>) -> HandlerResult {
    let tenant = tenant(&caller)?;
    let webhooks = app.jobs.webhooks.store.webhooks(tenant).await?;
    let list = WebhookList { webhooks, job_secret: app.jobs.webhooks.job_secret(tenant) };
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(list)).into_response())
}

/// Makes a receiver. Its secret is in this answer and in no later one.
#[utoipa::path(post, path = "/v1/webhooks", tag = "webhooks", operation_id = "create_webhook",
    request_body(content = NewWebhook, example = json!(examples::new_webhook())),
    responses(
        (status = 201, description = "The receiver and its secret", body = MadeWebhook, example = json!(examples::made_webhook())),
        (status = 404, description = "The service has no keys", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The tenant has as many as it may", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Such a receiver cannot be", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> HandlerResult {
    let tenant = tenant(&caller)?;
    let NewWebhook { url, mut events } = body::json(&app, request).await?;
    app.jobs.webhooks.check_url(&url)?;
    events.sort_unstable();
    events.dedup();
    if events.is_empty() {
        events = WebhookEvent::ALL.to_vec();
    }
    let created_at = app.jobs.webhooks.store.time().await?;
    let webhook = Webhook { id: new_id()?, url, events, created_at, disabled_at: None, disabled_because: None };
    let secret = new_secret()?;
    if !app.jobs.webhooks.store.add_webhook(tenant, &webhook, &secret).await? {
        let detail = format!("a tenant has at most {MAX_WEBHOOKS} receivers; delete one that is not needed");
        return Err(Problem::new(Code::Conflict, detail));
    }
    let headers = [(header::CACHE_CONTROL, "no-store")];
    Ok((StatusCode::CREATED, headers, Json(MadeWebhook { webhook, secret })).into_response())
}

/// Removes a receiver, and what it has not been told.
#[utoipa::path(delete, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "delete_webhook", params(WebhookPath), responses(
    (status = 204, description = "It is gone"),
    (status = 404, description = "No such receiver", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn delete(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
) -> HandlerResult<StatusCode> {
    match app.jobs.webhooks.store.remove_webhook(tenant(&caller)?, &id).await? {
        true => Ok(StatusCode::NO_CONTENT),
        false => Err(unknown()),
    }
}

/// Gives a receiver a new secret. For a day deliveries are signed with the one before too, so that none is refused meanwhile.
#[utoipa::path(post, path = "/v1/webhooks/{id}/secrets", tag = "webhooks", operation_id = "rotate_webhook_secret", params(WebhookPath), responses(
    (status = 201, description = "The new secret", body = NewSecret, example = json!(examples::new_secret())),
    (status = 404, description = "No such receiver", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn rotate(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
) -> HandlerResult {
    let (secret, previous_until) = (new_secret()?, app.jobs.webhooks.store.time().await?.plus(ROTATION));
    if !app.jobs.webhooks.store.rotate_secret(tenant(&caller)?, &id, &secret, previous_until).await? {
        return Err(unknown());
    }
    let headers = [(header::CACHE_CONTROL, "no-store")];
    Ok((StatusCode::CREATED, headers, Json(NewSecret { secret, previous_until })).into_response())
}

/// What a receiver was and is to be told, with what it answered.
#[utoipa::path(get, path = "/v1/webhooks/{id}/deliveries", tag = "webhooks", operation_id = "list_deliveries", params(WebhookPath, DeliveryQuery), responses(
    (status = 200, description = "A page of them", body = DeliveryPage, example = json!(examples::deliveries())),
    (status = 400, description = "A malformed query", body = Problem, content_type = "application/problem+json"),
    (status = 404, description = "No such receiver", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn deliveries(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    Path(id): Path<String>,
    query: Result<Query<DeliveryQuery>, axum::extract::rejection::QueryRejection>,
) -> HandlerResult {
    let tenant = tenant(&caller)?;
    let Query(query) = query.map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))?;
    let limit = super::jobs::page_limit(query.limit)?;
    let page = app.jobs.webhooks.store.deliveries(tenant, &id, query.cursor, limit).await?;
    let (deliveries, next) = page.ok_or_else(unknown)?;
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(DeliveryPage { deliveries, next })).into_response())
}

/// What was and is to be told of a job: to the `webhook` of its options, and to receivers of its tenant.
#[utoipa::path(get, path = "/v1/jobs/{id}/deliveries", tag = "webhooks", operation_id = "list_job_deliveries", params(JobPath, DeliveryQuery), responses(
    (status = 200, description = "A page of them", body = DeliveryPage, example = json!(examples::job_deliveries())),
    (status = 400, description = "A malformed query", body = Problem, content_type = "application/problem+json"),
    (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn of_job(
    State(app): State<App>,
    Path(id): Path<String>,
    query: Result<Query<DeliveryQuery>, axum::extract::rejection::QueryRejection>,
) -> HandlerResult {
    let Query(query) = query.map_err(|e| Problem::new(Code::InvalidRequest, e.body_text()))?;
    let limit = super::jobs::page_limit(query.limit)?;
    app.jobs.queue.tenant_of(&id).await?.ok_or_else(|| crate::jobs::unknown(&id))?;
    let (deliveries, next) = app.jobs.webhooks.store.job_deliveries(&id, query.cursor, limit).await?;
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(DeliveryPage { deliveries, next })).into_response())
}

/// Tells something of a job once more, under the same id.
#[utoipa::path(post, path = "/v1/jobs/{id}/deliveries/{delivery}/replay", tag = "webhooks", operation_id = "replay_job_delivery",
    params(JobPath, ("delivery" = String, Path, description = "Id of the delivery", example = "msg_0f5a9b7c2d4e6180a3c5e7f9b1d30426")),
    responses(
        (status = 202, description = "It is told now"),
        (status = 404, description = "No such job or delivery", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "It went to a receiver that is disabled", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn replay_of_job(
    State(app): State<App>,
    Path((id, delivery)): Path<(String, String)>,
) -> HandlerResult<StatusCode> {
    app.jobs.queue.tenant_of(&id).await?.ok_or_else(|| crate::jobs::unknown(&id))?;
    let store = &app.jobs.webhooks.store;
    replayed(store.replay_of_job(&id, &delivery, store.time().await?).await?)
}

fn replayed(replayed: Replayed) -> HandlerResult<StatusCode> {
    match replayed {
        Replayed::Yes => Ok(StatusCode::ACCEPTED),
        Replayed::Unknown => Err(Problem::new(Code::NotFound, "there is no such delivery")),
        Replayed::Disabled => {
            let detail = "the receiver is disabled, because it answered 410; delete it and make it again";
            Err(Problem::new(Code::Conflict, detail))
        }
    }
}

/// Tells a receiver something once more, under the same id.
#[utoipa::path(post, path = "/v1/webhooks/{id}/deliveries/{delivery}/replay", tag = "webhooks", operation_id = "replay_delivery",
    params(WebhookPath, ("delivery" = String, Path, description = "Id of the delivery", example = "msg_0f5a9b7c2d4e6180a3c5e7f9b1d30426")),
    responses(
        (status = 202, description = "It is told now"),
        (status = 404, description = "No such delivery", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "The receiver is disabled", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn replay(
    State(app): State<App>,
    Extension(caller): Extension<Caller>,
    Path((id, delivery)): Path<(String, String)>,
) -> HandlerResult<StatusCode> {
    let store = &app.jobs.webhooks.store;
    replayed(store.replay(tenant(&caller)?, &id, &delivery, store.time().await?).await?)
}
