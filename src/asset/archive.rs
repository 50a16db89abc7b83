//! Zip archives as input: bounded, whatever their headers declare.

use std::borrow::Cow;
use std::io::{BufRead, BufReader, Cursor, Read};

use super::name::from_bytes;
use super::upload::UploadEntry;
use super::uri::{file_name, normalise, quote};
use crate::error::{Code, Failure, Result};

/// Most entries that an archive may have.
pub const MAX_ENTRIES: usize = 10_000;

/// Whether the bytes begin as a zip archive does.
pub(crate) fn is_zip(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"PK\x05\x06")
}

/// Unpacks an archive. `left` is how many bytes may still be unpacked, and falls by what was.
///
/// # Errors
/// `invalid_model` when the archive is damaged, encrypted or names paths outside itself; `too_large` beyond `left` bytes or
/// 10,000 entries.
pub(crate) fn unpack(path: &str, bytes: &[u8], left: &mut u64) -> Result<Vec<UploadEntry<'static>>> {
    let damaged = |what: String| Failure::model(format!("the archive {} cannot be read: {what}", quote(path)));
    check_entries(path, bytes)?;
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes)).map_err(|e| damaged(e.to_string()))?;
    let mut entries = Vec::new();
    for index in 0..archive.len() {
        let mut file = archive.by_index(index).map_err(|e| damaged(e.to_string()))?;
        let name = from_bytes(file.name_raw());
        if file.is_dir() || name.ends_with('/') || is_litter(&name) {
            continue;
        }
        let clean = normalise(&name).filter(|_| !name.starts_with(['/', '\\'])).ok_or_else(|| {
            Failure::model(format!("the entry {} of the archive {} leaves its folder", quote(&name), quote(path)))
        })?;
        // Nothing is unpacked of what says itself that it is too much; a smaller size is not believed.
        if file.size() > *left {
            return Err(too_much(path));
        }
        let mut bytes = Vec::new();
        let cap = left.saturating_add(1);
        Read::by_ref(&mut file)
            .take(cap)
            .read_to_end(&mut bytes)
            .map_err(|e| damaged(format!("{}: {e}", quote(&name))))?;
        *left = left.checked_sub(bytes.len() as u64).ok_or_else(|| too_much(path))?;
        entries.push(UploadEntry { path: clean, bytes: Cow::Owned(bytes) });
    }
    Ok(entries)
}

/// The failure of an archive that unpacks to more than the limit. `path` is what it is called.
pub(crate) fn too_much(path: &str) -> Failure {
    Failure::new(Code::TooLarge, format!("the archive {} unpacks to more than the limit on the input", quote(path)))
}

/// What operating systems leave in archives.
pub(crate) fn is_litter(name: &str) -> bool {
    name.starts_with("__MACOSX/") || file_name(name).starts_with('.')
}

/// Refuses an archive of more than 10,000 entries before it is opened, so that a directory of millions is not built first.
/// What its end records declare is not believed, and there may be several: an entry of the directory begins with a
/// signature of its own, and those are counted. `path` is what the archive is called.
///
/// # Errors
/// `too_large`; `internal` when the disk fails.
pub(crate) fn check_entries(path: &str, archive: impl Read) -> Result<()> {
    const SIGNATURE: &[u8; 4] = b"PK\x01\x02";
    let mut archive = BufReader::with_capacity(1 << 16, archive);
    let (mut count, mut matched) = (0, 0);
    loop {
        let chunk = archive.fill_buf().map_err(|e| Failure::internal(format!("{}: {e}", quote(path))))?;
        if chunk.is_empty() {
            return Ok(());
        }
        for byte in chunk {
            matched = if *byte == SIGNATURE[matched] { matched + 1 } else { usize::from(*byte == SIGNATURE[0]) };
            if matched == SIGNATURE.len() {
                (count, matched) = (count + 1, 0);
            }
        }
        if count > MAX_ENTRIES {
            let message = format!("the archive {} has more than {MAX_ENTRIES} entries", quote(path));
            return Err(Failure::new(Code::TooLarge, message));
        }
        let length = chunk.len();
        archive.consume(length);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn archive(files: &[(&str, &[u8])]) -> Vec<u8> {
        let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
        for (name, bytes) in files {
            writer.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
            writer.write_all(bytes).unwrap();
        }
        writer.finish().unwrap().into_inner()
    }

    #[test]
    fn files_come_out_without_litter() {
        let zip = archive(&[("a/b.txt", b"hello"), ("__MACOSX/a", b"x"), ("a/.DS_Store", b"x")]);
        let mut left = 100;
        let entries = unpack("a.zip", &zip, &mut left).unwrap();
        assert_eq!(
            (entries.len(), entries[0].path.as_str(), &*entries[0].bytes, left),
            (1, "a/b.txt", &b"hello"[..], 95)
        );
    }

    #[test]
    fn bombs_and_climbers_are_refused() {
        let zip = archive(&[("zeros", &vec![0; 1 << 20])]);
        assert!(zip.len() < 10_000);
        assert_eq!(unpack("a.zip", &zip, &mut 1000).unwrap_err().code, Code::TooLarge);
        // One that declares less is damaged, if not too large.
        let declared = (1u32 << 20).to_le_bytes();
        let mut modest = zip.clone();
        for at in (0..zip.len() - 4).filter(|at| zip[*at..at + 4] == declared) {
            modest[at..at + 4].copy_from_slice(&7u32.to_le_bytes());
        }
        assert_ne!(modest, zip);
        assert!(unpack("a.zip", &modest, &mut 1000).is_err());
        let zip = archive(&[("../x", b"x")]);
        assert_eq!(unpack("a.zip", &zip, &mut 1000).unwrap_err().code, Code::InvalidModel);
        let names: Vec<String> = (0..10_001).map(|i| i.to_string()).collect();
        let files: Vec<(&str, &[u8])> = names.iter().map(|n| (n.as_str(), &b""[..])).collect();
        assert_eq!(unpack("a.zip", &archive(&files), &mut 1000).unwrap_err().code, Code::TooLarge);
    }

    #[test]
    fn truncations_do_not_panic() {
        let zip = archive(&[("a.txt", b"hello hello hello")]);
        for end in 0..zip.len() {
            assert!(unpack("a.zip", &zip[..end], &mut 1000).is_err(), "{end}");
        }
    }
}
