//! From the uploaded texture to the refined one, through provenance: whole texels are copied, the rest is resampled,
//! what nobody owns is filled.

use std::sync::Mutex;

use glam::DVec2;
use image::{ColorType, DynamicImage};
use rayon::prelude::*;

use super::baker::{Baker, Counts, state};
use super::coverage::PageRaster;
use super::pixels::{Depth, from_samples};
use super::push_pull::push_pull;
use super::sampler::{Footprint, Sampler};
use super::texel_map::{TexelMap, TexelMaps};
use super::transfer::{Space, Transfer, alpha_channel};
use super::{Alpha, Wrap};
use crate::atlas::{Atlas, Charts, Topology};
use crate::context::Context;
use crate::error::{Code, Failure, Result};
use crate::texture::Slot;

/// Texels of a band, about: what one task works on between two looks at the context.
const BAND_TEXELS: u32 = 1 << 18;
/// Texels that one page of one slot may have.
const PAGE_TEXELS: u64 = 1 << 30;
/// Relative change of a mask's coverage from which its alpha is scaled.
const COVERAGE_CHANGE: f64 = 0.01;

/// One slot of an Atlas to bake to a new layout.
#[derive(Clone)]
pub struct Bake<'a> {
    /// The Atlas as uploaded: what provenance refers to.
    pub before: &'a Atlas,
    /// The refined Atlas.
    pub after: &'a Atlas,
    /// Size of a sheet, in the texels in which UVs are measured, for which the slot has the size in its header.
    pub reference: [u32; 2],
    /// What the images mean, and how large the slot is.
    pub slot: &'a Slot,
    /// Where the slot is read from; at least one. All images have equal channels and depth.
    pub sources: Vec<Source<'a>>,
    /// Width of the ring about each chart that is taken from the uploaded image, in texels of the slot. 8 keeps the first mip levels.
    pub bleed: u32,
}

/// An uploaded image, and the primitives whose faces read it.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// The decoded image.
    pub image: &'a DynamicImage,
    /// Wrap modes (S, T).
    pub wrap: [Wrap; 2],
    /// How alpha is treated.
    pub alpha: Alpha,
    /// Primitives, as provenance numbers them.
    pub primitives: &'a [u32],
    /// Size of the sheet that the image fills, in reference texels.
    pub sheet: [u32; 2],
    /// Where the corner of that sheet lies in the layout of `before`.
    pub place: DVec2,
    /// Whether it only fills the place of faces that do not read the slot: they stay out of all figures.
    pub neutral: bool,
}

impl<'a> Bake<'a> {
    /// A slot that is one image with one reading, which fills the sheet `reference`.
    pub fn single(
        before: &'a Atlas,
        after: &'a Atlas,
        reference: [u32; 2],
        slot: &'a Slot,
        image: &'a DynamicImage,
        bleed: u32,
    ) -> Self {
        let source = Source {
            image,
            wrap: slot.readings.first().map_or([Wrap::default(); 2], |r| r.wrap),
            alpha: slot.alpha,
            primitives: &slot.primitives,
            sheet: reference,
            place: DVec2::ZERO,
            neutral: false,
        };
        Bake { before, after, reference, slot, sources: vec![source], bleed }
    }

    /// Channels of every image.
    pub(crate) fn channels(&self) -> u8 {
        self.sources.first().map_or(0, |s| s.image.color().channel_count())
    }
}

/// A baked slot.
#[derive(Debug, Clone, PartialEq)]
pub struct Baked {
    /// One image for each sheet of the refined Atlas, with the channels and depth of the source.
    pub pages: Vec<DynamicImage>,
    /// Texels whose centre a face covers and that were copied unchanged.
    pub verbatim_texels: u64,
    /// 3D area of the faces that were resampled / 3D area of the faces that read the slot, in 0..=1.
    pub resampled_area: f64,
    /// By face of the refined Atlas: whether its texels were copied unchanged. False for faces that do not read the slot.
    pub verbatim_face: Vec<bool>,
}

