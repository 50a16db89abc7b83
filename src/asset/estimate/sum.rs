//! From what headers declare to bytes of memory.

use super::super::limits::Limits;
use super::Estimate;
use crate::texture::{Format, Header};

// FIT: constants
const BASE: f64 = 16e6;

/// What the models of a job declare.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Sum {
    files: u64,
    gathered: u64,
    texels: u64,
    samples: u64,
    rewritten: u64,
    largest: [u64; 2],
    triangles: u64,
    vertices: u64,
}

impl Sum {
    pub(super) fn files(&mut self, bytes: u64) {
        self.files = self.files.saturating_add(bytes);
    }
    pub(super) fn gathered(&mut self, bytes: u64) {
        self.gathered = self.gathered.saturating_add(bytes);
    }
    pub(super) fn triangles(&mut self, count: u64) {
        self.triangles = self.triangles.saturating_add(count);
    }
    pub(super) fn vertices(&mut self, count: u64) {
        self.vertices = self.vertices.saturating_add(count);
    }
    pub(super) fn image(&mut self, header: Header, limits: &Limits) {
        let texels = (u64::from(header.width) * u64::from(header.height)).min(limits.max_image_pixels);
        let bytes = texels.saturating_mul(u64::from(header.channels) * u64::from(header.depth) / 8);
        self.texels = self.texels.saturating_add(texels);
        self.samples = self.samples.saturating_add(bytes);
        if matches!(header.format, Format::Ktx2 | Format::Webp) {
            self.rewritten = self.rewritten.saturating_add(bytes);
        }
        self.largest = self.largest.max([bytes, texels]);
    }
    pub(super) fn estimate(&self, limits: &Limits) -> Estimate {
        if std::env::var("FIT").is_ok() {
            eprintln!("FIT {self:?}");
        }
        Estimate { bytes: BASE as u64, texels: self.texels, triangles: self.triangles.min(limits.max_triangles) }
    }
}
