//! Where density falls: nothing aliases; and what the gutters keep apart when it falls by mipmaps.

use super::*;

/// Charts, the map from new to uploaded texels, for an image that is turned by `angle` and made smaller by `scale`.
fn smaller(side: u32, angle: f64, scale: f64) -> (Charts, impl Fn(DVec2) -> DVec2) {
    let size = f64::from(side);
    let mut charts = Charts::new([side; 2], [side; 2]);
    let quad = [(0.0, 0.0), (size, 0.0), (size, size), (0.0, size)].map(|(x, y)| DVec2::new(x, y));
    let m = DMat2::from_angle(angle) * scale;
    charts.fan(0, &quad, |p| m * (p - size / 2.0) + size / 2.0 + 0.3);
    (charts, move |p: DVec2| m.inverse() * (p - size / 2.0 - 0.3) + size / 2.0)
}

/// The mean over a new texel of the uploaded image, by 12 x 12 points of its bilinear interpolation.
fn box_filtered(image: &DynamicImage, map: &impl Fn(DVec2) -> DVec2, x: i64, y: i64) -> f64 {
    let mut sum = 0.0;
    for i in 0..12 * 12 {
        let p = DVec2::new(x as f64 + (f64::from(i % 12) + 0.5) / 12.0, y as f64 + (f64::from(i / 12) + 0.5) / 12.0);
        sum += bilinear(image, map(p));
    }
    sum / (12.0 * 12.0)
}

fn bilinear(image: &DynamicImage, point: DVec2) -> f64 {
    let (base, t) = ((point - 0.5).floor(), (point - 0.5).fract_gl());
    let clamp = |v: f64, d: i64, n: u32| (v as i64 + d).clamp(0, i64::from(n) - 1);
    let mut sum = 0.0;
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let weight = (if dx == 1 { t.x } else { 1.0 - t.x }) * (if dy == 1 { t.y } else { 1.0 - t.y });
        let value = texel(image, clamp(base.x, dx, image.width()), clamp(base.y, dy, image.height()))[0];
        sum += weight * f64::from(value);
    }
    sum
}

