//! Where the bytes of uploads are: pieces under names that are used once.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use hyper::body::Bytes;

use crate::error::{Code, Failure, Result};
use crate::jobs::files::{disk, sync_folder};

/// A store of pieces, which are small enough to be held in memory. Names are used once, so nothing is ever overwritten.
#[async_trait]
pub trait PieceStore: Send + Sync {
    /// Stores a piece. When this returns, it survives anything.
    async fn put(&self, upload: &str, name: &str, bytes: Bytes) -> Result<()>;

    /// The bytes of a piece.
    async fn get(&self, upload: &str, name: &str) -> Result<Bytes>;

    /// Removes one piece, as far as that can be done.
    async fn remove_piece(&self, upload: &str, name: &str);

    /// Removes all pieces of an upload, as far as that can be done: those that stay are found by [`PieceStore::untouched`].
    async fn remove(&self, upload: &str);

    /// The uploads of which there are pieces, and none that is younger than `age`.
    async fn untouched(&self, age: Duration) -> Vec<String>;
}

/// What is answered where a piece is not there.
pub(in crate::jobs) fn removed_piece() -> Failure {
    Failure::new(Code::Gone, "this upload is being removed; begin it again")
}

/// Pieces in a folder: `<upload>/<name>`.
#[derive(Debug, Clone)]
pub struct FolderPieces {
    root: PathBuf,
}

impl FolderPieces {
    /// The folder is made when the first piece comes.
    pub fn new(root: PathBuf) -> Self {
        FolderPieces { root }
    }

    /// Runs what blocks.
    async fn blocking<T: Send + 'static>(&self, work: impl FnOnce(&Path) -> T + Send + 'static) -> Result<T> {
        let root = self.root.clone();
        let done = tokio::task::spawn_blocking(move || work(&root)).await;
        done.map_err(|e| Failure::internal(format!("a piece was lost: {e}")))
    }
}

#[async_trait]
impl PieceStore for FolderPieces {
    async fn put(&self, upload: &str, name: &str, bytes: Bytes) -> Result<()> {
        let (upload, name) = (upload.to_owned(), name.to_owned());
        let written = self.blocking(move |root| {
            let folder = root.join(upload);
            let put = || -> io::Result<()> {
                if !folder.is_dir() {
                    fs::create_dir_all(&folder)?;
                    sync_folder(root)?;
                }
                let mut file = fs::File::create_new(folder.join(name))?;
                file.write_all(&bytes)?;
                file.sync_all()?;
                sync_folder(&folder)
            };
            put().map_err(|e| disk(&folder, &e))
        });
        written.await?
    }

    async fn get(&self, upload: &str, name: &str) -> Result<Bytes> {
        let path = Path::new(upload).join(name);
        let read = self.blocking(move |root| {
            let path = root.join(path);
            fs::read(&path).map_err(|e| match e.kind() {
                io::ErrorKind::NotFound => removed_piece(),
                _ => disk(&path, &e),
            })
        });
        read.await?.map(Bytes::from)
    }

    async fn remove_piece(&self, upload: &str, name: &str) {
        let path = Path::new(upload).join(name);
        let _ = self.blocking(move |root| fs::remove_file(root.join(path))).await;
    }

    async fn remove(&self, upload: &str) {
        let upload = upload.to_owned();
        let removed = self.blocking(move |root| fs::remove_dir_all(root.join(upload))).await;
        if let Ok(Err(error)) = removed
            && error.kind() != io::ErrorKind::NotFound
        {
            tracing::warn!(%error, "could not remove the pieces of an upload");
        }
    }

    async fn untouched(&self, age: Duration) -> Vec<String> {
        let found = self.blocking(move |root| {
            let before = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
            let uploads = fs::read_dir(root).into_iter().flatten().flatten();
            let old = uploads.filter(|e| e.metadata().and_then(|m| m.modified()).is_ok_and(|m| m < before));
            let mut ids: Vec<String> = old.filter_map(|e| e.file_name().into_string().ok()).collect();
            ids.sort();
            ids
        });
        found.await.unwrap_or_default()
    }
}

#[cfg(test)]
pub(in crate::jobs) mod conformance {
    use super::*;

    /// What every store of pieces must do.
    pub(in crate::jobs) async fn suite(store: &dyn PieceStore) {
        store.put("u", "a", Bytes::from_static(b"one")).await.unwrap();
        store.put("u", "b", Bytes::from_static(b"two")).await.unwrap();
        store.put("v", "a", Bytes::new()).await.unwrap();
        assert_eq!(store.get("u", "b").await.unwrap(), "two");
        assert_eq!(store.get("v", "a").await.unwrap(), "");
        assert_eq!(store.get("u", "c").await.unwrap_err().code, Code::Gone);
        assert_eq!(store.untouched(Duration::from_secs(3600)).await, Vec::<String>::new());
        assert_eq!(store.untouched(Duration::ZERO).await, ["u", "v"]);
        store.remove_piece("u", "a").await;
        assert_eq!(store.get("u", "a").await.unwrap_err().code, Code::Gone);
        store.remove("u").await;
        store.remove("u").await;
        assert_eq!(store.untouched(Duration::ZERO).await, ["v"]);
    }
}
