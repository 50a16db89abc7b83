//! BasisLZ's bit streams and Huffman codes (KTX 2.0, appendix "BasisLZ Bitstream Specification").

/// Bits that a word may have, and those of a word of the code that writes lengths.
const LONGEST: u8 = 16;
const LONGEST_OF_LENGTHS: u8 = 7;
/// Symbols of the code that writes lengths: these, then runs of zeros and of the length before.
const LENGTH_SYMBOLS: usize = 21;
const SHORT_ZEROS: usize = 17;
const LONG_ZEROS: usize = 18;
const SHORT_REPEAT: usize = 19;
const LONG_REPEAT: usize = 20;
/// In which order the lengths of its own words are written.
const LENGTH_ORDER: [usize; LENGTH_SYMBOLS] =
    [17, 18, 19, 20, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15, 16];

/// Bits, from the lowest of each byte to the highest.
#[derive(Debug, Default)]
pub(super) struct BitWriter {
    bytes: Vec<u8>,
    buffer: u64,
    filled: u32,
}

impl BitWriter {
    /// Appends the lowest `count` bits of `value`, at most 32.
    pub(super) fn put(&mut self, value: u32, count: u32) {
        self.buffer |= u64::from(value) << self.filled;
        self.filled += count;
        while self.filled >= 8 {
            self.bytes.push(self.buffer as u8);
            self.buffer >>= 8;
            self.filled -= 8;
        }
    }

    /// Appends a number in groups of `chunk` bits, the lowest first, each followed by whether another follows.
    pub(super) fn put_chunks(&mut self, mut value: u32, chunk: u32) {
        loop {
            let (low, rest) = (value & ((1 << chunk) - 1), value >> chunk);
            self.put(low | u32::from(rest > 0) << chunk, chunk + 1);
            if rest == 0 {
                return;
            }
            value = rest;
        }
    }

    /// Appends the word of a symbol.
    pub(super) fn put_symbol(&mut self, code: &Code, symbol: u32) {
        let (word, bits) = code.words.get(symbol as usize).copied().unwrap_or((0, 0));
        debug_assert!(bits > 0, "symbol {symbol} was not counted");
        self.put(word, u32::from(bits));
    }

    /// Appends the lengths of a code's words, by which a reader knows it.
    pub(super) fn put_code(&mut self, code: &Code) {
        let used = code.words.iter().rposition(|(_, bits)| *bits > 0).map_or(0, |last| last + 1);
        let lengths: Vec<u8> = code.words[..used].iter().map(|(_, bits)| *bits).collect();
        let runs = runs(&lengths);
        let mut counts = vec![0u32; LENGTH_SYMBOLS];
        for (symbol, ..) in &runs {
            counts[*symbol] += 1;
        }
        let of_lengths = Code::limited(&counts, LONGEST_OF_LENGTHS);
        self.put(used as u32, 14);
        let bits = |symbol: usize| u32::from(of_lengths.words[symbol].1);
        let written = LENGTH_ORDER.iter().rposition(|symbol| bits(*symbol) > 0).map_or(1, |last| last + 1);
        self.put(written as u32, 5);
        for symbol in &LENGTH_ORDER[..written] {
            self.put(bits(*symbol), 3);
        }
        for (symbol, extra, width) in runs {
            self.put_symbol(&of_lengths, symbol as u32);
            self.put(extra, width);
        }
    }

    /// All that was written, filled up to whole bytes.
    pub(super) fn finish(mut self) -> Vec<u8> {
        if self.filled > 0 {
            self.bytes.push(self.buffer as u8);
        }
        self.bytes
    }
}

/// Lengths as symbols with their extra bits: value and width.
fn runs(lengths: &[u8]) -> Vec<(usize, u32, u32)> {
    let mut out = Vec::new();
    let mut at = 0;
    while at < lengths.len() {
        let length = lengths[at];
        let mut run = lengths[at..].iter().take_while(|l| **l == length).count();
        at += run;
        if length > 0 {
            out.push((usize::from(length), 0, 0));
            run -= 1;
        }
        while run > 0 {
            let (symbol, least, width) = match (length == 0, run) {
                (true, 11..) => (LONG_ZEROS, 11, 7),
                (true, 3..) => (SHORT_ZEROS, 3, 3),
                (false, 7..) => (LONG_REPEAT, 7, 7),
                (false, 3..) => (SHORT_REPEAT, 3, 2),
                _ => (usize::from(length), 1, 0),
            };
            let taken = run.min(least + (1 << width) - 1);
            out.push((symbol, (taken - least) as u32, width as u32));
            run -= taken;
        }
    }
    out
}

/// A canonical Huffman code.
#[derive(Debug)]
pub(super) struct Code {
    /// By symbol: its word, the first bit lowest, and the bits of that; 0 bits for one that has none.
    words: Vec<(u32, u8)>,
}

impl Code {
    /// The code that writes so many of each symbol. One symbol has a word even where none is counted: readers ask for that.
    pub(super) fn new(counts: &[u32]) -> Self {
        Code::limited(counts, LONGEST)
    }

