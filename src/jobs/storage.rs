//! Whether the data folder can be used: whose it is, what is free, whether it takes what is written.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::files::{Files, disk, sync_folder};
use crate::error::{Code, Failure, Result};

/// Least number of bytes that must be free, where the volume is not small.
const MIN_FREE: u64 = 64 << 20;

impl Files {
    /// Makes sure that the stored files belong to the queue of this identity, which was made just now or not. A folder and its queue carry one
    /// identity. False where files are here whose queue is gone: the new one must not collect what it does not know.
    ///
    /// # Errors
    /// `unavailable`: the queue is another folder's, or the disk fails.
    pub fn own(&self, identity: &str, fresh: bool, adopt: bool) -> Result<bool> {
        let (marker, stranger) = (self.marker(), self.root().join("identity.new"));
        let mine = read(&marker)?;
        let stored = !self.objects().is_empty() || !self.untouched(std::time::Duration::ZERO).is_empty();
        let strange = read(&stranger)?.as_deref() == Some(identity);
        let known = match mine.as_deref() {
            Some(mine) => mine == identity || (fresh && !stored),
            // A store of before there were identities, or an empty one.
            None => !strange && (!fresh || !stored),
        };
        if known || adopt {
            if mine.as_deref() != Some(identity) {
                write(&marker, identity)?;
            }
            let _ = fs::remove_file(&stranger);
            return Ok(true);
        }
        let folder = self.root().display();
        if !fresh && !strange {
            let message = format!(
                "the job queue in {folder} belongs to another data folder, and nothing was changed: put this folder's own queue.sqlite back, \
                 or give up the files that are stored here with --adopt-store"
            );
            return Err(Failure::new(Code::Unavailable, message));
        }
        write(&stranger, identity)?;
        tracing::error!(
            "{folder} holds files of jobs, and the queue that knew them is gone: a new queue was made, and nothing will be removed. Stop the \
             service and put the old queue.sqlite back from a backup, or give the files up with --adopt-store"
        );
        Ok(false)
    }

    /// Whether enough is free, and the folder takes what is written. A limit of `None` is 64 MiB, or a tenth of the volume where that is
    /// less.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub fn probe(&self, min_free: Option<u64>) -> Result<()> {
        if let Some((free, whole)) = space(self.root())? {
            let wanted = min_free.unwrap_or(MIN_FREE.min(whole / 10));
            if free < wanted {
                let message = format!(
                    "{} MiB are free on the volume of the data folder, and {} MiB must be",
                    free >> 20,
                    wanted.div_ceil(1 << 20)
                );
                return Err(Failure::new(Code::InsufficientStorage, message));
            }
        }
        let path = self.incoming("probe");
        let written = || {
            let mut file = fs::File::create(&path)?;
            file.write_all(&[0; 4096])?;
            file.sync_data()?;
            fs::remove_file(&path)
        };
        written().map_err(|e| disk(&path, &e))
    }

    fn marker(&self) -> PathBuf {
        self.root().join("identity")
    }
}

/// Bytes that are free for this process on the volume of a folder, and bytes of the volume; `None` where the system does not tell.
fn space(folder: &Path) -> Result<Option<(u64, u64)>> {
    #[cfg(unix)]
    {
        let found = rustix::fs::statvfs(folder).map_err(|e| disk(folder, &e.into()))?;
        Ok(Some((found.f_bavail.saturating_mul(found.f_frsize), found.f_blocks.saturating_mul(found.f_frsize))))
    }
    #[cfg(not(unix))]
    {
        let _ = folder;
        Ok(None)
    }
}

fn read(path: &Path) -> Result<Option<String>> {
    match fs::read_to_string(path) {
        Ok(text) => Ok(Some(text.trim().to_owned())),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(disk(path, &e)),
    }
}

fn write(path: &Path, identity: &str) -> Result<()> {
    let young = path.with_extension("young");
    let written = || {
        let mut file = fs::File::create(&young)?;
        writeln!(file, "{identity}")?;
        file.sync_all()?;
        fs::rename(&young, path)?;
        sync_folder(path.parent().unwrap_or(Path::new(".")))
    };
    written().map_err(|e: io::Error| disk(path, &e))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> (tempfile::TempDir, Files) {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        (root, files)
    }

    fn with_object() -> (tempfile::TempDir, Files) {
        let (root, files) = folder();
        fs::create_dir_all(root.path().join("objects/ab")).unwrap();
        fs::write(root.path().join("objects/ab/abcd"), "x").unwrap();
        (root, files)
    }

    #[test]
    fn a_folder_belongs_to_its_first_queue() {
        let (root, files) = folder();
        assert_eq!(files.own("a", true, false), Ok(true));
        assert_eq!(fs::read_to_string(root.path().join("identity")).unwrap(), "a\n");
        assert_eq!(files.own("a", false, false), Ok(true));
        // Another's queue is refused, whether files are here or not.
        assert_eq!(files.own("b", false, false).unwrap_err().code, Code::Unavailable);
        assert_eq!(files.own("a", false, false), Ok(true));
    }

    #[test]
    fn files_without_their_queue_stay_until_their_owner_says_otherwise() {
        let (_root, files) = with_object();
        assert_eq!(files.own("a", false, false), Ok(true), "a store of before there were identities");
        // The queue is lost; the new one is foreign at each start, but it may be used.
        assert_eq!(files.own("b", true, false), Ok(false));
        assert_eq!(files.own("b", false, false), Ok(false));
        // The old one comes back.
        assert_eq!(files.own("a", false, false), Ok(true));
        assert_eq!(files.own("c", true, false), Ok(false));
        assert_eq!(files.own("c", false, true), Ok(true));
        assert_eq!(files.own("a", false, false).unwrap_err().code, Code::Unavailable);
    }

    #[test]
    fn files_of_before_there_were_identities_are_kept_as_well() {
        let (_root, files) = with_object();
        assert_eq!(files.own("a", true, false), Ok(false));
        assert_eq!(files.own("a", false, false), Ok(false), "at each start");
        // The one that knew them comes back.
        assert_eq!(files.own("b", false, false), Ok(true));
        assert_eq!(files.own("a", true, false), Ok(false));
        assert_eq!(files.own("a", false, true), Ok(true));
    }

    #[test]
    fn what_is_free_is_held_against_what_must_be() {
        let (_root, files) = folder();
        assert_eq!(files.probe(Some(0)), Ok(()));
        let failure = files.probe(Some(u64::MAX)).unwrap_err();
        assert_eq!(failure.code, Code::InsufficientStorage);
        assert!(failure.message.contains("MiB are free"), "{failure}");
        fs::remove_dir_all(files.incoming("")).unwrap();
        assert_eq!(files.probe(Some(0)).unwrap_err().code, Code::Unavailable);
    }
}
