//! An object store: S3 and what speaks like it, and others that `object_store` knows. `uploads/<job>/<n>`, `objects/<xx>/<name>`,
//! `pieces/<upload>/<name>`, and `staging/<random>` for what is too large for one request.

use std::io;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use axum::body::Bytes;
use futures_util::stream::{BoxStream, StreamExt, TryStreamExt, iter, once, try_unfold};
use object_store::path::Path as Key;
use object_store::{
    Error, MultipartUpload, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload, WriteMultipart,
};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::{FetchedUpload, Parts, Store, gone, shelf, upload_is_gone};
use crate::error::{Code, Failure, Result};
use crate::jobs::files::{Manifest, disk};
use crate::jobs::record::new_id;
use crate::jobs::resumable::{PieceStore, removed_piece};

/// Bytes that are asked for at once.
const PART: u64 = 4 << 20;
/// What is larger is sent in parts of this size, so many at the same time.
const LARGE: usize = 16 << 20;
const PARTS_AT_ONCE: usize = 4;
/// Files of an upload that are brought at the same time.
const FILES_AT_ONCE: usize = 4;

/// A store of objects under a prefix.
#[derive(Debug, Clone)]
pub struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: Key,
    name: String,
}

impl Objects {
    /// The store under `prefix`, called `name` in messages.
    pub fn new(store: Arc<dyn ObjectStore>, prefix: Key, name: String) -> Self {
        Objects { store, prefix, name }
    }

    /// Makes sure that of two that create one object only one does: what a store does not keep to, nothing may rest on.
    ///
    /// # Errors
    /// `unavailable`: the store cannot be used, or it does not keep to it.
    pub async fn probe(&self) -> Result<()> {
        let key = self.key(&["probe", &new_id()?]);
        let create = || self.store.put_opts(&key, PutPayload::from_static(b"probe"), PutMode::Create.into());
        create().await.map_err(|e| self.failed(&e))?;
        let again = create().await;
        let removed = self.store.delete(&key).await;
        match again {
            Err(Error::AlreadyExists { .. }) => removed.map_err(|e| self.failed(&e)),
            Err(error) => Err(self.failed(&error)),
            Ok(_) => Err(Failure::new(
                Code::Unavailable,
                format!(
                    "{} lets an object be created that is there already (it ignores `If-None-Match: *`), so it cannot be shared: use a store \
                     that keeps to it, or a newer version of this one",
                    self.name
                ),
            )),
        }
    }

    fn key(&self, parts: &[&str]) -> Key {
        parts.iter().fold(self.prefix.clone(), |key, part| key.join(*part))
    }

    fn object(&self, place: &str) -> Key {
        self.key(&["objects", shelf(place), place])
    }

    /// What a failure of the store is: the machine's trouble, which ends no job.
    fn failed(&self, error: &Error) -> Failure {
        tracing::debug!(%error, "the store failed");
        let name = &self.name;
        let message = match error {
            Error::PermissionDenied { .. } => {
                format!("{name} may not be used with these credentials: they need to read, write, list and delete")
            }
            Error::Unauthenticated { .. } => format!("{name} does not know these credentials"),
            Error::NotFound { .. } => format!("{name} is not there, or something in it is not: does the bucket exist?"),
            _ => format!("{name} does not answer as it should"),
        };
        Failure::new(Code::Unavailable, message)
    }

