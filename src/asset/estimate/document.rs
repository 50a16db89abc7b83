//! What a glTF document refers to: its triangles, and the heads of its images wherever they are.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;

use serde_json::Value;

use super::super::extensions::MESHOPT;
use super::super::glb;
use super::super::json::{array, number, whole};
use super::super::limits::Limits;
use super::super::load::Container;
use super::super::primitive::declared_triangles;
use super::super::tile::{HEAD, TileHeader};
use super::super::uri;
use super::files::{Files, Forward, Stream};
use super::sum::Sum;
use super::{layout, tree};
use crate::texture::{Header, probe};

/// Bytes of a string at first: the head of an image in a data URI.
const STRING: usize = 128 << 10;
/// How often an entry of an archive is read for images that lie in each other.
const MOST_ROUNDS: usize = 64;
/// What the names of texture coordinates begin with.
pub(super) const TEXCOORD: &str = "TEXCOORD_";

/// A document and where its parts lie.
pub(super) struct DocumentOutline {
    pub(super) json: Value,
    /// Where the binary chunk of a GLB begins.
    bin: u64,
    /// Strings are cut after this many bytes.
    string: usize,
}

/// Adds what the document in a file needs to `sum`. What is broken counts as nothing.
pub(super) fn add(files: &mut Files, index: usize, container: Container, limits: &Limits, sum: &mut Sum) {
    let glb = |file: &mut dyn Forward| {
        let mut head = Vec::new();
        Read::take(&mut *file, HEAD as u64).read_to_end(&mut head).ok()?;
        TileHeader::read(&head, u64::MAX).ok().map(|header| header.glb())
    };
    let start = match container {
        Container::Tile => files.open(index, glb).flatten(),
        _ => Some(0),
    };
    let Some(glb) = start else { return };
    let read = |string: usize| {
        move |file: &mut dyn Forward| {
            let (start, length, bin) = match container {
                Container::Glb | Container::Tile => chunks(file, glb)?,
                _ => (0, limits.max_json_bytes, 0),
            };
            file.to(start).ok()?;
            Some(DocumentOutline { json: tree::read(file, length.min(limits.max_json_bytes), string)?, bin, string })
        }
    };
    let Some(mut draft) = files.open(index, read(STRING)).flatten() else { return };
    let mut images = draft.images(index, files);
    // Heads that lie behind the cut of a string: data URIs with several images, or with long metadata.
    if images.iter().any(Option::is_none)
        && draft.is_cut()
        && let Some(whole) = files.open(index, read(usize::MAX)).flatten()
    {
        draft = whole;
        images = draft.images(index, files);
    }
    for (image, object) in images.iter().zip(array(&draft.json, "images")) {
        let length = draft.image_length(object, index, files);
        // Files of the upload are counted as such.
        if let Some(header) = image
            && object.get("uri").and_then(Value::as_str).is_none_or(uri::is_data)
        {
            sum.image(*header, length, limits);
        }
        sum.encoded += length;
    }
    draft.geometry(index, files, sum);
    match layout::covered(&draft, index, files) {
        Some(covered) => sum.covered += covered,
        None => sum.is_unmeasured = true,
    }
}

/// Where the JSON of the GLB at an offset begins, its length, and where the binary chunk begins.
fn chunks(file: &mut dyn Forward, offset: u64) -> Option<(u64, u64, u64)> {
    let mut head = [0; 20];
    if offset > 0 {
        file.to(offset).ok()?;
    }
    file.read_exact(&mut head).ok()?;
    let length = u64::from(u32::from_le_bytes([head[12], head[13], head[14], head[15]]));
    head.starts_with(glb::MAGIC).then_some((offset + 20, length, offset + 28 + length))
}

