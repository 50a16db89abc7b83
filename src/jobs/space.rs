//! Whether the volume of the data folder has room, and takes what is written.

use std::fs;
use std::io::Write;
use std::path::Path;

use super::files::{Files, disk};
use crate::error::{Code, Failure, Result};

/// Least number of bytes that must be free, where the volume is not small.
const MIN_FREE: u64 = 64 << 20;

impl Files {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_free_is_held_against_what_must_be() {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        assert_eq!(files.probe(Some(0)), Ok(()));
        let failure = files.probe(Some(u64::MAX)).unwrap_err();
        assert_eq!(failure.code, Code::InsufficientStorage);
        assert!(failure.message.contains("MiB are free"), "{failure}");
        fs::remove_dir_all(files.incoming("")).unwrap();
        assert_eq!(files.probe(Some(0)).unwrap_err().code, Code::Unavailable);
    }
}
