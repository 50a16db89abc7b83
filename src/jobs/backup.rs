//! A copy of a data folder as of one moment, while its service goes on.

use std::fs;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::files::{disk, sync_folder};
use super::queue::Queue;
use super::queue::sqlite::Sqlite;
use crate::error::{Code, Failure, Result};

/// What a data folder holds beside its queue. What is under way (`incoming`) and who lives (`workers`) is not for a copy.
const FOLDERS: [&str; 3] = ["uploads", "objects", "pieces"];

/// Copies the data folder `from` to `to`. Files never change once they have their names, so most of them are copied first; then the queue
/// stands still while what has come since is copied too, and the queue itself. Where both are on one volume, files are linked.
/// Returns the number of files.
///
/// # Errors
/// `invalid_request`: there is no queue, or `to` holds something; `insufficient_storage`, `unavailable`: the disk.
pub async fn copy(from: &Path, to: &Path) -> Result<usize> {
    let queue = from.join("queue.sqlite");
    let refused = |why: String| Err(Failure::new(Code::InvalidRequest, why));
    if !queue.is_file() {
        return refused(format!("{} holds no queue.sqlite", from.display()));
    }
    fs::create_dir_all(to).map_err(|e| disk(to, &e))?;
    if fs::read_dir(to).map_err(|e| disk(to, &e))?.next().is_some() {
        return refused(format!("{} is not empty", to.display()));
    }
    let copied = AtomicUsize::new(0);
    let files = || -> Result<()> {
        for folder in FOLDERS {
            copy_new(&from.join(folder), &to.join(folder), &copied).map_err(|e| disk(to, &e))?;
        }
        Ok(())
    };
    files()?;
    let queue = Sqlite::open(&queue).await?;
    queue.copy(&to.join("queue.sqlite"), &files).await?;
    fs::write(to.join("identity"), format!("{}\n", queue.identity().await?)).map_err(|e| disk(to, &e))?;
    sync_folder(to).map_err(|e| disk(to, &e))?;
    Ok(copied.into_inner())
}

/// Copies or links every file below `from` that `to` does not have.
fn copy_new(from: &Path, to: &Path, copied: &AtomicUsize) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in present(fs::read_dir(from))?.into_iter().flatten() {
        let entry = entry?;
        let place = to.join(entry.file_name());
        let Some(kind) = present(entry.file_type())? else { continue };
        if kind.is_dir() {
            copy_new(&entry.path(), &place, copied)?;
        } else if !place.try_exists()? {
            let linked = fs::hard_link(entry.path(), &place);
            let done =
                linked.or_else(|_| fs::copy(entry.path(), &place).and_then(|_| fs::File::open(&place)?.sync_all()));
            // What was removed meanwhile, nobody needs.
            if present(done)?.is_some() {
                copied.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
    Ok(())
}

fn present<T>(found: io::Result<T>) -> io::Result<Option<T>> {
    match found {
        Ok(found) => Ok(Some(found)),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(e),
    }
}
