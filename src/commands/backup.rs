//! `intarsia backup`: a copy of a service's data folder.

use intarsia::config::Backup;
use intarsia::error::{Failure, Result};
use intarsia::jobs::backup;

/// Copies the data folder while the service goes on.
pub fn run(arguments: &Backup) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|e| Failure::internal(format!("no runtime: {e}")))?;
    let copied = runtime.block_on(backup::copy(&arguments.data_dir, &arguments.to))?;
    super::print(&format!("copied the queue and {copied} files to {}\n", arguments.to.display()))
}
