//! The recorder: a report goes into a bounded queue, which holds up no thread that reports; a thread of its own writes it.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use cara_std::LineQueue;
use cara_std::control::protocol::{Answer, FunctionInfo};
use mcap::McapResult;
use serde::Serialize;
use serde_json::json;

use super::file::{Files, Limits, StartError};
use super::layout::{self, Elsewhere, MQTT, Message};

/// Longest message; a longer one is lost. With the 1024 lines of the queue this bounds its memory to 256 MiB.
const LONGEST: usize = 256 * 1024;
/// Lines of the queue that are no messages: the chunk ends, the recording ends.
const FLUSH: &[u8] = b"";
const END: &[u8] = b"end";
/// Bytes of the time before each message.
const TIME: usize = size_of::<u64>();

/// Writes a recording. Its clones write the same one.
#[derive(Clone)]
pub struct Recorder {
    queue: LineQueue,
    state: Arc<State>,
}

/// What has come of a recording.
pub struct Outcome {
    /// Messages that the files have.
    pub messages: u64,
    /// And those that they have not.
    pub lost: u64,
    /// The last file is whole; otherwise what the disk said, if it said something.
    pub whole: Result<(), Option<String>>,
}

impl Recorder {
    /// Begins a file with `about` as its metadata. Waits for a disk that hangs, and for none that is full.
    pub fn start(path: &Path, limits: Limits, about: BTreeMap<String, String>) -> Result<Self, StartError> {
        let state = Arc::<State>::default();
        let files = Files::open(path, limits, about, state.clone())?;
        let mut writer = Writer { files, state: state.clone(), lost: 0, unflushed: 0, is_over: false };
        let queue = LineQueue::new("recorder", move |line, lost| writer.take(line, lost));
        let queue = queue.map_err(|error| StartError::Failed { path: path.to_owned(), error })?;
        Ok(Self { queue, state })
    }

    /// Records an answer. Never waits: what finds no place is counted.
    pub fn take(&self, answer: &Answer) {
        self.write(line_of(answer));
    }

    /// Records what a node offers, likewise.
    pub fn take_functions(&self, node: &str, functions: &[FunctionInfo]) {
        self.write(line_of(&(node, functions)));
    }

    /// Records a message of MQTT, likewise. A payload that is no text is recorded as hexadecimal digits.
    pub fn take_mqtt(&self, is_sent: bool, topic: &str, is_retained: bool, payload: &[u8]) {
        let text = std::str::from_utf8(payload).ok();
        // A longer one is lost: `write` counts it.
        let hex = || payload.iter().take(LONGEST).map(|byte| format!("{byte:02x}")).collect::<String>();
        let hex = if text.is_none() { Some(hex()) } else { None };
        let direction = if is_sent { "sent" } else { "received" };
        let body = json!({
            "direction": direction, "topic": topic, "retained": is_retained, "payload": text, "payload_hex": hex,
        });
        self.write(line_of(&Elsewhere { topic: format!("{MQTT}{topic}"), body }));
    }

    fn write(&self, line: Option<Vec<u8>>) {
        match line {
            Some(line) => self.queue.write(&line),
            None => drop(self.state.too_long.fetch_add(1, Ordering::Relaxed)),
        }
    }

    /// Ends the chunk; to be called every second.
    pub fn flush(&self) {
        // A full queue is a disk that takes nothing now, and is flushed when it does.
        if self.state.held_up().is_none() {
            self.queue.write(FLUSH);
        }
    }

    /// Messages that the disk did not take, or not in time.
    pub fn lost(&self) -> u64 {
        self.queue.lost() + self.state.too_long.load(Ordering::Relaxed) + self.state.unwritten.load(Ordering::Relaxed)
    }

    /// Why nothing is written at this moment, as far as the system says.
    pub fn held_up(&self) -> Option<String> {
        self.state.held_up()
    }

    /// Which file of the recording is written: each has to begin with the state of everything.
    pub fn file(&self) -> u64 {
        self.state.file.load(Ordering::Relaxed)
    }

    /// Ends the recording. A disk that takes nothing is waited for twice for so long, and then given up.
    pub fn end(self, at_most: Duration) -> Outcome {
        let in_time = self.queue.flush(at_most) && {
            self.queue.write(END);
            self.queue.flush(at_most)
        };
        if !in_time {
            self.state.given_up.store(true, Ordering::Relaxed);
            // What waits is counted as lost.
            self.queue.flush(at_most);
        }
        let is_whole = self.state.is_whole.load(Ordering::Relaxed);
        let whole = if is_whole { Ok(()) } else { Err(self.state.held_up()) };
        Outcome { messages: self.state.messages.load(Ordering::Relaxed), lost: self.lost(), whole }
    }
}

/// What the recorder and its thread share.
#[derive(Default)]
pub(super) struct State {
    file: AtomicU64,
    /// Of that file.
    bytes: AtomicU64,
    messages: AtomicU64,
    too_long: AtomicU64,
    /// Messages of a chunk that the disk did not take.
    unwritten: AtomicU64,
    held_up: Mutex<Option<String>>,
    /// Before it nobody can give up, and so nothing waits for the disk.
    begun: AtomicBool,
    given_up: AtomicBool,
    is_whole: AtomicBool,
}

