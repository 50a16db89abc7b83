//! Resolves the buffers and images of a glTF document, from the GLB, the upload and data URIs; checks all of it.

use std::borrow::Cow;

use serde_json::Value;

use super::accessor_layout::{self, list, whole};
use super::compression;
use super::document::{Document, Merging};
use super::extensions;
use super::limits::{Budget, Limits};
use super::nodes;
use super::primitive::declared_triangles;
use super::upload::{Upload, UploadEntry};
use super::uri::{self, quote};
use crate::error::{Code, Failure, Result, Warning};

/// Checks a document and resolves its buffers and images. `bin` is the GLB's binary chunk, `entry` the file that holds the document.
///
/// # Errors
/// As [`super::load`].
pub(crate) fn resolve(
    json: Value,
    bin: Option<&[u8]>,
    entry: &UploadEntry<'_>,
    upload: &Upload<'_>,
    limits: &Limits,
    warnings: &mut Vec<Warning>,
    check: &dyn Fn() -> Result<()>,
) -> Result<Document> {
    check_header(&json)?;
    nodes::check(&json)?;
    let mut budget = Budget::new(limits);
    let buffers = buffers(&json, bin, &entry.path, upload, &mut budget, warnings)?;
    let name = uri::stem(&entry.path).to_owned();
    let mut document = Document { json, buffers, images: Vec::new(), name, merging: Merging::default() };
    let filtered = compression::views(&mut document, &mut budget, warnings, check)?;
    let lengths: Vec<usize> = document.buffers.iter().map(Vec::len).collect();
    accessor_layout::check(&document.json, &lengths, limits.max_input_bytes, warnings)?;
    check_triangles(&document.json, limits)?;
    compression::renew_bounds(&mut document, &filtered)?;
    compression::primitives(&mut document, limits, &mut budget, warnings, check)?;
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
        if !extensions::is_read(name) {
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

fn buffers(
    json: &Value,
    bin: Option<&[u8]>,
    path: &str,
    upload: &Upload<'_>,
    budget: &mut Budget,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Vec<u8>>> {
    let placeholders = compression::placeholders(json)?;
    let mut buffers = Vec::new();
    let mut bin_used = false;
    for index in 0..list(json, "buffers")?.len() {
        let object = accessor_layout::element(json, "buffers", index)?;
        let pointer = format!("/buffers/{index}");
        let at_uri = format!("{pointer}/uri");
        let length = whole(object, "byteLength", &pointer)?
            .ok_or_else(|| Failure::model("byteLength is missing").at(pointer.clone()))?;
        if placeholders.contains(&index) {
            buffers.push(Vec::new());
            continue;
        }
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
        let object = accessor_layout::element(&document.json, "images", index)?;
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
    for (mesh, object) in list(json, "meshes")?.iter().enumerate() {
        total = total.saturating_add(declared_triangles(json, object));
        if total > limits.max_triangles {
            let message = format!("the model has more than {} triangles", limits.max_triangles);
            return Err(Failure::new(Code::TooLarge, message).at(format!("/meshes/{mesh}")));
        }
    }
    Ok(())
}
