//! What turns decoded elements into attributes, after the filter appendix. Broken elements give unspecified values,
//! never a panic: casts saturate, and NaN becomes 0.

use std::f32::consts::FRAC_1_SQRT_2;

use super::Filter;

/// Applies a filter to tightly packed elements of `stride` bytes, which goes with it.
pub(super) fn apply(filter: Filter, data: &mut [u8], stride: usize) {
    let bytes = data.as_chunks_mut::<4>().0.iter_mut();
    match (filter, stride) {
        (Filter::None, _) => {}
        (Filter::Octahedral, 4) => bytes.for_each(|v| {
            let [x, y, z] = octahedral([v[0], v[1], v[2]].map(|b| f32::from(b as i8)), 127.0);
            *v = [x as i8 as u8, y as i8 as u8, z as i8 as u8, v[3]];
        }),
        (Filter::Octahedral, _) => words(data, |v| {
            let [x, y, z] = octahedral([v[0], v[1], v[2]].map(|w| f32::from(w as i16)), 32767.0);
            [x as i16 as u16, y as i16 as u16, z as i16 as u16, v[3]]
        }),
        (Filter::Quaternion, _) => words(data, |v| quaternion(v.map(|w| w as i16)).map(|w| w as u16)),
        (Filter::Exponential, _) => bytes.for_each(|v| *v = exponential(i32::from_le_bytes(*v)).to_le_bytes()),
        (Filter::Color, 4) => bytes.for_each(|v| {
            let [y, alpha] = [v[0], v[3]].map(i32::from);
            *v = color(y, i32::from(v[1] as i8), i32::from(v[2] as i8), alpha, 255.0).map(|c| c as u8);
        }),
        (Filter::Color, _) => words(data, |v| {
            let [y, alpha] = [v[0], v[3]].map(i32::from);
            color(y, i32::from(v[1] as i16), i32::from(v[2] as i16), alpha, 65535.0).map(|c| c as u16)
        }),
    }
}

/// Changes elements of four 16-bit components.
fn words(data: &mut [u8], f: impl Fn([u16; 4]) -> [u16; 4]) {
    for element in data.as_chunks_mut::<8>().0 {
        let [a, b, c, d, e, f_, g, h] = *element;
        let changed = f([[a, b], [c, d], [e, f_], [g, h]].map(u16::from_le_bytes));
        for (place, word) in element.as_chunks_mut::<2>().0.iter_mut().zip(changed) {
            *place = word.to_le_bytes();
        }
    }
}

/// A unit vector, times `max`, from two octahedral coordinates and what stands for 1 in them.
fn octahedral([x, y, one]: [f32; 3], max: f32) -> [f32; 3] {
    let (x, y) = (x / one, y / one);
    let z = 1.0 - x.abs() - y.abs();
    // The lower half is folded over the corners.
    let fold = z.min(0.0);
    let (x, y) = (x - fold.copysign(x), y - fold.copysign(y));
    let length = (x * x + y * y + z * z).sqrt();
    [x, y, z].map(|v| (v / length * max).round())
}

/// A unit quaternion from three components and, in the last, what stands for 1 and the number of the missing one.
fn quaternion(v: [i16; 4]) -> [i16; 4] {
    let one = f32::from(v[3] | 3);
    let [x, y, z] = [v[0], v[1], v[2]].map(|c| f32::from(c) / one * FRAC_1_SQRT_2);
    let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
    let missing = (v[3] & 3) as usize;
    let mut out = [0; 4];
    for (n, component) in [w, x, y, z].into_iter().enumerate() {
        out[(missing + n) % 4] = (component * 32767.0).round() as i16;
    }
    out
}

/// A float from an exponent (high byte) and a mantissa.
fn exponential(v: i32) -> f32 {
    let power = f64::from_bits(((1023 + i64::from(v >> 24)) as u64) << 52);
    (f64::from(v << 8 >> 8) * power) as f32
}

/// RGBA, as whole numbers up to `max`, from luma, two chroma differences and alpha, whose highest bit tells how many
/// bits the others have.
fn color(y: i32, orange: i32, green: i32, alpha: i32, max: f32) -> [f32; 4] {
    let full = (1 << (32 - alpha.leading_zeros())) - 1;
    let alpha = alpha & (full >> 1);
    let rgba = [y + orange - green, y + green, y - orange - green, alpha << 1 | alpha & 1];
    rgba.map(|c| (c as f32 * (max / full as f32)).round())
}
