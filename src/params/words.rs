//! Words and pointers for messages about options.

use serde_json::Value;

/// The nearest of `known`, if it is near enough to be what was meant.
pub fn nearest<'a>(wanted: &str, known: &[&'a str]) -> Option<&'a str> {
    let wanted = short(wanted);
    let score = |k: &str| strsim::jaro_winkler(&wanted, k);
    known.iter().copied().max_by(|a, b| score(a).total_cmp(&score(b))).filter(|k| score(k) >= 0.75)
}

/// Says what was meant: the nearest of `known` where one is near, else all that there are.
pub(crate) fn near_or_all(wanted: &str, known: &[&str]) -> String {
    match nearest(wanted, known) {
        Some(near) => format!("did you mean `{near}`?"),
        None => format!("known here: {}", known.join(", ")),
    }
}

/// The JSON pointer of a key under `pointer` (RFC 6901).
pub(crate) fn child(pointer: &str, key: &str) -> String {
    format!("{pointer}/{}", short(key).replace('~', "~0").replace('/', "~1"))
}

/// The last key of a pointer.
pub(crate) fn name(pointer: &str) -> String {
    let last = pointer.rsplit('/').next().unwrap_or_default();
    last.replace("~1", "/").replace("~0", "~")
}

/// What a value is, in words.
pub(crate) fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "a boolean",
        Value::Number(_) => "a number",
        Value::String(_) => "a string",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}

/// Text from outside, cut to a length fit for a message.
pub(crate) fn short(text: &str) -> String {
    const MOST: usize = 200;
    match text.char_indices().nth(MOST) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}
