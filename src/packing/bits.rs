//! Lines of cells as bits: bit `x % 64` of word `x / 64` is cell x.

/// Sets or clears bits of a word.
#[inline]
fn put(word: &mut u64, bits: u64, value: bool) {
    if value {
        *word |= bits;
    } else {
        *word &= !bits;
    }
}

/// Sets or clears the bits `first..=last` of a line.
#[inline]
pub(super) fn set_run(line: &mut [u64], first: usize, last: usize, value: bool) {
    let (i, j) = (first / 64, last / 64);
    let low = !0u64 << (first % 64);
    let high = !0u64 >> (63 - last % 64);
    if i == j {
        put(&mut line[i], low & high, value);
    } else {
        put(&mut line[i], low, value);
        line[i + 1..j].fill(if value { !0 } else { 0 });
        put(&mut line[j], high, value);
    }
}

/// Takes or frees the cells of a line of a mask, moved by `x` cells.
#[inline]
pub(super) fn shift_onto(line: &mut [u64], mask: &[u64], x: usize, taken: bool) {
    let (offset, shift) = (x / 64, x % 64);
    for (i, &word) in mask.iter().enumerate().filter(|(_, word)| **word != 0) {
        put(&mut line[offset + i], word << shift, taken);
        let high = if shift == 0 { 0 } else { word >> (64 - shift) };
        if high != 0 {
            put(&mut line[offset + i + 1], high, taken);
        }
    }
}

/// Word `i` of the line, shifted towards cell 0; zeros beyond the end.
#[inline]
pub(super) fn shifted(line: &[u64], i: usize, by: usize) -> u64 {
    let (i, by) = (i + by / 64, by % 64);
    let low = line.get(i).copied().unwrap_or(0);
    if by == 0 {
        return low;
    }
    low >> by | line.get(i + 1).copied().unwrap_or(0) << (64 - by)
}

/// The first bit of `value` at or after `from`.
#[inline]
pub(super) fn next_bit(line: &[u64], from: usize, value: bool) -> Option<usize> {
    let mut i = from / 64;
    let flip = if value { 0 } else { !0 };
    let mut word = (*line.get(i)? ^ flip) & (!0u64 << (from % 64));
    loop {
        if word != 0 {
            return Some(i * 64 + word.trailing_zeros() as usize);
        }
        i += 1;
        word = *line.get(i)? ^ flip;
    }
}

/// The longest run of zeros among the first `width` bits.
#[inline]
pub(super) fn longest_free(line: &[u64], width: usize) -> u32 {
    let mut longest = 0;
    let mut current = 0;
    for (i, &word) in line.iter().enumerate().take(width.div_ceil(64)) {
        let bits = (width - i * 64).min(64) as u32;
        if word == 0 {
            current += bits;
            continue;
        }
        longest = longest.max(current + word.trailing_zeros().min(bits));
        if word.count_zeros() > longest {
            let mut free = !word;
            let mut inner = 0;
            while free != 0 {
                free &= free << 1;
                inner += 1;
            }
            longest = longest.max(inner.min(bits));
        }
        current = word.leading_zeros().saturating_sub(64 - bits);
    }
    longest.max(current)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packing::random::Random;

    #[test]
    fn the_longest_free_run_is_never_understated() {
        let mut random = Random::new(8);
        for _ in 0..300 {
            let width = 1 + random.below(200);
            let line: Vec<u64> = (0..width.div_ceil(64) + 2)
                .map(|_| random.next() & random.next() & random.next() & random.next())
                .collect();
            let (mut longest, mut run) = (0, 0);
            for x in 0..width {
                run = if line[x / 64] >> (x % 64) & 1 == 0 { run + 1 } else { 0 };
                longest = longest.max(run);
            }
            let found = longest_free(&line, width);
            assert!(found >= longest && found <= width as u32, "{found} for {longest}");
        }
    }
}