/// Size in texels of the slot's page for a sheet of `job.after`.
pub fn page_size(job: &Bake<'_>, page: usize) -> [u32; 2] {
    let sheet = job.after.sheets.get(page).copied().unwrap_or([1, 1]);
    let side = |sheet: u32, slot: u32, reference: u32| {
        let size = (f64::from(sheet) * f64::from(slot) / f64::from(reference.max(1))).round();
        size.clamp(1.0, f64::from(u32::MAX)) as u32
    };
    let slot = [job.slot.header.width, job.slot.header.height];
    [side(sheet[0], slot[0], job.reference[0]), side(sheet[1], slot[1], job.reference[1])]
}

/// Bakes one slot. Each face whose new place differs from the uploaded one by whole texels, quarter turns and mirroring is copied
/// unchanged, with the ring that bilinear filtering reads; other faces are resampled. The bytes do not depend on the number of threads.
///
/// Fails with `canceled`, with `too_large` for a page of more than 2^30 texels, with `internal` when the parts of the job do not
/// belong together.
pub fn bake(job: &Bake<'_>, context: &Context) -> Result<Baked> {
    match job.sources.first().map(|s| s.image.color()) {
        Some(ColorType::L8) => Baker::<u8, 1>::run(job, context),
        Some(ColorType::La8) => Baker::<u8, 2>::run(job, context),
        Some(ColorType::Rgb8) => Baker::<u8, 3>::run(job, context),
        Some(ColorType::Rgba8) => Baker::<u8, 4>::run(job, context),
        Some(ColorType::L16) => Baker::<u16, 1>::run(job, context),
        Some(ColorType::La16) => Baker::<u16, 2>::run(job, context),
        Some(ColorType::Rgb16) => Baker::<u16, 3>::run(job, context),
        Some(ColorType::Rgba16) => Baker::<u16, 4>::run(job, context),
        other => Err(Failure::internal(format!("an image to bake cannot be {other:?}"))),
    }
}

