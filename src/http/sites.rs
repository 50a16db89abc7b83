//! Which web pages may call the service, and by which names it is called.
//!
//! A browser sends a form or an upload to any address that a page names, without asking first, and a name of a stranger's can be made to
//! lead to this machine (DNS rebinding). So a cross-site `Origin` is refused unless it is allowed, and on loopback only known names are
//! answered.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::problem::Problem;
use super::upload::DrainOnDrop;
use crate::error::{Code, Failure, Result};

/// Who may call.
#[derive(Debug, Clone)]
pub struct Sites {
    origins: Arc<[HeaderValue]>,
    any_origin: bool,
    /// Names that are answered on loopback; `None` answers to all.
    hosts: Option<Arc<[String]>>,
}

impl Sites {
    /// Pages of `origins` (`*` is any) may call. Where the service listens on loopback, it answers to the names of this machine and to
    /// `hosts`; elsewhere to every name.
    ///
    /// # Errors
    /// `invalid_options` for an origin that no browser sends.
    pub fn new(origins: &[String], hosts: &[String], listen: SocketAddr) -> Result<Self> {
        let any_origin = origins.iter().any(|o| o == "*");
        let named = origins.iter().filter(|o| *o != "*").map(|o| origin(o)).collect::<Result<Vec<_>>>()?;
        let hosts = listen.ip().is_loopback().then(|| hosts.iter().map(|h| h.to_ascii_lowercase()).collect());
        Ok(Sites { origins: named.into(), any_origin, hosts })
    }

    /// The allowed origins; `None` for all.
    pub(super) fn origins(&self) -> Option<&[HeaderValue]> {
        (!self.any_origin).then_some(&self.origins)
    }

    fn knows_host(&self, host: &str) -> bool {
        let Some(hosts) = &self.hosts else { return true };
        let Ok(authority) = host.parse::<Authority>() else { return false };
        let name = authority.host().trim_start_matches('[').trim_end_matches(']').to_ascii_lowercase();
        let local = name == "localhost" || name.ends_with(".localhost");
        local || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback()) || hosts.contains(&name)
    }

    fn allows_origin(&self, origin: &HeaderValue, host: Option<&str>) -> bool {
        // Same site: the page came from here. The scheme may differ, where a proxy speaks TLS.
        let here = origin.to_str().ok().and_then(|o| o.split_once("://")).map(|(_, authority)| authority);
        let same = here.zip(host).is_some_and(|(page, host)| same_authority(page, host));
        same || self.any_origin || self.origins.contains(origin)
    }
}

/// Whether two authorities are one, where 80 and 443 need not be written.
fn same_authority(page: &str, host: &str) -> bool {
    let split = |text: &str| {
        let parsed: Option<Authority> = text.parse().ok();
        parsed.map(|a| (a.host().to_ascii_lowercase(), a.port_u16().filter(|p| !matches!(p, 80 | 443))))
    };
    split(page).is_some_and(|page| Some(page) == split(host))
}

/// An origin as browsers send it: scheme, host, and a port that is not the scheme's own.
fn origin(text: &str) -> Result<HeaderValue> {
    let refused = |why: &str| {
        let message = format!(
            "`{text}` is no origin: {why}; an origin is like `https://studio.example` or `http://localhost:3000`"
        );
        Err(Failure::new(Code::InvalidOptions, message))
    };
    let Some((scheme, authority)) = text.split_once("://") else { return refused("it has no scheme") };
    if !scheme.bytes().all(|b| b.is_ascii_lowercase() || b"0123456789+-.".contains(&b)) || scheme.is_empty() {
        return refused("its scheme is not one in small letters");
    }
    if authority.contains(['/', '?', '#', '@', '*', ' ']) {
        return refused("it has more than a host and a port");
    }
    match authority.parse::<Authority>() {
        Ok(found) if found.host().is_empty() => refused("it has no host"),
        Ok(found) if found.host() != found.host().to_ascii_lowercase() => refused("browsers send it in small letters"),
        Ok(found) if matches!((scheme, found.port_u16()), ("http", Some(80)) | ("https", Some(443))) => {
            refused("browsers leave out the scheme's own port")
        }
        Ok(_) => text.parse().or_else(|_| refused("it cannot stand in a header")),
        Err(_) => refused("its host or port is broken"),
    }
}

