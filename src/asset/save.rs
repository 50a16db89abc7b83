//! From a [`Document`] to files: one GLB, or glTF with side files.
//!
//! `Document::images` is what counts: where an image's bytes differ from those its buffer view holds, the new ones are
//! stored. Buffers become one. Where every extension is understood, accessors and buffer views that nothing refers to any
//! more are left out with their bytes; otherwise every index stays as it is.

use serde_json::{Value, json};

use super::accessor_layout;
use super::document::{Document, File};
use super::json::{array_mut, list, number};
use super::side_names::{Names, by_name, media_type, plain};
use super::uri;
use super::{extensions, glb, prune};
use crate::error::{Failure, Result};

/// Where the bytes of a buffer view come from.
#[derive(Debug, Clone, Copy)]
enum ViewSource<'a> {
    /// A range of one of the document's buffers.
    Old { buffer: usize, offset: usize, length: usize },
    /// An image.
    New(&'a [u8]),
}

/// The document on its way out.
struct OutputDraft<'a> {
    document: &'a Document,
    json: Value,
    /// By buffer view.
    sources: Vec<ViewSource<'a>>,
}

impl Document {
    /// The document as GLB: all buffers and all images at hand in its binary chunk.
    ///
    /// # Errors
    /// `too_large` beyond 4 GiB; `invalid_model` when the document is not consistent.
    pub fn to_glb(&self) -> Result<Vec<u8>> {
        self.to_aligned_glb(4)
    }

    /// [`Document::to_glb`], with a length that is a multiple of `alignment`.
    pub(crate) fn to_aligned_glb(&self, alignment: usize) -> Result<Vec<u8>> {
        let mut draft = OutputDraft::new(self)?;
        for (index, bytes) in self.images.iter().enumerate() {
            if let Some(bytes) = bytes {
                draft.embed(index, bytes)?;
            }
        }
        let bin = draft.finish(None)?;
        glb::build(to_json(&draft.json)?, &bin, alignment)
    }

    /// The document as `model.gltf`, `model.bin` and one file for each image at hand: under the name that it came with, else
    /// `image-N.png` or `.jpg`.
    ///
    /// # Errors
    /// `invalid_model` when the document is not consistent.
    pub fn to_gltf(&self) -> Result<Vec<File>> {
        to_gltf(&[("model".to_owned(), self)])
    }
}

/// Documents as `<name>.gltf`, `<name>.bin` and one file for each image at hand, all side by side: images of equal name and
/// contents are one file.
///
/// # Errors
/// `invalid_model` when a document is not consistent.
pub fn to_gltf(documents: &[(String, &Document)]) -> Result<Vec<File>> {
    let mut names = Names::beside(documents.iter().map(|(name, _)| name.clone()));
    let (mut files, mut sides) = (Vec::new(), Vec::new());
    for (name, document) in documents {
        let mut draft = OutputDraft::new(document)?;
        for (index, bytes) in document.images.iter().enumerate() {
            if let Some(bytes) = bytes {
                draft.put_aside(index, bytes, &mut names, &mut sides);
            }
        }
        let buffer = format!("{name}.bin");
        let bin = draft.finish(Some(&buffer))?;
        files.push(File { path: format!("{name}.gltf"), bytes: to_json(&draft.json)? });
        if !bin.is_empty() {
            files.push(File { path: buffer, bytes: bin });
        }
    }
    files.append(&mut sides);
    Ok(files)
}

fn to_json(json: &Value) -> Result<Vec<u8>> {
    serde_json::to_vec(json).map_err(|e| Failure::internal(format!("the glTF JSON cannot be written: {e}")))
}

impl<'a> OutputDraft<'a> {
    fn new(document: &'a Document) -> Result<Self> {
        let mut sources = Vec::new();
        for index in 0..list(&document.json, "bufferViews")?.len() {
            let view = accessor_layout::view(&document.json, index)?;
            document.view_bytes(index)?;
            sources.push(ViewSource::Old { buffer: view.buffer, offset: view.offset, length: view.length });
        }
        Ok(OutputDraft { document, json: document.json.clone(), sources })
    }

