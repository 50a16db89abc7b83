//! Image files in: PNG and JPEG, bounded by their header before anything is allocated.

use std::io::Cursor;

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use super::{Format, Header, Image, Samples};
use crate::error::{Code, Failure, Result};

/// First bytes of every PNG file.
const PNG_SIGNATURE: [u8; 8] = [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a];
/// Longest side that a header may declare, in texels.
const LONGEST_SIDE: u32 = 65_535;
/// Memory that the PNG decoder may take beside the image itself (rows, palette, profiles), in bytes.
const PNG_OVERHEAD: usize = 64 << 20;

/// Reads what an image file says of itself; nothing is decoded.
///
/// Fails with `invalid_image` when the file is neither PNG nor JPEG or its header is broken.
pub fn header(bytes: &[u8]) -> Result<Header> {
    match format(bytes)? {
        Format::Png => Ok(png_reader(bytes)?.1),
        Format::Jpeg => Ok(jpeg_decoder(bytes, None)?.1),
    }
}

/// Decodes an image file of at most `max_pixels` texels, at its own depth. Palettes and depths under 8 bits become
/// 8 bits a channel, CMYK becomes RGB; colour profiles and gamma chunks are ignored, as glTF asks.
///
/// Fails with `too_large` beyond `max_pixels` (before any allocation), with `invalid_image` when the file is broken
/// or ends too early.
pub fn decode(bytes: &[u8], max_pixels: u64) -> Result<Image> {
    match format(bytes)? {
        Format::Png => decode_png(bytes, max_pixels),
        Format::Jpeg => decode_jpeg(bytes, max_pixels),
    }
}

fn invalid(what: impl std::fmt::Display) -> Failure {
    Failure::new(Code::InvalidImage, format!("the image cannot be decoded: {what}"))
}

fn format(bytes: &[u8]) -> Result<Format> {
    if bytes.starts_with(&PNG_SIGNATURE) {
        Ok(Format::Png)
    } else if bytes.starts_with(&[0xff, 0xd8]) {
        Ok(Format::Jpeg)
    } else if bytes.is_empty() {
        Err(invalid("the file is empty"))
    } else {
        Err(invalid("the file is neither PNG nor JPEG"))
    }
}

/// Number of samples of an image that may be decoded.
fn sample_count(header: &Header, max_pixels: u64) -> Result<usize> {
    let pixels = u64::from(header.width) * u64::from(header.height);
    if pixels > max_pixels {
        return Err(Failure::new(
            Code::TooLarge,
            format!("an image of {} x {} texels exceeds the limit of {max_pixels} texels", header.width, header.height),
        ));
    }
    pixels
        .checked_mul(u64::from(header.channels))
        .and_then(|n| usize::try_from(n).ok())
        .filter(|n| *n <= isize::MAX as usize / 2)
        .ok_or_else(|| invalid("its size is out of range"))
}

fn check_sides(width: u32, height: u32) -> Result<()> {
    if width == 0 || height == 0 || width > LONGEST_SIDE || height > LONGEST_SIDE {
        return Err(invalid(format!("a size of {width} x {height} is out of range")));
    }
    Ok(())
}

type PngReader<'a> = png::Reader<Cursor<&'a [u8]>>;

fn png_reader(bytes: &[u8]) -> Result<(PngReader<'_>, Header)> {
    let limits = png::Limits { bytes: PNG_OVERHEAD };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(png::Transformations::EXPAND);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let info = decoder.read_header_info().map_err(invalid)?;
    check_sides(info.width, info.height)?;
    let reader = decoder.read_info().map_err(invalid)?;
    let (colour, depth) = reader.output_color_type();
    let channels = match colour {
        png::ColorType::Grayscale => 1,
        png::ColorType::GrayscaleAlpha => 2,
        png::ColorType::Rgb => 3,
        png::ColorType::Rgba => 4,
        png::ColorType::Indexed => return Err(invalid("its palette is missing")),
    };
    let depth = if depth == png::BitDepth::Sixteen { 16 } else { 8 };
    let (width, height) = reader.info().size();
    Ok((reader, Header { width, height, channels, depth, format: Format::Png }))
}

fn decode_png(bytes: &[u8], max_pixels: u64) -> Result<Image> {
    let (mut reader, header) = png_reader(bytes)?;
    let samples = sample_count(&header, max_pixels)?;
    let size = samples * usize::from(header.depth / 8);
    if reader.output_buffer_size() != Some(size) {
        return Err(invalid("its size is out of range"));
    }
    let mut buffer = vec![0; size];
    let frame = reader.next_frame(&mut buffer).map_err(invalid)?;
    if (frame.width, frame.height) != (header.width, header.height) {
        return Err(invalid("its first frame does not fill the image"));
    }
    let samples = if header.depth == 16 {
        Samples::U16(buffer.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect())
    } else {
        Samples::U8(buffer)
    };
    Ok(Image { width: header.width, height: header.height, channels: header.channels, samples })
}

type JpegReader<'a> = JpegDecoder<ZCursor<&'a [u8]>>;

