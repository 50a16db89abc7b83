//! From what headers declare to bytes of memory: a job holds one thing after the other, and what it holds at most at once counts.
//!
//! Bytes of a texel follow from what is allocated, those of a triangle and of the process from measured peaks of resident memory;
//! `tests/memory.py` holds the whole against measurements. The process itself is in it: one job more in a service needs that much less. Not
//! in it: sheets and formats that options make larger than the input's, and `atlas.merge`, where images of one role are decoded together.

use std::num::Saturating;

use super::super::limits::Limits;
use super::{Demand, Estimate};
use crate::error::{Code, Failure, Result};
use crate::texture::{Format, Header, STREAMED_FROM};

/// What a process takes before it reads anything.
const PROCESS: f64 = 19e6;
/// The pictures of a layout before and after: 2048 x 2048 samples of six bytes each, and their pixels.
const PICTURES: f64 = 60e6;
/// Of a triangle with a layout: the atlas as uploaded and as refined, topology, provenance, measures.
const TRIANGLE: f64 = 1000.0;
/// Of a triangle without.
const BARE_TRIANGLE: f64 = 400.0;
/// Bytes of the pyramid that fills a page, for each texel of the page and each channel and its weight: of blocks of 8 x 8 texels.
const PYRAMID: f64 = 4.0 * BLOCKS;
/// Blocks of all levels, by texel.
const BLOCKS: f64 = 4.0 / 3.0 / 64.0;
/// Bytes of a texel that encoding a KTX2 file takes: all levels as RGBA and as blocks, what each may become, and the blocks of the upload.
const KTX2: f64 = 20.0;
/// Symbols that a JPEG is encoded to before their bits are known, by byte of the file.
const SYMBOLS: f64 = 3.0;
/// Of a triangle that is cut and flattened: the piece that it is in, its elements and factors, the void about it, the best map so far.
const UNWRAPPED: f64 = 2600.0;
/// What cutting takes whatever the size.
const CUTTING: f64 = 30e6;
/// Texels that a thread bakes at a time, and what it holds of each: owner, distance, and what fits it to the uploaded image.
const BAND: (u64, f64) = (1 << 18, 40.0);
/// What a thread holds of the strips of a page that is never held: texels, samples as floats, and what is seen of the file.
const STRIPS: f64 = 55e6;
/// Texels of the refined pages, of those of the upload: at most so many; where the area of the charts is known, that area times the second
/// number and the third.
const PAGE: (f64, f64, f64) = (0.95, 2.1, 0.12);

/// The same at most, where charts are made.
const MOST_UNWRAPPED: f64 = 2.0;

/// What the files of a model declare.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Sum {
    /// Bytes of files, archives and what is in them.
    pub(super) files: Saturating<u64>,
    /// Bytes of buffers.
    pub(super) buffers: Saturating<u64>,
    /// Bytes of encoded images, as often as they are copied.
    pub(super) encoded: Saturating<u64>,
    /// Triangles of all models.
    pub(super) triangles: Saturating<u64>,
    /// Vertices of all models.
    pub(super) vertices: Saturating<u64>,
    /// Whether anything has texture coordinates.
    pub(super) has_layout: bool,
    /// What the charts of all models cover, in sheets.
    pub(super) covered: f64,
    /// Whether there are charts of which that is not known.
    pub(super) is_unmeasured: bool,
    texels: Saturating<u64>,
    /// By image: its header and the bytes of its file.
    images: Vec<(Header, u64)>,
    largest_declared: u64,
}

