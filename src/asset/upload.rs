//! The files of one upload, found by the names that a model gives them.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};

use super::name::readings;
use super::uri::{file_name, normalise};

/// A file of the upload, perhaps unpacked from an archive.
#[derive(Debug, Clone)]
pub(crate) struct UploadEntry<'a> {
    /// Clean relative path.
    pub(crate) path: String,
    /// Contents.
    pub(crate) bytes: Cow<'a, [u8]>,
}

/// All files of an upload.
#[derive(Debug, Default)]
pub(crate) struct Upload<'a> {
    entries: Vec<UploadEntry<'a>>,
    /// Those that were found by a name, or named as the model.
    found: Vec<AtomicBool>,
    by_path: BTreeMap<String, usize>,
    /// By file name in lower case; none where several files share it.
    by_name: BTreeMap<String, Option<usize>>,
    /// What a name in another encoding than UTF-8 may read, in lower case, as a path and without its folder; none where several files may.
    by_reading: BTreeMap<String, Option<usize>>,
}

impl<'a> Upload<'a> {
    /// The files; of several with one path, the first counts.
    pub(crate) fn new(entries: Vec<UploadEntry<'a>>) -> Self {
        let found = entries.iter().map(|_| AtomicBool::new(false)).collect();
        let mut upload = Upload { entries, found, ..Upload::default() };
        for (index, entry) in upload.entries.iter().enumerate() {
            if upload.by_path.contains_key(&entry.path) {
                continue;
            }
            upload.by_path.insert(entry.path.clone(), index);
            let name = file_name(&entry.path).to_lowercase();
            upload.by_name.entry(name).and_modify(|found| *found = None).or_insert(Some(index));
            let paths = readings(&entry.path).into_iter().filter_map(|path| normalise(&path));
            let mut read: Vec<String> =
                paths.flat_map(|path| [file_name(&path).to_lowercase(), path.to_lowercase()]).collect();
            read.sort_unstable();
            read.dedup();
            for reading in read {
                upload.by_reading.entry(reading).and_modify(|found| *found = None).or_insert(Some(index));
            }
        }
        upload
    }

    /// All files in their order.
    pub(crate) fn entries(&self) -> &[UploadEntry<'a>] {
        &self.entries
    }

    /// The file at a path, byte by byte; else, as browsers and archives lose folders and some file systems case, the only
    /// one of that name; else, as they spell names in other encodings, the only one that may read the same.
    pub(crate) fn find(&self, path: &str) -> Option<&UploadEntry<'a>> {
        let index = self.position(path)?;
        self.found.get(index)?.store(true, Ordering::Relaxed);
        self.entries.get(index)
    }

    /// Paths of those among the first `count` files that nobody has found.
    pub(crate) fn unused(&self, count: usize) -> Vec<String> {
        let all = self.entries.iter().zip(&self.found).take(count);
        all.filter(|(_, found)| !found.load(Ordering::Relaxed)).map(|(entry, _)| entry.path.clone()).collect()
    }

    /// The index of what [`Upload::find`] finds.
    pub(crate) fn position(&self, path: &str) -> Option<usize> {
        let exact = |path: &str| match self.by_path.get(path) {
            Some(index) => Some(*index),
            None => self.by_name.get(&file_name(path).to_lowercase()).copied().flatten(),
        };
        let read = |path: &str| self.by_reading.get(&path.to_lowercase()).copied().flatten();
        let either = |path: &str| exact(path).or_else(|| read(path)).or_else(|| read(file_name(path)));
        exact(path)
            .or_else(|| either(path))
            .or_else(|| readings(path).iter().find_map(|path| either(&normalise(path)?)))
    }
}

/// A clean path for an uploaded file: its own where it is relative and stays inside, else its last part.
pub(crate) fn clean_path(path: &str, index: usize) -> String {
    let own = if path.starts_with(['/', '\\']) { None } else { normalise(path) };
    own.or_else(|| normalise(file_name(path))).unwrap_or_else(|| format!("file-{index}"))
}
