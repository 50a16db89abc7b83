//! Dropping bytes that no buffer view names any more.

use serde_json::Value;

use crate::asset::Document;
use crate::asset::accessor_layout::view;
use crate::asset::extensions::all_understood;
use crate::asset::json::array;

/// Leaves of a buffer what buffer views name, in the same order and on the same 16-byte boundaries. Does nothing where
/// an extension might name bytes unseen, or a view is broken, which others tell.
pub(super) fn squeeze(document: &mut Document, buffer: usize) {
    let Some(bytes) = document.buffers.get(buffer) else { return };
    let mut used = Vec::new();
    for index in 0..array(&document.json, "bufferViews").len() {
        let Ok(view) = view(&document.json, index) else { return };
        if view.buffer == buffer {
            let Some(end) = view.offset.checked_add(view.length).filter(|end| *end <= bytes.len()) else { return };
            used.push((view.offset, end, index));
        }
    }
    if !all_understood(&document.json) {
        return;
    }
    used.sort_unstable();
    let mut left: Vec<u8> = Vec::new();
    // The run of overlapping views that was copied last: its end, and how far it moved.
    let (mut copied, mut shift) = (0, 0);
    for (start, end, index) in used {
        if start > copied || left.is_empty() {
            // Bytes only move towards the beginning.
            let at = left.len() + (start - left.len()) % 16;
            left.resize(at, 0);
            (copied, shift) = (start, start - at);
        }
        if end > copied {
            left.extend_from_slice(&bytes[copied..end]);
            copied = end;
        }
        document.json["bufferViews"][index]["byteOffset"] = Value::from(start - shift);
    }
    document.json["buffers"][buffer]["byteLength"] = Value::from(left.len());
    document.buffers[buffer] = left;
}
