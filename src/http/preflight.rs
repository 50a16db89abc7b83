//! The cheap checks that a model passes before its job is accepted: container, lengths, JSON syntax. They read the file
//! from the disk and hold none of it in memory; everything else is for the job to find.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

use crate::asset::{TileHeader, check_entries, foreign, is_model_name, is_tile};
use crate::error::{Code, Failure, Result};
use crate::jobs::files::disk;

/// Checks an uploaded model and says what it is: `glb`, `gltf`, `obj`, `b3dm`, `i3dm` or `zip`.
///
/// # Errors
/// `invalid_model` with what is broken, `too_large` for JSON over `max_json` bytes, `unsupported_media_type` for what is
/// no model, `internal` when the disk fails.
pub(super) fn check(path: &Path, name: &str, max_json: u64) -> Result<&'static str> {
    let failed = |e: std::io::Error| disk(path, &e);
    let mut file = File::open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    if length == 0 {
        return Err(Failure::model("the model is empty"));
    }
    let mut head = Vec::new();
    (&mut file).take(64).read_to_end(&mut head).map_err(failed)?;
    let extension = name.rsplit_once('.').map(|(_, e)| e.to_ascii_lowercase()).unwrap_or_default();
    let text = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&head);
    let first = text.iter().find(|b| !b.is_ascii_whitespace());
    if head.starts_with(b"glTF") {
        glb(&mut file, 0, length, max_json)?;
        Ok("glb")
    } else if is_tile(&head) {
        let tile = TileHeader::read(&head, length)?;
        glb(&mut file, tile.glb(), tile.length, max_json)?;
        Ok(tile.kind.extension())
    } else if head.starts_with(b"PK\x03\x04") || head.starts_with(b"PK\x05\x06") {
        file.rewind().map_err(failed)?;
        check_entries(name, &file)?;
        zip(file)?;
        Ok("zip")
    } else if extension == "obj" {
        Ok("obj")
    } else if first == Some(&b'{') {
        file.seek(SeekFrom::Start((head.len() - text.len()) as u64)).map_err(failed)?;
        json(&mut file, length, max_json)?;
        Ok("gltf")
    } else {
        match extension.as_str() {
            "glb" => Err(Failure::model("the model is called .glb but does not start with the magic `glTF`")),
            "gltf" => Err(Failure::model("the model is called .gltf but is not a JSON object")),
            "zip" => Err(Failure::model("the model is called .zip but is not an archive")),
            _ => {
                let what = foreign(name, &head).map(|what| format!("; it is {what}")).unwrap_or_default();
                let text =
                    format!("the model is neither GLB, glTF, OBJ, a 3D tile (.b3dm, .i3dm) nor a zip of one{what}");
                Err(Failure::new(Code::UnsupportedMediaType, text))
            }
        }
    }
}

/// Header and first chunk of the GLB (glTF 2.0, 4.4) between two places of a file.
fn glb(file: &mut File, start: u64, end: u64, max_json: u64) -> Result<()> {
    let failed = |e: std::io::Error| Failure::internal(e.kind().to_string());
    let length = end.saturating_sub(start);
    let mut head = Vec::new();
    file.seek(SeekFrom::Start(start)).map_err(failed)?;
    (&mut *file).take(length.min(20)).read_to_end(&mut head).map_err(failed)?;
    if !head.starts_with(b"glTF") {
        return Err(Failure::model("the tile holds no GLB: the magic `glTF` is not behind its tables"));
    }
    let word = |at: usize| {
        let bytes = head.get(at..at + 4).and_then(|b| b.try_into().ok());
        bytes
            .map(u32::from_le_bytes)
            .ok_or_else(|| Failure::model(format!("the GLB ends after {length} bytes, in its header")))
    };
    let (version, declared, chunk, kind) = (word(4)?, u64::from(word(8)?), u64::from(word(12)?), word(16)?);
    if version != 2 {
        return Err(Failure::model(format!("the GLB has version {version}; version 2 is read")));
    }
    if declared > length {
        return Err(Failure::model(format!("the GLB declares {declared} bytes and has {length}: it is truncated")));
    }
    if kind != u32::from_le_bytes(*b"JSON") {
        return Err(Failure::model("the first chunk of the GLB is not JSON"));
    }
    if chunk.saturating_add(20) > declared {
        return Err(Failure::model(format!("the JSON chunk of the GLB declares {chunk} bytes, more than there are")));
    }
    file.seek(SeekFrom::Start(start + 20)).map_err(failed)?;
    json(file, chunk, max_json)
}

/// One JSON object of `length` bytes, and nothing after it.
fn json(file: &mut File, length: u64, max_json: u64) -> Result<()> {
    if length > max_json {
        return Err(Failure::new(
            Code::TooLarge,
            format!("the JSON of the model has {length} bytes; the limit is {max_json}"),
        ));
    }
    let broken = |e: &dyn std::fmt::Display| Failure::model(format!("the model's JSON is broken: {e}"));
    let mut reader = BufReader::with_capacity(1 << 16, file.take(length));
    if reader.fill_buf().is_ok_and(|head| head.starts_with(b"\xef\xbb\xbf")) {
        reader.consume(3);
    }
    let mut stream = serde_json::Deserializer::from_reader(&mut reader).into_iter::<Walked>();
    stream.next().transpose().map_err(|e| broken(&e))?.ok_or_else(|| broken(&"there is nothing"))?;
    drop(stream);
    // Some writers pad with zeros instead of blanks.
    let rest = reader.bytes().find(|b| b.as_ref().map_or(true, |b| *b != 0 && !b.is_ascii_whitespace()));
    rest.map_or(Ok(()), |_| Err(broken(&"something follows the JSON object")))
}

