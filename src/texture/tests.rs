//! The whole way from an uploaded image to a refined one, against twins by brute force.

mod density;
mod directions;
mod scans;
mod strips;

use glam::{DMat2, DVec2, DVec3};
use image::DynamicImage;

use super::direction::Turn;
use super::encode::tests::picture;
use super::*;
use crate::atlas::{Atlas, FaceId, Provenance, Surface, UvId, VertexId};
use crate::context::Context;
use crate::texture::{Reading, Slot};

/// A small generator (splitmix64), so that each case can be told by its number.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
    fn below(&mut self, n: u32) -> u32 {
        (self.unit() * f64::from(n)) as u32
    }
    fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

/// Charts as fans of triangles: their corners on the uploaded image, and the same corners on the new sheet.
struct Charts {
    before: Atlas,
    after: Atlas,
    reference: [u32; 2],
}

impl Charts {
    fn new(reference: [u32; 2], sheet: [u32; 2]) -> Self {
        let atlas = |size| Atlas { sheets: vec![size], ..Atlas::default() };
        Charts { before: atlas(reference), after: atlas(sheet), reference }
    }

    /// Adds a fan about its first point; `new` gives the place on the new sheet.
    fn fan(&mut self, primitive: u32, points: &[DVec2], new: impl Fn(DVec2) -> DVec2) {
        let first = self.before.uv.len();
        for p in points {
            self.before.surface.positions.push(DVec3::new(p.x, p.y, first as f64));
            self.before.uv.push(*p);
            self.after.uv.push(new(*p));
        }
        for k in 1..points.len() - 1 {
            let corners = [first, first + k, first + k + 1];
            let face = FaceId::new(self.before.corners.len());
            self.before.surface.triangles.push(corners.map(VertexId::new));
            self.before.corners.push(corners.map(UvId::new));
            self.before.page.push(0);
            self.before.provenance.push(Provenance::whole(face, primitive));
        }
        let Surface { positions, triangles } = self.before.surface.clone();
        self.after.surface = Surface { positions, triangles };
        self.after.corners = self.before.corners.clone();
        self.after.page = self.before.page.clone();
        self.after.provenance = self.before.provenance.clone();
    }

    fn bake<'a>(&'a self, slot: &'a Slot, source: &'a DynamicImage) -> Bake<'a> {
        Bake::single(&self.before, &self.after, self.reference, slot, source, 8)
    }
}

pub(super) fn slot(role: Role, image: &DynamicImage) -> Slot {
    let header = Header {
        width: image.width(),
        height: image.height(),
        channels: image.color().channel_count(),
        depth: depth(image),
        format: Format::Png,
    };
    Slot {
        image: 0,
        role,
        name: role.to_string(),
        header,
        block: 1,
        readings: vec![Reading { wrap: [Wrap::ClampToEdge; 2], primitives: vec![0] }],
        mipmaps: false,
        alpha: Alpha::Opaque,
        primitives: vec![0],
        exempt: false,
    }
}

/// The samples of a texel of an image of 8 bits.
fn texel(image: &DynamicImage, x: i64, y: i64) -> Vec<u32> {
    let c = usize::from(image.color().channel_count());
    let start = (y as usize * image.width() as usize + x as usize) * c;
    image.as_flat_samples_u8().unwrap().samples[start..start + c].iter().map(|v| u32::from(*v)).collect()
}

/// Noise: no two texels are alike, so that one in a wrong place is seen.
fn noise(width: u32, height: u32, channels: u8, seed: u64) -> DynamicImage {
    let mut random = Random(seed);
    let n = width * height * u32::from(channels);
    from_samples([width, height], channels, (0..n).map(|_| random.below(256) as u8).collect()).unwrap()
}

/// A star-shaped fan about `centre`.
fn star(random: &mut Random, centre: DVec2, radius: f64) -> Vec<DVec2> {
    let n = 3 + random.below(5);
    let mut points = vec![centre];
    for k in 0..=n {
        let angle = f64::from(k) / f64::from(n) * std::f64::consts::TAU * 0.9;
        points.push(centre + DVec2::from_angle(angle) * radius * random.range(0.2, 1.0));
    }
    points
}

/// A map from new to uploaded texels by whole texels, that brings `centre` to `new`, and its inverse as a closure.
fn whole(turn: Turn, centre: DVec2, new: DVec2) -> (DVec2, impl Fn(DVec2) -> DVec2) {
    let m = turn.matrix();
    let shift = (centre - m * new).round();
    (shift, move |p: DVec2| m.transpose() * (p - shift))
}

