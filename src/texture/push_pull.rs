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

/// A texel of the pyramid: its mean, and how well that is known in 0..=1.
type Mean<const C: usize> = ([f32; C], f32);

/// One level of the pyramid, of those above the first.
struct Level<const C: usize> {
    width: usize,
    height: usize,
    texels: Vec<Mean<C>>,
}

impl<const C: usize> Level<C> {
    /// Pulls up the next level, half as large. `below` gives a texel of the level below: its weighted value, its weight.
    fn pull(width: usize, height: usize, below: impl Fn(usize, usize) -> Mean<C> + Sync) -> Self {
        let (w, h) = (width.div_ceil(2), height.div_ceil(2));
        let mut texels = vec![([0.0; C], 0.0); w * h];
        texels.par_chunks_mut(w).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            for (x, out) in row.iter_mut().enumerate() {
                *out = mean([width, height], x, y, &below);
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
        push(self.row(y / 2), self.row(other(y, self.height)), x)
    }
}

/// The mean of the up to four texels under a texel of the next level; `size` is that of the level below.
#[inline]
fn mean<const C: usize>(
    [width, height]: [usize; 2],
    x: usize,
    y: usize,
    below: impl Fn(usize, usize) -> Mean<C>,
) -> Mean<C> {
    let both = 2 * x + 1 < width;
    let pair = |y: usize| if both { sum(below(2 * x, y), below(2 * x + 1, y)) } else { below(2 * x, y) };
    let mut all = pair(2 * y);
    if 2 * y + 1 < height {
        all = sum(all, pair(2 * y + 1));
    }
    let (value, weight) = all;
    if weight > 0.0 { (value.map(|v| v / weight), weight.min(1.0)) } else { ([0.0; C], 0.0) }
}

/// Beside the texel above place `i` of the level below, which has 3/4 of the weight: the one on the other side of the half, which has 1/4.
#[inline]
fn other(i: usize, size: usize) -> usize {
    if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(size - 1) }
}

/// The bilinear value at place `x` of a row of the level below, of the nearer and the farther row of the level above.
#[inline]
fn push<const C: usize>(near: &[Mean<C>], far: &[Mean<C>], x: usize) -> [f32; C] {
    let (x0, x1) = (x / 2, other(x, near.len()));
    let mut out = [0.0; C];
    for ((value, _), weight) in [(&near[x0], 0.5625), (&near[x1], 0.1875), (&far[x0], 0.1875), (&far[x1], 0.0625)] {
        out.iter_mut().zip(value).for_each(|(o, v)| *o += weight * v);
    }
    out
}

/// What a texel becomes whose place has the value `pushed` on the level above.
#[inline]
fn fill<const C: usize>((value, weight): &mut Mean<C>, pushed: impl FnOnce() -> [f32; C]) {
    if *weight < 1.0 {
        value.iter_mut().zip(pushed()).for_each(|(v, p)| *v = *weight * *v + (1.0 - *weight) * p);
    }
}

#[inline]
fn sum<const C: usize>(a: Mean<C>, b: Mean<C>) -> Mean<C> {
    (std::array::from_fn(|c| a.0[c] + b.0[c]), a.1 + b.1)
}

/// Some rows of the image. The first level of the pyramid is made of them where it is read, and nowhere kept: a quarter of the texels, in
/// floats, it would take more room than the image.
#[derive(Clone, Copy)]
struct Rows<'a, T, const C: usize> {
    texels: &'a [T],
    known: &'a [u8],
    width: usize,
    transfer: &'a Transfer<T>,
}

