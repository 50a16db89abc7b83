//! `extensionsUsed` and `extensionsRequired` of a document whose textures changed.

use serde_json::Value;

use crate::asset::extensions;
use crate::asset::json::{array, array_mut, object};

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

fn add(json: &mut Value, key: &str, name: &str) {
    if let Ok(names) = array_mut(json, key)
        && !names.iter().any(|n| n.as_str() == Some(name))
    {
        names.push(Value::from(name));
    }
}