    fn image(&mut self, index: usize) -> Option<&mut serde_json::Map<String, Value>> {
        self.json.get_mut("images")?.get_mut(index)?.as_object_mut()
    }

    /// Puts an image into a buffer view of its own, unless its bytes already are in the one that it names.
    fn embed(&mut self, index: usize, bytes: &'a [u8]) -> Result<()> {
        let view = self.sources.len();
        let document = self.document;
        let Some(image) = self.image(index) else { return Ok(()) };
        if let Some(named) = image.get("bufferView").and_then(number)
            && document.view_bytes(named)? == bytes
        {
            return Ok(());
        }
        let uri = image.shift_remove("uri");
        let media_type = media_type(bytes).or_else(|| by_name(uri.as_ref()?.as_str()?));
        if media_type.is_some() || !image.contains_key("mimeType") {
            image.insert("mimeType".to_owned(), media_type.unwrap_or("application/octet-stream").into());
        }
        image.insert("bufferView".to_owned(), Value::from(view));
        self.sources.push(ViewSource::New(bytes));
        array_mut(&mut self.json, "bufferViews")?.push(json!({ "buffer": 0, "byteLength": bytes.len() }));
        Ok(())
    }

    /// Makes an image a file of its own.
    fn put_aside(&mut self, index: usize, bytes: &'a [u8], names: &mut Names<'a>, sides: &mut Vec<File>) {
        let Some(image) = self.image(index) else { return };
        let uploaded = image.get("uri").and_then(Value::as_str).filter(|u| !uri::is_data(u));
        let wanted = uploaded.and_then(|u| uri::resolve("", u).ok()).map(|path| plain(&path));
        let (path, fresh) = names.find(wanted, (index, self.document.images.len()), bytes);
        let Some(image) = self.image(index) else { return };
        image.shift_remove("bufferView");
        // An untouched file keeps its URI as it is spelt.
        let same =
            image.get("uri").and_then(Value::as_str).is_some_and(|u| uri::resolve("", u).is_ok_and(|p| p == path));
        if !same {
            let escaped = percent_encoding::utf8_percent_encode(&path, &uri::RESERVED).to_string();
            image.insert("uri".to_owned(), Value::from(escaped));
        }
        if let Some(media_type) = media_type(bytes).filter(|_| image.contains_key("mimeType")) {
            image.insert("mimeType".to_owned(), Value::from(media_type));
        }
        if fresh {
            sides.push(File { path, bytes: bytes.to_vec() });
        }
    }

    /// Takes out what nothing refers to, lays the bytes of all buffer views into one buffer and says so in the JSON.
    fn finish(&mut self, uri: Option<&str>) -> Result<Vec<u8>> {
        let mut compact = false;
        if extensions::all_understood(&self.json)
            && let Some(kept) = prune::prune(&mut self.json)
        {
            let mut keep = kept.iter();
            self.sources.retain(|_| keep.next().copied().unwrap_or(true));
            compact = kept.contains(&false);
        }
        let mut bin = Vec::new();
        let ranges = if compact { self.used_ranges() } else { self.whole_buffers() };
        let mut placed: Vec<PlacedRange> = Vec::with_capacity(ranges.len());
        for (buffer, start, end) in ranges {
            let bytes = self.document.buffers.get(buffer).and_then(|b| b.get(start..end)).unwrap_or_default();
            // The remainder by 4 stays, and with it the alignment of every accessor.
            bin.resize(bin.len().next_multiple_of(4) + start % 4, 0);
            placed.push(PlacedRange { buffer, start, end, at: bin.len() });
            bin.extend_from_slice(bytes);
        }
        let mut offsets = Vec::with_capacity(self.sources.len());
        for source in &self.sources {
            offsets.push(match *source {
                ViewSource::Old { buffer, offset, .. } => locate(&placed, buffer, offset)?,
                ViewSource::New(bytes) => {
                    bin.resize(bin.len().next_multiple_of(4), 0);
                    bin.extend_from_slice(bytes);
                    bin.len() - bytes.len()
                }
            });
        }
        self.write_views(&offsets, &placed)?;
        self.write_buffers(bin.len(), uri);
        Ok(bin)
    }

