//! `cara logs`: the logs of units, as they come over their links.

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Argument, ArgumentValue, Question};
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
/// Firmware that is looked for in vain, before no more is looked for.
const MOST_WITHOUT: usize = 1024;

/// Shows the logs of units, as they come: of boards that are built with the feature `logs`, of units on Linux that stream theirs,
/// and of the manager itself. First comes what each has kept, a board also of its life before. Ctrl-C ends it.
///
/// A log of defmt takes the firmware's ELF. Others are lines of text.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID; `.` or its name for the manager; all if absent.
    node: Option<String>,
    #[command(flatten)]
    firmware: FirmwareArguments,
    /// End after this time.
    #[arg(long = "for", value_name = "TIME", value_parser = parse_time)]
    span: Option<Duration>,
}

// Where the firmware of boards is. No text of help: it would be that of the verb.
#[derive(clap::Args)]
pub(crate) struct FirmwareArguments {
    /// The ELF of the boards' firmware, whose log is defmt's, or a folder of ELFs, in which each node's is found by its build id;
    /// needs a `cara` that is built with the feature `defmt`.
    #[arg(long, value_name = "ELF|FOLDER")]
    elf: Option<PathBuf>,
}

pub(crate) fn run(Arguments { node, firmware, span }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut logs = Logs::new(Decoding::of(&firmware, Decoding::Text)?.into());
    let mut operator = Operator::open(global, &node.as_deref().map_or(Need::Everybody, Need::Node))?;
    let is_one = node.is_some();
    let question = match node {
        Some(node) if operator.is_itself(&node)? => of_one(".".to_owned()),
        Some(node) => {
            let node = nodes::connected(&mut operator, &node)?.selector;
            let published = nodes::functions(&mut operator, &node)?;
            if !published.iter().any(|function| function.name == STREAM && nodes::is_stream(function)) {
                let text = format!(
                    "{node} has no log for others: a board's firmware takes the feature `logs`, the file of `cara node` `[log] stream = true`"
                );
                return Err(Ended::failed("NoLog", text));
            }
            of_one(node)
        }
        None => Question::Streams { names: vec![STREAM.to_owned()], interval_ms: 0 },
    };
    operator.watch(&question, span, |answer| {
        let Answer::Value { node, unix_ms, error, .. } = &answer else { return Ok(true) };
        if let Some(error) = error {
            output::warning(format_args!("{node}: {}: {}", error.error, Shown(&error.text)));
        }
        match logs.take(&answer) {
            Some(Found::Unread(Some(why))) if is_one => {
                return Err(Ended::failed("NoFirmware", format!("{node}: {why}")));
            }
            Some(Found::Unread(Some(why))) => output::warning(format_args!("{node}: {why}")),
            Some(Found::Lines(lines)) => {
                lines.into_iter().try_for_each(|line| show(node, *unix_ms, line, global))?;
            }
            Some(Found::Unread(None)) | None => {}
        }
        Ok(true)
    })?;
    Ok(Exit::Done.into())
}

fn of_one(node: String) -> Question {
    Question::Stream { node, name: Some(STREAM.to_owned()), interval_ms: 0 }
}

/// What a board's log has at one position.
struct Piece {
    at: u32,
    /// The build id of a board's firmware, 0 if it has none.
    build: Option<u64>,
    bytes: Vec<u8>,
}

impl Piece {
    fn of(values: &[Argument]) -> Option<Self> {
        let value = |name| values.iter().find(|value| value.name == name).map(|value| &value.value);
        let int = |name| match value(name) {
            Some(ArgumentValue::Int(ints)) => ints.first().copied(),
            _ => None,
        };
        let Some(ArgumentValue::Bytes(hex)) = value("piece") else { return None };
        Some(Self { at: int("at")? as u32, build: int("build").map(|build| build as u64), bytes: unhex(hex)? })
    }
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
        lost @ Line::Lost(_) => output::line(format_args!("{FAINT}{time}{FAINT:#}  {node:<20} {BAD}{lost}{BAD:#}")),
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

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Text(text) => f.write_str(text),
            Self::Lost(bytes) => write!(f, "{bytes} bytes are lost here"),
        }
    }
}

/// The log of one board, put together from its pieces.
struct Log {
    build: Option<u64>,
    /// Where the next piece begins.
    next: Option<u32>,
    /// None if its firmware is not there: nothing is shown.
    reader: Option<Box<dyn Read>>,
}

/// The logs of all nodes, put together from their pieces. The default reads no board's.
#[derive(Default)]
pub(crate) struct Logs {
    decoding: Arc<Decoding>,
    /// By node.
    logs: HashMap<String, Log>,
    /// Whose firmware was not found.
    without: HashSet<(String, Option<u64>)>,
}

/// What a piece of a log brings.
enum Found {
    Lines(Vec<Line>),
    /// Its firmware is not there; why, with the first piece.
    Unread(Option<String>),
}

impl Logs {
    pub(super) fn new(decoding: Arc<Decoding>) -> Self {
        Self { decoding, ..Self::default() }
    }

