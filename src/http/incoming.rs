//! The files of a submission while it is received: streamed to the disk or taken from finished uploads, checked, measured.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use futures_util::{Stream, StreamExt};
use serde_json::Value;
use sha2::{Digest, Sha256};
use tokio::io::AsyncWriteExt;
use tokio::time::timeout;

use super::App;
use super::access::Caller;
use super::preflight;
use super::problem::{HandlerResult, Problem};
use super::references::reference;
use super::upload::{RATE_GRACE, stalled, too_large};
use crate::asset::{Demand, estimate};
use crate::config::Limits;
use crate::error::{Code, Failure};
use crate::jobs::build;
use crate::jobs::files::{Manifest, UploadedFile, disk};
use crate::jobs::record::new_id;
use crate::params::Problem as OptionProblem;

/// Files of a pool.
const MAX_POOL: usize = 10_000;
/// Bytes that `upload:` and an id take at most, with a line end behind it.
const MAX_REFERENCE: usize = 48;

/// How long the next bytes may take when so many have come since then: so long as an upload may stand still, and no longer than the least rate
/// allows.
pub(super) fn patience(limits: &Limits, bytes: u64, since: Instant) -> Duration {
    let earned = Duration::from_secs_f64(bytes as f64 / limits.min_upload_rate.max(1) as f64);
    let left = RATE_GRACE.saturating_add(earned).saturating_sub(since.elapsed());
    limits.upload_idle.min(left)
}

/// An upload under way. When it is dropped before the queue has taken it, its files go.
pub(super) struct IncomingUpload<'a> {
    app: &'a App,
    /// The job that it will be.
    pub(super) id: String,
    folder: PathBuf,
    tenant: String,
    /// What is here.
    pub(super) manifest: Manifest,
    /// Bytes of all its files.
    pub(super) bytes: u64,
    /// Bytes of them that came with the request.
    pub(super) sent: u64,
    /// How many files there may be, and their bytes.
    most: (usize, u64),
    started: Instant,
    taken: bool,
}

impl<'a> IncomingUpload<'a> {
    /// An empty one.
    pub(super) async fn new(app: &'a App, caller: &Caller) -> HandlerResult<Self> {
        let id = new_id()?;
        let folder = app.jobs.files.incoming(&id);
        tokio::fs::create_dir_all(&folder).await.map_err(|e| disk(&folder, &e))?;
        Ok(IncomingUpload {
            app,
            id,
            folder,
            tenant: caller.tenant().to_owned(),
            manifest: Manifest::default(),
            bytes: 0,
            sent: 0,
            most: (app.jobs.limits.max_files, app.jobs.limits.max_upload),
            started: Instant::now(),
            taken: false,
        })
    }

    /// One that holds files of several jobs, for [`IncomingUpload::link`]: what the request itself holds is bounded, and each job.
    pub(super) async fn pool(app: &'a App, caller: &Caller) -> HandlerResult<Self> {
        let mut pool = Self::new(app, caller).await?;
        pool.most = (MAX_POOL, u64::MAX);
        Ok(pool)
    }

    /// Takes a file of a pool under another path.
    pub(super) async fn link(
        &mut self,
        pool: &IncomingUpload<'_>,
        file: &UploadedFile,
        path: String,
    ) -> HandlerResult<UploadedFile> {
        let (number, to) = self.next()?;
        let from = pool.folder.join(file.number.to_string());
        let linked = tokio::task::spawn_blocking(move || {
            let bytes = std::fs::metadata(&from)?.len();
            std::fs::hard_link(&from, &to)
                .or_else(|_| std::fs::copy(&from, &to).and_then(|_| std::fs::File::open(&to)?.sync_all()))?;
            Ok(bytes)
        });
        let linked = linked.await.map_err(|e| Failure::internal(format!("a file was lost: {e}")))?;
        let bytes = linked.map_err(|e: std::io::Error| Problem::from(disk(&self.folder, &e)))?;
        self.count(bytes)?;
        Ok(UploadedFile { path, number, sha256: file.sha256.clone() })
    }

    /// The number of the next file, and where it goes.
    fn next(&self) -> HandlerResult<(usize, PathBuf)> {
        let number = self.manifest.models.len() + self.manifest.files.len();
        let (most, _) = self.most;
        if number >= most {
            return Err(Problem::new(Code::TooLarge, format!("a submission has at most {most} files")));
        }
        Ok((number, self.folder.join(number.to_string())))
    }

