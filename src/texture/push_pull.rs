//! Push-pull: the texels that nobody owns get smooth colours from those about them.
//!
//! S. J. Gortler and others, "The Lumigraph" (1996), section 3.5.3: averages are pulled up a pyramid with their weights and
//! pushed down again where weight is missing.

use rayon::prelude::*;

use super::Direction;
use super::pixels::Depth;
use super::transfer::{Space, Transfer, alpha_channel};
use crate::context::Context;
use crate::error::Result;

/// Rows of one parallel task.
const ROWS: usize = 32;

/// One level of the pyramid: means, and how well they are known in 0..=1.
struct Level<const C: usize> {
    width: usize,
    height: usize,
    texels: Vec<([f32; C], f32)>,
}

impl<const C: usize> Level<C> {
    /// Pulls up the next level, half as large. `below` gives a texel of the level below: its weighted value, its weight.
    fn pull(width: usize, height: usize, below: impl Fn(usize) -> ([f32; C], f32) + Sync) -> Self {
        let (w, h) = (width.div_ceil(2), height.div_ceil(2));
        let mut texels = vec![([0.0; C], 0.0); w * h];
        texels.par_chunks_mut(w).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            let pair = |at: usize, both: bool| if both { sum(below(at), below(at + 1)) } else { below(at) };
            for (x, out) in row.iter_mut().enumerate() {
                let (at, both) = (2 * y * width + 2 * x, 2 * x + 1 < width);
                let mut all = pair(at, both);
                if 2 * y + 1 < height {
                    all = sum(all, pair(at + width, both));
                }
                let (value, weight) = all;
                if weight > 0.0 {
                    *out = (value.map(|v| v / weight), weight.min(1.0));
                }
            }
        });
        Level { width: w, height: h, texels }
    }

    /// What this level pushes down to a texel of the level below: its bilinear value there.
    #[inline]
    fn push(&self, x: usize, y: usize) -> [f32; C] {
        // The near texel has 3/4 of the weight, the one on the other side of the half 1/4.
        let other = |i: usize, size: usize| {
            if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(size - 1) }
        };
        let (x0, y0) = (x / 2, y / 2);
        let (x1, y1) = (other(x, self.width), other(y, self.height));
        let mut out = [0.0; C];
        for (sx, sy, weight) in [(x0, y0, 0.5625), (x1, y0, 0.1875), (x0, y1, 0.1875), (x1, y1, 0.0625)] {
            let value = &self.texels[sy * self.width + sx].0;
            out.iter_mut().zip(value).for_each(|(o, v)| *o += weight * v);
        }
        out
    }
}

#[inline]
fn sum<const C: usize>(a: ([f32; C], f32), b: ([f32; C], f32)) -> ([f32; C], f32) {
    (std::array::from_fn(|c| a.0[c] + b.0[c]), a.1 + b.1)
}

/// Fills the texels of a `width`-wide image for which `known` is 0. An image without a known texel becomes black (opaque), or flat.
pub(crate) fn push_pull<T: Depth, const C: usize>(
    texels: &mut [T],
    known: &[u8],
    width: usize,
    transfer: &Transfer<T>,
    context: &Context,
) -> Result<()> {
    let height = known.len().checked_div(width).unwrap_or(0);
    if !known.contains(&0) {
        return Ok(());
    }
    context.check()?;
    let pixels = &*texels;
    let mut pyramid = vec![Level::<C>::pull(width, height, |i| match known[i] {
        0 => ([0.0; C], 0.0),
        _ => (transfer.decode::<C>(&pixels[i * C..(i + 1) * C]), 1.0),
    })];
    while let Some(level) = pyramid.last().filter(|l| l.width > 1 || l.height > 1) {
        context.check()?;
        pyramid.push(Level::pull(level.width, level.height, |i| {
            let (value, weight) = level.texels[i];
            (value.map(|v| weight * v), weight)
        }));
    }
    if let Some((value, weight)) = pyramid.last_mut().and_then(|top| top.texels.first_mut())
        && *weight == 0.0
    {
        *value = neutral(transfer.space);
    }
    // Down to the level above the image, then the image itself.
    for l in (0..pyramid.len().saturating_sub(1)).rev() {
        context.check()?;
        let (lower, upper) = pyramid.split_at_mut(l + 1);
        let (Some(level), Some(above)) = (lower.last_mut(), upper.first()) else { continue };
        let w = level.width;
        level.texels.par_chunks_mut(w).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            for (x, (value, weight)) in row.iter_mut().enumerate() {
                if *weight < 1.0 {
                    let pushed = above.push(x, y);
                    value.iter_mut().zip(pushed).for_each(|(v, p)| *v = *weight * *v + (1.0 - *weight) * p);
                }
            }
        });
    }
    context.check()?;
    let Some(first) = pyramid.first() else { return Ok(()) };
    let rows = texels.par_chunks_mut(width * C).zip(known.par_chunks(width)).with_min_len(ROWS).enumerate();
    rows.for_each(|(y, (row, known))| {
        for (x, (texel, known)) in row.chunks_exact_mut(C).zip(known).enumerate() {
            if *known == 0 {
                transfer.encode::<C>(first.push(x, y), texel);
            }
        }
    });
    Ok(())
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
            assert!(row.windows(2).all(|p| i32::from(p[1]) - i32::from(p[0]) >= -3), "{row:?}");
        }
    }
}
