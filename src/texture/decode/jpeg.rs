//! JPEG: what must be known of a file's segments before it is decoded.

use super::invalid;
use crate::error::Result;

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
