//! A slot whose texels are all copied, written as JPEG: baked, filled, compared and encoded strip by strip, so that no page is ever held.

use std::cell::RefCell;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};

use image::ColorType;
use rayon::prelude::*;

use super::baker::{Baker, state};
use super::coverage::PageRaster;
use super::encode::{RowSource, encode_jpeg, encode_jpeg_rows};
use super::fidelity::{Comparison, LEAST_SIDE, Point, PointError, REACH, scatter};
use super::jpeg_coding::JpegCoding;
use super::pixels::{TexelRows, from_samples};
use super::push_pull::{Pulled, STRIP_STEP, Strip, StripFill, UNFILLED};
use super::texel_map::{TexelMap, TexelMaps};
use super::{Bake, Fidelity, decode, page_size};
use crate::atlas::{Charts, Topology};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Texels of all pages of a slot from which it is worth the while: every texel is made twice.
pub const STREAMED_FROM: u64 = 1 << 25;
/// Texels of a strip, about; its rows are between these bounds, and a multiple of the rows that JPEG takes at a time.
const STRIP_TEXELS: usize = 1 << 20;
const STRIP_ROWS: Range<usize> = 32..256;
const JPEG_ROWS: usize = 16;
/// Rows about a strip that are encoded with it to see what the file shows: those whose texels decide what comparing reads.
const CODED: usize = JPEG_ROWS;
/// Rows about a strip that are baked with it: those that are encoded, and what filling them reads.
const HALO: usize = CODED + UNFILLED;
const _: () = assert!(HALO.is_multiple_of(STRIP_STEP) && JPEG_ROWS.is_multiple_of(STRIP_STEP));
// A decoder smooths chroma by a row of it.
const _: () = assert!(CODED >= REACH + 2);
/// The longest side of a JPEG.
const LONGEST: u32 = 65_535;

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
            let (page, copied) = Page::new(baker, raster, &comparison, &points, index, coding)?;
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
    fill: StripFill<C>,
    comparison: &'a Comparison<'a>,
    points: &'a [Point],
    /// By strip, the points that lie in it.
    points_of: Vec<Vec<u32>>,
    coding: &'a JpegCoding,
}

/// What points have lost: before encoding, and as their file shows them.
type Errors = [Vec<Option<PointError>>; 2];

