//! From uploaded files to a [`Document`]: the model is found, parsed and checked, and its buffers and images are collected.

use std::borrow::Cow;

use serde_json::Value;

use super::archive;
use super::buffers::resolve;
use super::foreign::foreign;
use super::glb;
use super::limits::Limits;
use super::name;
use super::obj;
use super::tile;
use super::upload::{Upload, UploadEntry, clean_path};
use super::uri::{self, quote};
use super::{Document, File};
use crate::error::{Code, Failure, Result, Warning};
use crate::params::near_or_all;

/// Most values that a glTF JSON may hold: each takes some 80 bytes of memory, however short it is written.
const MAX_JSON_VALUES: usize = 8_000_000;

/// What a model file is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Container {
    /// Binary glTF.
    Glb,
    /// glTF as JSON.
    Gltf,
    /// Binary glTF in a 3D tile.
    Tile,
    /// Wavefront OBJ.
    Obj,
}

/// Extensions of models, and of the tiles that are refused by name.
const MODEL_EXTENSIONS: [&str; 7] = ["glb", "gltf", "obj", "b3dm", "i3dm", "cmpt", "pnts"];

/// Whether a file is a model by its name.
pub fn is_model_name(name: &str) -> bool {
    MODEL_EXTENSIONS.contains(&uri::extension(name).as_str())
}

/// Loads the model among `files` (.glb, .gltf, .obj, .b3dm, .i3dm, or one of them in a .zip), told by content and by name. `main`
/// names it where there are several. Every buffer is resolved, compressed geometry is decompressed, every buffer view and
/// accessor lies inside its buffer; images that are missing are `None` and a warning.
///
/// # Errors
/// `invalid_model` with a pointer for a broken container, JSON, buffer view, accessor or compressed stream;
/// `unsupported_extension`; `missing_file` for buffers; `too_large` beyond `limits`.
pub fn load(files: &[File], main: Option<&str>, limits: &Limits) -> Result<(Document, Vec<Warning>)> {
    load_while(files, main, limits, &|| Ok(())).map(|(document, warnings, _)| (document, warnings))
}

/// [`load`], for as long as `check` is content: it is asked every now and then while compressed geometry is decoded. Beside document and
/// warnings it gives the paths of those `files` that the model does not name.
///
/// # Errors
/// As [`load`], and what `check` says.
pub fn load_while(
    files: &[File],
    main: Option<&str>,
    limits: &Limits,
    check: &dyn Fn() -> Result<()>,
) -> Result<(Document, Vec<Warning>, Vec<String>)> {
    let upload = unpack(files, limits)?;
    // An archive that is named stands for the model inside it.
    let main = main.filter(|m| !files.iter().any(|f| f.path == **m && archive::is_zip(&f.bytes)));
    let (entry, container) = find_model(&upload, main)?;
    if entry.bytes.is_empty() {
        return Err(Failure::model(format!("the file {} is empty", quote(&entry.path))));
    }
    let is_text = matches!(container, Container::Gltf | Container::Obj);
    if is_text && (entry.bytes.starts_with(b"\xFF\xFE") || entry.bytes.starts_with(b"\xFE\xFF")) {
        return Err(Failure::model(format!("the file {} is UTF-16 text: save it as UTF-8", quote(&entry.path))));
    }
    let mut warnings = Vec::new();
    let mut document = match container {
        Container::Obj => obj::load(entry, &upload, limits, &mut warnings)?,
        Container::Gltf => {
            let json = parse_json(&entry.bytes, limits)?;
            resolve(json, None, entry, &upload, limits, &mut warnings, check)?
        }
        Container::Glb | Container::Tile => {
            let (tile, glb) = match container {
                Container::Tile => tile::parse(&entry.bytes, &mut warnings).map(|(tile, glb)| (Some(tile), glb))?,
                _ => (None, entry.bytes.as_ref()),
            };
            let inside = glb::parse(glb, &mut warnings).and_then(|chunks| {
                let json = parse_json(chunks.json, limits)?;
                resolve(json, chunks.bin, entry, &upload, limits, &mut warnings, check)
            });
            let mut document = inside.map_err(|mut failure| {
                if let (Some(tile), Code::InvalidModel, None) = (&tile, failure.code, &failure.pointer) {
                    failure.message =
                        format!("the .{} holds no glTF that is read: {}", tile.kind.extension(), failure.message);
                }
                failure
            })?;
            document.tile = tile;
            document
        }
    };
    document.origins.decoded = Some(document.lengths());
    let plain = files.iter().filter(|f| !archive::is_zip(&f.bytes)).count();
    let unused = upload.unused(plain).into_iter().filter(|path| *path != entry.path);
    let unused = unused.map(|path| name::readable(&path).into_owned()).collect();
    Ok((document, warnings, unused))
}

/// A file of an upload, by its path or, where only one has it, its name; files in archives are found too.
///
/// # Errors
/// `too_large` beyond `limits`, `invalid_model` for a broken archive.
pub fn side_file(files: &[File], name: &str, limits: &Limits) -> Result<Option<Vec<u8>>> {
    let upload = unpack(files, limits)?;
    Ok(upload.find(&clean_path(name, 0)).map(|entry| entry.bytes.to_vec()))
}

