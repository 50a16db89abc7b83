//! The service: routes on one screen ([`router`]), one file a resource, problem details.

mod artifacts;
mod document;
mod events;
mod examples;
mod health;
mod jobs;
pub mod page;
mod prefer;
mod preflight;
pub mod problem;
mod recipes;
pub mod router;
pub mod sites;
mod upload;
mod upload_slots;

use std::sync::Arc;

use self::upload_slots::UploadSlots;
use crate::jobs::Jobs;

/// What every handler may use.
#[derive(Clone)]
pub struct App {
    /// The jobs.
    pub jobs: Arc<Jobs>,
    /// Bounds the submissions that are received at the same time.
    pub(crate) uploads: Arc<UploadSlots>,
    /// Whether anybody may list all jobs.
    pub(crate) list_jobs: bool,
}

impl App {
    /// The service over `jobs`.
    pub fn new(jobs: Arc<Jobs>, list_jobs: bool) -> Self {
        let uploads = UploadSlots::new(jobs.limits.max_uploads);
        App { jobs, uploads, list_jobs }
    }
}
