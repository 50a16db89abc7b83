//! The files of one upload, found by the names that a model gives them.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};

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
        }
        upload
    }

    /// All files in their order.
    pub(crate) fn entries(&self) -> &[UploadEntry<'a>] {
        &self.entries
    }

    /// The file at a path; else, as browsers and archives lose folders and some file systems case, the only
    /// one of that name.
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
        match self.by_path.get(path) {
            Some(index) => Some(*index),
            None => self.by_name.get(&file_name(path).to_lowercase()).copied().flatten(),
        }
    }
}

/// A clean path for an uploaded file: its own where it is relative and stays inside, else its last part.
pub(crate) fn clean_path(path: &str, index: usize) -> String {
    let own = if path.starts_with(['/', '\\']) { None } else { normalise(path) };
    own.or_else(|| normalise(file_name(path))).unwrap_or_else(|| format!("file-{index}"))
}
