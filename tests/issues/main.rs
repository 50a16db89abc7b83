//! Crashes and wrong results that were found once, each with what happened.

mod compressed_streams;
mod extensions;
mod fidelity;
mod layouts;
mod messages;
mod names;
mod numbers;
mod outcomes;
mod scans;
mod tangents;
mod textures;
mod tiles;

use std::path::{Path, PathBuf};

/// A model that users reported, under `reports` in `INTARSIA_DATA` or in `../shared/data`; none, with a word on the output, where it is missing.
fn reported(name: &str) -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let path = std::env::var_os("INTARSIA_DATA").map_or_else(beside, PathBuf::from).join("reports").join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {} is missing (set INTARSIA_DATA)", path.display());
    None
}
