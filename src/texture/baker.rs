//! Bakes a page by bands of rows: texels copied, resampled, fitted.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use glam::DVec2;

use super::bilinear_fit::{BilinearFit, HALO, QUADRATURE};
use super::coverage::{Coverage, NO_FACE, PageRaster};
use super::direction::{Turn, turn_vector};
use super::pixels::Depth;
use super::sampler::{Footprint, Sampler};
use super::texel_map::{TexelMap, TexelMaps};
use super::transfer::{Space, Transfer, alpha_channel};
use super::{Alpha, Bake};
use crate::context::Context;
use crate::error::Result;

/// What a texel of the page is.
pub(crate) mod state {
    /// Nobody's: filled at the end.
    pub(crate) const FREE: u8 = 0;
    /// Unchanged.
    pub(crate) const COPIED: u8 = 1;
    /// Resampled; no face covers its centre.
    pub(crate) const RING_RESAMPLED: u8 = 2;
    /// Resampled, with a face over its centre.
    pub(crate) const RESAMPLED: u8 = 3;
}

/// Columns of a band that are copied together: where a chart was turned by a quarter they are rows of the upload, and what is read of
/// these stays at hand from one row of the band to the next.
const TILE: usize = 128;

/// What all bands of a slot share.
pub(crate) struct Baker<'a, T, const C: usize> {
    pub(crate) job: &'a Bake<'a>,
    /// By source.
    pub(crate) samplers: Vec<Sampler<'a, T, C>>,
    /// Averages: linear light.
    pub(crate) transfer: &'a Transfer<T>,
    /// Interpolates: [`Transfer::shown`].
    pub(crate) shown: &'a Transfer<T>,
    pub(crate) maps: TexelMaps,
    /// By map; none where texels are copied.
    pub(crate) footprints: Vec<Option<Footprint>>,
    pub(crate) context: &'a Context,
    /// Cutoff of a mask whose coverage is kept.
    pub(crate) cutoff: Option<f32>,
    /// Owners of bands that are done, for the memory that they have.
    pub(crate) spare: Mutex<Vec<Coverage>>,
}

/// What is counted while a band is baked.
pub(crate) struct Counts {
    /// Copied texels whose centre a face covers.
    pub(crate) copied: u64,
    /// Resampled and covered texels by alpha, in 1/255.
    pub(crate) alphas: [u64; 256],
    /// Quarters of those texels that the uploaded mask shows.
    pub(crate) shown: u64,
}

/// A run of texels of one row that have one map.
struct Run {
    map: usize,
    columns: Range<usize>,
}

