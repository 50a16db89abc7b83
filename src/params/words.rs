//! Words and pointers for messages about options.

use serde_json::Value;

/// Fewest letters that a name shares with one that it begins or ends.
const SHARED_LETTERS: usize = 3;

/// The nearest of `known`, if it is near enough to be what was meant: at most a third of its letters were typed wrong, or one is the
/// beginning or the end of the other.
pub fn nearest<'a>(wanted: &str, known: &[&'a str]) -> Option<&'a str> {
    let wanted = short(wanted).to_lowercase();
    let distance = |k: &&'a str| {
        let known = k.to_lowercase();
        let typed = strsim::damerau_levenshtein(&wanted, &known);
        let (least, most) =
            (wanted.chars().count().min(known.chars().count()), wanted.chars().count().max(known.chars().count()));
        let affix = |a: &str, b: &str| a.starts_with(b) || a.ends_with(b);
        let is_part = least >= SHARED_LETTERS && (affix(&wanted, &known) || affix(&known, &wanted));
        (typed <= most / 3 || is_part).then_some((typed, *k))
    };
    // The first of the nearest.
    known.iter().filter_map(distance).reduce(|a, b| if b.0 < a.0 { b } else { a }).map(|(_, k)| k)
}

/// Says what was meant: the nearest of `known` where one is near, else all that there are.
pub fn near_or_all(wanted: &str, known: &[&str]) -> String {
    match nearest(wanted, known) {
        Some(near) => format!("did you mean `{near}`?"),
        None => listed(known),
    }
}

/// Most names that a message lists.
const MOST_LISTED: usize = 80;

/// What there is, in words.
pub(crate) fn listed(known: &[&str]) -> String {
    let more = match known.len().saturating_sub(MOST_LISTED) {
        0 => String::new(),
        n => format!(" and {n} more"),
    };
    match known {
        [] => "there are none".to_owned(),
        _ => format!("there are: {}{more}", known.iter().take(MOST_LISTED).copied().collect::<Vec<_>>().join(", ")),
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

#[cfg(test)]
mod tests {
    use super::{near_or_all, nearest};

    #[test]
    fn a_neighbour_is_named_only_if_it_is_one() {
        let known = ["recipe", "box_cutter", "optcuts", "pack", "texture", "atlas", "min_gain", "min"];
        for (wanted, near) in [
            ("gutter", None),
            ("quality", None),
            ("xyz", None),
            ("", None),
            ("boxcutter", Some("box_cutter")),
            ("Optcut", Some("optcuts")),
            ("packing", Some("pack")),
            ("textrue", Some("texture")),
            ("minimum", Some("min")),
        ] {
            assert_eq!(nearest(wanted, &known), near, "{wanted}");
        }
        assert_eq!(near_or_all("gutter", &["pack", "atlas"]), "there are: pack, atlas");
        assert_eq!(near_or_all("a", &[]), "there are none");
    }
}
