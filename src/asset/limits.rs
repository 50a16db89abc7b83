//! What an upload may cost.

use crate::error::{Code, Failure, Result};

/// Limits on the input, checked before anything large is allocated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Limits {
    /// Bytes of all input files together, unpacked. Default 1 GiB.
    pub max_input_bytes: u64,
    /// Texels of one image. Default 16384 x 16384.
    pub max_image_pixels: u64,
    /// Triangles of all primitives together. Default 20 million.
    pub max_triangles: u64,
    /// Bytes of the glTF JSON. Default 256 MiB.
    pub max_json_bytes: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            max_input_bytes: 1 << 30,
            max_image_pixels: 16384 * 16384,
            max_triangles: 20_000_000,
            max_json_bytes: 256 << 20,
        }
    }
}

impl From<&crate::config::Limits> for Limits {
    fn from(all: &crate::config::Limits) -> Self {
        Limits {
            max_input_bytes: all.max_upload,
            max_image_pixels: all.max_image_pixels,
            max_triangles: all.max_triangles,
            max_json_bytes: all.max_json,
        }
    }
}

/// How many bytes buffers and images may still take: a file named a thousand times counts a thousand times.
pub(crate) struct Budget {
    left: u64,
}

impl Budget {
    /// What may be gathered of an input within `limits`.
    pub(crate) fn new(limits: &Limits) -> Self {
        Budget { left: limits.max_input_bytes.saturating_mul(2) }
    }

    /// Takes note of bytes before they are allocated.
    ///
    /// # Errors
    /// `too_large` at `pointer` when they are too many.
    pub(crate) fn charge(&mut self, bytes: usize, pointer: &str) -> Result<()> {
        self.left = self.left.checked_sub(bytes as u64).ok_or_else(|| {
            Failure::new(Code::TooLarge, "the buffers and images together exceed the limit on the input").at(pointer)
        })?;
        Ok(())
    }

    /// The bytes in memory of their own.
    ///
    /// # Errors
    /// As [`Self::charge`].
    pub(crate) fn take(&mut self, bytes: &[u8], pointer: &str) -> Result<Vec<u8>> {
        self.charge(bytes.len(), pointer)?;
        Ok(bytes.to_vec())
    }
}
