//! The images of one Atlas, slot by slot: decode, bake, compare, encode.

use glam::DVec2;
use image::DynamicImage;
use rayon::prelude::*;

use super::formats::{PageKind, Plan, Upload};
use super::group::{Group, Member};
use super::load::Loaded;
use super::options::Weighed;
use crate::asset::{Document, TextureSet, is_small, mark_uniform, small_slot_warning};
use crate::atlas::Atlas;
use crate::context::Context;
use crate::error::{Code, Failure, Result, Warning};
use crate::metrics::gpu_bytes;
use crate::texture::Slot;
use crate::texture::Texture;
use crate::texture::{
    Alpha, Bake, Baked, Direction, FIDELITY_SAMPLES, Fidelity, Format, Header, Role, STREAMED_FROM, Source, Streamed,
    UploadedColors, Wrap, bake, bake_jpeg, basis_upload, decode, is_lossy, jpeg_coding, neutral, page_size, texel,
    webp_quality, widened,
};

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
    /// By face of the Atlas: whether its texels were copied. Empty where all were.
    pub verbatim_face: Vec<bool>,
    /// The uploaded files against the delivered ones.
    pub fidelity: Fidelity,
    /// The same before encoding: what the layout alone cost.
    pub layout_fidelity: Fidelity,
    /// What the user may not expect of the files.
    pub warnings: Vec<Warning>,
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

/// The uploaded images of a group.
pub struct Images<'a> {
    loaded: &'a Loaded,
    group: &'a Group,
    max_pixels: u64,
    /// Those of the first slot that is baked, or why there are none, when they have been decoded.
    first: Option<Result<Vec<DynamicImage>>>,
}

impl<'a> Images<'a> {
    /// None of them decoded yet; none may have more than `max_pixels`.
    pub fn new(loaded: &'a Loaded, group: &'a Group, max_pixels: u64) -> Self {
        Images { loaded, group, max_pixels, first: None }
    }

    /// Those that are needed first decoded: that can be done while something else is computed.
    pub fn begun(mut self, context: &Context) -> Self {
        let first = active(self.group).next().filter(|_| context.check().is_ok());
        self.first = first.map(|(index, slot)| self.decoded(index, slot));
        self
    }

    /// The images of a slot, with its channels and bits, in the order of its sources.
    pub fn decoded(&self, index: usize, slot: &Slot) -> Result<Vec<DynamicImage>> {
        let mut images = Vec::new();
        for (member, own) in self.group.sources(index) {
            let image = member.set.slots[own].image;
            let pointer = format!("/images/{image}");
            let encoded = uploaded(self.loaded, member, own)
                .ok_or_else(|| Failure::new(Code::MissingFile, "the image is missing").at(&pointer))?;
            let decoded = decode(encoded, self.max_pixels).map_err(|f| f.at(&pointer))?;
            images.push(match self.group.is_joined() {
                true => widened(decoded, slot.header.channels, slot.header.depth),
                false => decoded,
            });
        }
        Ok(images)
    }
}

/// Slots that are not exempt, and their indices.
pub fn active(group: &Group) -> impl Iterator<Item = (usize, &Slot)> {
    group.set().slots.iter().enumerate().filter(|(_, s)| !s.exempt)
}

/// Bakes every slot of the group that is not exempt, one at a time, for the layout `after`; how much it is like what was uploaded is measured through
/// `delivered`, whose texture coordinates are rounded as they are written. `progress` maps the fraction of this set to that of the stage.
///
/// # Errors
/// `invalid_image` with a pointer for an image that cannot be decoded, `too_large`, `canceled`.
pub fn bake_slots(
    mut images: Images<'_>,
    [after, delivered]: [&Atlas; 2],
    options: &Texture,
    context: &Context,
    progress: &dyn Fn(f64) -> f64,
) -> Result<Vec<BakedSlot>> {
    let (loaded, group) = (images.loaded, images.group);
    let count = active(group).count();
    let mut baked = Vec::new();
    for (n, (index, slot)) in active(group).enumerate() {
        context.step(progress(n as f64 / count as f64), &slot.name)?;
        let images = images.first.take().unwrap_or_else(|| images.decoded(index, slot))?;
        baked.push(bake_slot(loaded, group, [after, delivered], options, (index, slot), images, context)?);
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
            && decode(bytes, max_pixels).is_ok_and(|image| is_uniform(&image) && !turns(&image, slot.role))
        {
            mark_uniform(set, index);
        }
        if let Some(warning) = small_slot_warning(set, index) {
            context.warn(warning);
        }
    }
    Ok(())
}

