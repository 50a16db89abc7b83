//! From uploaded files to a [`Document`]: the model is found, taken apart and checked, and what it names is gathered.

use std::borrow::Cow;

use serde_json::Value;

use super::archive;
use super::glb;
use super::limits::Limits;
use super::obj;
use super::structure::{self, list, whole};
use super::upload::{Entry, Upload, clean_path};
use super::uri::{self, quote};
use super::{Document, File};
use crate::error::{Code, Failure, Result, Warning};

/// `extensionsRequired` that are understood, beside every KHR_materials_*.
const HANDLED: [&str; 4] =
    ["KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "EXT_mesh_gpu_instancing"];

/// Most values that a glTF JSON may hold: each takes some 80 bytes of memory, however short it is written.
const MAX_JSON_VALUES: usize = 8_000_000;

/// Whether an extension is understood, so that nothing in it can refer to buffers unseen.
pub(crate) fn is_handled(extension: &str) -> bool {
    extension.starts_with("KHR_materials_") || HANDLED.contains(&extension)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Container {
    Glb,
    Gltf,
    Obj,
}

/// Loads the model among `files` (.glb, .gltf, .obj, or one of them in a .zip), told by content and by name. `main`
/// names it where there are several. Every buffer is resolved, every buffer view and accessor lies inside its buffer;
/// images that are missing are `None` and a warning.
///
/// # Errors
/// `invalid_model` with a pointer for a broken container, JSON, buffer view or accessor; `unsupported_extension`;
/// `missing_file` for buffers; `too_large` beyond `limits`.
pub fn load(files: &[File], main: Option<&str>, limits: &Limits) -> Result<(Document, Vec<Warning>)> {
    let upload = unpack(files, limits)?;
    // An archive that is named stands for the model inside it.
    let main = main.filter(|m| !files.iter().any(|f| f.path == **m && archive::is_zip(&f.bytes)));
    let (entry, container) = find_model(&upload, main)?;
    if entry.bytes.is_empty() {
        return Err(Failure::model(format!("the file {} is empty", quote(&entry.path))));
    }
    let mut warnings = Vec::new();
    let document = match container {
        Container::Obj => obj::load(entry, &upload, limits, &mut warnings)?,
        Container::Gltf => {
            let json = parse_json(&entry.bytes, limits)?;
            resolve(json, None, entry, &upload, limits, &mut warnings)?
        }
        Container::Glb => {
            let chunks = glb::parse(&entry.bytes, &mut warnings)?;
            let json = parse_json(chunks.json, limits)?;
            resolve(json, chunks.bin, entry, &upload, limits, &mut warnings)?
        }
    };
    Ok((document, warnings))
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
        entries.push(Entry { path: clean_path(&file.path, index), bytes: Cow::Borrowed(file.bytes.as_slice()) });
    }
    let mut left = limits.max_input_bytes;
    for file in files.iter().filter(|f| archive::is_zip(&f.bytes)) {
        entries.extend(archive::unpack(&file.path, &file.bytes, &mut left)?);
    }
    Ok(Upload::new(entries))
}

fn find_model<'u, 'a>(upload: &'u Upload<'a>, main: Option<&str>) -> Result<(&'u Entry<'a>, Container)> {
    if let Some(main) = main {
        let entry = upload.find(&clean_path(main, 0)).ok_or_else(|| {
            Failure::new(Code::MissingFile, format!("the model {} is not among the files", quote(main)))
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
            Err(Failure::model(format!("there are several models ({}): name the one to take", names.join(", "))))
        }
        (None, _) => Err(match upload.entries() {
            [] => Failure::model("there is no file in the input"),
            [only] => not_a_model(only),
            all => Failure::model(format!("none of the {} files is a .glb, .gltf or .obj", all.len())),
        }),
    }
}

fn not_a_model(entry: &Entry<'_>) -> Failure {
    if entry.bytes.is_empty() {
        return Failure::model(format!("the file {} is empty", quote(&entry.path)));
    }
    Failure::model(format!("the file {} is neither GLB, glTF, OBJ nor a zip archive of one", quote(&entry.path)))
}

/// What a file is, by its first bytes, then its name, and where `guess` is set by how its text looks.
fn container(entry: &Entry<'_>, guess: bool) -> Option<Container> {
    let bytes = &*entry.bytes;
    if bytes.starts_with(glb::MAGIC) {
        return Some(Container::Glb);
    }
    let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes).trim_ascii_start();
    match uri::extension(&entry.path).as_str() {
        "gltf" => Some(Container::Gltf),
        "glb" if text.first() == Some(&b'{') => Some(Container::Gltf),
        "glb" => Some(Container::Glb),
        "obj" => Some(Container::Obj),
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

/// Checks the document and gathers its buffers and images.
fn resolve(
    json: Value,
    bin: Option<&[u8]>,
    entry: &Entry<'_>,
    upload: &Upload<'_>,
    limits: &Limits,
    warnings: &mut Vec<Warning>,
) -> Result<Document> {
    check_header(&json)?;
    let mut budget = Budget { left: limits.max_input_bytes.saturating_mul(2) };
    let buffers = buffers(&json, bin, &entry.path, upload, &mut budget, warnings)?;
    let lengths: Vec<usize> = buffers.iter().map(Vec::len).collect();
    structure::check(&json, &lengths, limits.max_input_bytes, warnings)?;
    check_triangles(&json, limits)?;
    let mut document = Document { json, buffers, images: Vec::new(), name: uri::stem(&entry.path).to_owned() };
    document.images = images(&document, &entry.path, upload, &mut budget, warnings)?;
    Ok(document)
}

fn check_header(json: &Value) -> Result<()> {
    if !json.is_object() {
        return Err(Failure::model("the glTF JSON is not an object").at(""));
    }
    let asset = json.get("asset").and_then(Value::as_object);
    let asset =
        asset.ok_or_else(|| Failure::model("the asset object, with the glTF version, is missing").at("/asset"))?;
    let version = asset.get("version").and_then(Value::as_str).unwrap_or_default();
    if major(version) != Some(2) {
        let message = format!("glTF version {} is not supported, only 2.x is", quote(version));
        return Err(Failure::model(message).at("/asset/version"));
    }
    if let Some(least) = asset.get("minVersion") {
        let least = least.as_str().unwrap_or_default();
        if least != "2.0" {
            let message = format!("the model needs a reader of glTF {}, and this one reads 2.0", quote(least));
            return Err(Failure::model(message).at("/asset/minVersion"));
        }
    }
    for (index, name) in list(json, "extensionsRequired")?.iter().enumerate() {
        let name = name.as_str().unwrap_or_default();
        if !is_handled(name) {
            let message = format!("the model requires the extension {}, which is not supported", quote(name));
            return Err(Failure::new(Code::UnsupportedExtension, message).at(format!("/extensionsRequired/{index}")));
        }
    }
    for key in [
        "accessors",
        "animations",
        "buffers",
        "bufferViews",
        "cameras",
        "images",
        "materials",
        "meshes",
        "nodes",
        "samplers",
        "scenes",
        "skins",
        "textures",
    ] {
        if let Some(index) = list(json, key)?.iter().position(|v| !v.is_object()) {
            return Err(Failure::model("an object is expected here").at(format!("/{key}/{index}")));
        }
    }
    Ok(())
}

fn major(version: &str) -> Option<u32> {
    let (major, minor) = version.split_once('.')?;
    minor.parse::<u32>().ok()?;
    major.parse().ok()
}

/// How many bytes buffers and images may still take: a file named a thousand times counts a thousand times.
struct Budget {
    left: u64,
}

impl Budget {
    fn take(&mut self, bytes: &[u8], pointer: &str) -> Result<Vec<u8>> {
        self.left = self.left.checked_sub(bytes.len() as u64).ok_or_else(|| {
            Failure::new(Code::TooLarge, "the buffers and images together exceed the limit on the input").at(pointer)
        })?;
        Ok(bytes.to_vec())
    }
}

fn buffers(
    json: &Value,
    bin: Option<&[u8]>,
    path: &str,
    upload: &Upload<'_>,
    budget: &mut Budget,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Vec<u8>>> {
    let mut buffers = Vec::new();
    let mut bin_used = false;
    for index in 0..list(json, "buffers")?.len() {
        let object = structure::element(json, "buffers", index)?;
        let pointer = format!("/buffers/{index}");
        let at_uri = format!("{pointer}/uri");
        let length = whole(object, "byteLength", &pointer)?
            .ok_or_else(|| Failure::model("byteLength is missing").at(pointer.clone()))?;
        let found: Cow<'_, [u8]> = match (object.get("uri"), bin) {
            (None, Some(bin)) if index == 0 => {
                bin_used = true;
                Cow::Borrowed(bin)
            }
            (None, _) => {
                return Err(
                    Failure::model("the buffer has no uri, and there is no GLB binary chunk for it").at(pointer)
                );
            }
            (Some(Value::String(data)), _) if uri::is_data(data) => {
                Cow::Owned(uri::parse_data(data).map_err(|e| Failure::model(e).at(at_uri.clone()))?.bytes)
            }
            (Some(Value::String(relative)), _) => {
                let resolved = uri::resolve(path, relative).map_err(|e| Failure::model(e).at(at_uri.clone()))?;
                let file = upload.find(&resolved).ok_or_else(|| {
                    let message = format!("the buffer's file {} was not uploaded", quote(relative));
                    Failure::new(Code::MissingFile, message).at(at_uri.clone())
                })?;
                Cow::Borrowed(&*file.bytes)
            }
            (Some(_), _) => return Err(Failure::model("uri is not a string").at(at_uri)),
        };
        let bytes = found.get(..length).ok_or_else(|| {
            let message = format!("the buffer declares {length} bytes, and {} are there", found.len());
            Failure::model(message).at(format!("{pointer}/byteLength"))
        })?;
        buffers.push(budget.take(bytes, &pointer)?);
    }
    if let Some(bin) = bin.filter(|b| !b.is_empty() && !bin_used) {
        let message = format!("the binary chunk of {} bytes belongs to no buffer and is dropped", bin.len());
        warnings.push(Warning::new("unused_binary_chunk", message));
    }
    Ok(buffers)
}

fn images(
    document: &Document,
    path: &str,
    upload: &Upload<'_>,
    budget: &mut Budget,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Option<Vec<u8>>>> {
    let mut images = Vec::new();
    for index in 0..list(&document.json, "images")?.len() {
        let object = structure::element(&document.json, "images", index)?;
        let pointer = format!("/images/{index}");
        let mut missing = |code: &str, why: String| {
            warnings.push(Warning::new(code, why).at(pointer.clone()));
            None
        };
        let found = if let Some(view) = whole(object, "bufferView", &pointer)? {
            let bytes = document.view_bytes(view).map_err(|e| e.at(format!("{pointer}/bufferView")))?;
            Some(Cow::Borrowed(bytes))
        } else {
            match object.get("uri").and_then(Value::as_str) {
                None => missing("missing_image", "the image has neither a uri nor a bufferView".to_owned()),
                Some(data) if uri::is_data(data) => match uri::parse_data(data) {
                    Ok(found) => Some(Cow::Owned(found.bytes)),
                    Err(why) => missing("invalid_image", why),
                },
                Some(relative) => match uri::resolve(path, relative) {
                    Err(why) => missing("missing_image", why),
                    Ok(resolved) => match upload.find(&resolved) {
                        Some(file) => Some(Cow::Borrowed(&*file.bytes)),
                        None => {
                            missing("missing_image", format!("the image file {} was not uploaded", quote(relative)))
                        }
                    },
                },
            }
        };
        images.push(match found {
            Some(bytes) => Some(budget.take(&bytes, &pointer)?),
            None => None,
        });
    }
    Ok(images)
}

/// Counts the triangles that the primitives declare; what is broken about them is told by those who read them.
fn check_triangles(json: &Value, limits: &Limits) -> Result<()> {
    let mut total: u64 = 0;
    let count = |accessor: &Value| {
        let index = usize::try_from(accessor.as_u64()?).ok()?;
        json.get("accessors")?.get(index)?.get("count")?.as_u64()
    };
    for (mesh, object) in list(json, "meshes")?.iter().enumerate() {
        let primitives = object.get("primitives").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
        for primitive in primitives {
            let position = || primitive.get("attributes")?.get("POSITION");
            let corners = primitive.get("indices").or_else(position).and_then(count).unwrap_or(0);
            let triangles = match primitive.get("mode").map_or(Some(4), Value::as_u64) {
                Some(4) => corners / 3,
                Some(5 | 6) => corners.saturating_sub(2),
                _ => 0,
            };
            total = total.saturating_add(triangles);
        }
        if total > limits.max_triangles {
            let message = format!("the model has more than {} triangles", limits.max_triangles);
            return Err(Failure::new(Code::TooLarge, message).at(format!("/meshes/{mesh}")));
        }
    }
    Ok(())
}
