//! One POST to a receiver. The address that is connected to is the one that was looked at, so that a name which leads elsewhere a moment
//! later (DNS rebinding) gains nothing; redirects are answers like others.

use std::sync::Arc;
use std::time::Duration;

use axum::http::{HeaderMap, Method, Request, Uri, header};
use http_body_util::Full;
use hyper::body::Bytes;
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, lookup_host};
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use super::target::{TargetPolicy, bare, refusal};
use crate::error::{Failure, Result};

/// How long an attempt may take, from the name to the answer.
const TIMEOUT: Duration = Duration::from_secs(20);
/// Bytes of the head of an answer.
const MAX_HEAD: usize = 16 << 10;
/// Addresses of a name that are tried.
const MAX_ADDRESSES: usize = 4;

/// TLS as a client, with the roots that browsers trust.
pub(in crate::jobs) fn tls() -> Result<TlsConnector> {
    let roots = RootCertStore { roots: webpki_roots::TLS_SERVER_ROOTS.to_vec() };
    let config =
        ClientConfig::builder_with_provider(Arc::new(ring::default_provider())).with_safe_default_protocol_versions();
    let config = config.map_err(|e| Failure::internal(format!("TLS cannot be set up: {e}")))?;
    Ok(Arc::new(config.with_root_certificates(roots).with_no_client_auth()).into())
}

/// Sends to receivers.
pub(super) struct Client {
    tls: TlsConnector,
    policy: TargetPolicy,
}

impl Client {
    /// A client that connects to what the policy permits.
    pub(super) fn new(policy: TargetPolicy) -> Result<Self> {
        Ok(Client { tls: tls()?, policy })
    }

    /// Where webhooks may go.
    pub(super) fn policy(&self) -> &TargetPolicy {
        &self.policy
    }

    /// POSTs JSON; the status of the answer, or why there is none.
    pub(super) async fn post(&self, url: &str, headers: HeaderMap, body: String) -> std::result::Result<u16, String> {
        let sent = timeout(TIMEOUT, self.send(url, headers, body)).await;
        sent.unwrap_or_else(|_| Err(format!("there was no answer within {} s", TIMEOUT.as_secs())))
    }

    async fn send(&self, url: &str, headers: HeaderMap, body: String) -> std::result::Result<u16, String> {
        let uri = self.policy.parse(url)?;
        let host = uri.host().map(bare).ok_or("the URL has no host")?.to_owned();
        let secure = uri.scheme_str() == Some("https");
        let stream = self.connect(&host, uri.port_u16().unwrap_or(if secure { 443 } else { 80 })).await?;
        if !secure {
            return exchange(stream, &uri, headers, body).await;
        }
        let name = ServerName::try_from(host).map_err(|e| format!("the host is no name for TLS: {e}"))?;
        let stream = self.tls.connect(name, stream).await.map_err(|e| format!("TLS: {e}"))?;
        exchange(stream, &uri, headers, body).await
    }

    /// A connection to an address of the host that is permitted.
    async fn connect(&self, host: &str, port: u16) -> std::result::Result<TcpStream, String> {
        let found = lookup_host((host, port)).await.map_err(|e| format!("the host is not found: {e}"))?;
        let mut why = "the host has no address".to_owned();
        for address in found.take(MAX_ADDRESSES) {
            if !self.policy.permits(address.ip()) {
                why = refusal(address.ip());
                continue;
            }
            match TcpStream::connect(address).await {
                Ok(stream) => return Ok(stream),
                Err(e) => why = format!("{address} cannot be connected to: {e}"),
            }
        }
        Err(why)
    }
}

/// Sends the request, and reads the head of its answer.
async fn exchange(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    uri: &Uri,
    headers: HeaderMap,
    body: String,
) -> std::result::Result<u16, String> {
    let path = uri.path_and_query().map_or("/", |p| p.as_str());
    let host = uri.authority().map(|a| a.as_str()).unwrap_or_default();
    let mut request = Request::builder().method(Method::POST).uri(path).header(header::HOST, host);
    for (name, value) in &headers {
        request = request.header(name, value);
    }
    let request = request.body(Full::new(Bytes::from(body))).map_err(|e| format!("the request cannot be made: {e}"))?;
    let (mut sender, connection) = http1::Builder::new()
        .max_buf_size(MAX_HEAD)
        .handshake(TokioIo::new(stream))
        .await
        .map_err(|e| format!("the connection failed: {e}"))?;
    let answer = async { sender.send_request(request).await.map(|answer| answer.status().as_u16()) };
    let mut connection = std::pin::pin!(connection);
    let mut answer = std::pin::pin!(answer);
    // What follows the head is of no interest, and the connection ends with this.
    let answered = tokio::select! {
        answered = &mut answer => answered,
        _ = &mut connection => answer.await,
    };
    answered.map_err(|e| format!("there was no answer: {e}"))
}
