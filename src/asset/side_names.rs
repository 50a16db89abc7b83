//! What images are, and the names of their files beside a glTF document.

use std::collections::BTreeMap;

use super::uri;
use crate::texture::Format;

/// The format that a URI tells: by its media type, or by its extension.
fn format_by_name(name: &str) -> Option<Format> {
    if !uri::is_data(name) {
        return Format::of_extension(&uri::extension(name));
    }
    let media_type = name.split([';', ',']).next().unwrap_or_default();
    Format::of_extension(&media_type.rsplit('/').next().unwrap_or_default().to_ascii_lowercase())
}

/// The media type that a URI tells.
pub(crate) fn by_name(name: &str) -> Option<&'static str> {
    format_by_name(name).map(Format::media_type)
}

/// The format that the first bytes of an image tell, as few as there may be of a damaged one.
fn format(bytes: &[u8]) -> Option<Format> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => Some(Format::Png),
        [0xFF, 0xD8, 0xFF, ..] => Some(Format::Jpeg),
        [0xAB, b'K', b'T', b'X', b' ', b'2', b'0', ..] => Some(Format::Ktx2),
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Some(Format::Webp),
        _ => None,
    }
}

/// The media type that the first bytes of an image tell.
pub(crate) fn media_type(bytes: &[u8]) -> Option<&'static str> {
    format(bytes).map(Format::media_type)
}

/// The names of side files, each given once whichever case a file system sees.
pub(crate) struct Names<'a> {
    /// Contents by name in lower case; none for the documents themselves and their buffers.
    taken: BTreeMap<String, Option<&'a [u8]>>,
}

impl<'a> Names<'a> {
    /// Names beside documents that take `stems` with `.gltf` and `.bin`.
    pub(crate) fn beside(stems: impl Iterator<Item = String>) -> Self {
        let own = stems.flat_map(|s| [format!("{s}.gltf"), format!("{s}.bin")]);
        Names { taken: own.map(|name| (name.to_lowercase(), None)).collect() }
    }

    /// A name for an image's file, and whether the file is yet to be written: images of one file share it, in whichever
    /// document they are. `index` of `count` images makes a name where none is wanted, or another has it.
    pub(crate) fn find(
        &mut self,
        wanted: Option<String>,
        (index, count): (usize, usize),
        bytes: &'a [u8],
    ) -> (String, bool) {
        let format = format(bytes);
        let extension = format.map_or("", Format::extension);
        let wanted = wanted.unwrap_or_else(|| format!("image-{index}.{extension}").trim_end_matches('.').to_owned());
        let agrees = format.is_none() || format_by_name(&wanted) == format;
        let stem =
            wanted.strip_suffix(&format!(".{}", wanted.rsplit('.').next().unwrap_or_default())).unwrap_or(&wanted);
        let mut path = if agrees { wanted.clone() } else { format!("{stem}.{extension}") };
        let ending = if agrees { uri::extension(&wanted) } else { extension.to_owned() };
        let mut round = 0;
        loop {
            let key = path.to_lowercase();
            match self.taken.get(&key) {
                Some(Some(other)) if *other == bytes => return (path, false),
                Some(_) => {}
                None => {
                    self.taken.insert(key, Some(bytes));
                    return (path, true);
                }
            }
            path = format!("{stem}-{}.{ending}", index + round).trim_end_matches('.').to_owned();
            round += count.max(1);
        }
    }
}

/// A relative path without characters that some file system refuses.
pub(crate) fn plain(path: &str) -> String {
    path.chars().map(|c| if matches!(c, ':' | '*' | '?' | '"' | '<' | '>' | '|') { '_' } else { c }).collect()
}
