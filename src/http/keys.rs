//! `/v1/keys`: the API keys of all tenants, for who has the scope `admin`.

use axum::Json;
use axum::extract::{Path, Request, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::Serialize;
use utoipa::ToSchema;

use super::App;
use super::body;
use super::examples;
use super::problem::{HandlerResult, Problem};
use crate::config::Auth;
use crate::error::Code;
use crate::jobs::keys::{Key, NewKey, hash};

/// All keys.
#[derive(Serialize, ToSchema)]
pub(super) struct KeyList {
    /// The keys, the newest first; also those that were revoked.
    keys: Vec<Key>,
}

/// A key that was made just now.
#[derive(Serialize, ToSchema)]
pub(super) struct MadeKey {
    /// The key.
    key: Key,
    /// What its owner sends as `Authorization: Bearer …`. It is told this once: only its hash is kept.
    token: String,
}

/// Where there are no keys, nobody could be asked for one.
fn with_keys(app: &App) -> HandlerResult<()> {
    match app.access.auth {
        Auth::Keys => Ok(()),
        Auth::None => {
            let detail = "this service has no API keys: it was started without `--auth keys`";
            Err(Problem::new(Code::NotFound, detail))
        }
    }
}

/// Lists the keys of all tenants; no token is told.
#[utoipa::path(get, path = "/v1/keys", tag = "keys", operation_id = "list_keys", responses(
    (status = 200, description = "All of them", body = KeyList, example = json!(examples::keys())),
    (status = 404, description = "The service has no keys", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list(State(app): State<App>) -> HandlerResult {
    with_keys(&app)?;
    let keys = app.jobs.keys.keys().await?;
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(KeyList { keys })).into_response())
}

/// Makes a key. Its token is in this answer and nowhere else.
#[utoipa::path(post, path = "/v1/keys", tag = "keys", operation_id = "create_key",
    request_body(content = NewKey, example = json!(examples::new_key())),
    responses(
        (status = 201, description = "The key and its token", body = MadeKey, example = json!(examples::made_key())),
        (status = 404, description = "The service has no keys", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Such a key cannot be", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn create(State(app): State<App>, request: Request) -> HandlerResult {
    with_keys(&app)?;
    let new: NewKey = body::json(&app, request).await?;
    let (key, token) = new.make()?;
    app.jobs.keys.add_key(&key, &hash(&token)).await?;
    tracing::info!(key = key.id, tenant = key.tenant, "an API key was made");
    let headers = [(header::CACHE_CONTROL, "no-store")];
    Ok((StatusCode::CREATED, headers, Json(MadeKey { key, token })).into_response())
}

/// Revokes a key: it stops within a second, and what is under way with it breaks off. Jobs that were submitted with it stay.
#[utoipa::path(delete, path = "/v1/keys/{id}", tag = "keys", operation_id = "revoke_key",
    params(("id" = String, Path, description = "Id of the key", example = "3b1f0a52c9d84e6f8a7d10c2b4e6f908")),
    responses(
        (status = 204, description = "It is worth nothing now"),
        (status = 404, description = "No such key, or it was revoked before", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn revoke(State(app): State<App>, Path(id): Path<String>) -> HandlerResult<StatusCode> {
    with_keys(&app)?;
    if !app.jobs.keys.revoke_key(&id).await? {
        return Err(Problem::new(Code::NotFound, "there is no valid key with this id"));
    }
    tracing::info!(key = id, "an API key was revoked");
    Ok(StatusCode::NO_CONTENT)
}
