//! `cara logs`: the logs of boards, as they come over their links.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use cara_std::Shown;
use cara_std::control::protocol::{Answer, ArgumentValue, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, BAD, FAINT};
use cara_tools::units::{parse_time, show_time};

/// The stream of a board's log.
const STREAM: &str = "log";
/// What is kept of a line that has no end.
const LONGEST: usize = 64 * 1024;

/// Shows the logs of boards that are built with the feature `logs`, as they come; first what each has kept for this, also of its
/// life before. Ctrl-C ends it.
///
/// A log of defmt takes the firmware's ELF. One without is lines of text.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID; all if absent.
    node: Option<String>,
    /// The ELF of the nodes' firmware, whose log is defmt's; needs a `cara` that is built with the feature `defmt`.
    #[arg(long, value_name = "ELF")]
    firmware: Option<PathBuf>,
    /// End after this time.
    #[arg(long = "for", value_name = "TIME", value_parser = parse_time)]
    span: Option<Duration>,
}

pub(crate) fn run(Arguments { node, firmware, span }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let decoding = Decoding::of(firmware.as_deref())?;
    let mut operator = Operator::open(global, &node.as_deref().map_or(Need::Everybody, Need::Node))?;
    let question = match node {
        Some(node) => {
            let node = nodes::connected(&mut operator, &node)?.selector;
            let published = nodes::functions(&mut operator, &node)?;
            if !published.iter().any(|function| function.name == STREAM && nodes::is_stream(function)) {
                let text = format!("{node} has no log for others: is its firmware built with the feature `logs`?");
                return Err(Ended::failed("NoLog", text));
            }
            Question::Stream { node, name: Some(STREAM.to_owned()), interval_ms: 0 }
        }
        None => Question::Streams { names: vec![STREAM.to_owned()], interval_ms: 0 },
    };
    let mut logs = HashMap::<String, Log>::new();
    operator.watch(&question, span, |answer| {
        let Answer::Value { node, unix_ms, values, error, .. } = answer else { return Ok(true) };
        if let Some(error) = error {
            output::warning(format_args!("{node}: {}: {}", error.error, Shown(&error.text)));
        }
        let ints =
            values.iter().find_map(|value| if let ArgumentValue::Int(ints) = &value.value { Some(ints) } else { None });
        let bytes = values
            .iter()
            .find_map(|value| if let ArgumentValue::Bytes(hex) = &value.value { unhex(hex) } else { None });
        let Some((at, piece)) = ints.and_then(|ints| ints.first()).zip(bytes) else { return Ok(true) };
        let log = logs.entry(node.clone()).or_insert_with(|| Log::new(decoding.reader()));
        for line in log.take(*at as u32, &piece) {
            show(&node, unix_ms, line, global)?;
        }
        Ok(true)
    })?;
    Ok(Exit::Done.into())
}

fn show(node: &str, unix_ms: u64, line: Line, global: &Global) -> std::io::Result<()> {
    if global.json {
        let (text, lost) = match line {
            Line::Text(text) => (Some(text), None),
            Line::Lost(bytes) => (None, Some(bytes)),
        };
        return output::object(&json!({ "node": node, "unix_ms": unix_ms, "text": text, "lost": lost }));
    }
    let time = show_time(unix_ms);
    match line {
        Line::Text(text) => output::line(format_args!("{FAINT}{time}{FAINT:#}  {node:<20} {}", Shown(&text))),
        Line::Lost(bytes) => {
            output::line(format_args!("{FAINT}{time}{FAINT:#}  {node:<20} {BAD}{bytes} bytes are lost here{BAD:#}"))
        }
    }
}

fn unhex(hex: &str) -> Option<Vec<u8>> {
    let digit = |byte: u8| char::from(byte).to_digit(16);
    let pairs = hex.as_bytes().chunks(2);
    pairs.map(|pair| Some((digit(*pair.first()?)? * 16 + digit(*pair.get(1)?)?) as u8)).collect()
}

/// Something to show.
#[derive(Debug, PartialEq, Eq)]
enum Line {
    Text(String),
    /// So many bytes are missing.
    Lost(u32),
}

/// The log of one board, put together from its pieces.
struct Log {
    /// Where the next piece begins.
    next: Option<u32>,
    reader: Box<dyn Read>,
}

/// Makes lines of bytes.
trait Read {
    fn read(&mut self, bytes: &[u8], found: &mut Vec<Line>);

    /// What comes next does not follow what came.
    fn cut(&mut self);
}

impl Log {
    fn new(reader: Box<dyn Read>) -> Self {
        Self { next: None, reader }
    }

    fn take(&mut self, at: u32, piece: &[u8]) -> Vec<Line> {
        let (next, mut found) = (self.next.unwrap_or(at), Vec::new());
        self.next = Some(at.wrapping_add(piece.len() as u32));
        let (ahead, known) = (at.wrapping_sub(next), next.wrapping_sub(at) as usize);
        match piece.get(known..) {
            // After it was away, a board sends its last piece again.
            Some(fresh) => self.reader.read(fresh, &mut found),
            None => {
                self.reader.cut();
                // One that begins anew, after its power was off, is behind, and has lost nothing that is known of.
                found.extend((ahead <= u32::MAX / 2).then_some(Line::Lost(ahead)));
                self.reader.read(piece, &mut found);
            }
        }
        found
    }
}

