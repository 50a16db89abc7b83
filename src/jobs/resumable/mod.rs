//! Uploads that are sent in pieces and go on after a break: what is known of them, their pieces, and how they become files of jobs.
//!
//! A piece is stored under a name of its own, and counts from when the row of its upload says so: what a connection, a process or a machine
//! leaves half-done is not there. Whoever sends holds the upload by a token. A newer sender takes it over, and pieces of the one before count
//! no more, so that nobody has to wait until a dead connection is noticed.

#[cfg(test)]
pub(super) mod conformance;
pub(super) mod pieces;
mod writer;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use serde::Serialize;
use sha2::{Digest, Sha256};
use tokio::io::AsyncWriteExt;
use utoipa::ToSchema;

pub(super) use self::pieces::removed_piece;
pub use self::pieces::{FolderPieces, PieceStore};
pub use self::writer::Writer;
use super::files::disk;
use super::record::{Timestamp, new_id};
use crate::error::{Code, Failure, Result};

/// What stands before the id of an upload where it stands for a file.
pub const PREFIX: &str = "upload:";
/// Pieces that nobody knows are removed when they are as old as this.
const ORPHANED_AFTER: Duration = Duration::from_secs(600);

/// An upload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, ToSchema)]
pub struct Upload {
    /// 128 random bits in hexadecimal digits. Knowing it is the right to use it.
    #[schema(pattern = "^[0-9a-f]{32}$")]
    pub id: String,
    /// What stands for it where a submission names a file.
    #[schema(pattern = "^upload:[0-9a-f]{32}$")]
    pub reference: String,
    /// What its user calls it.
    pub filename: Option<String>,
    /// Bytes that it will have.
    pub length: u64,
    /// Bytes that are here; it goes on from there.
    pub offset: u64,
    /// SHA-256 in hexadecimal digits: as it was declared until the upload is complete, then that of its bytes.
    pub sha256: Option<String>,
    /// Whether all bytes are here and are those that were declared.
    pub complete: bool,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it is removed; later with each piece that comes in.
    pub expires_at: Timestamp,
    /// Whose it is; empty for nobody's.
    #[serde(skip)]
    pub tenant: String,
    /// What its user told of it, as it came.
    #[serde(skip)]
    pub metadata: String,
}

/// A part of an upload that is stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Piece {
    /// The place of its first byte.
    pub start: u64,
    /// Its length.
    pub bytes: u64,
    /// Its name in the store of pieces.
    pub name: String,
}

/// How many uploads there may be.
#[derive(Debug, Clone, Copy)]
pub struct UploadBounds {
    /// Of all.
    pub all: u32,
    /// Of one tenant, where there are tenants.
    pub of_tenant: u32,
    /// Of one tenant that are not complete.
    pub incomplete: Option<u32>,
}

/// What uploads take.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct UploadBytes {
    /// Bytes that they will have.
    pub declared: u64,
    /// Bytes that are here.
    pub received: u64,
}

/// Where uploads are kept. Every method fails with `insufficient_storage` or `unavailable` when the backend does.
#[async_trait]
pub trait UploadStore: Send + Sync {
    /// Stores a new upload, of which nothing is here: `queue_full` or `quota_exceeded` where there are as many as there may be.
    async fn add_upload(&self, upload: &Upload, bounds: UploadBounds) -> Result<()>;

    /// An upload.
    async fn upload(&self, id: &str) -> Result<Option<Upload>>;

    /// Makes `holder` the only one who may add pieces; false where it is complete, gone or not at `offset`.
    async fn hold_upload(&self, id: &str, holder: &str, offset: u64) -> Result<bool>;

    /// Adds pieces, which follow each other, behind what is here, in one step; false where that is not the holder's any more.
    async fn add_pieces(&self, id: &str, holder: &str, pieces: &[Piece], expires_at: Timestamp) -> Result<bool>;

    /// The pieces of an upload, in order.
    async fn pieces(&self, id: &str) -> Result<Vec<Piece>>;