impl DocumentOutline {
    pub(super) fn element<'a>(&'a self, key: &str, index: &Value) -> Option<&'a Value> {
        array(&self.json, key).get(number(index)?)
    }

    /// The file of the upload that a URI in the file `model` means.
    fn file(&self, uri: &str, model: usize, files: &Files) -> Option<usize> {
        files.find(&uri::resolve(files.path(model), uri).ok()?)
    }

    /// Whether a string may have been cut.
    fn is_cut(&self) -> bool {
        let uris = ["buffers", "images"].into_iter().flat_map(|key| array(&self.json, key));
        uris.filter_map(|o| o.get("uri")?.as_str()).any(|u| u.len() + 4 > self.string)
    }

    /// What the head of each image says.
    fn images(&self, model: usize, files: &mut Files) -> Vec<Option<Header>> {
        let mut found = Vec::new();
        // By file and offset, so that each file is read once and forward: the longest view, and the images.
        let mut views: BTreeMap<BufferHolder, BTreeMap<u64, (u64, Vec<usize>)>> = BTreeMap::new();
        for (index, image) in array(&self.json, "images").iter().enumerate() {
            let place = image.get("bufferView").and_then(|view| self.view(view, model, files));
            if let Some((holder, offset)) = place {
                let (longest, images) = views.entry(holder).or_default().entry(offset).or_default();
                *longest = self.image_length(image, model, files).max(*longest);
                images.push(index);
            }
            found.push(match image.get("uri").and_then(Value::as_str) {
                Some(data) if uri::is_data(data) => data_bytes(data).and_then(|bytes| probe(&*bytes)),
                Some(uri) => self.file(uri, model, files).and_then(|f| files.known().get(f)?.image),
                None => None,
            });
        }
        for (holder, mut places) in views {
            let mut read = |file: &mut dyn Forward| {
                places.retain(|offset, (length, images)| {
                    if file.to(*offset).is_err() {
                        return true;
                    }
                    let header = probe(Read::take(&mut *file, *length));
                    images.iter().for_each(|image| found[*image] = header);
                    false
                });
                places.is_empty()
            };
            // Once, unless images lie in each other and the file is a stream.
            for _ in 0..MOST_ROUNDS {
                let done = match holder {
                    BufferHolder::File(index) => files.open(index, &mut read),
                    BufferHolder::Data(buffer) => {
                        let uri = array(&self.json, "buffers").get(buffer).and_then(|b| b.get("uri")?.as_str());
                        uri.and_then(data_bytes).map(|bytes| read(&mut Stream::new(&*bytes)))
                    }
                };
                if done.unwrap_or(true) {
                    break;
                }
            }
        }
        found
    }

    /// What holds a buffer view, and where it begins there.
    pub(super) fn view(&self, view: &Value, model: usize, files: &Files) -> Option<(BufferHolder, u64)> {
        let view = self.element("bufferViews", view)?;
        let offset = view.get("byteOffset").and_then(whole).unwrap_or(0);
        let index = view.get("buffer")?;
        let buffer = self.element("buffers", index)?;
        Some(match buffer.get("uri").and_then(Value::as_str) {
            None => (BufferHolder::File(model), self.bin.checked_add(offset)?),
            Some(data) if uri::is_data(data) => (BufferHolder::Data(number(index)?), offset),
            Some(uri) => (BufferHolder::File(self.file(uri, model, files)?), offset),
        })
    }

    /// Bytes of an image's file.
    fn image_length(&self, image: &Value, model: usize, files: &Files) -> u64 {
        let view = || self.element("bufferViews", image.get("bufferView")?)?.get("byteLength").and_then(whole);
        match image.get("uri").and_then(Value::as_str) {
            // The text itself is a part of the model's file, and no shorter.
            Some(data) if uri::is_data(data) => data.len() as u64 / 4 * 3,
            Some(uri) => self.file(uri, model, files).and_then(|f| files.known().get(f)).map_or(0, |f| f.length),
            None => view().unwrap_or(0),
        }
    }

    /// Buffers, triangles and vertices.
    fn geometry(&self, model: usize, files: &Files, sum: &mut Sum) {
        for buffer in array(&self.json, "buffers") {
            let declared = buffer.get("byteLength").and_then(whole).unwrap_or(0);
            let there = match buffer.get("uri").and_then(Value::as_str) {
                Some(uri) if !uri::is_data(uri) => self.file(uri, model, files),
                _ => Some(model),
            };
            let there = there.and_then(|f| files.known().get(f)).map_or(0, |f| f.length);
            sum.buffers += declared.min(there);
        }
        for view in array(&self.json, "bufferViews") {
            // Buffer views that grow when they are decoded.
            if view.get("extensions").is_some_and(|e| MESHOPT.iter().any(|name| e.get(name).is_some())) {
                sum.buffers += view.get("byteLength").and_then(whole).unwrap_or(0);
            }
        }
        let primitives = || array(&self.json, "meshes").iter().flat_map(|m| array(m, "primitives"));
        primitives().for_each(|p| sum.triangles += declared_triangles(&self.json, p));
        sum.has_layout |= primitives().any(|p| {
            let attributes = p.get("attributes").and_then(Value::as_object);
            attributes.is_some_and(|a| a.keys().any(|name| name.starts_with(TEXCOORD)))
        });
        let positions: BTreeSet<u64> =
            primitives().filter_map(|p| p.get("attributes")?.get("POSITION")?.as_u64()).collect();
        let counts =
            positions.iter().filter_map(|p| self.element("accessors", &Value::from(*p))?.get("count")?.as_u64());
        sum.vertices += counts.fold(0, u64::saturating_add);
    }
}

/// What holds the bytes of a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum BufferHolder {
    /// A file of the upload.
    File(usize),
    /// The data URI of a buffer.
    Data(usize),
}

/// The bytes of a data URI, perhaps one that was cut.
fn data_bytes(data: &str) -> Option<Cow<'_, [u8]>> {
    let comma = data.find(',')? + 1;
    let whole = data.len() - (data.len() - comma) % 4;
    let cut = |end: usize| uri::parse_data(data.get(..end)?).ok().map(Cow::Owned);
    cut(data.len()).or_else(|| cut(whole))
}
