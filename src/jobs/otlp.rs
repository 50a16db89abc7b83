//! Spans to a collector by OTLP (HTTP and protobuf): batches and retries are the SDK's, the connection is made by what webhooks use too.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use http_body_util::{BodyExt, Full, Limited};
use hyper::client::conn::http1;
use hyper::header::{HOST, HeaderValue};
use hyper_util::rt::TokioIo;
use opentelemetry::trace::{SpanContext, SpanId, SpanKind as OtelKind, Status, TraceFlags, TraceId, TraceState};
use opentelemetry::{InstrumentationScope, KeyValue};
use opentelemetry_http::{Bytes, HttpClient, HttpError, Request, Response};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig, WithHttpConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{BatchSpanProcessor, SpanData, SpanEvents, SpanLinks, SpanProcessor};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;

use super::trace::{Span, SpanKind, SpanSink};
use super::webhooks::tls;
use crate::error::{Code, Failure, Result};

/// Where a collector takes traces, below its address.
const PATH: &str = "/v1/traces";
/// How long a batch may take.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Bytes of an answer.
const MAX_ANSWER: usize = 1 << 20;

/// Sends spans to a collector.
#[derive(Debug)]
pub struct Otlp {
    processor: BatchSpanProcessor,
    scope: InstrumentationScope,
}

impl Otlp {
    /// Sends to the collector at `endpoint`, an address such as `http://127.0.0.1:4318`, over the runtime that this is called on. Further settings
    /// are taken from the environment, as OpenTelemetry names it.
    ///
    /// # Errors
    /// `invalid_request` where that is no address of a collector.
    pub fn new(endpoint: &str) -> Result<Arc<Self>> {
        let wrong = |why: String| Failure::new(Code::InvalidRequest, format!("--otlp-endpoint `{endpoint}`: {why}"));
        let base = endpoint.trim_end_matches('/');
        if !base.starts_with("http://") && !base.starts_with("https://") {
            return Err(wrong("it is an address such as http://127.0.0.1:4318".to_owned()));
        }
        let url = if base.ends_with(PATH) { base.to_owned() } else { format!("{base}{PATH}") };
        let client = Client { runtime: Handle::current(), tls: tls()? };
        let exporter = SpanExporter::builder()
            .with_http()
            .with_http_client(client)
            .with_protocol(Protocol::HttpBinary)
            .with_timeout(TIMEOUT)
            .with_endpoint(url)
            .build()
            .map_err(|e| wrong(e.to_string()))?;
        let mut processor = BatchSpanProcessor::builder(exporter).build();
        let mut resource =
            Resource::builder().with_attribute(KeyValue::new("service.version", env!("CARGO_PKG_VERSION")));
        if std::env::var_os("OTEL_SERVICE_NAME").is_none_or(|name| name.is_empty()) {
            resource = resource.with_service_name("intarsia");
        }
        processor.set_resource(&resource.build());
        let scope = InstrumentationScope::builder("intarsia").with_version(env!("CARGO_PKG_VERSION")).build();
        Ok(Arc::new(Otlp { processor, scope }))
    }
}

impl SpanSink for Otlp {
    fn take(&self, span: Span) {
        let context = |id: [u8; 8]| {
            let trace = TraceId::from_bytes(span.context.trace);
            SpanContext::new(trace, SpanId::from_bytes(id), TraceFlags::SAMPLED, false, TraceState::default())
        };
        self.processor.on_end(SpanData {
            span_context: context(span.context.span),
            parent_span_id: span.parent.map_or(SpanId::INVALID, SpanId::from_bytes),
            parent_span_is_remote: span.kind == SpanKind::Server && span.parent.is_some(),
            span_kind: match span.kind {
                SpanKind::Server => OtelKind::Server,
                SpanKind::Consumer => OtelKind::Consumer,
                SpanKind::Client => OtelKind::Client,
                SpanKind::Internal => OtelKind::Internal,
            },
            name: span.name.into(),
            start_time: span.start,
            end_time: span.end,
            attributes: span.attributes.into_iter().map(|(key, value)| KeyValue::new(key, value)).collect(),
            dropped_attributes_count: 0,
            events: SpanEvents::default(),
            links: SpanLinks::default(),
            status: span.error.map_or(Status::Unset, Status::error),
            instrumentation_scope: self.scope.clone(),
        });
    }

    fn flush(&self) {
        if let Err(error) = self.processor.shutdown() {
            tracing::warn!(%error, "the last spans were not taken by the collector");
        }
    }
}

/// One connection for each batch: they are few.
#[derive(Clone)]
struct Client {
    runtime: Handle,
    tls: TlsConnector,
}

impl std::fmt::Debug for Client {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Client")
    }
}

#[async_trait]
impl HttpClient for Client {
    async fn send_bytes(&self, request: Request<Bytes>) -> std::result::Result<Response<Bytes>, HttpError> {
        // The SDK calls from a thread of its own, which is not the runtime's.
        let client = self.clone();
        self.runtime.spawn(async move { timeout(TIMEOUT, client.send(request)).await }).await??
    }
}

impl Client {
    async fn send(&self, request: Request<Bytes>) -> std::result::Result<Response<Bytes>, HttpError> {
        let uri = request.uri().clone();
        let host = uri.host().ok_or("the address of the collector has no host")?.to_owned();
        let bare = host.trim_start_matches('[').trim_end_matches(']').to_owned();
        let secure = uri.scheme_str() == Some("https");
        let stream =
            TcpStream::connect((bare.as_str(), uri.port_u16().unwrap_or(if secure { 443 } else { 80 }))).await?;
        if !secure {
            return exchange(stream, request).await;
        }
        exchange(self.tls.connect(ServerName::try_from(bare)?, stream).await?, request).await
    }
}

async fn exchange(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    mut request: Request<Bytes>,
) -> std::result::Result<Response<Bytes>, HttpError> {
    let authority = request.uri().authority().map(|a| a.as_str().to_owned()).unwrap_or_default();
    request.headers_mut().insert(HOST, HeaderValue::from_str(&authority)?);
    *request.uri_mut() = request.uri().path_and_query().map_or("/", |p| p.as_str()).parse()?;
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
    let answer = async {
        let (head, body) = sender.send_request(request.map(Full::new)).await?.into_parts();
        let body = Limited::new(body, MAX_ANSWER).collect().await?.to_bytes();
        Ok(Response::from_parts(head, body))
    };
    let (mut connection, mut answer) = (std::pin::pin!(connection), std::pin::pin!(answer));
    tokio::select! {
        answer = &mut answer => answer,
        _ = &mut connection => answer.await,
    }
}