    fn whole_buffers(&self) -> Vec<(usize, usize, usize)> {
        self.document.buffers.iter().enumerate().map(|(index, bytes)| (index, 0, bytes.len())).collect()
    }

    /// The bytes of the buffer views that are left; views may overlap.
    fn used_ranges(&self) -> Vec<(usize, usize, usize)> {
        let mut used: Vec<(usize, usize, usize)> = self
            .sources
            .iter()
            .filter_map(|source| match *source {
                ViewSource::Old { buffer, offset, length } => Some((buffer, offset, offset + length)),
                ViewSource::New(_) => None,
            })
            .collect();
        used.sort_unstable();
        let mut merged: Vec<(usize, usize, usize)> = Vec::new();
        for (buffer, start, end) in used {
            match merged.last_mut() {
                Some(last) if last.0 == buffer && start <= last.2 => last.2 = last.2.max(end),
                _ => merged.push((buffer, start, end)),
            }
        }
        merged
    }

    fn write_views(&mut self, offsets: &[usize], placed: &[PlacedRange]) -> Result<()> {
        let Some(views) = self.json.get_mut("bufferViews").and_then(Value::as_array_mut) else { return Ok(()) };
        for (view, offset) in views.iter_mut().zip(offsets) {
            set_number(view, "buffer", 0, None);
            set_number(view, "byteOffset", *offset, Some(0));
            // Compression extensions name a buffer range of their own.
            let extensions = view.get_mut("extensions").and_then(Value::as_object_mut);
            for extension in extensions.into_iter().flat_map(|e| e.values_mut()) {
                let Some(buffer) = extension.get("buffer").and_then(number) else { continue };
                let offset = locate(placed, buffer, extension.get("byteOffset").and_then(number).unwrap_or(0))?;
                set_number(extension, "buffer", 0, None);
                set_number(extension, "byteOffset", offset, Some(0));
            }
        }
        Ok(())
    }

    /// One buffer; the name and extras of the first stay.
    fn write_buffers(&mut self, length: usize, uri: Option<&str>) {
        let Some(root) = self.json.as_object_mut() else { return };
        if length == 0 {
            root.shift_remove("buffers");
            return;
        }
        let buffers = root.entry("buffers").or_insert_with(|| json!([]));
        let mut first = buffers.get(0).filter(|b| b.is_object()).cloned().unwrap_or_else(|| json!({}));
        if let (Some(object), None) = (first.as_object_mut(), uri) {
            object.shift_remove("uri");
        }
        if let Some(uri) = uri {
            first["uri"] = Value::from(uri);
        }
        set_number(&mut first, "byteLength", length, None);
        *buffers = json!([first]);
    }
}

/// A range of an old buffer and where it begins in the new one.
#[derive(Debug, Clone, Copy)]
struct PlacedRange {
    buffer: usize,
    start: usize,
    end: usize,
    at: usize,
}

fn locate(placed: &[PlacedRange], buffer: usize, offset: usize) -> Result<usize> {
    let after = placed.partition_point(|r| (r.buffer, r.start) <= (buffer, offset));
    let range = after.checked_sub(1).and_then(|i| placed.get(i)).filter(|r| r.buffer == buffer && offset <= r.end);
    range
        .map(|r| r.at + (offset - r.start))
        .ok_or_else(|| Failure::model(format!("byte {offset} of buffer {buffer} does not exist")).at("/bufferViews"))
}

/// Sets a number unless it is there, or missing with this default.
fn set_number(value: &mut Value, key: &str, wanted: usize, default: Option<usize>) {
    let found = value.get(key).map_or(default, number);
    if found != Some(wanted) {
        value[key] = Value::from(wanted);
    }
}
