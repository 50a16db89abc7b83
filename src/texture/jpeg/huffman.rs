//! Huffman codes of at most 16 bits, as short as the counts of their symbols allow (ITU T.81, annexes C and K.2).

/// Counts of symbols.
pub(super) type Counts = [u64; 256];

/// A code.
#[derive(Debug, Clone)]
pub(super) struct Code {
    /// Symbols by length of their words, 1 to 16 bits.
    pub(super) lengths: [u8; 16],
    /// Symbols from the shortest word to the longest.
    pub(super) symbols: Vec<u8>,
    /// By symbol: its word and the bits of that; 0 bits for one that has none.
    pub(super) words: [(u16, u8); 256],
}

/// Lengths that words may have before they are shortened.
const LONGEST: usize = 64;

impl Code {
    /// The code that writes so many of each symbol in the fewest bits, without the word of ones only. Has a word where all counts are 0.
    pub(super) fn new(counts: &Counts) -> Self {
        let mut lengths = [0u32; LONGEST + 1];
        let sizes = sizes(counts);
        for size in sizes.iter().filter(|size| **size > 0) {
            lengths[*size as usize] += 1;
        }
        shorten(&mut lengths);
        // Symbol 256 held the word of ones: one of the longest.
        if let Some(last) = lengths.iter_mut().rev().find(|n| **n > 0) {
            *last -= 1;
        }
        let mut order: Vec<u8> = (0..=255u8).filter(|s| sizes[usize::from(*s)] > 0).collect();
        order.sort_by_key(|s| (sizes[usize::from(*s)], *s));
        let mut code = Code { lengths: [0; 16], symbols: order, words: [(0, 0); 256] };
        let (mut word, mut next) = (0u16, 0);
        for (i, bits) in (1..=16u8).enumerate() {
            code.lengths[i] = lengths[usize::from(bits)] as u8;
            for _ in 0..code.lengths[i] {
                code.words[usize::from(code.symbols[next])] = (word, bits);
                word += 1;
                next += 1;
            }
            word <<= 1;
        }
        code
    }
}

/// Lengths of words by symbol, with one more symbol that occurs once (figure K.1); at most [`LONGEST`].
fn sizes(counts: &Counts) -> [u32; 257] {
    let mut weights = [0u64; 257];
    weights[..256].copy_from_slice(counts);
    if counts.iter().all(|n| *n == 0) {
        weights[0] = 1;
    }
    weights[256] = 1;
    let mut sizes = [0u32; 257];
    let mut chain: [Option<usize>; 257] = [None; 257];
    loop {
        // The least weight, then the next; of equals the last.
        let (mut first, mut second): (Option<usize>, Option<usize>) = (None, None);
        for (i, weight) in weights.iter().enumerate().filter(|(_, w)| **w > 0) {
            if first.is_none_or(|f| *weight <= weights[f]) {
                (first, second) = (Some(i), first);
            } else if second.is_none_or(|s| *weight <= weights[s]) {
                second = Some(i);
            }
        }
        let (Some(first), Some(second)) = (first, second) else { return sizes };
        weights[first] += weights[second];
        weights[second] = 0;
        // All symbols of both trees become one longer; then they are one tree.
        let mut at = first;
        loop {
            sizes[at] += 1;
            match chain[at] {
                Some(next) => at = next,
                None => break,
            }
        }
        chain[at] = Some(second);
        let mut next = Some(second);
        while let Some(at) = next {
            sizes[at] += 1;
            next = chain[at];
        }
    }
}

/// Makes words longer than 16 bits shorter, and others longer for it (figure K.3).
fn shorten(lengths: &mut [u32; LONGEST + 1]) {
    for long in (17..=LONGEST).rev() {
        while lengths[long] > 0 {
            let Some(short) = (1..long - 1).rev().find(|n| lengths[*n] > 0) else { return };
            lengths[long] -= 2;
            lengths[long - 1] += 1;
            lengths[short + 1] += 2;
            lengths[short] -= 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kraft(code: &Code) -> u64 {
        code.lengths.iter().enumerate().map(|(i, n)| u64::from(*n) << (15 - i)).sum()
    }

    #[test]
    fn words_are_prefix_free_short_and_never_all_ones() {
        let mut skewed = [0u64; 256];
        // Fibonacci numbers make the deepest trees.
        let (mut a, mut b) = (1u64, 1u64);
        for count in skewed.iter_mut().take(40) {
            *count = a;
            (a, b) = (b, a + b);
        }
        let mut even = [1u64; 256];
        even[7] = 1_000_000;
        let mut one = [0u64; 256];
        one[9] = 5;
        for counts in [skewed, even, one, [0; 256]] {
            let code = Code::new(&counts);
            assert!(kraft(&code) < 1 << 16, "the word of ones is free");
            for (symbol, count) in counts.iter().enumerate() {
                let (word, bits) = code.words[symbol];
                assert_eq!(bits > 0, *count > 0 || (symbol == 0 && counts == [0; 256]));
                assert!(bits == 0 || u32::from(word) < (1 << bits) - 1);
            }
            for a in 0..256 {
                for b in (0..256).filter(|b| *b != a) {
                    let ((wa, na), (wb, nb)) = (code.words[a], code.words[b]);
                    assert!(na == 0 || nb < na || wb >> (nb - na) != wa, "{a} begins {b}");
                }
            }
        }
        assert_eq!(Code::new(&even).words[7].1, 1);
    }
}