impl<T: Depth, const C: usize> Rows<'_, T, C> {
    fn size(&self) -> [usize; 2] {
        [self.width, self.known.len() / self.width]
    }

    /// A texel of the first level.
    #[inline]
    fn first(&self, x: usize, y: usize) -> Mean<C> {
        mean(self.size(), x, y, |x, y| {
            let i = y * self.width + x;
            match self.known[i] {
                0 => ([0.0; C], 0.0),
                _ => (self.transfer.decode::<C>(&self.texels[i * C..(i + 1) * C]), 1.0),
            }
        })
    }

    /// A row of the first level, filled from the level `above`, where it is row `y`.
    fn filled(&self, own: usize, above: Option<&Level<C>>, y: usize) -> Vec<Mean<C>> {
        let row = (0..self.width.div_ceil(2)).map(|x| {
            let mut texel = self.first(x, own);
            match above {
                Some(above) => fill(&mut texel, || above.push(x, y)),
                None if texel.1 == 0.0 => texel.0 = neutral(self.transfer.space),
                None => {}
            }
            texel
        });
        row.collect()
    }
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
    let image = Rows::<T, C> { texels, known, width, transfer };
    let [w, h] = image.size().map(|side| side.div_ceil(2));
    let mut pyramid: Vec<Level<C>> = Vec::new();
    if w > 1 || h > 1 {
        pyramid.push(Level::pull(w, h, |x, y| weighted(image.first(x, y))));
    }
    complete(&mut pyramid, transfer.space, context)?;
    context.check()?;
    // Tasks read the first level's rows at each other's ends: these are made before any task writes.
    let above = pyramid.first();
    let rows = |texels: &[T], known: &[u8], own: usize, y: usize| {
        Rows::<T, C> { texels, known, width, transfer }.filled(own, above, y)
    };
    let tasks = known.par_chunks(2 * ROWS * width).enumerate();
    let ends: Vec<[Vec<Mean<C>>; 2]> = tasks
        .map(|(task, own)| {
            let first = task * ROWS;
            let last = first + (own.len() / width).div_ceil(2) - 1;
            [first, last].map(|y| image.filled(y, above, y))
        })
        .collect();
    let tasks = texels.par_chunks_mut(2 * ROWS * width * C).zip(known.par_chunks(2 * ROWS * width)).enumerate();
    tasks.for_each(|(task, (texels, known))| {
        let (first, count) = (task * ROWS, (known.len() / width).div_ceil(2));
        let before = task.checked_sub(1).map(|t| ends[t][1].clone());
        let behind = ends.get(task + 1).map(|ends| ends[0].clone());
        let own = (0..count).map(|y| rows(texels, known, y, first + y));
        let level: Vec<Vec<Mean<C>>> = before.into_iter().chain(own).chain(behind).collect();
        // The row of `level` that is the first of this task.
        let offset = usize::from(task > 0);
        let pairs = texels.chunks_exact_mut(width * C).zip(known.chunks_exact(width)).enumerate();
        for (y, (row, known)) in pairs {
            let (near, far) = (y / 2 + offset, other(y + 2 * offset, level.len()));
            for (x, (texel, known)) in row.chunks_exact_mut(C).zip(known).enumerate() {
                if *known == 0 {
                    transfer.encode::<C>(push(&level[near], &level[far], x), texel);
                }
            }
        }
    });
    Ok(())
}

#[inline]
fn weighted<const C: usize>((value, weight): Mean<C>) -> Mean<C> {
    (value.map(|v| weight * v), weight)
}

/// Pulls up what is above the levels that are there, and pushes it down as far as the first of them.
fn complete<const C: usize>(pyramid: &mut Vec<Level<C>>, space: Space, context: &Context) -> Result<()> {
    while let Some(level) = pyramid.last().filter(|l| l.width > 1 || l.height > 1) {
        context.check()?;
        pyramid.push(Level::pull(level.width, level.height, |x, y| weighted(level.row(y)[x])));
    }
    if let Some((value, weight)) = pyramid.last_mut().and_then(|top| top.texels.first_mut())
        && *weight == 0.0
    {
        *value = neutral(space);
    }
    for l in (0..pyramid.len().saturating_sub(1)).rev() {
        context.check()?;
        let (lower, upper) = pyramid.split_at_mut(l + 1);
        let (Some(level), Some(above)) = (lower.last_mut(), upper.first()) else { continue };
        let w = level.width;
        level.texels.par_chunks_mut(w).with_min_len(ROWS).enumerate().for_each(|(y, row)| {
            row.iter_mut().enumerate().for_each(|(x, texel)| fill(texel, || above.push(x, y)));
        });
    }
    Ok(())
}

/// Rows of an image that are filled by themselves, and the halo of rows about them that this reads.
pub(crate) struct Strip<'a, T> {
    pub(crate) texels: &'a mut [T],
    /// 0 where a texel is to be filled.
    pub(crate) known: &'a [u8],
    /// The first of the rows: a multiple of [`STRIP_STEP`]. The last one is, or is the image's last.
    pub(crate) top: usize,
    /// Width and height of the image.
    pub(crate) size: [usize; 2],
}

/// Strips begin at multiples of this many rows: those of one row of the third level.
pub(crate) const STRIP_STEP: usize = 8;
/// Rows at the ends of a strip that are not the image's: they are read, and not filled.
pub(crate) const UNFILLED: usize = 8;

/// Some rows of one of the first levels.
struct LevelRows<const C: usize> {
    top: usize,
    /// Width and height of the level.
    size: [usize; 2],
    texels: Vec<Mean<C>>,
}

