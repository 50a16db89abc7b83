//! How a JPEG file loses: its quantisation tables, the size of its chroma, its scans.

use jpeg_encoder::{ChromaSubsamplingMethod, Encoder, QuantizationTableType, SamplingFactor};

/// Quality where neither the options nor an uploaded file say one.
const QUALITY: u8 = 92;
/// Quality from which chroma keeps its full resolution, where the options say a quality.
const FULL_CHROMA: u8 = 90;

/// What an encoder of JPEG files is told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JpegCoding {
    pub(super) tables: Tables,
    /// Texels by sample of chroma, along x and y.
    pub(super) sampling: [u8; 2],
    /// Whether the picture comes in scans of growing detail.
    pub(super) progressive: bool,
}

/// Steps that coefficients are rounded to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Tables {
    /// Those of annex K of ITU T.81, scaled as the Independent JPEG Group does, by a quality in 1..=100.
    Quality(u8),
    /// Those of luma and of chroma in natural order, in 1..=255.
    Own(Box<[[u16; 64]; 2]>),
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
    /// That of a quality in 1..=100; from 90 on chroma keeps its resolution.
    pub fn of_quality(quality: u8) -> Self {
        let sampling = if quality >= FULL_CHROMA { [1; 2] } else { [2; 2] };
        JpegCoding { tables: Tables::Quality(quality.clamp(1, 100)), sampling, progressive: false }
    }

    /// What loses no more than either of two: the finer step of each coefficient, the finer chroma. Of two qualities, the better.
    #[must_use]
    pub fn finer(self, other: Self) -> Self {
        let tables = match (self.tables, other.tables) {
            (Tables::Own(a), Tables::Own(b)) => {
                Tables::Own(Box::new([finer_table(a[0], b[0]), finer_table(a[1], b[1])]))
            }
            (Tables::Quality(a), Tables::Quality(b)) => Tables::Quality(a.max(b)),
            (own @ Tables::Own(_), _) | (_, own) => own,
        };
        let sampling = [0, 1].map(|k| self.sampling[k].min(other.sampling[k]));
        JpegCoding { tables, sampling, progressive: self.progressive && other.progressive }
    }

    /// Sides of the blocks that are encoded by themselves, in texels: of a picture moved by multiples of them, every coefficient comes again.
    pub fn block(&self) -> [u32; 2] {
        self.sampling.map(|n| 8 * u32::from(n))
    }

    /// An encoder of one file. `small` ones get Huffman tables of their own, which takes twice the time and holds all coefficients.
    pub(super) fn encoder<'a>(&self, file: &'a mut Vec<u8>, small: bool) -> Encoder<&'a mut Vec<u8>> {
        let quality = match self.tables {
            Tables::Quality(quality) => quality,
            Tables::Own(_) => QUALITY,
        };
        let mut encoder = Encoder::new(file, quality);
        if let Tables::Own(tables) = &self.tables {
            let [luma, chroma] = tables.as_ref().map(|table| QuantizationTableType::Custom(Box::new(table)));
            encoder.set_quantization_tables(luma, chroma);
        }
        let [x, y] = self.sampling;
        encoder.set_sampling_factor(SamplingFactor::from_factors(x, y).unwrap_or(SamplingFactor::F_1_1));
        encoder.set_chroma_subsampling_method(ChromaSubsamplingMethod::Average);
        encoder.set_progressive(self.progressive && small);
        encoder.set_optimized_huffman_tables(small);
        encoder
    }
}