impl<T: Depth, const C: usize> Baker<'_, T, C> {
    /// Bakes the rows from `top` on that `out` and `states` hold.
    pub(crate) fn band(&self, page: &PageRaster, top: u32, out: &mut [T], states: &mut [u8]) -> Result<Counts> {
        let width = page.width as usize;
        let has_fit = self.footprints.iter().any(|f| matches!(f, Some(Footprint::Point)));
        let halo = if has_fit { HALO } else { 0 };
        let first = top.saturating_sub(halo);
        let last = (top + (states.len() / width) as u32).saturating_add(halo).min(page.height);
        let mut coverage = self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        page.rows(first, last - first, self.context, &self.maps, &mut coverage)?;
        let has_fit = has_fit && coverage.owner.iter().any(|owner| self.interpolates(*owner));
        let mut fit = has_fit.then(|| BilinearFit::new(width, coverage.owner.len()));
        let mut counts = Counts { copied: 0, alphas: [0; 256], shown: 0 };
        let mut beyond = vec![T::default(); width * C];
        let rows = 0..(last - first) as usize;
        // A fit takes its texels row by row.
        let tile = if has_fit { width } else { TILE };
        for left in (0..width).step_by(tile) {
            let columns = left..(left + tile).min(width);
            for row in rows.clone() {
                self.context.check()?;
                let y = first as usize + row;
                let core = y.checked_sub(top as usize).filter(|r| (r + 1) * width <= states.len());
                let line = match core {
                    Some(r) => &mut out[r * width * C..(r + 1) * width * C],
                    None if has_fit => &mut beyond[..],
                    None => continue,
                };
                self.row(&coverage, row, y, columns.clone(), line, fit.as_mut());
            }
        }
        for row in rows {
            let core = (first as usize + row).checked_sub(top as usize).filter(|r| (r + 1) * width <= states.len());
            if let Some(r) = core {
                self.mark(&coverage, row, &mut states[r * width..(r + 1) * width], &mut counts);
            }
        }
        if let Some(mut fit) = fit {
            self.context.check()?;
            fit.solve();
            let start = (top - first) as usize * width;
            for (i, texel) in out.chunks_exact_mut(C).enumerate() {
                if fit.free[start + i] {
                    self.shown.encode(fit.values[start + i], texel);
                }
            }
        }
        if let (Some(cutoff), Some(channel)) = (self.cutoff, alpha_channel(C)) {
            let start = (top - first) as usize * width;
            for (i, texel) in out.chunks_exact(C).enumerate().filter(|(i, _)| states[*i] == state::RESAMPLED) {
                let centre = DVec2::new((i % width) as f64 + 0.5, f64::from(top) + (i / width) as f64 + 0.5);
                let Some((map, source)) = self.maps.with_source(coverage.owner[start + i] as usize) else { continue };
                // Only masks keep their coverage.
                if !matches!(self.job.sources[source].alpha, Alpha::Mask(_)) {
                    continue;
                }
                let sampler = &self.samplers[source];
                counts.alphas[((texel[channel].value() * 255 + T::MAX / 2) / T::MAX) as usize & 255] += 1;
                let shown = |offset: &&[f64; 2]| {
                    let point = map.apply(centre + DVec2::from(**offset));
                    sampler.bilinear(point, self.shown)[channel] >= cutoff
                };
                counts.shown += QUADRATURE.iter().filter(shown).count() as u64;
            }
        }
        self.spare.lock().unwrap_or_else(PoisonError::into_inner).push(coverage);
        Ok(counts)
    }

    /// Whether a face's texels are interpolated (and then fitted).
    fn interpolates(&self, face: u32) -> bool {
        let map = self.maps.of_face.get(face as usize).copied().unwrap_or(TexelMaps::NONE);
        matches!(self.footprints.get(map as usize), Some(Some(Footprint::Point)))
    }

    /// The runs of `owners`, which begin at column `x`.
    fn runs<'b>(&'b self, mut x: usize, owners: &'b [u32]) -> impl Iterator<Item = Run> + 'b {
        let map_of = |owner: u32| if owner == NO_FACE { TexelMaps::NONE } else { self.maps.of_face[owner as usize] };
        owners.chunk_by(move |a, b| a == b || map_of(*a) == map_of(*b)).filter_map(move |run| {
            let columns = x..x + run.len();
            x = columns.end;
            let map = map_of(*run.first()?) as usize;
            (map < self.maps.all.len()).then_some(Run { map, columns })
        })
    }

    /// Copies or resamples the texels of one row that lie in some columns.
    fn row(
        &self,
        coverage: &Coverage,
        row: usize,
        y: usize,
        columns: Range<usize>,
        line: &mut [T],
        mut fit: Option<&mut BilinearFit<C>>,
    ) {
        let width = line.len() / C;
        let owners = &coverage.owner[row * width + columns.start..row * width + columns.end];
        for Run { map, columns } in self.runs(columns.start, owners) {
            let out = &mut line[columns.start * C..columns.end * C];
            let start = row * width + columns.start;
            let sampler = &self.samplers[self.maps.source[map] as usize];
            match (&self.maps.all[map], &self.footprints[map]) {
                (TexelMap::Exact { turn, shift }, _) => {
                    self.copy(sampler, *turn, *shift, [columns.start as i64, y as i64], out)
                }
                (_, None) => continue,
                (affine, Some(footprint)) => {
                    for (i, texel) in out.chunks_exact_mut(C).enumerate() {
                        let centre = DVec2::new((columns.start + i) as f64 + 0.5, y as f64 + 0.5);
                        let value = self.turned(affine, sampler.sample(affine.apply(centre), footprint));
                        sampler.transfer_of(footprint).encode(value, texel);
                        if let (Some(fit), Footprint::Point) = (fit.as_deref_mut(), footprint) {
                            fit.free[start + i] = true;
                            if coverage.distance[start + i] == 0.0 {
                                fit.target_of[start + i] = fit.targets.len() as u32;
                                fit.targets.push(QUADRATURE.map(|offset| {
                                    let point = affine.apply(centre + DVec2::from(offset));
                                    self.turned(affine, sampler.bilinear(point, self.shown))
                                }));
                            }
                            fit.values[start + i] = value;
                        }
                    }
                }
            }
            if let Some(fit) = fit.as_deref_mut() {
                for (i, texel) in out.chunks_exact(C).enumerate().filter(|(i, _)| !fit.free[start + i]) {
                    fit.values[start + i] = self.shown.decode(texel);
                }
            }
        }
    }

    /// Notes what the texels of a row are.
    fn mark(&self, coverage: &Coverage, row: usize, states: &mut [u8], counts: &mut Counts) {
        let start = row * states.len();
        for Run { map, columns } in self.runs(0, &coverage.owner[start..start + states.len()]) {
            let distance = &coverage.distance[start + columns.start..start + columns.end];
            let states = &mut states[columns];
            if self.footprints[map].is_none() {
                states.fill(state::COPIED);
                if !self.job.sources[self.maps.source[map] as usize].neutral {
                    counts.copied += distance.iter().filter(|d| **d == 0.0).count() as u64;
                }
            } else {
                for (s, d) in states.iter_mut().zip(distance) {
                    *s = if *d == 0.0 { state::RESAMPLED } else { state::RING_RESAMPLED };
                }
            }
        }
    }

    /// A direction turns with its chart; other values stay.
    #[inline]
    fn turned(&self, map: &TexelMap, mut value: [f32; C]) -> [f32; C] {
        if let (TexelMap::Affine { rotation, .. }, Space::Directed(_)) = (map, self.transfer.space) {
            turn_vector(rotation.to_cols_array().map(|v| v as f32), &mut value);
        }
        value
    }

    /// Copies a run of texels from `at` on.
    fn copy(&self, sampler: &Sampler<'_, T, C>, turn: Turn, shift: [i64; 2], at: [i64; 2], out: &mut [T]) {
        let count = (out.len() / C) as i64;
        let axis = |k: usize| {
            let (a, b) = (i64::from(turn.x[k]), i64::from(turn.y[k]));
            // A centre at i + 1/2 that is mirrored about an integer lies one texel lower.
            a * at[0] + b * at[1] + shift[k] - i64::from(a + b < 0)
        };
        let (x, y) = (axis(0), axis(1));
        let (dx, dy) = (i64::from(turn.x[0]), i64::from(turn.x[1]));
        let [w, h] = sampler.size;
        let (last_x, last_y) = (x + dx * (count - 1), y + dy * (count - 1));
        let inside = [x, last_x].iter().all(|v| (0..w).contains(v)) && [y, last_y].iter().all(|v| (0..h).contains(v));
        if inside && dx == 1 {
            let start = sampler.index(x, y);
            out.copy_from_slice(&sampler.texels[start..start + out.len()]);
        } else if inside {
            let (mut from, step) = (sampler.index(x, y), ((dx + dy * w) * C as i64) as isize);
            for texel in out.chunks_exact_mut(C) {
                texel.copy_from_slice(&sampler.texels[from..from + C]);
                from = from.wrapping_add_signed(step);
            }
        } else {
            let mut place = [x, y];
            for texel in out.chunks_exact_mut(C) {
                let from = sampler.index(place[0], place[1]);
                texel.copy_from_slice(&sampler.texels[from..from + C]);
                place = [place[0] + dx, place[1] + dy];
            }
        }
        if matches!(sampler.transfer.space, Space::Directed(_)) && !turn.is_identity() {
            out.chunks_exact_mut(C).for_each(|texel| turn.turn_samples(texel));
        }
    }
}