impl<const C: usize> LevelRows<C> {
    /// Those over `rows` of the level below.
    fn pull(size_below: [usize; 2], rows: std::ops::Range<usize>, below: impl Fn(usize, usize) -> Mean<C>) -> Self {
        let size = size_below.map(|side| side.div_ceil(2));
        let own = rows.start / 2..rows.end.div_ceil(2);
        let mut texels = vec![([0.0; C], 0.0); own.len() * size[0]];
        for (row, y) in texels.chunks_exact_mut(size[0]).zip(own.clone()) {
            row.iter_mut().enumerate().for_each(|(x, texel)| *texel = mean(size_below, x, y, &below));
        }
        LevelRows { top: own.start, size, texels }
    }

    fn rows(&self) -> std::ops::Range<usize> {
        self.top..self.top + self.texels.len() / self.size[0]
    }

    fn row(&self, y: usize) -> &[Mean<C>] {
        &self.texels[(y - self.top) * self.size[0]..(y - self.top + 1) * self.size[0]]
    }

    /// The nearer and the farther row of this level about row `y` of the level below, where both are at hand.
    fn about(&self, y: usize) -> Option<[&[Mean<C>]; 2]> {
        let rows = [y / 2, other(y, self.size[1])];
        rows.iter().all(|y| self.rows().contains(y)).then(|| rows.map(|y| self.row(y)))
    }
}

impl<T: Depth> Strip<'_, T> {
    /// Its rows of the first and the second level.
    fn levels<const C: usize>(&self, transfer: &Transfer<T>) -> [LevelRows<C>; 2] {
        let width = self.size[0];
        let first = LevelRows::pull(self.size, self.top..self.top + self.known.len() / width, |x, y| {
            let i = (y - self.top) * width + x;
            match self.known[i] {
                0 => ([0.0; C], 0.0),
                _ => (transfer.decode::<C>(&self.texels[i * C..(i + 1) * C]), 1.0),
            }
        });
        let second = LevelRows::pull(first.size, first.rows(), |x, y| weighted(first.row(y)[x]));
        [first, second]
    }

    /// Its rows of the third level.
    fn third<const C: usize>(&self, transfer: &Transfer<T>) -> Vec<Mean<C>> {
        let [_, second] = self.levels::<C>(transfer);
        LevelRows::pull(second.size, second.rows(), |x, y| weighted(second.row(y)[x])).texels
    }
}

/// The pyramid of an image that is never held: from the third level on, a sixty-fourth of its texels.
pub(crate) struct StripFill<const C: usize> {
    third: Level<C>,
}

/// What a strip adds to the pyramid: its rows of the third level.
pub(crate) struct Pulled<const C: usize>(Vec<Mean<C>>);

impl<const C: usize> StripFill<C> {
    /// What one of the strips that make up the image adds; without a halo.
    pub(crate) fn pull<T: Depth>(strip: &Strip<'_, T>, transfer: &Transfer<T>) -> Pulled<C> {
        Pulled(strip.third(transfer))
    }

    /// The pyramid over all strips, in their order.
    pub(crate) fn new(
        size: [usize; 2],
        strips: impl Iterator<Item = Pulled<C>>,
        space: Space,
        context: &Context,
    ) -> Result<Self> {
        let [width, height] = size.map(|side| side.div_ceil(STRIP_STEP));
        let mut texels = Vec::with_capacity(width * height);
        strips.for_each(|Pulled(rows)| texels.extend(rows));
        let mut pyramid = vec![Level { width, height, texels }];
        complete(&mut pyramid, space, context)?;
        Ok(StripFill { third: pyramid.swap_remove(0) })
    }

