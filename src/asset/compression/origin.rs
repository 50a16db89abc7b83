//! How the geometry of a document came, so that it can leave in the same way.

use std::collections::BTreeMap;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::draco::Quantization;
use super::meshopt::{Filter, StreamLayout};
use crate::asset::Document;
use crate::asset::accessor::RawAccessor;
use crate::asset::json::array;

/// SHA-256 of decoded elements: whether they are still what a stream holds.
pub(super) type Hash = [u8; 32];

/// What of a document came compressed, by the indices that it has in the document.
#[derive(Debug, Clone, Default)]
pub struct Origins {
    /// Buffer views of a meshopt stream.
    pub(super) views: BTreeMap<usize, ViewOrigin>,
    /// Filter of an attribute with this name, and what stands for 1 in its octahedral coordinates.
    pub(super) filters: BTreeMap<String, (Filter, i16)>,
    /// Primitives of a Draco stream; several may have one.
    pub(super) streams: Vec<StreamOrigin>,
    /// Accessors that a Draco stream filled.
    pub(super) attributes: BTreeMap<usize, Quantization>,
    /// Accessors that others were made of.
    sources: BTreeMap<usize, usize>,
    /// Number of accessors and of buffer views once everything was decoded.
    pub(in crate::asset) decoded: Option<[usize; 2]>,
    /// Number of accessors and of buffer views of the file.
    pub(in crate::asset) uploaded: Option<[usize; 2]>,
    /// Bytes of each buffer of the file.
    pub(in crate::asset) lengths: Vec<usize>,
}

/// A buffer view that came compressed.
#[derive(Debug, Clone)]
pub(super) struct ViewOrigin {
    /// Which of the two names.
    pub(super) name: &'static str,
    pub(super) layout: StreamLayout,
    pub(super) stream: Arc<[u8]>,
    /// Where it stood: buffer, first byte, end.
    pub(super) range: [usize; 3],
    pub(super) hash: Hash,
}

/// A Draco stream and the accessors that it filled.
#[derive(Debug, Clone)]
pub(super) struct StreamOrigin {
    pub(super) stream: Arc<[u8]>,
    /// Name, accessor and number in the stream of each attribute.
    pub(super) attributes: Vec<(String, usize, u32)>,
    pub(super) indices: usize,
    /// Its buffer view, and where that stood: buffer, first byte, end.
    pub(super) view: usize,
    pub(super) range: [usize; 3],
    pub(super) hash: Hash,
}

impl Origins {
    /// Whether any geometry came compressed.
    pub(in crate::asset) fn any(&self) -> bool {
        !self.views.is_empty() || !self.streams.is_empty()
    }

    /// Notes that an accessor was made of another.
    pub(in crate::asset) fn derive(&mut self, accessor: usize, source: usize) {
        // Sources come before what is made of them: no chain has an end in itself.
        if source < accessor {
            self.sources.insert(accessor, source);
        }
    }

    fn root(&self, mut accessor: usize) -> usize {
        while let Some(source) = self.sources.get(&accessor) {
            accessor = *source;
        }
        accessor
    }

    /// How the accessor that this one goes back to lay in a Draco stream, where it did.
    pub(super) fn quantization(&self, accessor: usize) -> Option<&Quantization> {
        self.attributes.get(&self.root(accessor))
    }

    /// The buffer view of the Draco stream that filled the accessor to which this one goes back.
    pub(super) fn stream_view(&self, accessor: usize) -> Option<usize> {
        let root = self.root(accessor);
        let filled = |origin: &&StreamOrigin| origin.attributes.iter().any(|(_, own, _)| *own == root);
        self.streams.iter().find(filled).map(|origin| origin.view)
    }
}

impl Document {
    /// Number of accessors and of buffer views.
    pub(in crate::asset) fn lengths(&self) -> [usize; 2] {
        ["accessors", "bufferViews"].map(|key| array(&self.json, key).len())
    }

    /// The bytes that came with the file, as buffer, first byte and end, without the streams that others replace.
    pub(in crate::asset) fn uploaded_ranges(&self) -> Vec<(usize, usize, usize)> {
        let Origins { views, streams, lengths, .. } = &self.origins;
        let is_replaced = |view: &usize| self.compressed.as_ref().is_some_and(|c| c.views.contains_key(view));
        let of_views = views.iter().filter(|(view, _)| is_replaced(view)).map(|(_, origin)| origin.range);
        let of_streams = streams.iter().filter(|origin| is_replaced(&origin.view)).map(|origin| origin.range);
        let mut gone: Vec<[usize; 3]> = of_views.chain(of_streams).collect();
        gone.sort_unstable();
        let mut left = Vec::new();
        for (buffer, length) in lengths.iter().enumerate() {
            let mut start = 0;
            for [_, from, to] in gone.iter().filter(|range| range[0] == buffer) {
                if *from > start {
                    left.push((buffer, start, *from));
                }
                start = start.max(*to);
            }
            if *length > start {
                left.push((buffer, start, *length));
            }
        }
        left
    }
}

/// The hash of elements that stand together.
pub(super) fn hash<'a>(parts: impl Iterator<Item = &'a RawAccessor>) -> Hash {
    let mut hasher = Sha256::new();
    for part in parts {
        hasher
            .update([part.component_type.as_gl_enum().to_le_bytes(), (part.count as u32).to_le_bytes()].as_flattened());
        hasher.update(&part.data);
    }
    hasher.finalize().into()
}

/// The hash of the bytes of a buffer view.
pub(super) fn hash_of_bytes(bytes: &[u8]) -> Hash {
    Sha256::digest(bytes).into()
}
