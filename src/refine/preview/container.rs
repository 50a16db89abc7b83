//! The file: eight bytes that name it, a header in JSON, and sections that the header names.

use serde_json::{Value, json};

use crate::error::Result;
use crate::texture::zlib;

/// First bytes of the file.
pub(super) const MAGIC: &[u8; 4] = b"INTP";
/// Version of the layout.
pub(super) const VERSION: u32 = 1;
/// Level of zlib: most of what can be won for little time.
const LEVEL: i32 = 5;

/// What stands behind the header.
#[derive(Default)]
pub(super) struct Sections {
    bytes: Vec<u8>,
}

impl Sections {
    /// Adds bytes as they are; gives where they stand.
    pub fn raw(&mut self, bytes: &[u8]) -> Value {
        let offset = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        json!({ "offset": offset, "bytes": bytes.len() })
    }

    /// Adds numbers of `width` components each: differences to the number before, zigzag, the four bytes of all apart, zlib.
    pub fn numbers(&mut self, values: &[u32], width: usize) -> Result<Value> {
        let n = values.len();
        let mut planes = vec![0u8; 4 * n];
        for (i, value) in values.iter().enumerate() {
            let before = i.checked_sub(width).map_or(0, |i| values[i]);
            let difference = value.wrapping_sub(before);
            let zigzag = (difference << 1) ^ (((difference as i32) >> 31) as u32);
            for (k, byte) in zigzag.to_le_bytes().into_iter().enumerate() {
                planes[k * n + i] = byte;
            }
        }
        self.compressed(&planes, n, width)
    }

    /// Adds bytes, zlib.
    pub fn octets(&mut self, values: &[u8]) -> Result<Value> {
        self.compressed(values, values.len(), 1)
    }

    fn compressed(&mut self, bytes: &[u8], count: usize, width: usize) -> Result<Value> {
        let mut section = self.raw(&zlib(bytes, LEVEL)?);
        section["count"] = json!(count);
        section["width"] = json!(width);
        Ok(section)
    }

    /// The whole file.
    pub fn file(self, header: &Value) -> serde_json::Result<Vec<u8>> {
        let mut text = serde_json::to_vec(header)?;
        // Sections begin at a multiple of four.
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut file = Vec::with_capacity(12 + text.len() + self.bytes.len());
        file.extend_from_slice(MAGIC);
        file.extend_from_slice(&VERSION.to_le_bytes());
        file.extend_from_slice(&(text.len() as u32).to_le_bytes());
        file.extend(text);
        file.extend(self.bytes);
        Ok(file)
    }
}
