//! Webhooks by Standard Webhooks: receivers are told that a job has ended, signed, again and again until they have taken it.
//!
//! What is to be told stands in an outbox beside the queue, written in the transaction that ends the job; so nothing is forgotten, and what
//! was told twice has one id. [`Deliverer`] empties it.

mod client;
mod deliver;
pub mod target;

use std::time::Duration;

use async_trait::async_trait;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub(super) use self::client::tls;
pub use self::deliver::Deliverer;
use super::record::Timestamp;
use crate::error::{Failure, Result};

/// Webhooks of one tenant.
pub const MAX_WEBHOOKS: u32 = 100;
/// What the secret of a receiver begins with.
const SECRET_PREFIX: &str = "whsec_";

/// What receivers are told of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
pub enum WebhookEvent {
    /// A job has succeeded.
    #[serde(rename = "job.succeeded")]
    Succeeded,
    /// A job has failed.
    #[serde(rename = "job.failed")]
    Failed,
    /// A job was cancelled.
    #[serde(rename = "job.canceled")]
    Canceled,
    /// A job waited for too long and was never run.
    #[serde(rename = "job.expired")]
    Expired,
}

impl WebhookEvent {
    /// All events.
    pub const ALL: [WebhookEvent; 4] =
        [WebhookEvent::Succeeded, WebhookEvent::Failed, WebhookEvent::Canceled, WebhookEvent::Expired];
}

/// A receiver, without its secrets.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, ToSchema)]
pub struct Webhook {
    /// Its id.
    #[schema(pattern = "^[0-9a-f]{32}$")]
    pub id: String,
    /// Where it is told.
    pub url: String,
    /// What it is told of.
    pub events: Vec<WebhookEvent>,
    /// When it was made.
    pub created_at: Timestamp,
    /// Since when it is told nothing more.
    pub disabled_at: Option<Timestamp>,
    /// Why it is told nothing more.
    pub disabled_because: Option<String>,
}

/// Where a delivery stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeliveryState {
    /// It will be tried, or tried again.
    Pending,
    /// The receiver has taken it.
    Delivered,
    /// It was given up.
    Failed,
}

/// One thing that a receiver is told.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, ToSchema)]
pub struct Delivery {
    /// Its id, the same for each attempt (`webhook-id`).
    pub id: String,
    /// The job.
    pub job: String,
    /// The receiver; null where it goes to the `webhook` of the job.
    pub webhook: Option<String>,
    /// What it tells.
    pub event: String,
    /// Where it stands.
    pub state: DeliveryState,
    /// How often it was tried.
    pub attempts: u32,
    /// When it is tried next.
    pub next_attempt_at: Option<Timestamp>,
    /// When the job ended.
    pub created_at: Timestamp,
    /// When the receiver has taken it.
    pub delivered_at: Option<Timestamp>,
    /// What the last attempt was answered (HTTP status).
    pub status: Option<u16>,
    /// Why the last attempt failed.
    pub error: Option<String>,
}

/// A secret, and until when it signs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoredSecret {
    /// `whsec_` and its bytes in base64.
    pub secret: String,
    /// Milliseconds since 1970; `None` for the newest.
    pub until: Option<i64>,
}

/// A delivery whose time has come, held by whoever tries it.
#[derive(Debug, Clone)]
pub struct Due {
    /// Its id.
    pub id: String,
    /// Which attempt this is: the fencing token.
    pub attempt: u32,
    /// Whose it is.
    pub tenant: String,
    /// The receiver; `None` where the job named the URL.
    pub webhook: Option<String>,
    /// Where to.
    pub url: String,
    /// The secrets of the receiver.
    pub secrets: Vec<StoredSecret>,
    /// The body.
    pub payload: String,
    /// The traceparent of its job.
    pub trace: Option<String>,
}

/// What came of an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Settled {
    /// When it is tried again; `None` where it has ended.
    pub next_at: Option<Timestamp>,
    /// When the receiver has taken it.
    pub delivered_at: Option<Timestamp>,
    /// What it was answered.
    pub status: Option<u16>,
    /// Why it failed.
    pub error: Option<String>,
    /// Whether the receiver wants to be told nothing more, and when it said so.
    pub gone: Option<Timestamp>,
}

/// What became of a wish to tell something once more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Replayed {
    /// It is told now.
    Yes,
    /// There is no such delivery.
    Unknown,
    /// The receiver is disabled.
    Disabled,
}

/// Where receivers and the outbox are kept. Every method fails with `insufficient_storage` or `unavailable` when the backend does.
#[async_trait]
pub trait WebhookStore: Send + Sync {
    /// The time by which the outbox goes.
    async fn time(&self) -> Result<Timestamp>;

    /// Stores a receiver of a tenant; false where the tenant has [`MAX_WEBHOOKS`].
    async fn add_webhook(&self, tenant: &str, webhook: &Webhook, secret: &str) -> Result<bool>;

    /// The receivers of a tenant, the newest first.
    async fn webhooks(&self, tenant: &str) -> Result<Vec<Webhook>>;

    /// Removes a receiver, and what it has not been told. False where the tenant has no such.
    async fn remove_webhook(&self, tenant: &str, id: &str) -> Result<bool>;

    /// Gives a receiver a new secret; the ones before sign until `until` beside it. False where the tenant has no such receiver.
    async fn rotate_secret(&self, tenant: &str, id: &str, secret: &str, until: Timestamp) -> Result<bool>;

    /// What a receiver was or is to be told, the newest first: those under `cursor`, and the next cursor; `None` where the tenant has no
    /// such receiver.
    async fn deliveries(
        &self,
        tenant: &str,
        webhook: &str,
        cursor: Option<i64>,
        limit: u32,
    ) -> Result<Option<(Vec<Delivery>, Option<i64>)>>;

    /// Makes a delivery due once more, as if it had never been tried.
    async fn replay(&self, tenant: &str, webhook: &str, delivery: &str, now: Timestamp) -> Result<Replayed>;

    /// What was or is to be told of a job, to its own `webhook` and to receivers, the newest first: those under `cursor`, and the next cursor.
    async fn job_deliveries(&self, job: &str, cursor: Option<i64>, limit: u32) -> Result<(Vec<Delivery>, Option<i64>)>;

    /// Makes a delivery of a job due once more, as if it had never been tried.
    async fn replay_of_job(&self, job: &str, delivery: &str, now: Timestamp) -> Result<Replayed>;

    /// Takes deliveries whose time has come at `now`, the longest due first and at most `per_tenant` of a tenant. Whoever takes them has
    /// `lease`: after that they are due again.
    async fn due(&self, now: Timestamp, lease: Duration, limit: u32, per_tenant: u32) -> Result<Vec<Due>>;

    /// Notes what came of an attempt. False where it is not the caller's any more.
    async fn settle(&self, due: &Due, settled: &Settled) -> Result<bool>;

    /// Deletes deliveries from before `before`.
    async fn purge_deliveries(&self, before: Timestamp) -> Result<u64>;
}

/// A new secret: 256 random bits.
///
/// # Errors
/// `internal` where the system has no random bits.
pub fn new_secret() -> Result<String> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(|e| Failure::internal(format!("no random bits: {e}")))?;
    Ok(format!("{SECRET_PREFIX}{}", STANDARD.encode(bytes)))
}