    /// `None` if it is no piece of a log.
    fn take(&mut self, answer: &Answer) -> Option<Found> {
        let Answer::Value { node, stream, values, .. } = answer else { return None };
        if stream.split('(').next() != Some(STREAM) {
            return None;
        }
        let Piece { at, build, bytes } = Piece::of(values)?;
        let mut why_not = None;
        if self.logs.get(node).is_none_or(|log| log.build != build) {
            let whose = (node.clone(), build);
            // A board that changes its build id with each piece is not looked for each time.
            let is_many = build.is_some() && self.without.len() >= MOST_WITHOUT;
            let reader = if is_many || self.without.contains(&whose) {
                None
            } else {
                self.decoding.reader(build).map_err(|why| why_not = Some(why)).ok()
            };
            if why_not.is_some() {
                self.without.insert(whose);
            }
            self.logs.insert(node.clone(), Log { build, next: None, reader });
        }
        let log = self.logs.get_mut(node).filter(|log| log.reader.is_some());
        Some(log.map_or(Found::Unread(why_not), |log| Found::Lines(log.take(at, &bytes))))
    }

    /// An event for each line in the place of a piece of a log. A piece whose firmware is not there, and anything else, stays as it
    /// is; before the first such piece an event says why.
    pub(crate) fn events(&mut self, answer: Answer) -> Vec<Answer> {
        let found = self.take(&answer);
        let Answer::Value { node, unix_ms, .. } = &answer else { return vec![answer] };
        let event = |event: &str, text| Answer::Event {
            at_ms: 0,
            unix_ms: *unix_ms,
            event: event.to_owned(),
            node: Some(node.clone()),
            text,
        };
        match found {
            Some(Found::Lines(lines)) => lines.into_iter().map(|line| event(STREAM, line.to_string())).collect(),
            Some(Found::Unread(Some(why))) => vec![event("no_firmware", why), answer],
            Some(Found::Unread(None)) | None => vec![answer],
        }
    }
}

/// Makes lines of bytes.
trait Read {
    fn read(&mut self, bytes: &[u8], found: &mut Vec<Line>);

    /// What comes next does not follow what came; returns how many bytes had no end yet, and are lost.
    fn cut(&mut self) -> u32;
}

