//! The data folder of a process: `incoming/<worker>/…` what is being received, computed on or written. What is complete goes to the store
//! ([`super::store`]).
//!
//! Names from outside never become paths: files are numbered or named by their contents, and what they are called stands in the queue.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::record::{ArtifactEntry, new_id};
use crate::asset::File;
use crate::error::{Code, Failure, Result};
use crate::refine::run::Artifact;

/// Characters that need no escape in the last segment of a path (RFC 3986, unreserved).
const SEGMENT: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

/// End of the name of a worker's file that is not locked yet.
const UNLOCKED: &str = ".new";

/// What was uploaded, by the number of its file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// The models, in order.
    pub models: Vec<UploadedFile>,
    /// The files that they name.
    pub files: Vec<UploadedFile>,
}

/// One uploaded file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct UploadedFile {
    /// Relative path as its user calls it.
    pub path: String,
    /// Number of its file.
    pub number: usize,
    /// SHA-256 in hexadecimal digits.
    #[serde(default)]
    pub sha256: String,
}

/// The data folder, as one worker sees it.
#[derive(Debug, Clone)]
pub struct Files {
    root: PathBuf,
    /// This process.
    owner: String,
    /// Locked as long as this process lives, so that others can see when it is gone.
    _lock: Arc<fs::File>,
}

impl Files {
    /// Opens or makes the folder, and registers this process as a worker: a file that it holds locked while it lives, whatever way it
    /// ends.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub fn open(root: &Path) -> Result<Self> {
        let owner = new_id()?;
        let incoming = Path::new("incoming").join(&owner);
        for part in [Path::new("workers"), &incoming] {
            let folder = root.join(part);
            fs::create_dir_all(&folder).map_err(|e| disk(&folder, &e))?;
        }
        let (unlocked, path) =
            (root.join("workers").join(format!("{owner}{UNLOCKED}")), root.join("workers").join(&owner));
        let lock = || {
            let file = fs::File::create_new(&unlocked)?;
            file.lock()?;
            // Others look only at the final name, so they never see it unlocked while its process lives.
            fs::rename(&unlocked, &path)?;
            Ok(file)
        };
        let lock = lock().map_err(|e| disk(&path, &e))?;
        Ok(Files { root: root.to_owned(), owner, _lock: Arc::new(lock) })
    }

    /// The data folder.
    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// The worker that this process is.
    pub fn owner(&self) -> &str {
        &self.owner
    }

    /// Whether the process of a worker is gone; `None` where this folder has never known it, or does not any more.
    pub fn worker_is_gone(&self, owner: &str) -> Option<bool> {
        match fs::File::open(self.lock_file(owner)) {
            Ok(file) => Some(file.try_lock().is_ok()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(_) => Some(false),
        }
    }

    /// Removes what workers that are gone have left.
    pub fn remove_dead_workers(&self) {
        for folder in ["incoming", "workers"] {
            for entry in fs::read_dir(self.root.join(folder)).into_iter().flatten().flatten() {
                let name = entry.file_name();
                if let Some(owner) = name.to_str().filter(|n| !n.ends_with(UNLOCKED))
                    && self.worker_is_gone(owner) != Some(false)
                {
                    remove_folder(&self.root.join("incoming").join(owner));
                    let _ = fs::remove_file(self.lock_file(owner));
                }
            }
        }
    }

    fn lock_file(&self, owner: &str) -> PathBuf {
        self.root.join("workers").join(owner)
    }

    /// A folder for an upload that is under way.
    pub fn incoming(&self, job: &str) -> PathBuf {
        self.root.join("incoming").join(&self.owner).join(job)
    }

    /// Reads an upload, which lies in `folder`: each model with all side files.
    ///
    /// # Errors
    /// `unavailable`; `internal` where a file is gone.
    pub fn load(folder: &Path, manifest: &Manifest) -> Result<Vec<Vec<File>>> {
        let read = |stored: &UploadedFile| {
            let path = folder.join(stored.number.to_string());
            let bytes = fs::read(&path).map_err(|e| match e.kind() {
                io::ErrorKind::NotFound => Failure::internal("what was uploaded for this job is gone from the store"),
                _ => disk(&path, &e),
            })?;
            // Uploads of before they had a hash are taken as they are.
            if !stored.sha256.is_empty() && hex::encode(Sha256::digest(&bytes)) != stored.sha256 {
                return Err(Failure::internal(
                    "what was uploaded for this job is damaged: a file does not have its SHA-256",
                ));
            }
            Ok(File { path: stored.path.clone(), bytes })
        };
        let side: Vec<File> = manifest.files.iter().map(read).collect::<Result<_>>()?;
        let mut models = Vec::with_capacity(manifest.models.len());
        let mut side = Some(side);
        for (i, model) in manifest.models.iter().enumerate() {
            let last = i + 1 == manifest.models.len();
            let mut files = vec![read(model)?];
            files.extend(if last { side.take() } else { side.clone() }.unwrap_or_default());
            models.push(files);
        }
        Ok(models)
    }

    /// Removes what was received for a job.
    pub fn remove_incoming(&self, job: &str) {
        remove_folder(&self.incoming(job));
    }
}