    /// Notes that all bytes are here, and their hash. False where there is no such upload.
    async fn complete_upload(&self, id: &str, sha256: &str) -> Result<bool>;

    /// Forgets an upload. False where there is none.
    async fn remove_upload(&self, id: &str) -> Result<bool>;

    /// The uploads that have expired at `now`.
    async fn expired_uploads(&self, now: Timestamp) -> Result<Vec<String>>;

    /// What uploads take: those of one tenant, or all.
    async fn upload_bytes(&self, tenant: Option<&str>) -> Result<UploadBytes>;
}

/// A new upload.
#[derive(Debug, Clone)]
pub struct NewUpload {
    /// Whose it is; empty for nobody's.
    pub tenant: String,
    /// What its user calls it.
    pub filename: Option<String>,
    /// What its user told of it, as it came.
    pub metadata: String,
    /// Bytes that it will have.
    pub length: u64,
    /// The SHA-256 that they will have, if that was declared.
    pub sha256: Option<String>,
}

/// Uploads and their pieces.
pub struct Resumable {
    store: Arc<dyn UploadStore>,
    pieces: Arc<dyn PieceStore>,
    keep: Duration,
}

impl Resumable {
    /// Uploads that stand in `store`, with their bytes in `pieces`, each kept for so long after its last byte.
    pub fn new(store: Arc<dyn UploadStore>, pieces: Arc<dyn PieceStore>, keep: Duration) -> Self {
        Resumable { store, pieces, keep }
    }

    /// Makes an upload.
    ///
    /// # Errors
    /// `queue_full`, `quota_exceeded`.
    pub async fn create(&self, new: NewUpload, bounds: UploadBounds) -> Result<Upload> {
        let (id, now) = (new_id()?, Timestamp::now());
        let upload = Upload {
            reference: format!("{PREFIX}{id}"),
            id,
            filename: new.filename,
            length: new.length,
            offset: 0,
            sha256: new.sha256,
            complete: false,
            created_at: now,
            expires_at: now.plus(self.keep),
            tenant: new.tenant,
            metadata: new.metadata,
        };
        self.store.add_upload(&upload, bounds).await?;
        tracing::info!(upload = upload.id, length = upload.length, "an upload begins");
        if upload.length == 0 { self.finish(&upload).await } else { Ok(upload) }
    }

    /// An upload that has not expired.
    ///
    /// # Errors
    /// `not_found`; `gone` for one that has expired.
    pub async fn get(&self, id: &str) -> Result<Upload> {
        let upload = self.store.upload(id).await?.ok_or_else(|| unknown_upload(id))?;
        if upload.expires_at <= Timestamp::now() {
            return Err(Failure::new(Code::Gone, "this upload has expired; begin it again"));
        }
        Ok(upload)
    }

    /// Whose an upload is; `None` where there is none.
    ///
    /// # Errors
    /// `unavailable`.
    pub async fn tenant_of(&self, id: &str) -> Result<Option<String>> {
        Ok(self.store.upload(id).await?.map(|upload| upload.tenant))
    }

    /// Takes an upload to add to it. With `at_once` each piece counts as soon as it is stored, else all do with [`Writer::commit`].
    ///
    /// # Errors
    /// `conflict` where it is not at that offset any more.
    pub async fn hold(self: &Arc<Self>, upload: &Upload, at_once: bool) -> Result<Writer> {
        let holder = new_id()?;
        if !self.store.hold_upload(&upload.id, &holder, upload.offset).await? {
            return Err(taken_over());
        }
        Ok(Writer::new(self.clone(), upload, holder, at_once))
    }

