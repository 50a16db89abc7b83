//! Image files in: PNG, JPEG, WebP and KTX2, bounded by their headers before anything is allocated.

#[cfg(test)]
mod fixture;
mod jpeg;
mod ktx2;
mod probe;
#[cfg(test)]
mod tests;
mod webp;

pub(crate) use jpeg::coding as jpeg_coding;
pub use probe::probe;
pub(crate) use webp::quality as webp_quality;

use std::io::Cursor;
use std::panic::{UnwindSafe, catch_unwind};

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};

use super::{BasisUpload, Format, Header};
use crate::error::{Code, Failure, Result};

/// Longest side that a header may declare, in texels.
const LONGEST_SIDE: u32 = 65_535;
/// Memory that a PNG decoder may take beside the image itself (rows, palette, profiles, text), in bytes.
const OVERHEAD: u64 = 64 << 20;
/// First bytes of every PNG file.
const PNG_SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Reads what an image file says of itself; nothing is decoded.
///
/// Fails with `invalid_image` when the file is of no known kind or its header is broken.
pub fn header(bytes: &[u8]) -> Result<Header> {
    let format = format(bytes)?;
    guarded(|| match format {
        Format::Png => Ok(decoder(bytes, ImageFormat::Png, format)?.1),
        Format::Jpeg => Ok(decoder(bytes, ImageFormat::Jpeg, format)?.1),
        Format::Webp => webp::header(bytes),
        Format::Ktx2 => ktx2::header(bytes),
    })
}

/// Decodes an image file of at most `max_pixels` texels, at its own depth; of several mip levels, the first. Palettes and
/// depths under 8 bits become 8 bits a channel, CMYK becomes RGB; colour profiles, gamma chunks and orientation are ignored, as glTF asks.
///
/// Fails with `too_large` beyond `max_pixels` (before any allocation), with `invalid_image` when the file is broken
/// or ends too early.
pub fn decode(bytes: &[u8], max_pixels: u64) -> Result<DynamicImage> {
    let format = format(bytes)?;
    guarded(|| {
        let (decoder, header) = match format {
            Format::Png => decoder(bytes, ImageFormat::Png, format)?,
            Format::Jpeg => decoder(bytes, ImageFormat::Jpeg, format)?,
            Format::Webp => {
                // Before the decoder allocates what a chunk asks for.
                let told = webp::header(bytes)?;
                let (decoder, header) = decoder(bytes, ImageFormat::WebP, format)?;
                if header != told {
                    return Err(invalid("its chunks contradict each other"));
                }
                (decoder, header)
            }
            Format::Ktx2 => return ktx2::decode(bytes, max_pixels),
        };
        check_size(&header, max_pixels)?;
        if format == Format::Jpeg {
            jpeg::check_scans(bytes)?;
        }
        DynamicImage::from_decoder(decoder).map_err(invalid)
    })
}

/// A decoder whose header is read.
fn decoder(bytes: &[u8], kind: ImageFormat, format: Format) -> Result<(impl ImageDecoder + '_, Header)> {
    let mut limits = Limits::no_limits();
    limits.max_image_width = Some(LONGEST_SIDE);
    limits.max_image_height = Some(LONGEST_SIDE);
    limits.max_alloc = Some(OVERHEAD);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), kind);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(invalid)?;
    let (width, height) = decoder.dimensions();
    check_sides(width, height)?;
    let colour = decoder.color_type();
    let channels = colour.channel_count();
    let depth = 8 * colour.bytes_per_pixel() / channels;
    Ok((decoder, Header { width, height, channels, depth, format }))
}

/// Whether the file was compressed with a loss, as far as its header tells: JPEG, lossy WebP, Basis Universal.
pub fn is_lossy(bytes: &[u8]) -> bool {
    match format(bytes) {
        Ok(Format::Jpeg) => true,
        Ok(Format::Webp) => webp::is_lossy(bytes),
        Ok(Format::Ktx2) => ktx2::is_lossy(bytes),
        Ok(Format::Png) | Err(_) => false,
    }
}

/// What a KTX2 file with blocks of Basis Universal takes with it; none for other files.
pub(crate) fn basis_upload(bytes: &[u8]) -> Option<BasisUpload> {
    let is_ktx2 = format(bytes).is_ok_and(|f| f == Format::Ktx2);
    is_ktx2.then(|| guarded(|| Ok(ktx2::upload(bytes))).ok().flatten()).flatten()
}

fn invalid(what: impl std::fmt::Display) -> Failure {
    Failure::new(Code::InvalidImage, format!("the image cannot be decoded: {what}"))
}

fn format(bytes: &[u8]) -> Result<Format> {
    if bytes.starts_with(PNG_SIGNATURE) {
        Ok(Format::Png)
    } else if bytes.starts_with(&[0xff, 0xd8]) {
        Ok(Format::Jpeg)
    } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        Ok(Format::Webp)
    } else if bytes.starts_with(&ktx2::IDENTIFIER) {
        Ok(Format::Ktx2)
    } else if bytes.is_empty() {
        Err(invalid("the file is empty"))
    } else {
        Err(invalid("the file is neither PNG, JPEG, WebP nor KTX2"))
    }
}

/// Decoders index tables with numbers from the file: where one of them panics on a broken file, the file is at fault, and the
/// job must end in a sentence. Nothing but the result leaves the closure, so that no state can be left half changed.
fn guarded<T>(read: impl FnOnce() -> Result<T> + UnwindSafe) -> Result<T> {
    catch_unwind(read).unwrap_or_else(|_| Err(invalid("its data contradict each other")))
}

fn check_size(header: &Header, max_pixels: u64) -> Result<()> {
    if u64::from(header.width) * u64::from(header.height) > max_pixels {
        return Err(Failure::new(
            Code::TooLarge,
            format!("an image of {} x {} texels exceeds the limit of {max_pixels} texels", header.width, header.height),
        ));
    }
    Ok(())
}

fn check_sides(width: u32, height: u32) -> Result<()> {
    if width == 0 || height == 0 || width > LONGEST_SIDE || height > LONGEST_SIDE {
        return Err(invalid(format!("a size of {width} x {height} is out of range")));
    }
    Ok(())
}
