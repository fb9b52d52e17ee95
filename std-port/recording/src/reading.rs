//! Reads the messages of an MCAP file from its beginning, also of one that was cut off, and what is left of one that is damaged.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use crc::{CRC_32_ISO_HDLC, Crc, Digest, Table};
use mcap::records::{Record, op};
use mcap::{MAGIC, parse_record};

/// Longest record that is read: a damaged length asks for no more memory.
const LONGEST: usize = 64 << 20;
/// Bytes that are read at once.
const STEP: u64 = 64 << 10;
/// Opcode and length of a record.
const HEAD: usize = 9;
/// What stands in an uncompressed chunk before its records.
const CHUNK_HEAD: usize = 40;
const FOOTER: usize = 20;
/// Opcodes from here on are of other programs.
const PRIVATE: u8 = 0x80;

type Checksum = Crc<u32, Table<16>>;
static CHECKSUM: Checksum = Checksum::new(&CRC_32_ISO_HDLC);

/// The messages of a file, in its order.
pub struct Reading<R> {
    input: Input<R>,
    topics: HashMap<u16, String>,
    /// The metadata that `cara` writes.
    about: BTreeMap<String, String>,
    /// Of the chunk that was read last.
    found: VecDeque<Message>,
    /// It is an MCAP file.
    is_begun: bool,
    damage: Damage,
    end: Option<End>,
}

/// A message.
#[derive(Debug, PartialEq, Eq)]
pub struct Message {
    /// Of its channel.
    pub topic: String,
    /// Nanoseconds since 1970, when it was recorded.
    pub came: u64,
    /// JSON.
    pub body: Vec<u8>,
}

/// How the reading of a file has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// It was read to its end.
    Whole,
    /// It ends in the middle, as after the end of the process or the host that recorded it.
    CutOff,
    /// It cannot be read from here on.
    Damaged(String),
}

/// What is left out of a file, because it is not as it was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Damage {
    /// Chunks, or what stands between two that can be read.
    pub parts: u64,
    /// Messages of sound chunks whose channels are in none.
    pub messages: u64,
}

impl Reading<File> {
    /// Opens a file.
    pub fn open(path: &Path) -> io::Result<Self> {
        Ok(Self::of(File::open(path)?))
    }
}

impl<R: Read> Reading<R> {
    /// Reads what comes.
    pub fn of(from: R) -> Self {
        Self {
            input: Input { from, bytes: Vec::new(), at: 0, is_over: false, taken: CHECKSUM.digest() },
            topics: HashMap::new(),
            about: BTreeMap::new(),
            found: VecDeque::new(),
            is_begun: false,
            damage: Damage::default(),
            end: None,
        }
    }

    /// How it has ended, once there are no more messages.
    pub fn end(&self) -> Option<&End> {
        self.end.as_ref()
    }

    /// What was left out until now.
    pub fn damage(&self) -> Damage {
        self.damage
    }

    /// What the recording says of itself, once the first message has been read.
    pub fn about(&self) -> &BTreeMap<String, String> {
        &self.about
    }

