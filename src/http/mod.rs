//! The service: routes on one screen ([`router`]), one file a resource, problem details.

mod access;
mod artifacts;
mod batch_request;
mod batches;
mod body;
mod document;
mod events;
mod examples;
mod health;
mod incoming;
mod jobs;
mod keys;
pub mod page;
mod prefer;
mod preflight;
pub mod problem;
mod rate_limit;
mod recipes;
mod references;
mod resumable;
pub mod router;
pub mod sites;
mod trace;
mod tus;
mod upload;
mod upload_slots;
mod webhooks;

use std::sync::Arc;

use self::rate_limit::RateLimiter;
use self::upload_slots::UploadSlots;
use crate::config::Access;
use crate::jobs::Jobs;

/// What every handler may use.
#[derive(Clone)]
pub struct App {
    /// The jobs.
    pub jobs: Arc<Jobs>,
    /// Bounds the submissions that are received at the same time.
    pub(crate) uploads: Arc<UploadSlots>,
    /// Who may call.
    pub(crate) access: Arc<Access>,
    /// Bounds the requests of each client.
    rates: Arc<RateLimiter>,
}

impl App {
    /// The service over `jobs`, for whoever may call.
    pub fn new(jobs: Arc<Jobs>, access: Access) -> Self {
        let uploads = UploadSlots::new(jobs.limits.max_uploads);
        App { jobs, uploads, access: access.into(), rates: Arc::default() }
    }
}
