//! From what headers declare to bytes of memory.
//!
//! The factors are upper bounds fitted to measured peaks of resident memory: 35 scans, PBR models and surfaces without images, with up to
//! 200,000 triangles and images of up to 67 million texels (PNG of 8 and 16 bits, JPEG, KTX2), refined by `pack` and `scan`, up to
//! 53,000 triangles by `box_cutter`, some with pictures. The estimates are above all of them, and within 2.5 times those over 100 MB. Not in
//! them: sheets that options make larger than the input's, and `atlas.merge`, where images of one role are decoded together.

use std::num::Saturating;

use super::super::limits::Limits;
use super::Estimate;
use crate::error::{Code, Failure, Result};
use crate::texture::Header;

/// What the process takes before it reads anything, and what pictures and searches of the smallest models take.
const BASE: f64 = 90e6;
/// Of a byte of the files: they are held as they came.
const FILE: f64 = 1.0;
/// Of a byte of the buffers and encoded images that a document gathers: there, in the refined document and among the results.
const GATHERED: f64 = 4.0;
/// Of a texel of the largest image: owners and fill of the sheet that is baked, one slot at a time.
const LARGEST_TEXEL: f64 = 3.0;
/// Of a byte of the samples of the largest image: it is decoded, baked and encoded.
const LARGEST_SAMPLE: f64 = 1.5;
/// Of a byte of the samples of any image: its refined file is held until all are written, and may have to be lossless.
const SAMPLE: f64 = 1.4;
/// Of a triangle: the atlas as uploaded and as refined, topology, provenance, measures.
const TRIANGLE: f64 = 1000.0;

/// What the files of a model declare.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Sum {
    /// Bytes of files, archives and what is in them.
    pub(super) files: Saturating<u64>,
    /// Bytes of buffers and encoded images, as often as they are copied.
    pub(super) gathered: Saturating<u64>,
    /// Triangles of all models.
    pub(super) triangles: Saturating<u64>,
    /// Vertices of all models.
    pub(super) vertices: Saturating<u64>,
    texels: Saturating<u64>,
    samples: Saturating<u64>,
    largest_texels: u64,
    largest_samples: u64,
    largest_declared: u64,
}

impl Sum {
    /// An image, which is not decoded beyond the limit.
    pub(super) fn image(&mut self, header: Header, limits: &Limits) {
        let declared = u64::from(header.width) * u64::from(header.height);
        self.largest_declared = self.largest_declared.max(declared);
        let texels = declared.min(limits.max_image_pixels);
        let samples = texels.saturating_mul(u64::from(header.channels) * u64::from(header.depth / 8));
        self.texels += texels;
        self.samples += samples;
        self.largest_texels = self.largest_texels.max(texels);
        self.largest_samples = self.largest_samples.max(samples);
    }

    /// Refuses what the job would refuse.
    ///
    /// # Errors
    /// `too_large`.
    pub(super) fn check(&self, limits: &Limits) -> Result<()> {
        let refused = |what: String| Err(Failure::new(Code::TooLarge, what));
        if self.largest_declared > limits.max_image_pixels {
            let (declared, most) = (self.largest_declared, limits.max_image_pixels);
            return refused(format!("an image has {declared} pixels by its header; the limit is {most}"));
        }
        if self.triangles.0 > limits.max_triangles {
            return refused(format!(
                "the model has {} triangles; the limit is {}",
                self.triangles.0, limits.max_triangles
            ));
        }
        Ok(())
    }

    /// What that comes to. The loader gathers at most twice the input's limit.
    pub(super) fn estimate(&self, limits: &Limits) -> Estimate {
        let triangles = self.triangles.0.min(limits.max_triangles);
        // Three vertices of its own are the most that a triangle has.
        let surface = triangles.max(self.vertices.0.min(limits.max_input_bytes) / 3);
        let parts = [
            (FILE, self.files.0),
            (GATHERED, self.gathered.0.min(limits.max_input_bytes.saturating_mul(2))),
            (LARGEST_TEXEL, self.largest_texels),
            (LARGEST_SAMPLE, self.largest_samples),
            (SAMPLE, self.samples.0),
            (TRIANGLE, surface),
        ];
        let bytes = BASE + parts.iter().map(|(factor, count)| factor * *count as f64).sum::<f64>();
        Estimate { bytes: bytes as u64, texels: self.texels.0, triangles }
    }
}