#[test]
fn every_footprint_of_a_chart_moved_by_whole_texels_is_the_uploaded_one() {
    let wraps = [Wrap::Repeat, Wrap::MirroredRepeat, Wrap::ClampToEdge];
    for seed in 0..40 {
        let mut random = Random(seed);
        let image = noise(61, 47, 3, seed);
        let mut charts = Charts::new([61, 47], [160, 160]);
        let mut placed = Vec::new();
        for cell in 0..16u32 {
            // Cells of 40, charts of radius 16 at most: gutters stay over 2 texels.
            let new = DVec2::new(f64::from(cell % 4) * 40.0 + 20.0, f64::from(cell / 4) * 40.0 + 20.0);
            let radius = if cell == 5 { 0.2 } else { random.range(1.0, 16.0) };
            // Anywhere on the image, over its borders and in other tiles.
            let centre = DVec2::new(random.range(-70.0, 130.0), random.range(-60.0, 100.0));
            let turn = Turn::ALL[random.below(8) as usize];
            let (shift, place) = whole(turn, centre, new);
            let faces = charts.before.face_count();
            charts.fan(0, &star(&mut random, centre, radius), place);
            placed.push((faces..charts.before.face_count(), turn, shift));
        }
        let mut slot = slot(Role::BaseColor, &image);
        slot.readings[0].wrap = [wraps[random.below(3) as usize], wraps[random.below(3) as usize]];
        let job = charts.bake(&slot, &image);
        let baked = bake(&job, &Context::silent()).unwrap();
        assert!(baked.verbatim_face.iter().all(|v| *v), "seed {seed}");
        assert_eq!(baked.resampled_area, 0.0);
        let out = &baked.pages[0];
        for (faces, turn, shift) in placed {
            for face in faces {
                for _ in 0..60 {
                    let (u, v) = (random.unit().sqrt(), random.unit());
                    let [a, b, c] = charts.after.uv_triangle(FaceId::new(face));
                    let q = a * (1.0 - u) + b * (u * (1.0 - v)) + c * (u * v);
                    let base = (q - 0.5).floor();
                    for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                        let new = base + DVec2::new(dx, dy);
                        let old = (turn.matrix() * (new + 0.5) + shift).floor();
                        let wrap = slot.readings[0].wrap;
                        let old = [wrap[0].texel(old.x as i64, 61), wrap[1].texel(old.y as i64, 47)];
                        let found = texel(out, new.x as i64, new.y as i64);
                        assert_eq!(found, texel(&image, old[0], old[1]), "seed {seed}, face {face}, {q}");
                    }
                }
            }
        }
        let fidelity = fidelity(&job, &baked, 2000, &Context::silent()).unwrap();
        assert!(fidelity.exact && fidelity.psnr_db == 120.0 && fidelity.max_error < 1e-6, "{fidelity:?}");
    }
}

#[test]
fn a_fold_between_faces_wound_against_each_other_has_its_ring() {
    let image = noise(64, 64, 3, 5);
    let mut charts = Charts::new([64, 64], [64, 64]);
    // Two faces on the same side of their common edge, one within the other.
    let corners = [[8.3, 20.34], [30.0, 28.0], [50.2, 20.33], [28.0, 24.0]].map(DVec2::from);
    charts.fan(0, &corners, |p| p + DVec2::new(5.0, 9.0));
    // Wound the same way, so that they pass the edge in the same direction.
    for atlas in [&mut charts.before, &mut charts.after] {
        atlas.corners[1].swap(1, 2);
        atlas.surface.triangles[1].swap(1, 2);
    }
    let slot = slot(Role::BaseColor, &image);
    let out = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
    // What is read along the edge: the rows 19 and 20, moved.
    for x in 10..48 {
        for y in [19, 20] {
            assert_eq!(texel(&out, x + 5, y + 9), texel(&image, x, y), "{x} {y}");
        }
    }
}

