//! Triangles of an OBJ file, counted as its bytes pass.

use std::io::{BufRead, BufReader, Read};

use super::sum::Sum;

/// Adds the triangles and the vertices of an OBJ text to `sum`.
pub(super) fn add(file: impl Read, sum: &mut Sum) {
    let mut file = BufReader::with_capacity(1 << 16, file);
    let mut line = Line::default();
    let (mut triangles, mut vertices) = (0u64, 0u64);
    while let Ok(chunk) = file.fill_buf() {
        let length = chunk.len();
        // A line feed at the end for the one that is missing.
        for byte in if length == 0 { b"\n" } else { chunk } {
            match line.take(*byte) {
                Some((b'f', words)) => triangles += words.saturating_sub(2),
                Some((b'v', _)) => vertices += 1,
                _ => {}
            }
        }
        if length == 0 {
            break;
        }
        file.consume(length);
    }
    sum.triangles += triangles;
    sum.vertices += vertices;
}

/// The line at hand.
#[derive(Default)]
struct Line {
    /// The first word, where it has one letter.
    keyword: Option<u8>,
    /// Words so far, the first too.
    words: u64,
    /// The byte before.
    last: u8,
}

impl Line {
    /// Takes a byte; at the end of a line its keyword and the number of words after it.
    fn take(&mut self, byte: u8) -> Option<(u8, u64)> {
        let first = matches!(self.last, 0 | b' ' | b'\t' | b'\r' | b'\n' | b'\\');
        let last = std::mem::replace(&mut self.last, byte);
        match byte {
            b'\n' | b'\r' if last == b'\\' => self.last = b'\\',
            b'\n' => {
                let line = std::mem::take(self);
                return line.keyword.map(|k| (k, line.words.saturating_sub(1)));
            }
            b' ' | b'\t' | b'\r' | b'\\' => {}
            letter if first => {
                self.words += 1;
                if self.words == 1 {
                    self.keyword = Some(letter);
                }
            }
            _ if self.words == 1 => self.keyword = None,
            _ => {}
        }
        None
    }
}
