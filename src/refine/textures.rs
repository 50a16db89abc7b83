//! The images of one texture set, slot by slot: decode, bake, compare, encode.

use super::options::{Texture, TextureFormat};
use crate::asset::{Document, Slot, TextureSet, is_small, mark_uniform, small_slot_warning};
use crate::atlas::Atlas;
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};
use crate::texture::{Bake, FIDELITY_SAMPLES, Fidelity, Format, Image, Samples, bake, decode, encode, fidelity};

/// Texels about each chart that are taken from the uploaded image: enough for mip levels 0 to 2.
const BLEED: u32 = 8;

/// One baked slot: a file for each sheet, and what it cost.
#[derive(Debug, Clone)]
pub struct BakedSlot {
    /// Index into the set's slots.
    pub slot: usize,
    /// By sheet.
    pub files: Vec<BakedFile>,
    /// Texels that were copied unchanged, over all sheets.
    pub verbatim_texels: u64,
    /// Fraction of the 3D area that was resampled.
    pub resampled_area: f64,
    /// Before against after, before encoding.
    pub fidelity: Fidelity,
}

/// An encoded image.
#[derive(Debug, Clone)]
pub struct BakedFile {
    /// Width and height in texels.
    pub size: [u32; 2],
    /// Container.
    pub format: Format,
    /// The file.
    pub bytes: Vec<u8>,
}

/// Bakes every slot of the set that is not exempt, one at a time. `progress` maps the fraction of this set to that of the stage.
///
/// # Errors
/// `invalid_image` with a pointer for an image that cannot be decoded, `too_large`, `canceled`.
pub fn bake_slots(
    doc: &Document,
    set: &TextureSet,
    after: &Atlas,
    options: &Texture,
    max_pixels: u64,
    context: &Context,
    progress: &dyn Fn(f64) -> f64,
) -> Result<Vec<BakedSlot>> {
    let active: Vec<(usize, &Slot)> = set.slots.iter().enumerate().filter(|(_, s)| !s.exempt).collect();
    let mut baked = Vec::new();
    for (n, (index, slot)) in active.iter().enumerate() {
        context.step(progress(n as f64 / active.len() as f64), &slot.name)?;
        baked.push(bake_slot(doc, set, after, options, max_pixels, (*index, slot), context)?);
    }
    Ok(baked)
}

/// Exempts the slots of one colour: any UVs fit them. Only those that look like it (small, or files of next to no bytes) are decoded for
/// that; one that does not decode fails later, if at all.
///
/// # Errors
/// `canceled`.
pub fn exempt_uniform(doc: &Document, set: &mut TextureSet, max_pixels: u64, context: &Context) -> Result<()> {
    for index in 0..set.slots.len() {
        context.check()?;
        let slot = &set.slots[index];
        let Some(bytes) = doc.images.get(slot.image).and_then(Option::as_deref) else { continue };
        let texels = u64::from(slot.header.width) * u64::from(slot.header.height);
        let flat = (bytes.len() as u64) < texels / 64 + 256;
        // The reference slot itself gives the sheet its size.
        let is_reference = [slot.header.width, slot.header.height] == set.reference;
        if (flat || is_small(slot, set.reference))
            && !is_reference
            && decode(bytes, max_pixels).is_ok_and(|image| is_uniform(&image))
        {
            mark_uniform(set, index);
        }
        if let Some(warning) = small_slot_warning(set, index) {
            context.warn(warning);
        }
    }
    Ok(())
}

fn is_uniform(image: &Image) -> bool {
    fn all_equal<T: PartialEq>(samples: &[T], channels: usize) -> bool {
        let mut texels = samples.chunks_exact(channels.max(1));
        texels.next().is_none_or(|first| texels.all(|t| t == first))
    }
    let channels = usize::from(image.channels);
    match &image.samples {
        Samples::U8(samples) => all_equal(samples, channels),
        Samples::U16(samples) => all_equal(samples, channels),
    }
}

fn bake_slot(
    doc: &Document,
    set: &TextureSet,
    after: &Atlas,
    options: &Texture,
    max_pixels: u64,
    (index, slot): (usize, &Slot),
    context: &Context,
) -> Result<BakedSlot> {
    let pointer = format!("/images/{}", slot.image);
    let encoded = doc
        .images
        .get(slot.image)
        .and_then(Option::as_deref)
        .ok_or_else(|| Failure::new(Code::MissingFile, "the image is missing").at(&pointer))?;
    let source = decode(encoded, max_pixels).map_err(|f| f.at(&pointer))?;
    let job = Bake { before: &set.atlas, after, reference: set.reference, slot, source: &source, bleed: BLEED };
    let baked = bake(&job, context)?;
    let (fidelity, files) = rayon::join(
        || fidelity(&job, &baked, FIDELITY_SAMPLES, context),
        || {
            baked
                .pages
                .iter()
                .map(|page| {
                    let format = format_of(slot, page, options, context, &pointer);
                    let bytes = encode(page, format, options.jpeg_quality)?;
                    Ok(BakedFile { size: [page.width, page.height], format, bytes })
                })
                .collect::<Result<Vec<_>>>()
        },
    );
    Ok(BakedSlot {
        slot: index,
        files: files?,
        verbatim_texels: baked.verbatim_texels,
        resampled_area: baked.resampled_area,
        fidelity: fidelity?,
    })
}

fn format_of(slot: &Slot, page: &Image, options: &Texture, context: &Context, pointer: &str) -> Format {
    let wanted = match options.format {
        TextureFormat::Keep => slot.header.format,
        TextureFormat::Png => Format::Png,
        TextureFormat::Jpeg => Format::Jpeg,
    };
    if wanted != Format::Jpeg {
        return wanted;
    }
    let deep = matches!(page.samples, Samples::U16(_));
    if page.channels.is_multiple_of(2) || deep {
        context.warn(
            Warning::new(
                "kept_png",
                format!("{} has alpha or 16 bits, which JPEG cannot hold: it is written as PNG", slot.name),
            )
            .at(pointer),
        );
        return Format::Png;
    }
    if slot.header.format == Format::Jpeg {
        context.warn(
            Warning::new(
                "lossy_reencode",
                format!(
                    "{} was a JPEG and is compressed once more (set texture.format to \"png\" to avoid that)",
                    slot.name
                ),
            )
            .at(pointer),
        );
    }
    Format::Jpeg
}
