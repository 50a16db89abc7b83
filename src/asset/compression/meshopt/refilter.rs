//! Elements of which a filter makes attributes again: what [`super::filters`] does, backwards.

use super::{Filter, Mode, StreamLayout, unfiltered};

/// Bits of the whole number in an element of the exponential filter, without its sign.
const MANTISSA: i32 = 23;

/// What stands for 1 in the octahedral coordinates of a stream, and with it their bits; none where it is no such stream.
pub(in crate::asset::compression) fn one_of_octahedral(stream: &[u8], layout: &StreamLayout) -> Option<i16> {
    if layout.filter != Filter::Octahedral || layout.mode != Mode::Attributes || layout.count == 0 {
        return None;
    }
    let data = unfiltered(stream, layout).ok()?;
    let one = match layout.stride {
        4 => i16::from(*data.get(2)? as i8),
        _ => i16::from_le_bytes([*data.get(4)?, *data.get(5)?]),
    };
    (one > 0).then_some(one)
}

/// Octahedral coordinates of unit vectors, elements of four signed components of `stride / 4` bytes; the fourth stays. `one` stands for 1.
pub(in crate::asset::compression) fn octahedral(data: &mut [u8], stride: usize, one: i16) {
    let folded = |[x, y, z]: [f32; 3]| {
        let sum = x.abs() + y.abs() + z.abs();
        let (x, y) = if sum > 0.0 { (x / sum, y / sum) } else { (0.0, 0.0) };
        // The lower half is folded over the corners.
        let (x, y) = if z < 0.0 { ((1.0 - y.abs()).copysign(x), (1.0 - x.abs()).copysign(y)) } else { (x, y) };
        [x, y].map(|v| (v * f32::from(one)).round() as i16)
    };
    match stride {
        4 => {
            for v in data.as_chunks_mut::<4>().0 {
                let [x, y] = folded([v[0], v[1], v[2]].map(|b| f32::from(b as i8)));
                *v = [x as u8, y as u8, one as u8, v[3]];
            }
        }
        _ => {
            for v in data.as_chunks_mut::<8>().0 {
                let [x, y] =
                    folded([[v[0], v[1]], [v[2], v[3]], [v[4], v[5]]].map(|b| f32::from(i16::from_le_bytes(b))));
                let words = [x, y, one].map(i16::to_le_bytes);
                v[..6].copy_from_slice(words.as_flattened());
            }
        }
    }
}

/// Floats as whole numbers with one exponent for each component of the elements; none where that would not be exact.
pub(in crate::asset::compression) fn exponential(data: &[u8], stride: usize) -> Option<Vec<u8>> {
    let components = stride / 4;
    // By component: the exponent of the last bit that any value has.
    let mut least = vec![i32::MAX; components];
    let values = || data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
    for (n, value) in values().enumerate() {
        if !value.is_finite() || (value == 0.0 && value.is_sign_negative()) {
            return None;
        }
        if value != 0.0 {
            let (whole, exponent) = split(value);
            let least = &mut least[n % components];
            *least = (*least).min(exponent + whole.trailing_zeros() as i32);
        }
    }
    let mut out = Vec::with_capacity(data.len());
    for (n, value) in values().enumerate() {
        let exponent = match least[n % components] {
            i32::MAX => 0,
            exponent => exponent,
        };
        if !(-100..=100).contains(&exponent) {
            return None;
        }
        let whole = f64::from(value) * 2f64.powi(-exponent);
        if whole.abs() >= f64::from(1 << MANTISSA) {
            return None;
        }
        out.extend((exponent << 24 | (whole as i32 & 0xFF_FFFF)).to_le_bytes());
    }
    Some(out)
}

/// A finite float's significand as a whole number, and the power of two that goes with it.
fn split(value: f32) -> (u32, i32) {
    let bits = value.to_bits();
    let (exponent, fraction) = ((bits >> 23 & 0xFF) as i32, bits & 0x7F_FFFF);
    if exponent == 0 { (fraction, -149) } else { (fraction | 0x80_0000, exponent - 150) }
}
