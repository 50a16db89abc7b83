//! JPEG: what must be known of a file's segments before it is decoded.

use super::invalid;
use crate::error::Result;
use crate::texture::jpeg::{JpegCoding, ZIGZAG, finer_table};

/// Scans that a file may have: each of them visits the whole picture, however few bytes it holds.
const SCANS: usize = 500;

/// Refuses a file that ends before its picture does, or has too many scans.
pub(super) fn check_scans(bytes: &[u8]) -> Result<()> {
    match scans(bytes) {
        None => Err(invalid("the file ends before the picture does")),
        Some(scans) if scans > SCANS => Err(invalid(format!("it has more than {SCANS} scans"))),
        Some(_) => Ok(()),
    }
}

/// The number of scans of a file whose segments follow each other up to the end-of-image marker (ITU T.81, annex B); none where
/// that or every scan is missing. The decoder itself paints what is missing grey.
fn scans(bytes: &[u8]) -> Option<usize> {
    let mut scans = 0;
    for (marker, _) in Segments::of(bytes) {
        match marker {
            END_OF_IMAGE => return (scans > 0).then_some(scans),
            START_OF_SCAN => scans += 1,
            _ => {}
        }
    }
    None
}

const END_OF_IMAGE: u8 = 0xd9;
const START_OF_SCAN: u8 = 0xda;
const QUANTIZATION_TABLES: u8 = 0xdb;
/// Frames that decoders know: baseline, extended, progressive.
const FRAMES: [u8; 3] = [0xc0, 0xc1, PROGRESSIVE];
const PROGRESSIVE: u8 = 0xc2;

/// How a JPEG file was encoded, from its quantisation tables and its frame header (ITU T.81, B.2.4.1 and B.2.2). None where one of the
/// two is missing or makes no sense, or where its samples have other than 8 bits.
pub(crate) fn coding(bytes: &[u8]) -> Option<JpegCoding> {
    let mut tables: [Option<[u16; 64]>; 4] = [None; 4];
    let mut frame = None;
    for (marker, payload) in Segments::of(bytes) {
        match marker {
            QUANTIZATION_TABLES => read_tables(payload, &mut tables)?,
            _ if FRAMES.contains(&marker) && frame.is_none() => frame = Some((marker, payload)),
            START_OF_SCAN => break,
            _ => {}
        }
    }
    let (marker, frame) = frame?;
    let (depth, count) = (*frame.first()?, usize::from(*frame.get(5)?));
    let components: Vec<&[u8]> = frame.get(6..6 + 3 * count)?.chunks_exact(3).collect();
    if depth != 8 || ![1, 3, 4].contains(&count) {
        return None;
    }
    let table = |component: &&[u8]| tables.get(usize::from(component[2])).copied().flatten();
    let factors = |component: &&[u8]| [component[1] >> 4, component[1] & 15];
    let luma = table(components.first()?)?;
    let (mut chroma, mut sampling) = (luma, [1, 1]);
    if count > 1 {
        chroma = finer_table(table(&components[1])?, table(&components[2])?);
        let (whole, part) = (factors(&components[0]), factors(&components[1]));
        let ratio = |k: usize| {
            Some(whole[k] / part[k]).filter(|ratio| [1, 2, 4].contains(ratio) && ratio * part[k] == whole[k])
        };
        if part.iter().all(|n| *n > 0) && factors(&components[2]) == part && count == 3 {
            let ratios = [ratio(0).unwrap_or(1), ratio(1).unwrap_or(1)];
            // Ten blocks are the most that a scan of all components holds together (B.2.3).
            sampling = if ratios[0] * ratios[1] <= 8 { ratios } else { [1, 1] };
        }
    }
    Some(JpegCoding { tables: Box::new([luma, chroma]), sampling, progressive: marker == PROGRESSIVE, decoded: true })
}

/// Reads the tables of a DQT segment, which stand in zigzag order, into natural order.
fn read_tables(mut payload: &[u8], tables: &mut [Option<[u16; 64]>; 4]) -> Option<()> {
    while let Some((head, rest)) = payload.split_first() {
        let (wide, id) = (head >> 4 == 1, usize::from(head & 15));
        let values = rest.get(..if wide { 128 } else { 64 })?;
        let mut table = [0; 64];
        for (k, place) in ZIGZAG.iter().enumerate() {
            let value =
                if wide { u16::from_be_bytes([values[2 * k], values[2 * k + 1]]) } else { u16::from(values[k]) };
            // Baseline files hold bytes; a finer step loses nothing.
            table[usize::from(*place)] = value.clamp(1, 255);
        }
        *tables.get_mut(id)? = Some(table);
        payload = &rest[values.len()..];
    }
    Some(())
}

/// The segments of a file: markers and what follows their length. Ends where the file does.
struct Segments<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Segments<'a> {
    fn of(bytes: &'a [u8]) -> Self {
        Segments { bytes, at: 2 }
    }
}

impl<'a> Iterator for Segments<'a> {
    type Item = (u8, &'a [u8]);

    fn next(&mut self) -> Option<(u8, &'a [u8])> {
        loop {
            // To the next marker: fill bytes, stuffed zeros and restarts belong to what comes before.
            self.at += self.bytes.get(self.at..)?.windows(2).position(|w| is_marker(w[0], w[1]))? + 2;
            match self.bytes[self.at - 1] {
                0xd8 | 0x01 => {}
                END_OF_IMAGE => return Some((END_OF_IMAGE, &[])),
                marker => {
                    let length = self.bytes.get(self.at..self.at + 2)?;
                    let length = usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
                    let payload = self.bytes.get(self.at + 2..(self.at + length).min(self.bytes.len()));
                    self.at += length;
                    return Some((marker, payload.unwrap_or_default()));
                }
            }
        }
    }
}

fn is_marker(first: u8, second: u8) -> bool {
    first == 0xff && second != 0 && second != 0xff && !(0xd0..=0xd7).contains(&second)
}
