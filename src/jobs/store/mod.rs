//! Where uploads wait and results are kept: a folder, or an object store that many machines share, behind one trait.
//!
//! Objects are written once, under names that begin with the SHA-256 of their contents, and are checked against it when they are read. All
//! stores pass one suite ([`conformance`]).

#[cfg(test)]
mod conformance;
pub mod folder;
pub mod objects;
mod open;
pub mod ownership;
#[cfg(test)]
mod tests;

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use axum::body::Bytes;
use futures_util::stream::{BoxStream, StreamExt, try_unfold};
use sha2::{Digest, Sha256};

pub use self::open::open;
use super::files::Manifest;
use super::resumable::PieceStore;
use crate::error::{Code, Failure, Result};

/// Bytes of an object, part after part.
pub type Parts = BoxStream<'static, Result<Bytes>>;

/// A store. Every method fails with `insufficient_storage` or `unavailable` when what it is made of does.
#[async_trait]
pub trait Store: Send + Sync {
    /// Takes over the upload of a job, whose files lie in the folder `from` by their numbers. When this returns, it survives anything.
    async fn accept(&self, job: &str, from: &Path, inputs: &Manifest) -> Result<()>;

    /// The upload of a job on this machine. What has to be brought here goes to the folder `to`. `internal` where it is gone.
    async fn fetch(&self, job: &str, inputs: &Manifest, to: &Path) -> Result<FetchedUpload>;

    /// Removes the upload of a job.
    async fn remove_upload(&self, job: &str) -> Result<()>;

    /// The jobs of which there are uploads that nobody touched for `age`.
    async fn untouched_uploads(&self, age: Duration) -> Result<Vec<String>>;

    /// Stores an object under the name `place`, unless it is there. When this returns, it survives anything.
    async fn put(&self, place: &str, bytes: Bytes) -> Result<()>;

    /// A part of an object, in order. `gone` where there is none.
    async fn get(&self, place: &str, range: Range<u64>) -> Result<Parts>;

    /// Removes an object, if it is there.
    async fn remove(&self, place: &str) -> Result<()>;

    /// The names of all objects.
    async fn places(&self) -> Result<Vec<String>>;

    /// Whether it can be used; `deep` asks whoever is far away.
    async fn check(&self, deep: bool) -> Result<()>;

    /// Whether it can be looked through at no cost, and nobody else's files are in it for longer than a moment.
    fn is_local(&self) -> bool;

    /// What it is called in messages.
    fn name(&self) -> String;

    /// A short text that the store holds beside the objects.
    async fn marker(&self, name: &str) -> Result<Option<String>>;

    /// Stores such a text; false where there is one already and it shall not be replaced.
    async fn set_marker(&self, name: &str, text: &str, replace: bool) -> Result<bool>;

    /// Removes such a text.
    async fn remove_marker(&self, name: &str) -> Result<()>;

    /// Whether it holds neither uploads nor objects.
    async fn is_empty(&self) -> Result<bool>;

    /// Where the pieces of uploads are kept that are sent in pieces.
    fn pieces(&self) -> Arc<dyn PieceStore>;

    /// Removes what is left of attempts to store something that nobody has gone on with for `age`.
    async fn remove_unfinished(&self, age: Duration) -> Result<()>;
}

/// The upload of a job in a folder of this machine. What was brought here for it goes with it.
#[derive(Debug)]
pub struct FetchedUpload {
    folder: PathBuf,
    brought: bool,
}

impl FetchedUpload {
    /// Where its files lie by their numbers.
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

impl Drop for FetchedUpload {
    fn drop(&mut self) {
        if self.brought {
            super::files::remove_folder(&self.folder);
        }
    }
}

/// The folder of a store in which an object lies: many files in one folder are slow in some.
fn shelf(place: &str) -> &str {
    place.get(..2).unwrap_or("00")
}

/// The same parts, of which the last is only given when all of them have that hash: whoever reads an object that is damaged never has it
/// whole.
pub fn verified(parts: Parts, sha256: String) -> Parts {
    let start = (parts, Sha256::new(), None::<Bytes>, sha256);
    let checked = try_unfold(start, |(mut parts, mut hash, mut held, sha256)| async move {
        loop {
            match parts.next().await.transpose()? {
                Some(part) => {
                    hash.update(&part);
                    if let Some(before) = held.replace(part) {
                        return Ok(Some((before, (parts, hash, held, sha256))));
                    }
                }
                None => {
                    let Some(last) = held.take() else { return Ok(None) };
                    let found = hex::encode(hash.finalize());
                    if found != sha256 {
                        tracing::error!(sha256, found, "an object of the store is damaged");
                        return Err(Failure::internal("the stored file is damaged: it does not have its SHA-256"));
                    }
                    // Nothing follows.
                    let end: Parts = futures_util::stream::empty().boxed();
                    return Ok(Some((last, (end, Sha256::new(), None, sha256))));
                }
            }
        }
    });
    checked.boxed()
}

/// What is answered where an object is not there.
fn gone() -> Failure {
    Failure::new(Code::Gone, "the artifacts of this job have been removed")
}

/// What a job fails with whose upload is not there.
fn upload_is_gone() -> Failure {
    Failure::internal("what was uploaded for this job is gone from the store")
}
