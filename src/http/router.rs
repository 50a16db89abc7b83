//! All routes, and what surrounds every one of them.

use std::panic::AssertUnwindSafe;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{DefaultBodyLimit, MatchedPath, Request, State};
use axum::http::{Extensions, HeaderMap, HeaderName, Method, StatusCode, Version, header};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use futures_util::FutureExt;
use tower_http::compression::CompressionLayer;
use tower_http::cors::{AllowOrigin, Any, CorsLayer};
use tower_http::request_id::{MakeRequestUuid, PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::trace::{DefaultOnFailure, DefaultOnResponse, TraceLayer};
use tracing::Level;
use utoipa::openapi::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::problem::Problem;
use super::sites::{self, Sites};
use super::{
    App, access, artifacts, batches, document, events, health, jobs, keys, page, recipes, resumable, trace, tus,
    webhooks,
};
use crate::config::Role;
use crate::error::Code;
use crate::jobs::trace::TRACEPARENT;

/// How long a browser remembers what a page may send: the most that browsers take.
const PREFLIGHT_AGE: Duration = Duration::from_secs(7200);

/// The routes of a process that takes jobs.
fn all_routes() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(document::head())
        .routes(routes!(jobs::submit, jobs::list))
        .routes(routes!(jobs::read, jobs::delete))
        .routes(routes!(jobs::cancel))
        .routes(routes!(webhooks::of_job))
        .routes(routes!(webhooks::replay_of_job))
        .routes(routes!(events::follow))
        .routes(routes!(artifacts::report))
        .routes(routes!(artifacts::fetch))
        .routes(routes!(batches::submit))
        .routes(routes!(batches::read, batches::delete))
        .routes(routes!(batches::cancel))
        .routes(routes!(resumable::create))
        .routes(routes!(resumable::read, resumable::append, resumable::remove))
        .routes(routes!(keys::list, keys::create))
        .routes(routes!(keys::revoke))
        .routes(routes!(webhooks::list, webhooks::create))
        .routes(routes!(webhooks::delete))
        .routes(routes!(webhooks::rotate))
        .routes(routes!(webhooks::deliveries))
        .routes(routes!(webhooks::replay))
        .routes(routes!(recipes::recipes))
        .routes(routes!(recipes::limits))
        .merge(service_routes())
}

/// The routes of every process.
fn service_routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(health::alive))
        .routes(routes!(health::ready))
        .routes(routes!(health::metrics))
        .routes(routes!(health::contract))
        .routes(routes!(page::index))
        .routes(routes!(page::part))
}

/// The service, for the pages and under the names of `sites`; that of a worker takes no jobs.
pub fn router(app: App, sites: Sites, role: Role) -> Router {
    let routes = if role == Role::Worker { service_routes() } else { all_routes() };
    let (router, _) = routes.split_for_parts();
    let request_id = HeaderName::from_static("x-request-id");
    let mut router = router
        .fallback(|| async { Problem::new(Code::NotFound, "there is no such route; /openapi.json lists all") })
        .method_not_allowed_fallback(|| async {
            Problem::new(
                Code::InvalidRequest,
                "this route does not know the method; the header Allow lists those that it knows",
            )
            .with_status(StatusCode::METHOD_NOT_ALLOWED)
        })
        // Uploads have a limit of their own, counted while they stream to the disk.
        .layer(DefaultBodyLimit::disable())
        .layer(from_fn_with_state(app.clone(), access::check))
        .layer(from_fn(catch_panics))
        .layer(from_fn_with_state(app.clone(), record_response))
        .layer(from_fn_with_state(app.clone(), trace::tell))
        .layer(CompressionLayer::new().compress_when(is_compressible));
    if sites.origins().is_none_or(|origins| !origins.is_empty()) {
        router = router.layer(cors(&sites));
    }
    let lines = TraceLayer::new_for_http()
        .make_span_with(|request: &Request| {
            let id = request.headers().get("x-request-id").and_then(|v| v.to_str().ok()).unwrap_or_default();
            let id: String = id.chars().take(100).collect();
            let context = request.extensions().get::<trace::RequestTrace>().map(|trace| trace.context);
            tracing::info_span!(
                "request",
                method = %request.method(),
                path = request.uri().path(),
                id,
                trace_id = context.map(|context| context.trace_id()),
                span_id = context.map(|context| context.span_id())
            )
        })
        .on_response(DefaultOnResponse::new().level(Level::DEBUG))
        // What fails says so itself, and the machine's troubles are told once.
        .on_failure(DefaultOnFailure::new().level(Level::DEBUG));
    router
        .layer(from_fn_with_state(app.clone(), tus::protocol))
        .layer(from_fn_with_state(sites, sites::check))
        .layer(PropagateRequestIdLayer::new(request_id.clone()))
        .layer(lines)
        .layer(from_fn(trace::begin))
        .layer(SetRequestIdLayer::new(request_id, MakeRequestUuid))
        .with_state(app)
}

