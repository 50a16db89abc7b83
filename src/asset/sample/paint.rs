//! Textures painted over an unwrapped surface, each texel by the point that it lies on.

use glam::{DVec2, DVec3};

use super::random::{mix, smooth};
use super::surface::Unwrapped;
use crate::texture::{Coding, encode, from_samples};

/// A point of the surface, as a painter sees it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point {
    /// Position.
    pub(crate) position: DVec3,
    /// Unit normal.
    pub(crate) normal: DVec3,
    /// Unit tangent along +u.
    pub(crate) tangent: DVec3,
    /// Unit bitangent, against v.
    pub(crate) bitangent: DVec3,
}

/// Texels painted around each chart, so that filtering reads no background.
const GUTTER: usize = 4;

/// An RGB PNG of the painted surface, texels between charts in `background`.
pub(crate) fn paint(
    shapes: &[&Unwrapped],
    [width, height]: [usize; 2],
    background: [u8; 3],
    mut shade: impl FnMut(Point) -> [u8; 3],
) -> Vec<u8> {
    let mut texels = vec![background; width * height];
    let mut filled = vec![false; width * height];
    let size = DVec2::new(width as f64, height as f64);
    for shape in shapes {
        for triangle in &shape.triangles {
            let corners = triangle.map(|v| shape.uvs[v] * size);
            each_texel(corners, [width, height], |at, weights| {
                if !filled[at] {
                    filled[at] = true;
                    texels[at] = shade(point(shape, *triangle, weights));
                }
            });
        }
    }
    grow(&mut texels, &mut filled, width);
    let image = from_samples([width as u32, height as u32], 3, texels.into_flattened());
    let file = image.and_then(|image| encode(&image, &Coding::Png));
    debug_assert!(file.is_ok(), "writing to memory does not fail");
    file.unwrap_or_default()
}

fn point(shape: &Unwrapped, triangle: [usize; 3], weights: [f64; 3]) -> Point {
    let blend = |of: &dyn Fn(usize) -> DVec3| triangle.iter().zip(weights).map(|(v, w)| of(*v) * w).sum::<DVec3>();
    let normal = blend(&|v| shape.normals[v]).normalize_or(DVec3::Z);
    let tangent = blend(&|v| shape.tangents[v].0);
    let tangent = (tangent - normal * normal.dot(tangent)).normalize_or(normal.any_orthonormal_vector());
    let bitangent = normal.cross(tangent) * shape.tangents[triangle[0]].1;
    Point { position: blend(&|v| shape.positions[v]), normal, tangent, bitangent }
}

/// Calls `f` with each texel whose centre lies in a triangle, and its barycentric coordinates.
fn each_texel(corners: [DVec2; 3], [width, height]: [usize; 2], mut f: impl FnMut(usize, [f64; 3])) {
    let [a, b, c] = corners;
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 {
        return;
    }
    let low = a.min(b).min(c).floor().max(DVec2::ZERO);
    let high = a.max(b).max(c).ceil().min(DVec2::new(width as f64, height as f64));
    for y in low.y as usize..high.y as usize {
        for x in low.x as usize..high.x as usize {
            let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let weights = [(c - b).perp_dot(p - b), (a - c).perp_dot(p - c), (b - a).perp_dot(p - a)].map(|w| w / area);
            if weights.iter().all(|w| *w >= -1e-9) {
                f(y * width + x, weights);
            }
        }
    }
}

/// Copies painted texels outwards, ring by ring.
fn grow(texels: &mut [[u8; 3]], filled: &mut [bool], width: usize) {
    let height = filled.len() / width;
    let mut rim: Vec<usize> = (0..filled.len()).filter(|at| filled[*at]).collect();
    for _ in 0..GUTTER {
        let mut next = Vec::new();
        for at in rim {
            let (x, y) = (at % width, at / width);
            for j in y.saturating_sub(1)..(y + 2).min(height) {
                for near in j * width + x.saturating_sub(1)..j * width + (x + 2).min(width) {
                    if !filled[near] {
                        filled[near] = true;
                        texels[near] = texels[at];
                        next.push(near);
                    }
                }
            }
        }
        rim = next;
    }
}

/// Smooth colours with fine stripes and grain.
pub(crate) fn marble(p: DVec3) -> [u8; 3] {
    let broad = DVec3::new(smooth(p * 2.0), smooth(p * 2.3 + 9.0), smooth(p * 1.9 - 7.0));
    let fine = 0.5 + 0.5 * (60.0 * (p.x + 0.6 * p.y) + 8.0 * smooth(p * 5.0)).sin();
    let grain = mix(mix(mix(p.x.to_bits()) ^ p.y.to_bits()) ^ p.z.to_bits()) as u8;
    let grain = f64::from(grain) / 255.0 - 0.5;
    (DVec3::splat(0.15) + broad * 0.6 + DVec3::new(0.18, 0.12, 0.2) * fine + 0.06 * grain)
        .to_array()
        .map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8)
}

/// A tangent-space normal of small bumps.
pub(crate) fn bumps(point: Point) -> [u8; 3] {
    let k = 22.0;
    let (s, c) = ((point.position * k).map(f64::sin), (point.position * k).map(f64::cos));
    let slope = 0.35 * DVec3::new(c.x * s.y * s.z, s.x * c.y * s.z, s.x * s.y * c.z);
    let world = (point.normal - (slope - point.normal * point.normal.dot(slope))).normalize_or(point.normal);
    let local = DVec3::new(world.dot(point.tangent), world.dot(point.bitangent), world.dot(point.normal));
    local.to_array().map(|v| ((v * 0.5 + 0.5) * 255.0).round() as u8)
}

/// Occlusion, roughness and metalness.
pub(crate) fn orm(p: DVec3) -> [u8; 3] {
    let occlusion = 0.6 + 0.4 * smooth(p * 3.0);
    let roughness = 0.25 + 0.7 * smooth(p * 6.0 + 3.0);
    let metallic = if smooth(p * 2.5 - 4.0) > 0.6 { 1.0 } else { 0.0 };
    [occlusion, roughness, metallic].map(|v| (v * 255.0_f64).round() as u8)
}

/// Glowing spots on black.
pub(crate) fn glow(p: DVec3) -> [u8; 3] {
    let spot = ((smooth(p * 4.0 + 11.0) - 0.7) * 6.0).clamp(0.0, 1.0);
    [255.0, 170.0, 60.0].map(|v: f64| (v * spot).round() as u8)
}
