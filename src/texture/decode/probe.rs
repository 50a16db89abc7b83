//! What an image will be once decoded, from its first bytes alone: the rest of the file need not be at hand.

use std::io::{self, Read};

use super::{check_sides, format};
use crate::texture::{Format, Header};

/// Bytes with which every format but JPEG tells its size: the signature of a PNG and its first chunk are the most.
const HEAD: usize = 33;

/// Reads the head of an image file: JPEG up to its frame, PNG up to its data, of the others 33 bytes. Where that does not tell channels
/// and depth, they are the most that there may be. Nothing is checked but the size, so that [`header`](super::header) may still refuse the file.
/// None where the head tells no size.
pub fn probe(mut file: impl Read) -> Option<Header> {
    let mut head = Vec::with_capacity(HEAD);
    (&mut file).take(HEAD as u64).read_to_end(&mut head).ok()?;
    let format = format(&head).ok()?;
    let (size, channels, depth) = match format {
        Format::Png => png(&head, file)?,
        Format::Webp => (webp(&head)?, 4, 8),
        Format::Ktx2 => {
            let deep = matches!(little(&head, 12)?, 70 | 77 | 84 | 91);
            ([little(&head, 20)?, little(&head, 24)?], 4, if deep { 16 } else { 8 })
        }
        Format::Jpeg => {
            let (size, channels) = jpeg(head.get(2..)?.chain(file))?;
            (size, channels, 8)
        }
    };
    check_sides(size[0], size[1]).ok()?;
    Some(Header { width: size[0], height: size[1], channels, depth, format })
}

/// IHDR comes first (PNG, 5.6); a transparent colour, which becomes alpha, stands somewhere between it and the first IDAT.
fn png(head: &[u8], file: impl Read) -> Option<([u32; 2], u8, u8)> {
    let big = |at: usize| head.get(at..at + 4)?.try_into().ok().map(u32::from_be_bytes);
    let (depth, colour) = (*head.get(24)?, *head.get(25)?);
    let channels = match colour {
        0 => 1 + u8::from(is_transparent(head, file)),
        2 => 3 + u8::from(is_transparent(head, file)),
        4 => 2,
        _ => 4,
    };
    Some(([big(16)?, big(20)?], channels, if depth == 16 { 16 } else { 8 }))
}

fn is_transparent(head: &[u8], file: impl Read) -> bool {
    // After the signature, IHDR and its checksum.
    let mut file = head.get(33..).unwrap_or_default().chain(file);
    loop {
        let mut chunk = [0; 8];
        if file.read_exact(&mut chunk).is_err() || chunk.ends_with(b"IDAT") {
            return false;
        }
        if chunk.ends_with(b"tRNS") {
            return true;
        }
        let length = u64::from(u32::from_be_bytes([chunk[0], chunk[1], chunk[2], chunk[3]]));
        let _ = io::copy(&mut (&mut file).take(length + 4), &mut io::sink());
    }
}

/// The first chunk tells the size of the picture or of its canvas (RFC 9649, 2.5 to 2.7).
fn webp(head: &[u8]) -> Option<[u32; 2]> {
    match head.get(12..16)? {
        b"VP8X" => {
            let side = |at: usize| little(head, at).map(|w| (w & 0xff_ffff) + 1);
            Some([side(24)?, side(27)?])
        }
        b"VP8L" => little(head, 21).map(|bits| [1 + (bits & 0x3fff), 1 + (bits >> 14 & 0x3fff)]),
        b"VP8 " => little(head, 26).map(|bits| [bits & 0x3fff, bits >> 16 & 0x3fff]),
        _ => None,
    }
}

/// From the first marker to the frame header (ITU T.81, B.2.2); the segments between are skipped.
fn jpeg(mut file: impl Read) -> Option<([u32; 2], u8)> {
    loop {
        if byte(&mut file)? != 0xff {
            continue;
        }
        let marker = loop {
            match byte(&mut file)? {
                0xff => {}
                other => break other,
            }
        };
        match marker {
            // Stuffed zeros, restarts and a second start have no length.
            0 | 1 | 0xd0..=0xd8 => {}
            // The picture begins or ends without a frame.
            0xd9 | 0xda => return None,
            0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                let mut frame = [0; 8];
                file.read_exact(&mut frame).ok()?;
                let side = |at: usize| u32::from(u16::from_be_bytes([frame[at], frame[at + 1]]));
                return Some(([side(5), side(3)], if frame[7] == 1 { 1 } else { 3 }));
            }
            _ => {
                let length = u64::from(u16::from_be_bytes([byte(&mut file)?, byte(&mut file)?]));
                io::copy(&mut (&mut file).take(length.saturating_sub(2)), &mut io::sink()).ok()?;
            }
        }
    }
}

fn byte(file: &mut impl Read) -> Option<u8> {
    let mut one = [0];
    file.read_exact(&mut one).ok()?;
    Some(one[0])
}

fn little(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at.checked_add(4)?)?.try_into().ok().map(u32::from_le_bytes)
}
