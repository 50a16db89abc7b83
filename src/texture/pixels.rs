//! Images in memory: a [`DynamicImage`] of 8 or 16 bits and one to four channels, and the samples in it that filters work on.

use std::ops::Range;

use image::{DynamicImage, ImageBuffer, Luma, LumaA, Rgb, Rgba};

use super::{Direction, Role};
use crate::error::{Failure, Result};

/// A sample's type: 8 or 16 bits.
pub(crate) trait Depth: Copy + Default + Eq + Send + Sync + 'static {
    /// The largest value.
    const MAX: u32;
    /// As a number in `0..=MAX`.
    fn value(self) -> u32;
    /// From a number in `0..=MAX`.
    fn from_value(value: u32) -> Self;
    /// The samples of an image, where they are of this type: row by row from the top, channels interleaved.
    fn of(image: &DynamicImage) -> Option<&[Self]>;
    /// An image of 1 grey, 2 grey and alpha, 3 RGB or 4 RGBA channels; none where the samples are too few.
    fn image(width: u32, height: u32, channels: u8, samples: Vec<Self>) -> Option<DynamicImage>;
}

macro_rules! depth {
    ($sample:ty, $view:ident) => {
        impl Depth for $sample {
            const MAX: u32 = <$sample>::MAX as u32;
            fn value(self) -> u32 {
                u32::from(self)
            }
            fn from_value(value: u32) -> Self {
                value as $sample
            }
            fn of(image: &DynamicImage) -> Option<&[Self]> {
                image.$view().map(|view| view.samples)
            }
            fn image(width: u32, height: u32, channels: u8, samples: Vec<Self>) -> Option<DynamicImage> {
                match channels {
                    1 => ImageBuffer::<Luma<$sample>, _>::from_raw(width, height, samples).map(Into::into),
                    2 => ImageBuffer::<LumaA<$sample>, _>::from_raw(width, height, samples).map(Into::into),
                    3 => ImageBuffer::<Rgb<$sample>, _>::from_raw(width, height, samples).map(Into::into),
                    4 => ImageBuffer::<Rgba<$sample>, _>::from_raw(width, height, samples).map(Into::into),
                    _ => None,
                }
            }
        }
    };
}

depth!(u8, as_flat_samples_u8);
depth!(u16, as_flat_samples_u16);

/// An image of its samples. Fails with `internal` where they are not as many as it needs.
pub(crate) fn from_samples<T: Depth>([width, height]: [u32; 2], channels: u8, samples: Vec<T>) -> Result<DynamicImage> {
    let expected = u64::from(width) * u64::from(height) * u64::from(channels);
    (samples.len() as u64 == expected)
        .then(|| T::image(width, height, channels, samples))
        .flatten()
        .ok_or_else(|| Failure::internal("an image does not hold the samples that it declares"))
}

/// Bits of a sample.
pub fn depth(image: &DynamicImage) -> u8 {
    let colour = image.color();
    (colour.bits_per_pixel() / u16::from(colour.channel_count())) as u8
}

/// Some rows of an image, whose texels are read one by one.
#[derive(Clone, Copy)]
pub(crate) struct TexelRows<'a> {
    bytes: &'a [u8],
    channels: usize,
    is_deep: bool,
    /// Width and height of the whole image.
    pub(crate) size: [usize; 2],
    /// The first of the rows.
    top: usize,
}

impl<'a> TexelRows<'a> {
    /// All rows of an image.
    pub(crate) fn of(image: &'a DynamicImage) -> Self {
        let channels = usize::from(image.color().channel_count());
        let size = [image.width() as usize, image.height() as usize];
        TexelRows { bytes: image.as_bytes(), channels, is_deep: depth(image) == 16, size, top: 0 }
    }

    /// The rows from `top` on of an image of that size, 8 bits a sample.
    pub(crate) fn part(bytes: &'a [u8], channels: usize, size: [usize; 2], top: usize) -> Self {
        TexelRows { bytes, channels, is_deep: false, size, top }
    }

    /// The samples of a texel, and 0 for the channels that the image does not have.
    #[inline]
    fn samples(&self, x: usize, y: usize) -> [u32; 4] {
        let bytes = self.channels << usize::from(self.is_deep);
        let start = ((y - self.top) * self.size[0] + x) * bytes;
        let texel = &self.bytes[start..start + bytes];
        let mut out = [0; 4];
        if self.is_deep {
            let values = texel.chunks_exact(2).map(|b| u16::from_ne_bytes([b[0], b[1]]));
            out.iter_mut().zip(values).for_each(|(o, v)| *o = u32::from(v));
        } else {
            out.iter_mut().zip(texel).for_each(|(o, v)| *o = u32::from(*v));
        }
        out
    }

    /// The largest sample.
    fn most(&self) -> f64 {
        if self.is_deep { 65_535.0 } else { 255.0 }
    }

    /// The encoded values of a texel in 0..=1, and 0 for the channels that the image does not have.
    #[inline]
    pub(crate) fn texel(&self, x: usize, y: usize) -> [f64; 4] {
        let most = self.most();
        self.samples(x, y).map(|v| f64::from(v) / most)
    }

    /// The sums over a rectangle of texels of `C` channels of 8 bits.
    fn sum<const C: usize>(&self, columns: Range<usize>, rows: Range<usize>) -> [u32; 4] {
        let mut sum = [0; 4];
        for y in rows {
            let start = (y - self.top) * self.size[0];
            for texel in self.bytes[(start + columns.start) * C..(start + columns.end) * C].chunks_exact(C) {
                (0..C).for_each(|c| sum[c] += u32::from(texel[c]));
            }
        }
        sum
    }