fn is_uniform(image: &DynamicImage) -> bool {
    let mut texels = image.as_bytes().chunks_exact(usize::from(image.color().bytes_per_pixel()));
    texels.next().is_none_or(|first| texels.all(|t| t == first))
}

/// Whether the first texel of an image is a direction that another layout would turn: not the normal of the surface.
fn turns(image: &DynamicImage, role: Role) -> bool {
    let first = texel(image, 0, 0);
    let last = usize::from(image.color().channel_count()) - 1;
    let flat = |c: usize| (first[c.min(last)] - 0.5).abs() < 1.0 / 255.0;
    role.is_direction() && !(role.direction() == Some(Direction::Normal) && flat(0) && flat(1))
}

fn bake_slot(
    loaded: &Loaded,
    group: &Group,
    [after, delivered]: [&Atlas; 2],
    options: &Texture,
    (index, slot): (usize, &Slot),
    images: Vec<DynamicImage>,
    context: &Context,
) -> Result<BakedSlot> {
    let set = group.set();
    let uploads = group.sources(index).filter_map(|(member, own)| {
        let file = uploaded(loaded, member, own)?;
        let format = member.set.slots[own].header.format;
        let Header { width, height, .. } = member.set.slots[own].header;
        let texels = u64::from(width) * u64::from(height);
        Some(Upload {
            format,
            lossy: is_lossy(file),
            bytes: file.len() as u64,
            texels,
            jpeg: jpeg_coding(file),
            webp: webp_quality(file),
            basis: options.format.of(slot.role).may_be_ktx2().then(|| basis_upload(file)).flatten(),
        })
    });
    let plan = Plan::new(slot, uploads.collect(), options);
    // By source: its readers with equal wrap modes.
    let readers: Vec<Vec<([Wrap; 2], Vec<u32>)>> = group
        .sources(index)
        .map(|(m, s)| m.set.slots[s].readings.iter().map(|r| (r.wrap, Group::primitives(m, &r.primitives))).collect())
        .collect();
    let mut sources: Vec<Source<'_>> = Vec::new();
    for (((member, own), image), readers) in group.sources(index).zip(&images).zip(&readers) {
        let (alpha, sheet, place) = (member.set.slots[own].alpha, member.set.reference, member.place);
        for (wrap, primitives) in readers {
            sources.push(Source { image, wrap: *wrap, alpha, primitives, sheet, place, neutral: false });
        }
    }
    // Faces of sets that do not have the slot.
    let neutral = neutral(slot.role, slot.header.channels, slot.header.depth)?;
    let others: Vec<u32> = (0..set.primitives.len() as u32).filter(|p| !slot.primitives.contains(p)).collect();
    if group.is_joined() && !others.is_empty() {
        let (wrap, alpha, place) = ([Wrap::Repeat; 2], Alpha::Opaque, DVec2::ZERO);
        sources.push(Source {
            image: &neutral,
            wrap,
            alpha,
            primitives: &others,
            sheet: texel_sheet(slot, set),
            place,
            neutral: true,
        });
    }
    let job = Bake { before: &set.atlas, after, reference: set.reference, slot, sources, bleed: plan.bleed() };
    let kind = |page: usize| PageKind { colour: job.sources[0].image.color(), size: page_size(&job, page) };
    let kinds: Vec<PageKind> = (0..after.sheets.len()).map(kind).collect();
    let texels: u64 = kinds.iter().map(|kind| u64::from(kind.size[0]) * u64::from(kind.size[1])).sum();
    if texels >= STREAMED_FROM
        && let Some(coding) = plan.jpeg(&kinds)
        && let Some(streamed) = bake_jpeg(&job, coding, FIDELITY_SAMPLES, context)?
    {
        let file = |(size, bytes)| BakedFile { size, format: Format::Jpeg, bytes };
        let files: Vec<BakedFile> = streamed.files.into_iter().map(file).collect();
        let warnings = plan.warnings(&kinds, bytes(&files));
        let Streamed { verbatim_texels, fidelity, layout_fidelity, .. } = streamed;
        return Ok(BakedSlot {
            slot: index,
            files,
            verbatim_texels,
            resampled_area: 0.0,
            verbatim_face: Vec::new(),
            fidelity,
            layout_fidelity,
            warnings,
        });
    }
    let Baked { pages, verbatim_texels, resampled_area, verbatim_face } = bake(&job, context)?;
    let job = Bake { after: delivered, ..job };
    let (layout, written) = rayon::join(
        || {
            let uploaded = UploadedColors::new(&job, FIDELITY_SAMPLES, context)?;
            let layout = uploaded.against(&pages, context)?;
            Ok::<_, Failure>((uploaded, layout))
        },
        || {
            pages
                .par_iter()
                .map(|page| {
                    let coding = plan.of(PageKind::of(page));
                    let bytes = coding.encode(page, context)?;
                    Ok(BakedFile { size: [page.width(), page.height()], format: coding.format(), bytes })
                })
                .collect::<Result<Vec<_>>>()
        },
    );
    let written = written?;
    let (uploaded, layout_fidelity) = layout?;
    let warnings = plan.warnings(&kinds, bytes(&written));
    let fidelity = match as_delivered(pages, &written)? {
        Some(pages) => uploaded.against(&pages, context)?,
        None => layout_fidelity,
    };
    Ok(BakedSlot {
        slot: index,
        files: written,
        verbatim_texels,
        resampled_area,
        verbatim_face,
        fidelity,
        layout_fidelity,
        warnings,
    })
}

