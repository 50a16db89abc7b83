//! The files of jobs: `uploads/<job>/<n>` and `artifacts/<job>/<attempt>/<n>` in the data folder.
//!
//! Names from outside never become paths: files are numbered, and what they are called stands in the queue. A folder
//! gets its final name only when everything in it is on the disk.

use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use zip::write::SimpleFileOptions;

use super::record::Entry;
use crate::asset::File;
use crate::error::{Failure, Result};
use crate::refine::run::Artifact;

/// Name of the archive with all of a result.
pub const ARCHIVE: &str = "result.zip";
/// Characters that need no escape in the last segment of a path (RFC 3986, unreserved).
const SEGMENT: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

/// End of the name of a worker's file that is not locked yet.
const YOUNG: &str = ".new";

/// What was uploaded, by the number of its file.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// The models, in order.
    pub models: Vec<Stored>,
    /// The files that they name.
    pub files: Vec<Stored>,
}

/// One uploaded file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stored {
    /// Relative path as its user calls it.
    pub path: String,
    /// Number of its file.
    pub number: usize,
}

/// The data folder.
#[derive(Debug, Clone)]
pub struct Files {
    root: PathBuf,
}

impl Files {
    /// Opens or makes the folder.
    ///
    /// # Errors
    /// `internal` with the system's words.
    pub fn open(root: &Path) -> Result<Self> {
        for part in ["uploads", "artifacts", "workers"] {
            let folder = root.join(part);
            fs::create_dir_all(&folder).map_err(|e| disk(&folder, &e))?;
        }
        Ok(Files { root: root.to_owned() })
    }

    /// Where the queue stands.
    pub fn queue(&self) -> PathBuf {
        self.root.join("queue.sqlite")
    }

    /// Registers a worker: a file that its process holds locked while it lives, whatever way it ends.
    ///
    /// # Errors
    /// `internal` with the system's words.
    pub fn register_worker(&self, owner: &str) -> Result<fs::File> {
        let (young, path) = (self.worker(&format!("{owner}{YOUNG}")), self.worker(owner));
        let lock = || {
            let file = fs::File::create_new(&young)?;
            file.lock()?;
            // Others look only at the final name, so they never see it unlocked while its process lives.
            fs::rename(&young, &path)?;
            Ok(file)
        };
        lock().map_err(|e| disk(&path, &e))
    }

    /// Whether the process of a worker is gone.
    pub fn worker_is_gone(&self, owner: &str) -> bool {
        match fs::File::open(self.worker(owner)) {
            Ok(file) => file.try_lock().is_ok(),
            Err(error) => error.kind() == io::ErrorKind::NotFound,
        }
    }