#[test]
fn texels_belong_to_the_lowest_face_over_their_centre() {
    let mut random = Random(3);
    let image = noise(64, 64, 1, 3);
    let mut charts = Charts::new([64, 64], [64, 64]);
    for _ in 0..12 {
        // Overlapping charts, each from its own place.
        let centre = DVec2::new(random.range(10.0, 50.0), random.range(10.0, 50.0));
        let new = DVec2::new(random.range(15.0, 45.0), random.range(15.0, 45.0));
        let place = whole(Turn::ALL[0], centre, new).1;
        charts.fan(0, &star(&mut random, centre, 14.0), place);
    }
    let slot = slot(Role::Occlusion, &image);
    let out = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
    let mut covered = 0;
    for y in 0..64 {
        for x in 0..64 {
            let p = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let owner = charts.after.faces().find(|f| {
                let [a, b, c] = charts.after.uv_triangle(*f);
                let s = [(b - a).perp_dot(p - a), (c - b).perp_dot(p - b), (a - c).perp_dot(p - c)];
                s.iter().all(|v| *v > 0.0) || s.iter().all(|v| *v < 0.0)
            });
            let Some(face) = owner else { continue };
            let delta = charts.before.uv_triangle(face)[0] - charts.after.uv_triangle(face)[0];
            let old = (p + delta).floor();
            let old = [old.x as i64, old.y as i64].map(|v| v.clamp(0, 63));
            assert_eq!(texel(&out, x.into(), y.into()), texel(&image, old[0], old[1]), "{x} {y}");
            covered += 1;
        }
    }
    assert!(covered > 500);
}

/// A quad turned by `angle` (and scaled) about the middle of a 256 x 256 image.
fn turned_quad(angle: f64, scale: f64) -> Charts {
    let mut charts = Charts::new([256, 256], [256, 256]);
    let quad = [(40.0, 40.0), (216.0, 40.0), (216.0, 216.0), (40.0, 216.0)].map(|(x, y)| DVec2::new(x, y));
    let m = DMat2::from_angle(angle) * (scale * 0.7);
    charts.fan(0, &quad, |p| m * (p - 128.0) + 128.3);
    charts
}

#[test]
fn a_turned_chart_is_resampled_closely() {
    let image = picture(256, 256, 3, false);
    let slot = slot(Role::BaseColor, &image);
    let charts = turned_quad(0.4, 1.0 / 0.7);
    let job = charts.bake(&slot, &image);
    let baked = bake(&job, &Context::silent()).unwrap();
    assert_eq!(baked.resampled_area, 1.0);
    let fidelity = fidelity(&job, &baked, 20_000, &Context::silent()).unwrap();
    assert!(fidelity.psnr_db > 40.0 && !fidelity.exact, "{fidelity:?}");
}

#[test]
fn directions_keep_their_angle_under_any_turn() {
    let mut image = picture(256, 256, 3, false).into_rgb8();
    for n in image.pixels_mut() {
        let (x, y) = (f64::from(n[0]) / 255.0 - 0.5, f64::from(n[1]) / 255.0 - 0.5);
        let z = (1.0 - x * x - y * y).sqrt();
        *n = image::Rgb([x, y, z].map(|v| ((v * 0.5 + 0.5) * 255.0).round() as u8));
    }
    let image = image.into();
    let slot = slot(Role::Normal, &image);
    for (angle, exact) in [(0.0, true), (std::f64::consts::FRAC_PI_2, true), (std::f64::consts::PI, true), (1.0, false)]
    {
        let mut charts = turned_quad(angle, 1.0 / 0.7);
        if exact {
            charts.after.uv.iter_mut().for_each(|uv| *uv = (*uv - 0.3).round());
        }
        let job = charts.bake(&slot, &image);
        let baked = bake(&job, &Context::silent()).unwrap();
        let fidelity = fidelity(&job, &baked, 5000, &Context::silent()).unwrap();
        assert_eq!(fidelity.exact, exact, "{angle}: {fidelity:?}");
        assert!(fidelity.angle_median_deg.unwrap() < if exact { 1e-6 } else { 0.5 }, "{fidelity:?}");
        assert!(fidelity.angle_p95_deg.unwrap() < if exact { 1e-6 } else { 2.0 }, "{fidelity:?}");
    }
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let image = picture(256, 256, 4, false);
    let mut slot = slot(Role::BaseColor, &image);
    slot.alpha = Alpha::Mask(0.5);
    let charts = turned_quad(0.7, 0.8);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let job = charts.bake(&slot, &image);
            let baked = bake(&job, &Context::silent()).unwrap();
            let fidelity = fidelity(&job, &baked, 10_000, &Context::silent()).unwrap();
            (baked, fidelity)
        })
    };
    assert_eq!(run(1), run(4));
}

