//! Reproducible noise.

use glam::DVec3;

/// SplitMix64 (Steele, Lea, Flood 2014).
#[derive(Debug, Clone)]
pub(crate) struct Random(pub(crate) u64);

impl Random {
    /// The next 64 bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        mix(self.0)
    }

    /// Evenly in 0..1.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Scrambles 64 bits.
pub(crate) fn mix(bits: u64) -> u64 {
    let z = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Smooth noise in 0..1 over space, one feature a unit.
pub(crate) fn smooth(p: DVec3) -> f64 {
    let cell = p.floor();
    let t = p - cell;
    let t = t * t * (DVec3::splat(3.0) - 2.0 * t);
    let mut sum = 0.0;
    for corner in 0..8 {
        let d = DVec3::new(f64::from(corner & 1), f64::from(corner >> 1 & 1), f64::from(corner >> 2));
        let [x, y, z] = (cell + d).to_array().map(|v| v as i64 as u64);
        let value = mix(mix(mix(x).wrapping_add(y)).wrapping_add(z));
        let weight = (DVec3::ONE - d + (2.0 * d - DVec3::ONE) * t).to_array().iter().product::<f64>();
        sum += weight * (value >> 11) as f64 / (1_u64 << 53) as f64;
    }
    sum
}