impl<T: Depth, const C: usize> Baker<'_, T, C> {
    /// Gives what bakes a slot to `with`. Fails with `internal` when the images are not of one kind.
    pub(crate) fn with<R>(
        job: &Bake<'_>,
        maps: TexelMaps,
        context: &Context,
        with: impl FnOnce(&Baker<'_, T, C>) -> Result<R>,
    ) -> Result<R> {
        let transfer = Transfer::new(Space::of(job.slot.role, job.channels()));
        let cutoff = match job.slot.alpha {
            Alpha::Mask(cutoff) if alpha_channel(C).is_some() && cutoff > 0.0 && cutoff <= 1.0 => Some(cutoff as f32),
            _ => None,
        };
        let shown = transfer.shown();
        let mut samplers = Vec::with_capacity(job.sources.len());
        for source in &job.sources {
            let image = source.image;
            let texels =
                T::of(image).filter(|texels| !texels.is_empty() && usize::from(image.color().channel_count()) == C);
            let texels = texels.ok_or_else(|| Failure::internal("the images of a slot are not of one kind"))?;
            let size = [i64::from(image.width()), i64::from(image.height())];
            let premultiply = source.alpha == Alpha::Blend;
            samplers.push(Sampler::<T, C> {
                texels,
                size,
                wrap: source.wrap,
                transfer: &transfer,
                shown: &shown,
                premultiply,
            });
        }
        let footprint = |map: &TexelMap| match map {
            TexelMap::Exact { .. } => None,
            TexelMap::Affine { to_source, .. } => Some(Footprint::new(to_source.matrix2)),
        };
        let footprints = maps.all.iter().map(footprint).collect();
        with(&Baker {
            job,
            samplers,
            transfer: &transfer,
            shown: &shown,
            maps,
            footprints,
            context,
            cutoff,
            spare: Mutex::default(),
        })
    }

    fn run(job: &Bake<'_>, context: &Context) -> Result<Baked> {
        let topology = Topology::new(job.after);
        let maps = TexelMaps::new(job, &Charts::new(&topology))?;
        Self::with(job, maps, context, |baker| baker.pages(&topology))
    }

    fn pages(&self, topology: &Topology) -> Result<Baked> {
        let job = self.job;
        let mut pages = Vec::new();
        let mut verbatim_texels = 0;
        for page in 0..job.after.sheets.len() {
            let (image, copied) = self.page(page, topology)?;
            pages.push(image);
            verbatim_texels += copied;
        }
        let verbatim_face: Vec<bool> =
            (0..job.after.face_count()).map(|f| matches!(self.maps.get(f), Some(TexelMap::Exact { .. }))).collect();
        let (mut all, mut resampled) = (0.0, 0.0);
        for face in job.after.faces().filter(|f| self.maps.counts(f.index())) {
            let area = job.after.area(face);
            all += area;
            resampled += if verbatim_face[face.index()] { 0.0 } else { area };
        }
        let resampled_area = if all > 0.0 { resampled / all } else { 0.0 };
        Ok(Baked { pages, verbatim_texels, resampled_area, verbatim_face })
    }

    fn page(&self, index: usize, topology: &Topology) -> Result<(DynamicImage, u64)> {
        let [w, h] = page_size(self.job, index);
        if u64::from(w) * u64::from(h) > PAGE_TEXELS {
            let message = format!("a refined texture of {w} x {h} texels is beyond what can be baked");
            return Err(Failure::new(Code::TooLarge, message));
        }
        let (width, height) = (w as usize, h as usize);
        let page = u16::try_from(index).map_err(|_| Failure::internal("there are too many sheets"))?;
        let page = PageRaster::new(self.job.after, topology, &self.maps, page, [w, h], self.job.bleed);
        let rows = (BAND_TEXELS / w).clamp(32, 256);
        let band = width * rows as usize;
        let mut texels = vec![T::default(); width * height * C];
        let mut states = vec![state::FREE; width * height];
        let bands = texels.par_chunks_mut(band * C).zip(states.par_chunks_mut(band)).enumerate();
        let counts: Vec<Result<Counts>> =
            bands.map(|(i, (out, states))| self.band(&page, i as u32 * rows, out, states)).collect();
        let mut copied = 0;
        let mut alphas = [0; 256];
        let mut shown = 0;
        for band in counts {
            let band = band?;
            copied += band.copied;
            shown += band.shown;
            alphas.iter_mut().zip(band.alphas).for_each(|(sum, n)| *sum += n);
        }
        if let (Some(cutoff), Some(channel)) = (self.cutoff, alpha_channel(C))
            && let Some(scale) = coverage_scale(&alphas, shown as f64 / 4.0, cutoff)
        {
            texels.par_chunks_exact_mut(C).zip(states.par_iter()).for_each(|(texel, state)| {
                if matches!(*state, state::RESAMPLED | state::RING_RESAMPLED) {
                    let alpha = texel[channel].value() as f32 * scale;
                    texel[channel] = T::from_value((alpha + 0.5).min(T::MAX as f32) as u32);
                }
            });
        }
        push_pull::<T, C>(&mut texels, &states, width, self.transfer, self.context)?;
        Ok((from_samples([w, h], C as u8, texels)?, copied))
    }
}

/// The factor on alpha that brings the coverage of a mask (texels at or above the cutoff) back to `target`; none when it
/// is close already.
fn coverage_scale(alphas: &[u64; 256], target: f64, cutoff: f32) -> Option<f32> {
    let bin = (cutoff * 255.0).ceil() as usize;
    let now: u64 = alphas.iter().skip(bin).sum();
    if (now as f64 - target).abs() <= COVERAGE_CHANGE * target || target <= 0.0 {
        return None;
    }
    // The threshold on the alphas as they are that shows nearest to the target.
    let mut above = 0;
    let mut best = (f64::INFINITY, bin);
    for level in (1..256).rev() {
        above += alphas[level];
        let off = (above as f64 - target).abs();
        if off < best.0 {
            best = (off, level);
        }
    }
    (best.1 != bin).then(|| cutoff * 255.0 / (best.1 as f32 - 0.5))
}
