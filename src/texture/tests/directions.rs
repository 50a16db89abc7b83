//! Directions, seen on the surface: the world-space vectors of the new sheet are those of the uploaded image.

use super::*;

/// An image whose texels are directions, by a function of the place.
fn field(channels: u8, value: impl Fn(DVec2) -> [f64; 3]) -> DynamicImage {
    let texels = (0..256 * 256).map(|i| value(DVec2::new(f64::from(i % 256) + 0.5, f64::from(i / 256) + 0.5)));
    let samples = texels.flat_map(|v| {
        let coded = v.map(|v| (v * 255.0).round() as u8).into_iter().chain([255]);
        coded.take(usize::from(channels)).collect::<Vec<_>>()
    });
    from_samples([256, 256], channels, samples.collect()).unwrap()
}

fn coded(v: f64) -> f64 {
    v * 0.5 + 0.5
}

fn normals(p: DVec2) -> [f64; 3] {
    let n = DVec3::new(0.6 * (p.x / 17.0).sin(), 0.5 * (p.y / 23.0 + 1.0).cos(), 1.0).normalize();
    n.to_array().map(coded)
}

fn brushed(p: DVec2) -> [f64; 3] {
    let angle = p.x / 31.0 + (p.y / 27.0).sin();
    [coded(angle.cos()), coded(angle.sin()), 0.55 + 0.4 * (p.y / 19.0).sin()]
}

/// The three numbers of a texel as numbers, by bilinear filtering.
fn read(image: &DynamicImage, p: DVec2) -> DVec3 {
    let (base, t) = ((p - 0.5).floor(), p - 0.5 - (p - 0.5).floor());
    let mut sum = DVec3::ZERO;
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let weight = (if dx == 1 { t.x } else { 1.0 - t.x }) * (if dy == 1 { t.y } else { 1.0 - t.y });
        let v = texel(image, base.x as i64 + dx, base.y as i64 + dy);
        sum += weight * DVec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2])) / 255.0;
    }
    sum
}

/// What a texel means in a tangent frame: a normal (whose x and y the material scales by 1.7), or a direction along the surface.
fn world(role: Role, value: DVec3, tangent: DVec3, bitangent: DVec3) -> DVec3 {
    let v = value * 2.0 - 1.0;
    match role.direction() {
        Some(Direction::Normal) => (1.7 * (tangent * v.x + bitangent * v.y) + DVec3::Z * v.z).normalize(),
        _ => (tangent * v.x + bitangent * v.y).normalize(),
    }
}

#[test]
fn directions_on_the_surface_stay_under_turns_mirroring_and_scale() {
    let flip = DMat2::from_diagonal(DVec2::new(1.0, -1.0));
    let quarter = DMat2::from_cols(DVec2::Y, -DVec2::X);
    // Whole moves first: all eight symmetries are exact.
    let mut moves: Vec<(DMat2, bool)> = Vec::new();
    for k in 0..8 {
        let turn = (0..k % 4).fold(DMat2::IDENTITY, |m, _| quarter * m);
        moves.push((if k < 4 { turn } else { turn * flip }, true));
    }
    for (angle, scale) in [(0.7, 1.0), (2.2, 0.9), (-1.3, 0.55), (0.4, 0.31)] {
        moves.extend([DMat2::IDENTITY, flip].map(|f| (DMat2::from_angle(angle) * f * scale, false)));
    }
    for (role, image) in [
        (Role::Normal, field(3, normals)),
        (Role::ClearcoatNormal, field(4, normals)),
        (Role::Anisotropy, field(3, brushed)),
    ] {
        for (m, exact) in &moves {
            let mut charts = Charts::new([256, 256], [256, 256]);
            let quad = [(60.0, 60.0), (196.0, 60.0), (196.0, 196.0), (60.0, 196.0)].map(|(x, y)| DVec2::new(x, y));
            charts.fan(0, &quad, |p| *m * (p - 128.0) + 128.0);
            let slot = slot(role, &image);
            let job = charts.bake(&slot, &image);
            let baked = bake(&job, &Context::silent()).unwrap();
            assert_eq!(baked.resampled_area == 0.0, *exact);
            let figures = fidelity(&job, &baked, 4000, &Context::silent()).unwrap();
            assert_eq!(figures.exact, *exact, "{role:?} {m}");
            let (mut worst, mut strength) = (0.0f64, 0.0f64);
            let mut random = Random(7);
            for _ in 0..2000 {
                let p = DVec2::new(random.range(64.0, 192.0), random.range(64.0, 192.0));
                let (old, new) = (read(&image, p), read(&baked.pages[0], *m * (p - 128.0) + 128.0));
                // On the uploaded image +u is x on the surface and +v is -y; the new +u is what leads there.
                let along = m.inverse() * DVec2::X;
                let tangent = DVec3::new(along.x, -along.y, 0.0).normalize();
                let bitangent = DVec3::Z.cross(tangent) * m.determinant().signum();
                let (a, b) = (world(role, old, DVec3::X, DVec3::Y), world(role, new, tangent, bitangent));
                worst = worst.max(a.cross(b).length().atan2(a.dot(b)).to_degrees());
                if role == Role::Anisotropy {
                    strength = strength.max((old.z - new.z).abs() * 255.0);
                }
            }
            let limit = if *exact { 0.7 } else { 2.5 };
            assert!(worst < limit && strength < 6.0, "{role:?} by {m}: {worst} degrees, strength off by {strength}");
            let (median, p95) = (figures.angle_median_deg.unwrap(), figures.angle_p95_deg.unwrap());
            assert!(median <= p95 && p95 < limit, "{role:?} by {m}: {figures:?}");
        }
    }
}

/// Stripes one texel wide, of two directions in degrees, at a quarter of the density.
fn stripes(angles: [f64; 2]) -> DVec3 {
    let stripe = |p: DVec2| {
        let angle = angles[p.x as usize % 2].to_radians();
        [coded(angle.cos()), coded(angle.sin()), 0.8]
    };
    let image = field(3, stripe);
    let slot = slot(Role::Anisotropy, &image);
    let mut charts = Charts::new([256, 256], [256, 256]);
    let quad = [(0.0, 0.0), (256.0, 0.0), (256.0, 256.0), (0.0, 256.0)].map(|(x, y)| DVec2::new(x, y));
    charts.fan(0, &quad, |p| p * 0.25);
    let out = bake(&charts.bake(&slot, &image), &Context::silent()).unwrap().pages.remove(0);
    let v = texel(&out, 30, 30);
    let angle = (f64::from(v[1]) / 127.5 - 1.0).atan2(f64::from(v[0]) / 127.5 - 1.0);
    DVec3::new(angle.to_degrees().rem_euclid(180.0), f64::from(v[2]) / 255.0, f64::from(v[2]))
}

#[test]
fn opposite_directions_are_the_same_and_crossed_ones_cancel() {
    let same = stripes([30.0, 210.0]);
    assert!((same.x - 30.0).abs() < 1.5 && (same.y - 0.8).abs() < 0.02, "{same}");
    let near = stripes([100.0, 120.0]);
    assert!((near.x - 110.0).abs() < 1.5 && (0.7..0.8).contains(&near.y), "{near}");
    let crossed = stripes([20.0, 110.0]);
    assert!(crossed.y < 0.05, "{crossed}");
}
