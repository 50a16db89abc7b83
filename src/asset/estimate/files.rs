//! The files of an upload on the disk, those in archives too: their lengths, and what their heads say.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use zip::ZipArchive;

use super::super::archive::{check_entries, is_litter, is_zip, too_much};
use super::super::limits::Limits;
use super::super::load::{Container, container};
use super::super::name::from_bytes;
use super::super::upload::{Upload, UploadEntry, clean_path};
use super::super::uri::normalise;
use crate::error::Result;
use crate::texture::{Header, probe};

/// Bytes by which a file is known.
const HEAD: u64 = 64 << 10;

/// A file that is read forward from places in it.
pub(super) trait Forward: Read {
    /// Goes to a place; a stream cannot go back.
    fn to(&mut self, offset: u64) -> io::Result<()>;
}

impl Forward for File {
    fn to(&mut self, offset: u64) -> io::Result<()> {
        self.seek(SeekFrom::Start(offset)).map(|_| ())
    }
}

/// A stream that knows where it is.
pub(super) struct Stream<R> {
    inner: R,
    at: u64,
}

impl<R> Stream<R> {
    pub(super) fn new(inner: R) -> Self {
        Stream { inner, at: 0 }
    }
}

impl<R: Read> Read for Stream<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.at += count as u64;
        Ok(count)
    }
}

impl<R: Read> Forward for Stream<R> {
    fn to(&mut self, offset: u64) -> io::Result<()> {
        let skip = offset.checked_sub(self.at).ok_or(io::ErrorKind::NotSeekable)?;
        io::copy(&mut self.take(skip), &mut io::sink()).map(|_| ())
    }
}

/// A file of the upload.
pub(super) struct KnownFile {
    place: FilePlace,
    /// Bytes, unpacked.
    pub(super) length: u64,
    /// What it says of itself, where it is an image.
    pub(super) image: Option<Header>,
    /// What it is, where it is a model.
    pub(super) container: Option<Container>,
}

enum FilePlace {
    Disk(PathBuf),
    /// Index of the archive, and of the entry in it.
    Archive(usize, usize),
}

/// All files.
#[derive(Default)]
pub(super) struct Files {
    archives: Vec<ZipArchive<BufReader<File>>>,
    known: Vec<KnownFile>,
    /// Their clean paths in the same order, with nothing in them, to be found as the loader finds files.
    upload: Upload<'static>,
    /// Bytes of archives.
    pub(super) packed: u64,
    /// Bytes that may still be unpacked.
    left: u64,
}

impl Files {
    /// Looks at files by their names and where they are on the disk. What cannot be opened is left out.
    ///
    /// # Errors
    /// `too_large` when archives unpack to more than `limits` allow.
    pub(super) fn new<'p>(files: impl Iterator<Item = (&'p str, &'p Path)>, limits: &Limits) -> Result<Self> {
        let mut all = Files { left: limits.max_input_bytes, ..Files::default() };
        let mut entries = Vec::new();
        for (index, (name, path)) in files.enumerate() {
            let Ok(mut file) = File::open(path) else { continue };
            let Ok(length) = file.metadata().map(|m| m.len()) else { continue };
            let mut start = Vec::new();
            if (&mut file).take(4).read_to_end(&mut start).and_then(|_| file.to(0)).is_err() {
                continue;
            }
            if is_zip(&start) {
                all.packed = all.packed.saturating_add(length);
                all.unpack(name, file, &mut entries)?;
            } else {
                let mut entry = UploadEntry { path: clean_path(name, index), bytes: Vec::new().into() };
                let (image, container) = look(&mut entry, &mut file, index == 0);
                all.known.push(KnownFile { place: FilePlace::Disk(path.to_owned()), length, image, container });
                entries.push(entry);
            }
        }
        all.upload = Upload::new(entries);
        Ok(all)
    }

    /// Walks an archive. Its entries are read to their ends and kept nowhere: what they declare is not believed.
    fn unpack(&mut self, name: &str, mut file: File, entries: &mut Vec<UploadEntry<'static>>) -> Result<()> {
        if check_entries(name, &file).is_err() || file.to(0).is_err() {
            return Ok(());
        }
        let Ok(mut archive) = ZipArchive::new(BufReader::new(file)) else { return Ok(()) };
        for index in 0..archive.len() {
            let Ok(file) = archive.by_index(index) else { continue };
            let inner = from_bytes(file.name_raw());
            let Some(path) = normalise(&inner).filter(|_| !file.is_dir() && !is_litter(&inner)) else { continue };
            let mut entry = UploadEntry { path, bytes: Vec::new().into() };
            let mut stream = Stream::new(file.take(self.left.saturating_add(1)));
            let (image, container) = look(&mut entry, &mut stream, false);
            // An entry that breaks off has been read as far as the job will read it.
            let _ = io::copy(&mut stream, &mut io::sink());
            self.left = self.left.checked_sub(stream.at).ok_or_else(|| too_much(name))?;
            let place = FilePlace::Archive(self.archives.len(), index);
            self.known.push(KnownFile { place, length: stream.at, image, container });
            entries.push(entry);
        }
        self.archives.push(archive);
        Ok(())
    }

    /// All files in their order.
    pub(super) fn known(&self) -> &[KnownFile] {
        &self.known
    }

    /// The path of a file.
    pub(super) fn path(&self, index: usize) -> &str {
        self.upload.entries().get(index).map_or("", |e| &e.path)
    }

    /// The file that a model means by a path.
    pub(super) fn find(&self, path: &str) -> Option<usize> {
        self.upload.position(path)
    }

    /// Gives a file to `read`.
    pub(super) fn open<T>(&mut self, index: usize, read: impl FnOnce(&mut dyn Forward) -> T) -> Option<T> {
        match &self.known.get(index)?.place {
            FilePlace::Disk(path) => Some(read(&mut File::open(path).ok()?)),
            FilePlace::Archive(archive, entry) => {
                let file = self.archives.get_mut(*archive)?.by_index(*entry).ok()?;
                Some(read(&mut Stream::new(file)))
            }
        }
    }
}

/// What a file is by its head.
fn look(entry: &mut UploadEntry<'static>, file: &mut dyn Read, guess: bool) -> (Option<Header>, Option<Container>) {
    let mut head = Vec::new();
    let _ = file.take(HEAD).read_to_end(&mut head);
    let image = probe(head.chain(file));
    entry.bytes = head.into();
    let container = container(entry, guess);
    entry.bytes = Vec::new().into();
    (image, container)
}
