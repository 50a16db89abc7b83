//! Transfer functions: between the samples of a file and the numbers that filters work on.

use super::pixels::Depth;
use super::{Direction, Role};

/// What the colour channels hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Space {
    /// sRGB-encoded light; averaged as linear light.
    Srgb,
    /// Plain numbers in 0..=1.
    Linear,
    /// `value * 2 - 1`: unit vectors (glTF 2.0, 3.9.3), or two components and a plain strength (KHR_materials_anisotropy).
    Directed(Direction),
}

impl Space {
    /// The space of a slot's colour channels. Directions need three of them.
    pub(crate) fn of(role: Role, channels: u8) -> Self {
        match role.direction() {
            Some(direction) if channels >= 3 => Space::Directed(direction),
            _ if role.is_srgb() => Space::Srgb,
            _ => Space::Linear,
        }
    }
}

/// Channel of alpha among `channels`.
pub(crate) const fn alpha_channel(channels: usize) -> Option<usize> {
    match channels {
        2 => Some(1),
        4 => Some(3),
        _ => None,
    }
}

/// Light from an sRGB-encoded value, both in 0..=1 (IEC 61966-2-1).
pub(crate) fn srgb_to_linear(value: f64) -> f64 {
    if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// The inverse of [`srgb_to_linear`].
pub(crate) fn linear_to_srgb(value: f64) -> f64 {
    if value <= 0.003_130_8 { value * 12.92 } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
}

/// Buckets of the table that finds an 8-bit sRGB code; the darkest codes are more than one bucket apart.
const BUCKETS: usize = 8192;

/// The transfer function of one slot, as tables: decodes and encodes its samples.
pub(crate) struct Transfer<T> {
    /// What the colour channels hold.
    pub(crate) space: Space,
    colour: Vec<f32>,
    /// Of alpha, and of the strength of an anisotropy.
    plain: Vec<f32>,
    /// 8-bit sRGB only: the code at the lower end of each bucket of light.
    codes: Vec<u8>,
    /// 8-bit sRGB only: the light from which the next code is nearer.
    limits: Vec<f32>,
    depth: std::marker::PhantomData<T>,
}

impl<T: Depth> Transfer<T> {
    /// Tables for a space.
    pub(crate) fn new(space: Space) -> Self {
        let unit = |v: u32| f64::from(v) / f64::from(T::MAX);
        let plain: Vec<f32> = (0..=T::MAX).map(|v| unit(v) as f32).collect();
        let colour = match space {
            Space::Srgb => (0..=T::MAX).map(|v| srgb_to_linear(unit(v)) as f32).collect(),
            Space::Linear => plain.clone(),
            Space::Directed(_) => (0..=T::MAX).map(|v| (unit(v) * 2.0 - 1.0) as f32).collect(),
        };
        let mut codes = Vec::new();
        let mut limits = Vec::new();
        if space == Space::Srgb && T::MAX == 255 {
            limits = (0..255).map(|v| srgb_to_linear((f64::from(v) + 0.5) / 255.0) as f32).collect();
            let mut code = 0;
            for bucket in 0..=BUCKETS {
                let light = bucket as f32 / BUCKETS as f32;
                while limits.get(code).is_some_and(|limit| light >= *limit) {
                    code += 1;
                }
                codes.push(code as u8);
            }
        }
        Transfer { space, colour, plain, codes, limits, depth: std::marker::PhantomData }
    }

    /// The transfer function in which texels are interpolated: encoded values, as dark edges would ring in linear light, and as the figures of
    /// fidelity take them.
    pub(crate) fn shown(&self) -> Self {
        Transfer::new(if self.space == Space::Srgb { Space::Linear } else { self.space })
    }

    /// The numbers of one texel of `C` samples.
    #[inline]
    pub(crate) fn decode<const C: usize>(&self, texel: &[T]) -> [f32; C] {
        let mut out = [0.0; C];
        let strength = self.space == Space::Directed(Direction::Anisotropy);
        for (c, (o, t)) in out.iter_mut().zip(texel).enumerate() {
            let plain = alpha_channel(C) == Some(c) || (strength && c == 2);
            let table = if plain { &self.plain } else { &self.colour };
            *o = table[t.value() as usize];
        }
        out
    }

    /// The numbers of texels that lie side by side. Faster than [`Transfer::decode`] where samples are plain numbers.
    #[inline]
    pub(crate) fn decode_all<const C: usize, const N: usize>(&self, texels: &[T], out: &mut [[f32; C]; N]) {
        if self.space == Space::Linear {
            let unit = (T::MAX as f32).recip();
            for (o, t) in out.as_flattened_mut().iter_mut().zip(texels) {
                *o = t.value() as i32 as f32 * unit;
            }
        } else {
            for (o, t) in out.iter_mut().zip(texels.chunks_exact(C)) {
                *o = self.decode(t);
            }
        }
    }

    /// The samples nearest to the numbers of one texel. Directions are made unit vectors first; where nothing is left of them, a normal
    /// becomes the flat one, and an anisotropy runs along the tangent.
    #[inline]
    pub(crate) fn encode<const C: usize>(&self, mut texel: [f32; C], out: &mut [T]) {
        if let Space::Directed(direction) = self.space {
            let (components, neutral) = match direction {
                Direction::Normal => (3, 2),
                Direction::Anisotropy => (2, 0),
            };
            let length = texel.iter().take(components).map(|t| t * t).sum::<f32>().sqrt();
            let none = length < 1e-6;
            for (c, t) in texel.iter_mut().enumerate().take(components) {
                let unit = if none { f32::from(u8::from(c == neutral)) } else { *t / length };
                *t = unit * 0.5 + 0.5;
            }
        }
        for (c, (o, t)) in out.iter_mut().zip(texel).enumerate() {
            *o = if self.space == Space::Srgb && alpha_channel(C) != Some(c) {
                self.encode_light(t)
            } else {
                quantise(t)
            };
        }
    }

    #[inline]
    fn encode_light(&self, light: f32) -> T {
        // NaN cannot come from finite samples; it would become 0.
        let light = light.clamp(0.0, 1.0);
        if self.codes.is_empty() {
            return quantise(linear_to_srgb(f64::from(light)) as f32);
        }
        let mut code = usize::from(self.codes[(light * BUCKETS as f32) as i32 as usize]);
        while self.limits.get(code).is_some_and(|limit| light >= *limit) {
            code += 1;
        }
        T::from_value(code as u32)
    }
}

#[inline]
fn quantise<T: Depth>(value: f32) -> T {
    T::from_value((value.clamp(0.0, 1.0) * T::MAX as f32 + 0.5) as i32 as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip<T: Depth + std::fmt::Debug>(space: Space) {
        let transfer = Transfer::<T>::new(space);
        for v in 0..=T::MAX {
            let texel = [T::from_value(v), T::from_value(T::MAX - v)];
            let mut out = [T::default(); 2];
            transfer.encode::<2>(transfer.decode::<2>(&texel), &mut out);
            assert_eq!(out, texel, "{space:?}");
        }
    }

    #[test]
    fn every_sample_survives_decoding_and_encoding() {
        for space in [Space::Srgb, Space::Linear] {
            round_trip::<u8>(space);
            round_trip::<u16>(space);
        }
    }

    #[test]
    fn light_becomes_the_nearest_code() {
        let transfer = Transfer::<u8>::new(Space::Srgb);
        for i in 0..=100_000 {
            let light = f64::from(i) / 100_000.0;
            let mut out = [0u8];
            transfer.encode::<1>([light as f32], &mut out);
            let exact = linear_to_srgb(light) * 255.0;
            assert!((f64::from(out[0]) - exact).abs() < 0.501, "{light}: {} for {exact}", out[0]);
        }
    }

    #[test]
    fn directions_are_encoded_as_unit_vectors() {
        let transfer = Transfer::<u8>::new(Space::Directed(Direction::Normal));
        let mut out = [0u8; 3];
        transfer.encode::<3>([0.0, 0.0, 0.2], &mut out);
        assert_eq!(out, [128, 128, 255]);
        transfer.encode::<3>([0.0; 3], &mut out);
        assert_eq!(out, [128, 128, 255]);
    }

    #[test]
    fn the_strength_of_an_anisotropy_is_a_plain_number() {
        let transfer = Transfer::<u8>::new(Space::Directed(Direction::Anisotropy));
        let texel = transfer.decode::<4>(&[255, 0, 51, 102]);
        assert_eq!(texel, [1.0, -1.0, 0.2, 0.4]);
        let mut out = [0u8; 4];
        transfer.encode::<4>([0.0, -0.3, 0.2, 0.4], &mut out);
        assert_eq!(out, [128, 0, 51, 102]);
        transfer.encode::<4>([0.0, 0.0, 0.2, 0.4], &mut out);
        assert_eq!(out, [255, 128, 51, 102]);
    }
}
