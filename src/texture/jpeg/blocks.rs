//! Blocks of 8 x 8 samples: their cosine transform, quantised (ITU T.81, A.3.3 and A.3.4).

use super::ZIGZAG;

/// A row of a block.
type Row = [f32; 8];

/// Coefficients of a block in zigzag order, quantised.
pub(super) type Coefficients = [i16; 64];

/// The largest coefficient of a baseline file, apart from the first (ITU T.81, table F.2).
const LARGEST: f32 = 1023.0;

/// Below so many steps a coefficient is dropped, but for the first. Most of those that lie between this and a half are grain, and each of them
/// costs some bits; a coefficient that was decoded from a file is near a whole number of steps, and stays.
const DEAD: f32 = 0.58;

/// A quantiser with one table.
#[derive(Debug, Clone)]
pub(super) struct Quantizer {
    /// By place, row by row: one over the step.
    inverse: [f32; 64],
}

impl Quantizer {
    pub(super) fn new(table: &[u16; 64]) -> Self {
        Quantizer { inverse: table.map(|step| 1.0 / f32::from(step.max(1))) }
    }

    /// The coefficients of samples in -128..=127, each rounded to a multiple of its step; small ones are dropped.
    pub(super) fn coefficients(&self, samples: &[Row; 8]) -> Coefficients {
        let transformed = transform(samples);
        let mut steps = [0i16; 64];
        for (v, row) in transformed.iter().enumerate() {
            for (u, value) in row.iter().enumerate() {
                let value = value * self.inverse[v * 8 + u];
                let rounded = value.clamp(-1024.0, LARGEST) + 0.5f32.copysign(value);
                steps[v * 8 + u] = if value.abs() < DEAD { 0 } else { rounded as i16 };
            }
        }
        let first = transformed[0][0] * self.inverse[0];
        steps[0] = (first.clamp(-1024.0, LARGEST) + 0.5f32.copysign(first)) as i16;
        let mut ordered = [0; 64];
        ordered.iter_mut().zip(ZIGZAG).for_each(|(out, place)| *out = steps[usize::from(place)]);
        ordered[1..].iter_mut().for_each(|c| *c = (*c).clamp(-(LARGEST as i16), LARGEST as i16));
        ordered
    }
}

/// Rows of the transform: `COSINES[u][x]` is the factor of sample x in coefficient u.
const COSINES: [Row; 8] = cosines();
/// The same by sample.
const BY_SAMPLE: [Row; 8] = transposed(&COSINES);

/// Half the cosine of k pi / 16.
const HALF_COSINES: [f64; 9] = [
    0.5,
    0.490_392_640_201_615_2,
    0.461_939_766_255_643_4,
    0.415_734_806_151_272_6,
    0.353_553_390_593_273_8,
    0.277_785_116_509_801_1,
    0.191_341_716_182_544_9,
    0.097_545_161_008_064_1,
    0.0,
];

const fn cosines() -> [Row; 8] {
    let mut rows = [[0.0; 8]; 8];
    let mut u = 0;
    while u < 8 {
        let mut x = 0;
        while x < 8 {
            // (2 x + 1) u sixteenths of pi, of a turn of 32.
            let angle = (2 * x + 1) * u % 32;
            let angle = if angle > 16 { 32 - angle } else { angle };
            let value = if angle > 8 { -HALF_COSINES[16 - angle] } else { HALF_COSINES[angle] };
            rows[u][x] = if u == 0 { HALF_COSINES[4] as f32 } else { value as f32 };
            x += 1;
        }
        u += 1;
    }
    rows
}

const fn transposed(rows: &[Row; 8]) -> [Row; 8] {
    let mut columns = [[0.0; 8]; 8];
    let mut i = 0;
    while i < 64 {
        columns[i % 8][i / 8] = rows[i / 8][i % 8];
        i += 1;
    }
    columns
}

/// The cosine transform, rows by the vertical frequency. Sums run in one order, so that every machine gives the same.
fn transform(samples: &[Row; 8]) -> [Row; 8] {
    let mut across = [[0.0f32; 8]; 8];
    for (out, row) in across.iter_mut().zip(samples) {
        for (sample, factors) in row.iter().zip(&BY_SAMPLE) {
            for (out, factor) in out.iter_mut().zip(factors) {
                *out += sample * factor;
            }
        }
    }
    let mut both = [[0.0f32; 8]; 8];
    for (out, factors) in both.iter_mut().zip(&COSINES) {
        for (factor, row) in factors.iter().zip(&across) {
            for (out, value) in out.iter_mut().zip(row) {
                *out += factor * value;
            }
        }
    }
    both
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, term by term.
    #[test]
    fn the_transform_is_that_of_the_standard() {
        let mut samples = [[0.0f32; 8]; 8];
        for (i, sample) in samples.iter_mut().flatten().enumerate() {
            *sample = ((i * i * 37 + i * 11) % 256) as f32 - 128.0;
        }
        let transformed = transform(&samples);
        let scale = |n: usize| if n == 0 { 0.5f64.sqrt() } else { 1.0 };
        let cosine = |x: usize, u: usize| ((2 * x + 1) as f64 * u as f64 * std::f64::consts::PI / 16.0).cos();
        for (v, row) in transformed.iter().enumerate() {
            for (u, value) in row.iter().enumerate() {
                let mut sum = 0.0;
                for (y, row) in samples.iter().enumerate() {
                    sum +=
                        row.iter().enumerate().map(|(x, s)| f64::from(*s) * cosine(x, u) * cosine(y, v)).sum::<f64>();
                }
                let exact = sum * scale(u) * scale(v) / 4.0;
                assert!((exact - f64::from(*value)).abs() < 1e-3, "{u} {v}");
            }
        }
    }
}
