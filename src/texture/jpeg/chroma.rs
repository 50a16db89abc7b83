//! Chroma of less resolution than luma.
//!
//! Decoders make two texels of one sample as three quarters of it and a quarter of its neighbour on that side. The mean of two such texels
//! is not the sample: it is (1, 6, 1) / 8 of the samples. What is decoded and encoded again loses resolution each time, unless that is
//! undone. The inverse filter is sqrt(2) r^|n| with r = -(3 - 2 sqrt 2), as (1, 6, 1) / 8 has the root r.

/// Samples on either side that the inverse reads: r^4 is below a thousandth.
pub(super) const REACH: usize = 3;

/// The inverse filter, from its centre outwards; its sum over both sides is 1.
const INVERSE: [f32; REACH + 1] = inverse();

const fn inverse() -> [f32; REACH + 1] {
    let r = -0.171_572_875_253_809_9_f64;
    let mut taps = [1.0; REACH + 1];
    let mut sum = 1.0;
    let mut i = 1;
    while i <= REACH {
        taps[i] = taps[i - 1] * r;
        sum += 2.0 * taps[i];
        i += 1;
    }
    let mut scaled = [0.0; REACH + 1];
    let mut i = 0;
    while i <= REACH {
        scaled[i] = (taps[i] / sum) as f32;
        i += 1;
    }
    scaled
}

/// The sample at `i` of `count` ones, which are mirrored at the ends as decoders have it.
pub(super) fn mirrored(i: isize, count: usize) -> usize {
    let last = count as isize - 1;
    let i = if i < 0 { -1 - i } else { i };
    let i = if i > last { 2 * last + 1 - i } else { i };
    i.clamp(0, last) as usize
}

/// Turns means of two texels along a line into samples.
pub(super) fn undo_across(line: &mut [f32], scratch: &mut Vec<f32>) {
    scratch.clear();
    scratch.extend_from_slice(line);
    let count = line.len();
    for (i, out) in line.iter_mut().enumerate() {
        let mut sum = INVERSE[0] * scratch[i];
        for (n, tap) in INVERSE.iter().enumerate().skip(1) {
            let [before, after] = if i >= REACH && i + REACH < count {
                [i - n, i + n]
            } else {
                [i as isize - n as isize, i as isize + n as isize].map(|i| mirrored(i, count))
            };
            sum += tap * (scratch[before] + scratch[after]);
        }
        *out = sum;
    }
}

/// The same between lines: `line(n)` is the nth from the one that becomes `out`.
pub(super) fn undo_down<'a>(out: &mut [f32], line: impl Fn(isize) -> &'a [f32]) {
    out.iter_mut().zip(line(0)).for_each(|(out, value)| *out = INVERSE[0] * value);
    for (n, tap) in (1isize..).zip(&INVERSE[1..]) {
        for ((out, above), below) in out.iter_mut().zip(line(-n)).zip(line(n)) {
            *out += tap * (above + below);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_decoders_smooth_comes_back() {
        let samples: Vec<f32> = (0..40).map(|i| ((i * i * 31) % 97) as f32 - 48.0).collect();
        let at = |i: isize| samples[mirrored(i, samples.len())];
        let mut means: Vec<f32> = (0..samples.len() as isize)
            .map(|i| ((3.0 * at(i) + at(i - 1)) / 4.0 + (3.0 * at(i) + at(i + 1)) / 4.0) / 2.0)
            .collect();
        let lines: Vec<[f32; 1]> = means.iter().map(|v| [*v]).collect();
        undo_across(&mut means, &mut Vec::new());
        for (i, (mean, sample)) in means.iter().zip(&samples).enumerate() {
            assert!((mean - sample).abs() < 0.2, "{i}: {mean} is {sample}");
            let mut down = [0.0];
            undo_down(&mut down, |n| &lines[mirrored(i as isize + n, lines.len())]);
            assert!((down[0] - mean).abs() < 1e-4);
        }
    }
}
