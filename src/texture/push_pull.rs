//! Push-pull: the texels that nobody owns get the colours of those about them.
//!
//! S. J. Gortler and others, "The Lumigraph" (1996), section 3.5.3: averages are pulled up a pyramid with their weights and
//! pushed down again where weight is missing. Its lowest level here are blocks of 8 x 8 texels, which is what encoders of images work by:
//! filled texels of a block have one colour, which costs next to nothing in a file. Mip levels that are coarser than a block see no difference.

use rayon::prelude::*;

use super::Direction;
use super::pixels::Depth;
use super::transfer::{Space, Transfer, alpha_channel};
use crate::context::Context;
use crate::error::Result;

/// Side of a block in texels.
pub(crate) const BLOCK: usize = 8;
/// Rows of one parallel task.
const ROWS: usize = 32;

/// A texel of the pyramid: its mean, and how well that is known in 0..=1.
pub(crate) type Mean<const C: usize> = ([f32; C], f32);

/// One level of the pyramid.
struct Level<const C: usize> {
    width: usize,
    height: usize,
    texels: Vec<Mean<C>>,
}

impl<const C: usize> Level<C> {
    /// The next level, half as large.
    fn pulled(&self) -> Self {
        let (w, h) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut texels = vec![([0.0; C], 0.0); w * h];
        texels.par_chunks_mut(w).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            for (x, out) in row.iter_mut().enumerate() {
                let (mut value, mut weight) = ([0.0; C], 0.0);
                for below in (2 * y..(2 * y + 2).min(self.height)).map(|y| self.row(y)) {
                    for (own, known) in &below[2 * x..(2 * x + 2).min(self.width)] {
                        value.iter_mut().zip(own).for_each(|(sum, v)| *sum += known * v);
                        weight += known;
                    }
                }
                if weight > 0.0 {
                    *out = (value.map(|v| v / weight), weight.min(1.0));
                }
            }
        });
        Level { width: w, height: h, texels }
    }

    fn row(&self, y: usize) -> &[Mean<C>] {
        &self.texels[y * self.width..(y + 1) * self.width]
    }

    /// What this level pushes down to a texel of the level below: its bilinear value there.
    #[inline]
    fn push(&self, x: usize, y: usize) -> [f32; C] {
        let (near, far) = (self.row(y / 2), self.row(other(y, self.height)));
        let (x0, x1) = (x / 2, other(x, self.width));
        let mut out = [0.0; C];
        for ((value, _), weight) in [(&near[x0], 0.5625), (&near[x1], 0.1875), (&far[x0], 0.1875), (&far[x1], 0.0625)] {
            out.iter_mut().zip(value).for_each(|(o, v)| *o += weight * v);
        }
        out
    }
}

/// Beside the texel above place `i` of the level below, which has 3/4 of the weight: the one on the other side of the half, which has 1/4.
#[inline]
fn other(i: usize, size: usize) -> usize {
    if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(size - 1) }
}

/// Fills the texels of a `width`-wide image for which `known` is 0. An image without a known texel becomes black (opaque), or flat.
pub(crate) fn push_pull<T: Depth, const C: usize>(
    texels: &mut [T],
    known: &[u8],
    width: usize,
    transfer: &Transfer<T>,
    context: &Context,
) -> Result<()> {
    if !known.contains(&0) {
        return Ok(());
    }
    context.check()?;
    let height = known.len() / width;
    let strips = texels.par_chunks(ROWS * width * C).zip(known.par_chunks(ROWS * width));
    let means: Vec<Vec<Mean<C>>> =
        strips.map(|(texels, known)| block_means::<T, C>(texels, known, width, transfer)).collect();
    let fill = Fill::new([width, height], means.into_iter(), transfer.space, context)?;
    let strips = texels.par_chunks_mut(ROWS * width * C).zip(known.par_chunks(ROWS * width)).enumerate();
    strips.for_each(|(strip, (texels, known))| fill.fill(texels, known, strip * ROWS, transfer));
    Ok(())
}