    fn list(&self, folder: &str) -> BoxStream<'static, Result<ObjectMeta>> {
        let (of, listed) = (self.clone(), self.store.list(Some(&self.key(&[folder]))));
        listed.map_err(move |e| of.failed(&e)).boxed()
    }

    /// The folders within `folder` of whose objects none is younger than `age`.
    async fn untouched_in(&self, folder: &str, age: Duration) -> Result<Vec<String>> {
        let before = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
        let mut newest = std::collections::BTreeMap::<String, SystemTime>::new();
        let mut listed = self.list(folder);
        while let Some(found) = listed.next().await.transpose()? {
            let mut parts = found.location.parts().rev();
            let Some(job) = parts.nth(1) else { continue };
            let touched = SystemTime::from(found.last_modified);
            let of_job = newest.entry(job.as_ref().to_owned()).or_insert(touched);
            *of_job = touched.max(*of_job);
        }
        Ok(newest.into_iter().filter(|(_, touched)| *touched < before).map(|(job, _)| job).collect())
    }

    /// Removes all objects whose names begin with that of a folder.
    async fn remove_folder(&self, folder: &Key) -> Result<()> {
        let keys = self.store.list(Some(folder)).map_ok(|found| found.location).boxed();
        let removed = self.store.delete_stream(keys).try_for_each(|_| async { Ok(()) }).await;
        match removed {
            Err(Error::NotFound { .. }) => Ok(()),
            removed => removed.map_err(|e| self.failed(&e)),
        }
    }

    /// Bytes of an object, if it is there.
    async fn length(&self, key: &Key) -> Result<Option<u64>> {
        match self.store.head(key).await {
            Ok(found) => Ok(Some(found.size)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed(&error)),
        }
    }

    /// Stores an object that nobody has, in one step. False where somebody has it now.
    async fn create(&self, key: &Key, bytes: Bytes) -> Result<bool> {
        let created = if bytes.len() <= LARGE {
            self.store.put_opts(key, bytes.into(), PutOptions::from(PutMode::Create)).await.map(|_| ())
        } else {
            // Parts know no condition, a copy does.
            let staged = self.key(&["staging", &new_id()?]);
            let upload = self.store.put_multipart(&staged).await.map_err(|e| self.failed(&e))?;
            let parts = iter([Ok(bytes)]);
            self.send(upload, parts.boxed()).await?;
            let copied = self.store.copy_if_not_exists(&staged, key).await;
            // What stays here is removed by maintenance.
            if let Err(error) = self.store.delete(&staged).await {
                tracing::debug!(%error, "an object stays in staging");
            }
            copied
        };
        match created {
            Ok(()) => Ok(true),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
            Err(error) => Err(self.failed(&error)),
        }
    }

    /// Sends an object in parts.
    async fn send(&self, upload: Box<dyn MultipartUpload>, mut parts: BoxStream<'_, Result<Bytes>>) -> Result<()> {
        let mut writer = WriteMultipart::new_with_chunk_size(upload, LARGE);
        while let Some(part) = parts.next().await {
            let part = match part {
                Ok(part) => part,
                Err(failure) => {
                    let _ = writer.abort().await;
                    return Err(failure);
                }
            };
            writer.wait_for_capacity(PARTS_AT_ONCE).await.map_err(|e| self.failed(&e))?;
            writer.put(part);
        }
        // On failure the parts are aborted as far as the store can still be reached.
        writer.finish().await.map(|_| ()).map_err(|e| self.failed(&e))
    }

    /// Sends a file of this machine.
    async fn send_file(&self, from: &Path, key: &Key) -> Result<()> {
        let failed = |e: io::Error| disk(from, &e);
        let length = tokio::fs::metadata(from).await.map_err(failed)?.len();
        if length <= LARGE as u64 {
            let bytes = tokio::fs::read(from).await.map_err(failed)?;
            return self.store.put(key, bytes.into()).await.map(|_| ()).map_err(|e| self.failed(&e));
        }
        let file = File::open(from).await.map_err(failed)?;
        let parts = try_unfold(file, |mut file| async move {
            let mut part = Vec::with_capacity(PART as usize);
            let n = (&mut file).take(PART).read_to_end(&mut part).await.map_err(failed)?;
            Ok((n > 0).then(|| (Bytes::from(part), file)))
        });
        let upload = self.store.put_multipart(key).await.map_err(|e| self.failed(&e))?;
        self.send(upload, parts.boxed()).await
    }

    /// Brings an object to a file of this machine.
    async fn bring(&self, key: &Key, to: &Path) -> Result<()> {
        let failed = |e: io::Error| disk(to, &e);
        let length = self.length(key).await?.ok_or_else(upload_is_gone)?;
        let mut file = File::create(to).await.map_err(failed)?;
        let mut parts = self.parts(key.clone(), 0..length);
        while let Some(part) = parts.next().await {
            file.write_all(&part?).await.map_err(failed)?;
        }
        file.flush().await.map_err(failed)
    }

    /// A range of an object, in requests of a size that one answer can be waited for: what breaks off is asked for again, and only that.
    fn parts(&self, key: Key, range: Range<u64>) -> Parts {
        let parts = try_unfold((self.clone(), key, range), |(of, key, left)| async move {
            if left.is_empty() {
                return Ok(None);
            }
            let end = left.end.min(left.start + PART);
            let part = of.store.get_range(&key, left.start..end).await;
            let part = part.map_err(|e| match e {
                Error::NotFound { .. } => gone(),
                e => of.failed(&e),
            })?;
            if part.len() as u64 != end - left.start {
                return Err(of.failed(&Error::Generic { store: "store", source: "a part is too short".into() }));
            }
            Ok(Some((part, (of, key, end..left.end))))
        });
        parts.boxed()
    }
}

#[async_trait]
impl Store for Objects {
    async fn accept(&self, job: &str, from: &Path, inputs: &Manifest) -> Result<()> {
        let numbers = inputs.models.iter().chain(&inputs.files).map(|file| file.number.to_string());
        let send = |number: String| async move {
            self.send_file(&from.join(&number), &self.key(&["uploads", job, &number])).await
        };
        iter(numbers.map(Ok)).try_for_each_concurrent(FILES_AT_ONCE, send).await?;
        // The copy that was received here has done its service.
        super::super::files::remove_folder(from);
        Ok(())
    }

    async fn fetch(&self, job: &str, inputs: &Manifest, to: &Path) -> Result<FetchedUpload> {
        tokio::fs::create_dir_all(to).await.map_err(|e| disk(to, &e))?;
        // Whatever comes of it, the folder goes when it is not needed.
        let fetched = FetchedUpload { folder: to.to_owned(), brought: true };
        let numbers = inputs.models.iter().chain(&inputs.files).map(|file| file.number.to_string());
        let bring =
            |number: String| async move { self.bring(&self.key(&["uploads", job, &number]), &to.join(&number)).await };
        iter(numbers.map(Ok)).try_for_each_concurrent(FILES_AT_ONCE, bring).await?;
        Ok(fetched)
    }