impl Log {
    fn take(&mut self, at: u32, piece: &[u8]) -> Vec<Line> {
        let (next, mut found) = (self.next.unwrap_or(at), Vec::new());
        let Some(reader) = &mut self.reader else { return found };
        self.next = Some(at.wrapping_add(piece.len() as u32));
        let (ahead, known) = (at.wrapping_sub(next), next.wrapping_sub(at) as usize);
        match piece.get(known..) {
            // After it was away, a board sends its last piece again.
            Some(fresh) => reader.read(fresh, &mut found),
            None => {
                // One that begins anew, after its power was off, is behind: of it only the begun line is known to be lost.
                let missing = if ahead <= u32::MAX / 2 { ahead } else { 0 };
                let lost = missing.saturating_add(reader.cut());
                found.extend((lost > 0).then_some(Line::Lost(lost)));
                reader.read(piece, &mut found);
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

    fn cut(&mut self) -> u32 {
        std::mem::take(&mut self.0).len() as u32
    }
}

/// How logs are read.
#[derive(Default)]
pub(super) enum Decoding {
    /// All are text.
    Text,
    /// Those of units on Linux are text, and a board's is not read.
    #[default]
    OfLinux,
    #[cfg(feature = "defmt")]
    Frames(firmware::Firmware),
}

impl Decoding {
    /// With the firmware that is named; `otherwise` if none is.
    #[cfg(not(feature = "defmt"))]
    pub(super) fn of(arguments: &FirmwareArguments, otherwise: Self) -> anyhow::Result<Self> {
        let refused = "this `cara` is built without the feature `defmt`: it reads no firmware";
        arguments.elf.as_ref().map_or(Ok(otherwise), |_| Err(Ended::usage(refused)))
    }

    #[cfg(feature = "defmt")]
    pub(super) fn of(arguments: &FirmwareArguments, otherwise: Self) -> anyhow::Result<Self> {
        let Some(path) = &arguments.elf else { return Ok(otherwise) };
        let found = firmware::Firmware::of(path);
        found.map(Self::Frames).map_err(|why| Ended::usage(format!("{}: {why}", path.display())))
    }

    /// Of a board whose firmware has this build id; a log without any is text.
    fn reader(&self, build: Option<u64>) -> Result<Box<dyn Read>, String> {
        match (self, build) {
            #[cfg(feature = "defmt")]
            (Self::Frames(firmware), Some(build)) => Ok(Box::new(frames::Frames::new(firmware.table(build)?))),
            (Self::OfLinux, Some(build)) => Err(format!(
                "its log stays bytes, as its firmware is not known, {}: name its ELF, or a folder that has it, with --elf",
                match build {
                    0 => "which tells no build id".to_owned(),
                    build => format!("whose build id is {build:016x}"),
                }
            )),
            _ => Ok(Box::new(Lines::default())),
        }
    }
}

#[cfg(feature = "defmt")]
mod firmware {
    use std::collections::HashMap;
    use std::path::{Path, PathBuf};
    use std::sync::{Mutex, PoisonError};

    use defmt_decoder::Table;
    use object::Object as _;

    /// How an ELF begins.
    const MAGIC: &[u8] = b"\x7fELF";

    /// Where the ELFs are.
    pub(in crate::commands) enum Firmware {
        File {
            path: PathBuf,
            build: Option<u64>,
            table: &'static Table,
        },
        /// With what was found there.
        Folder(PathBuf, Mutex<HashMap<u64, &'static Table>>),
    }

    impl Firmware {
        pub(super) fn of(path: &Path) -> Result<Self, String> {
            if path.is_dir() {
                return Ok(Self::Folder(path.to_owned(), Mutex::default()));
            }
            let elf = std::fs::read(path).map_err(|error| error.to_string())?;
            Ok(Self::File { path: path.to_owned(), build: build_id(&elf), table: table(&elf)? })
        }

        /// Of the board's firmware, whose build id is 0 if it tells none.
        pub(super) fn table(&self, build: u64) -> Result<&'static Table, String> {
            match self {
                Self::File { table, .. } if build == 0 => Ok(table),
                Self::File { table, build: found, .. } if *found == Some(build) => Ok(table),
                Self::File { path, build: found, .. } => Err(format!(
                    "its firmware has the build id {build:016x}, and {} {}: name the ELF that the board was flashed with, or a \
                     folder that has it",
                    path.display(),
                    found.map_or_else(|| "none".to_owned(), |found| format!("{found:016x}")),
                )),
                Self::Folder(folder, _) if build == 0 => {
                    let folder = folder.display();
                    Err(format!("it tells no build id, by which its ELF could be found in {folder}: name the ELF"))
                }
                Self::Folder(folder, found) => {
                    let mut found = found.lock().unwrap_or_else(PoisonError::into_inner);
                    if let Some(table) = found.get(&build) {
                        return Ok(table);
                    }
                    let table = table(&elf_of(folder, build)?)?;
                    found.insert(build, table);
                    Ok(table)
                }
            }
        }
    }

    fn elf_of(folder: &Path, build: u64) -> Result<Vec<u8>, String> {
        let entries = std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        let paths = entries.filter_map(|entry| Some(entry.ok()?.path())).filter(|path| path.is_file());
        let found = paths.filter_map(|path| elf(&path)).find(|elf| build_id(elf) == Some(build));
        found.ok_or_else(|| {
            let folder = folder.display();
            format!("{folder} has no ELF with its build id {build:016x}: put the one there that it was flashed with")
        })
    }

    /// A file, if it is one.
    fn elf(path: &Path) -> Option<Vec<u8>> {
        use std::io::Read as _;
        let mut file = std::fs::File::open(path).ok()?;
        let mut bytes = vec![0; MAGIC.len()];
        file.read_exact(&mut bytes).ok().filter(|()| bytes == MAGIC)?;
        file.read_to_end(&mut bytes).ok()?;
        Some(bytes)
    }

    /// The first eight bytes of its build id, as boards tell them.
    fn build_id(elf: &[u8]) -> Option<u64> {
        let file = object::File::parse(elf).ok()?;
        Some(u64::from_be_bytes(*file.build_id().ok()??.first_chunk()?))
    }

    fn table(elf: &[u8]) -> Result<&'static Table, String> {
        let table = Table::parse(elf).map_err(|error| error.to_string())?;
        // One for each firmware, as long as the program runs.
        table.map(|table| &*Box::leak(Box::new(table))).ok_or_else(|| "it has no table of defmt".to_owned())
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
                found.push(Line::Lost(self.cut()));
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
                    Ok(Err(DecodeError::Malformed)) | Err(_) => {
                        found.push(Line::Lost(self.cut()));
                        return;
                    }
                }
            }
        }

        fn cut(&mut self) -> u32 {
            std::mem::replace(self, Self::new(self.table)).waiting as u32
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Line {
        Line::Text(text.to_owned())
    }

    fn log_of_text() -> Log {
        Log { build: None, next: None, reader: Some(Box::<Lines>::default()) }
    }

    #[test]
    fn pieces_make_lines_and_what_is_lost_is_counted() {
        let mut log = log_of_text();
        assert_eq!(log.take(7, b"one\ntw"), [text("one")]);
        assert_eq!(log.take(13, b"o\n"), [text("two")]);
        assert_eq!(log.take(13, b"o\n"), [], "sent again");
        assert_eq!(log.take(13, b"o\nthree\n"), [text("three")]);
        assert_eq!(log.take(121, b"rest\nfour\n"), [Line::Lost(100), text("rest"), text("four")]);
        assert_eq!(log.take(0, b"anew\n"), [text("anew")], "power was off");
        assert_eq!(log.take(5, b"begun"), []);
        assert_eq!(log.take(0, b"an\n"), [Line::Lost(5), text("an")], "in the middle of a line");
        let mut wrapping = log_of_text();
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
