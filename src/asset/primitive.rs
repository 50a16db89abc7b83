//! What a primitive's JSON says by itself.

use serde_json::Value;

use super::json::array;

/// JSON pointer of a primitive.
pub(crate) fn primitive_pointer(mesh: usize, primitive: usize) -> String {
    format!("/meshes/{mesh}/primitives/{primitive}")
}

/// The triangles that the primitives of a mesh declare.
pub(crate) fn declared_triangles(json: &Value, mesh: &Value) -> u64 {
    let count = |accessor: &Value| {
        let index = usize::try_from(accessor.as_u64()?).ok()?;
        json.get("accessors")?.get(index)?.get("count")?.as_u64()
    };
    let primitives = array(mesh, "primitives").iter().map(|primitive| {
        let position = || primitive.get("attributes")?.get("POSITION");
        let corners = primitive.get("indices").or_else(position).and_then(count).unwrap_or(0);
        match primitive.get("mode").map_or(Some(4), Value::as_u64) {
            Some(4) => corners / 3,
            Some(5 | 6) => corners.saturating_sub(2),
            _ => 0,
        }
    });
    primitives.fold(0, u64::saturating_add)
}
