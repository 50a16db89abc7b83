//! What a bake cost: the surface's colour before against after, as a renderer's bilinear filter shows it.
//!
//! The points and both colours are computed from the Atlases and the images alone, not from how the bake was done.

use glam::{DMat2, DVec2, DVec3};
use image::DynamicImage;
use rayon::prelude::*;

use super::pixels::Depth;
use super::texel_map::{TexelMap, TexelMaps, source_scale};
use super::{Bake, Baked, Direction, Source, Wrap, texel};
use crate::atlas::{Charts, Topology};
use crate::context::Context;
use crate::error::{Failure, Result};

/// Points that the report's figures are computed at.
pub const SAMPLES: u32 = 100_000;
/// The best PSNR that is told, in decibels.
const BEST: f64 = 120.0;
/// Texels with less weight than this are not part of a footprint: a point may lie on either side of a lattice line.
const WEIGHT: f64 = 1e-3;
/// Points between two looks at the context.
const CHUNK: u32 = 4096;

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
    direction: Option<Direction>,
    /// By source.
    mips: Vec<Mip>,
    /// By source: its texels by reference texel.
    scales: Vec<DVec2>,
}

impl<'a> UploadedColors<'a> {
    /// `samples` points, spread as [`fidelity`] says.
    ///
    /// # Errors
    /// `internal` when the parts do not belong together.
    pub fn new(job: &'a Bake<'a>, samples: u32, context: &Context) -> Result<Self> {
        let maps = TexelMaps::new(job, &Charts::new(&Topology::new(job.after)))?;
        Ok(UploadedColors {
            job,
            points: scatter(job, &maps, samples, context.seed),
            direction: job.slot.role.direction().filter(|_| job.channels() >= 3),
            mips: job.sources.iter().map(|s| Mip::new(s.image)).collect(),
            scales: job.sources.iter().map(source_scale).collect(),
            maps,
        })
    }

    /// Fidelity of the slot's pages: as they were baked, or as their files decode.
    ///
    /// # Errors
    /// `canceled`; `internal` where pages are missing.
    pub fn against(&self, pages: &[DynamicImage], context: &Context) -> Result<Fidelity> {
        if pages.len() != self.job.after.sheets.len() {
            return Err(Failure::internal("a baked slot does not have the pages of its atlas"));
        }
        let comparison = Comparison { uploaded: self, pages, page_mips: pages.iter().map(Mip::new).collect() };
        let chunks: Vec<Result<Sums>> = self
            .points
            .par_chunks(CHUNK as usize)
            .map(|points| {
                context.check()?;
                let mut sums = Sums::default();
                points.iter().for_each(|p| comparison.add(p, &mut sums));
                Ok(sums)
            })
            .collect();
        let mut all = Sums::default();
        for chunk in chunks {
            all.join(chunk?);
        }
        Ok(all.fidelity())
    }
}

/// A point on the surface: a face and barycentric coordinates.
struct Point {
    face: u32,
    weights: DVec3,
}

