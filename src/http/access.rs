//! Who calls, and what it may do: the one place where a request is held against its key.
//!
//! A route is closed unless it is listed as open here, so that one that is added later is not open by accident. A tenant's key reaches the
//! jobs of its tenant: for another's, the answer is that of a job that there is not.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{ConnectInfo, MatchedPath, RawPathParams, Request, State};
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use futures_util::stream::try_unfold;
use tokio::time::timeout;

use super::App;
use super::problem::{Challenge, HandlerResult, Problem};
use super::upload::DrainOnDrop;
use crate::config::{Auth, Quotas, Scope};
use crate::error::{Code, Result};
use crate::jobs::batches::unknown_batch;
use crate::jobs::keys::{Key, hash};
use crate::jobs::resumable::unknown_upload;
use crate::jobs::unknown;

/// How often the key of a request that takes longer is looked at again.
const RECHECK: Duration = Duration::from_millis(500);

/// Whoever sends a request.
#[derive(Debug, Clone)]
pub(super) struct Caller {
    key: Option<Key>,
    address: IpAddr,
}

/// What counts as one client.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Client {
    /// All with one address, or of one network.
    Address(IpAddr),
    /// All keys of a tenant.
    Tenant(String),
    /// One key.
    Key(String),
    /// All that are not told apart.
    Other,
}

impl Client {
    /// One client has many addresses of IPv6: those of one network of 64 bits are one.
    pub(super) fn of(address: IpAddr) -> Self {
        Client::Address(match address.to_canonical() {
            IpAddr::V6(address) => IpAddr::V6((address.to_bits() >> 64 << 64).into()),
            address => address,
        })
    }
}

impl Caller {
    /// Its tenant; empty where the service knows no tenants.
    pub(super) fn tenant(&self) -> &str {
        self.key.as_ref().map_or("", |key| &key.tenant)
    }

    /// Its tenant, where the service knows tenants.
    pub(super) fn tenant_if_any(&self) -> Option<&str> {
        self.key.as_ref().map(|key| key.tenant.as_str())
    }

    /// What its tenant may have.
    pub(super) fn quotas(&self) -> Quotas {
        self.key.as_ref().map(|key| key.quotas.clone()).unwrap_or_default()
    }

    /// Who it is among those that upload.
    pub(super) fn client(&self) -> Client {
        self.key.as_ref().map_or(Client::of(self.address), |key| Client::Tenant(key.tenant.clone()))
    }
}

/// What a request needs: `None` where anybody may send it.
fn needed(method: &Method, route: Option<&str>) -> Option<Scope> {
    let reads = matches!(*method, Method::GET | Method::HEAD);
    match route? {
        "/metrics" => Some(Scope::Admin),
        "/v1/recipes" | "/v1/limits" => None,
        route if !route.starts_with("/v1/") => None,
        route if route == "/v1/jobs" || route.starts_with("/v1/jobs/") => {
            Some(if reads { Scope::Read } else { Scope::Submit })
        }
        route if route == "/v1/batches" || route.starts_with("/v1/batches/") => {
            Some(if reads { Scope::Read } else { Scope::Submit })
        }
        // Who sends pieces must be able to ask how far they are.
        route if route == "/v1/uploads" || route.starts_with("/v1/uploads/") => Some(Scope::Submit),
        // Their answers hold secrets.
        route if route == "/v1/webhooks" || route.starts_with("/v1/webhooks/") => Some(Scope::Submit),
        _ => Some(Scope::Admin),
    }
}

