//! Reading a model from disk together with the files that it names beside it.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::File;
use super::glb;
use super::name;
use super::obj;
use super::tile;
use super::uri;
use crate::error::{Code, Failure, Result};

/// Reads files for [`super::load`]. For a model the files that it names beside it or in folders below
/// (buffers, images, material libraries and their maps) follow; those that are missing are left out.
///
/// # Errors
/// `missing_file` when one of `paths` cannot be read.
pub fn read_paths(paths: &[PathBuf]) -> Result<Vec<File>> {
    let mut files: Vec<File> = Vec::new();
    for path in paths {
        let bytes = std::fs::read(path)
            .map_err(|e| Failure::new(Code::MissingFile, format!("{} cannot be read: {e}", path.display())))?;
        let name = path.file_name().map_or_else(|| "model".into(), |n| name::from_bytes(n.as_encoded_bytes()));
        let folder = path.parent().unwrap_or(Path::new(""));
        let named = match uri::extension(&name).as_str() {
            "gltf" => named_by_gltf(&bytes),
            "glb" | "b3dm" | "i3dm" => named_by_gltf(json_of_binary(&bytes)),
            "obj" => named_by_obj(&bytes, folder),
            _ => Vec::new(),
        };
        if !files.iter().any(|f| f.path == name) {
            files.push(File { path: name, bytes });
        }
        for side in named {
            if files.iter().any(|f| f.path == side) {
                continue;
            }
            if let Some((path, bytes)) = read_beside(folder, side) {
                files.push(File { path, bytes });
            }
        }
    }
    Ok(files)
}

/// Clean relative paths of buffers and images. A document that cannot be parsed names none; `load` says why.
fn named_by_gltf(bytes: &[u8]) -> Vec<String> {
    // Some editors write a byte-order mark.
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let json: Value = serde_json::from_slice(bytes).unwrap_or_default();
    let arrays = ["buffers", "images"].into_iter().filter_map(|key| json.get(key)?.as_array());
    let uris = arrays.flatten().filter_map(|object| object.get("uri")?.as_str());
    uris.filter(|u| !uri::is_data(u)).filter_map(|u| uri::resolve("", u).ok()).collect()
}

/// The JSON of a GLB, alone or in a tile; empty where it is broken, which `load` tells.
fn json_of_binary(bytes: &[u8]) -> &[u8] {
    let mut warnings = Vec::new();
    let glb = if tile::is_tile(bytes) { tile::parse(bytes, &mut warnings).map(|(_, glb)| glb) } else { Ok(bytes) };
    let json = glb.and_then(|glb| glb::parse(glb, &mut warnings)).map(|chunks| chunks.json).unwrap_or_default();
    // Some writers pad with zeros instead of blanks.
    json.iter().rposition(|b| *b != 0).and_then(|last| json.get(..=last)).unwrap_or_default()
}

fn named_by_obj(bytes: &[u8], folder: &Path) -> Vec<String> {
    let mut named = Vec::new();
    for library in obj::libraries(bytes) {
        let Some((library, text)) = read_beside(folder, library) else { continue };
        let maps = obj::maps(&text)
            .into_iter()
            .filter_map(|map| uri::join(&library, &map).or(uri::normalise(uri::file_name(&map))));
        named.extend(maps.collect::<Vec<_>>());
        named.push(library);
    }
    named
}

/// A plain file below `folder`, under the bytes of its name, or else under what they may read, with the path that it is at; pipes and devices are not
/// opened.
fn read_beside(folder: &Path, relative: String) -> Option<(String, Vec<u8>)> {
    // What a name reads must not lead elsewhere either.
    let readings =
        name::readings(&relative).into_iter().filter(|reading| uri::normalise(reading).as_ref() == Some(reading));
    let readings: Vec<String> = readings.collect();
    std::iter::once(relative).chain(readings).find_map(|relative| {
        let path = folder.join(native(&relative));
        path.metadata().ok().filter(std::fs::Metadata::is_file)?;
        Some((relative, std::fs::read(path).ok()?))
    })
}

/// A name as the file system has it.
#[cfg(unix)]
fn native(name: &str) -> PathBuf {
    use std::os::unix::ffi::OsStrExt;
    PathBuf::from(std::ffi::OsStr::from_bytes(&name::bytes(name)))
}

#[cfg(not(unix))]
fn native(name: &str) -> PathBuf {
    // Other systems have no bytes in their names: what one reads is looked for.
    PathBuf::from(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_byte_order_mark_hides_no_side_file() {
        let text = "\u{FEFF}{\"buffers\": [{\"uri\": \"a%20b.bin\"}], \"images\": [{\"uri\": \"80%25 worn.png\"}]}";
        assert_eq!(named_by_gltf(text.as_bytes()), ["a b.bin", "80% worn.png"]);
    }
}
