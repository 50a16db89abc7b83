//! The few values of a glTF JSON that tell what it needs, read from a stream: whatever else it holds is passed over.

use std::cell::Cell;
use std::fmt;
use std::io::{BufRead, BufReader, Read};

use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};

use super::super::extensions::MESHOPT;
use super::document::TEXCOORD;

/// Keys of objects that are kept, wherever they stand.
const KEYS: [&str; 23] = [
    "accessors",
    "attributes",
    "buffer",
    "bufferView",
    "bufferViews",
    "buffers",
    "byteLength",
    "byteOffset",
    "byteStride",
    "componentType",
    "count",
    "extensions",
    "extensionsUsed",
    "images",
    "indices",
    "meshes",
    "mode",
    "POSITION",
    "primitives",
    "sparse",
    "uri",
    MESHOPT[0],
    MESHOPT[1],
];
/// Values that are kept at most, some 100 bytes each; the rest of a larger document counts by its length alone.
const MOST_VALUES: usize = 2_000_000;

/// Reads a document of at most `most` bytes; strings are cut after `string` bytes. None where it is broken.
pub(super) fn read(file: impl Read, most: u64, string: usize) -> Option<Value> {
    let mut file = BufReader::with_capacity(1 << 16, file.take(most));
    if file.fill_buf().ok()?.starts_with(b"\xef\xbb\xbf") {
        file.consume(3);
    }
    let left = Cell::new(MOST_VALUES);
    let mut json = serde_json::Deserializer::from_reader(file);
    Kept { left: &left, string }.deserialize(&mut json).ok()
}

/// Keeps what is known.
#[derive(Clone, Copy)]
struct Kept<'a> {
    left: &'a Cell<usize>,
    string: usize,
}

impl<'de> DeserializeSeed<'de> for Kept<'_> {
    type Value = Value;
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        match self.left.get().checked_sub(1) {
            Some(left) => {
                self.left.set(left);
                deserializer.deserialize_any(self)
            }
            None => deserializer.deserialize_ignored_any(IgnoredAny).map(|_| Value::Null),
        }
    }
}

impl<'de> Visitor<'de> for Kept<'_> {
    type Value = Value;
    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("JSON")
    }
    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }
    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(Value::from(value))
    }
    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(Value::from(value))
    }
    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(Value::from(value))
    }
    fn visit_str<E>(self, value: &str) -> Result<Value, E> {
        Ok(Value::from(value.get(..value.floor_char_boundary(self.string)).unwrap_or_default()))
    }
    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let mut kept = Vec::new();
        while let Some(item) = items.next_element_seed(self)? {
            // Past the limit there is nothing to say of the items but that they are read.
            if self.left.get() > 0 {
                kept.push(item);
            }
        }
        Ok(Value::Array(kept))
    }
    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let mut kept = Map::new();
        while let Some(key) = entries.next_key::<String>()? {
            if KEYS.contains(&key.as_str()) || key.starts_with(TEXCOORD) {
                kept.insert(key, entries.next_value_seed(self)?);
            } else {
                entries.next_value::<IgnoredAny>()?;
            }
        }
        Ok(Value::Object(kept))
    }
}
