//! The trace of a request: it goes on with the one that its client began, or begins here.

use std::time::SystemTime;

use axum::extract::{MatchedPath, Request, State};
use axum::http::Method;
use axum::middleware::Next;
use axum::response::Response;

use super::App;
use crate::jobs::trace::{Span, SpanKind, TRACEPARENT, TraceContext};

/// The span of a request, with whether its client named the one before.
#[derive(Debug, Clone, Copy)]
pub(super) struct RequestTrace {
    /// The span of the request itself.
    pub(super) context: TraceContext,
    parent: Option<[u8; 8]>,
}

/// Gives a request its [`RequestTrace`].
pub(super) async fn begin(mut request: Request, next: Next) -> Response {
    let given = request.headers().get(TRACEPARENT).and_then(|v| TraceContext::parse(v.to_str().ok()?));
    let context = given.map_or_else(TraceContext::root, TraceContext::child);
    request.extensions_mut().insert(RequestTrace { context, parent: given.map(|given| given.span) });
    next.run(request).await
}

/// The traceparent for what a request brings.
pub(super) fn of(request: &Request) -> Option<String> {
    request.extensions().get::<RequestTrace>().map(|trace| trace.context.to_string())
}

/// Tells of the span of a request: one that changes something, or whose client traces it. What only asks again and again would drown the rest.
pub(super) async fn tell(State(app): State<App>, route: Option<MatchedPath>, request: Request, next: Next) -> Response {
    let trace = request.extensions().get::<RequestTrace>().copied();
    let reads = matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
    let Some(trace) = trace.filter(|trace| trace.parent.is_some() || !reads) else { return next.run(request).await };
    let (start, method) = (SystemTime::now(), request.method().as_str().chars().take(20).collect::<String>());
    let response = next.run(request).await;
    let route = route.as_ref().map_or("other", MatchedPath::as_str);
    let status = response.status();
    let span = || Span {
        name: format!("{method} {route}"),
        kind: SpanKind::Server,
        context: trace.context,
        parent: trace.parent,
        start,
        end: SystemTime::now(),
        attributes: vec![
            ("http.request.method", method.clone()),
            ("http.route", route.to_owned()),
            ("http.response.status_code", status.as_str().to_owned()),
        ],
        error: status.is_server_error().then(|| status.to_string()),
    };
    app.jobs.telemetry.spans.tell(span, trace.context);
    response
}
