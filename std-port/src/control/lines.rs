//! Lines of a bounded length.

use std::io::{BufRead, BufReader, Read, Result};

use super::protocol::LONGEST_LINE;

/// A buffer that has held a long line is given back.
const KEPT: usize = 64 * 1024;

/// Reads line by line, and buffers at most the longest allowed line.
pub(super) struct Lines<R> {
    reader: BufReader<R>,
    line: Vec<u8>,
}

/// What stands between two ends of lines.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Line<'a> {
    Text(&'a [u8]),
    /// It was longer than [`LONGEST_LINE`], and has been passed over.
    TooLong,
}

impl<R: Read> Lines<R> {
    pub(super) fn new(reader: R) -> Self {
        Self { reader: BufReader::new(reader), line: Vec::new() }
    }

    /// What the lines are read from.
    pub(super) fn source(&self) -> &R {
        self.reader.get_ref()
    }

    pub(super) fn source_mut(&mut self) -> &mut R {
        self.reader.get_mut()
    }

    /// Whether something has been read that is in no line yet.
    pub(super) fn has_more(&self) -> bool {
        !self.reader.buffer().is_empty()
    }

    /// Skips empty lines; whether there were any. Blocks without input.
    pub(super) fn skip_empty(&mut self) -> Result<bool> {
        let empty = self.reader.fill_buf()?.iter().take_while(|&&byte| byte == b'\n').count();
        self.reader.consume(empty);
        Ok(empty > 0)
    }

    /// The next line; `None` at the end. Text without a line end is no line.
    pub(super) fn next(&mut self) -> Result<Option<Line<'_>>> {
        self.line.clear();
        if self.line.capacity() > KEPT {
            self.line.shrink_to(0);
        }
        let mut too_long = false;
        loop {
            let read = self.reader.fill_buf()?;
            if read.is_empty() {
                return Ok(None);
            }
            let end = read.iter().position(|&byte| byte == b'\n');
            let piece = &read[..end.unwrap_or(read.len())];
            too_long |= self.line.len() + piece.len() > LONGEST_LINE;
            if too_long {
                self.line = Vec::new();
            } else {
                self.line.extend_from_slice(piece);
            }
            let used = piece.len() + usize::from(end.is_some());
            self.reader.consume(used);
            if end.is_some() {
                return Ok(Some(if too_long { Line::TooLong } else { Line::Text(&self.line) }));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_come_whole_and_half_ones_not_at_all() {
        let mut lines = Lines::new(&b"one\n\ntwo\nhalf"[..]);
        for expected in ["one", "", "two"] {
            assert_eq!(lines.next().unwrap(), Some(Line::Text(expected.as_bytes())));
        }
        assert_eq!(lines.next().unwrap(), None);
    }

    #[test]
    fn empty_lines_are_passed_over_up_to_the_next_line() {
        let mut lines = Lines::new(&b"\n\n\none\n\n"[..]);
        assert!(!lines.has_more() && lines.skip_empty().unwrap() && !lines.skip_empty().unwrap());
        assert!(lines.has_more());
        assert_eq!(lines.next().unwrap(), Some(Line::Text(b"one")));
        assert!(lines.skip_empty().unwrap() && !lines.has_more() && !lines.skip_empty().unwrap());
    }

    #[test]
    fn the_longest_line_is_read_and_a_longer_one_is_passed_over() {
        let mut text = vec![b'x'; LONGEST_LINE];
        text.push(b'\n');
        text.extend(vec![b'y'; LONGEST_LINE + 1]);
        text.extend(b"\nnext\n");
        let mut lines = Lines::new(&text[..]);
        assert!(matches!(lines.next().unwrap(), Some(Line::Text(line)) if line.len() == LONGEST_LINE));
        assert_eq!(lines.next().unwrap(), Some(Line::TooLong));
        assert_eq!(lines.line.capacity(), 0, "nothing of it is kept");
        assert_eq!(lines.next().unwrap(), Some(Line::Text(b"next")));
    }
}