/// Lets a request through whose key allows it, and puts its [`Caller`] among its extensions.
pub(super) async fn check(
    State(app): State<App>,
    route: Option<MatchedPath>,
    parameters: std::result::Result<RawPathParams, RawPathParamsRejection>,
    request: Request,
    next: Next,
) -> Response {
    let route = route.as_ref().map(MatchedPath::as_str);
    let address =
        request.extensions().get::<ConnectInfo<SocketAddr>>().map_or(Ipv4Addr::UNSPECIFIED.into(), |c| c.0.ip());
    let keys = app.access.auth == Auth::Keys;
    let needed = needed(request.method(), route).filter(|_| keys);
    let token = if keys { bearer(request.headers()) } else { None };
    let known = match &token {
        Some(token) => app.jobs.keys.key_of(&hash(token)).await,
        None => Ok(None),
    };
    let key = match known {
        Ok(key) => key,
        // What anybody may ask is answered without the keys.
        Err(_) if needed.is_none() => None,
        Err(failure) => return refused(failure.into(), request),
    };
    let caller = Caller { key, address };
    // Probes are not counted.
    let counted = !matches!(route, Some("/healthz" | "/readyz"));
    let allowance = allowance(&app, &caller).filter(|_| counted);
    let answer = async {
        if let Some(wait) = allowance.as_ref().and_then(|allowance| allowance.wait) {
            let detail = format!("more requests came than are allowed in a minute; the next one is taken in {wait} s");
            return refused(Problem { retry_after: Some(wait), ..Problem::new(Code::RateLimited, detail) }, request);
        }
        let allowed = match needed {
            Some(scope) => permit(&app, &caller, scope, token.is_some(), route, parameters.as_ref().ok()).await,
            None => Ok(()),
        };
        match allowed {
            Ok(()) => watched(&app, caller, token.as_deref().map(hash), request, next).await,
            Err(problem) => refused(problem, request),
        }
    };
    let mut response = answer.await;
    if let Some(allowance) = allowance {
        allowance.tell(response.headers_mut());
    }
    response
}

/// The answer to a client that may still be sending.
fn refused(problem: Problem, request: Request) -> Response {
    drop(DrainOnDrop(Some(request.into_body().into_data_stream())));
    problem.into_response()
}

/// The token of a request (RFC 6750, section 2.1).
fn bearer(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::AUTHORIZATION)?.to_str().unwrap_or_default();
    let token = value.split_once(' ').filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"));
    // One that is malformed is no valid one.
    Some(token.map_or("", |(_, token)| token.trim()).to_owned())
}

/// Counts the request, where its client may not send any number.
fn allowance(app: &App, caller: &Caller) -> Option<super::rate_limit::Allowance> {
    let (client, own) = match &caller.key {
        Some(key) => (Client::Key(key.id.clone()), key.quotas.rate_limit),
        None => (Client::of(caller.address), None),
    };
    Some(app.rates.count(client, own.or(app.access.rate_limit)?, Instant::now()))
}

/// Whether a caller may do what needs `scope`, with what the path names.
async fn permit(
    app: &App,
    caller: &Caller,
    scope: Scope,
    tried: bool,
    route: Option<&str>,
    parameters: Option<&RawPathParams>,
) -> HandlerResult<()> {
    let Some(key) = &caller.key else { return Err(unauthorized(tried)) };
    if !key.scopes.contains(&scope) {
        let detail = format!("this needs a key with the scope `{}`, which this one does not have", scope.as_str());
        return Err(Problem { challenge: Some(Challenge::Scope(scope)), ..Problem::new(Code::Forbidden, detail) });
    }
    let id = parameters.into_iter().flatten().find(|(name, _)| *name == "id").map_or("", |(_, id)| id);
    let of = |prefix: &str| route.is_some_and(|route| route.starts_with(prefix));
    let (owner, unknown) = if of("/v1/jobs/") {
        (app.jobs.queue.tenant_of(id).await?, unknown(id))
    } else if of("/v1/batches/") {
        (app.jobs.batches.tenant_of_batch(id).await?, unknown_batch(id))
    } else if of("/v1/uploads/") {
        (app.jobs.resumable.tenant_of(id).await?, unknown_upload(id))
    } else {
        return Ok(());
    };
    if owner.as_deref() == Some(key.tenant.as_str()) { Ok(()) } else { Err(unknown.into()) }
}

