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
    /// An image, or a compressed primitive.
    New(&'a [u8]),
    /// The stream that an extension names; the view itself has so many bytes of a buffer without contents.
    Compressed { stream: &'a [u8], extension: &'static str, length: usize },
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
        let compressed = document.compressed.as_ref();
        let json = compressed.map_or(&document.json, |c| &c.json);
        let mut sources = Vec::new();
        for index in 0..list(json, "bufferViews")?.len() {
            let view = accessor_layout::view(json, index)?;
            if let Some(own) = compressed.and_then(|c| c.views.get(&index)) {
                sources.push(match own.extension {
                    Some(extension) => ViewSource::Compressed { stream: &own.bytes, extension, length: view.length },
                    None => ViewSource::New(&own.bytes),
                });
                continue;
            }
            document.view_bytes(index)?;
            sources.push(ViewSource::Old { buffer: view.buffer, offset: view.offset, length: view.length });
        }
        Ok(OutputDraft { document, json: json.clone(), sources })
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
        let (mut compact, mut uploaded) = (false, false);
        // Where something may name accessors and views unseen, those that came with the file stay.
        let least = match self.document.origins.uploaded {
            _ if extensions::all_understood(&self.document.json) => Some([0, 0]),
            least => least.filter(|_| self.document.compressed.is_some()),
        };
        if let Some(kept) = least.and_then(|least| prune::prune(&mut self.json, least)) {
            let mut keep = kept.iter();
            self.sources.retain(|_| keep.next().copied().unwrap_or(true));
            compact = kept.contains(&false) || self.document.compressed.is_some();
            uploaded = least != Some([0, 0]);
        }
        let mut bin = Vec::new();
        let ranges = if compact { self.used_ranges(uploaded) } else { self.whole_buffers() };
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
                ViewSource::New(bytes) | ViewSource::Compressed { stream: bytes, .. } => {
                    bin.resize(bin.len().next_multiple_of(4), 0);
                    bin.extend_from_slice(bytes);
                    bin.len() - bytes.len()
                }
            });
        }
        let without_contents = self.write_views(&offsets, &placed)?;
        self.write_buffers(bin.len(), uri, without_contents);
        Ok(bin)
    }

    fn whole_buffers(&self) -> Vec<(usize, usize, usize)> {
        self.document.buffers.iter().enumerate().map(|(index, bytes)| (index, 0, bytes.len())).collect()
    }

    /// The bytes of the buffer views that are left; views may overlap. With `uploaded` whatever came with the file too, but for the streams that
    /// are replaced.
    fn used_ranges(&self, uploaded: bool) -> Vec<(usize, usize, usize)> {
        let mut used: Vec<(usize, usize, usize)> = self
            .sources
            .iter()
            .filter_map(|source| match *source {
                ViewSource::Old { buffer, offset, length } => Some((buffer, offset, offset + length)),
                ViewSource::New(_) | ViewSource::Compressed { .. } => None,
            })
            .collect();
        if uploaded {
            used.extend(self.document.uploaded_ranges());
        }
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

    /// Gives the length of the buffer without contents that compressed views name, and the extension that tells of it; none where there are none.
    fn write_views(&mut self, offsets: &[usize], placed: &[PlacedRange]) -> Result<Option<(usize, &'static str)>> {
        let mut without_contents: Option<(usize, &'static str)> = None;
        let views = self.json.get_mut("bufferViews").and_then(Value::as_array_mut).into_iter().flatten();
        for ((view, source), offset) in views.zip(&self.sources).zip(offsets) {
            if let ViewSource::Compressed { stream, extension, length } = *source {
                let (end, _) = without_contents.get_or_insert((0, extension));
                set_number(view, "buffer", 1, None);
                set_number(view, "byteOffset", *end, Some(0));
                *end = (*end + length).next_multiple_of(4);
                let own = &mut view["extensions"][extension];
                set_number(own, "byteOffset", *offset, Some(0));
                set_number(own, "byteLength", stream.len(), None);
                continue;
            }
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
        Ok(without_contents)
    }

    /// One buffer; the name and extras of the first stay. Behind it that without contents.
    fn write_buffers(&mut self, length: usize, uri: Option<&str>, without_contents: Option<(usize, &str)>) {
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
        if let (Some((length, extension)), Some(buffers)) = (without_contents, buffers.as_array_mut()) {
            buffers.push(json!({ "byteLength": length, "extensions": { extension: { "fallback": true } } }));
        }
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