    /// Counts bytes of a file.
    fn count(&mut self, bytes: u64) -> HandlerResult<()> {
        self.bytes = self.bytes.saturating_add(bytes);
        let (_, most) = self.most;
        if self.bytes > most { Err(too_large(most)) } else { Ok(()) }
    }

    /// Streams one file to the disk; one that holds only `upload:` and an id is that upload.
    pub(super) async fn store<E: std::fmt::Display>(
        &mut self,
        name: String,
        stream: impl Stream<Item = Result<Bytes, E>>,
    ) -> HandlerResult<UploadedFile> {
        let (number, path) = self.next()?;
        let failed = |e: std::io::Error| Problem::from(disk(&path, &e));
        let mut file = tokio::fs::File::create_new(&path).await.map_err(failed)?;
        let mut hash = Sha256::new();
        let (mut head, before) = (Vec::new(), self.bytes);
        let mut stream = std::pin::pin!(stream);
        while let Some(chunk) = timeout(self.patience(), stream.next()).await.map_err(|_| stalled())? {
            let chunk = chunk.map_err(|e| Problem::new(Code::InvalidRequest, format!("the upload broke off: {e}")))?;
            self.count(chunk.len() as u64)?;
            self.sent += chunk.len() as u64;
            if self.sent > self.app.jobs.limits.max_upload {
                return Err(too_large(self.app.jobs.limits.max_upload));
            }
            if head.len() < MAX_REFERENCE {
                head.extend(chunk.iter().take(MAX_REFERENCE - head.len()));
            }
            hash.update(&chunk);
            file.write_all(&chunk).await.map_err(failed)?;
        }
        file.flush().await.map_err(failed)?;
        let written = self.bytes - before;
        let text = std::str::from_utf8(&head).ok().filter(|text| text.len() as u64 == written);
        if let Some(id) = text.and_then(|text| reference(text.trim())) {
            drop(file);
            tokio::fs::remove_file(&path).await.map_err(failed)?;
            self.bytes = before;
            return self.take_upload(id, Some(name), "").await;
        }
        file.sync_all().await.map_err(failed)?;
        Ok(UploadedFile { path: name, number, sha256: hex::encode(hash.finalize()) })
    }

    /// Takes a complete upload as a file, for which the request names it at `pointer`. Without a path, it has the one that it was given when it
    /// began.
    pub(super) async fn take_upload(
        &mut self,
        id: &str,
        path: Option<String>,
        pointer: &str,
    ) -> HandlerResult<UploadedFile> {
        let missing = |why: String| {
            let problem = OptionProblem::new(pointer, why.clone());
            Problem { errors: vec![problem], ..Problem::new(Code::MissingFile, why) }
        };
        let resumable = &self.app.jobs.resumable;
        let found = match resumable.get(id).await {
            Ok(upload) if upload.tenant == self.tenant => upload,
            Ok(_) => return Err(missing(format!("there is no upload `{id}`"))),
            Err(failure) if matches!(failure.code, Code::NotFound | Code::Gone) => {
                return Err(missing(format!("there is no upload `{id}`, or it has expired")));
            }
            Err(failure) => return Err(failure.into()),
        };
        if found.offset < found.length {
            let (here, all) = (found.offset, found.length);
            return Err(missing(format!(
                "{here} of the {all} bytes of the upload `{id}` are here; send the others first"
            )));
        }
        // Where the service went down between the last byte and the look at all of them.
        let found = if found.complete { found } else { resumable.finish(&found).await? };
        let (number, to) = self.next()?;
        self.count(found.length)?;
        let sha256 = resumable.copy(&found, &to).await?;
        let path = path.or(found.filename).unwrap_or_else(|| "model".to_owned());
        Ok(UploadedFile { path, number, sha256 })
    }

    /// Adds a file that is stored.
    pub(super) fn add(&mut self, file: UploadedFile, is_model: bool) -> HandlerResult<()> {
        if is_model {
            self.manifest.models.push(file);
            return Ok(());
        }
        self.check_path_unused(&file.path)?;
        self.manifest.files.push(file);
        Ok(())
    }

    /// Adds a file of a pool that items name by another name than its path.
    pub(super) fn add_unnamed(&mut self, file: UploadedFile) {
        self.manifest.files.push(file);
    }