/// Means of the known texels of blocks, row by row, over some rows of an image that begin with a block.
pub(crate) fn block_means<T: Depth, const C: usize>(
    texels: &[T],
    known: &[u8],
    width: usize,
    transfer: &Transfer<T>,
) -> Vec<Mean<C>> {
    let columns = width.div_ceil(BLOCK);
    let mut means = Vec::with_capacity(columns * (known.len() / width).div_ceil(BLOCK));
    let rows = texels.chunks(BLOCK * width * C).zip(known.chunks(BLOCK * width));
    for (texels, known) in rows {
        let mut sums = vec![([0.0f32; C], 0u32); columns];
        for (texels, known) in texels.chunks_exact(width * C).zip(known.chunks_exact(width)) {
            let blocks = texels.chunks(BLOCK * C).zip(known.chunks(BLOCK));
            for ((sum, count), (texels, known)) in sums.iter_mut().zip(blocks) {
                for (texel, _) in texels.chunks_exact(C).zip(known).filter(|(_, known)| **known != 0) {
                    sum.iter_mut().zip(transfer.decode::<C>(texel)).for_each(|(sum, v)| *sum += v);
                    *count += 1;
                }
            }
        }
        means.extend(sums.into_iter().map(|(sum, count)| match count {
            0 => ([0.0; C], 0.0),
            _ => (sum.map(|v| v / count as f32), 1.0),
        }));
    }
    means
}

/// What the blocks of an image are filled with.
pub(crate) struct Fill<const C: usize> {
    width: usize,
    blocks: Level<C>,
}

impl<const C: usize> Fill<C> {
    /// From the [`block_means`] of strips that make up an image of `size`, in their order.
    pub(crate) fn new(
        size: [usize; 2],
        strips: impl Iterator<Item = Vec<Mean<C>>>,
        space: Space,
        context: &Context,
    ) -> Result<Self> {
        let [width, height] = size.map(|side| side.div_ceil(BLOCK));
        let mut texels = Vec::with_capacity(width * height);
        strips.for_each(|rows| texels.extend(rows));
        let mut pyramid = vec![Level { width, height, texels }];
        while let Some(level) = pyramid.last().filter(|l| l.width > 1 || l.height > 1) {
            context.check()?;
            let next = level.pulled();
            pyramid.push(next);
        }
        let mut above: Option<Level<C>> = None;
        while let Some(mut level) = pyramid.pop() {
            context.check()?;
            let w = level.width;
            level.texels.par_chunks_mut(w).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
                for (x, (value, weight)) in row.iter_mut().enumerate().filter(|(_, (_, weight))| *weight == 0.0) {
                    (*value, *weight) = (above.as_ref().map_or_else(|| neutral(space), |above| above.push(x, y)), 1.0);
                }
            });
            above = Some(level);
        }
        let blocks = above.unwrap_or(Level { width, height, texels: Vec::new() });
        Ok(Fill { width: size[0], blocks })
    }

    /// Fills some rows from row `top` on.
    pub(crate) fn fill<T: Depth>(&self, texels: &mut [T], known: &[u8], top: usize, transfer: &Transfer<T>) {
        let rows = texels.chunks_exact_mut(self.width * C).zip(known.chunks_exact(self.width)).enumerate();
        for (y, (row, known)) in rows {
            let blocks = row.chunks_mut(BLOCK * C).zip(known.chunks(BLOCK)).zip(self.blocks.row((top + y) / BLOCK));
            for ((texels, known), (value, _)) in blocks.filter(|((_, known), _)| known.contains(&0)) {
                let mut colour: [T; C] = std::array::from_fn(|c| texels[c]);
                transfer.encode::<C>(*value, &mut colour);
                for (texel, _) in texels.chunks_exact_mut(C).zip(known).filter(|(_, known)| **known == 0) {
                    texel.copy_from_slice(&colour);
                }
            }
        }
    }
}

