//! Where the real models are.

use std::path::PathBuf;

use intarsia::asset::File;
use intarsia::asset::read_paths;

/// The folder of models, if there is one.
pub fn folder() -> Option<PathBuf> {
    let folder = std::env::var_os("INTARSIA_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    folder.is_dir().then_some(folder)
}

/// The files of a model; `None`, aloud, where it is missing.
pub fn model(name: &str) -> Option<Vec<File>> {
    let Some(folder) = folder() else {
        println!("skipped: {name}: no models at hand (set INTARSIA_DATA)");
        return None;
    };
    let path = folder.join(name);
    match read_paths(&[path]) {
        Ok(files) => Some(files),
        Err(_) => {
            println!("skipped: {name} is not at hand");
            None
        }
    }
}
