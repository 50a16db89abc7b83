//! Image files out.

use image::DynamicImage;

use super::basis::BasisCoding;
use super::jpeg::JpegCoding;
use super::pixels::Depth;
use super::{Format, png, webp};
use crate::context::Context;
use crate::error::{Failure, Result};

/// A format, and what its encoder is told.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Coding {
    /// PNG.
    Png,
    /// JPEG.
    Jpeg(JpegCoding),
    /// WebP, with a quality in 0..=100, or without loss.
    Webp(Option<u8>),
    /// KTX2 with blocks of Basis Universal.
    Basis(BasisCoding),
}

impl Coding {
    /// The container.
    pub fn format(&self) -> Format {
        match self {
            Coding::Png => Format::Png,
            Coding::Jpeg(_) => Format::Jpeg,
            Coding::Webp(_) => Format::Webp,
            Coding::Basis(_) => Format::Ktx2,
        }
    }
}

impl Coding {
    /// [`encode`], which can be given up.
    ///
    /// # Errors
    /// `canceled`, and those of [`encode`].
    pub fn encode(&self, image: &DynamicImage, context: &Context) -> Result<Vec<u8>> {
        if image.width() == 0 || image.height() == 0 {
            return Err(Failure::internal("an image to encode has no texels"));
        }
        context.check()?;
        match self {
            Coding::Png => png::encode(image),
            Coding::Jpeg(coding) => encode_jpeg(image, coding),
            Coding::Webp(quality) => webp::encode(image, *quality),
            Coding::Basis(coding) => coding.encode(image, context),
        }
    }
}

/// Encodes an image with its own channels; PNG keeps the depth, JPEG has 8 bits, and WebP and KTX2 8 bits in RGB or RGBA.
///
/// Fails with `internal` when the image is empty, has alpha for JPEG or 16 bits for WebP or KTX2, or a size that the format cannot have.
pub fn encode(image: &DynamicImage, coding: &Coding) -> Result<Vec<u8>> {
    coding.encode(image, &Context::silent())
}

fn encode_jpeg(image: &DynamicImage, coding: &JpegCoding) -> Result<Vec<u8>> {
    let narrowed: Vec<u8>;
    let samples = match u16::of(image) {
        Some(samples) => {
            narrowed = samples.iter().map(|s| ((u32::from(*s) * 255 + 32_767) / 65_535) as u8).collect();
            &narrowed
        }
        None => image.as_bytes(),
    };
    coding.encode(samples, [image.width(), image.height()], image.color().channel_count())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::texture::{decode, from_samples, header};

    /// A smooth picture with some grain, different in every channel.
    pub(crate) fn picture(width: u32, height: u32, channels: u8, deep: bool) -> DynamicImage {
        let value = |i: u64| {
            let (c, p) = (i % u64::from(channels), i / u64::from(channels));
            let (x, y) = ((p % u64::from(width)) as f64, (p / u64::from(width)) as f64);
            let grain = (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 60) as f64 / 400.0;
            0.5 + 0.4 * ((x / 9.0 + c as f64).sin() * (y / 7.0 - c as f64).cos()) + grain
        };
        let n = u64::from(width) * u64::from(height) * u64::from(channels);
        if deep {
            from_samples([width, height], channels, (0..n).map(|i| (value(i) * 65_535.0) as u16).collect()).unwrap()
        } else {
            from_samples([width, height], channels, (0..n).map(|i| (value(i) * 255.0) as u8).collect()).unwrap()
        }
    }

    #[test]
    fn png_round_trips_at_every_depth_and_channel_count() {
        for deep in [false, true] {
            for channels in 1..=4 {
                let image = picture(37, 21, channels, deep);
                let file = encode(&image, &Coding::Png).unwrap();
                assert_eq!(decode(&file, 1 << 20).unwrap(), image);
                let head = header(&file).unwrap();
                assert_eq!((head.channels, head.depth), (channels, if deep { 16 } else { 8 }));
            }
        }
    }

    #[test]
    fn jpeg_round_trips_closely_and_refuses_alpha() {
        for channels in [1, 3] {
            let image = picture(45, 31, channels, false);
            let file = encode(&image, &Coding::Jpeg(JpegCoding::of_quality(95))).unwrap();
            assert_eq!(header(&file).unwrap().channels, channels);
            let (a, b) = (decode(&file, 1 << 20).unwrap().into_bytes(), image.as_bytes());
            assert_eq!(a.len(), b.len());
            let squares: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum();
            assert!(squares / (a.len() as f64) < 9.0, "{}", squares / a.len() as f64);
        }
        assert!(encode(&picture(8, 8, 4, false), &Coding::Jpeg(JpegCoding::of_quality(95))).is_err());
        assert!(encode(&DynamicImage::new_rgb8(0, 4), &Coding::Png).is_err());
    }
}