    /// Reads on until a message is found; `None` at the end of the messages.
    fn read_on(&mut self) -> Result<Option<Message>, End> {
        if self.input.is_at_begin() {
            if self.input.peek(MAGIC.len())? != MAGIC {
                return Err(End::no_recording());
            }
            self.input.skip(MAGIC.len());
        }
        loop {
            if let Some(message) = self.found.pop_front() {
                return Ok(Some(message));
            }
            let Self { input, topics, about, found, damage, .. } = self;
            let next = input.next()?;
            let Next::Record(opcode, length) = next else {
                self.find_chunk(next == Next::CutOff)?;
                continue;
            };
            let record = input.record(length);
            let is_sound = match opcode {
                op::DATA_END => match <[u8; 4]>::try_from(record).map(u32::from_le_bytes) {
                    Ok(expected) => {
                        let is_damaged = expected != 0 && expected != input.taken.clone().finalize();
                        damage.parts = damage.parts.max(is_damaged.into());
                        return Ok(None);
                    }
                    Err(_) => false,
                },
                // The end of the messages is missing before it.
                op::FOOTER if length == FOOTER => {
                    damage.parts = damage.parts.max(1);
                    return Ok(None);
                }
                op::FOOTER => false,
                op::METADATA => {
                    if let Ok(Record::Metadata(its)) = parse_record(opcode, record) {
                        *about = its.metadata;
                    }
                    true
                }
                op::CHUNK => match chunk(record)? {
                    Some((records_of, true)) => {
                        records(records_of)
                            .for_each(|(opcode, record)| damage.messages += take(opcode, record, topics, found));
                        true
                    }
                    // Its messages may be others than those that were recorded. Sound chunks need its channels.
                    Some((records_of, false)) => {
                        damage.parts += 1;
                        for (opcode, record) in records(records_of).filter(|(opcode, _)| *opcode == op::CHANNEL) {
                            if let Ok(Record::Channel(channel)) = parse_record(opcode, record) {
                                topics.entry(channel.id).or_insert(channel.topic);
                            }
                        }
                        true
                    }
                    None => false,
                },
                op::MESSAGE_INDEX => record.get(2..6).is_some_and(|inner| inner == ((length - 6) as u32).to_le_bytes()),
                // Nobody writes one here, and passed over it could be a chunk.
                PRIVATE.. => false,
                opcode => {
                    damage.messages += take(opcode, record, topics, found);
                    true
                }
            };
            if is_sound {
                self.is_begun = true;
                self.input.skip(HEAD + length);
            } else {
                self.find_chunk(false)?;
            }
        }
    }

    /// Goes on to the next sound chunk from a place where no record is, or one that ends behind the end of the file. Without such a
    /// chunk the file ends here: if it has no end of its own, it was cut off.
    fn find_chunk(&mut self, is_short: bool) -> Result<(), End> {
        // A tail of zeros behind a whole record, as file systems may have it after a loss of power.
        let mut is_zero = true;
        loop {
            match self.input.peek(MAGIC.len() + 1)? {
                [] if !self.is_begun => return Err(End::no_recording()),
                [] => {
                    self.damage.parts += u64::from(!is_short && !is_zero);
                    return Err(End::CutOff);
                }
                rest if rest == MAGIC => {
                    self.damage.parts += 1;
                    return Err(if self.is_begun { End::Whole } else { End::no_recording() });
                }
                [first, ..] => is_zero &= *first == 0,
            }
            self.input.skip(1);
            if let Next::Record(op::CHUNK, length) = self.input.next()?
                && matches!(chunk(self.input.record(length)), Ok(Some((_, true))))
            {
                self.damage.parts += 1;
                self.is_begun = true;
                return Ok(());
            }
        }
    }
}

impl End {
    fn no_recording() -> Self {
        Self::Damaged("it is no recording".to_owned())
    }
}

impl From<io::Error> for End {
    fn from(error: io::Error) -> Self {
        Self::Damaged(error.to_string())
    }
}

impl<R: Read> Iterator for Reading<R> {
    type Item = Message;

    fn next(&mut self) -> Option<Message> {
        if self.end.is_some() {
            return None;
        }
        match self.read_on() {
            Ok(Some(message)) => return Some(message),
            Ok(None) => self.end = Some(End::Whole),
            Err(end) => self.end = Some(end),
        }
        None
    }
}

/// The bytes of a file.
struct Input<R> {
    from: R,
    /// Those that were read, from `at` on not yet taken.
    bytes: Vec<u8>,
    at: usize,
    is_over: bool,
    /// The checksum of what was taken.
    taken: Digest<'static, u32, Table<16>>,
}

/// What comes next.
#[derive(PartialEq, Eq)]
enum Next {
    /// A record's opcode and length. All of it is there.
    Record(u8, usize),
    /// A record of which a part is there, or nothing.
    CutOff,
    /// No record.
    Bad,
}

