//! KTX2 files (Khronos Texture Container 2.0) with blocks of Basis Universal.

/// First bytes of every file.
const IDENTIFIER: [u8; 12] = [0xab, b'K', b'T', b'X', b' ', b'2', b'0', 0xbb, 0x0d, 0x0a, 0x1a, 0x0a];
/// Bytes before the index of levels, and of one entry of it.
const INDEX: usize = 80;
const ENTRY: usize = 24;
/// What the file says of itself: values by name, in the order of the names.
const VALUES: [(&str, &str); 2] =
    [("KTXorientation", "rd"), ("KTXwriter", concat!("Intarsia ", env!("CARGO_PKG_VERSION")))];

/// How levels are compressed once more, by the number that the header has of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Supercompression {
    BasisLz = 1,
    Zstandard = 2,
}

/// Which channels a sample of the descriptor has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sample {
    /// Number of the channel in its colour model.
    pub(super) channel: u8,
    /// Bits before it, and its own.
    pub(super) bits: [u16; 2],
}

/// A file to be written.
#[derive(Debug)]
pub(super) struct File {
    /// Of the first level.
    pub(super) size: [u32; 2],
    pub(super) srgb: bool,
    pub(super) content: Content,
}

/// Blocks of one kind.
#[derive(Debug)]
pub(super) struct Content {
    /// Colour model of the Khronos Data Format.
    pub(super) model: u8,
    pub(super) samples: Vec<Sample>,
    pub(super) supercompression: Supercompression,
    /// Supercompression global data.
    pub(super) global: Vec<u8>,
    /// From the largest: a level's bytes, and their number before the supercompression, 0 for BasisLZ.
    pub(super) levels: Vec<(Vec<u8>, u64)>,
}

impl File {
    /// The file's bytes.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let descriptor = self.descriptor();
        let mut values = Vec::new();
        for (name, value) in VALUES {
            let entry = [name.as_bytes(), b"\0", value.as_bytes(), b"\0"].concat();
            values.extend((entry.len() as u32).to_le_bytes());
            values.extend(entry);
            values.resize(values.len().next_multiple_of(4), 0);
        }
        let start = INDEX + ENTRY * self.content.levels.len();
        let after_values = start + descriptor.len() + values.len();
        let global = if self.content.global.is_empty() { 0 } else { after_values.next_multiple_of(8) };
        let mut at = if self.content.global.is_empty() { after_values } else { global + self.content.global.len() };
        // The smallest level comes first.
        let mut offsets = vec![0; self.content.levels.len()];
        for (offset, (level, _)) in offsets.iter_mut().zip(&self.content.levels).rev() {
            *offset = at;
            at += level.len();
        }
        let mut out = IDENTIFIER.to_vec();
        let words = [
            0,
            1,
            self.size[0],
            self.size[1],
            0,
            0,
            1,
            self.content.levels.len() as u32,
            self.content.supercompression as u32,
            start as u32,
            descriptor.len() as u32,
            (start + descriptor.len()) as u32,
            values.len() as u32,
        ];
        out.extend(words.into_iter().flat_map(u32::to_le_bytes));
        let longs = |longs: &[u64]| longs.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<u8>>();
        out.extend(longs(&[global as u64, self.content.global.len() as u64]));
        for (offset, (level, inflated)) in offsets.iter().zip(&self.content.levels) {
            out.extend(longs(&[*offset as u64, level.len() as u64, *inflated]));
        }
        out.extend(descriptor);
        out.extend(values);
        if global > 0 {
            out.resize(global, 0);
            out.extend(&self.content.global);
        }
        self.content.levels.iter().rev().for_each(|(level, _)| out.extend(level));
        out
    }

    /// The data format descriptor: one basic block.
    fn descriptor(&self) -> Vec<u8> {
        let block = 24 + 16 * self.content.samples.len() as u32;
        let words = [
            block + 4,
            0,
            2 | block << 16,
            // BT.709 primaries; alpha is not premultiplied.
            u32::from(self.content.model) | 1 << 8 | if self.srgb { 2 } else { 1 } << 16,
            3 | 3 << 8,
            // Bytes of a plane are not told where the file is compressed.
            0,
            0,
        ];
        let mut out: Vec<u8> = words.into_iter().flat_map(u32::to_le_bytes).collect();
        for Sample { channel, bits: [offset, length] } in &self.content.samples {
            let first = u32::from(*offset) | u32::from(length - 1) << 16 | u32::from(*channel) << 24;
            out.extend([first, 0, 0, u32::MAX].into_iter().flat_map(u32::to_le_bytes));
        }
        out
    }
}
