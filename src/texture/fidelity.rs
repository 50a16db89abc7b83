//! What a bake cost: the surface's colour before against after, as a renderer's bilinear filter shows it.
//!
//! The points and both colours are computed from the Atlases and the images alone, not from how the bake was done.

use glam::{DMat2, DVec2, DVec3};
use image::DynamicImage;
use rayon::prelude::*;

use super::pixels::TexelRows;
use super::texel_map::{TexelMap, TexelMaps, source_scale};
use super::{Bake, Baked, Direction, Wrap};
use crate::atlas::{Charts, Topology};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Points that the report's figures are computed at.
pub const SAMPLES: u32 = 100_000;
/// The best PSNR that is told, in decibels.
const BEST: f64 = 120.0;
/// Texels with less weight than this are not part of a footprint: a point may lie on either side of a lattice line.
const WEIGHT: f64 = 1e-3;
/// Points between two looks at the context, and that are summed before the sums are.
const CHUNK: usize = 4096;

/// Fidelity of one slot. Errors are absolute differences of encoded values, in 1/255.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fidelity {
    /// Points on the surface; 0 when no face that reads the slot has an area.
    pub samples: u32,
    /// Peak signal-to-noise ratio over all channels in decibels, at most 120. Directions are turned back first.
    pub psnr_db: f64,
    /// Whether at all points the texels of the bilinear footprint are equal (directions: after the turn).
    pub exact: bool,
    /// Largest error at mip level 0.
    pub max_error: f64,
    /// Mean error at mip level 2.
    pub mip2_mean_error: f64,
    /// Largest error at mip level 2.
    pub mip2_max_error: f64,
    /// For directions, the median angle between before and after, in degrees; of an anisotropy, between the axes where it has a strength.
    pub angle_median_deg: Option<f64>,
    /// For directions, the 95th percentile of that angle, in degrees.
    pub angle_p95_deg: Option<f64>,
}

/// Compares a baked slot with its source at `samples` points, spread over the 3D area of the faces that read it (stratified, from
/// `context.seed`). Fails with `canceled`, or with `internal` when the parts do not belong together.
pub fn fidelity(job: &Bake<'_>, baked: &Baked, samples: u32, context: &Context) -> Result<Fidelity> {
    UploadedColors::new(job, samples, context)?.against(&baked.pages, context)
}

/// A slot as uploaded, and the points of the surface at which pages are held against it.
pub struct UploadedColors<'a> {
    job: &'a Bake<'a>,
    maps: TexelMaps,
    points: Vec<Point>,
}

impl<'a> UploadedColors<'a> {
    /// `samples` points, spread as [`fidelity`] says.
    ///
    /// # Errors
    /// `internal` when the parts do not belong together.
    pub fn new(job: &'a Bake<'a>, samples: u32, context: &Context) -> Result<Self> {
        let maps = TexelMaps::new(job, &Charts::new(&Topology::new(job.after)))?;
        Ok(UploadedColors { job, points: scatter(job, &maps, samples, context.seed), maps })
    }

    /// Fidelity of the slot's pages: as they were baked, or as their files decode.
    ///
    /// # Errors
    /// `canceled`; `internal` where pages are missing.
    pub fn against(&self, pages: &[DynamicImage], context: &Context) -> Result<Fidelity> {
        if pages.len() != self.job.after.sheets.len() {
            return Err(Failure::internal("a baked slot does not have the pages of its atlas"));
        }
        let comparison = Comparison::new(self.job, &self.maps);
        let pages: Vec<TexelRows<'_>> = pages.iter().map(TexelRows::of).collect();
        let compared: Vec<Result<Vec<Option<PointError>>>> = self
            .points
            .par_chunks(CHUNK)
            .map(|points| {
                context.check()?;
                Ok(points.iter().map(|p| comparison.compare(p, &pages[comparison.place(p).0])).collect())
            })
            .collect();
        let mut all = Vec::with_capacity(self.points.len());
        for chunk in compared {
            all.extend(chunk?);
        }
        Ok(comparison.sum(&all))
    }
}

/// A point on the surface: a face and barycentric coordinates.
pub(crate) struct Point {
    face: u32,
    weights: DVec3,
}