impl<R: Read> Input<R> {
    fn is_at_begin(&self) -> bool {
        self.bytes.is_empty() && !self.is_over
    }

    /// The next bytes; fewer at the end.
    fn peek(&mut self, count: usize) -> io::Result<&[u8]> {
        if self.bytes.len().saturating_sub(self.at) < count && !self.is_over {
            self.bytes.drain(..self.at);
            self.at = 0;
            while self.bytes.len() < count && !self.is_over {
                self.is_over = self.from.by_ref().take(STEP).read_to_end(&mut self.bytes)? == 0;
            }
        }
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        Ok(rest.get(..count).unwrap_or(rest))
    }

    /// Takes bytes that are there.
    fn skip(&mut self, count: usize) {
        let end = self.bytes.len().min(self.at + count);
        self.taken.update(self.bytes.get(self.at..end).unwrap_or_default());
        self.at = end;
    }

    fn next(&mut self) -> io::Result<Next> {
        let Some((opcode, length)) =
            self.peek(HEAD)?.split_first().and_then(|(opcode, rest)| Some((*opcode, *rest.first_chunk()?)))
        else {
            return Ok(Next::CutOff);
        };
        let length = usize::try_from(u64::from_le_bytes(length)).unwrap_or(usize::MAX);
        if !matches!(opcode, op::HEADER..=op::DATA_END | PRIVATE..) || length > LONGEST {
            return Ok(Next::Bad);
        }
        let is_there = self.peek(HEAD + length)?.len() == HEAD + length;
        Ok(if is_there { Next::Record(opcode, length) } else { Next::CutOff })
    }

    /// The next record, of that length.
    fn record(&self, length: usize) -> &[u8] {
        let begin = self.at + HEAD;
        self.bytes.get(begin..begin + length).unwrap_or_default()
    }
}

/// The records of a chunk and whether they are as they were written; `None` if its lengths do not fit, and it may be none.
fn chunk(chunk: &[u8]) -> Result<Option<(&[u8], bool)>, End> {
    let Ok(Record::Chunk { header, .. }) = parse_record(op::CHUNK, chunk) else { return Ok(None) };
    match header.compression.as_str() {
        "" => {}
        known @ ("lz4" | "zstd") => {
            return Err(End::Damaged(format!("it is compressed ({known}), which cara does not read")));
        }
        _ => return Ok(None),
    }
    let records = chunk.get(CHUNK_HEAD..).unwrap_or_default();
    if [header.compressed_size, header.uncompressed_size] != [records.len() as u64; 2] {
        return Ok(None);
    }
    // Zero is none.
    let is_sound = header.uncompressed_crc == 0 || header.uncompressed_crc == CHECKSUM.checksum(records);
    Ok(Some((records, is_sound)))
}

/// The records of a chunk, up to the first one that does not fit. The crate's own reader takes lengths in a chunk on trust.
fn records(mut chunk: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    std::iter::from_fn(move || {
        let (opcode, rest) = chunk.split_first()?;
        let (length, rest) = rest.split_first_chunk()?;
        let (record, rest) = rest.split_at_checked(u64::from_le_bytes(*length).try_into().ok()?)?;
        chunk = rest;
        Some((*opcode, record))
    })
}

/// Returns how many messages have no channel.
fn take(opcode: u8, record: &[u8], topics: &mut HashMap<u16, String>, found: &mut VecDeque<Message>) -> u64 {
    match opcode {
        op::CHANNEL | op::MESSAGE => {}
        // Nothing else is looked at, and so nothing of it can be wrong.
        _ => return 0,
    }
    match parse_record(opcode, record) {
        Ok(Record::Channel(channel)) => drop(topics.insert(channel.id, channel.topic)),
        Ok(Record::Message { header, data }) => {
            let Some(topic) = topics.get(&header.channel_id).cloned() else { return 1 };
            found.push_back(Message { topic, came: header.log_time, body: data.into_owned() });
        }
        _ => {}
    }
    0
}
