//! Which queue a service has.

use std::path::Path;
use std::sync::Arc;

use super::Queue;
use super::postgres::Postgres;
use super::sqlite::Sqlite;
use crate::config::QueueAddress;
use crate::error::Result;
use crate::jobs::batches::BatchStore;
use crate::jobs::keys::KeyStore;
use crate::jobs::resumable::UploadStore;
use crate::jobs::webhooks::WebhookStore;

/// The file of a queue in SQLite, in the data folder.
pub const FILE: &str = "queue.sqlite";

/// A queue with what stands beside it in its database.
pub struct Opened {
    /// The jobs.
    pub queue: Arc<dyn Queue>,
    /// The API keys.
    pub keys: Arc<dyn KeyStore>,
    /// Receivers and outbox.
    pub webhooks: Arc<dyn WebhookStore>,
    /// Jobs that were submitted together.
    pub batches: Arc<dyn BatchStore>,
    /// Uploads that are sent in pieces.
    pub uploads: Arc<dyn UploadStore>,
    /// Whether it was made just now.
    pub fresh: bool,
}

impl Opened {
    fn of<Q: Queue + KeyStore + WebhookStore + BatchStore + UploadStore + 'static>(queue: Q, fresh: bool) -> Self {
        let queue = Arc::new(queue);
        let (keys, webhooks, batches, uploads) = (queue.clone(), queue.clone(), queue.clone(), queue.clone());
        Opened { queue, keys, webhooks, batches, uploads, fresh }
    }
}

/// Opens the queue at `address`, or the one of the data folder `data`. Where `small` is given, jobs that are expected to need no more bytes
/// have a slot of their own.
///
/// # Errors
/// `insufficient_storage`, `unavailable`: the disk, the file or the server; `invalid_request`: no address.
pub async fn open(address: &QueueAddress, data: &Path, small: Option<u64>) -> Result<Opened> {
    let small = small.unwrap_or(u64::MAX);
    match address.postgres()? {
        Some(url) => {
            let queue = Postgres::open(url).await?;
            let fresh = queue.is_fresh();
            Ok(Opened::of(queue.with_small(small), fresh))
        }
        None => {
            let file = data.join(FILE);
            let fresh = !file.exists();
            Ok(Opened::of(Sqlite::open(&file).await?.with_small(small), fresh))
        }
    }
}