/// Points in the order of faces, one in each stratum of equal area.
fn scatter(job: &Bake<'_>, maps: &TexelMaps, samples: u32, seed: u64) -> Vec<Point> {
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

impl Texels for DynamicImage {
    fn size(&self) -> [i64; 2] {
        [i64::from(self.width()), i64::from(self.height())]
    }
    fn texel(&self, x: i64, y: i64) -> [f64; 4] {
        texel(self, x as u32, y as u32)
    }
}

/// Mip level 2: means of 4 x 4 encoded texels (of what an image smaller or not divisible by 4 has there).
struct Mip {
    size: [i64; 2],
    texels: Vec<[f32; 4]>,
}

impl Mip {
    fn new(image: &DynamicImage) -> Self {
        let full = [image.width() as usize, image.height() as usize];
        let size = full.map(|n| (n / 4).max(1));
        let texels = match image {
            DynamicImage::ImageLuma8(b) => means::<_, 1>(b.as_raw(), full, size),
            DynamicImage::ImageLumaA8(b) => means::<_, 2>(b.as_raw(), full, size),
            DynamicImage::ImageRgb8(b) => means::<_, 3>(b.as_raw(), full, size),
            DynamicImage::ImageRgba8(b) => means::<_, 4>(b.as_raw(), full, size),
            DynamicImage::ImageLuma16(b) => means::<_, 1>(b.as_raw(), full, size),
            DynamicImage::ImageLumaA16(b) => means::<_, 2>(b.as_raw(), full, size),
            DynamicImage::ImageRgb16(b) => means::<_, 3>(b.as_raw(), full, size),
            DynamicImage::ImageRgba16(b) => means::<_, 4>(b.as_raw(), full, size),
            // Nothing decodes to floats.
            _ => vec![[0.0; 4]; size[0] * size[1]],
        };
        Mip { size: size.map(|n| n as i64), texels }
    }
}

/// The means over what each texel of an image of `size` covers of one of `full` texels of `C` channels.
fn means<T: Depth, const C: usize>(samples: &[T], full: [usize; 2], size: [usize; 2]) -> Vec<[f32; 4]> {
    let range = |i: usize, axis: usize| i * full[axis] / size[axis]..((i + 1) * full[axis]).div_ceil(size[axis]);
    let mut texels = vec![[0.0; 4]; size[0] * size[1]];
    texels.par_chunks_mut(size[0]).with_min_len(16).enumerate().for_each(|(y, row)| {
        let rows = range(y, 1);
        let lines = samples[rows.start * full[0] * C..rows.end * full[0] * C].chunks_exact(full[0] * C);
        let mut sums = vec![[0u32; C]; size[0]];
        for line in lines {
            // Nearly always four texels each; else they may share one.
            if full[0] == 4 * size[0] {
                for (sum, run) in sums.iter_mut().zip(line.chunks_exact(4 * C)) {
                    (0..4 * C).for_each(|i| sum[i % C] += run[i].value());
                }
            } else {
                for (x, sum) in sums.iter_mut().enumerate() {
                    let columns = range(x, 0);
                    for texel in line[columns.start * C..columns.end * C].chunks_exact(C) {
                        (0..C).for_each(|c| sum[c] += texel[c].value());
                    }
                }
            }
        }
        for (x, (out, sum)) in row.iter_mut().zip(&sums).enumerate() {
            let whole = (rows.len() * range(x, 0).len()) as f64 * f64::from(T::MAX);
            out.iter_mut().zip(sum).for_each(|(o, s)| *o = (f64::from(*s) / whole) as f32);
        }
    });
    texels
}

impl Texels for Mip {
    fn size(&self) -> [i64; 2] {
        self.size
    }
    fn texel(&self, x: i64, y: i64) -> [f64; 4] {
        self.texels[(y * self.size[0] + x) as usize].map(f64::from)
    }
}

/// Pages against what was uploaded.
struct Comparison<'a> {
    uploaded: &'a UploadedColors<'a>,
    pages: &'a [DynamicImage],
    page_mips: Vec<Mip>,
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

impl Comparison<'_> {
    fn add(&self, point: &Point, sums: &mut Sums) {
        let UploadedColors { job, maps, .. } = self.uploaded;
        let f = point.face as usize;
        let Some((map, source)) = maps.with_source(f) else { return };
        let read = &job.sources[source];
        let w = point.weights;
        let mix = |c: [DVec2; 3]| c[0] * w.x + c[1] * w.y + c[2] * w.z;
        let origin = &job.after.provenance[f];
        let b = origin.barycentric[0] * w.x + origin.barycentric[1] * w.y + origin.barycentric[2] * w.z;
        let [p0, p1, p2] = job.before.uv_triangle(origin.source);
        let size = DVec2::new(f64::from(read.image.width()), f64::from(read.image.height()));
        let old_uv = (p0 * b.x + p1 * b.y + p2 * b.z - read.place) * self.uploaded.scales[source] / size;
        let page = usize::from(job.after.page[f]);
        let sheet = job.after.sheets[page].map(|n| f64::from(n.max(1)));
        let new_uv = mix(job.after.corners[f].map(|c| job.after.uv[c.index()])) / DVec2::from(sheet);
        let clamp = [Wrap::ClampToEdge; 2];
        let channels = usize::from(job.channels());

        let old = self.turned(read.image.bilinear(old_uv, read.wrap), map);
        let new = self.pages[page].bilinear(new_uv, clamp);
        let mip_old = self.turned(self.uploaded.mips[source].bilinear(old_uv, read.wrap), map);
        let mip_new = self.page_mips[page].bilinear(new_uv, clamp);
        let mut mip = 0.0f64;
        for c in 0..channels {
            let d = new[c] - old[c];
            sums.squares += d * d;
            sums.max = sums.max.max(d.abs() * 255.0);
            mip = mip.max((mip_new[c] - mip_old[c]).abs() * 255.0);
        }
        sums.values += channels as f64;
        sums.mip_sum += mip;
        sums.mip_max = sums.mip_max.max(mip);
        sums.samples += 1;
        sums.exact += u32::from(self.is_exact(map, read, page, mix(maps.corners[f])));
        let vector = |v: [f64; 4]| DVec3::new(v[0], v[1], v[2]) * 2.0 - 1.0;
        let (a, b) = (vector(old), vector(new));
        match self.uploaded.direction {
            Some(Direction::Normal) => sums.angles.push(a.cross(b).length().atan2(a.dot(b)).to_degrees()),
            // Without strength there is no direction; opposite ones are the same.
            Some(Direction::Anisotropy) if old[2] > 0.0 => {
                let (a, b) = (a.truncate(), b.truncate());
                sums.angles.push(a.perp_dot(b).abs().atan2(a.dot(b).abs()).to_degrees());
            }
            _ => {}
        }
    }

    /// An encoded value of the uploaded image as it stands on the new sheet: directions turn.
    fn turned(&self, value: [f64; 4], map: &TexelMap) -> [f64; 4] {
        if self.uploaded.direction.is_none() {
            return value;
        }
        let r: DMat2 = map.rotation();
        let image = DVec2::new(value[0] * 2.0 - 1.0, 1.0 - value[1] * 2.0);
        let (x, y) = (r.x_axis.dot(image), -r.y_axis.dot(image));
        [x * 0.5 + 0.5, y * 0.5 + 0.5, value[2], value[3]]
    }

    /// Whether the texels that bilinear filtering reads at a point of a page are the uploaded ones.
    fn is_exact(&self, map: &TexelMap, from: &Source<'_>, page: usize, point: DVec2) -> bool {
        let (source, image) = (from.image, &self.pages[page]);
        let base = (point - 0.5).floor();
        let t = point - 0.5 - base;
        let read = |t: f64| [(0, 1.0 - t), (1, t)].into_iter().filter(|(_, w)| *w > WEIGHT).map(|(d, _)| d);
        let at = |image: &DynamicImage, p: DVec2, wrap: [Wrap; 2]| {
            let [w, h] = image.size();
            image.texel(wrap[0].texel(p.x.floor() as i64, w), wrap[1].texel(p.y.floor() as i64, h))
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
