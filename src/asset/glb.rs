//! The GLB container (glTF 2.0, section 4): a header, a JSON chunk and at most one binary chunk.

use crate::error::{Code, Failure, Result, Warning};

/// First four bytes of a GLB file.
pub(crate) const MAGIC: &[u8; 4] = b"glTF";
const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;

/// The chunks of a GLB file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Chunks<'a> {
    /// Bytes of the JSON chunk, trailing spaces included.
    pub(crate) json: &'a [u8],
    /// Bytes of the binary chunk, padding included.
    pub(crate) bin: Option<&'a [u8]>,
}

/// Takes a GLB file apart. Deviations that leave no doubt about the contents are warnings.
///
/// # Errors
/// `invalid_model`: wrong magic or version, truncated, chunks out of order or too long.
pub(crate) fn parse<'a>(bytes: &'a [u8], warnings: &mut Vec<Warning>) -> Result<Chunks<'a>> {
    if bytes.get(..4) != Some(MAGIC) {
        return Err(Failure::model("the file does not begin with the GLB magic \"glTF\""));
    }
    let (Some(version), Some(length)) = (word(bytes, 4), word(bytes, 8)) else {
        let there = bytes.len();
        return Err(Failure::model(format!("the GLB header is truncated: 12 bytes are needed, {there} are there")));
    };
    if version != 2 {
        return Err(Failure::model(format!("GLB version {version} is not supported, only version 2 is")));
    }
    let (length, there) = (length as usize, bytes.len());
    let bytes = bytes.get(..length).filter(|_| length >= 12).ok_or_else(|| {
        let declared = format!("the GLB header declares {length} bytes, and the file has {there}");
        Failure::model(format!("{declared}: it is truncated or damaged"))
    })?;
    if length < there {
        let message = format!("{} bytes after the end of the GLB are ignored", there - length);
        warnings.push(Warning::new("trailing_bytes", message));
    }
    let mut chunks: (Option<&[u8]>, Option<&[u8]>) = (None, None);
    let (mut at, mut index) = (12, 0);
    while at < bytes.len() {
        let (Some(size), Some(kind)) = (word(bytes, at), word(bytes, at + 4)) else {
            return Err(Failure::model(format!("the header of GLB chunk {index} is truncated")));
        };
        let start = at + 8;
        let body = start.checked_add(size as usize).and_then(|end| bytes.get(start..end)).ok_or_else(|| {
            let left = bytes.len() - start;
            Failure::model(format!("GLB chunk {index} declares {size} bytes, and {left} are left in the file"))
        })?;
        if size % 4 != 0 {
            let message = format!("the length of GLB chunk {index}, {size}, is not a multiple of 4");
            warnings.push(Warning::new("misaligned_chunk", message));
        }
        match (index, kind) {
            (0, JSON) => chunks.0 = Some(body),
            (0, _) => return Err(Failure::model("the first GLB chunk is not the JSON chunk")),
            (1, BIN) => chunks.1 = Some(body),
            (_, JSON | BIN) => {
                let message = format!("GLB chunk {index} is out of order: JSON is first, BIN second, once each");
                return Err(Failure::model(message));
            }
            _ => {
                let message = format!("GLB chunk {index} of unknown type {kind:#010x} is dropped");
                warnings.push(Warning::new("unknown_chunk", message));
            }
        }
        at = start + body.len();
        index += 1;
    }
    let json = chunks.0.ok_or_else(|| Failure::model("the GLB has no JSON chunk"))?;
    Ok(Chunks { json, bin: chunks.1 })
}

/// Puts a GLB file together, whose length is a multiple of `alignment` (4 or more of it); JSON is padded with spaces, the binary chunk with
/// zeros, and left out where empty.
///
/// # Errors
/// `too_large` when it would not fit in the 4 GiB that the header can declare.
pub(crate) fn build(mut json: Vec<u8>, bin: &[u8], alignment: usize) -> Result<Vec<u8>> {
    let padded = bin.len().next_multiple_of(4);
    let chunk = if bin.is_empty() { 0 } else { 8 + padded };
    let total = (20 + json.len() + chunk).next_multiple_of(alignment.max(4));
    json.resize(total - 20 - chunk, b' ');
    let too_large =
        |_| Failure::new(Code::TooLarge, format!("the model takes {total} bytes, and a GLB holds at most 4 GiB"));
    let length = u32::try_from(total).map_err(too_large)?;
    let mut out = Vec::with_capacity(total);
    out.extend_from_slice(MAGIC);
    for value in [2, length, json.len() as u32, JSON] {
        out.extend_from_slice(&value.to_le_bytes());
    }
    out.append(&mut json);
    if !bin.is_empty() {
        out.extend_from_slice(&(padded as u32).to_le_bytes());
        out.extend_from_slice(&BIN.to_le_bytes());
        out.extend_from_slice(bin);
        out.resize(total, 0);
    }
    Ok(out)
}

/// Four bytes as a number.
pub(crate) fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk::<4>().map(|w| u32::from_le_bytes(*w))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(bytes: &[u8]) -> String {
        let failure = parse(bytes, &mut Vec::new()).unwrap_err();
        assert_eq!(failure.code, Code::InvalidModel);
        failure.message
    }

    #[test]
    fn what_is_built_is_read() {
        let glb = build(b"{}".to_vec(), &[1, 2, 3], 4).unwrap();
        let mut warnings = Vec::new();
        let chunks = parse(&glb, &mut warnings).unwrap();
        assert_eq!(chunks, Chunks { json: b"{}  ", bin: Some(&[1, 2, 3, 0]) });
        assert!(warnings.is_empty());
        let glb = build(b"{}".to_vec(), &[], 4).unwrap();
        assert_eq!(parse(&glb, &mut warnings).unwrap().bin, None);
        let glb = build(b"{}".to_vec(), &[1, 2, 3], 8).unwrap();
        let chunks = parse(&glb, &mut warnings).unwrap();
        assert_eq!((glb.len() % 8, chunks), (0, Chunks { json: b"{}      ", bin: Some(&[1, 2, 3, 0]) }));
    }

    #[test]
    fn every_truncation_is_refused() {
        let glb = build(b"{}".to_vec(), &[1, 2, 3], 4).unwrap();
        for end in 0..glb.len() {
            message(&glb[..end]);
        }
    }

    #[test]
    fn damage_is_named() {
        let glb = build(b"{}".to_vec(), &[1, 2, 3], 4).unwrap();
        let with = |at: usize, value: u32| {
            let mut bytes = glb.clone();
            bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            bytes
        };
        assert!(message(&with(0, 0)).contains("magic"));
        assert!(message(&with(4, 1)).contains("version 1"));
        assert!(message(&with(8, 4000)).contains("4000"));
        assert!(message(&with(8, 3)).contains("3 bytes"));
        assert!(message(&with(12, u32::MAX)).contains("chunk 0"));
        assert!(message(&with(16, BIN)).contains("JSON"));
        assert!(message(&with(28, JSON)).contains("out of order"));
        let mut warnings = Vec::new();
        let mut long = glb.clone();
        long.push(0);
        parse(&long, &mut warnings).unwrap();
        assert_eq!(warnings[0].code, "trailing_bytes");
        parse(&with(28, 7), &mut warnings).unwrap();
        assert_eq!(warnings[1].code, "unknown_chunk");
    }
}
