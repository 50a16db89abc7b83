//! Empties the outbox: tells what is due, and says when to try again.

use std::sync::Arc;
use std::time::Duration;

use axum::http::{HeaderMap, HeaderValue, header};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use futures_util::StreamExt;
use futures_util::stream::iter;
use standardwebhooks::{HEADER_WEBHOOK_ID, HEADER_WEBHOOK_SIGNATURE, HEADER_WEBHOOK_TIMESTAMP, Webhook as Signer};
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use super::client::Client;
use super::target::TargetPolicy;
use super::{Due, SECRET_PREFIX, Settled, WebhookStore};
use crate::config::Webhooks;
use crate::error::{Code, Failure, Result};
use crate::jobs::record::Timestamp;
use crate::jobs::trace::{TRACEPARENT, TraceContext};

/// How long after each attempt the next one comes: three days in all, as Standard Webhooks proposes.
const DELAYS: [Duration; 9] = [
    Duration::from_secs(5),
    Duration::from_secs(5 * 60),
    Duration::from_secs(30 * 60),
    Duration::from_secs(2 * 3600),
    Duration::from_secs(5 * 3600),
    Duration::from_secs(10 * 3600),
    Duration::from_secs(14 * 3600),
    Duration::from_secs(20 * 3600),
    Duration::from_secs(24 * 3600),
];
/// Part of a delay by which it may be longer, so that receivers that come back are not told everything at once.
const JITTER: f64 = 0.2;
/// How long whoever takes a delivery has for it.
const LEASE: Duration = Duration::from_secs(60);
/// Deliveries that are tried at the same time, and those of one tenant among them.
const AT_ONCE: u32 = 16;
const PER_TENANT: u32 = 4;
/// How often the outbox is looked at.
const INTERVAL: Duration = Duration::from_millis(500);
/// Characters that are kept of why an attempt failed.
const MAX_ERROR: usize = 300;

/// Tells receivers.
pub struct Deliverer {
    /// Receivers and outbox.
    pub store: Arc<dyn WebhookStore>,
    client: Client,
    /// Secrets of the service, for URLs that a job names, decoded.
    secrets: Vec<Vec<u8>>,
}

impl Deliverer {
    /// Tells what `store` holds.
    ///
    /// # Errors
    /// `invalid_options` for a secret that is none.
    pub fn new(store: Arc<dyn WebhookStore>, settings: &Webhooks) -> Result<Self> {
        let policy = TargetPolicy { allow: settings.webhook_allow.clone() };
        let secret = |secret: &crate::config::Secret| {
            let text = secret.text();
            let bytes = STANDARD.decode(text.strip_prefix(SECRET_PREFIX).unwrap_or(text));
            bytes.ok().filter(|bytes| bytes.len() >= 24).ok_or_else(|| {
                let message = "a --webhook-secret is `whsec_` and at least 24 bytes in base64; `openssl rand -base64 32` makes them";
                Failure::new(Code::InvalidOptions, message)
            })
        };
        let secrets = settings.webhook_secret.iter().map(secret).collect::<Result<_>>()?;
        Ok(Deliverer { store, client: Client::new(policy)?, secrets })
    }

    /// Whether a URL may be told anything, as far as that shows before its name is looked up.
    ///
    /// # Errors
    /// `invalid_options` with the reason.
    pub fn check_url(&self, url: &str) -> Result<()> {
        self.client.policy().parse(url).map(|_| ()).map_err(|why| Failure::new(Code::InvalidOptions, why).at("/url"))
    }

    /// The secret with which a receiver that a job of the tenant names checks what it is told; `None` where the service has none. Each
    /// tenant has its own, so that none can sign for another.
    pub fn job_secret(&self, tenant: &str) -> Option<String> {
        Some(format!("{SECRET_PREFIX}{}", STANDARD.encode(self.job_secrets(tenant).first()?)))
    }

    fn job_secrets(&self, tenant: &str) -> Vec<Vec<u8>> {
        let of_tenant = |secret: &Vec<u8>| {
            if tenant.is_empty() {
                return Some(secret.clone());
            }
            let derived = Signer::from_bytes(secret.clone()).ok()?.sign("tenant", 0, tenant.as_bytes()).ok()?;
            STANDARD.decode(derived.strip_prefix("v1,")?).ok()
        };
        self.secrets.iter().filter_map(of_tenant).collect()
    }

    /// Tells what is due until `shutdown`.
    pub async fn run(self: Arc<Self>, shutdown: CancellationToken) {
        while !shutdown.is_cancelled() {
            let told = match self.store.time().await {
                Ok(now) => self.round(now).await,
                Err(failure) => Err(failure),
            };
            if let Err(failure) = &told
                && !failure.is_of_the_machine()
            {
                tracing::error!(%failure, "webhooks cannot be sent");
            }
            if !matches!(told, Ok(1..)) {
                tokio::select! {
                    () = sleep(INTERVAL) => {}
                    () = shutdown.cancelled() => {}
                }
            }
        }
    }