    /// The mean over a rectangle of texels.
    pub(crate) fn mean(&self, columns: Range<usize>, rows: Range<usize>) -> [f64; 4] {
        let whole = (rows.len() * columns.len()) as f64 * self.most();
        let sum = match (self.is_deep, self.channels) {
            (false, 1) => self.sum::<1>(columns, rows),
            (false, 3) => self.sum::<3>(columns, rows),
            (false, 4) => self.sum::<4>(columns, rows),
            _ => {
                let texels = rows.flat_map(|y| columns.clone().map(move |x| self.samples(x, y)));
                texels.fold([0; 4], |sum, texel| std::array::from_fn(|c| sum[c] + texel[c]))
            }
        };
        sum.map(|s| f64::from((f64::from(s) / whole) as f32))
    }
}

/// The encoded values of a texel in 0..=1, and 0 for the channels that the image does not have.
pub fn texel(image: &DynamicImage, x: u32, y: u32) -> [f64; 4] {
    TexelRows::of(image).texel(x as usize, y as usize)
}

/// The same picture with `channels` channels (1, 2, 3 or 4) and 8 or 16 bits, so that it can share a sheet: grey becomes RGB, alpha that is
/// missing is opaque. Nothing is lost as long as there are not fewer channels than before; bits never become fewer.
pub fn widened(image: DynamicImage, channels: u8, bits: u8) -> DynamicImage {
    match (channels, bits.max(depth(&image))) {
        (1, 8) => image.into_luma8().into(),
        (2, 8) => image.into_luma_alpha8().into(),
        (3, 8) => image.into_rgb8().into(),
        (4, 8) => image.into_rgba8().into(),
        (1, _) => image.into_luma16().into(),
        (2, _) => image.into_luma_alpha16().into(),
        (3, _) => image.into_rgb16().into(),
        (4, _) => image.into_rgba16().into(),
        _ => image,
    }
}

/// One texel that leaves a material as it is: white, a flat normal, or the full anisotropy along the tangent. Fails with `internal` unless
/// there are 1 to 4 channels.
pub fn neutral(role: Role, channels: u8, bits: u8) -> Result<DynamicImage> {
    let flat: [u8; 4] = match role.direction() {
        Some(Direction::Normal) => [128, 128, 255, 255],
        Some(Direction::Anisotropy) => [255, 128, 255, 255],
        None => [255; 4],
    };
    let samples = flat.into_iter().take(usize::from(channels)).collect();
    Ok(widened(from_samples([1, 1], channels, samples)?, channels, bits))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image<T: Depth>(channels: u8, samples: &[T]) -> DynamicImage {
        from_samples([1, 1], channels, samples.to_vec()).unwrap()
    }

    #[test]
    fn grey_becomes_colour_and_alpha_opaque() {
        for v in 0..=255u8 {
            let (w, deep) = (255 - v, u16::from(v) * 257);
            assert_eq!(widened(image(1, &[v]), 4, 8), image(4, &[v, v, v, 255]));
            assert_eq!(widened(image(2, &[v, w]), 4, 8), image(4, &[v, v, v, w]));
            assert_eq!(widened(image(1, &[v]), 2, 8), image(2, &[v, 255]));
            assert_eq!(widened(image(1, &[v]), 3, 16), image(3, &[deep; 3]));
            assert_eq!(widened(image(2, &[v, w]), 4, 16), image(4, &[deep, deep, deep, u16::from(w) * 257]));
            assert_eq!(widened(image(3, &[v, 2, w]), 4, 16), image(4, &[deep, 514, u16::from(w) * 257, 65_535]));
            assert_eq!(widened(image(3, &[1, v, 3]), 3, 8), image(3, &[1, v, 3]));
            assert_eq!(widened(image(4, &[1, 2, v, w]), 4, 8), image(4, &[1, 2, v, w]));
        }
        for v in (0..=65_535u16).step_by(13) {
            assert_eq!(widened(image(1, &[v]), 3, 16), image(3, &[v; 3]));
            assert_eq!(widened(image(3, &[v, 7, 9]), 4, 8), image(4, &[v, 7, 9, 65_535]));
        }
    }

    #[test]
    fn neutral_texels_are_white_flat_or_along_the_tangent() {
        assert_eq!(neutral(Role::BaseColor, 2, 8).unwrap(), image(2, &[255u8; 2]));
        assert_eq!(neutral(Role::Normal, 3, 8).unwrap(), image(3, &[128u8, 128, 255]));
        assert_eq!(neutral(Role::Anisotropy, 3, 8).unwrap(), image(3, &[255u8, 128, 255]));
        assert_eq!(neutral(Role::Normal, 4, 16).unwrap(), image(4, &[32_896u16, 32_896, 65_535, 65_535]));
        assert!(neutral(Role::Normal, 5, 8).is_err());
    }

    #[test]
    fn texels_are_read_at_any_depth() {
        assert_eq!(texel(&image(2, &[51u8, 255]), 0, 0), [0.2, 1.0, 0.0, 0.0]);
        assert_eq!(texel(&image(4, &[0u16, 65_535, 13_107, 1]), 0, 0), [0.0, 1.0, 0.2, 1.0 / 65_535.0]);
        let wide = from_samples([2, 2], 1, vec![0u8, 0, 255, 0]).unwrap();
        assert_eq!((texel(&wide, 0, 1)[0], texel(&wide, 1, 1)[0]), (1.0, 0.0));
        assert!(from_samples([2, 2], 1, vec![0u8; 5]).is_err());
    }
}