#[test]
fn a_mask_made_smaller_keeps_its_coverage() {
    // Blades of one texel in four: filtering alone would bring all of them under the cutoff.
    let samples = (0..256 * 256).flat_map(|i| [40u8, 160, 60, if i % 4 == 0 { 255 } else { 0 }]).collect();
    let image = from_samples([256, 256], 4, samples).unwrap();
    let mut slot = slot(Role::BaseColor, &image);
    slot.alpha = Alpha::Mask(0.5);
    let charts = turned_quad(0.3, 0.5);
    let out = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
    let inside = |p: i64| (100..156).contains(&p);
    let texels: Vec<_> =
        (0..256).flat_map(|y| (0..256).map(move |x| (x, y))).filter(|(x, y)| inside(*x) && inside(*y)).collect();
    let shown = texels.iter().filter(|(x, y)| texel(&out, *x, *y)[3] >= 128).count();
    let coverage = shown as f64 / texels.len() as f64;
    assert!((coverage - 0.25).abs() < 0.06, "{coverage}");
}

#[test]
fn a_smaller_slot_moves_with_the_reference_and_other_primitives_are_left_out() {
    let image = noise(32, 32, 1, 9);
    let slot = slot(Role::MetallicRoughness, &image);
    // The reference is twice as large: texels of the slot are whole for even moves.
    let mut charts = Charts::new([64, 64], [128, 32]);
    let quad = [(8.0, 8.0), (24.0, 8.0), (24.0, 24.0), (8.0, 24.0)].map(|(x, y)| DVec2::new(x, y));
    charts.fan(0, &quad, |p| p + DVec2::new(22.0, -4.0));
    charts.fan(1, &quad, |p| p + DVec2::new(80.0, 0.0));
    let baked = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap();
    let out = &baked.pages[0];
    assert_eq!((out.width(), out.height()), (64, 16));
    assert_eq!(baked.verbatim_face, [true, true, false, false]);
    assert_eq!(baked.verbatim_texels, 64);
    for y in 4..12 {
        for x in 4..12 {
            assert_eq!(texel(out, x + 11, y - 2), texel(&image, x, y));
        }
    }
}

#[test]
fn what_makes_no_sense_is_left_out_or_refused() {
    let image = noise(16, 16, 4, 1);
    let slot = slot(Role::BaseColor, &image);
    let mut charts = Charts::new([16, 16], [32, 32]);
    let square = [(2.0, 2.0), (9.0, 2.0), (9.0, 9.0), (2.0, 9.0)].map(|(x, y)| DVec2::new(x, y));
    charts.fan(0, &square, |p| p);
    // A point, a line, a line that was a square, nowhere, and far away.
    charts.fan(0, &[DVec2::splat(3.0); 3], |p| p + 12.3);
    charts.fan(0, &[DVec2::splat(3.0), DVec2::splat(9.0), DVec2::splat(5.0)], |p| p * 2.2);
    charts.fan(0, &square, |p| DVec2::new(p.x * 1.7, 20.2));
    charts.fan(0, &square, |p| p * f64::NAN);
    charts.fan(0, &square, |p| p * 1e300);
    let job = charts.bake(&slot, &image);
    let baked = bake(&job, &Context::silent()).unwrap();
    assert!(baked.verbatim_face[0] && !baked.verbatim_face[baked.verbatim_face.len() - 1]);
    assert!(fidelity(&job, &baked, 1000, &Context::silent()).unwrap().psnr_db.is_finite());

    let mut foreign = charts.after.clone();
    foreign.provenance[0].source = FaceId(999);
    assert!(bake(&Bake { after: &foreign, ..job.clone() }, &Context::silent()).is_err());
    let empty = DynamicImage::new_rgba8(0, 16);
    assert!(bake(&charts.bake(&slot, &empty), &Context::silent()).is_err());
    let mut mixed = job.clone();
    let grey = noise(16, 16, 1, 1);
    mixed.sources.push(Source { image: &grey, ..mixed.sources[0] });
    assert!(bake(&mixed, &Context::silent()).is_err());
    let cancel = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(true));
    let canceled = Context::new(std::sync::Arc::new(crate::context::Silent), cancel, 0);
    assert_eq!(bake(&job, &canceled).unwrap_err().code, crate::error::Code::Canceled);
}
