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
        to_unit(self.bits())
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
    let [x, y, z] = cell.to_array().map(|v| v as i64 as u64);
    let blend = |t: f64, ends: [f64; 2]| ends[0] + t * (ends[1] - ends[0]);
    let along_z = |hash: u64| blend(t.z, [0, 1].map(|k| to_unit(mix(hash.wrapping_add(z).wrapping_add(k)))));
    let along_y = |hash: u64| blend(t.y, [0, 1].map(|k| along_z(mix(hash.wrapping_add(y).wrapping_add(k)))));
    blend(t.x, [0, 1].map(|k| along_y(mix(x.wrapping_add(k)))))
}

fn to_unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}