    /// Tells what is due at `now`, once each; how many there were.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub async fn round(&self, now: Timestamp) -> Result<usize> {
        let due = self.store.due(now, LEASE, AT_ONCE, PER_TENANT).await?;
        let count = due.len();
        let attempts = iter(due).map(|due| async move {
            let settled = self.attempt(&due, now).await;
            if let Some(why) = &settled.error {
                let (delivery, attempt, tenant) = (&due.id, due.attempt, &due.tenant);
                tracing::warn!(
                    delivery,
                    attempt,
                    tenant,
                    again = settled.next_at.is_some(),
                    "a webhook was not delivered: {why}"
                );
            }
            self.store.settle(&due, &settled).await
        });
        let mut attempts = attempts.buffer_unordered(AT_ONCE as usize);
        while let Some(settled) = attempts.next().await {
            settled?;
        }
        Ok(count)
    }

    async fn attempt(&self, due: &Due, now: Timestamp) -> Settled {
        let sent = match self.headers(due, now) {
            Ok(headers) => self.client.post(&due.url, headers, due.payload.clone()).await,
            Err(why) => Err(why),
        };
        let (status, error) = match sent {
            Ok(status @ 200..=299) => {
                return Settled {
                    next_at: None,
                    delivered_at: Some(now),
                    status: Some(status),
                    error: None,
                    gone: None,
                };
            }
            Ok(410) => (Some(410), "the receiver wants to be told nothing more (410)".to_owned()),
            Ok(status @ 300..=399) => {
                (Some(status), "the receiver answered with a redirect, which is not followed".to_owned())
            }
            Ok(status) => (Some(status), format!("the receiver answered {status}")),
            Err(why) => (None, why),
        };
        let gone = (status == Some(410)).then_some(now);
        let next_at = delay(due.attempt).filter(|_| gone.is_none()).map(|delay| now.plus(delay));
        Settled { next_at, delivered_at: None, status, error: Some(error.chars().take(MAX_ERROR).collect()), gone }
    }

    /// The headers of Standard Webhooks, with a signature of each secret that holds.
    fn headers(&self, due: &Due, now: Timestamp) -> std::result::Result<HeaderMap, String> {
        let seconds = now.0 / 1000;
        let holds = due.secrets.iter().filter(|secret| secret.until.is_none_or(|until| until > now.0));
        let signers = match &due.webhook {
            Some(_) => holds.map(|secret| Signer::new(&secret.secret)).collect::<std::result::Result<Vec<_>, _>>(),
            None => self.job_secrets(&due.tenant).into_iter().map(Signer::from_bytes).collect(),
        };
        let failed = |e: standardwebhooks::WebhookError| format!("it cannot be signed: {e}");
        let signers = signers.map_err(failed)?;
        if signers.is_empty() {
            return Err("it cannot be signed: the service has no --webhook-secret any more".to_owned());
        }
        let signatures = signers.iter().map(|signer| signer.sign(&due.id, seconds, due.payload.as_bytes()));
        let signatures = signatures.collect::<std::result::Result<Vec<_>, _>>().map_err(failed)?.join(" ");
        let value = |text: &str| HeaderValue::from_str(text).map_err(|e| e.to_string());
        let mut headers = HeaderMap::new();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/json"));
        headers.insert(header::USER_AGENT, HeaderValue::from_static(concat!("intarsia/", env!("CARGO_PKG_VERSION"))));
        if let Some(trace) = due.trace.as_deref().and_then(TraceContext::parse) {
            headers.insert(TRACEPARENT, value(&trace.child().to_string())?);
        }
        headers.insert(HEADER_WEBHOOK_ID, value(&due.id)?);
        headers.insert(HEADER_WEBHOOK_TIMESTAMP, seconds.into());
        headers.insert(HEADER_WEBHOOK_SIGNATURE, value(&signatures)?);
        Ok(headers)
    }
}

/// How long after that attempt the next one comes; `None` after the last.
fn delay(attempt: u32) -> Option<Duration> {
    let delay = DELAYS.get(usize::try_from(attempt).ok()?.checked_sub(1)?)?;
    let mut random = [0; 4];
    // Without random bits, all come at the same time.
    let _ = getrandom::fill(&mut random);
    Some(delay.mul_f64(1.0 + JITTER * f64::from(u32::from_le_bytes(random)) / f64::from(u32::MAX)))
}

#[cfg(test)]
mod tests;
