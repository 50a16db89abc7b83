//! The textures of a sample at another size, or as JPEG: what large scans are like, in time and memory.

use image::RgbImage;
use rayon::prelude::*;
use serde_json::Value;

use crate::asset::Document;
use crate::error::Result;
use crate::texture::{Coding, JpegCoding, decode, encode};

/// How the textures of a sample are written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SampleTextures {
    /// Their longer side, in texels; none leaves it as it is.
    pub side: Option<u32>,
    /// Whether they are JPEG files, instead of PNG.
    pub jpeg: bool,
}

/// Quality of JPEG files.
const QUALITY: u8 = 90;

impl SampleTextures {
    /// Writes the textures of a document anew, which are RGB.
    pub(super) fn apply(self, document: &mut Document) -> Result<()> {
        if self == Self::default() {
            return Ok(());
        }
        let coding = if self.jpeg { Coding::Jpeg(JpegCoding::of_quality(QUALITY)) } else { Coding::Png };
        for (index, file) in document.images.iter_mut().enumerate() {
            let Some(bytes) = file else { continue };
            let mut image = decode(bytes, u64::MAX)?.into_rgb8();
            if let Some(side) = self.side {
                let longest = image.width().max(image.height());
                let size = [image.width(), image.height()].map(|n| (n * side / longest).max(1));
                image = scaled(&image, size);
            }
            *bytes = encode(&image.into(), &coding)?;
            if let Some(kind) = document.json.pointer_mut(&format!("/images/{index}/mimeType")) {
                *kind = Value::from(coding.format().media_type());
            }
        }
        Ok(())
    }
}

/// An image at another size, interpolated in steps of a 256th of a texel.
fn scaled(image: &RgbImage, [width, height]: [u32; 2]) -> RgbImage {
    let (own_width, own_height) = image.dimensions();
    // The texel at or before a place, the one behind it, and the weight of that.
    let place = |i: u32, size: u32, own: u32| {
        let at = ((2 * u64::from(i) + 1) * u64::from(own) * 128 / u64::from(size)).saturating_sub(128);
        let first = (at / 256) as usize;
        (first, (first + 1).min(own as usize - 1), (at % 256) as u32)
    };
    let columns: Vec<_> = (0..width).map(|x| place(x, width, own_width)).collect();
    let mut out = RgbImage::new(width, height);
    let line = 3 * own_width as usize;
    out.par_chunks_mut(3 * width as usize).enumerate().for_each(|(y, row)| {
        let (above, below, down) = place(y as u32, height, own_height);
        let rows = [above, below].map(|y| &image.as_raw()[y * line..(y + 1) * line]);
        for (texel, &(left, right, along)) in row.chunks_exact_mut(3).zip(&columns) {
            for (c, out) in texel.iter_mut().enumerate() {
                let [a, b] = rows
                    .map(|row| u32::from(row[3 * left + c]) * (256 - along) + u32::from(row[3 * right + c]) * along);
                *out = ((a * (256 - down) + b * down + (1 << 15)) >> 16) as u8;
            }
        }
    });
    out
}