fn unpack<'a>(files: &'a [File], limits: &Limits) -> Result<Upload<'a>> {
    let too_large = || {
        let message = format!("the input has more than {} bytes", limits.max_input_bytes);
        Failure::new(Code::TooLarge, message)
    };
    let mut left = limits.max_input_bytes;
    let mut entries = Vec::with_capacity(files.len());
    for (index, file) in files.iter().enumerate() {
        left = left.checked_sub(file.bytes.len() as u64).ok_or_else(too_large)?;
        if archive::is_zip(&file.bytes) {
            // The archive itself was counted; its contents have the whole limit, shared by all archives.
            continue;
        }
        entries.push(UploadEntry { path: clean_path(&file.path, index), bytes: Cow::Borrowed(file.bytes.as_slice()) });
    }
    let mut left = limits.max_input_bytes;
    for file in files.iter().filter(|f| archive::is_zip(&f.bytes)) {
        entries.extend(archive::unpack(&file.path, &file.bytes, &mut left)?);
    }
    Ok(Upload::new(entries))
}

fn find_model<'u, 'a>(upload: &'u Upload<'a>, main: Option<&str>) -> Result<(&'u UploadEntry<'a>, Container)> {
    if let Some(main) = main {
        let entry = upload.find(&clean_path(main, 0)).ok_or_else(|| {
            let paths: Vec<&str> = upload.entries().iter().map(|e| e.path.as_str()).collect();
            Failure::new(
                Code::MissingFile,
                format!("the model {} is not among the files; {}", quote(main), near_or_all(main, &paths)),
            )
        })?;
        let container = container(entry, true).ok_or_else(|| not_a_model(entry))?;
        return Ok((entry, container));
    }
    let alone = upload.entries().len() == 1;
    let mut found = upload.entries().iter().filter_map(|e| container(e, alone).map(|c| (e, c)));
    match (found.next(), found.next()) {
        (Some(only), None) => Ok(only),
        (Some(first), Some(second)) => {
            let names: Vec<String> =
                [first, second].into_iter().chain(found.take(3)).map(|(e, _)| quote(&e.path)).collect();
            Err(Failure::model(format!(
                "there are several models ({}): name the one to take, by its path, as the option `model`",
                names.join(", ")
            )))
        }
        (None, _) => Err(match upload.entries() {
            [] => Failure::model("there is no file in the input"),
            [only] => not_a_model(only),
            all => {
                let names: Vec<String> = all.iter().take(MOST_NAMED).map(|e| told(e)).collect();
                let more = if all.len() > MOST_NAMED { ", …" } else { "" };
                let names = names.join(", ");
                Failure::model(format!(
                    "none of the {} files is a .glb, .gltf, .obj, .b3dm or .i3dm: {names}{more}",
                    all.len()
                ))
            }
        }),
    }
}

fn not_a_model(entry: &UploadEntry<'_>) -> Failure {
    if entry.bytes.is_empty() {
        return Failure::model(format!("the file {} is empty", quote(&entry.path)));
    }
    Failure::model(format!(
        "the file {} is neither GLB, glTF, OBJ, a 3D tile (.b3dm, .i3dm) nor a zip archive of one",
        told(entry)
    ))
}

/// Most files that a message names.
const MOST_NAMED: usize = 5;

/// A file's name, with what it is where that is known of one that is not read.
fn told(entry: &UploadEntry<'_>) -> String {
    let what = foreign(&entry.path, &entry.bytes).map(|what| format!(" ({what})")).unwrap_or_default();
    format!("{}{what}", quote(&entry.path))
}

/// What a file is, by its first bytes, then its name, and where `guess` is set by how its text looks.
pub(crate) fn container(entry: &UploadEntry<'_>, guess: bool) -> Option<Container> {
    let bytes = &*entry.bytes;
    if bytes.starts_with(glb::MAGIC) {
        return Some(Container::Glb);
    }
    if tile::is_tile(bytes) {
        return Some(Container::Tile);
    }
    let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes).trim_ascii_start();
    match uri::extension(&entry.path).as_str() {
        "gltf" => Some(Container::Gltf),
        "glb" if text.first() == Some(&b'{') => Some(Container::Gltf),
        "glb" => Some(Container::Glb),
        "obj" => Some(Container::Obj),
        "b3dm" | "i3dm" => Some(Container::Tile),
        _ if guess && text.first() == Some(&b'{') => Some(Container::Gltf),
        _ if guess && obj::looks_like(text) => Some(Container::Obj),
        _ => None,
    }
}

fn parse_json(bytes: &[u8], limits: &Limits) -> Result<Value> {
    if bytes.len() as u64 > limits.max_json_bytes {
        let message = format!("the glTF JSON has {} bytes, more than {}", bytes.len(), limits.max_json_bytes);
        return Err(Failure::new(Code::TooLarge, message));
    }
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    // Some writers pad the JSON chunk with zeros instead of spaces.
    let end = bytes.iter().rposition(|b| *b != 0).map_or(0, |last| last + 1);
    let bytes = bytes.get(..end).unwrap_or_default();
    if count_values(bytes) > MAX_JSON_VALUES {
        let message = format!("the glTF JSON holds more than {MAX_JSON_VALUES} values");
        return Err(Failure::new(Code::TooLarge, message));
    }
    serde_json::from_slice(bytes).map_err(|e| Failure::model(format!("the glTF JSON cannot be parsed: {e}")))
}

/// An upper bound on the values of a JSON text: its commas and openings outside strings.
fn count_values(bytes: &[u8]) -> usize {
    let mut count = 0;
    let mut inside = false;
    let mut escaped = false;
    for byte in bytes {
        match byte {
            _ if escaped => escaped = false,
            b'\\' if inside => escaped = true,
            b'"' => inside = !inside,
            b',' | b'[' | b'{' if !inside => count += 1,
            _ => {}
        }
    }
    count
}