/// Points in the order of faces, one in each stratum of equal area.
pub(crate) fn scatter(job: &Bake<'_>, maps: &TexelMaps, samples: u32, seed: u64) -> Vec<Point> {
    let faces: Vec<(u32, f64)> = job
        .after
        .faces()
        .filter(|f| maps.counts(f.index()))
        .map(|f| (f.0, job.after.area(f)))
        .filter(|(_, area)| area.is_finite() && *area > 0.0)
        .collect();
    let total: f64 = faces.iter().map(|f| f.1).sum();
    let mut points = Vec::new();
    let mut next = 0;
    let mut reached = 0.0;
    for k in 0..samples {
        let random = |n: u64| unit(seed.wrapping_add((u64::from(k) * 3 + n).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
        let wanted = (f64::from(k) + random(0)) / f64::from(samples) * total;
        while next + 1 < faces.len() && reached + faces[next].1 <= wanted {
            reached += faces[next].1;
            next += 1;
        }
        let Some((face, _)) = faces.get(next) else { break };
        // Uniform on the triangle.
        let (root, v) = (random(1).sqrt(), random(2));
        points.push(Point { face: *face, weights: DVec3::new(1.0 - root, root * (1.0 - v), root * v) });
    }
    points
}

/// A number in 0..1 from a state.
fn unit(state: u64) -> f64 {
    (mix(state) >> 11) as f64 / (1u64 << 53) as f64
}

/// The number that splitmix64 (Steele, Lea, Flood 2014) gives at a state.
pub(crate) fn mix(state: u64) -> u64 {
    let z = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Something with up to four channels of encoded values in 0..=1.
trait Texels {
    fn size(&self) -> [i64; 2];
    fn texel(&self, x: i64, y: i64) -> [f64; 4];

    /// Bilinear interpolation at a point in 0..1 of the image.
    fn bilinear(&self, uv: DVec2, wrap: [Wrap; 2]) -> [f64; 4] {
        let size = self.size();
        let p = uv * DVec2::new(size[0] as f64, size[1] as f64) - 0.5;
        let base = p.floor();
        let t = p - base;
        let mut out = [0.0; 4];
        for (dy, wy) in [(0, 1.0 - t.y), (1, t.y)] {
            let y = wrap[1].texel(base.y as i64 + dy, size[1]);
            for (dx, wx) in [(0, 1.0 - t.x), (1, t.x)] {
                let value = self.texel(wrap[0].texel(base.x as i64 + dx, size[0]), y);
                out.iter_mut().zip(value).for_each(|(o, v)| *o += wx * wy * v);
            }
        }
        out
    }
}

impl Texels for TexelRows<'_> {
    fn size(&self) -> [i64; 2] {
        self.size.map(|n| n as i64)
    }
    fn texel(&self, x: i64, y: i64) -> [f64; 4] {
        TexelRows::texel(self, x as usize, y as usize)
    }
}

/// Mip level 2: means of 4 x 4 encoded texels (of what an image smaller or not divisible by 4 has there), each made where it is read.
struct Mip<'a>(TexelRows<'a>);

impl Texels for Mip<'_> {
    fn size(&self) -> [i64; 2] {
        self.0.size.map(|n| (n / 4).max(1) as i64)
    }
    fn texel(&self, x: i64, y: i64) -> [f64; 4] {
        let (full, size) = (self.0.size, self.size().map(|n| n as usize));
        let range = |i: usize, axis: usize| i * full[axis] / size[axis]..((i + 1) * full[axis]).div_ceil(size[axis]);
        self.0.mean(range(x as usize, 0), range(y as usize, 1))
    }
}

/// Rows about a point within which it is compared, on pages of at least [`LEAST_SIDE`] rows.
pub(crate) const REACH: usize = 8;
/// See [`REACH`].
pub(crate) const LEAST_SIDE: u32 = 64;

/// Compares points of a slot as uploaded and on its pages.
pub(crate) struct Comparison<'a> {
    job: &'a Bake<'a>,
    direction: Option<Direction>,
    /// By source: its texels.
    sources: Vec<TexelRows<'a>>,
    /// By source: its texels by reference texel.
    scales: Vec<DVec2>,
    maps: &'a TexelMaps,
}

