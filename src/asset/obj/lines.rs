//! The logical lines of an OBJ or MTL file.

/// Walks a text line by line: LF, CR or CRLF, `\` at a line's end continues it, comments and blanks are cut.
pub(crate) struct Lines<'a> {
    rest: &'a [u8],
    number: usize,
    joined: Vec<u8>,
}

impl<'a> Lines<'a> {
    /// From the beginning of `text`.
    pub(crate) fn new(text: &'a [u8]) -> Self {
        Lines { rest: text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(text), number: 0, joined: Vec::new() }
    }

    /// The next line that holds something, with the number (from 1) of its first line in the file.
    pub(crate) fn next_line(&mut self) -> Option<(usize, &[u8])> {
        loop {
            let line = self.physical()?;
            let number = self.number;
            if line.ends_with(b"\\") {
                self.join(line);
                if !self.joined.trim_ascii().is_empty() {
                    break Some((number, self.joined.trim_ascii()));
                }
                continue;
            }
            let line = without_comment(line);
            if !line.is_empty() {
                break Some((number, line));
            }
        }
    }

    fn join(&mut self, first: &[u8]) {
        self.joined.clear();
        let mut line = first;
        loop {
            let continued = line.strip_suffix(b"\\");
            self.joined.extend_from_slice(without_comment(continued.unwrap_or(line)));
            self.joined.push(b' ');
            if continued.is_none() {
                break;
            }
            match self.physical() {
                Some(next) => line = next,
                None => break,
            }
        }
    }

    fn physical(&mut self) -> Option<&'a [u8]> {
        if self.rest.is_empty() {
            return None;
        }
        self.number += 1;
        let end = self.rest.iter().position(|b| matches!(b, b'\n' | b'\r')).unwrap_or(self.rest.len());
        let (line, rest) = self.rest.split_at(end);
        self.rest = rest.strip_prefix(b"\r\n").or_else(|| rest.get(1..)).unwrap_or_default();
        Some(line.trim_ascii_end())
    }
}

/// A `#` opens a comment at the start of a line or after a blank: inside a word it belongs to a name.
fn without_comment(line: &[u8]) -> &[u8] {
    let line = line.trim_ascii();
    if !line.contains(&b'#') {
        return line;
    }
    if line.starts_with(b"#") {
        return &[];
    }
    let comment = line.windows(2).position(|w| matches!(w, [b' ' | b'\t', b'#']));
    comment.and_then(|at| line.get(..at)).unwrap_or(line).trim_ascii()
}

/// The words of a line.
pub(crate) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty())
}

/// A line's first word and what follows it.
pub(crate) fn keyword(line: &[u8]) -> (&[u8], &[u8]) {
    let end = line.iter().position(u8::is_ascii_whitespace).unwrap_or(line.len());
    let (word, rest) = line.split_at(end);
    (word, rest.trim_ascii())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ending_and_continuation() {
        let text = b"\xEF\xBB\xBFa 1\r\nb \\\r\n 2\\\n3 # x\n\n# c\rd#e f\n\\\n";
        let mut lines = Lines::new(text);
        let mut found = Vec::new();
        while let Some((number, line)) = lines.next_line() {
            found.push((number, String::from_utf8(line.to_vec()).unwrap()));
        }
        let expected = [(1, "a 1"), (2, "b 2 3"), (7, "d#e f")].map(|(n, s)| (n, s.to_owned()));
        assert_eq!(found, expected);
    }
}