#[test]
fn a_zone_plate_made_smaller_does_not_alias() {
    // Frequencies grow from the middle, to one half a texel at the middle of the sides.
    let side = 384;
    let k = std::f64::consts::PI / f64::from(side);
    let ring = |i: u32| {
        let p = DVec2::new(f64::from(i % side), f64::from(i / side)) + 0.5 - f64::from(side) / 2.0;
        (127.5 + 120.0 * (k * p.length_squared()).cos()).round() as u8
    };
    let image = from_samples([side, side], 1, (0..side * side).map(ring).collect()).unwrap();
    let slot = slot(Role::Occlusion, &image);
    for (angle, scale) in [(0.0, 0.4), (0.5, 0.4), (0.2, 0.7), (0.0, 0.15)] {
        let (charts, map) = smaller(side, angle, scale);
        let out = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
        let (mut slow, mut fast) = ([0.0; 2], [0.0; 3]);
        for (x, y) in (0..i64::from(side)).flat_map(|y| (0..i64::from(side)).map(move |x| (x, y))) {
            let old = map(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
            let r = (old - f64::from(side) / 2.0).length();
            // Cycles by new texel.
            let frequency = k * r / std::f64::consts::PI / scale;
            if r > 0.45 * f64::from(side) || (0.08..0.75).contains(&frequency) {
                continue;
            }
            let value = f64::from(texel(&out, x, y)[0]);
            let reference = box_filtered(&image, &map, x, y);
            if frequency < 0.08 {
                slow = [slow[0] + (value - reference).powi(2), slow[1] + 1.0];
            } else {
                fast = [fast[0] + (value - 127.5).powi(2), fast[1] + (reference - 127.5).powi(2), fast[2] + 1.0];
            }
        }
        assert!(scale < 0.2 || slow[1] > 20.0, "{angle} {scale}: {slow:?}");
        assert!((slow[0] / slow[1]).sqrt() < 6.0, "{angle} {scale}: what can be shown is off by {slow:?}");
        if fast[2] > 0.0 {
            let [own, reference] = [fast[0], fast[1]].map(|sum| (sum / fast[2]).sqrt());
            assert!(own < 10.0 && own < reference + 2.0, "{angle} {scale}: {own} beside {reference} of the box");
        }
    }
}

#[test]
fn colours_are_averaged_as_light() {
    let side = 128;
    let samples = (0..side * side).flat_map(|i| [if (i / side + i) % 2 == 0 { 0u8 } else { 255 }; 3]).collect();
    let image = from_samples([side, side], 3, samples).unwrap();
    // Half the light is 188 in sRGB; half of a number is 128.
    for (role, expected) in [(Role::BaseColor, 188), (Role::Emissive, 188), (Role::MetallicRoughness, 128)] {
        let slot = slot(role, &image);
        let out = bake(&smaller(side, 0.3, 0.3).0.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
        for p in 56..72 {
            let value = texel(&out, p, 64)[0];
            assert!(value.abs_diff(expected) <= 4, "{role:?}: {value}");
        }
    }
}

/// The next mip level: means of 2 x 2 texels.
fn halved(size: [usize; 2], texels: &[f64]) -> ([usize; 2], Vec<f64>) {
    let [w, h] = size.map(|s| s / 2);
    let at = |x: usize, y: usize| texels[y * size[0] + x];
    let mean = |i: usize| {
        let (x, y) = (i % w * 2, i / w * 2);
        (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1)) / 4.0
    };
    ([w, h], (0..w * h).map(mean).collect())
}

#[test]
fn a_gutter_keeps_charts_apart_in_mipmaps() {
    // Each chart is the middle of a field of one value.
    let values = [10u8, 90, 170, 250];
    let image = from_samples([256, 64], 1, (0..256 * 64).map(|i| values[i % 256 / 64]).collect()).unwrap();
    let slot = slot(Role::Occlusion, &image);
    for gutter in [2u32, 4, 8] {
        let g = f64::from(gutter);
        let pitch = 32.0 + g;
        let mut charts = Charts::new([256, 64], [2 * (32 + gutter) + gutter; 2]);
        let corner = |i: usize| g + pitch * DVec2::new((i % 2) as f64, (i / 2) as f64);
        for i in 0..4 {
            let old = DVec2::new(64.0 * i as f64 + 16.0, 16.0);
            let quad = [(0.0, 0.0), (32.0, 0.0), (32.0, 32.0), (0.0, 32.0)].map(|(x, y)| old + DVec2::new(x, y));
            charts.fan(0, &quad, |p| p - old + corner(i));
        }
        let out = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
        let mut size = [out.width() as usize, out.height() as usize];
        let mut texels: Vec<f64> = out.as_bytes().iter().map(|v| f64::from(*v)).collect();
        for level in 0..=gutter.ilog2() {
            let scale = f64::from(1 << level);
            for (i, value) in values.iter().enumerate() {
                let all = (0..=32).flat_map(|x| (0..=32).map(move |y| DVec2::new(f64::from(x), f64::from(y))));
                for point in all.map(|p| (corner(i) + p) / scale) {
                    // Below the last level bilinear filtering reads nothing foreign up to the border; there, the chart's own texels hold
                    // nothing foreign.
                    let last = level == gutter.ilog2();
                    let inside = (corner(i) / scale + 0.5, (corner(i) + 32.0) / scale - 0.5);
                    let p = if last { point.clamp(inside.0, inside.1) } else { point } - 0.5;
                    let (base, t) = (p.floor(), p - p.floor());
                    let mut shown = 0.0;
                    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                        let clamp = |v: f64, d: i64, n: usize| (v as i64 + d).clamp(0, n as i64 - 1) as usize;
                        let (x, y) = (clamp(base.x, dx, size[0]), clamp(base.y, dy, size[1]));
                        let weight = (if dx == 1 { t.x } else { 1.0 - t.x }) * (if dy == 1 { t.y } else { 1.0 - t.y });
                        shown += if weight > 0.0 { weight * texels[y * size[0] + x] } else { 0.0 };
                    }
                    assert!(
                        (shown - f64::from(*value)).abs() < 1e-6,
                        "gutter {gutter}, level {level}: {shown} for {value}"
                    );
                }
            }
            (size, texels) = halved(size, &texels);
        }
    }
}
