//! Triangles of an OBJ file and the area of its charts, counted as its bytes pass.

use std::io::{BufRead, BufReader, Read};
use std::str::SplitAsciiWhitespace;

use super::sum::Sum;

/// Bytes of a line that is looked into.
const LONGEST_LINE: usize = 1 << 12;
/// Texture coordinates that are held.
const MOST_POINTS: usize = 2_000_000;

/// Adds the triangles, the vertices and the charts of an OBJ text to `sum`.
pub(super) fn add(file: impl Read, sum: &mut Sum) {
    let mut file = BufReader::with_capacity(1 << 16, file);
    let mut line = Line::default();
    let (mut triangles, mut vertices) = (0u64, 0u64);
    let mut layout = Layout { is_measured: true, ..Layout::default() };
    while let Ok(chunk) = file.fill_buf() {
        let length = chunk.len();
        // A line feed at the end for the one that is missing.
        for byte in if length == 0 { b"\n" } else { chunk } {
            match line.take(*byte) {
                Some((b'f', words)) => {
                    triangles += words.saturating_sub(2);
                    layout.face(line.text());
                }
                Some((b'v', _)) => vertices += 1,
                Some((b't', _)) => layout.point(line.text()),
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
    sum.has_layout |= layout.count > 0;
    sum.covered += layout.area;
    sum.is_unmeasured |= !layout.is_measured;
}

/// The charts so far.
#[derive(Default)]
struct Layout {
    /// Texture coordinates, those that are held.
    points: Vec<[f32; 2]>,
    /// All of them.
    count: usize,
    /// Of all faces, in sheets.
    area: f64,
    /// Whether every face so far could be read.
    is_measured: bool,
}

impl Layout {
    fn point(&mut self, line: Option<&str>) {
        self.count += 1;
        let read = |words: &mut SplitAsciiWhitespace<'_>| words.next()?.parse::<f32>().ok().filter(|n| n.is_finite());
        let point = line.map(str::split_ascii_whitespace).and_then(|mut words| {
            words.next()?;
            // A missing second coordinate is 0.
            Some([read(&mut words)?, read(&mut words).unwrap_or(0.0)])
        });
        match point.filter(|_| self.points.len() < MOST_POINTS) {
            Some(point) => self.points.push(point),
            None => self.is_measured = false,
        }
    }

    /// Adds a face, as the fan of triangles that it becomes.
    fn face(&mut self, line: Option<&str>) {
        if !self.is_measured {
            return;
        }
        let Some(line) = line else {
            self.is_measured = false;
            return;
        };
        let corners = line.split_ascii_whitespace().skip(1).map(|corner| {
            let index: i64 = corner.split('/').nth(1)?.parse().ok()?;
            let index = if index < 0 { self.points.len() as i64 + index } else { index - 1 };
            self.points.get(usize::try_from(index).ok()?).map(|p| p.map(f64::from))
        });
        // A face without coordinates covers nothing.
        let Some(corners) = corners.collect::<Option<Vec<_>>>() else { return };
        for pair in corners.windows(2).skip(1) {
            let ([x, y], a, b) = (corners[0], pair[0], pair[1]);
            self.area += ((a[0] - x) * (b[1] - y) - (b[0] - x) * (a[1] - y)).abs() / 2.0;
        }
    }
}

/// The line at hand.
#[derive(Default)]
struct Line {
    /// The first word, where it has one letter; `t` is that of `vt`.
    keyword: Option<u8>,
    /// Words so far, the first too.
    words: u64,
    /// The byte before.
    last: u8,
    /// Its beginning, one line for several that are continued.
    text: Vec<u8>,
    /// Whether it has ended: the next byte begins another.
    has_ended: bool,
}

impl Line {
    /// Takes a byte; at the end of a line its keyword and the number of words after it.
    fn take(&mut self, byte: u8) -> Option<(u8, u64)> {
        if std::mem::take(&mut self.has_ended) {
            (self.keyword, self.words, self.last) = (None, 0, 0);
            self.text.clear();
        }
        let first = matches!(self.last, 0 | b' ' | b'\t' | b'\r' | b'\n' | b'\\');
        let last = std::mem::replace(&mut self.last, byte);
        if self.text.len() <= LONGEST_LINE {
            self.text.push(if matches!(byte, b'\\' | b'\n' | b'\r') { b' ' } else { byte });
        }
        match byte {
            b'\n' | b'\r' if last == b'\\' => self.last = b'\\',
            b'\n' => {
                self.has_ended = true;
                return self.keyword.map(|k| (k, self.words.saturating_sub(1)));
            }
            b' ' | b'\t' | b'\r' | b'\\' => {}
            letter if first => {
                self.words += 1;
                if self.words == 1 {
                    self.keyword = Some(letter);
                }
            }
            letter if self.words == 1 => self.keyword = (self.keyword == Some(b'v') && letter == b't').then_some(b't'),
            _ => {}
        }
        None
    }

    /// The line that has ended; none where it is too long, or no text.
    fn text(&self) -> Option<&str> {
        std::str::from_utf8(&self.text).ok().filter(|text| text.len() <= LONGEST_LINE)
    }
}
