//! Filters: what the uploaded image is worth at a point, over the footprint of a new texel.
//!
//! Where density is kept or rises, the six-point cubic convolution of R. Keys ("Cubic Convolution Interpolation for Digital
//! Image Processing", 1981, section V), which reproduces cubics; where it falls, the four-point kernel stretched over
//! the new texel's parallelogram, so that nothing aliases. Both are held within the range of the nearest texels: masks do not ring.
//! An anisotropy is interpolated as a renderer does it, by its components; the stretched kernel takes a direction and its
//! opposite for the same, so that neither cancels the other.

use glam::{DMat2, DVec2, Vec2};

use super::direction::{doubled, halved};
use super::pixels::Depth;
use super::transfer::{Space, Transfer, alpha_channel};
use super::{Direction, Wrap};

/// Texels of the uploaded image by new texel, along the longer axis, from which the kernel is stretched.
const MINIFIED: f64 = 1.2;
/// Taps along one axis of a stretched kernel, at most; beyond, one texel is read of every so many.
const TAPS: f64 = 64.0;

/// Reads one uploaded image.
pub(crate) struct Sampler<'a, T, const C: usize> {
    pub(crate) texels: &'a [T],
    pub(crate) size: [i64; 2],
    pub(crate) wrap: [Wrap; 2],
    /// Averages: linear light.
    pub(crate) transfer: &'a Transfer<T>,
    /// Interpolates: [`Transfer::shown`].
    pub(crate) shown: &'a Transfer<T>,
    /// Whether colour is weighted by alpha while filtering.
    pub(crate) premultiply: bool,
}

/// The shape of a new texel on the uploaded image.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Footprint {
    /// About a texel or less: interpolate.
    Point,
    /// More than a texel.
    Minified {
        /// From offsets on the uploaded image to units of the stretched kernel.
        inverse: DMat2,
        /// Half of the bounding box of the kernel's support, in texels.
        reach: DVec2,
        /// Every how many texels are read.
        step: i64,
    },
}

impl Footprint {
    /// From the map's linear part, in uploaded texels by new texel.
    pub(crate) fn new(linear: DMat2) -> Self {
        // Singular values and vectors of `linear` from the eigenvectors of its Gram matrix.
        let gram = linear * linear.transpose();
        let (mean, half) = (0.5 * (gram.x_axis.x + gram.y_axis.y), 0.5 * (gram.x_axis.x - gram.y_axis.y));
        let radius = half.hypot(gram.x_axis.y);
        let major = (mean + radius).max(0.0).sqrt();
        if major.is_nan() || major <= MINIFIED {
            return Footprint::Point;
        }
        let minor = (mean - radius).max(0.0).sqrt();
        let angle = 0.5 * gram.x_axis.y.atan2(half);
        let along = DVec2::from_angle(angle);
        let across = along.perp();
        // Neither axis narrower than the texels that are read. The kernel keeps the new texel's own axes where it can.
        let (wide, narrow) = (major, minor.max(1.0));
        let shaped = if minor >= 1.0 { linear } else { DMat2::from_cols(along * wide, across * narrow) };
        let reach = 2.0 * (shaped.x_axis.abs() + shaped.y_axis.abs());
        let step = (4.0 * wide / TAPS).ceil().clamp(1.0, 1e6) as i64;
        Footprint::Minified { inverse: shaped.inverse(), reach: reach.min(DVec2::splat(1e7)), step }
    }
}

