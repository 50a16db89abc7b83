//! Files of formats for which there is no encoder here: small ones, bit by bit.

/// Bits from the lowest of the first byte on.
#[derive(Default)]
pub(crate) struct Bits {
    bytes: Vec<u8>,
    count: usize,
}

impl Bits {
    /// Appends the lowest `count` bits of `value`; there are zeros above it.
    pub(crate) fn put(&mut self, value: u32, count: usize) {
        for k in 0..count {
            if self.count.is_multiple_of(8) {
                self.bytes.push(0);
            }
            if let Some(last) = self.bytes.last_mut() {
                *last |= ((value.checked_shr(k as u32).unwrap_or(0) & 1) as u8) << (self.count % 8);
            }
            self.count += 1;
        }
    }

    /// A symbol of a code in which all `2^length` symbols have the same length: the highest bit comes first.
    fn symbol(&mut self, symbol: u32, length: usize) {
        (0..length).rev().for_each(|k| self.put(symbol >> k, 1));
    }

    /// The table of such a code (KTX 2.0, 5.3.2): its size, the code of code lengths with one symbol, and that symbol once a symbol.
    fn table(&mut self, length: usize) {
        const ORDER: [usize; 21] = [17, 18, 19, 20, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15, 16];
        let place = ORDER.iter().position(|l| *l == length).unwrap();
        self.put(1 << length, 14);
        self.put(place as u32 + 1, 5);
        (0..=place).for_each(|k| self.put(u32::from(k == place), 3));
        self.put(0, 1 << length);
    }
}

/// What a KTX2 file says and holds.
pub(crate) struct Ktx2<'a> {
    pub(crate) vulkan: u32,
    pub(crate) size: [u32; 2],
    /// Supercompression scheme.
    pub(crate) scheme: u32,
    /// Colour model of the descriptor, and the channel of each sample.
    pub(crate) model: u32,
    pub(crate) channels: &'a [u32],
    /// Bytes of the level when inflated, if that is to be told.
    pub(crate) inflated: u64,
    pub(crate) global: &'a [u8],
    pub(crate) level: &'a [u8],
}

/// A file of one level (KTX 2.0, 3).
pub(crate) fn ktx2(of: &Ktx2<'_>) -> Vec<u8> {
    let descriptor = 28 + 16 * of.channels.len();
    let at = [104, 104 + descriptor, 104 + descriptor + of.global.len()];
    let mut file = super::ktx2::IDENTIFIER.to_vec();
    let mut words = |all: &[u32]| all.iter().for_each(|w| file.extend(w.to_le_bytes()));
    words(&[of.vulkan, 1, of.size[0], of.size[1], 0, 0, 1, 1, of.scheme]);
    words(&[at[0] as u32, descriptor as u32, 0, 0]);
    let global = if of.global.is_empty() { 0 } else { at[1] as u32 };
    words(&[global, 0, of.global.len() as u32, 0]);
    words(&[at[2] as u32, 0, of.level.len() as u32, 0, of.inflated as u32, (of.inflated >> 32) as u32]);
    // Version 2; BT.709, linear; blocks of 4 x 4 texels.
    words(&[descriptor as u32, 0, 2 | (descriptor as u32 - 4) << 16, of.model | 1 << 8 | 1 << 16, 0x0303, 0, 0]);
    of.channels.iter().for_each(|channel| words(&[channel << 24, 0, 0, u32::MAX]));
    file.extend(of.global);
    file.extend(of.level);
    file
}

/// A UASTC block of one colour (mode 8).
pub(crate) fn solid_block(rgba: [u8; 4]) -> [u8; 16] {
    let mut bits = Bits::default();
    bits.put(0b10111, 5);
    rgba.iter().for_each(|v| bits.put(u32::from(*v), 8));
    bits.put(0, 128 - 37);
    bits.bytes.try_into().unwrap()
}

/// A Zstandard frame that holds its data as they are (RFC 8878, 3.1.1).
pub(crate) fn zstd(data: &[u8]) -> Vec<u8> {
    // One segment; its size in four bytes.
    let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0xa0];
    frame.extend((data.len() as u32).to_le_bytes());
    let header = (data.len() as u32) << 3 | 1;
    frame.extend(&header.to_le_bytes()[..3]);
    frame.extend(data);
    frame
}

/// Two end points of ETC1S: five bits a channel, and the table of intensities.
pub(crate) type EndPoint = ([u32; 3], u32);