/// A log of text.
#[derive(Default)]
struct Lines(Vec<u8>);

impl Read for Lines {
    fn read(&mut self, bytes: &[u8], found: &mut Vec<Line>) {
        for byte in bytes {
            match byte {
                b'\n' => found.push(Line::Text(String::from_utf8_lossy(&std::mem::take(&mut self.0)).into_owned())),
                byte if self.0.len() < LONGEST => self.0.push(*byte),
                _ => {}
            }
        }
    }

    fn cut(&mut self) {
        self.0.clear();
    }
}

/// How logs are read.
enum Decoding {
    Text,
    #[cfg(feature = "defmt")]
    Frames(&'static defmt_decoder::Table),
}

impl Decoding {
    #[cfg(not(feature = "defmt"))]
    fn of(firmware: Option<&Path>) -> anyhow::Result<Self> {
        let refused = "this `cara` is built without the feature `defmt`: it reads no firmware";
        firmware.map_or(Ok(Self::Text), |_| Err(Ended::usage(refused)))
    }

    #[cfg(feature = "defmt")]
    fn of(firmware: Option<&Path>) -> anyhow::Result<Self> {
        let Some(path) = firmware else { return Ok(Self::Text) };
        let wrong = |why: &dyn std::fmt::Display| Ended::usage(format!("{}: {why}", path.display()));
        let elf = std::fs::read(path).map_err(|error| wrong(&error))?;
        let table = defmt_decoder::Table::parse(&elf).map_err(|error| wrong(&error))?;
        let table = table.ok_or_else(|| wrong(&"it has no table of defmt"))?;
        // One for as long as the program runs.
        Ok(Self::Frames(Box::leak(Box::new(table))))
    }

    fn reader(&self) -> Box<dyn Read> {
        match self {
            Self::Text => Box::new(Lines::default()),
            #[cfg(feature = "defmt")]
            Self::Frames(table) => Box::new(frames::Frames::new(table)),
        }
    }
}

#[cfg(feature = "defmt")]
mod frames {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use defmt_decoder::{DecodeError, StreamDecoder, Table};

    use super::{LONGEST, Line, Read};

    /// A log of defmt.
    pub(super) struct Frames {
        table: &'static Table,
        decoder: Box<dyn StreamDecoder>,
        /// Bytes since the last frame.
        waiting: usize,
    }

    impl Frames {
        pub(super) fn new(table: &'static Table) -> Self {
            Self { table, decoder: table.new_stream_decoder(), waiting: 0 }
        }
    }

    impl Read for Frames {
        fn read(&mut self, bytes: &[u8], found: &mut Vec<Line>) {
            if self.waiting > LONGEST {
                self.cut();
            }
            self.decoder.received(bytes);
            self.waiting += bytes.len();
            loop {
                // The decoder takes its input for sound; a board may say anything.
                let decode = AssertUnwindSafe(|| self.decoder.decode().map(|frame| frame.display(false).to_string()));
                match catch_unwind(decode) {
                    Ok(Ok(text)) => {
                        self.waiting = 0;
                        found.push(Line::Text(text));
                    }
                    Ok(Err(DecodeError::UnexpectedEof)) => return,
                    // The rest of a frame whose begin is lost, or another firmware's.
                    Ok(Err(DecodeError::Malformed)) if self.table.encoding().can_recover() => {}
                    Ok(Err(DecodeError::Malformed)) | Err(_) => return self.cut(),
                }
            }
        }

        fn cut(&mut self) {
            *self = Self::new(self.table);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Line {
        Line::Text(text.to_owned())
    }

    #[test]
    fn pieces_make_lines_and_what_is_lost_is_counted() {
        let mut log = Log::new(Box::<Lines>::default());
        assert_eq!(log.take(7, b"one\ntw"), [text("one")]);
        assert_eq!(log.take(13, b"o\n"), [text("two")]);
        assert_eq!(log.take(13, b"o\n"), [], "sent again");
        assert_eq!(log.take(13, b"o\nthree\n"), [text("three")]);
        assert_eq!(log.take(121, b"rest\nfour\n"), [Line::Lost(100), text("rest"), text("four")]);
        assert_eq!(log.take(0, b"anew\n"), [text("anew")], "power was off");
        let mut wrapping = Log::new(Box::<Lines>::default());
        assert_eq!(wrapping.take(u32::MAX, b"ab"), []);
        assert_eq!(wrapping.take(1, b"c\n"), [text("abc")]);
        assert_eq!(wrapping.take(4, b"d\n"), [Line::Lost(1), text("d")]);
    }

    #[test]
    fn a_piece_is_read_from_its_digits() {
        assert_eq!(unhex("00ff0a"), Some(vec![0, 255, 10]));
        assert!(unhex("0").is_none() && unhex("xx").is_none());
    }
}
