//! A slot whose texels are all copied, written as JPEG: baked, filled, compared and encoded strip by strip, so that no page is ever held.

use std::ops::Range;

use image::ColorType;
use rayon::prelude::*;

use super::baker::{Baker, state};
use super::coverage::PageRaster;
use super::fidelity::{Comparison, LEAST_SIDE, Point, PointError, REACH, scatter};
use super::jpeg::{Frame, JpegCoding, LONGEST, Scanned};
use super::pixels::TexelRows;
use super::push_pull::{BLOCK, Fill, Mean, block_means};
use super::texel_map::{TexelMap, TexelMaps};
use super::{Bake, Fidelity, decode, page_size};
use crate::atlas::{Charts, Topology};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Texels of all pages of a slot from which it is worth the while: every texel is made twice.
pub const STREAMED_FROM: u64 = 1 << 25;
/// Texels of a strip, about; its rows are between these bounds, and a multiple of the rows that JPEG takes at a time.
const STRIP_TEXELS: usize = 1 << 21;
const STRIP_ROWS: Range<usize> = 128..512;
const JPEG_ROWS: usize = 16;
/// Rows about a strip that are encoded with it to see what the file shows: those whose texels decide what comparing reads.
const CODED: usize = JPEG_ROWS;
/// Rows about a strip that are baked with it: those that are encoded, and what encoding them reads.
const HALO: usize = CODED + 8;
const _: () = assert!(JPEG_ROWS.is_multiple_of(BLOCK));
// A decoder smooths chroma by a row of it.
const _: () = assert!(CODED >= REACH + 2);

/// A baked slot, encoded.
#[derive(Debug, Clone)]
pub struct Streamed {
    /// By sheet: width and height in texels, and the file.
    pub files: Vec<([u32; 2], Vec<u8>)>,
    /// Texels whose centre a face covers: all were copied unchanged.
    pub verbatim_texels: u64,
    /// The files, decoded, against what was uploaded.
    pub fidelity: Fidelity,
    /// The pages before encoding against what was uploaded.
    pub layout_fidelity: Fidelity,
}

/// Bakes a slot to JPEG files, the same as [`bake`](super::bake), [`encode`](super::encode) and
/// [`UploadedColors`](super::UploadedColors) give one after the other. None where that cannot be done by strips: a texel must be resampled, the images have alpha or 16 bits,
/// a page is tiny, chroma has a quarter of the resolution.
///
/// Fails with `canceled`, with `internal` when the parts of the job do not belong together.
pub fn bake_jpeg(job: &Bake<'_>, coding: &JpegCoding, samples: u32, context: &Context) -> Result<Option<Streamed>> {
    match job.sources.first().map(|s| s.image.color()) {
        Some(ColorType::L8) => streamed::<1>(job, coding, samples, context),
        Some(ColorType::Rgb8) => streamed::<3>(job, coding, samples, context),
        _ => Ok(None),
    }
}

fn streamed<const C: usize>(
    job: &Bake<'_>,
    coding: &JpegCoding,
    samples: u32,
    context: &Context,
) -> Result<Option<Streamed>> {
    let sizes: Vec<[u32; 2]> = (0..job.after.sheets.len()).map(|page| page_size(job, page)).collect();
    // Chroma of a quarter is not interleaved.
    if coding.block().iter().any(|side| *side > JPEG_ROWS as u32)
        || sizes.iter().flatten().any(|side| !(LEAST_SIDE..=LONGEST).contains(side))
    {
        return Ok(None);
    }
    let topology = Topology::new(job.after);
    let maps = TexelMaps::new(job, &Charts::new(&topology))?;
    if maps.all.iter().any(|map| !matches!(map, TexelMap::Exact { .. })) {
        return Ok(None);
    }
    Baker::<u8, C>::with(job, maps, context, |baker| {
        let comparison = Comparison::new(job, &baker.maps);
        let points = scatter(job, &baker.maps, samples, context.seed);
        let mut errors = [vec![None; points.len()], vec![None; points.len()]];
        let (mut files, mut verbatim_texels) = (Vec::new(), 0);
        for (index, size) in sizes.iter().enumerate() {
            let page = u16::try_from(index).map_err(|_| Failure::internal("there are too many sheets"))?;
            let raster = PageRaster::new(job.after, &topology, &baker.maps, page, *size, job.bleed);
            let frame = Frame::new(coding, *size, C as u8)?;
            let (page, copied) = Page::new(baker, raster, &comparison, &points, index, frame)?;
            verbatim_texels += copied;
            let file = page.encoded(&mut errors)?;
            files.push((*size, file));
        }
        let [layout_fidelity, fidelity] = errors.map(|errors| comparison.sum(&errors));
        Ok(Some(Streamed { files, verbatim_texels, fidelity, layout_fidelity }))
    })
}

/// One page, of which any rows can be made.
struct Page<'a, 'b, const C: usize> {
    baker: &'a Baker<'b, u8, C>,
    raster: PageRaster,
    size: [usize; 2],
    /// Rows of a strip.
    rows: usize,
    fill: Fill<C>,
    comparison: &'a Comparison<'a>,
    points: &'a [Point],
    /// By strip, the points that lie in it.
    points_of: Vec<Vec<u32>>,
    frame: Frame,
}

