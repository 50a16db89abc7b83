//! Resolves the buffers and images of a glTF document, from the GLB, the upload and data URIs; checks all of it.

use std::borrow::Cow;

use serde_json::Value;

use super::accessor_layout;
use super::compression;
use super::document::{Document, Merging};
use super::extensions;
use super::json::{array, list, object, read_key};
use super::limits::{Budget, Limits};
use super::name::readable;
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
    let name = uri::stem(&readable(&entry.path)).to_owned();
    let mut document = Document {
        json,
        buffers,
        images: Vec::new(),
        name,
        merging: Merging::default(),
        tile: None,
        undefined: Default::default(),
        origins: Default::default(),
        compressed: None,
    };
    document.origins.uploaded = Some(document.lengths());
    document.origins.lengths = document.buffers.iter().map(Vec::len).collect();
    let filtered = compression::views(&mut document, &mut budget, check)?;
    let lengths: Vec<usize> = document.buffers.iter().map(Vec::len).collect();
    accessor_layout::check(&document.json, &lengths, limits.max_input_bytes, warnings)?;
    check_triangles(&document.json, limits)?;
    compression::renew_bounds(&mut document, &filtered)?;
    compression::primitives(&mut document, limits, &mut budget, warnings, check)?;
    // A stream may hold more than was declared.
    check_triangles(&document.json, limits)?;
    document.images = images(&document, &entry.path, upload, &mut budget, warnings)?;
    Ok(document)
}

fn check_header(json: &Value) -> Result<()> {
    if !json.is_object() {
        return Err(Failure::model("the glTF JSON is not an object").at(""));
    }
    let asset = object(json, "asset")
        .ok_or_else(|| Failure::model("the asset object, with the glTF version, is missing").at("/asset"))?;
    let version = asset.get("version").and_then(Value::as_str).unwrap_or_default();
    if major(version) != Some(2) {
        let message = format!("glTF version {} is not supported, only 2.x is", quote(version));
        return Err(Failure::model(message).at("/asset/version"));
    }
    if let Some(least) = asset.get("minVersion").map(|v| v.as_str().unwrap_or_default()).filter(|v| *v != "2.0") {
        let message = format!("the model needs a reader of glTF {}, and this one reads 2.0", quote(least));
        return Err(Failure::model(message).at("/asset/minVersion"));
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
    for (index, object) in list(json, "buffers")?.iter().enumerate() {
        let pointer = format!("/buffers/{index}");
        let length: usize = read_key(object, "byteLength", &pointer)?
            .ok_or_else(|| Failure::model("byteLength is missing").at(pointer.clone()))?;
        if placeholders.contains(&index) {
            buffers.push(Vec::new());
            continue;
        }
        let found = match (object.get("uri"), bin) {
            (Some(Value::String(uri)), _) => contents(uri, path, upload, "buffer's"),
            (Some(_), _) => Err(Failure::model("uri is not a string")),
            (None, Some(bin)) if index == 0 => {
                bin_used = true;
                Ok(Cow::Borrowed(bin))
            }
            (None, _) => {
                let message = "the buffer has no uri, and there is no GLB binary chunk for it";
                return Err(Failure::model(message).at(pointer));
            }
        };
        let found = found.map_err(|e| e.at(format!("{pointer}/uri")))?;
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

/// What a URI in the model at `path` stands for. `whose` file it is, is told where it is not there.
fn contents<'a>(uri: &str, path: &str, upload: &'a Upload<'_>, whose: &str) -> Result<Cow<'a, [u8]>> {
    if uri::is_data(uri) {
        return uri::parse_data(uri).map(Cow::Owned).map_err(Failure::model);
    }
    let file = upload.find(&uri::resolve(path, uri).map_err(Failure::model)?).ok_or_else(|| {
        Failure::new(
            Code::MissingFile,
            format!("the {whose} file {} was not uploaded: send it along with the model, under that name", quote(uri)),
        )
    })?;
    Ok(Cow::Borrowed(&*file.bytes))
}

fn images(
    document: &Document,
    path: &str,
    upload: &Upload<'_>,
    budget: &mut Budget,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Option<Vec<u8>>>> {
    let mut images = Vec::new();
    for (index, object) in list(&document.json, "images")?.iter().enumerate() {
        let pointer = format!("/images/{index}");
        let uri = object.get("uri").and_then(Value::as_str);
        let found = match (read_key(object, "bufferView", &pointer)?, uri) {
            (Some(view), _) => {
                let bytes = document.view_bytes(view).map_err(|e| e.at(format!("{pointer}/bufferView")))?;
                Ok(Cow::Borrowed(bytes))
            }
            (None, Some(uri)) => contents(uri, path, upload, "image"),
            (None, None) => Err(Failure::model("the image has neither a uri nor a bufferView")),
        };
        images.push(match found {
            Ok(bytes) => Some(budget.take(&bytes, &pointer)?),
            Err(failure) => {
                let code = if uri.is_some_and(uri::is_data) { "invalid_image" } else { "missing_image" };
                warnings.push(Warning::new(code, failure.message).at(pointer));
                None
            }
        });
    }
    Ok(images)
}

/// Counts the triangles that the primitives declare; what is broken about them is told by those who read them.
fn check_triangles(json: &Value, limits: &Limits) -> Result<()> {
    let mut total: u64 = 0;
    for (mesh, object) in list(json, "meshes")?.iter().enumerate() {
        let own = array(object, "primitives").iter().map(|primitive| declared_triangles(json, primitive));
        total = own.fold(total, u64::saturating_add);
        if total > limits.max_triangles {
            let message = format!("the model has more than {} triangles", limits.max_triangles);
            return Err(Failure::new(Code::TooLarge, message).at(format!("/meshes/{mesh}")));
        }
    }
    Ok(())
}