impl<T: Depth, const C: usize> Sampler<'_, T, C> {
    /// The transfer function of what [`Sampler::sample`] gives.
    pub(crate) fn transfer_of(&self, footprint: &Footprint) -> &Transfer<T> {
        if matches!(footprint, Footprint::Point) { self.shown } else { self.transfer }
    }

    /// The filtered value at a point, in texels; premultiplied colour is divided again.
    pub(crate) fn sample(&self, point: DVec2, footprint: &Footprint) -> [f32; C] {
        let transfer = self.transfer_of(footprint);
        let mut value = match footprint {
            Footprint::Point => self.interpolate(point),
            Footprint::Minified { inverse, reach, step } => self.minify(point, inverse, *reach, *step),
        };
        if let (true, Some(a)) = (self.premultiply, alpha_channel(C)) {
            let alpha = value[a];
            // Nothing shows here: the colour is taken without weights, so that it stays smooth for filtering.
            let scale = if alpha > 1e-4 { alpha.recip() } else { return self.bilinear(point, transfer) };
            value.iter_mut().take(a).for_each(|v| *v *= scale);
        }
        value
    }

    /// Bilinear interpolation as a renderer does it, colour not weighted by alpha.
    #[inline]
    pub(crate) fn bilinear(&self, point: DVec2, transfer: &Transfer<T>) -> [f32; C] {
        let ([x, y], t) = base(point);
        let mut out = [0.0; C];
        let inside = x >= 0 && x + 1 < self.size[0];
        for (dy, wy) in [(0, 1.0 - t.y), (1, t.y)] {
            let first = self.index(x, y + dy);
            let mut pair = [[0.0; C]; 2];
            if inside {
                transfer.decode_all(&self.texels[first..first + 2 * C], &mut pair);
            } else {
                pair = [first, self.index(x + 1, y + dy)].map(|at| transfer.decode::<C>(&self.texels[at..at + C]));
            }
            for c in 0..C {
                out[c] += wy * ((1.0 - t.x) * pair[0][c] + t.x * pair[1][c]);
            }
        }
        out
    }

    /// Position in `texels` of a texel, through the wrap modes.
    #[inline]
    pub(crate) fn index(&self, x: i64, y: i64) -> usize {
        let [w, h] = self.size;
        let x = if (0..w).contains(&x) { x } else { self.wrap[0].texel(x, w) };
        let y = if (0..h).contains(&y) { y } else { self.wrap[1].texel(y, h) };
        (y * w + x) as usize * C
    }

    #[inline]
    fn at(&self, index: usize, transfer: &Transfer<T>) -> [f32; C] {
        let mut value = transfer.decode::<C>(&self.texels[index..index + C]);
        if let (true, Some(a)) = (self.premultiply, alpha_channel(C)) {
            let alpha = value[a];
            value.iter_mut().take(a).for_each(|v| *v *= alpha);
        }
        value
    }

    /// The six-point kernel along both axes: down the columns first, whose samples lie side by side.
    fn interpolate(&self, point: DVec2) -> [f32; C] {
        let ([x, y], t) = base(point);
        let (wx, wy) = (six_point(t.x), six_point(t.y));
        let whole = x >= 2 && x + 4 <= self.size[0];
        let columns: [usize; 6] = std::array::from_fn(|i| {
            let x = x + i as i64 - 2;
            (if (0..self.size[0]).contains(&x) { x } else { self.wrap[0].texel(x, self.size[0]) }) as usize * C
        });
        let mut sums = [[0.0; C]; 6];
        let (mut lows, mut highs) = ([[f32::INFINITY; C]; 4], [[f32::NEG_INFINITY; C]; 4]);
        for (j, weight) in wy.iter().enumerate() {
            let y = y + j as i64 - 2;
            let y = if (0..self.size[1]).contains(&y) { y } else { self.wrap[1].texel(y, self.size[1]) };
            let line = (y * self.size[0]) as usize * C;
            let mut row = [[0.0; C]; 6];
            if whole && !self.premultiply {
                let start = line + columns[0];
                self.shown.decode_all(&self.texels[start..start + 6 * C], &mut row);
            } else {
                row = columns.map(|column| self.at(line + column, self.shown));
            }
            for (sum, value) in sums.as_flattened_mut().iter_mut().zip(row.as_flattened()) {
                *sum += weight * value;
            }
            if (1..5).contains(&j) {
                let bounds = lows.as_flattened_mut().iter_mut().zip(highs.as_flattened_mut());
                for ((low, high), value) in bounds.zip(row[1..5].as_flattened()) {
                    // Without what `min` and `max` do for NaN.
                    *low = if value < low { *value } else { *low };
                    *high = if value > high { *value } else { *high };
                }
            }
        }
        let mut out = [0.0; C];
        sums.iter().zip(&wx).for_each(|(sum, weight)| add(&mut out, *weight, sum));
        let (mut low, mut high) = (lows[0], highs[0]);
        for i in 1..4 {
            for c in 0..C {
                low[c] = low[c].min(lows[i][c]);
                high[c] = high[c].max(highs[i][c]);
            }
        }
        clamp(&mut out, &low, &high);
        out
    }

    fn minify(&self, point: DVec2, inverse: &DMat2, reach: DVec2, step: i64) -> [f32; C] {
        let first = |v: f64| ((v - 0.5) / step as f64).ceil() as i64;
        let (from, to) = (point - reach, point + reach);
        let mut out = [0.0; C];
        let mut total = 0.0;
        let axes = self.transfer.space == Space::Directed(Direction::Anisotropy);
        let (mut low, mut high) = ([f32::INFINITY; C], [f32::NEG_INFINITY; C]);
        for y in first(from.y)..=first(to.y) {
            for x in first(from.x)..=first(to.x) {
                let (x, y) = if step > 1 { jittered(x, y, step) } else { (x, y) };
                let k = (*inverse * (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - point)).abs().as_vec2();
                let weight = four_point(k.x) * four_point(k.y);
                if weight == 0.0 {
                    continue;
                }
                let mut value = self.at(self.index(x, y), self.transfer);
                if axes {
                    doubled(&mut value);
                }
                add(&mut out, weight, &value);
                total += weight;
                if k.x < 1.0 && k.y < 1.0 {
                    extend(&mut low, &mut high, &value);
                }
            }
        }
        let nearest = || self.at(self.index(point.x.floor() as i64, point.y.floor() as i64), self.transfer);
        if total < 0.25 || low[0] > high[0] {
            return nearest();
        }
        out.iter_mut().for_each(|v| *v /= total);
        clamp(&mut out, &low, &high);
        if axes {
            halved(&mut out, &nearest());
        }
        out
    }
}

