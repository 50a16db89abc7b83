//! Whether the service can do its work: looked at every second, told once when it changes.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::time::sleep;

use super::Jobs;
use crate::error::{Failure, Result};

/// How often it is looked at.
const INTERVAL: Duration = Duration::from_secs(1);
/// Every so many looks, the whole file of the queue is read.
const DEEP_EVERY: u32 = 60;

/// What was found at the last look.
#[derive(Default)]
pub(super) struct Health(Mutex<Option<Failure>>);

impl Jobs {
    /// Whether jobs can be taken and run, as of the last look.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`: why not.
    pub fn ready(&self) -> Result<()> {
        self.health.0.lock().unwrap_or_else(PoisonError::into_inner).clone().map_or(Ok(()), Err)
    }

    /// Looks again and again, until the service shuts down.
    pub async fn watch(self: Arc<Self>) {
        for round in 1u32.. {
            tokio::select! {
                () = sleep(INTERVAL) => {}
                () = self.shutdown.cancelled() => break,
            }
            self.look(round.is_multiple_of(DEEP_EVERY)).await;
        }
    }

    /// Looks once; `deep` reads the whole file of the queue.
    pub(super) async fn look(&self, deep: bool) {
        let found = self.probe(deep).await.err();
        let mut known = self.health.0.lock().unwrap_or_else(PoisonError::into_inner);
        match (&*known, &found) {
            // What is free changes all the time: the kind of trouble tells whether this is another.
            (before, Some(now)) if before.as_ref().is_none_or(|before| before.code != now.code) => {
                tracing::error!(code = now.code.as_str(), "not ready: {}; jobs wait, none is lost", now.message);
            }
            (Some(_), None) => {
                tracing::info!("ready again");
                self.wake.notify_one();
            }
            _ => {}
        }
        *known = found;
    }

    async fn probe(&self, deep: bool) -> Result<()> {
        let (files, min_free) = (self.files.clone(), self.min_free);
        let probed = tokio::task::spawn_blocking(move || files.probe(min_free)).await;
        probed.map_err(|e| Failure::internal(format!("the data folder cannot be looked at: {e}")))??;
        self.store.check(deep).await?;
        self.queue.check(deep).await
    }
}