    /// Looks at the bytes of an upload that are all here, and notes that it is complete. One whose bytes are not those that were declared is
    /// removed: nobody can tell which of them are wrong.
    ///
    /// # Errors
    /// `checksum_mismatch`; `conflict` where bytes are missing.
    pub async fn finish(&self, upload: &Upload) -> Result<Upload> {
        let mut hash = Sha256::new();
        let mut end = 0;
        for piece in self.store.pieces(&upload.id).await? {
            let bytes = self.pieces.get(&upload.id, &piece.name).await?;
            if piece.start != end || bytes.len() as u64 != piece.bytes {
                return Err(damaged());
            }
            end += piece.bytes;
            hash.update(&bytes);
        }
        if end != upload.length {
            let message =
                format!("{end} of the {} bytes of this upload are here; send the others first", upload.length);
            return Err(Failure::new(Code::Conflict, message));
        }
        let found = hex::encode(hash.finalize());
        if let Some(declared) = upload.sha256.as_ref().filter(|declared| **declared != found) {
            self.remove(&upload.id).await?;
            let message = format!(
                "the bytes have the SHA-256 {found}, and {declared} was declared: the upload was removed, begin it again"
            );
            return Err(Failure::new(Code::ChecksumMismatch, message));
        }
        if !self.store.complete_upload(&upload.id, &found).await? {
            return Err(unknown_upload(&upload.id));
        }
        tracing::info!(upload = upload.id, sha256 = found, "an upload is complete");
        Ok(Upload { offset: end, sha256: Some(found), complete: true, ..upload.clone() })
    }

    /// Writes the bytes of a complete upload to a new file, and returns their hash.
    ///
    /// # Errors
    /// `unavailable` where they are not what they were.
    pub async fn copy(&self, upload: &Upload, to: &Path) -> Result<String> {
        let failed = |e: std::io::Error| disk(to, &e);
        let mut file = tokio::fs::File::create_new(to).await.map_err(failed)?;
        let mut hash = Sha256::new();
        for piece in self.store.pieces(&upload.id).await? {
            let bytes = self.pieces.get(&upload.id, &piece.name).await?;
            hash.update(&bytes);
            file.write_all(&bytes).await.map_err(failed)?;
        }
        file.flush().await.map_err(failed)?;
        file.sync_all().await.map_err(failed)?;
        let found = hex::encode(hash.finalize());
        if upload.sha256.as_ref() == Some(&found) { Ok(found) } else { Err(damaged()) }
    }

    /// Removes an upload.
    ///
    /// # Errors
    /// `not_found`.
    pub async fn remove(&self, id: &str) -> Result<()> {
        // Its row first: pieces without one are orphans, a row without its pieces would be a promise.
        if !self.store.remove_upload(id).await? {
            return Err(unknown_upload(id));
        }
        self.pieces.remove(id).await;
        Ok(())
    }

    /// What uploads take: those of one tenant, or all.
    ///
    /// # Errors
    /// `unavailable`.
    pub async fn bytes(&self, tenant: Option<&str>) -> Result<UploadBytes> {
        self.store.upload_bytes(tenant).await
    }

    /// Removes what has expired, and with `sweep` pieces that belong to no upload.
    ///
    /// # Errors
    /// `unavailable`.
    pub async fn maintain(&self, now: Timestamp, sweep: bool) -> Result<()> {
        for id in self.store.expired_uploads(now).await? {
            match self.remove(&id).await {
                Err(failure) if failure.code != Code::NotFound => return Err(failure),
                _ => tracing::info!(upload = id, "an upload has expired"),
            }
        }
        if sweep {
            for id in self.pieces.untouched(ORPHANED_AFTER).await {
                if self.store.upload(&id).await?.is_none() {
                    self.pieces.remove(&id).await;
                }
            }
        }
        Ok(())
    }
}

/// What is answered where there is no such upload, or none that the caller may know of.
pub fn unknown_upload(id: &str) -> Failure {
    Failure::new(Code::NotFound, format!("there is no upload `{}`", id.chars().take(64).collect::<String>()))
}

fn taken_over() -> Failure {
    let message = "another request adds to this upload, or has; ask for its offset (HEAD) and go on from there";
    Failure::new(Code::Conflict, message)
}

fn damaged() -> Failure {
    Failure::new(Code::Unavailable, "what is stored of this upload is not what was sent; delete it and begin it again")
}
