//! The pictures: every page of every slot, small enough for a page on the web.

use image::{DynamicImage, RgbImage};
use serde_json::{Value, json};

use super::super::group::Group;
use super::super::load::Loaded;
use super::super::refinement::Refinement;
use super::super::textures::{Images, active, uploaded};
use super::container::Sections;
use crate::error::Result;
use crate::texture::{Coding, Format, JpegCoding, Slot, decode, encode, header};

/// Longest side, in pixels.
const LONGEST: u32 = 2048;
/// Quality of what has to be encoded: loss that is not seen at 100 %.
const QUALITY: u8 = 90;
/// Pixels up to which a picture is encoded without loss.
const LOSSLESS: u32 = 256 * 256;

/// What is left of the bytes for pictures, and for how many.
pub(super) struct Share {
    bytes: usize,
    pictures: usize,
}

impl Share {
    pub fn new(bytes: usize, pictures: usize) -> Self {
        Share { bytes, pictures }
    }

    /// The bytes that the next picture may have.
    fn next(&self) -> usize {
        self.bytes / self.pictures.max(1)
    }

    fn take(&mut self, bytes: usize) {
        self.bytes = self.bytes.saturating_sub(bytes);
        self.pictures = self.pictures.saturating_sub(1);
    }
}

/// The pictures of a refinement.
pub(super) fn count(r: &Refinement<'_>) -> usize {
    active(r.group).count() + r.slots.iter().map(|slot| slot.files.len()).sum::<usize>()
}

/// The uploaded picture of a slot; of several models, their images on the sheet that they share. Null where one does not decode: what was left
/// as it was is not looked at before.
pub(super) fn before_page(
    loaded: &Loaded,
    group: &Group,
    index: usize,
    slot: &Slot,
    max_pixels: u64,
    share: &mut Share,
    sections: &mut Sections,
) -> Result<Value> {
    if !group.is_joined()
        && let Some(bytes) = uploaded(loaded, &group.members[0], index).filter(|bytes| is_small_enough(bytes, share))
    {
        return as_it_is(bytes, share, sections);
    }
    let Ok(images) = Images::new(loaded, group, max_pixels).decoded(index, slot) else {
        share.take(0);
        return Ok(Value::Null);
    };
    if !group.is_joined() {
        return images.first().map_or(Ok(Value::Null), |image| scaled(image, share, sections));
    }
    let sheet = group.set().reference;
    let [width, height] = fitted(sheet);
    let scale = f64::from(width) / f64::from(sheet[0].max(1));
    let mut all = RgbImage::new(width, height);
    for (image, (member, _)) in images.iter().zip(group.sources(index)) {
        let side = |k: usize| ((f64::from(member.set.reference[k]) * scale).round() as u32).max(1);
        let part = image.thumbnail_exact(side(0), side(1)).into_rgb8();
        let place = member.place * scale;
        image::imageops::replace(&mut all, &part, place.x.round() as i64, place.y.round() as i64);
    }
    encoded(DynamicImage::ImageRgb8(all), sheet, share, sections)
}

/// A delivered picture.
pub(super) fn after_page(bytes: &[u8], max_pixels: u64, share: &mut Share, sections: &mut Sections) -> Result<Value> {
    if is_small_enough(bytes, share) {
        return as_it_is(bytes, share, sections);
    }
    scaled(&decode(bytes, max_pixels)?, share, sections)
}

/// Whether browsers read the file, and it is small enough in pixels and bytes.
fn is_small_enough(bytes: &[u8], share: &Share) -> bool {
    bytes.len() <= share.next()
        && header(bytes).is_ok_and(|h| h.format != Format::Ktx2 && h.width.max(h.height) <= LONGEST)
}

fn as_it_is(bytes: &[u8], share: &mut Share, sections: &mut Sections) -> Result<Value> {
    let header = header(bytes)?;
    share.take(bytes.len());
    let section = sections.raw(bytes);
    Ok(told(section, header.format, [header.width, header.height], [header.width, header.height]))
}

fn scaled(image: &DynamicImage, share: &mut Share, sections: &mut Sections) -> Result<Value> {
    let size = [image.width(), image.height()];
    let [width, height] = fitted(size);
    let small =
        if [width, height] == size { image.to_rgb8() } else { image.thumbnail_exact(width, height).into_rgb8() };
    encoded(DynamicImage::ImageRgb8(small), size, share, sections)
}

/// Encodes a picture of a sheet of `size`, by halves smaller until it fits.
fn encoded(mut image: DynamicImage, size: [u32; 2], share: &mut Share, sections: &mut Sections) -> Result<Value> {
    loop {
        let [width, height] = [image.width(), image.height()];
        let coding = match width.saturating_mul(height) <= LOSSLESS {
            true => Coding::Png,
            false => Coding::Jpeg(JpegCoding::of_quality(QUALITY)),
        };
        let bytes = encode(&image, &coding)?;
        if bytes.len() <= share.next() || width.max(height) <= 16 {
            share.take(bytes.len());
            let section = sections.raw(&bytes);
            return Ok(told(section, coding.format(), [width, height], size));
        }
        image = image.thumbnail_exact((width / 2).max(1), (height / 2).max(1));
    }
}

/// A size scaled down until its longer side is [`LONGEST`].
fn fitted(size: [u32; 2]) -> [u32; 2] {
    let longest = size[0].max(size[1]);
    if longest <= LONGEST {
        return size.map(|side| side.max(1));
    }
    size.map(|side| ((f64::from(side) * f64::from(LONGEST) / f64::from(longest)).round() as u32).max(1))
}

fn told(mut section: Value, format: Format, pixels: [u32; 2], size: [u32; 2]) -> Value {
    section["media_type"] = json!(format.media_type());
    section["pixels"] = json!(pixels);
    section["size"] = json!(size);
    section
}
