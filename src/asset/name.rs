//! Names of files and materials in whichever encoding: kept byte by byte, found so, and shown readably.
//!
//! A name that is UTF-8 is itself. Of any other, each byte that is not ASCII is a character of its own from a private range, so that equal names are
//! equal strings and paths are joined and cut as others are.

use std::borrow::Cow;

use chardetng::{EncodingDetector, Iso2022JpDetection, Utf8Detection};
use encoding_rs::{BIG5, EUC_KR, Encoding, GBK, SHIFT_JIS, WINDOWS_1252};
use unicode_normalization::UnicodeNormalization;

/// Stands for byte 0; the other bytes follow.
const FIRST: u32 = 0x0010_F700;

/// Encodings that names are tried in where they are compared with others.
const COMMON: [&Encoding; 5] = [WINDOWS_1252, GBK, SHIFT_JIS, BIG5, EUC_KR];

/// The upper half of code page 437, in which archives spell names unless they say that they are UTF-8.
const CODE_PAGE_437: &str = "ÇüéâäàåçêëèïîìÄÅÉæÆôöòûùÿÖÜ¢£¥₧ƒáíóúñÑªº¿⌐¬½¼¡«»░▒▓│┤╡╢╖╕╣║╗╝╜╛┐└┴┬├─┼╞╟╚╔╩╦╠═╬╧╨╤╥╙╘╒╓╫╪┘┌█▄▌▐▀αßΓπΣσµτΦΘΩδ∞φε∩≡±≥≤⌠⌡÷≈°∙·√ⁿ²■\u{a0}";

/// A name from its bytes.
pub(crate) fn from_bytes(bytes: &[u8]) -> String {
    if let Some(text) = std::str::from_utf8(bytes).ok().filter(|text| !is_kept(text)) {
        return text.to_owned();
    }
    // The second byte of a character may be that of a backslash, which is no separator then. Short names do not tell their encoding: what could be such a
    // character is taken for one, and found by its readings where it is none.
    let is_clean = |e: &&'static Encoding| e.decode_without_bom_handling_and_without_replacement(bytes).is_some();
    let wide = [guess([bytes].into_iter()), SHIFT_JIS, GBK, BIG5].into_iter();
    let wide = wide.filter(|e| [SHIFT_JIS, GBK, BIG5].contains(e)).find(is_clean);
    let is_lead = |b: u8| b > 0x80 && wide.is_some_and(|e| e != SHIFT_JIS || !(0xA0..0xE0).contains(&b));
    let mut name = String::new();
    let mut after_lead = false;
    for byte in bytes.iter().copied() {
        if byte.is_ascii() && !(after_lead && byte == b'\\') {
            name.push(char::from(byte));
        } else {
            name.extend(char::from_u32(FIRST + u32::from(byte)));
        }
        after_lead = !after_lead && is_lead(byte);
    }
    name
}

/// The bytes of a name.
pub(crate) fn bytes(name: &str) -> Cow<'_, [u8]> {
    if !is_kept(name) {
        return Cow::Borrowed(name.as_bytes());
    }
    let mut bytes = Vec::with_capacity(name.len());
    for c in name.chars() {
        match byte(c) {
            Some(byte) => bytes.push(byte),
            None => bytes.extend_from_slice(c.encode_utf8(&mut [0; 4]).as_bytes()),
        }
    }
    Cow::Owned(bytes)
}

/// A name as people read it, by the encoding that it is probably in.
pub(crate) fn readable(name: &str) -> Cow<'_, str> {
    readable_in(name, None)
}

/// A name as people read it, in an encoding where it fits that, else in its own.
pub(crate) fn readable_in<'a>(name: &'a str, encoding: Option<&'static Encoding>) -> Cow<'a, str> {
    if !is_kept(name) {
        return Cow::Borrowed(name);
    }
    let bytes = bytes(name);
    let known = encoding.and_then(|e| e.decode_without_bom_handling_and_without_replacement(&bytes));
    let text = known.unwrap_or_else(|| guess([&*bytes].into_iter()).decode_without_bom_handling(&bytes).0);
    Cow::Owned(text.into_owned())
}

