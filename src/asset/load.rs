//! Stand-in for the loader. Replaced at the merge.

use std::path::PathBuf;

use crate::asset::File;
use crate::error::{Failure, Result};

/// Reads models from disk.
pub fn read_paths(paths: &[PathBuf]) -> Result<Vec<File>> {
    paths
        .iter()
        .map(|path| {
            let bytes = std::fs::read(path).map_err(|e| Failure::model(format!("{}: {e}", path.display())))?;
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            Ok(File { path: name, bytes })
        })
        .collect()
}
