//! Mip levels of a page.

use crate::texture::{Direction, Role, linear_to_srgb, srgb_to_linear};

/// How texels become one: what they mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MipFilter {
    /// Colour is averaged as light.
    pub srgb: bool,
    /// RGB is a direction, and stays as long as it was.
    pub normal: bool,
    /// Colour counts as much as its alpha.
    pub premultiplied: bool,
}

impl MipFilter {
    /// That of a role, whose alpha blends or does not.
    pub fn of(role: Role, blend: bool) -> Self {
        MipFilter { srgb: role.is_srgb(), normal: role.direction() == Some(Direction::Normal), premultiplied: blend }
    }
}

/// RGBA, eight bits a channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Level {
    pub(super) size: [usize; 2],
    pub(super) texels: Vec<[u8; 4]>,
}

impl Level {
    /// This level and all smaller ones, down to one texel.
    pub(super) fn chain(self, filter: MipFilter) -> Vec<Level> {
        let table: Vec<f32> = (0..256).map(|v| srgb_to_linear(f64::from(v) / 255.0) as f32).collect();
        let mut levels = vec![self];
        while let Some(last) = levels.last().filter(|l| l.size != [1, 1]) {
            let next = last.half(filter, &table);
            levels.push(next);
        }
        levels
    }

    fn half(&self, filter: MipFilter, linear: &[f32]) -> Level {
        let size = self.size.map(|n| (n / 2).max(1));
        let taps: [Vec<Vec<(usize, f32)>>; 2] =
            [0, 1].map(|k| (0..size[k]).map(|i| shares(i, self.size[k], size[k])).collect());
        let mut texels = Vec::with_capacity(size[0] * size[1]);
        for rows in &taps[1] {
            for columns in &taps[0] {
                let (mut sum, mut colours, mut weight) = ([0f32; 4], 0f32, 0f32);
                for (y, a) in rows {
                    for (x, b) in columns {
                        let texel = self.texels[y * self.size[0] + x];
                        let w = a * b;
                        let alpha = f32::from(texel[3]) / 255.0;
                        let colour = if filter.premultiplied { w * alpha.max(1e-4) } else { w };
                        for c in 0..3 {
                            let value =
                                if filter.srgb { linear[usize::from(texel[c])] } else { f32::from(texel[c]) / 255.0 };
                            sum[c] += colour * value;
                        }
                        sum[3] += w * alpha;
                        colours += colour;
                        weight += w;
                    }
                }
                texels.push(encoded([sum[0] / colours, sum[1] / colours, sum[2] / colours, sum[3] / weight], filter));
            }
        }
        Level { size, texels }
    }
}

/// Texels of `from` that lie under texel `i` of `to`, and how much of each.
fn shares(i: usize, from: usize, to: usize) -> Vec<(usize, f32)> {
    let scale = from as f64 / to as f64;
    let (a, b) = (i as f64 * scale, (i + 1) as f64 * scale);
    let covered = |x: usize| (b.min(x as f64 + 1.0) - a.max(x as f64)) as f32;
    (a as usize..from.min(b.ceil() as usize)).map(|x| (x, covered(x))).filter(|(_, w)| *w > 1e-6).collect()
}

fn encoded(value: [f32; 4], filter: MipFilter) -> [u8; 4] {
    let mut colour = [value[0], value[1], value[2]];
    if filter.normal {
        let v = colour.map(|c| 2.0 * c - 1.0);
        let length = v.iter().map(|c| c * c).sum::<f32>().sqrt();
        if length > 1e-3 {
            colour = v.map(|c| 0.5 * c / length + 0.5);
        }
    }
    let byte = |v: f32| (255.0 * v).round().clamp(0.0, 255.0) as u8;
    let [r, g, b] = colour.map(|c| if filter.srgb { byte(linear_to_srgb(f64::from(c)) as f32) } else { byte(c) });
    [r, g, b, byte(value[3])]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chain(size: [usize; 2], texels: Vec<[u8; 4]>, filter: MipFilter) -> Vec<Level> {
        Level { size, texels }.chain(filter)
    }

    #[test]
    fn light_is_kept_and_normals_stay_unit_vectors() {
        let plain = MipFilter { srgb: false, normal: false, premultiplied: false };
        let board = |[w, h]: [usize; 2]| -> Vec<[u8; 4]> {
            (0..w * h).map(|i| if (i % w + i / w) % 2 == 0 { [255, 0, 10, 255] } else { [0, 0, 30, 0] }).collect()
        };
        let levels = chain([8, 4], board([8, 4]), plain);
        assert_eq!(levels.iter().map(|l| l.size).collect::<Vec<_>>(), [[8, 4], [4, 2], [2, 1], [1, 1]]);
        assert!(levels[1..].iter().all(|l| l.texels.iter().all(|t| *t == [128, 0, 20, 128])));
        let light = chain([8, 4], board([8, 4]), MipFilter { srgb: true, ..plain });
        assert_eq!(light[1].texels[0][0], 188);
        let opaque = chain([8, 4], board([8, 4]), MipFilter { premultiplied: true, ..plain });
        assert_eq!(opaque[1].texels[0], [255, 0, 10, 128]);
        let bent: Vec<[u8; 4]> =
            (0..4).map(|i| if i % 2 == 0 { [218, 128, 218, 255] } else { [37, 128, 218, 255] }).collect();
        assert_eq!(chain([2, 2], bent, MipFilter { normal: true, ..plain })[1].texels[0], [128, 128, 255, 255]);
    }

    #[test]
    fn odd_sides_lose_nothing() {
        let plain = MipFilter { srgb: false, normal: false, premultiplied: false };
        for size in [[5, 3], [7, 1], [1, 9], [13, 11]] {
            let texels: Vec<[u8; 4]> = (0..size[0] * size[1]).map(|i| [(i * 37 % 251) as u8, 200, 0, 255]).collect();
            let mean = |l: &Level| l.texels.iter().map(|t| f64::from(t[0])).sum::<f64>() / l.texels.len() as f64;
            let levels = chain(size, texels, plain);
            for level in &levels {
                assert!((mean(level) - mean(&levels[0])).abs() < 1.5, "{size:?} {:?}", level.size);
                assert!(level.texels.iter().all(|t| t[1..] == [200, 0, 255]));
            }
        }
    }
}