/// The encoding of some names; none where all are UTF-8.
pub(crate) fn encoding<'a>(names: impl Iterator<Item = &'a str>) -> Option<&'static Encoding> {
    let kept: Vec<Cow<'_, [u8]>> = names.filter(|name| is_kept(name)).map(bytes).collect();
    (!kept.is_empty()).then(|| guess(kept.iter().map(|name| &**name)))
}

/// What a name may read, the probable first. One that is UTF-8 reads as it is: other spellings of it have accents with their letters or apart from them
/// (NFC, NFD), as some file systems write all names.
pub(crate) fn readings(name: &str) -> Vec<String> {
    if !is_kept(name) {
        let spellings = [name.nfc().collect::<String>(), name.nfd().collect()];
        return spellings.into_iter().filter(|spelling| spelling != name).collect();
    }
    let bytes = bytes(name);
    let decoded = |e: &&'static Encoding| e.decode_without_bom_handling_and_without_replacement(&bytes);
    let mut readings: Vec<String> =
        [guess([&*bytes].into_iter())].iter().chain(&COMMON).filter_map(decoded).map(Cow::into_owned).collect();
    let upper: Vec<char> = CODE_PAGE_437.chars().collect();
    let character =
        |b: &u8| b.checked_sub(0x80).and_then(|b| upper.get(usize::from(b)).copied()).unwrap_or(char::from(*b));
    readings.push(bytes.iter().map(character).collect());
    readings
}

/// Whether a name is kept by its bytes.
fn is_kept(name: &str) -> bool {
    name.chars().any(|c| byte(c).is_some())
}

/// The byte that a character stands for: none that could separate folders or name the one above, but for the second byte of a character.
fn byte(c: char) -> Option<u8> {
    let byte = u32::from(c).checked_sub(FIRST).and_then(|b| u8::try_from(b).ok());
    byte.filter(|b| !b.is_ascii() || *b == b'\\')
}

fn guess<'a>(names: impl Iterator<Item = &'a [u8]>) -> &'static Encoding {
    let mut detector = EncodingDetector::new(Iso2022JpDetection::Deny);
    for name in names {
        detector.feed(name, false);
        detector.feed(b"\n", false);
    }
    detector.feed(b"", true);
    detector.guess(None, Utf8Detection::Deny)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_keep_their_bytes_and_read_well() {
        let latin = WINDOWS_1252.encode("größe/grün é.png").0;
        let chinese = GBK.encode("贴图/红色砖墙.png").0;
        let japanese = SHIFT_JIS.encode("表面/テクスチャ.png").0;
        for (encoded, text) in
            [(latin, "größe/grün é.png"), (chinese, "贴图/红色砖墙.png"), (japanese, "表面/テクスチャ.png")]
        {
            let name = from_bytes(&encoded);
            assert_eq!(&*bytes(&name), &*encoded);
            assert_eq!(readable(&name), text);
            assert!(readings(&name).contains(&text.to_owned()));
            assert_eq!(name.matches(['/', '\\']).count(), 1, "{text}: a byte of a character separates nothing");
        }
        let plain = from_bytes("größe.png".as_bytes());
        assert_eq!((plain.as_str(), readings(&plain)), ("größe.png", vec!["gro\u{308}ße.png".to_owned()]));
        assert_eq!(readings("gro\u{308}ße.png"), ["größe.png"]);
        assert_eq!(readings("wall.png"), Vec::<String>::new());
        let packed = from_bytes(b"gr\x94\xe1e.png");
        assert!(readings(&packed).contains(&"größe.png".to_owned()), "{:?}", readings(&packed));
        assert_eq!(CODE_PAGE_437.chars().count(), 128);
    }

    #[test]
    fn any_bytes_are_kept() {
        for first in 0..=255u8 {
            let own = [first, b'\\', 0xFF, b'/', first, b'a'];
            assert_eq!(&*bytes(&from_bytes(&own)), own);
        }
        // Nobody leaves a folder with characters of the private range.
        let climber = "\u{10F72E}\u{10F72E}\u{10F72F}x";
        assert_eq!(&*bytes(climber), climber.as_bytes());
        let private = "\u{10F780}";
        assert_eq!(&*bytes(&from_bytes(private.as_bytes())), private.as_bytes());
    }
}
