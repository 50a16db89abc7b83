//! The files of one upload, found by the names that a model gives them.

use std::borrow::Cow;
use std::collections::BTreeMap;

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
    by_path: BTreeMap<String, usize>,
    /// By file name in lower case; none where several files share it.
    by_name: BTreeMap<String, Option<usize>>,
}

impl<'a> Upload<'a> {
    /// The files; of several with one path, the first counts.
    pub(crate) fn new(entries: Vec<UploadEntry<'a>>) -> Self {
        let mut upload = Upload { entries, ..Upload::default() };
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
        self.entries.get(self.position(path)?)
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