/// Levels of a JSON document, as `serde_json` reads it.
pub(super) const MAX_JSON_NESTING: u32 = 127;

/// A JSON value of which nothing is kept, read level by level: that a document is nested too deeply shows as it will show in the job.
struct Walked;

impl<'de> Deserialize<'de> for Walked {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        deserializer.deserialize_any(Walked)
    }
}

impl<'de> Visitor<'de> for Walked {
    type Value = Walked;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("any JSON value")
    }

    fn visit_bool<E>(self, _: bool) -> std::result::Result<Walked, E> {
        Ok(Walked)
    }

    fn visit_i64<E>(self, _: i64) -> std::result::Result<Walked, E> {
        Ok(Walked)
    }

    fn visit_u64<E>(self, _: u64) -> std::result::Result<Walked, E> {
        Ok(Walked)
    }

    fn visit_f64<E>(self, _: f64) -> std::result::Result<Walked, E> {
        Ok(Walked)
    }

    fn visit_str<E>(self, _: &str) -> std::result::Result<Walked, E> {
        Ok(Walked)
    }

    fn visit_unit<E>(self) -> std::result::Result<Walked, E> {
        Ok(Walked)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> std::result::Result<Walked, A::Error> {
        while list.next_element::<Walked>()?.is_some() {}
        Ok(Walked)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> std::result::Result<Walked, A::Error> {
        while object.next_entry::<IgnoredAny, Walked>()?.is_some() {}
        Ok(Walked)
    }
}

/// An archive whose directory can be read and names a model.
fn zip(file: File) -> Result<()> {
    let archive = zip::ZipArchive::new(BufReader::new(file));
    let archive = archive.map_err(|e| Failure::model(format!("the zip is broken: {e}")))?;
    if archive.file_names().any(|name| name.is_ok_and(|name| is_model_name(&name))) {
        Ok(())
    } else {
        Err(Failure::model("the zip holds no .glb, .gltf, .obj, .b3dm or .i3dm"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(bytes: &[u8], name: &str) -> Result<&'static str> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        check(file.path(), name, 1000)
    }

    fn glb_of(json: &[u8]) -> Vec<u8> {
        let mut out = b"glTF\x02\0\0\0".to_vec();
        out.extend((20 + json.len() as u32).to_le_bytes());
        out.extend((json.len() as u32).to_le_bytes());
        out.extend(b"JSON");
        out.extend(json);
        out
    }

    #[test]
    fn sound_models_pass_and_their_format_is_found() {
        for json in [&b"{\"asset\":{}} "[..], b"{\"asset\":{}}\0\0\0", b"\xef\xbb\xbf{\"asset\":{}}"] {
            assert_eq!(checked(&glb_of(json), "model"), Ok("glb"), "{json:?}");
        }
        assert_eq!(checked(b"\xef\xbb\xbf {\"a\": 1}", "m.gltf"), Ok("gltf"));
        assert_eq!(checked(b"# cube\nv 0 0 0\n", "m.OBJ"), Ok("obj"));
    }

    #[test]
    fn broken_models_are_refused_with_what_is_broken() {
        let whole = glb_of(b"{\"asset\":{}} ");
        let mut version = whole.clone();
        version[4] = 1;
        let mut chunk = whole.clone();
        chunk[12] = 200;
        for (bytes, name, code, part) in [
            (&b""[..], "m.glb", Code::InvalidModel, "empty"),
            (&whole[..10], "m.glb", Code::InvalidModel, "in its header"),
            (&whole[..25], "m.glb", Code::InvalidModel, "truncated"),
            (&version, "m.glb", Code::InvalidModel, "version 1"),
            (&chunk, "m.glb", Code::InvalidModel, "more than there are"),
            (&glb_of(b"{\"asset\":"), "m.glb", Code::InvalidModel, "JSON is broken"),
            (&glb_of(b"{} {}"), "m.glb", Code::InvalidModel, "JSON is broken"),
            (
                &glb_of(format!("{{\"a\":{}{}}}", "[".repeat(200), "]".repeat(200)).as_bytes()),
                "m.glb",
                Code::InvalidModel,
                "recursion limit",
            ),
            (b"{\"a\": 1", "m.gltf", Code::InvalidModel, "JSON is broken"),
            (b"hello", "m.gltf", Code::InvalidModel, "not a JSON object"),
            (b"hello", "m.glb", Code::InvalidModel, "magic"),
            (b"hello", "m.txt", Code::UnsupportedMediaType, "neither"),
            (b"PK\x03\x04 no", "m.zip", Code::InvalidModel, "zip is broken"),
            (&glb_of(&[b' '; 2000]), "m.glb", Code::TooLarge, "2000 bytes"),
        ] {
            let failure = checked(bytes, name).unwrap_err();
            assert_eq!(failure.code, code, "{failure}");
            assert!(failure.message.contains(part), "{failure}");
        }
    }
}
