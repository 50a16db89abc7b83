//! The files of jobs, in the data folder: `incoming/<worker>/…` what is being received or written, `uploads/<job>/<n>` what jobs wait
//! with, `objects/<xx>/<sha256>` the files of results, each once however many jobs have it.
//!
//! Names from outside never become paths: files are numbered or named by their contents, and what they are called stands in the queue. A
//! file gets its final name only when all of it is on the disk.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

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
        for part in [Path::new("uploads"), Path::new("objects"), Path::new("workers"), &incoming] {
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

    /// Where the queue stands.
    pub fn queue(&self) -> PathBuf {
        self.root.join("queue.sqlite")
    }

    /// Whether the process of a worker is gone.
    pub fn worker_is_gone(&self, owner: &str) -> bool {
        match fs::File::open(self.lock_file(owner)) {
            Ok(file) => file.try_lock().is_ok(),
            Err(error) => error.kind() == io::ErrorKind::NotFound,
        }
    }

    /// Removes what workers that are gone have left.
    pub fn remove_dead_workers(&self) {
        for folder in ["incoming", "workers"] {
            for entry in fs::read_dir(self.root.join(folder)).into_iter().flatten().flatten() {
                let name = entry.file_name();
                if let Some(owner) = name.to_str().filter(|n| !n.ends_with(UNLOCKED))
                    && self.worker_is_gone(owner)
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

    /// Takes a complete upload over. All its files have been synced.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub fn accept(&self, job: &str) -> Result<()> {
        let (from, to) = (self.incoming(job), self.uploads(job));
        sync_folder(&from).map_err(|e| disk(&from, &e))?;
        fs::rename(&from, &to).map_err(|e| disk(&to, &e))?;
        sync_folder(&self.root.join("uploads")).map_err(|e| disk(&to, &e))
    }

    /// Where the upload of a job lies.
    pub fn uploads(&self, job: &str) -> PathBuf {
        self.root.join("uploads").join(job)
    }

    /// Reads an upload, which lies in `folder`: each model with all side files.
    ///
    /// # Errors
    /// `unavailable`; `internal` where a file is gone.
    pub fn load(folder: &Path, manifest: &Manifest) -> Result<Vec<Vec<File>>> {
        let read = |stored: &UploadedFile| {
            let path = folder.join(stored.number.to_string());
            let bytes = fs::read(&path).map_err(|e| match e.kind() {
                io::ErrorKind::NotFound => {
                    Failure::internal("what was uploaded for this job is gone from the data folder")
                }
                _ => disk(&path, &e),
            })?;
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

    /// Stores the files of a result, whose objects are reserved, by their hashes. When this returns, they survive anything.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub fn store(&self, entries: &[ArtifactEntry], artifacts: &[Artifact]) -> Result<()> {
        let put = |entry: &ArtifactEntry, artifact: &Artifact| -> io::Result<()> {
            let object = self.object(&entry.sha256);
            let folder = object.parent().unwrap_or(&self.root);
            if fs::metadata(&object).is_ok_and(|m| m.len() == entry.bytes) {
                return Ok(());
            }
            fs::create_dir_all(folder)?;
            let partial = self.incoming(&format!("{}.object", new_id().map_err(io::Error::other)?));
            let mut file = fs::File::create_new(&partial)?;
            file.write_all(&artifact.bytes)?;
            file.sync_all()?;
            fs::rename(&partial, &object)?;
            sync_folder(folder)?;
            sync_folder(&self.root.join("objects"))
        };
        let stored = entries.iter().zip(artifacts).try_for_each(|(entry, artifact)| put(entry, artifact));
        stored.map_err(|e| disk(&self.root.join("objects"), &e))
    }

    /// Where an object is.
    pub fn object(&self, sha256: &str) -> PathBuf {
        self.root.join("objects").join(sha256.get(..2).unwrap_or("00")).join(sha256)
    }

    /// Removes an object.
    pub fn remove_object(&self, sha256: &str) {
        let path = self.object(sha256);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                tracing::warn!(path = %path.display(), %error, "could not remove an object");
            }
            _ => {}
        }
    }

    /// The hashes of all objects.
    pub fn objects(&self) -> Vec<String> {
        let folders = fs::read_dir(self.root.join("objects")).into_iter().flatten().flatten();
        let files = folders.flat_map(|folder| fs::read_dir(folder.path()).into_iter().flatten().flatten());
        files.filter_map(|file| file.file_name().into_string().ok()).collect()
    }

    /// Removes what was uploaded for a job.
    pub fn remove_uploads(&self, job: &str) {
        remove_folder(&self.incoming(job));
        remove_folder(&self.uploads(job));
    }

    /// Names of the jobs that have uploads which nobody touched for `age`.
    pub fn untouched(&self, age: Duration) -> Vec<String> {
        let before = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
        let uploads = fs::read_dir(self.root.join("uploads")).into_iter().flatten().flatten();
        let old = uploads.filter(|e| e.metadata().and_then(|m| m.modified()).is_ok_and(|m| m < before));
        let mut jobs: Vec<String> = old.filter_map(|e| e.file_name().into_string().ok()).collect();
        jobs.sort();
        jobs
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

fn remove_folder(path: &Path) {
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
    use std::collections::BTreeSet;

    use super::*;

    fn artifact(name: &str, bytes: &[u8]) -> Artifact {
        Artifact { name: name.into(), role: "model".into(), media_type: "text/plain".into(), bytes: bytes.to_vec() }
    }

    #[test]
    fn results_are_stored_by_their_contents_each_once() {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        let artifacts = [artifact("a b/c.txt", b"one"), artifact("b.txt", b"two"), artifact("c.txt", b"two")];
        let entries = entries("j", &artifacts);
        for _ in 0..2 {
            files.store(&entries, &artifacts).unwrap();
        }
        let hashes: BTreeSet<String> = entries.iter().map(|e| e.sha256.clone()).collect();
        assert_eq!((files.objects().len(), files.objects().into_iter().collect()), (2, hashes));
        assert_eq!(fs::read_dir(files.incoming("")).unwrap().count(), 0);
        assert_eq!((entries[0].href.as_deref(), entries[0].bytes), (Some("/v1/jobs/j/artifacts/a%20b%2Fc.txt"), 3));
        assert_eq!(fs::read(files.object(&entries[1].sha256)).unwrap(), b"two");
        files.remove_object(&entries[1].sha256);
        assert_eq!(files.objects().len(), 1);
    }

    #[test]
    fn workers_are_gone_when_their_lock_is_and_so_is_what_they_left() {
        let root = tempfile::tempdir().unwrap();
        let (files, other) = (Files::open(root.path()).unwrap(), Files::open(root.path()).unwrap());
        let (left, owner) = (other.incoming("j"), other.owner().to_owned());
        fs::create_dir_all(&left).unwrap();
        assert!(!files.worker_is_gone(&owner) && files.worker_is_gone("other"));
        files.remove_dead_workers();
        assert!(files.lock_file(&owner).exists() && left.exists());
        drop(other);
        assert!(files.worker_is_gone(&owner));
        files.remove_dead_workers();
        assert!(!files.lock_file(&owner).exists() && !left.exists() && files.incoming("").exists());
    }

    #[test]
    fn uploads_are_whole_or_not_there() {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        let stored = |path: &str, number| UploadedFile { path: path.into(), number, sha256: String::new() };
        let manifest =
            Manifest { models: vec![stored("a.glb", 0), stored("b.glb", 1)], files: vec![stored("t.png", 2)] };
        fs::create_dir_all(files.incoming("j")).unwrap();
        for n in 0..3 {
            fs::write(files.incoming("j").join(n.to_string()), [n]).unwrap();
        }
        assert!(Files::load(&files.uploads("j"), &manifest).is_err());
        files.accept("j").unwrap();
        let models = Files::load(&files.uploads("j"), &manifest).unwrap();
        let seen: Vec<Vec<(&str, u8)>> =
            models.iter().map(|m| m.iter().map(|f| (f.path.as_str(), f.bytes[0])).collect()).collect();
        assert_eq!(seen, [[("a.glb", 0), ("t.png", 2)], [("b.glb", 1), ("t.png", 2)]]);
        assert_eq!(files.untouched(Duration::ZERO), ["j"]);
        files.remove_uploads("j");
        assert!(files.untouched(Duration::ZERO).is_empty());
    }
}
