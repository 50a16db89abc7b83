//! Adds to an upload, piece by piece.

use std::sync::Arc;

use hyper::body::Bytes;

use super::{Piece, Resumable, Upload, taken_over};
use crate::error::Result;
use crate::jobs::record::Timestamp;

/// Bytes of a piece, but for the last: what is lost at most when the process dies.
const PIECE: usize = 4 << 20;

/// Whoever adds to an upload.
pub struct Writer {
    resumable: Arc<Resumable>,
    upload: String,
    holder: String,
    at_once: bool,
    /// The end of the pieces that are stored.
    end: u64,
    buffer: Vec<u8>,
    /// Pieces that are stored and do not count yet.
    pending: Vec<Piece>,
}

impl Writer {
    pub(super) fn new(resumable: Arc<Resumable>, upload: &Upload, holder: String, at_once: bool) -> Self {
        let (end, upload) = (upload.offset, upload.id.clone());
        Writer { resumable, upload, holder, at_once, end, buffer: Vec::new(), pending: Vec::new() }
    }

    /// The offset behind all that was written.
    pub fn offset(&self) -> u64 {
        self.end + self.buffer.len() as u64
    }

    /// Takes bytes.
    ///
    /// # Errors
    /// `conflict` where another has taken the upload over; `insufficient_storage`, `unavailable`.
    pub async fn write(&mut self, mut bytes: &[u8]) -> Result<()> {
        while !bytes.is_empty() {
            let (now, rest) = bytes.split_at(bytes.len().min(PIECE - self.buffer.len()));
            self.buffer.extend_from_slice(now);
            bytes = rest;
            if self.buffer.len() == PIECE {
                self.store().await?;
                if self.at_once {
                    self.count().await?;
                }
            }
        }
        Ok(())
    }

    /// Stores what has come, and lets it count. When this returns, it survives anything. Returns the offset.
    ///
    /// # Errors
    /// As [`Writer::write`].
    pub async fn commit(&mut self) -> Result<u64> {
        if !self.buffer.is_empty() {
            self.store().await?;
        }
        self.count().await?;
        Ok(self.end)
    }

    /// Gives up what does not count yet.
    pub async fn discard(self) {
        for piece in &self.pending {
            self.resumable.pieces.remove_piece(&self.upload, &piece.name).await;
        }
    }

    async fn store(&mut self) -> Result<()> {
        let bytes = Bytes::from(std::mem::take(&mut self.buffer));
        let (start, length) = (self.end, bytes.len() as u64);
        let name = format!("{start:016x}-{}", self.holder);
        self.resumable.pieces.put(&self.upload, &name, bytes).await?;
        self.pending.push(Piece { start, bytes: length, name });
        self.end += length;
        Ok(())
    }

    async fn count(&mut self) -> Result<()> {
        if self.pending.is_empty() {
            return Ok(());
        }
        let expires_at = Timestamp::now().plus(self.resumable.keep);
        if !self.resumable.store.add_pieces(&self.upload, &self.holder, &self.pending, expires_at).await? {
            return Err(taken_over());
        }
        self.pending.clear();
        Ok(())
    }
}