    /// No two files have one path.
    pub(super) fn check_path_unused(&self, path: &str) -> HandlerResult<()> {
        let taken = self.manifest.files.iter().any(|f| f.path == path);
        if taken { Err(Problem::new(Code::InvalidRequest, format!("two files are called `{path}`"))) } else { Ok(()) }
    }

    /// The cheap checks of every model.
    pub(super) async fn check(&mut self) -> HandlerResult<()> {
        if self.manifest.models.is_empty() {
            return Err(Problem::new(Code::InvalidRequest, "the submission has no `model`"));
        }
        let most = self.app.jobs.limits.max_json;
        for model in &mut self.manifest.models {
            let (path, name) = (self.folder.join(model.number.to_string()), model.path.clone());
            let kind = tokio::task::spawn_blocking(move || preflight::check(&path, &name, most)).await;
            let kind = kind.map_err(|e| Failure::internal(format!("the check was lost: {e}")))??;
            // A body without a name gets the one that belongs to its contents.
            if !model.path.contains('.') {
                model.path = format!("{}.{kind}", model.path);
            }
        }
        Ok(())
    }

    /// Bytes that the job is expected to need, by the headers of its files and what its recipe does.
    pub(super) async fn memory(&self, demand: Demand) -> HandlerResult<u64> {
        let (folder, manifest, limits) =
            (self.folder.clone(), self.manifest.clone(), crate::asset::Limits::from(&self.app.jobs.limits));
        let threads = self.app.jobs.slots.threads();
        let estimated = tokio::task::spawn_blocking(move || {
            let at = |stored: &UploadedFile| folder.join(stored.number.to_string());
            let files: Vec<(&str, PathBuf)> = manifest.files.iter().map(|f| (f.path.as_str(), at(f))).collect();
            let files: Vec<(&str, &Path)> = files.iter().map(|(name, path)| (*name, path.as_path())).collect();
            let mut models = manifest.models.iter();
            models.try_fold(0u64, |sum, model| -> Result<u64, Failure> {
                Ok(sum.saturating_add(estimate((&model.path, &at(model)), &files, &limits, threads, demand)?.bytes))
            })
        });
        let bytes = estimated.await.map_err(|e| Failure::internal(format!("the estimate was lost: {e}")))??;
        let most = self.app.jobs.slots.memory();
        if bytes > most {
            let detail =
                format!("the job would need about {bytes} bytes of memory; this service has {most} for all jobs");
            return Err(Problem::new(Code::TooLarge, detail));
        }
        Ok(bytes)
    }

    /// How long the next bytes may take: so long as an upload may stand still, and no longer than the least rate allows.
    pub(super) fn patience(&self) -> Duration {
        patience(&self.app.jobs.limits, self.sent, self.started)
    }

    /// Fingerprint of this request: its options, and its files by name and contents.
    pub(super) fn fingerprint(&self, options: &Value) -> String {
        let mut hash = Sha256::new();
        hash.update(options.to_string());
        for (kind, files) in [("model", &self.manifest.models), ("file", &self.manifest.files)] {
            for file in files {
                hash.update(format!("\n{kind} {} {}", file.sha256, file.path));
            }
        }
        hex::encode(hash.finalize())
    }

    /// What the result follows from, where it may be reused: equal options, files, limits and programs give equal bytes, unless there is a
    /// limit on time. What is only returned or told is no part of it.
    pub(super) async fn result_key(&self, options: &Value) -> Option<String> {
        if options.get("reuse") != Some(&Value::Bool(true)) || options.get("time_limit_s").is_some_and(|s| !s.is_null())
        {
            return None;
        }
        let build = build().await?;
        let mut options = options.as_object()?.clone();
        for told in ["reuse", "webhook", "metadata"] {
            options.remove(told);
        }
        let limits = crate::asset::Limits::from(&self.app.jobs.limits);
        let all = format!("{build}\n{limits:?}\n{}", self.fingerprint(&Value::Object(options)));
        Some(hex::encode(Sha256::digest(all)))
    }

    /// Leaves the files to the job.
    pub(super) fn leave(&mut self) {
        self.taken = true;
    }
}

impl Drop for IncomingUpload<'_> {
    fn drop(&mut self) {
        if !self.taken {
            self.app.jobs.files.remove_incoming(&self.id);
        }
    }
}