/// What a point of the surface has lost.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PointError {
    /// By channel, the difference of encoded values.
    differences: [f64; 4],
    /// The largest difference at mip level 2, in 1/255.
    mip: f64,
    exact: bool,
    /// Between directions, in degrees.
    angle: Option<f64>,
}

#[derive(Default)]
struct Sums {
    samples: u32,
    squares: f64,
    values: f64,
    exact: u32,
    max: f64,
    mip_sum: f64,
    mip_max: f64,
    angles: Vec<f64>,
}

impl<'a> Comparison<'a> {
    pub(crate) fn new(job: &'a Bake<'a>, maps: &'a TexelMaps) -> Self {
        Comparison {
            job,
            direction: job.slot.role.direction().filter(|_| job.channels() >= 3),
            sources: job.sources.iter().map(|s| TexelRows::of(s.image)).collect(),
            scales: job.sources.iter().map(source_scale).collect(),
            maps,
        }
    }

    /// The page that a point lies on, and its place there in 0..1.
    pub(crate) fn place(&self, point: &Point) -> (usize, DVec2) {
        let (after, f, w) = (self.job.after, point.face as usize, point.weights);
        let page = usize::from(after.page[f]);
        let sheet = after.sheets[page].map(|n| f64::from(n.max(1)));
        let [a, b, c] = after.corners[f].map(|c| after.uv[c.index()]);
        (page, (a * w.x + b * w.y + c * w.z) / DVec2::from(sheet))
    }

    /// What a point has lost; `rows` are those of its page, as far as [`REACH`] about it. None for a face that does not read the slot.
    pub(crate) fn compare(&self, point: &Point, rows: &TexelRows<'_>) -> Option<PointError> {
        let (job, f) = (self.job, point.face as usize);
        let (map, source) = self.maps.with_source(f)?;
        let read = &job.sources[source];
        let w = point.weights;
        let mix = |c: [DVec2; 3]| c[0] * w.x + c[1] * w.y + c[2] * w.z;
        let origin = &job.after.provenance[f];
        let b = origin.barycentric[0] * w.x + origin.barycentric[1] * w.y + origin.barycentric[2] * w.z;
        let [p0, p1, p2] = job.before.uv_triangle(origin.source);
        let size = DVec2::new(f64::from(read.image.width()), f64::from(read.image.height()));
        let old_uv = (p0 * b.x + p1 * b.y + p2 * b.z - read.place) * self.scales[source] / size;
        let new_uv = self.place(point).1;
        let clamp = [Wrap::ClampToEdge; 2];
        let channels = usize::from(job.channels());

        let old = self.turned(self.sources[source].bilinear(old_uv, read.wrap), map);
        let new = rows.bilinear(new_uv, clamp);
        let mip_old = self.turned(Mip(self.sources[source]).bilinear(old_uv, read.wrap), map);
        let mip_new = Mip(*rows).bilinear(new_uv, clamp);
        let mut mip = 0.0f64;
        let mut differences = [0.0; 4];
        for c in 0..channels {
            differences[c] = new[c] - old[c];
            mip = mip.max((mip_new[c] - mip_old[c]).abs() * 255.0);
        }
        let exact = self.is_exact(map, source, rows, mix(self.maps.corners[f]));
        let vector = |v: [f64; 4]| DVec3::new(v[0], v[1], v[2]) * 2.0 - 1.0;
        let (a, b) = (vector(old), vector(new));
        let angle = match self.direction {
            Some(Direction::Normal) => Some(a.cross(b).length().atan2(a.dot(b)).to_degrees()),
            // Without strength there is no direction; opposite ones are the same.
            Some(Direction::Anisotropy) if old[2] > 0.0 => {
                let (a, b) = (a.truncate(), b.truncate());
                Some(a.perp_dot(b).abs().atan2(a.dot(b).abs()).to_degrees())
            }
            _ => None,
        };
        Some(PointError { differences, mip, exact, angle })
    }

    /// What all points have lost, in their order.
    pub(crate) fn sum(&self, points: &[Option<PointError>]) -> Fidelity {
        let channels = usize::from(self.job.channels());
        let mut all = Sums::default();
        for chunk in points.chunks(CHUNK) {
            let mut sums = Sums::default();
            chunk.iter().flatten().for_each(|error| sums.add(error, channels));
            all.join(sums);
        }
        all.fidelity()
    }

