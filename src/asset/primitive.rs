//! What a primitive's JSON says by itself.

use serde_json::Value;

use super::json::{number, whole};

/// JSON pointer of a primitive.
pub(crate) fn primitive_pointer(mesh: usize, primitive: usize) -> String {
    format!("/meshes/{mesh}/primitives/{primitive}")
}

/// The triangles that a primitive declares.
pub(crate) fn declared_triangles(json: &Value, primitive: &Value) -> u64 {
    let count = |accessor: &Value| json.get("accessors")?.get(number(accessor)?)?.get("count").and_then(whole);
    let position = || primitive.get("attributes")?.get("POSITION");
    let corners = primitive.get("indices").or_else(position).and_then(count).unwrap_or(0);
    match primitive.get("mode").map_or(Some(4), Value::as_u64) {
        Some(4) => corners / 3,
        Some(5 | 6) => corners.saturating_sub(2),
        _ => 0,
    }
}
