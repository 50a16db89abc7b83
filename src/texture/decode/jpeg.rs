//! JPEG: baseline and progressive, grey, YCbCr, RGB, and inverted CMYK and YCCK as Adobe writes them.

use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

use super::{LONGEST_SIDE, check_sides, invalid, sample_count};
use crate::error::Result;
use crate::texture::{Format, Header, Image, Samples};

/// Scans that a file may have: each of them visits the whole picture, however few bytes it holds.
const SCANS: usize = 500;

pub(super) fn header(bytes: &[u8]) -> Result<Header> {
    Ok(decoder(bytes, None)?.1)
}

type Decoder<'a> = JpegDecoder<ZCursor<&'a [u8]>>;

/// A decoder whose headers are read. `out` is the colour space to decode to; the grey or RGB that the file holds when not given.
fn decoder(bytes: &[u8], out: Option<ColorSpace>) -> Result<(Decoder<'_>, Header)> {
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

pub(super) fn decode(bytes: &[u8], max_pixels: u64) -> Result<Image> {
    let header = header(bytes)?;
    let samples = sample_count(&header, max_pixels)?;
    match scans(bytes) {
        None => return Err(invalid("the file ends before the picture does")),
        Some(scans) if scans > SCANS => return Err(invalid(format!("it has more than {SCANS} scans"))),
        Some(_) => {}
    }
    let space = if header.channels == 1 { ColorSpace::Luma } else { ColorSpace::RGB };
    let (mut decoder, _) = decoder(bytes, Some(space))?;
    let buffer = decoder.decode().map_err(|e| invalid(format!("{e:?}")))?;
    if buffer.len() != samples {
        return Err(invalid("its data does not fill the image"));
    }
    Ok(Image { width: header.width, height: header.height, channels: header.channels, samples: Samples::U8(buffer) })
}

/// The number of scans of a file whose segments follow each other up to the end-of-image marker (ITU T.81, annex B); none where
/// that or every scan is missing. The decoder itself paints what is missing grey.
fn scans(bytes: &[u8]) -> Option<usize> {
    let mut at = 2;
    let mut scans = 0;
    loop {
        // To the next marker: fill bytes, stuffed zeros and restarts belong to what comes before.
        at += bytes.get(at..)?.windows(2).position(|w| is_marker(w[0], w[1]))? + 2;
        match bytes[at - 1] {
            0xd9 => return (scans > 0).then_some(scans),
            0xd8 | 0x01 => continue,
            marker => {
                let length = bytes.get(at..at + 2).map(|b| usize::from(u16::from_be_bytes([b[0], b[1]])))?;
                scans += usize::from(marker == 0xda);
                at += length.max(2);
            }
        }
    }
}

fn is_marker(first: u8, second: u8) -> bool {
    first == 0xff && second != 0 && second != 0xff && !(0xd0..=0xd7).contains(&second)
}
