//! A folder of this machine, or of a volume that several share: `uploads/<job>/<n>`, `objects/<xx>/<name>`. A file gets its final name only
//! when all of it is on the disk.

use std::fs;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use async_trait::async_trait;
use axum::body::Bytes;
use futures_util::stream::{StreamExt, try_unfold};

use super::{FetchedUpload, Parts, Store, gone, shelf, upload_is_gone};
use crate::error::{Failure, Result};
use crate::jobs::files::{Files, Manifest, disk, remove_folder, sync_folder};
use crate::jobs::record::new_id;
use crate::jobs::resumable::{FolderPieces, PieceStore};

/// Bytes that are read at once.
const CHUNK: u64 = 128 << 10;

/// The store of a folder.
#[derive(Debug, Clone)]
pub struct Folder {
    files: Files,
    /// Bytes that must be free on its volume, where nobody else looks at it.
    min_free: Option<Option<u64>>,
}

impl Folder {
    /// The store in the data folder of the service.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub fn of_data(files: &Files) -> Result<Self> {
        Self::new(files.clone(), None)
    }

    /// A store in a folder of its own, on whose volume so much must be free.
    ///
    /// # Errors
    /// `insufficient_storage`, `unavailable`.
    pub fn at(root: &Path, min_free: Option<u64>) -> Result<Self> {
        Self::new(Files::open(root)?, Some(min_free))
    }

    fn new(files: Files, min_free: Option<Option<u64>>) -> Result<Self> {
        for part in ["uploads", "objects"] {
            let folder = files.root().join(part);
            fs::create_dir_all(&folder).map_err(|e| disk(&folder, &e))?;
        }
        Ok(Folder { files, min_free })
    }

    fn uploads(&self, job: &str) -> PathBuf {
        self.files.root().join("uploads").join(job)
    }

    fn object(&self, place: &str) -> PathBuf {
        self.files.root().join("objects").join(shelf(place)).join(place)
    }

    fn accept_now(&self, job: &str, from: &Path) -> Result<()> {
        let to = self.uploads(job);
        let moved = || {
            sync_folder(from)?;
            match fs::rename(from, &to) {
                Err(e) if e.kind() == io::ErrorKind::CrossesDevices => {
                    let partial = self.files.incoming(&format!("{job}.accepted"));
                    copy_synced(from, &partial)?;
                    fs::rename(&partial, &to)?;
                    remove_folder(from);
                }
                done => done?,
            }
            sync_folder(&self.files.root().join("uploads"))
        };
        moved().map_err(|e| disk(&to, &e))
    }

    fn put_now(&self, place: &str, bytes: &[u8]) -> Result<()> {
        let object = self.object(place);
        let folder = object.parent().unwrap_or(self.files.root());
        let put = || {
            if fs::metadata(&object).is_ok_and(|m| m.len() == bytes.len() as u64) {
                return Ok(());
            }
            fs::create_dir_all(folder)?;
            let partial = self.files.incoming(&format!("{}.object", new_id().map_err(io::Error::other)?));
            let mut file = fs::File::create_new(&partial)?;
            file.write_all(bytes)?;
            file.sync_all()?;
            fs::rename(&partial, &object)?;
            sync_folder(folder)?;
            sync_folder(&self.files.root().join("objects"))
        };
        put().map_err(|e: io::Error| disk(&object, &e))
    }
}

/// Copies the files of a folder, so that they survive anything.
fn copy_synced(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let copy = to.join(entry.file_name());
        fs::copy(entry.path(), &copy)?;
        fs::File::open(&copy)?.sync_all()?;
    }
    sync_folder(to)
}

/// Runs what waits for the disk.
pub(super) async fn blocking<T: Send + 'static>(work: impl FnOnce() -> Result<T> + Send + 'static) -> Result<T> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|e| Failure::internal(format!("the work on the disk was lost: {e}")))?
}

#[async_trait]
impl Store for Folder {
    async fn accept(&self, job: &str, from: &Path, _: &Manifest) -> Result<()> {
        let (store, job, from) = (self.clone(), job.to_owned(), from.to_owned());
        blocking(move || store.accept_now(&job, &from)).await
    }

    async fn fetch(&self, job: &str, _: &Manifest, _: &Path) -> Result<FetchedUpload> {
        let folder = self.uploads(job);
        match tokio::fs::metadata(&folder).await {
            Ok(_) => Ok(FetchedUpload { folder, brought: false }),
            Err(e) if e.kind() == io::ErrorKind::NotFound && self.files.root().is_dir() => Err(upload_is_gone()),
            Err(e) => Err(disk(&folder, &e)),
        }
    }

    async fn remove_upload(&self, job: &str) -> Result<()> {
        let folder = self.uploads(job);
        blocking(move || {
            remove_folder(&folder);
            Ok(())
        })
        .await
    }

