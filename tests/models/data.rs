//! Where the real models are, and which of them.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};

use intarsia::asset::{File, read_paths};

/// The folder of models, if there is one. One that `INTARSIA_DATA` names has to be there.
pub fn folder() -> Option<PathBuf> {
    let named = std::env::var_os("INTARSIA_DATA").map(PathBuf::from);
    if let Some(folder) = &named {
        assert!(folder.is_dir(), "INTARSIA_DATA names no folder: {}", folder.display());
    }
    named.or_else(|| {
        let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
        beside.is_dir().then_some(beside)
    })
}

/// The models of these names that are at hand, with their files.
///
/// Where there is no folder of models, that is said, and there are none. Where there is one, what is missing is said, and
/// it must not be everything: a test that tries nothing fails.
pub fn models<'a>(names: &[&'a str]) -> impl Iterator<Item = (&'a str, Vec<File>)> + use<'a> {
    let folder = folder();
    if folder.is_none() {
        skipped("real models: there are none at hand (set INTARSIA_DATA)");
    }
    let paths = names.iter().filter_map(|name| Some((*name, folder.as_ref()?.join(name))));
    let (found, missing): (Vec<_>, Vec<_>) = paths.partition(|(_, path)| path.exists());
    missing.iter().for_each(|(name, _)| skipped(&format!("{name} is not at hand")));
    assert!(missing.is_empty() || !found.is_empty(), "{folder:?} holds none of {names:?}");
    let read = |path| read_paths(&[path]).unwrap_or_else(|failure| panic!("a model is not read: {failure}"));
    found.into_iter().map(move |(name, path)| (name, read(path)))
}

/// The files of one model, as [`models`] finds them.
pub fn model(name: &str) -> Option<Vec<File>> {
    models(&[name]).next().map(|(_, files)| files)
}

/// Says what is not tried, once, past the capture of a test's output: a test that passes is not heard otherwise.
pub fn skipped(what: &str) {
    static SAID: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    if SAID.lock().unwrap_or_else(PoisonError::into_inner).insert(what.to_owned()) {
        writeln!(std::io::stderr(), "skipped: {what}").expect("stderr");
    }
}
