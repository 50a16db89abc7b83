//! PNG: every colour type, depth and interlacing.

use std::io::Cursor;

use png::{BitDepth, ColorType, Decoder, Limits, Reader, Transformations};

use super::{check_sides, invalid, sample_count};
use crate::error::Result;
use crate::texture::{Format, Header, Image, Samples};

/// First bytes of every PNG file.
pub(super) const SIGNATURE: [u8; 8] = [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a];
/// Memory that the decoder may take beside the image itself (rows, palette, profiles), in bytes.
const OVERHEAD: usize = 64 << 20;

pub(super) fn header(bytes: &[u8]) -> Result<Header> {
    Ok(reader(bytes)?.1)
}

fn reader(bytes: &[u8]) -> Result<(Reader<Cursor<&[u8]>>, Header)> {
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), Limits { bytes: OVERHEAD });
    decoder.set_transformations(Transformations::EXPAND);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let info = decoder.read_header_info().map_err(invalid)?;
    check_sides(info.width, info.height)?;
    let reader = decoder.read_info().map_err(invalid)?;
    let (colour, depth) = reader.output_color_type();
    let channels = match colour {
        ColorType::Grayscale => 1,
        ColorType::GrayscaleAlpha => 2,
        ColorType::Rgb => 3,
        ColorType::Rgba => 4,
        ColorType::Indexed => return Err(invalid("its palette is missing")),
    };
    let depth = if depth == BitDepth::Sixteen { 16 } else { 8 };
    let (width, height) = reader.info().size();
    Ok((reader, Header { width, height, channels, depth, format: Format::Png }))
}

pub(super) fn decode(bytes: &[u8], max_pixels: u64) -> Result<Image> {
    let (mut reader, header) = reader(bytes)?;
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