/// What points have lost: before encoding, and as their file shows them.
type Errors = [Vec<Option<PointError>>; 2];

/// A strip as it is encoded, and what its points have lost.
struct Finished {
    scanned: Scanned,
    errors: Vec<(u32, [Option<PointError>; 2])>,
}

/// Some rows as baked, and what of them is known.
type Baked = (Vec<u8>, Vec<u8>);

impl<'a, 'b, const C: usize> Page<'a, 'b, C> {
    /// Looks at all strips once, for the pyramid that they are filled from; gives the number of covered texels too.
    fn new(
        baker: &'a Baker<'b, u8, C>,
        raster: PageRaster,
        comparison: &'a Comparison<'a>,
        points: &'a [Point],
        index: usize,
        frame: Frame,
    ) -> Result<(Self, u64)> {
        let size = [raster.width as usize, raster.height as usize];
        let rows = (STRIP_TEXELS / size[0]).clamp(STRIP_ROWS.start, STRIP_ROWS.end) / JPEG_ROWS * JPEG_ROWS;
        let strips: Vec<usize> = (0..size[1]).step_by(rows).collect();
        let pull = |top: usize| -> Result<(Vec<Mean<C>>, u64)> {
            let ((texels, known), copied) = baked(baker, &raster, top..(top + rows).min(size[1]))?;
            Ok((block_means(&texels, &known, size[0], baker.transfer), copied))
        };
        let pulled: Vec<Result<(Vec<Mean<C>>, u64)>> = strips.par_iter().map(|top| pull(*top)).collect();
        let pulled = pulled.into_iter().collect::<Result<Vec<_>>>()?;
        let copied = pulled.iter().map(|(_, copied)| copied).sum();
        let fill = Fill::new(size, pulled.into_iter().map(|(means, _)| means), baker.transfer.space, baker.context)?;
        let mut points_of = vec![Vec::new(); strips.len()];
        for (i, point) in points.iter().enumerate() {
            let (page, place) = comparison.place(point);
            if page == index {
                let row = (place.y * size[1] as f64).clamp(0.0, (size[1] - 1) as f64) as usize;
                points_of[row / rows].push(i as u32);
            }
        }
        Ok((Page { baker, raster, size, rows, fill, comparison, points, points_of, frame }, copied))
    }

    fn strip(&self, strip: usize) -> Result<Finished> {
        let [width, height] = self.size;
        let own = strip * self.rows..((strip + 1) * self.rows).min(height);
        let with_halo = own.start.saturating_sub(HALO)..(own.end + HALO).min(height);
        let ((mut texels, known), _) = baked(self.baker, &self.raster, with_halo.clone())?;
        let top = with_halo.start;
        self.fill.fill(&mut texels, &known, top, self.baker.transfer);
        drop(known);
        let coded = own.start.saturating_sub(CODED)..(own.end + CODED).min(height);
        let scan = |rows: Range<usize>| self.frame.strip(&texels, top, rows);
        let mut parts = vec![scan(own.clone())?];
        if coded.start < own.start {
            parts.insert(0, scan(coded.start..own.start)?);
        }
        if own.end < coded.end {
            parts.push(scan(own.end..coded.end)?);
        }
        // What the file shows of these rows: blocks do not depend on those above and below.
        let size = [width as u32, coded.len() as u32];
        let shown = decode(&self.frame.of_height(coded.len()).file(&parts), u64::from(size[0]) * u64::from(size[1]));
        let shown = shown.map_err(|e| Failure::internal(format!("a texture that was written: {}", e.message)))?;
        let baked = TexelRows::part(&texels, C, self.size, top);
        let shown = TexelRows::part(shown.as_bytes(), C, self.size, coded.start);
        let compare = |i: &u32| {
            let point = &self.points[*i as usize];
            (*i, [&baked, &shown].map(|rows| self.comparison.compare(point, rows)))
        };
        let errors = self.points_of[strip].iter().map(compare).collect();
        let scanned = parts.swap_remove(usize::from(coded.start < own.start));
        Ok(Finished { scanned, errors })
    }

    /// The page as a JPEG.
    fn encoded(&self, errors: &mut Errors) -> Result<Vec<u8>> {
        let strips: Vec<Result<Finished>> =
            (0..self.points_of.len()).into_par_iter().map(|strip| self.strip(strip)).collect();
        let mut scanned = Vec::with_capacity(strips.len());
        for strip in strips {
            let strip = strip?;
            for (i, lost) in strip.errors {
                errors.iter_mut().zip(lost).for_each(|(errors, lost)| errors[i as usize] = lost);
            }
            scanned.push(strip.scanned);
        }
        Ok(self.frame.file(&scanned))
    }
}

/// Some rows of a page, and how many covered texels there are.
fn baked<const C: usize>(baker: &Baker<'_, u8, C>, raster: &PageRaster, rows: Range<usize>) -> Result<(Baked, u64)> {
    let count = rows.len() * raster.width as usize;
    let (mut texels, mut states) = (vec![0; count * C], vec![state::FREE; count]);
    let counts = baker.band(raster, rows.start as u32, &mut texels, &mut states)?;
    Ok(((texels, states), counts.copied))
}