    /// Fills a strip but for its ends, as [`push_pull`] fills the whole image.
    pub(crate) fn fill<T: Depth>(&self, strip: &mut Strip<'_, T>, transfer: &Transfer<T>) {
        if !strip.known.contains(&0) {
            return;
        }
        let [mut first, mut second] = strip.levels::<C>(transfer);
        for y in second.rows() {
            let (start, width) = ((y - second.top) * second.size[0], second.size[0]);
            let row = &mut second.texels[start..start + width];
            row.iter_mut().enumerate().for_each(|(x, texel)| fill(texel, || self.third.push(x, y)));
        }
        for y in first.rows() {
            let Some([near, far]) = second.about(y) else { continue };
            let (start, width) = ((y - first.top) * first.size[0], first.size[0]);
            let row = &mut first.texels[start..start + width];
            row.iter_mut().enumerate().for_each(|(x, texel)| fill(texel, || push(near, far, x)));
        }
        let [width, height] = strip.size;
        let rows = strip.top..strip.top + strip.known.len() / width;
        let filled = if rows.start == 0 { 0 } else { rows.start + UNFILLED }..if rows.end == height {
            height
        } else {
            rows.end.saturating_sub(UNFILLED)
        };
        for y in filled {
            let Some([near, far]) = first.about(y) else { continue };
            let start = (y - strip.top) * width;
            let texels = strip.texels[start * C..(start + width) * C].chunks_exact_mut(C);
            for (x, (texel, known)) in texels.zip(&strip.known[start..start + width]).enumerate() {
                if *known == 0 {
                    transfer.encode::<C>(push(near, far, x), texel);
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

    /// The same with all levels at hand, texel by texel.
    fn by_the_book(texels: &[f32], known: &[bool], w: usize, h: usize) -> Vec<f32> {
        if w == 1 && h == 1 {
            return texels.to_vec();
        }
        let (w1, h1) = (w.div_ceil(2), h.div_ceil(2));
        let (mut above, mut weights) = (vec![0.0; w1 * h1], vec![0.0f32; w1 * h1]);
        let weight_of = |i: usize| f32::from(u8::from(known[i]));
        for (i, texel) in texels.iter().enumerate().filter(|(i, _)| known[*i]) {
            let up = i / w / 2 * w1 + i % w / 2;
            above[up] += texel;
            weights[up] += weight_of(i);
        }
        above.iter_mut().zip(&weights).filter(|(_, w)| **w > 0.0).for_each(|(a, w)| *a /= w);
        let known_above: Vec<bool> = weights.iter().map(|w| *w > 0.0).collect();
        let above = by_the_book(&above, &known_above, w1, h1);
        let beside =
            |i: usize, size: usize| (if i.is_multiple_of(2) { (i / 2).max(1) - 1 } else { i / 2 + 1 }).min(size - 1);
        let at = |i: usize| {
            let (x, y) = (i % w, i / w);
            let (xs, ys) = ([x / 2, beside(x, w1)], [y / 2, beside(y, h1)]);
            let value = |x: usize, y: usize| above[ys[y] * w1 + xs[x]];
            0.5625 * value(0, 0) + 0.1875 * (value(1, 0) + value(0, 1)) + 0.0625 * value(1, 1)
        };
        (0..w * h).map(|i| if known[i] { texels[i] } else { at(i) }).collect()
    }

    #[test]
    fn rows_of_any_task_are_what_all_levels_give() {
        for (w, h) in [(1, 1), (2, 1), (3, 2), (5, 64), (7, 65), (40, 129), (9, 193), (1, 300)] {
            let known: Vec<u8> = (0..w * h).map(|i| u8::from(i * 7919 % 5 == 0)).collect();
            let mut texels: Vec<u16> = (0..w * h).map(|i| (i * 40_503 % 65_536) as u16).collect();
            let floats: Vec<f32> = texels.iter().map(|t| f32::from(*t)).collect();
            let known_texels: Vec<bool> = known.iter().map(|k| *k == 1).collect();
            let expected = by_the_book(&floats, &known_texels, w, h);
            let transfer = Transfer::<u16>::new(Space::Linear);
            push_pull::<u16, 1>(&mut texels, &known, w, &transfer, &Context::silent()).unwrap();
            for (i, (texel, expected)) in texels.iter().zip(expected).enumerate() {
                assert!((f32::from(*texel) - expected).abs() <= 1.0, "{i} of {w} x {h}: {texel}, not {expected}");
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
                let cut = |rows: std::ops::Range<usize>| {
                    (texels[rows.start * w * 3..rows.end * w * 3].to_vec(), &known[rows.start * w..rows.end * w])
                };
                let strips = || (0..h).step_by(24).map(|top| top..(top + 24).min(h));
                let pulled = strips().map(|rows| {
                    let (mut texels, known) = cut(rows.clone());
                    let strip = Strip { texels: &mut texels, known, top: rows.start, size: [w, h] };
                    StripFill::<3>::pull(&strip, &transfer)
                });
                let fill = StripFill::new([w, h], pulled, transfer.space, &context).unwrap();
                for rows in strips() {
                    let halo = rows.start.saturating_sub(UNFILLED)..(rows.end + UNFILLED).min(h);
                    let (mut texels, known) = cut(halo.clone());
                    fill.fill(&mut Strip { texels: &mut texels, known, top: halo.start, size: [w, h] }, &transfer);
                    let own = (rows.start - halo.start) * w * 3..(rows.end - halo.start) * w * 3;
                    assert_eq!(texels[own], whole[rows.start * w * 3..rows.end * w * 3], "{rows:?} of {w} x {h}");
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
            assert!(row.windows(2).all(|p| i32::from(p[1]) - i32::from(p[0]) >= -3), "{row:?}");
        }
    }
}
