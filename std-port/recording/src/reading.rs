//! Reads the messages of an MCAP file from its beginning, also of one that was cut off.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, parse_record};

/// Longest record that is read: a damaged length asks for no more memory.
const LONGEST: usize = 64 << 20;

/// The messages of a file, in its order.
pub struct Reading<R> {
    from: R,
    reader: LinearReader,
    topics: HashMap<u16, String>,
    /// The metadata that `cara` writes.
    about: BTreeMap<String, String>,
    /// Of the chunk that was read last.
    found: VecDeque<Message>,
    /// It is an MCAP file.
    is_begun: bool,
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
    /// All messages were read.
    Whole,
    /// It ends in the middle, as after the end of the process or the host that recorded it.
    CutOff,
    /// It cannot be read from here on.
    Damaged(String),
}

impl Reading<BufReader<File>> {
    /// Opens a file.
    pub fn open(path: &Path) -> io::Result<Self> {
        Ok(Self::of(BufReader::new(File::open(path)?)))
    }
}

impl<R: Read> Reading<R> {
    /// Reads what comes.
    pub fn of(from: R) -> Self {
        let options = LinearReaderOptions::default().with_emit_chunks(true).with_record_length_limit(LONGEST);
        let reader = LinearReader::new_with_options(options);
        Self {
            from,
            reader,
            topics: HashMap::new(),
            about: BTreeMap::new(),
            found: VecDeque::new(),
            is_begun: false,
            end: None,
        }
    }

    /// How it has ended, once there are no more messages.
    pub fn end(&self) -> Option<&End> {
        self.end.as_ref()
    }

    /// What the recording says of itself, once the first message has been read.
    pub fn about(&self) -> &BTreeMap<String, String> {
        &self.about
    }

    /// Reads on until a message is found; `None` at the end of the messages.
    fn read_on(&mut self) -> Result<Option<Message>, End> {
        loop {
            if let Some(message) = self.found.pop_front() {
                return Ok(Some(message));
            }
            match self.reader.next_event() {
                None | Some(Err(McapError::UnexpectedEof)) if self.is_begun => return Err(End::CutOff),
                None => return Err(End::of(&McapError::BadMagic)),
                Some(Err(error)) => return Err(End::of(&error)),
                Some(Ok(LinearReadEvent::ReadRequest(count))) => {
                    let read = self.from.read(self.reader.insert(count)).map_err(|error| End::of(&error))?;
                    self.reader.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    self.is_begun = true;
                    match opcode {
                        op::DATA_END => return Ok(None),
                        op::METADATA => {
                            if let Ok(Record::Metadata(about)) = parse_record(opcode, data) {
                                self.about = about.metadata;
                            }
                        }
                        op::CHUNK => take_chunk(data, &mut self.topics, &mut self.found)?,
                        opcode => take(opcode, data, &mut self.topics, &mut self.found),
                    }
                }
            }
        }
    }
}

impl End {
    fn of(error: &dyn std::error::Error) -> Self {
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

fn take_chunk(chunk: &[u8], topics: &mut HashMap<u16, String>, found: &mut VecDeque<Message>) -> Result<(), End> {
    match parse_record(op::CHUNK, chunk) {
        Ok(Record::Chunk { header, data }) if header.compression.is_empty() => {
            records(&data).for_each(|(opcode, record)| take(opcode, record, topics, found));
            Ok(())
        }
        Ok(Record::Chunk { header, .. }) => {
            Err(End::Damaged(format!("it is compressed ({}), which cara does not read", header.compression)))
        }
        _ => Err(End::Damaged("a chunk is damaged".to_owned())),
    }
}

fn take(opcode: u8, record: &[u8], topics: &mut HashMap<u16, String>, found: &mut VecDeque<Message>) {
    match opcode {
        op::CHANNEL | op::MESSAGE => {}
        // Nothing else is looked at, and so nothing of it can be wrong.
        _ => return,
    }
    match parse_record(opcode, record) {
        Ok(Record::Channel(channel)) => drop(topics.insert(channel.id, channel.topic)),
        Ok(Record::Message { header, data }) => {
            let Some(topic) = topics.get(&header.channel_id).cloned() else { return };
            found.push_back(Message { topic, came: header.log_time, body: data.into_owned() });
        }
        _ => {}
    }
}