/// Where an artifact of a job is fetched.
pub(super) fn href(job: &str, name: &str) -> String {
    format!("/v1/jobs/{job}/artifacts/{}", utf8_percent_encode(name, SEGMENT))
}

/// The entries of a result's files, in the same order.
pub fn entries(job: &str, artifacts: &[Artifact]) -> Vec<ArtifactEntry> {
    let entry = |artifact: &Artifact| ArtifactEntry {
        name: artifact.name.clone(),
        role: artifact.role.clone(),
        media_type: artifact.media_type.clone(),
        bytes: artifact.bytes.len() as u64,
        sha256: hex::encode(Sha256::digest(&artifact.bytes)),
        href: Some(href(job, &artifact.name)),
        expired: false,
    };
    artifacts.iter().map(entry).collect()
}

pub(super) fn sync_folder(path: &Path) -> io::Result<()> {
    // Only Unix can open a folder and sync it; elsewhere the rename is durable by itself or not at all.
    if cfg!(unix) { fs::File::open(path)?.sync_all() } else { Ok(()) }
}

pub(super) fn remove_folder(path: &Path) {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            tracing::warn!(path = %path.display(), %error, "could not remove a folder");
        }
        _ => {}
    }
}

/// A failure of the disk: the machine's trouble, which ends no job.
pub fn disk(path: &Path, error: &io::Error) -> Failure {
    tracing::debug!(path = %path.display(), %error, "the data folder failed");
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            Failure::new(Code::InsufficientStorage, "the disk of the data folder is full")
        }
        kind => Failure::new(Code::Unavailable, format!("the data folder cannot be used: {kind}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn artifacts_are_named_by_their_contents() {
        let artifact = |name: &str, bytes: &[u8]| Artifact {
            name: name.into(),
            role: "model".into(),
            media_type: "text/plain".into(),
            bytes: bytes.to_vec(),
        };
        let entries =
            entries("j", &[artifact("a b/c.txt", b"one"), artifact("b.txt", b"two"), artifact("c.txt", b"two")]);
        assert_eq!((entries[0].href.as_deref(), entries[0].bytes), (Some("/v1/jobs/j/artifacts/a%20b%2Fc.txt"), 3));
        assert!(entries[1].sha256 == entries[2].sha256 && entries[0].sha256 != entries[1].sha256);
    }

    #[test]
    fn workers_are_gone_when_their_lock_is_and_so_is_what_they_left() {
        let root = tempfile::tempdir().unwrap();
        let (files, other) = (Files::open(root.path()).unwrap(), Files::open(root.path()).unwrap());
        let (left, owner) = (other.incoming("j"), other.owner().to_owned());
        fs::create_dir_all(&left).unwrap();
        assert_eq!((files.worker_is_gone(&owner), files.worker_is_gone("other")), (Some(false), None));
        files.remove_dead_workers();
        assert!(files.lock_file(&owner).exists() && left.exists());
        drop(other);
        assert_eq!(files.worker_is_gone(&owner), Some(true));
        files.remove_dead_workers();
        assert!(!files.lock_file(&owner).exists() && !left.exists() && files.incoming("").exists());
    }

    #[test]
    fn uploads_are_read_with_all_their_files_and_checked() {
        let root = tempfile::tempdir().unwrap();
        let stored =
            |path: &str, number, sha256: &str| UploadedFile { path: path.into(), number, sha256: sha256.into() };
        let hash = hex::encode(Sha256::digest([0]));
        let models = vec![stored("a.glb", 0, &hash), stored("b.glb", 1, "")];
        let manifest = Manifest { models, files: vec![stored("t.png", 2, "")] };
        assert!(Files::load(root.path(), &manifest).is_err());
        for n in 0..3 {
            fs::write(root.path().join(n.to_string()), [n]).unwrap();
        }
        let models = Files::load(root.path(), &manifest).unwrap();
        let seen: Vec<Vec<(&str, u8)>> =
            models.iter().map(|m| m.iter().map(|f| (f.path.as_str(), f.bytes[0])).collect()).collect();
        assert_eq!(seen, [[("a.glb", 0), ("t.png", 2)], [("b.glb", 1), ("t.png", 2)]]);
        fs::write(root.path().join("0"), [7]).unwrap();
        let failure = Files::load(root.path(), &manifest).unwrap_err();
        assert!(failure.code == Code::Internal && failure.message.contains("damaged"), "{failure}");
    }
}
