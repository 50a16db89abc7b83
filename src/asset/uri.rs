//! URIs and paths that a model names: decoded, made relative and kept inside the upload.

use std::borrow::Cow;
use std::ffi::OsStr;
use std::path::Path;

use super::name::readable;
use base64::Engine;
use base64::alphabet;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};

/// Base64 as data URIs carry it; padding may be missing.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &alphabet::STANDARD,
    GeneralPurposeConfig::new()
        .with_decode_padding_mode(DecodePaddingMode::Indifferent)
        .with_decode_allow_trailing_bits(true),
);

/// What a relative URI may not hold as it is.
pub(crate) const RESERVED: percent_encoding::AsciiSet = percent_encoding::CONTROLS
    .add(b' ')
    .add(b'"')
    .add(b'#')
    .add(b'%')
    .add(b'<')
    .add(b'>')
    .add(b'?')
    .add(b':')
    .add(b'\\');

/// Whether a URI carries its data.
pub(crate) fn is_data(uri: &str) -> bool {
    uri.get(..5).is_some_and(|s| s.eq_ignore_ascii_case("data:"))
}

/// Decodes a data URI (RFC 2397): base64, or percent-encoded without it.
///
/// # Errors
/// A sentence that says what is wrong.
pub(crate) fn parse_data(uri: &str) -> Result<Vec<u8>, String> {
    let rest = uri.get(5..).filter(|_| is_data(uri)).ok_or("this is not a data URI")?;
    let (head, body) = rest.split_once(',').ok_or("the data URI has no comma before its data")?;
    let bytes = Cow::from(percent_encoding::percent_decode_str(body));
    if !head.split(';').skip(1).any(|p| p.trim().eq_ignore_ascii_case("base64")) {
        return Ok(bytes.into_owned());
    }
    BASE64.decode(bytes).map_err(|e| format!("the base64 of the data URI is broken: {e}"))
}

/// The path of a percent-encoded relative URI, from the folder of the model.
///
/// # Errors
/// A sentence, when the URI has a scheme, is absolute, or leaves the folder of the upload.
pub(crate) fn resolve(model_path: &str, uri: &str) -> Result<String, String> {
    let decoded = percent_encoding::percent_decode_str(uri)
        .decode_utf8()
        .map_err(|_| format!("{} is not UTF-8 once decoded", quote(uri)))?;
    if has_scheme(&decoded) {
        return Err(format!("{} is not a relative path, and nothing is fetched from elsewhere", quote(uri)));
    }
    join(model_path, &decoded).ok_or_else(|| format!("{} leaves the folder of the upload", quote(uri)))
}

/// The path `relative` seen from the folder that holds `model_path`; none when it is absolute, empty or escapes.
pub(crate) fn join(model_path: &str, relative: &str) -> Option<String> {
    let folder = model_path.rfind('/').and_then(|end| model_path.get(..end)).unwrap_or_default();
    if relative.starts_with(['/', '\\']) {
        return None;
    }
    normalise(&format!("{folder}/{relative}"))
}

/// A relative path with forward slashes, without `.`, `..`, empty parts, drive letters and control characters;
/// none when nothing is left or when it would leave its root.
pub(crate) fn normalise(path: &str) -> Option<String> {
    if path.chars().any(char::is_control) {
        return None;
    }
    let mut parts: Vec<&str> = Vec::new();
    for part in path.split(['/', '\\']) {
        match part {
            "" | "." => {}
            ".." => {
                parts.pop()?;
            }
            part if part.len() == 2 && part.ends_with(':') => return None,
            part => parts.push(part),
        }
    }
    (!parts.is_empty()).then(|| parts.join("/"))
}

/// The last part of a path, whichever slashes it has.
pub(crate) fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\']).next().unwrap_or(path)
}

/// The last part of a path without its extension.
pub(crate) fn stem(path: &str) -> &str {
    Path::new(file_name(path)).file_stem().and_then(OsStr::to_str).unwrap_or_default()
}

/// The extension of a path in lower case, without its dot; empty where there is none.
pub(crate) fn extension(path: &str) -> String {
    let name = file_name(path);
    name.rfind('.').and_then(|dot| name.get(dot + 1..)).unwrap_or_default().to_ascii_lowercase()
}

/// A name from outside, short enough for a sentence.
pub(crate) fn quote(name: &str) -> String {
    let name = &*readable(name);
    let mut short: String = name.chars().take(80).collect();
    if short.len() < name.len() {
        short.push('…');
    }
    format!("{short:?}")
}

/// `scheme:` of two letters and more; a single letter is a drive and refused by `normalise`.
fn has_scheme(text: &str) -> bool {
    let Some((scheme, _)) = text.split_once(':') else { return text.starts_with("//") };
    let mut letters = scheme.chars();
    letters.next().is_some_and(|c| c.is_ascii_alphabetic())
        && letters.all(|c| c.is_ascii_alphanumeric() || matches!(c, '+' | '-' | '.'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_uris_stay_inside() {
        assert_eq!(resolve("a/model.gltf", "t%20x/c.png").unwrap(), "a/t x/c.png");
        assert_eq!(resolve("a/model.gltf", "../c.png").unwrap(), "c.png");
        assert_eq!(resolve("model.gltf", "./x/../c.png").unwrap(), "c.png");
        for bad in ["../c.png", "%2e%2e/c.png", "/etc/passwd", "http://x/c.png", "file:c.png", "C:\\c.png", "", "%ff"] {
            assert!(resolve("model.gltf", bad).is_err(), "{bad}");
        }
        assert!(resolve("model.gltf", "..\\c.png").is_err());
        assert!(resolve("model.gltf", "a\0.png").is_err());
    }

    #[test]
    fn data_uris() {
        let found = parse_data("data:application/octet-stream;base64,AQID").unwrap();
        assert_eq!(found, [1, 2, 3]);
        assert_eq!(parse_data("DATA:;base64,AQ").unwrap(), [1]);
        assert_eq!(parse_data("data:text/plain,a%20b").unwrap(), b"a b");
        assert!(parse_data("data:;base64,A*").is_err());
        assert!(parse_data("data:;base64").is_err());
    }

    #[test]
    fn names() {
        assert_eq!(stem("a/b.c.glb"), "b.c");
        assert_eq!(stem(".glb"), ".glb");
        assert_eq!(extension("a.b/C.GLB"), "glb");
        assert_eq!(extension("a.b/c"), "");
    }
}