    /// Removes the files of workers that are gone.
    pub fn forget_workers(&self) {
        for entry in fs::read_dir(self.root.join("workers")).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if let Some(owner) = name.to_str().filter(|n| !n.ends_with(YOUNG))
                && self.worker_is_gone(owner)
            {
                let _ = fs::remove_file(entry.path());
            }
        }
    }

    fn worker(&self, owner: &str) -> PathBuf {
        self.root.join("workers").join(owner)
    }

    /// A folder for an upload that is under way.
    pub fn incoming(&self, job: &str) -> PathBuf {
        self.root.join("uploads").join(format!("{job}.part"))
    }

    /// Takes a complete upload over. All its files have been synced.
    ///
    /// # Errors
    /// `internal` with the system's words.
    pub fn accept(&self, job: &str) -> Result<()> {
        let (from, to) = (self.incoming(job), self.root.join("uploads").join(job));
        sync_folder(&from).map_err(|e| disk(&from, &e))?;
        fs::rename(&from, &to).map_err(|e| disk(&to, &e))?;
        sync_folder(&self.root.join("uploads")).map_err(|e| disk(&to, &e))
    }

    /// Reads an upload: each model with all side files.
    ///
    /// # Errors
    /// `internal` with the system's words.
    pub fn load(&self, job: &str, manifest: &Manifest) -> Result<Vec<Vec<File>>> {
        let folder = self.root.join("uploads").join(job);
        let read = |stored: &Stored| {
            let path = folder.join(stored.number.to_string());
            let bytes = fs::read(&path).map_err(|e| disk(&path, &e))?;
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

    /// Stores a result, with an archive of all of it, and says what there is.
    ///
    /// # Errors
    /// `internal` with the system's words; then nothing is left.
    pub fn store(&self, job: &str, attempt: u32, artifacts: &[Artifact]) -> Result<Vec<Entry>> {
        let folder = self.root.join("artifacts").join(job);
        let part = folder.join(format!("{attempt}.part"));
        let done = folder.join(attempt.to_string());
        let write = || -> io::Result<Vec<Entry>> {
            for stale in [&part, &done] {
                remove(stale)?;
            }
            fs::create_dir_all(&part)?;
            let mut entries = Vec::with_capacity(artifacts.len() + 1);
            for (number, artifact) in artifacts.iter().enumerate() {
                let mut file = fs::File::create_new(part.join(number.to_string()))?;
                file.write_all(&artifact.bytes)?;
                file.sync_all()?;
                let sha256 = hex::encode(Sha256::digest(&artifact.bytes));
                entries.push(entry(job, artifact, artifact.bytes.len() as u64, sha256));
            }
            if !artifacts.iter().any(|a| a.name == ARCHIVE) {
                let path = part.join(artifacts.len().to_string());
                archive(&path, artifacts)?;
                let (bytes, sha256) = measure(&path)?;
                let (name, role, media_type) = (ARCHIVE.into(), "archive".into(), "application/zip".into());
                entries.push(entry(job, &Artifact { name, role, media_type, bytes: Vec::new() }, bytes, sha256));
            }
            sync_folder(&part)?;
            fs::rename(&part, &done)?;
            sync_folder(&folder)?;
            sync_folder(&self.root.join("artifacts"))?;
            Ok(entries)
        };
        write().map_err(|e| {
            self.remove_attempt(job, attempt);
            disk(&done, &e)
        })
    }

    /// Where an artifact is.
    pub fn artifact(&self, job: &str, attempt: u32, number: usize) -> PathBuf {
        self.root.join("artifacts").join(job).join(attempt.to_string()).join(number.to_string())
    }

    /// Removes what an attempt has written.
    pub fn remove_attempt(&self, job: &str, attempt: u32) {
        let folder = self.root.join("artifacts").join(job);
        forget(&folder.join(format!("{attempt}.part")));
        forget(&folder.join(attempt.to_string()));
    }

    /// Removes what was uploaded for a job.
    pub fn remove_uploads(&self, job: &str) {
        forget(&self.incoming(job));
        forget(&self.root.join("uploads").join(job));
    }

    /// Removes the results of a job.
    pub fn remove_artifacts(&self, job: &str) {
        forget(&self.root.join("artifacts").join(job));
    }

    /// Names of the jobs that have files which nobody touched for `age`.
    pub fn untouched(&self, age: Duration) -> Vec<String> {
        let mut jobs = Vec::new();
        let before = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
        for part in ["uploads", "artifacts"] {
            for entry in fs::read_dir(self.root.join(part)).into_iter().flatten().flatten() {
                let old = entry.metadata().and_then(|m| m.modified()).is_ok_and(|m| m < before);
                if old && let Some(name) = entry.file_name().to_str() {
                    jobs.push(name.trim_end_matches(".part").to_owned());
                }
            }
        }
        jobs.sort();
        jobs.dedup();
        jobs
    }
}

fn entry(job: &str, artifact: &Artifact, bytes: u64, sha256: String) -> Entry {
    let href = format!("/v1/jobs/{job}/artifacts/{}", utf8_percent_encode(&artifact.name, SEGMENT));
    let Artifact { name, role, media_type, .. } = artifact;
    Entry { name: name.clone(), role: role.clone(), media_type: media_type.clone(), bytes, sha256, href }
}

/// An archive with fixed times, so that the same result has the same bytes.
fn archive(path: &Path, artifacts: &[Artifact]) -> io::Result<()> {
    let mut zip = zip::ZipWriter::new(io::BufWriter::new(fs::File::create_new(path)?));
    for artifact in artifacts {
        let packed = artifact.media_type.starts_with("image/");
        let method = if packed { zip::CompressionMethod::Stored } else { zip::CompressionMethod::Deflated };
        let options = SimpleFileOptions::default()
            .compression_method(method)
            .compression_level((!packed).then_some(1))
            .last_modified_time(zip::DateTime::default())
            .unix_permissions(0o644)
            .large_file(artifact.bytes.len() as u64 >= u64::from(u32::MAX));
        zip.start_file(artifact.name.as_str(), options).map_err(io::Error::other)?;
        zip.write_all(&artifact.bytes)?;
    }
    let file = zip.finish().map_err(io::Error::other)?.into_inner().map_err(io::IntoInnerError::into_error)?;
    file.sync_all()
}

/// Length and SHA-256 of a file.
fn measure(path: &Path) -> io::Result<(u64, String)> {
    let mut file = fs::File::open(path)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    let mut length = 0u64;
    loop {
        let n = file.read(&mut buffer)?;
        if n == 0 {
            return Ok((length, hex::encode(hash.finalize())));
        }
        length += n as u64;
        hash.update(buffer.get(..n).unwrap_or_default());
    }
}

fn sync_folder(path: &Path) -> io::Result<()> {
    // Only Unix can open a folder and sync it; elsewhere the rename is durable by itself or not at all.
    if cfg!(unix) { fs::File::open(path)?.sync_all() } else { Ok(()) }
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

fn forget(path: &Path) {
    if let Err(error) = remove(path) {
        tracing::warn!(path = %path.display(), %error, "could not remove a folder");
    }
}

/// A failure of the disk: the log gets the words, the user the fact.
pub fn disk(path: &Path, error: &io::Error) -> Failure {
    tracing::error!(path = %path.display(), %error, "the data folder failed");
    Failure::internal(format!("the data folder failed: {}", error.kind()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn artifact(name: &str, bytes: &[u8]) -> Artifact {
        Artifact { name: name.into(), role: "model".into(), media_type: "text/plain".into(), bytes: bytes.to_vec() }
    }

    #[test]
    fn results_are_stored_by_attempt_with_an_archive_of_the_same_bytes() {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        let artifacts = [artifact("a b/c.txt", b"one"), artifact("b.txt", b"two")];
        let first = files.store("j", 1, &artifacts).unwrap();
        let second = files.store("j", 2, &artifacts).unwrap();
        assert_eq!(first, second);
        assert_eq!(first[0].href, "/v1/jobs/j/artifacts/a%20b%2Fc.txt");
        assert_eq!(first[2].name, ARCHIVE);
        assert_eq!(fs::read(files.artifact("j", 1, 1)).unwrap(), b"two");
        let archive = fs::File::open(files.artifact("j", 1, 2)).unwrap();
        let mut archive = zip::ZipArchive::new(archive).unwrap();
        let mut text = String::new();
        archive.by_name("b.txt").unwrap().read_to_string(&mut text).unwrap();
        assert_eq!(text, "two");
        files.remove_attempt("j", 1);
        assert!(!files.artifact("j", 1, 1).exists() && files.artifact("j", 2, 1).exists());
    }

    #[test]
    fn workers_are_gone_when_their_lock_is() {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        let lock = files.register_worker("w").unwrap();
        assert!(!files.worker_is_gone("w") && files.worker_is_gone("other"));
        files.forget_workers();
        assert!(files.worker("w").exists());
        drop(lock);
        assert!(files.worker_is_gone("w"));
        files.forget_workers();
        assert!(!files.worker("w").exists());
    }

    #[test]
    fn uploads_are_whole_or_not_there() {
        let root = tempfile::tempdir().unwrap();
        let files = Files::open(root.path()).unwrap();
        let stored = |path: &str, number| Stored { path: path.into(), number };
        let manifest =
            Manifest { models: vec![stored("a.glb", 0), stored("b.glb", 1)], files: vec![stored("t.png", 2)] };
        fs::create_dir_all(files.incoming("j")).unwrap();
        for n in 0..3 {
            fs::write(files.incoming("j").join(n.to_string()), [n]).unwrap();
        }
        assert!(files.load("j", &manifest).is_err());
        files.accept("j").unwrap();
        let models = files.load("j", &manifest).unwrap();
        let seen: Vec<Vec<(&str, u8)>> =
            models.iter().map(|m| m.iter().map(|f| (f.path.as_str(), f.bytes[0])).collect()).collect();
        assert_eq!(seen, [[("a.glb", 0), ("t.png", 2)], [("b.glb", 1), ("t.png", 2)]]);
        assert_eq!(files.untouched(Duration::ZERO), ["j"]);
        files.remove_uploads("j");
        assert!(files.untouched(Duration::ZERO).is_empty());
    }
}