/// A strip as it is encoded, and what its points have lost.
struct Finished {
    texels: Vec<u8>,
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
        coding: &'a JpegCoding,
    ) -> Result<(Self, u64)> {
        let size = [raster.width as usize, raster.height as usize];
        let rows = (STRIP_TEXELS / size[0]).clamp(STRIP_ROWS.start, STRIP_ROWS.end) / JPEG_ROWS * JPEG_ROWS;
        let strips: Vec<usize> = (0..size[1]).step_by(rows).collect();
        let pull = |top: usize| -> Result<(Pulled<C>, u64)> {
            let ((mut texels, known), copied) = baked(baker, &raster, top..(top + rows).min(size[1]))?;
            let strip = Strip { texels: &mut texels, known: &known, top, size };
            Ok((StripFill::pull(&strip, baker.transfer), copied))
        };
        let pulled: Vec<Result<(Pulled<C>, u64)>> = strips.par_iter().map(|top| pull(*top)).collect();
        let pulled = pulled.into_iter().collect::<Result<Vec<_>>>()?;
        let copied = pulled.iter().map(|(_, copied)| copied).sum();
        let space = baker.transfer.space;
        let fill = StripFill::new(size, pulled.into_iter().map(|(rows, _)| rows), space, baker.context)?;
        let mut points_of = vec![Vec::new(); strips.len()];
        for (i, point) in points.iter().enumerate() {
            let (page, place) = comparison.place(point);
            if page == index {
                let row = (place.y * size[1] as f64).clamp(0.0, (size[1] - 1) as f64) as usize;
                points_of[row / rows].push(i as u32);
            }
        }
        Ok((Page { baker, raster, size, rows, fill, comparison, points, points_of, coding }, copied))
    }

    /// Some strips, made in parallel.
    fn strips(&self, strips: Range<usize>) -> Result<Vec<Finished>> {
        let strips: Vec<Result<Finished>> = strips.into_par_iter().map(|strip| self.strip(strip)).collect();
        strips.into_iter().collect()
    }

    fn strip(&self, strip: usize) -> Result<Finished> {
        let [width, height] = self.size;
        let own = strip * self.rows..((strip + 1) * self.rows).min(height);
        let with_halo = own.start.saturating_sub(HALO)..(own.end + HALO).min(height);
        let ((mut texels, known), _) = baked(self.baker, &self.raster, with_halo.clone())?;
        let top = with_halo.start;
        self.fill.fill(&mut Strip { texels: &mut texels, known: &known, top, size: self.size }, self.baker.transfer);
        let coded = own.start.saturating_sub(CODED)..(own.end + CODED).min(height);
        let shown = self.shown(&texels[(coded.start - top) * width * C..(coded.end - top) * width * C], coded.len())?;
        let baked = TexelRows::part(&texels, C, self.size, top);
        let shown = TexelRows::part(&shown, C, self.size, coded.start);
        let compare = |i: &u32| {
            let point = &self.points[*i as usize];
            (*i, [&baked, &shown].map(|rows| self.comparison.compare(point, rows)))
        };
        let errors = self.points_of[strip].iter().map(compare).collect();
        texels.truncate((own.end - top) * width * C);
        texels.drain(..(own.start - top) * width * C);
        Ok(Finished { texels, errors })
    }

    /// Some rows as whoever opens the page's file sees them: blocks of a JPEG do not depend on those above and below.
    fn shown(&self, rows: &[u8], height: usize) -> Result<Vec<u8>> {
        let size = [self.size[0] as u32, height as u32];
        let file = encode_jpeg(&from_samples(size, C as u8, rows.to_vec())?, self.coding, false)?;
        let shown = decode(&file, u64::from(size[0]) * u64::from(size[1]));
        Ok(shown.map_err(|e| Failure::internal(format!("a texture that was written: {}", e.message)))?.into_bytes())
    }

    /// The page as a JPEG. While some strips are encoded the next ones are made.
    fn encoded(&self, errors: &mut Errors) -> Result<Vec<u8>> {
        let count = self.points_of.len();
        let batch = rayon::current_num_threads().max(1);
        let next: Mutex<Option<Result<Vec<Finished>>>> = Mutex::new(None);
        let make = |first: usize| {
            let made = catch_unwind(AssertUnwindSafe(|| self.strips(first..(first + batch).min(count))));
            let made = made.unwrap_or_else(|_| Err(Failure::internal("a strip of a page cannot be made")));
            *next.lock().unwrap_or_else(PoisonError::into_inner) = Some(made);
        };
        let [width, height] = self.size;
        let state = RefCell::new(Reading { first: 0, batch: Vec::new(), failure: None, errors });
        let file = rayon::in_place_scope(|scope| {
            scope.spawn(|_| make(0));
            let row = |y: usize, take: &mut dyn FnMut(&[u8])| {
                let mut reading = state.borrow_mut();
                let strip = y / self.rows;
                if reading.failure.is_none() && strip >= reading.first + reading.batch.len() {
                    let first = reading.first + reading.batch.len();
                    let made = loop {
                        // The lock is free again before others work on this thread.
                        let made = next.lock().unwrap_or_else(PoisonError::into_inner).take();
                        if let Some(made) = made {
                            break made;
                        }
                        // With one thread this is what makes them.
                        if rayon::yield_now() != Some(rayon::Yield::Executed) {
                            std::thread::yield_now();
                        }
                    };
                    match made {
                        Ok(batch) => reading.take(first, batch),
                        Err(failure) => reading.failure = Some(failure),
                    }
                    let behind = first + reading.batch.len();
                    if reading.failure.is_none() && behind < count {
                        let make = &make;
                        scope.spawn(move |_| make(behind));
                    }
                }
                let at = (y - strip * self.rows) * width * C;
                let strip = strip.checked_sub(reading.first).and_then(|i| reading.batch.get(i));
                match strip.and_then(|s| s.texels.get(at..at + width * C)) {
                    Some(row) => take(row),
                    None => take(&vec![0; width * C]),
                }
            };
            encode_jpeg_rows(&RowSource { size: [width as u32, height as u32], channels: C, row: &row }, self.coding)
        });
        match state.into_inner().failure {
            Some(failure) => Err(failure),
            None => file,
        }
    }
}

/// Where the encoder is.
struct Reading<'e> {
    /// The first strip of the batch.
    first: usize,
    batch: Vec<Finished>,
    failure: Option<Failure>,
    errors: &'e mut Errors,
}

impl Reading<'_> {
    fn take(&mut self, first: usize, batch: Vec<Finished>) {
        for (i, error) in batch.iter().flat_map(|strip| &strip.errors) {
            self.errors.iter_mut().zip(error).for_each(|(errors, error)| errors[*i as usize] = *error);
        }
        (self.first, self.batch) = (first, batch);
    }
}

/// Some rows of a page, and how many covered texels there are.
fn baked<const C: usize>(baker: &Baker<'_, u8, C>, raster: &PageRaster, rows: Range<usize>) -> Result<(Baked, u64)> {
    let count = rows.len() * raster.width as usize;
    let (mut texels, mut states) = (vec![0; count * C], vec![state::FREE; count]);
    let counts = baker.band(raster, rows.start as u32, &mut texels, &mut states)?;
    Ok(((texels, states), counts.copied))
}