fn unauthorized(tried: bool) -> Problem {
    let (detail, challenge) = if tried {
        ("the API key is not known, or was revoked", Challenge::Invalid)
    } else {
        let detail = "this service needs an API key: send it as `Authorization: Bearer …`; its administrator makes one";
        (detail, Challenge::Missing)
    };
    Problem { challenge: Some(challenge), ..Problem::new(Code::Unauthorized, detail) }
}

/// Answers a request, for as long as its key holds: what is still coming in or going out ends with it.
async fn watched(app: &App, caller: Caller, hash: Option<String>, mut request: Request, next: Next) -> Response {
    let hash = hash.filter(|_| caller.key.is_some());
    request.extensions_mut().insert(caller);
    let Some(hash) = hash else { return next.run(request).await };
    let watch = Watch { app: app.clone(), hash, looked: Instant::now() };
    let mut after = watch.clone();
    let response = next.run(request.map(|body| guarded(body, watch))).await;
    if !after.holds().await {
        return unauthorized(true).into_response();
    }
    // What has a length is here already.
    if response.body().size_hint().exact().is_some() { response } else { response.map(|body| guarded(body, after)) }
}

/// Looks at a key again from time to time.
#[derive(Clone)]
struct Watch {
    app: App,
    hash: String,
    looked: Instant,
}

impl Watch {
    /// Whether the key still holds, as of some moments ago.
    async fn holds(&mut self) -> bool {
        if self.looked.elapsed() < RECHECK {
            return true;
        }
        self.looked = Instant::now();
        // Where the keys cannot be read for a moment, nothing ends.
        let found: Result<Option<Key>> = self.app.jobs.keys.key_of(&self.hash).await;
        !matches!(found, Ok(None))
    }
}

/// The body, which breaks off when the key is revoked, also while nothing comes.
fn guarded(body: Body, watch: Watch) -> Body {
    Body::from_stream(try_unfold((body.into_data_stream(), watch), |(mut body, mut watch)| async move {
        loop {
            let next: std::result::Result<Option<std::result::Result<Bytes, axum::Error>>, _> =
                timeout(RECHECK, body.next()).await;
            if !watch.holds().await {
                return Err(axum::Error::new("the API key was revoked"));
            }
            if let Ok(chunk) = next {
                return Ok(chunk.transpose()?.map(|chunk| (chunk, (body, watch))));
            }
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_route_that_nobody_thought_of_is_closed() {
        let of = |method: Method, route| needed(&method, Some(route));
        assert_eq!(of(Method::GET, "/v1/something/{id}"), Some(Scope::Admin));
        assert_eq!(of(Method::GET, "/v1/jobsandmore"), Some(Scope::Admin));
        assert_eq!(of(Method::GET, "/v1/jobs/{id}/artifacts/{name}"), Some(Scope::Read));
        assert_eq!(of(Method::HEAD, "/v1/jobs/{id}"), Some(Scope::Read));
        assert_eq!(of(Method::PUT, "/v1/jobs/{id}"), Some(Scope::Submit));
        assert_eq!(of(Method::GET, "/metrics"), Some(Scope::Admin));
        for open in ["/", "/healthz", "/readyz", "/openapi.json", "/v1/recipes", "/v1/limits"] {
            assert_eq!(of(Method::GET, open), None, "{open}");
        }
        assert_eq!(needed(&Method::GET, None), None, "there is nothing there");
    }

    #[test]
    fn tokens_are_read_from_their_header() {
        let of = |value: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::AUTHORIZATION, value.parse().unwrap());
            bearer(&headers)
        };
        assert_eq!(of("Bearer abc"), Some("abc".to_owned()));
        assert_eq!(of("bearer  abc "), Some("abc".to_owned()));
        for malformed in ["Basic abc", "abc", "", "Bearer"] {
            assert_eq!(of(malformed), Some(String::new()), "{malformed}");
        }
        assert_eq!(bearer(&HeaderMap::new()), None);
    }
}
