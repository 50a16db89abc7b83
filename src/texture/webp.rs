//! WebP files out, by libwebp.

#![expect(unsafe_code, reason = "functions of a C library, with pictures of a size that is known to it")]

use image::DynamicImage;
use libwebp_sys as webp;

use super::depth;
use crate::error::{Failure, Result};

/// Longest side of a WebP file, in texels.
pub(crate) const LONGEST: u32 = 16_383;
/// How hard lossless files are searched for, of 100: the library's own choice.
const EFFORT: f32 = 75.0;

/// Encodes an image of 8 bits a channel, as RGB or RGBA: without loss, or with a quality in 0..=100. Colour under transparency is kept.
///
/// # Errors
/// `internal` for an image of 16 bits or beyond 16,383 texels a side, and where the library has no memory.
pub(super) fn encode(image: &DynamicImage, quality: Option<u8>) -> Result<Vec<u8>> {
    let failed = |e: &dyn std::fmt::Display| Failure::internal(format!("a WebP file cannot be written: {e}"));
    if depth(image) != 8 {
        return Err(failed(&"it has 8 bits"));
    }
    if image.width().max(image.height()) > LONGEST {
        return Err(failed(&format!("its sides end at {LONGEST}")));
    }
    let widened;
    let (samples, channels) = match image {
        DynamicImage::ImageRgb8(image) => (image.as_raw(), 3),
        DynamicImage::ImageRgba8(image) => (image.as_raw(), 4),
        _ if image.color().has_alpha() => {
            widened = image.to_rgba8().into_raw();
            (&widened, 4)
        }
        _ => {
            widened = image.to_rgb8().into_raw();
            (&widened, 3)
        }
    };
    let effort = quality.map_or(EFFORT, f32::from);
    let config = webp::WebPConfig::new_with_preset(webp::WebPPreset::WEBP_PRESET_DEFAULT, effort);
    let mut config = config.map_err(|()| failed(&"its library is another one"))?;
    config.lossless = i32::from(quality.is_none());
    config.exact = 1;
    let mut picture = Picture::new().ok_or_else(|| failed(&"its library is another one"))?;
    let mut file: Vec<u8> = Vec::new();
    let inner = &mut picture.0;
    (inner.width, inner.height) = (image.width() as i32, image.height() as i32);
    inner.use_argb = config.lossless;
    inner.writer = Some(append);
    inner.custom_ptr = (&raw mut file).cast();
    let stride = image.width() as i32 * channels;
    // SAFETY: the picture has the size of the image, whose rows lie `stride` bytes from each other; `file` outlives the call.
    let done = unsafe {
        let imported = match channels {
            3 => webp::WebPPictureImportRGB(inner, samples.as_ptr(), stride),
            _ => webp::WebPPictureImportRGBA(inner, samples.as_ptr(), stride),
        };
        imported != 0 && webp::WebPEncode(&config, inner) != 0
    };
    if !done {
        return Err(failed(&format!("{:?}", inner.error_code)));
    }
    Ok(file)
}

/// A picture of the library, freed at its end.
struct Picture(webp::WebPPicture);

impl Picture {
    fn new() -> Option<Self> {
        webp::WebPPicture::new().ok().map(Picture)
    }
}

impl Drop for Picture {
    fn drop(&mut self) {
        // SAFETY: the library made it and frees what it holds, once.
        unsafe { webp::WebPPictureFree(&mut self.0) };
    }
}

/// Appends what the library wrote to the file.
unsafe extern "C" fn append(data: *const u8, size: usize, picture: *const webp::WebPPicture) -> i32 {
    // SAFETY: the library gives the picture that it was called with, and `size` bytes at `data`.
    unsafe {
        let file = (*picture).custom_ptr.cast::<Vec<u8>>();
        if size > 0 {
            (*file).extend_from_slice(std::slice::from_raw_parts(data, size));
        }
    }
    1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::texture::encode::tests::picture;
    use crate::texture::{decode, is_lossy, webp_quality, widened};

    #[test]
    fn without_loss_every_texel_comes_back_and_with_loss_the_quality_does() {
        for channels in 1..=4 {
            let mut image = picture(67, 45, channels, false);
            if let DynamicImage::ImageRgba8(image) = &mut image {
                image.pixels_mut().take(300).for_each(|texel| texel[3] = 0);
            }
            let file = encode(&image, None).unwrap();
            assert!(!is_lossy(&file) && webp_quality(&file).is_none());
            let wide = widened(image.clone(), if channels % 2 == 0 { 4 } else { 3 }, 8);
            assert_eq!(decode(&file, 1 << 20).unwrap(), wide);
            let mut before = usize::MAX;
            for quality in [95, 75, 40, 10] {
                let file = encode(&image, Some(quality)).unwrap();
                assert!(is_lossy(&file) && file.len() < before, "{channels} {quality}");
                before = file.len();
                let told = webp_quality(&file).unwrap();
                assert!(told.abs_diff(quality) <= 8, "{quality} is told as {told}");
                assert_eq!(decode(&file, 1 << 20).unwrap().color(), wide.color());
            }
        }
        assert!(encode(&picture(8, 8, 3, true), None).is_err());
        assert!(encode(&DynamicImage::new_luma8(16_384, 1), Some(80)).is_err());
    }
}