/// A decoder whose headers are read. `out` is the colour space to decode to; the grey or RGB that the file holds when not given.
fn jpeg_decoder(bytes: &[u8], out: Option<ColorSpace>) -> Result<(JpegReader<'_>, Header)> {
    let side = LONGEST_SIDE as usize;
    let mut options = DecoderOptions::default().set_max_width(side).set_max_height(side).set_strict_mode(false);
    if let Some(space) = out {
        options = options.jpeg_set_out_colorspace(space);
    }
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| invalid(format!("{e:?}")))?;
    let (width, height) = decoder.dimensions().ok_or_else(|| invalid("it has no frame"))?;
    let (width, height) = (width as u32, height as u32);
    check_sides(width, height)?;
    let channels = if decoder.input_colorspace() == Some(ColorSpace::Luma) { 1 } else { 3 };
    Ok((decoder, Header { width, height, channels, depth: 8, format: Format::Jpeg }))
}

fn decode_jpeg(bytes: &[u8], max_pixels: u64) -> Result<Image> {
    let header = jpeg_decoder(bytes, None)?.1;
    let samples = sample_count(&header, max_pixels)?;
    if !jpeg_is_complete(bytes) {
        return Err(invalid("the file ends before the picture does"));
    }
    let space = if header.channels == 1 { ColorSpace::Luma } else { ColorSpace::RGB };
    let (mut decoder, _) = jpeg_decoder(bytes, Some(space))?;
    let buffer = decoder.decode().map_err(|e| invalid(format!("{e:?}")))?;
    if buffer.len() != samples {
        return Err(invalid("its data does not fill the image"));
    }
    Ok(Image { width: header.width, height: header.height, channels: header.channels, samples: Samples::U8(buffer) })
}

/// Whether the segments of a JPEG file follow each other up to the end-of-image marker, after at least one scan
/// (ITU T.81, annex B). The decoder itself paints what is missing grey.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    let mut scans = 0;
    loop {
        // To the next marker: fill bytes, stuffed zeros and restarts belong to what comes before.
        let Some(found) = bytes.get(at..).and_then(|rest| rest.windows(2).position(|w| is_marker(w[0], w[1]))) else {
            return false;
        };
        at += found + 2;
        match bytes[at - 1] {
            0xd9 => return scans > 0,
            0xd8 | 0x01 => continue,
            marker => {
                let Some(length) = bytes.get(at..at + 2).map(|b| usize::from(u16::from_be_bytes([b[0], b[1]]))) else {
                    return false;
                };
                scans += usize::from(marker == 0xda);
                at += length.max(2);
            }
        }
    }
}

fn is_marker(first: u8, second: u8) -> bool {
    first == 0xff && second != 0 && second != 0xff && !(0xd0..=0xd7).contains(&second)
}

#[cfg(test)]
mod tests {
    use super::super::encode::tests::picture;
    use super::*;
    use crate::texture::encode;

    #[test]
    fn palettes_low_depths_and_transparency_are_expanded() {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, 3, 1);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Two);
        encoder.set_palette(vec![1, 2, 3, 40, 50, 60, 7, 8, 9]);
        encoder.set_trns(vec![255, 128]);
        encoder.write_header().unwrap().write_image_data(&[0b00_01_10_00]).unwrap();
        let expected = Header { width: 3, height: 1, channels: 4, depth: 8, format: Format::Png };
        assert_eq!(header(&file).unwrap(), expected);
        let image = decode(&file, 3).unwrap();
        assert_eq!(image.samples, Samples::U8(vec![1, 2, 3, 255, 40, 50, 60, 128, 7, 8, 9, 255]));
    }

    #[test]
    fn a_bomb_is_refused_by_its_header() {
        let mut file = encode(&picture(64, 64, 3, false), Format::Png, 90).unwrap();
        assert_eq!(decode(&file, 64 * 64 - 1).unwrap_err().code, Code::TooLarge);
        // 60000 x 60000 texels declared by the same few bytes.
        file[16..24].copy_from_slice(&[0, 0, 0xea, 0x60, 0, 0, 0xea, 0x60]);
        let crc = crc32(&file[12..29]);
        file[29..33].copy_from_slice(&crc.to_be_bytes());
        assert_eq!(header(&file).unwrap().width, 60_000);
        assert_eq!(decode(&file, 1 << 28).unwrap_err().code, Code::TooLarge);
        file[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
        let crc = crc32(&file[12..29]);
        file[29..33].copy_from_slice(&crc.to_be_bytes());
        assert_eq!(header(&file).unwrap_err().code, Code::InvalidImage);
    }

    #[test]
    fn every_truncation_and_many_mutations_end_in_a_sentence() {
        for format in [Format::Png, Format::Jpeg] {
            let file = encode(&picture(40, 24, 3, false), format, 90).unwrap();
            let needed = if format == Format::Png { file.len() - 16 } else { file.len() - 1 };
            for length in 0..needed {
                let failure = decode(&file[..length], 1 << 20).unwrap_err();
                assert_eq!(failure.code, Code::InvalidImage, "{format:?} cut to {length}");
            }
            for at in 0..file.len() {
                for bit in [1, 0x10, 0x80] {
                    let mut broken = file.clone();
                    broken[at] ^= bit;
                    if let Err(failure) = decode(&broken, 1 << 20) {
                        assert!(matches!(failure.code, Code::InvalidImage | Code::TooLarge));
                    }
                }
            }
        }
        assert_eq!(header(b"").unwrap_err().code, Code::InvalidImage);
        assert_eq!(header(b"GIF89a").unwrap_err().code, Code::InvalidImage);
    }

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0u32, |crc, b| {
            (0..8).fold(crc ^ u32::from(*b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
        })
    }
}
