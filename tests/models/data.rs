//! Where the real models are, and which of them.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use intarsia::asset::{File, read_paths};

/// Bytes of a model with its images above which it is tried only where all are: the tests of a build must not take a quarter of an hour.
const LARGE: u64 = 2_000_000;

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
/// it must not be everything: a test that tries nothing fails. Large ones are left out, which is said too, unless `INTARSIA_TEST_ALL` is set or
/// there are no others.
pub fn models<'a>(names: &[&'a str]) -> impl Iterator<Item = (&'a str, Vec<File>)> + use<'a> {
    let folder = folder();
    if folder.is_none() {
        skipped("real models: there are none at hand (set INTARSIA_DATA)");
    }
    let paths = names.iter().filter_map(|name| Some((*name, folder.as_ref()?.join(name))));
    let (found, missing): (Vec<_>, Vec<_>) = paths.partition(|(_, path)| path.exists());
    missing.iter().for_each(|(name, _)| skipped(&format!("{name} is not at hand")));
    assert!(missing.is_empty() || !found.is_empty(), "{folder:?} holds none of {names:?}");
    let sized: Vec<(&str, PathBuf, u64)> =
        found.into_iter().map(|(name, path)| (name, path.clone(), bytes(&path))).collect();
    let most = if std::env::var_os("INTARSIA_TEST_ALL").is_some() { u64::MAX } else { LARGE };
    let most = sized.iter().map(|(.., size)| *size).min().map_or(most, |least| most.max(least));
    let (wanted, large): (Vec<_>, Vec<_>) = sized.into_iter().partition(|(.., size)| *size <= most);
    large.iter().for_each(|(name, ..)| skipped(&format!("{name} is large (INTARSIA_TEST_ALL=1 tries it too)")));
    let read = |path| read_paths(&[path]).unwrap_or_else(|failure| panic!("a model is not read: {failure}"));
    wanted.into_iter().map(move |(name, path, _)| (name, read(path)))
}

/// Bytes of a model: a file by itself, or all that lies in a folder of its own.
fn bytes(path: &Path) -> u64 {
    let of = |path: &Path| path.metadata().map_or(0, |own| own.len());
    let is_alone = path.extension().is_some_and(|e| e == "glb")
        || path.parent().is_some_and(|p| p.ends_with("meshes") || p.ends_with("uv"));
    if is_alone {
        return of(path);
    }
    let files = path.parent().and_then(|folder| std::fs::read_dir(folder).ok());
    files.into_iter().flatten().flatten().map(|entry| of(&entry.path())).sum()
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
