//! JPEG files out: what they lose, and the baseline encoder that keeps to it.

mod blocks;
mod chroma;
mod huffman;
mod scan;

use jpeg_encoder::{ChromaSubsamplingMethod, ColorType, Encoder, QuantizationTableType, SamplingFactor};

pub(super) use scan::{Frame, Scanned};

use crate::error::{Failure, Result};

/// Quality where neither the options nor an uploaded file say one.
const QUALITY: u8 = 92;
/// Quality from which chroma keeps its full resolution, where the options say a quality.
const FULL_CHROMA: u8 = 90;
/// Longest side of a JPEG, in texels.
pub(super) const LONGEST: u32 = 65_535;
/// Texels up to which a picture can come in scans of growing detail: all its coefficients are held then.
const PROGRESSIVE: u64 = 1 << 25;

/// Steps of coefficients, of luma and of chroma, row by row.
pub(super) type Tables = [[u16; 64]; 2];

/// How a JPEG file loses: its quantisation tables, the size of its chroma, its scans.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JpegCoding {
    /// In 1..=255.
    pub(super) tables: Box<Tables>,
    /// Texels by sample of chroma, along x and y.
    pub(super) sampling: [u8; 2],
    /// Whether the picture comes in scans of growing detail.
    pub(super) progressive: bool,
    /// Whether the picture was decoded from such a file: chroma is then what decoders smooth to what they gave.
    pub(super) decoded: bool,
}

/// The finer step of each coefficient.
pub(super) fn finer_table(mut a: [u16; 64], b: [u16; 64]) -> [u16; 64] {
    a.iter_mut().zip(b).for_each(|(a, b)| *a = b.min(*a));
    a
}

impl Default for JpegCoding {
    fn default() -> Self {
        JpegCoding::of_quality(QUALITY)
    }
}

impl JpegCoding {
    /// That of a quality in 1..=100: the tables of ITU T.81, annex K, scaled as the Independent JPEG Group does. From 90 on chroma keeps its
    /// resolution.
    pub fn of_quality(quality: u8) -> Self {
        let quality = u16::from(quality.clamp(1, 100));
        let percent = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
        let scaled = |step: u16| ((u32::from(step) * u32::from(percent) + 50) / 100).clamp(1, 255) as u16;
        let sampling = if quality >= u16::from(FULL_CHROMA) { [1; 2] } else { [2; 2] };
        let tables = Box::new([LUMA, CHROMA].map(|table| table.map(scaled)));
        JpegCoding { tables, sampling, progressive: false, decoded: false }
    }

    /// What loses no more than either of two: the finer step of each coefficient, the finer chroma.
    #[must_use]
    pub fn finer(self, other: Self) -> Self {
        let [a, b] = [*self.tables, *other.tables];
        JpegCoding {
            tables: Box::new([finer_table(a[0], b[0]), finer_table(a[1], b[1])]),
            sampling: [0, 1].map(|k| self.sampling[k].min(other.sampling[k])),
            progressive: self.progressive && other.progressive,
            decoded: self.decoded && other.decoded && self.sampling == other.sampling,
        }
    }

    /// Sides of the blocks that are encoded by themselves, in texels: of a picture moved by multiples of them, every coefficient comes again.
    pub fn block(&self) -> [u32; 2] {
        self.sampling.map(|n| 8 * u32::from(n))
    }

    /// Encodes `samples`, 8 bits each, of one channel or three, row by row.
    ///
    /// # Errors
    /// `internal` for an image without texels or beyond 65,535 of them along a side, and where samples are missing.
    pub(super) fn encode(&self, samples: &[u8], size: [u32; 2], channels: u8) -> Result<Vec<u8>> {
        if self.progressive && u64::from(size[0]) * u64::from(size[1]) <= PROGRESSIVE {
            return self.encode_progressive(samples, size, channels);
        }
        let frame = Frame::new(self, size, channels)?;
        let strips = frame.strips(samples)?;
        Ok(frame.file(&strips))
    }

    fn encode_progressive(&self, samples: &[u8], size: [u32; 2], channels: u8) -> Result<Vec<u8>> {
        let [width, height] = size.map(u16::try_from);
        let (Ok(width), Ok(height)) = (width, height) else { return Err(impossible(&"it is too large")) };
        let mut file = Vec::new();
        let mut encoder = Encoder::new(&mut file, QUALITY);
        let [luma, chroma] = self.tables.map(|table| QuantizationTableType::Custom(Box::new(table)));
        encoder.set_quantization_tables(luma, chroma);
        let [x, y] = self.sampling;
        encoder.set_sampling_factor(SamplingFactor::from_factors(x, y).unwrap_or(SamplingFactor::F_1_1));
        encoder.set_chroma_subsampling_method(ChromaSubsamplingMethod::Average);
        encoder.set_progressive(true);
        encoder.set_optimized_huffman_tables(true);
        let kind = if channels == 1 { ColorType::Luma } else { ColorType::Rgb };
        encoder.encode(samples, width, height, kind).map_err(|e| impossible(&e))?;
        Ok(file)
    }
}

/// A JPEG that cannot be.
pub(super) fn impossible(why: &dyn std::fmt::Display) -> Failure {
    Failure::internal(format!("a JPEG cannot be written: {why}"))
}

/// Of luma, ITU T.81, table K.1.
#[rustfmt::skip]
const LUMA: [u16; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61,
    12, 12, 14, 19, 26, 58, 60, 55,
    14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62,
    18, 22, 37, 56, 68, 109, 103, 77,
    24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
];
/// Of chroma, ITU T.81, table K.2.
#[rustfmt::skip]
const CHROMA: [u16; 64] = [
    17, 18, 24, 47, 99, 99, 99, 99,
    18, 21, 26, 66, 99, 99, 99, 99,
    24, 26, 56, 99, 99, 99, 99, 99,
    47, 66, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
];

/// Natural places of the coefficients in zigzag order (ITU T.81, figure A.6).
pub(super) const ZIGZAG: [u8; 64] = zigzag();

const fn zigzag() -> [u8; 64] {
    let mut places = [0; 64];
    let (mut k, mut diagonal) = (0, 0);
    while diagonal < 15 {
        let first = if diagonal < 8 { 0 } else { diagonal - 7 };
        let last = if diagonal < 8 { diagonal } else { 7 };
        let mut i = first;
        while i <= last {
            // Even diagonals run upwards: the column grows.
            let column = if diagonal % 2 == 0 { i } else { diagonal - i };
            places[k] = ((diagonal - column) * 8 + column) as u8;
            k += 1;
            i += 1;
        }
        diagonal += 1;
    }
    places
}

#[cfg(test)]
mod tests;
