//! `extensionsUsed` and `extensionsRequired` of a document whose textures changed.

use serde_json::Value;

use crate::asset::extensions::{self, OnPrimitive};
use crate::asset::json::{array, array_mut, object, object_mut};
use crate::context::Context;
use crate::error::{Result, Warning};

/// Declares what is used now, and no longer what refining took out. What was declared without being used stays so.
pub(super) fn declare(before: &Value, after: &mut Value) {
    for name in extensions::all().filter(|e| e.written).map(|e| e.name) {
        let is_used = |json: &Value| extensions::used(json).iter().any(|e| e.get(name).is_some());
        let new = is_used(after);
        if is_used(before) && !new {
            extensions::undeclare(after, name);
        } else if new {
            add(after, "extensionsUsed", name);
            // Without a core source there is no texture for a reader that does not know the extension.
            let needed = array(after, "textures")
                .iter()
                .any(|t| object(t, "extensions").is_some_and(|e| e.contains_key(name)) && t.get("source").is_none());
            if needed {
                add(after, "extensionsRequired", name);
            }
        }
    }
}

/// Takes extensions from a primitive that were made for other triangles than it has now, and says so.
///
/// # Errors
/// `internal` where there is no such primitive.
pub(super) fn drop_of_triangles(json: &mut Value, pointer: &str, context: &Context) -> Result<()> {
    let primitive = object_mut(json, pointer)?;
    let all = primitive.get("extensions").and_then(Value::as_object).into_iter().flatten();
    let stale = |(name, own): (&String, &Value)| {
        (extensions::on_primitive(name, own) == OnPrimitive::OfTriangles).then(|| name.clone())
    };
    let stale: Vec<String> = all.filter_map(stale).collect();
    extensions::retain(primitive, |name| !stale.iter().any(|s| s == name));
    for name in stale {
        let text = format!("the extension {name} is left out: it was made for triangles that are divided now");
        context.warn(Warning::new("extension_dropped", text).at(pointer.to_owned()));
        if !extensions::used(json).iter().any(|e| e.get(&name).is_some()) {
            extensions::undeclare(json, &name);
        }
    }
    Ok(())
}

fn add(json: &mut Value, key: &str, name: &str) {
    if let Ok(names) = array_mut(json, key)
        && !names.iter().any(|n| n.as_str() == Some(name))
    {
        names.push(Value::from(name));
    }
}
