//! The streams of EXT_meshopt_compression and KHR_meshopt_compression, after the bitstream appendix of the latter.
//!
//! Our own reader, because it is short, needs no C++ and cannot leave its slices: what a stream can become is bounded
//! by its length ([`StreamLayout::least_bytes`]) before anything is allocated.

mod attributes;
mod encode;
mod filters;
mod indices;
mod refilter;

use std::fmt::Display;

use serde::{Deserialize, Serialize};

pub(super) use encode::encode;
pub(super) use refilter::{exponential, octahedral, one_of_octahedral};

/// Version of the codec of attributes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Codec {
    /// The only one that EXT_meshopt_compression has.
    Version0,
    /// KHR_meshopt_compression has this one too.
    Version1,
}

/// Bitstream of a buffer view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(super) enum Mode {
    /// Elements of a few bytes, as differences byte by byte.
    Attributes,
    /// Indices of a triangle list.
    Triangles,
    /// Any other indices.
    Indices,
}

/// What is done to the elements after decoding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(super) enum Filter {
    /// Nothing.
    #[default]
    None,
    /// Unit vectors from octahedral coordinates.
    Octahedral,
    /// Unit quaternions from three components and the number of the fourth.
    Quaternion,
    /// Floats from 24-bit mantissas and 8-bit exponents.
    Exponential,
    /// RGBA from YCoCg and alpha.
    Color,
}

/// What the extension says of the elements of a buffer view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub(super) struct StreamLayout {
    /// Bitstream.
    pub(super) mode: Mode,
    /// What follows.
    #[serde(default)]
    pub(super) filter: Filter,
    /// Number of elements.
    pub(super) count: usize,
    /// Bytes of one element.
    #[serde(rename = "byteStride")]
    pub(super) stride: usize,
}

/// Why a stream cannot be decoded, in words that follow "the stream".
pub(super) type Decoded<T> = Result<T, &'static str>;

const ENDS_EARLY: &str = "ends early";

impl StreamLayout {
    /// Whether mode, filter, stride and count go together.
    ///
    /// # Errors
    /// What does not.
    pub(super) fn check(&self) -> Result<(), impl Display + use<>> {
        let StreamLayout { mode, filter, count, stride } = *self;
        let strides_of_mode = match mode {
            Mode::Attributes => stride.is_multiple_of(4) && (4..=256).contains(&stride),
            Mode::Triangles | Mode::Indices => stride == 2 || stride == 4,
        };
        let strides_of_filter = match filter {
            Filter::None | Filter::Exponential => true,
            Filter::Octahedral | Filter::Color => stride == 4 || stride == 8,
            Filter::Quaternion => stride == 8,
        };
        if !strides_of_mode || !strides_of_filter {
            Err(format!("byteStride {stride} does not go with its mode and filter"))
        } else if mode != Mode::Attributes && filter != Filter::None {
            Err("indices have no filter".to_owned())
        } else if mode == Mode::Triangles && !count.is_multiple_of(3) {
            Err(format!("{count} indices are no triangles"))
        } else {
            Ok(())
        }
    }

    /// Bytes of the decoded elements; none when that is no number.
    pub(super) fn bytes(&self) -> Option<usize> {
        self.count.checked_mul(self.stride)
    }

    /// The least bytes that a stream of this layout can have: a shorter one lies about its count.
    pub(super) fn least_bytes(&self) -> usize {
        match self.mode {
            // One control byte for four bytes of at most 256 elements.
            Mode::Attributes => self.count.div_ceil(256).saturating_mul(self.stride / 4),
            Mode::Triangles => self.count / 3,
            Mode::Indices => self.count,
        }
    }
}

/// Decodes a stream whose layout was checked, and whose size is affordable.
///
/// # Errors
/// What is wrong with the stream.
pub(super) fn decode(stream: &[u8], layout: &StreamLayout) -> Decoded<Vec<u8>> {
    if stream.len() < layout.least_bytes() {
        return Err("is too short for its count");
    }
    let mut data = unfiltered(stream, layout)?;
    filters::apply(layout.filter, &mut data, layout.stride);
    Ok(data)
}

fn unfiltered(stream: &[u8], layout: &StreamLayout) -> Decoded<Vec<u8>> {
    Ok(match layout.mode {
        Mode::Attributes => attributes::decode(stream, layout.count, layout.stride)?,
        Mode::Triangles => narrow(&indices::triangles(stream, layout.count / 3)?, layout.stride),
        Mode::Indices => narrow(&indices::sequence(stream, layout.count)?, layout.stride),
    })
}

fn narrow(values: &[u32], stride: usize) -> Vec<u8> {
    if stride == 2 {
        values.iter().flat_map(|v| (*v as u16).to_le_bytes()).collect()
    } else {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }
}

/// Bytes read one after the other.
struct Reader<'a> {
    left: &'a [u8],
}

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> Decoded<&'a [u8]> {
        let (taken, left) = self.left.split_at_checked(count).ok_or(ENDS_EARLY)?;
        self.left = left;
        Ok(taken)
    }

    fn byte(&mut self) -> Decoded<u8> {
        let (byte, left) = self.left.split_first().ok_or(ENDS_EARLY)?;
        self.left = left;
        Ok(*byte)
    }

    /// Seven bits a byte, least significant first; the highest bit says that another byte follows, of five at most.
    fn varint(&mut self) -> Decoded<u32> {
        let mut value = 0;
        for shift in [0, 7, 14, 21, 28] {
            let byte = self.byte()?;
            value |= u32::from(byte & 0x7F) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err("holds a number of more than five bytes")
    }

    fn end(&self) -> Decoded<()> {
        if self.left.is_empty() { Ok(()) } else { Err("holds bytes that belong to nothing") }
    }
}

/// What lies between the header byte and a tail of `tail` bytes.
fn body(stream: &[u8], tail: usize) -> Decoded<(u8, Reader<'_>)> {
    let (header, rest) = stream.split_first().ok_or(ENDS_EARLY)?;
    let length = rest.len().checked_sub(tail).ok_or(ENDS_EARLY)?;
    Ok((*header, Reader { left: rest.get(..length).unwrap_or_default() }))
}

#[cfg(test)]
mod tests;