/// The name by which the service is called: that of the target where it has one, whatever the header says (RFC 9112, section 3.2.2).
fn host(request: &Request) -> Option<&str> {
    let named = || Some(request.headers().get(header::HOST)?.to_str().unwrap_or_default());
    request.uri().authority().map(Authority::as_str).or_else(named)
}

/// Refuses what comes from other sites, and what is meant for another host.
pub(super) async fn check(State(sites): State<Sites>, request: Request, next: Next) -> Response {
    // A proxy may have read another of them (RFC 9112, section 3.2).
    if request.headers().get_all(header::HOST).iter().nth(1).is_some() {
        return refused(Problem::new(Code::InvalidRequest, "the request has more than one `Host`"), request);
    }
    let host = host(&request);
    if host.is_some_and(|host| !sites.knows_host(host)) {
        let detail = "this service listens on this machine alone and does not know the host that is asked for; --allow-host adds one";
        let problem = Problem::new(Code::InvalidRequest, detail);
        return refused(problem.with_status(StatusCode::MISDIRECTED_REQUEST), request);
    }
    if let Some(origin) = request.headers().get(header::ORIGIN)
        && !sites.allows_origin(origin, host)
    {
        let detail = "pages of this origin may not call this service; --allow-origin lets them";
        return refused(Problem::new(Code::Forbidden, detail), request);
    }
    next.run(request).await
}

/// The answer to a client that may still be sending.
fn refused(problem: Problem, request: Request) -> Response {
    drop(DrainOnDrop(Some(request.into_body().into_data_stream())));
    problem.into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sites(origins: &[&str], hosts: &[&str], listen: &str) -> Sites {
        let owned = |list: &[&str]| list.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
        Sites::new(&owned(origins), &owned(hosts), listen.parse().unwrap()).unwrap()
    }

    #[test]
    fn on_loopback_only_names_of_this_machine_and_named_ones_are_answered() {
        let local = sites(&[], &["Atlas.example"], "127.0.0.1:8080");
        for host in ["localhost", "localhost:8080", "127.0.0.1:8080", "[::1]:8080", "atlas.example", "a.localhost:1"] {
            assert!(local.knows_host(host), "{host}");
        }
        for host in ["evil.example", "localhost.evil.example", "10.0.0.1", "", "a b", "127.0.0.1.nip.example:8080"] {
            assert!(!local.knows_host(host), "{host}");
        }
        assert!(sites(&[], &[], "0.0.0.0:80").knows_host("anything.example"));
    }

    #[test]
    fn the_target_names_the_host_before_the_header_does() {
        let named = |target: &str, header: Option<&str>| {
            let request = axum::http::Request::builder().uri(target);
            let request = header.into_iter().fold(request, |r, host| r.header("host", host));
            host(&request.body(axum::body::Body::empty()).unwrap()).map(str::to_owned)
        };
        assert_eq!(named("/v1/jobs", Some("localhost:8080")).as_deref(), Some("localhost:8080"));
        assert_eq!(named("http://evil.example/", Some("localhost")).as_deref(), Some("evil.example"));
        assert_eq!(named("/", None), None);
    }

    #[test]
    fn pages_from_elsewhere_are_refused_unless_they_are_allowed() {
        let sites = sites(&["https://studio.example"], &[], "127.0.0.1:8080");
        let allowed = |origin: &'static str, host| sites.allows_origin(&HeaderValue::from_static(origin), Some(host));
        assert!(allowed("https://studio.example", "localhost:8080"));
        assert!(allowed("http://localhost:8080", "localhost:8080"));
        assert!(allowed("https://atlas.example", "atlas.example:443"), "behind a proxy with TLS");
        for origin in ["http://localhost:3000", "https://evil.example", "null", "http://127.0.0.1:8080", ""] {
            assert!(!allowed(origin, "localhost:8080"), "{origin}");
        }
    }

    #[test]
    fn origins_that_no_browser_sends_are_named() {
        for text in [
            "studio.example",
            "https://a.example/",
            "https://",
            "HTTPS://a.example",
            "https://A.example",
            "https://a:443",
            "http://*.a",
        ] {
            let failure = Sites::new(&[text.to_owned()], &[], "127.0.0.1:1".parse().unwrap()).unwrap_err();
            assert!(failure.message.contains(text), "{failure}");
        }
        assert!(Sites::new(&["*".to_owned()], &[], "127.0.0.1:1".parse().unwrap()).unwrap().any_origin);
    }
}
