//! `extensionsUsed` and `extensionsRequired` of a document whose textures changed.

use serde_json::Value;

use crate::asset::extensions;
use crate::asset::json::{array, array_mut, object};

/// Declares what is used now, and no longer what refining took out. What was declared without being used stays so.
pub(super) fn declare(before: &Value, after: &mut Value) {
    for name in extensions::all().filter(|e| e.written).map(|e| e.name) {
        let (old, new) = (is_used(before, name), is_used(after, name));
        if old && !new {
            for key in ["extensionsUsed", "extensionsRequired"] {
                remove(after, key, name);
            }
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

/// Whether an `extensions` object outside `extras` has the name.
fn is_used(json: &Value, name: &str) -> bool {
    let mut stack = vec![json];
    while let Some(value) = stack.pop() {
        match value {
            Value::Array(items) => stack.extend(items),
            Value::Object(map) => {
                if object(value, "extensions").is_some_and(|e| e.contains_key(name)) {
                    return true;
                }
                stack.extend(map.iter().filter(|(key, _)| *key != "extras").map(|(_, child)| child));
            }
            _ => {}
        }
    }
    false
}

fn remove(json: &mut Value, key: &str, name: &str) {
    let Some(names) = json.get_mut(key).and_then(Value::as_array_mut) else { return };
    names.retain(|n| n.as_str() != Some(name));
    if names.is_empty()
        && let Some(root) = json.as_object_mut()
    {
        root.shift_remove(key);
    }
}

fn add(json: &mut Value, key: &str, name: &str) {
    if let Ok(names) = array_mut(json, key)
        && !names.iter().any(|n| n.as_str() == Some(name))
    {
        names.push(Value::from(name));
    }
}