    fn limited(counts: &[u32], longest: u8) -> Self {
        let lengths = lengths(counts, longest);
        let mut next = [0u32; 33];
        for length in 1..32usize {
            let shorter = lengths.iter().filter(|l| usize::from(**l) == length).count() as u32;
            next[length + 1] = (next[length] + shorter) << 1;
        }
        let word = |length: &u8| {
            let bits = u32::from(*length);
            if bits == 0 {
                return (0, 0);
            }
            let word = next[bits as usize];
            next[bits as usize] += 1;
            (word.reverse_bits() >> (32 - bits), *length)
        };
        Code { words: lengths.iter().map(word).collect() }
    }
}

/// Lengths of words by symbol, none longer than `longest`.
fn lengths(counts: &[u32], longest: u8) -> Vec<u8> {
    let mut lengths = vec![0u8; counts.len().max(1)];
    let mut used: Vec<(u64, usize)> =
        counts.iter().enumerate().filter(|(_, n)| **n > 0).map(|(s, n)| (u64::from(*n), s)).collect();
    if used.len() < 2 {
        lengths[used.first().map_or(0, |(_, symbol)| *symbol)] = 1;
        return lengths;
    }
    used.sort_unstable();
    // Leaves and inner nodes, both from the rarest on: the two rarest become one.
    let leaves = used.len();
    let mut weights: Vec<u64> = used.iter().map(|(n, _)| *n).collect();
    let mut parent = vec![0usize; 2 * leaves - 1];
    let (mut leaf, mut inner) = (0, leaves);
    for node in leaves..2 * leaves - 1 {
        let mut weight = 0;
        for _ in 0..2 {
            let takes_leaf = leaf < leaves && (inner >= node || weights[leaf] <= weights[inner]);
            let taken = if takes_leaf { &mut leaf } else { &mut inner };
            parent[*taken] = node;
            weight += weights[*taken];
            *taken += 1;
        }
        weights.push(weight);
    }
    let mut depth = vec![0u32; 2 * leaves - 1];
    for node in (0..2 * leaves - 2).rev() {
        depth[node] = depth[parent[node]] + 1;
    }
    let mut of_length = vec![0u64; usize::from(longest) + 1];
    for depth in &depth[..leaves] {
        of_length[(*depth as usize).min(usize::from(longest))] += 1;
    }
    // Words that were cut short took more than there is: a longest one goes under a shorter one, until it fits.
    let taken = |of_length: &[u64]| -> u64 {
        of_length.iter().enumerate().skip(1).map(|(l, n)| n << (usize::from(longest) - l)).sum()
    };
    while taken(&of_length) > 1 << longest {
        let Some(short) = (1..usize::from(longest)).rev().find(|l| of_length[*l] > 0) else { break };
        of_length[short] -= 1;
        of_length[short + 1] += 2;
        of_length[usize::from(longest)] -= 1;
    }
    // The rarest have the longest.
    let mut symbols = used.iter().map(|(_, symbol)| *symbol);
    for (length, count) in of_length.iter().enumerate().rev() {
        for symbol in symbols.by_ref().take(*count as usize) {
            lengths[symbol] = length as u8;
        }
    }
    lengths
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_prefix_free_and_no_longer_than_they_may_be() {
        let (mut a, mut b) = (1u32, 1u32);
        let fibonacci = std::iter::from_fn(|| {
            let now = a;
            (a, b) = (b, a.saturating_add(b));
            Some(now)
        });
        let skewed: Vec<u32> = fibonacci.take(44).collect();
        let mixed: Vec<u32> = (0..5000u32).map(|i| i.wrapping_mul(2_654_435_761) >> 22).collect();
        for (counts, longest) in [(&skewed, 16), (&skewed, 7), (&mixed, 16), (&vec![0, 0, 9], 7), (&vec![], 16)] {
            let lengths = lengths(counts, longest);
            let kraft: f64 = lengths.iter().filter(|l| **l > 0).map(|l| 0.5f64.powi(i32::from(*l))).sum();
            let used = counts.iter().filter(|n| **n > 0).count();
            assert!(lengths.iter().all(|l| *l <= longest));
            assert!(if used < 2 { kraft == 0.5 } else { (kraft - 1.0).abs() < 1e-12 }, "{kraft}");
            assert!(counts.iter().zip(&lengths).all(|(n, l)| (*n > 0) == (*l > 0) || used == 0));
        }
        let average = |counts: &[u32]| {
            let (lengths, all): (Vec<u8>, f64) = (lengths(counts, 16), counts.iter().map(|n| f64::from(*n)).sum());
            let bits: f64 = counts.iter().zip(&lengths).map(|(n, l)| f64::from(*n) * f64::from(*l)).sum();
            let entropy: f64 =
                counts.iter().filter(|n| **n > 0).map(|n| -f64::from(*n) * (f64::from(*n) / all).log2()).sum();
            (bits / all, entropy / all)
        };
        let (bits, entropy) = average(&mixed);
        assert!(bits < entropy + 0.1, "{bits} {entropy}");
    }
}