    async fn untouched_uploads(&self, age: Duration) -> Result<Vec<String>> {
        let folder = self.files.root().join("uploads");
        blocking(move || {
            let before = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
            let uploads = fs::read_dir(folder).into_iter().flatten().flatten();
            let old = uploads.filter(|e| e.metadata().and_then(|m| m.modified()).is_ok_and(|m| m < before));
            let mut jobs: Vec<String> = old.filter_map(|e| e.file_name().into_string().ok()).collect();
            jobs.sort();
            Ok(jobs)
        })
        .await
    }

    async fn put(&self, place: &str, bytes: Bytes) -> Result<()> {
        let (store, place) = (self.clone(), place.to_owned());
        blocking(move || store.put_now(&place, &bytes)).await
    }

    async fn get(&self, place: &str, range: Range<u64>) -> Result<Parts> {
        let path = self.object(place);
        let opened = {
            let path = path.clone();
            blocking(move || {
                let failed = |e: io::Error| match e.kind() {
                    io::ErrorKind::NotFound => gone(),
                    _ => disk(&path, &e),
                };
                let mut file = fs::File::open(&path).map_err(failed)?;
                file.seek(SeekFrom::Start(range.start)).map_err(failed)?;
                Ok((file, range.end.saturating_sub(range.start)))
            })
        };
        let parts = try_unfold(opened.await?, move |(file, left)| {
            let path = path.clone();
            async move {
                if left == 0 {
                    return Ok(None);
                }
                let read = blocking(move || {
                    let mut part = Vec::new();
                    let read = (&file).take(left.min(CHUNK)).read_to_end(&mut part);
                    match read.map_err(|e| disk(&path, &e))? {
                        0 => Err(disk(&path, &io::ErrorKind::UnexpectedEof.into())),
                        n => Ok((Bytes::from(part), (file, left - n as u64))),
                    }
                });
                read.await.map(Some)
            }
        });
        Ok(parts.boxed())
    }

    async fn remove(&self, place: &str) -> Result<()> {
        let path = self.object(place);
        match tokio::fs::remove_file(&path).await {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(disk(&path, &error)),
            _ => Ok(()),
        }
    }

    async fn places(&self) -> Result<Vec<String>> {
        let root = self.files.root().join("objects");
        blocking(move || {
            let folders = fs::read_dir(root).into_iter().flatten().flatten();
            let files = folders.flat_map(|folder| fs::read_dir(folder.path()).into_iter().flatten().flatten());
            Ok(files.filter_map(|file| file.file_name().into_string().ok()).collect())
        })
        .await
    }

    async fn check(&self, _: bool) -> Result<()> {
        let Some(min_free) = self.min_free else { return Ok(()) };
        let files = self.files.clone();
        blocking(move || files.probe(min_free)).await
    }

    fn pieces(&self) -> Arc<dyn PieceStore> {
        Arc::new(FolderPieces::new(self.files.root().join("pieces")))
    }

    fn is_local(&self) -> bool {
        true
    }

    fn name(&self) -> String {
        self.files.root().display().to_string()
    }

    async fn marker(&self, name: &str) -> Result<Option<String>> {
        let path = self.files.root().join(name);
        match tokio::fs::read_to_string(&path).await {
            Ok(text) => Ok(Some(text.trim().to_owned())),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(disk(&path, &e)),
        }
    }

    async fn set_marker(&self, name: &str, text: &str, replace: bool) -> Result<bool> {
        let (path, text) = (self.files.root().join(name), text.to_owned());
        blocking(move || {
            let young = path.with_extension(format!("{}.young", new_id()?));
            let written = || {
                let mut file = fs::File::create(&young)?;
                writeln!(file, "{text}")?;
                file.sync_all()?;
                let linked =
                    if replace { Err(io::ErrorKind::Unsupported.into()) } else { fs::hard_link(&young, &path) };
                match linked {
                    Ok(()) => fs::remove_file(&young)?,
                    Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {
                        fs::remove_file(&young)?;
                        return Ok(false);
                    }
                    // Not every volume has links.
                    Err(_) => fs::rename(&young, &path)?,
                }
                sync_folder(path.parent().unwrap_or(Path::new(".")))?;
                Ok(true)
            };
            written().map_err(|e: io::Error| disk(&path, &e))
        })
        .await
    }

    async fn remove_marker(&self, name: &str) -> Result<()> {
        let _ = tokio::fs::remove_file(self.files.root().join(name)).await;
        Ok(())
    }

    async fn is_empty(&self) -> Result<bool> {
        Ok(self.places().await?.is_empty() && self.untouched_uploads(Duration::ZERO).await?.is_empty())
    }

    async fn remove_unfinished(&self, _: Duration) -> Result<()> {
        let files = self.files.clone();
        blocking(move || {
            files.remove_dead_workers();
            Ok(())
        })
        .await
    }
}