/// The OpenAPI document.
pub fn openapi() -> OpenApi {
    document::complete(all_routes().into_openapi())
}

/// The OpenAPI document as it stands in `api/openapi.json`.
pub fn openapi_text() -> String {
    let mut text = serde_json::to_string_pretty(&openapi()).unwrap_or_default();
    text.push('\n');
    text
}

fn cors(sites: &Sites) -> CorsLayer {
    let allowed =
        sites.origins().map_or_else(|| AllowOrigin::from(Any), |origins| AllowOrigin::list(origins.iter().cloned()));
    CorsLayer::new()
        .allow_origin(allowed)
        .max_age(PREFLIGHT_AGE)
        .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::PATCH, Method::DELETE])
        .allow_headers(
            [
                header::AUTHORIZATION,
                header::CONTENT_TYPE,
                header::IF_NONE_MATCH,
                header::IF_RANGE,
                header::RANGE,
                HeaderName::from_static("last-event-id"),
                HeaderName::from_static("prefer"),
                HeaderName::from_static("idempotency-key"),
                HeaderName::from_static(TRACEPARENT),
                HeaderName::from_static("tracestate"),
                HeaderName::from_static("x-request-id"),
            ]
            .into_iter()
            .chain(tus::REQUEST_HEADERS)
            .collect::<Vec<_>>(),
        )
        .expose_headers(
            [
                header::LOCATION,
                header::RETRY_AFTER,
                header::ETAG,
                header::CONTENT_DISPOSITION,
                header::CONTENT_RANGE,
                header::ACCEPT_RANGES,
                header::WWW_AUTHENTICATE,
                HeaderName::from_static("ratelimit-limit"),
                HeaderName::from_static("ratelimit-policy"),
                HeaderName::from_static("ratelimit-remaining"),
                HeaderName::from_static("ratelimit-reset"),
                HeaderName::from_static("preference-applied"),
                HeaderName::from_static("idempotency-replayed"),
                HeaderName::from_static("result-reused"),
                HeaderName::from_static("x-request-id"),
            ]
            .into_iter()
            .chain(tus::RESPONSE_HEADERS)
            .collect::<Vec<_>>(),
        )
}

/// Whether a response is compressed where the client takes that: JSON and metrics, not streams, nor artifacts, of which ranges can be
/// asked for.
fn is_compressible(_: StatusCode, _: Version, headers: &HeaderMap, _: &Extensions) -> bool {
    let media_type = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let media_type = media_type.split(';').next().unwrap_or_default();
    matches!(media_type, "application/json" | "application/problem+json" | "text/plain")
        && !headers.contains_key(header::ACCEPT_RANGES)
}

/// Counts a response.
async fn record_response(State(app): State<App>, route: Option<MatchedPath>, request: Request, next: Next) -> Response {
    let (started, method) = (Instant::now(), request.method().clone());
    let response = next.run(request).await;
    // Methods that nobody defined are one.
    let method = match method {
        Method::GET | Method::POST | Method::DELETE | Method::HEAD | Method::OPTIONS | Method::PUT | Method::PATCH => {
            method
        }
        _ => Method::TRACE,
    };
    let route = route.as_ref().map_or("other", MatchedPath::as_str);
    app.jobs.telemetry.record_response(method.as_str(), route, response.status().as_u16(), started.elapsed());
    response
}

/// A panic in a handler is answered, and ends that request only.
async fn catch_panics(request: Request, next: Next) -> Response {
    match AssertUnwindSafe(next.run(request)).catch_unwind().await {
        Ok(response) => response,
        Err(_) => {
            tracing::error!("a handler panicked");
            Problem::new(Code::Internal, "Intarsia failed on this request; the fault is ours").into_response()
        }
    }
}