impl Sum {
    /// An image whose file has `length` bytes; it is not decoded beyond the limit.
    pub(super) fn image(&mut self, header: Header, length: u64, limits: &Limits) {
        let declared = texels(header);
        self.largest_declared = self.largest_declared.max(declared);
        self.texels += declared.min(limits.max_image_pixels);
        self.images.push((header, length));
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

    /// What that comes to, with so many threads.
    pub(super) fn estimate(&self, limits: &Limits, threads: usize, demand: Demand) -> Estimate {
        let triangles = self.triangles.0.min(limits.max_triangles);
        // Three vertices of its own are the most that a triangle has.
        let surface = triangles.max(self.vertices.0.min(limits.max_input_bytes) / 3) as f64;
        // The loader gathers at most twice the input's limit.
        let most = limits.max_input_bytes.saturating_mul(2);
        let (buffers, encoded) = (self.buffers.0.min(most) as f64, self.encoded.0.min(most) as f64);
        // Files are held as they came, and what the document gathers of them.
        let held = PROCESS + self.files.0 as f64 + buffers + encoded;
        // Charts without any area are left as they are, but by what lays them out itself.
        let has_layout = self.has_layout && (self.is_unmeasured || self.covered > 0.0);
        let bytes = if has_layout || demand.unwraps {
            let held = held + TRIANGLE * surface;
            let bakes = demand.bakes && self.has_layout;
            let images = || self.images.iter().filter(|_| bakes);
            let page = self.page(demand);
            let baking = images().map(|image| self.baking(*image, page, threads, demand)).fold(0.0, f64::max);
            // An image is decoded while surfaces are unwrapped.
            let decoded = images().map(|(header, _)| samples(*header)).fold(0.0, f64::max);
            let unwrapping = if demand.unwraps { CUTTING + UNWRAPPED * surface + decoded } else { 0.0 };
            let written: f64 = match bakes {
                true => images().map(|(header, length)| written(*header, *length, page)).sum(),
                false => encoded,
            };
            // One slot at a time is baked, and its files are held until all are. Then they are in the document, in the GLB and beside it, while
            // pictures are drawn; at the end they are in the archive twice more.
            let phases =
                [unwrapping, baking + written, PICTURES + buffers + 4.0 * written, 2.0 * buffers + 6.0 * written];
            held + phases.into_iter().fold(0.0, f64::max)
        } else {
            held + 2.0 * buffers + BARE_TRIANGLE * surface
        };
        Estimate { bytes: bytes as u64, texels: self.texels.0, triangles }
    }

    /// Texels of a refined page, of those of the upload.
    fn page(&self, demand: Demand) -> f64 {
        let (most, factor, least) = PAGE;
        // Charts that shared texels have some of their own in a new layout, whatever room that takes.
        let most = if demand.unwraps { MOST_UNWRAPPED } else { most };
        if self.is_unmeasured { most } else { (factor * self.covered + least).min(most) }
    }

    /// What baking one image takes: the image, its page, and the larger of what baking and what encoding hold beside: a byte of state for each
    /// texel, the pyramid that fills the page (of floats and a weight), and the bands of the threads; symbols of a JPEG, or the page once more,
    /// filtered for a PNG; blocks and what they may become for a KTX2.
    fn baking(&self, (header, length): (Header, u64), page: f64, threads: usize, demand: Demand) -> f64 {
        let (count, channels) = (texels(header), f64::from(header.channels));
        let page = page * count as f64;
        let bands = (count / BAND.0).clamp(1, threads.max(1) as u64) * BAND.0;
        let band = BAND.1 * bands.min(count) as f64;
        let filling = 1.0 + PYRAMID * (channels + 1.0);
        let symbols = SYMBOLS * length as f64;
        let encoding = match header.format {
            _ if demand.ktx2 => KTX2,
            Format::Ktx2 => KTX2,
            Format::Jpeg => symbols / count.max(1) as f64,
            // Samples of 16 bits are turned round first.
            _ => texel_bytes(header) * f64::from(header.depth / 8),
        };
        let held_texel = texel_bytes(header) + filling.max(encoding);
        // Images of another size than the largest may have no texels that charts move by.
        let largest = self.images.iter().all(|(other, _)| texels(*other) <= count);
        if demand.copies && !self.is_unmeasured && largest && header.format == Format::Jpeg {
            let strips = page * PYRAMID * (channels + 1.0) + symbols + STRIPS * threads.max(1) as f64;
            let held = page.min(STREAMED_FROM as f64) * held_texel;
            return samples(header) + if page < STREAMED_FROM as f64 { held + band } else { held.max(strips) };
        }
        samples(header) + page * held_texel + band
    }
}

fn texels(header: Header) -> u64 {
    u64::from(header.width) * u64::from(header.height)
}

fn texel_bytes(header: Header) -> f64 {
    f64::from(header.channels) * f64::from(header.depth / 8)
}

fn samples(header: Header) -> f64 {
    texels(header) as f64 * texel_bytes(header)
}

/// Bytes of the refined file of an image: as large as the uploaded one, more where that was compressed harder than ours will be (palettes, a
/// low quality, Basis Universal), and at most as large as the samples of its page.
fn written(header: Header, length: u64, page: f64) -> f64 {
    let (samples, length) = (samples(header), length as f64);
    let bytes = match header.format {
        Format::Png => 1.1 * length + (0.1 * samples).min(8.0 * length),
        Format::Jpeg => 2.0 * length + 0.02 * samples,
        Format::Webp | Format::Ktx2 => 0.6 * samples,
    };
    bytes.min(1.01 * page * samples)
}