impl State {
    pub(super) fn begins(&self) {
        self.bytes.store(0, Ordering::Relaxed);
        self.file.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn has_begun(&self) {
        self.begun.store(true, Ordering::Relaxed);
    }

    pub(super) fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    pub(super) fn wrote(&self, count: usize) {
        self.bytes.fetch_add(count as u64, Ordering::Relaxed);
        *self.held_up.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    pub(super) fn is_given_up(&self) -> bool {
        self.given_up.load(Ordering::Relaxed)
    }

    /// The system refuses to write: waits before the next try. An error before the recording has begun, and once it is given up.
    pub(super) fn is_held_up(&self, error: io::Error, pause: Duration) -> io::Result<()> {
        *self.held_up.lock().unwrap_or_else(PoisonError::into_inner) = Some(error.to_string());
        if !self.begun.load(Ordering::Relaxed) || self.is_given_up() {
            return Err(error);
        }
        std::thread::sleep(pause);
        Ok(())
    }

    fn held_up(&self) -> Option<String> {
        self.held_up.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// The thread's side.
struct Writer {
    files: Files,
    state: Arc<State>,
    /// Losses that the recording has.
    lost: u64,
    /// Messages since the last chunk ended.
    unflushed: u64,
    /// The last file has ended: what other threads still report would begin another one.
    is_over: bool,
}

impl Writer {
    /// An error counts the line as lost.
    fn take(&mut self, line: &[u8], lost: u64) -> io::Result<()> {
        let lost = lost + self.state.too_long.load(Ordering::Relaxed);
        match line {
            _ if self.is_over => Ok(()),
            FLUSH => self.flush(),
            END => self.end(lost),
            line => self.write(line, lost),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        // Its messages are counted one by one, and not the line that ends them.
        match self.files.flush() {
            Ok(()) => self.unflushed = 0,
            Err(_) => drop(self.state.unwritten.fetch_add(std::mem::take(&mut self.unflushed), Ordering::Relaxed)),
        }
        Ok(())
    }

    fn end(&mut self, lost: u64) -> io::Result<()> {
        self.is_over = true;
        let messages = self.state.messages.load(Ordering::Relaxed);
        let body = json!({ "event": "ended", "messages": messages, "lost_in_all": lost });
        let ended = self.note_losses(lost).and_then(|()| self.files.write(&layout::about_itself(body, now()), now()));
        self.flush()?;
        if ended.and_then(|()| self.files.finish()).is_ok() {
            self.state.is_whole.store(true, Ordering::Relaxed);
        }
        Ok(())
    }

    fn write(&mut self, line: &[u8], lost: u64) -> io::Result<()> {
        let Some((message, came)) = message_of(line)? else { return Ok(()) };
        self.note_losses(lost).and_then(|()| self.files.write(&message, came)).map_err(io::Error::other)?;
        self.state.messages.fetch_add(1, Ordering::Relaxed);
        self.unflushed += 1;
        Ok(())
    }

    /// Writes down how many messages are missing here.
    fn note_losses(&mut self, lost: u64) -> McapResult<()> {
        if lost <= self.lost {
            return Ok(());
        }
        let text = format!("{} messages came faster than the disk took them", lost - self.lost);
        let body = json!({ "event": "lost", "lost": lost - self.lost, "lost_in_all": lost, "text": text });
        self.lost = lost;
        self.files.write(&layout::about_itself(body, now()), now())
    }
}

/// An answer that comes now, or a node and its functions, with its time before it; `None` if it is too long.
pub(super) fn line_of(body: &impl Serialize) -> Option<Vec<u8>> {
    let mut line = now().to_le_bytes().to_vec();
    serde_json::to_writer(&mut line, body).ok().filter(|()| line.len() <= LONGEST)?;
    Some(line)
}

/// When a line came, in nanoseconds since 1970.
pub(super) fn came(line: &[u8]) -> Option<u64> {
    line.first_chunk::<TIME>().map(|came| u64::from_le_bytes(*came))
}

/// What is recorded of a line, and when that came; `None` if nothing is.
pub(super) fn message_of(line: &[u8]) -> io::Result<Option<(Message, u64)>> {
    let came = came(line).ok_or(io::ErrorKind::InvalidData)?;
    let body = line.get(TIME..).unwrap_or_default();
    if body.starts_with(b"[") {
        let (node, functions): (String, Vec<FunctionInfo>) = serde_json::from_slice(body)?;
        return Ok(Some((layout::functions(&node, &functions, came), came)));
    }
    if body.starts_with(Elsewhere::BEGIN) {
        let elsewhere: Elsewhere = serde_json::from_slice(body)?;
        return Ok(Some((elsewhere.message(came), came)));
    }
    let answer = serde_json::from_slice(body)?;
    Ok(layout::message(&answer, came).map(|message| (message, came)))
}

/// Nanoseconds since 1970.
pub(super) fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos() as u64
}
