//! What an upload may cost.

/// Limits on the input, checked before anything large is allocated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