fn bytes(files: &[BakedFile]) -> u64 {
    files.iter().map(|file| file.bytes.len() as u64).sum()
}

/// Whether baked slots have more of something than the files that they were read from.
pub(super) fn has_grown(loaded: &Loaded, group: &Group, slots: &[BakedSlot], weighed: Weighed) -> bool {
    let weight = |[width, height]: [u32; 2], bytes: usize| match weighed {
        Weighed::Pixels => u64::from(width) * u64::from(height),
        Weighed::Bytes => bytes as u64,
        Weighed::GpuBytes => gpu_bytes(width, height),
    };
    let before = slots.iter().flat_map(|slot| group.sources(slot.slot)).map(|(member, own)| {
        let Header { width, height, .. } = member.set.slots[own].header;
        weight([width, height], uploaded(loaded, member, own).map_or(0, <[u8]>::len))
    });
    let after = slots.iter().flat_map(|slot| &slot.files).map(|file| weight(file.size, file.bytes.len()));
    after.sum::<u64>() > before.sum()
}

/// The pages as whoever opens their files sees them; none where these lose nothing. A page is dropped before its file is decoded.
fn as_delivered(pages: Vec<DynamicImage>, files: &[BakedFile]) -> Result<Option<Vec<DynamicImage>>> {
    if !files.iter().any(|file| is_lossy(&file.bytes)) {
        return Ok(None);
    }
    let delivered = |(page, file): (DynamicImage, &BakedFile)| {
        if !is_lossy(&file.bytes) {
            return Ok(page);
        }
        let pixels = u64::from(page.width()) * u64::from(page.height());
        drop(page);
        decode(&file.bytes, pixels).map_err(|e| Failure::internal(format!("a texture that was written: {}", e.message)))
    };
    pages.into_iter().zip(files).map(delivered).collect::<Result<_>>().map(Some)
}

/// The file of a slot of a member.
pub fn uploaded<'a>(loaded: &'a Loaded, member: &Member, own: usize) -> Option<&'a [u8]> {
    let model = loaded.models.get(member.model)?;
    model.doc.images.get(member.set.slots.get(own)?.image)?.as_deref()
}

/// The sheet of one texel of a slot: what makes an image of one texel as fine as the slot.
fn texel_sheet(slot: &Slot, set: &TextureSet) -> [u32; 2] {
    let side = |k: usize, size: u32| (f64::from(set.reference[k]) / f64::from(size.max(1))).round().max(1.0) as u32;
    [side(0, slot.header.width), side(1, slot.header.height)]
}