    /// An encoded value of the uploaded image as it stands on the new sheet: directions turn.
    fn turned(&self, value: [f64; 4], map: &TexelMap) -> [f64; 4] {
        if self.direction.is_none() {
            return value;
        }
        let r: DMat2 = map.rotation();
        let image = DVec2::new(value[0] * 2.0 - 1.0, 1.0 - value[1] * 2.0);
        let (x, y) = (r.x_axis.dot(image), -r.y_axis.dot(image));
        [x * 0.5 + 0.5, y * 0.5 + 0.5, value[2], value[3]]
    }

    /// Whether the texels that bilinear filtering reads at a point of a page are the uploaded ones.
    fn is_exact(&self, map: &TexelMap, from: usize, image: &TexelRows<'_>, point: DVec2) -> bool {
        let (source, from) = (&self.sources[from], &self.job.sources[from]);
        let base = (point - 0.5).floor();
        let t = point - 0.5 - base;
        let read = |t: f64| [(0, 1.0 - t), (1, t)].into_iter().filter(|(_, w)| *w > WEIGHT).map(|(d, _)| d);
        let at = |image: &TexelRows<'_>, p: DVec2, wrap: [Wrap; 2]| {
            let [w, h] = Texels::size(image);
            Texels::texel(image, wrap[0].texel(p.x.floor() as i64, w), wrap[1].texel(p.y.floor() as i64, h))
        };
        let texels = read(t.y).flat_map(|dy| read(t.x).map(move |dx| base + DVec2::new(dx as f64, dy as f64) + 0.5));
        match map {
            TexelMap::Exact { .. } => texels.into_iter().all(|texel| {
                let old = self.turned(at(source, map.apply(texel), from.wrap), map);
                let new = at(image, texel, [Wrap::ClampToEdge; 2]);
                // Turning a number and turning its code differ by rounding of the double only.
                old.iter().zip(new).all(|(a, b)| (a - b).abs() < 1e-9)
            }),
            // Resampled texels are equal only where nothing changes.
            TexelMap::Affine { .. } => {
                let base = (map.apply(point) - 0.5).floor() + 0.5;
                let old = at(source, base, from.wrap);
                let same = |v: [f64; 4]| self.turned(v, map).iter().zip(self.turned(old, map)).all(|(a, b)| *a == b);
                let offsets = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)];
                let flat = offsets.iter().all(|(x, y)| same(at(source, base + DVec2::new(*x, *y), from.wrap)));
                flat && texels.into_iter().all(|p| {
                    at(image, p, [Wrap::ClampToEdge; 2]).iter().zip(self.turned(old, map)).all(|(a, b)| *a == b)
                })
            }
        }
    }
}

impl Sums {
    fn add(&mut self, error: &PointError, channels: usize) {
        for d in &error.differences[..channels] {
            self.squares += d * d;
            self.max = self.max.max(d.abs() * 255.0);
        }
        self.values += channels as f64;
        self.mip_sum += error.mip;
        self.mip_max = self.mip_max.max(error.mip);
        self.samples += 1;
        self.exact += u32::from(error.exact);
        self.angles.extend(error.angle);
    }

    fn join(&mut self, other: Sums) {
        self.samples += other.samples;
        self.squares += other.squares;
        self.values += other.values;
        self.exact += other.exact;
        self.max = self.max.max(other.max);
        self.mip_sum += other.mip_sum;
        self.mip_max = self.mip_max.max(other.mip_max);
        self.angles.extend(other.angles);
    }

    fn fidelity(mut self) -> Fidelity {
        self.angles.sort_unstable_by(f64::total_cmp);
        let last = self.angles.len().saturating_sub(1);
        let rank = |q: f64| self.angles.get(((self.angles.len() as f64 * q) as usize).min(last)).copied();
        let samples = f64::from(self.samples.max(1));
        let mean = self.squares / self.values.max(1.0);
        Fidelity {
            samples: self.samples,
            psnr_db: if mean > 0.0 { (-10.0 * mean.log10()).min(BEST) } else { BEST },
            exact: self.exact == self.samples,
            max_error: self.max,
            mip2_mean_error: self.mip_sum / samples,
            mip2_max_error: self.mip_max,
            angle_median_deg: rank(0.5),
            angle_p95_deg: rank(0.95),
        }
    }
}