/// The texel at or below a point, with half a texel taken off, and the fractions beyond it.
#[inline]
fn base(point: DVec2) -> ([i64; 2], Vec2) {
    let p = point - 0.5;
    // Without SSE 4.1, which not every processor has, `floor` is a call.
    let floor = |v: f64| {
        let towards_zero = v as i64;
        towards_zero - i64::from(towards_zero as f64 > v)
    };
    let (x, y) = (floor(p.x), floor(p.y));
    ([x, y], (p - DVec2::new(x as f64, y as f64)).as_vec2())
}

/// One texel of a cell of `step` x `step`: no pattern of the image may fall in with the lattice.
fn jittered(x: i64, y: i64, step: i64) -> (i64, i64) {
    let mixed = (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
    let mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let offset = |bits: u64| ((bits & 0xffff) as i64 * step) >> 16;
    (x * step + offset(mixed >> 32), y * step + offset(mixed >> 48))
}

#[inline]
fn add<const C: usize>(sum: &mut [f32; C], weight: f32, value: &[f32; C]) {
    for c in 0..C {
        sum[c] += weight * value[c];
    }
}

#[inline]
fn extend<const C: usize>(low: &mut [f32; C], high: &mut [f32; C], value: &[f32; C]) {
    for c in 0..C {
        low[c] = low[c].min(value[c]);
        high[c] = high[c].max(value[c]);
    }
}

#[inline]
fn clamp<const C: usize>(value: &mut [f32; C], low: &[f32; C], high: &[f32; C]) {
    for c in 0..C {
        value[c] = value[c].max(low[c]).min(high[c]);
    }
}

/// Weights of the texels -2..=3 at fraction `t`: Keys' six-point kernel, fourth order.
fn six_point(t: f32) -> [f32; 6] {
    let inner = |s: f32| ((4.0 * s - 7.0) * s * s) / 3.0 + 1.0;
    let middle = |s: f32| ((-7.0 * s + 36.0) * s - 59.0) * s / 12.0 + 2.5;
    let outer = |s: f32| ((s - 8.0) * s + 21.0) * s / 12.0 - 1.5;
    [outer(2.0 + t), middle(1.0 + t), inner(t), inner(1.0 - t), middle(2.0 - t), outer(3.0 - t)]
}

/// Keys' four-point kernel at distance `s >= 0`, third order.
fn four_point(s: f32) -> f32 {
    if s < 1.0 {
        (1.5 * s - 2.5) * s * s + 1.0
    } else if s < 2.0 {
        ((-0.5 * s + 2.5) * s - 4.0) * s + 2.0
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::texture::transfer::Space;

    fn sampler<'a>(texels: &'a [u16], transfer: &'a Transfer<u16>, width: i64) -> Sampler<'a, u16, 1> {
        let size = [width, texels.len() as i64 / width];
        Sampler { texels, size, wrap: [Wrap::ClampToEdge; 2], transfer, shown: transfer, premultiply: false }
    }

    #[test]
    fn a_linear_ramp_is_reproduced_under_any_turn_and_scale() {
        let transfer = Transfer::<u16>::new(Space::Linear);
        let texels: Vec<u16> = (0..64 * 64).map(|i| (i % 64 * 500 + i / 64 * 300) as u16).collect();
        let s = sampler(&texels, &transfer, 64);
        for scale in [0.5, 1.0, 1.7, 3.0] {
            let footprint = Footprint::new(DMat2::from_angle(0.6) * scale);
            for k in 0..200 {
                let p = DVec2::new(20.0 + f64::from(k) * 0.11, 22.0 + f64::from(k * 7 % 200) * 0.1);
                let exact = ((p.x - 0.5) * 500.0 + (p.y - 0.5) * 300.0) / 65_535.0;
                let error = (f64::from(s.sample(p, &footprint)[0]) - exact).abs() * 65_535.0;
                // A stretched kernel in general position sums to the ramp only nearly.
                assert!(error < if scale > 1.2 { 40.0 } else { 0.1 }, "scale {scale} at {p}: {error}");
            }
        }
    }

    #[test]
    fn texel_centres_interpolate_and_masks_do_not_ring() {
        let transfer = Transfer::<u16>::new(Space::Linear);
        let texels: Vec<u16> = (0..256).map(|i| if i % 16 < 8 { 10_000 } else { 50_000 }).collect();
        let s = sampler(&texels, &transfer, 16);
        let value = |x: f64| f64::from(s.sample(DVec2::new(x, 8.5), &Footprint::Point)[0]) * 65_535.0;
        assert!((value(7.5) - 10_000.0).abs() < 0.1 && (value(8.5) - 50_000.0).abs() < 0.1);
        for k in 0..160 {
            let v = value(f64::from(k) / 10.0);
            assert!((9_999.9..=50_000.1).contains(&v), "{v}");
        }
    }

    #[test]
    fn a_checkerboard_made_smaller_is_grey() {
        let transfer = Transfer::<u16>::new(Space::Linear);
        let texels: Vec<u16> = (0..128 * 128).map(|i| if (i / 128 + i) % 2 == 0 { 0 } else { 65_535 }).collect();
        let s = sampler(&texels, &transfer, 128);
        for scale in [2.0, 5.3, 20.0, 50.0] {
            let footprint = Footprint::new(DMat2::from_angle(0.3) * scale);
            let v = s.sample(DVec2::new(63.2, 64.9), &footprint)[0];
            assert!((v - 0.5).abs() < 0.05, "scale {scale}: {v}");
        }
    }
}