    async fn remove_upload(&self, job: &str) -> Result<()> {
        self.remove_folder(&self.key(&["uploads", job])).await
    }

    async fn untouched_uploads(&self, age: Duration) -> Result<Vec<String>> {
        self.untouched_in("uploads", age).await
    }

    async fn put(&self, place: &str, bytes: Bytes) -> Result<()> {
        let (key, length) = (self.object(place), bytes.len() as u64);
        // What is there need not be sent.
        if self.length(&key).await? == Some(length) {
            return Ok(());
        }
        if self.create(&key, bytes).await? || self.length(&key).await? == Some(length) {
            return Ok(());
        }
        let message = format!("{} says that an object is there, and does not show it: it is tried again", self.name);
        Err(Failure::new(Code::Unavailable, message))
    }

    async fn get(&self, place: &str, range: Range<u64>) -> Result<Parts> {
        let key = self.object(place);
        if range.is_empty() {
            return self.length(&key).await?.map(|_| futures_util::stream::empty().boxed()).ok_or_else(gone);
        }
        // The first part tells whether it is there, before anything is answered.
        let mut parts = self.parts(key, range);
        let first = parts.next().await.transpose()?;
        Ok(once(async { Ok(first.unwrap_or_default()) }).chain(parts).boxed())
    }

    async fn remove(&self, place: &str) -> Result<()> {
        match self.store.delete(&self.object(place)).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.failed(&error)),
        }
    }

    async fn places(&self) -> Result<Vec<String>> {
        let names = self.list("objects").map_ok(|found| found.location.filename().map(str::to_owned));
        names.try_filter_map(|name| async { Ok(name) }).try_collect().await
    }

    async fn check(&self, deep: bool) -> Result<()> {
        if deep {
            self.marker("identity").await?;
        }
        Ok(())
    }

    fn pieces(&self) -> Arc<dyn PieceStore> {
        Arc::new(self.clone())
    }

    fn is_local(&self) -> bool {
        false
    }

    fn name(&self) -> String {
        self.name.clone()
    }

    async fn marker(&self, name: &str) -> Result<Option<String>> {
        let found = match self.store.get(&self.key(&[name])).await {
            Ok(found) => found.bytes().await.map_err(|e| self.failed(&e))?,
            Err(Error::NotFound { .. }) => return Ok(None),
            Err(error) => return Err(self.failed(&error)),
        };
        Ok(Some(String::from_utf8_lossy(&found).trim().to_owned()))
    }

    async fn set_marker(&self, name: &str, text: &str, replace: bool) -> Result<bool> {
        let mode = if replace { PutMode::Overwrite } else { PutMode::Create };
        match self.store.put_opts(&self.key(&[name]), format!("{text}\n").into(), mode.into()).await {
            Ok(_) => Ok(true),
            Err(Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(self.failed(&error)),
        }
    }

    async fn remove_marker(&self, name: &str) -> Result<()> {
        match self.store.delete(&self.key(&[name])).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.failed(&error)),
        }
    }

    async fn is_empty(&self) -> Result<bool> {
        for folder in ["objects", "uploads"] {
            if self.list(folder).next().await.transpose()?.is_some() {
                return Ok(false);
            }
        }
        Ok(true)
    }

    async fn remove_unfinished(&self, age: Duration) -> Result<()> {
        let before = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
        for folder in ["staging", "probe"] {
            let mut listed = self.list(folder);
            while let Some(found) = listed.next().await.transpose()? {
                if SystemTime::from(found.last_modified) < before {
                    self.store.delete(&found.location).await.map_err(|e| self.failed(&e))?;
                }
            }
        }
        Ok(())
    }
}

/// Pieces of uploads: `pieces/<upload>/<name>`.
#[async_trait]
impl PieceStore for Objects {
    async fn put(&self, upload: &str, name: &str, bytes: Bytes) -> Result<()> {
        let put = self.store.put(&self.key(&["pieces", upload, name]), bytes.into()).await;
        put.map(|_| ()).map_err(|e| self.failed(&e))
    }

    async fn get(&self, upload: &str, name: &str) -> Result<Bytes> {
        let failed = |e: Error| match e {
            Error::NotFound { .. } => removed_piece(),
            e => self.failed(&e),
        };
        let found = self.store.get(&self.key(&["pieces", upload, name])).await.map_err(failed)?;
        found.bytes().await.map_err(failed)
    }

    async fn remove_piece(&self, upload: &str, name: &str) {
        let _ = self.store.delete(&self.key(&["pieces", upload, name])).await;
    }

    async fn remove(&self, upload: &str) {
        if let Err(failure) = self.remove_folder(&self.key(&["pieces", upload])).await {
            tracing::warn!(%failure, "the pieces of an upload stay for now");
        }
    }

    async fn untouched(&self, age: Duration) -> Vec<String> {
        self.untouched_in("pieces", age).await.unwrap_or_default()
    }
}