/// What stands where nothing is known.
fn neutral<const C: usize>(space: Space) -> [f32; C] {
    let neutral = match space {
        Space::Directed(Direction::Normal) => Some(2),
        Space::Directed(Direction::Anisotropy) => Some(0),
        _ => None,
    };
    std::array::from_fn(|c| f32::from(u8::from(alpha_channel(C) == Some(c) || neutral == Some(c))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filled(width: usize, height: usize, value: [u8; 4], known: impl Fn(usize) -> bool) -> Vec<u8> {
        let mask: Vec<u8> = (0..width * height).map(|i| u8::from(known(i))).collect();
        let mut texels: Vec<u8> = mask.iter().flat_map(|k| if *k == 1 { value } else { [9; 4] }).collect();
        let transfer = Transfer::<u8>::new(Space::Srgb);
        push_pull::<u8, 4>(&mut texels, &mask, width, &transfer, &Context::silent()).unwrap();
        texels
    }

    #[test]
    fn a_constant_fills_to_the_same_constant_at_any_size() {
        for (w, h) in [(1, 1), (1, 7), (16, 16), (33, 5), (100, 67)] {
            let value = [200, 3, 90, 128];
            let out = filled(w, h, value, |i| i == w * h / 2 || i % 37 == 5);
            assert!(out.chunks_exact(4).all(|t| t == value), "{w} x {h}");
        }
    }

    /// Blocks of 8 x 8, each the mean of what is known in it, else what the levels above give.
    #[test]
    fn blocks_have_the_mean_of_what_is_known_in_them() {
        for (w, h) in [(1, 1), (3, 2), (16, 8), (40, 129), (9, 193)] {
            let known: Vec<u8> = (0..w * h).map(|i| u8::from(i * 7919 % 50 == 0)).collect();
            let uploaded: Vec<u16> = (0..w * h).map(|i| (i * 40_503 % 65_536) as u16).collect();
            let mut texels = uploaded.clone();
            let transfer = Transfer::<u16>::new(Space::Linear);
            push_pull::<u16, 1>(&mut texels, &known, w, &transfer, &Context::silent()).unwrap();
            for i in 0..w * h {
                let block = [i % w / BLOCK, i / w / BLOCK];
                let own = (0..w * h).filter(|k| known[*k] == 1 && [k % w / BLOCK, k / w / BLOCK] == block);
                let (sum, count) = own.fold((0.0, 0.0), |(sum, count), k| (sum + f64::from(uploaded[k]), count + 1.0));
                let expected = if known[i] == 1 { f64::from(uploaded[i]) } else { sum / count };
                let close = (f64::from(texels[i]) - expected).abs() <= 1.0;
                assert!(close || count == 0.0 && known[i] == 0, "{i} of {w} x {h}: {}, not {expected}", texels[i]);
            }
        }
    }

    #[test]
    fn an_image_that_is_filled_by_strips_is_what_it_is_as_a_whole() {
        for (w, h) in [(16, 16), (17, 64), (33, 129), (40, 200), (16, 43)] {
            for part in [5, 97, 100_000] {
                let known: Vec<u8> = (0..w * h).map(|i| u8::from(i * 7919 % part == 0)).collect();
                let texels: Vec<u8> = (0..w * h * 3).map(|i| (i * 40_503 % 253) as u8).collect();
                let transfer = Transfer::<u8>::new(Space::Srgb);
                let context = Context::silent();
                let mut whole = texels.clone();
                push_pull::<u8, 3>(&mut whole, &known, w, &transfer, &context).unwrap();
                let strips = || (0..h).step_by(24).map(|top| top..(top + 24).min(h));
                let means = strips().map(|rows| {
                    let texels = &texels[rows.start * w * 3..rows.end * w * 3];
                    block_means::<u8, 3>(texels, &known[rows.start * w..rows.end * w], w, &transfer)
                });
                let fill = Fill::<3>::new([w, h], means, transfer.space, &context).unwrap();
                // Any rows can be filled.
                for rows in (0..h).step_by(7).map(|top| top..(top + 7).min(h)) {
                    let mut own = texels[rows.start * w * 3..rows.end * w * 3].to_vec();
                    fill.fill(&mut own, &known[rows.start * w..rows.end * w], rows.start, &transfer);
                    assert_eq!(own, whole[rows.start * w * 3..rows.end * w * 3], "{rows:?} of {w} x {h}");
                }
            }
        }
    }

    #[test]
    fn nothing_known_is_black_and_opaque() {
        let out = filled(5, 3, [1; 4], |_| false);
        assert!(out.chunks_exact(4).all(|t| t == [0, 0, 0, 255]));
    }

    #[test]
    fn known_texels_stay_and_others_lie_between() {
        let (w, h) = (64, 48);
        let mask: Vec<u8> = (0..w * h).map(|i| u8::from(i % w == 0 || i % w == w - 1)).collect();
        let mut texels: Vec<u8> = (0..w * h).map(|i| if i % w == 0 { 20 } else { 220 }).collect();
        let transfer = Transfer::<u8>::new(Space::Linear);
        push_pull::<u8, 1>(&mut texels, &mask, w, &transfer, &Context::silent()).unwrap();
        for y in 0..h {
            let row = &texels[y * w..(y + 1) * w];
            assert_eq!((row[0], row[w - 1]), (20, 220));
            assert!(row.iter().all(|v| (20..=220).contains(v)));
            assert!(row[1..w - 1].windows(2).all(|p| i32::from(p[1]) - i32::from(p[0]) >= -3), "{row:?}");
        }
    }
}