/// An ETC1S file with eight end points and four selectors, `blocks` (end point, selector) by slice: the second slice is alpha.
pub(crate) fn etc1s(
    size: [u32; 2],
    ends: &[EndPoint; 8],
    selectors: &[[u8; 16]; 4],
    slices: &[&[(u32, u32)]],
) -> Vec<u8> {
    let mut codebook = Bits::default();
    (0..3).for_each(|_| codebook.table(5));
    codebook.table(3);
    codebook.put(0, 1);
    let (mut last, mut intensity) = ([16; 3], 0);
    for (colour, table) in ends {
        codebook.symbol(table.wrapping_sub(intensity) & 7, 3);
        intensity = *table;
        for (last, c) in last.iter_mut().zip(colour) {
            codebook.symbol(c.wrapping_sub(*last) & 31, 5);
            *last = *c;
        }
    }
    let mut patterns = Bits::default();
    patterns.put(0b100, 3);
    selectors.iter().flatten().for_each(|s| patterns.put(u32::from(*s), 2));
    let mut tables = Bits::default();
    tables.table(8);
    tables.table(3);
    tables.table(2);
    tables.table(1);
    tables.put(1, 13);

    let mut level = Vec::new();
    let mut places = Vec::new();
    for blocks in slices {
        let mut bits = Bits::default();
        let across = size[0].div_ceil(4) as usize;
        let mut last = 0;
        for (i, (end, selector)) in blocks.iter().enumerate() {
            // Once in four blocks: none of them is predicted.
            if (i % across).is_multiple_of(2) && (i / across).is_multiple_of(2) {
                bits.symbol(255, 8);
            }
            bits.symbol(end.wrapping_sub(last) & 7, 3);
            last = *end;
            bits.symbol(*selector, 2);
        }
        places.extend([level.len() as u32, bits.bytes.len() as u32]);
        level.extend(bits.bytes);
    }
    places.resize(4, 0);

    let mut global = vec![8, 0, 4, 0];
    let lengths = [codebook.bytes.len(), patterns.bytes.len(), tables.bytes.len(), 0].map(|n| n as u32);
    let words = lengths.into_iter().chain([0]).chain(places);
    words.for_each(|w| global.extend(w.to_le_bytes()));
    global.extend([codebook.bytes, patterns.bytes, tables.bytes].concat());
    let channels = &[0, 15][..slices.len()];
    ktx2(&Ktx2 { vulkan: 0, size, scheme: 1, model: 163, channels, inflated: 0, global: &global, level: &level })
}

/// A lossy WebP still of `size` texels, at most 16 x 16, with nothing but predictions (RFC 6386): grey. `alpha`, if any, is stored as it is
/// in an extended file.
pub(crate) fn grey_webp(size: [u16; 2], alpha: Option<&[u8]>) -> Vec<u8> {
    // A key frame, version 0, shown; one partition of zeros, which say: no segments, no filter, one partition of coefficients,
    // quantiser 0, probabilities as they are, modes of the first symbol.
    let first = [0u8; 64];
    let tag = 1 << 4 | (first.len() as u32) << 5;
    let mut frame = tag.to_le_bytes()[..3].to_vec();
    frame.extend([0x9d, 0x01, 0x2a]);
    frame.extend(size.iter().flat_map(|s| s.to_le_bytes()));
    frame.extend(first);
    frame.extend([0; 64]);
    let mut chunks: Vec<(&[u8; 4], Vec<u8>)> = Vec::new();
    if let Some(alpha) = alpha {
        let side = |s: u16| (u32::from(s) - 1).to_le_bytes()[..3].to_vec();
        chunks.push((b"VP8X", [vec![0x10, 0, 0, 0], side(size[0]), side(size[1])].concat()));
        chunks.push((b"ALPH", [&[0][..], alpha].concat()));
    }
    chunks.push((b"VP8 ", frame));
    riff(&chunks)
}

/// A WebP file of chunks.
pub(crate) fn riff(chunks: &[(&[u8; 4], Vec<u8>)]) -> Vec<u8> {
    let mut body = b"WEBP".to_vec();
    for (name, data) in chunks {
        body.extend(*name);
        body.extend((data.len() as u32).to_le_bytes());
        body.extend(data);
        body.resize(body.len().next_multiple_of(2), 0);
    }
    [b"RIFF", &(body.len() as u32).to_le_bytes()[..], &body].concat()
}
