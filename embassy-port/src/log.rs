//! The log of a board over its link: a stream of the lowest class, whose values are pieces of the log, one after another.
//!
//! A [`Log`] keeps the newest [`LOG_BYTES`], until a subscriber gets them: also those of before it has joined, and of the life
//! before, where the memory survives a reset. It holds up nobody who writes. What was overwritten before it was sent is lost; each
//! piece has its position in the log, so that the reader counts the losses.
//!
//! The bytes are whatever the board logs, such as frames of `defmt`, which are read with the firmware's ELF: each piece has the
//! firmware's build id, by which it is found.

use core::cell::Cell as CoreCell;
use core::fmt;
use core::sync::atomic::{AtomicU8, AtomicU32, Ordering};

use cara_core::distribution::function::{Definition, Signature};
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::Error;
use cara_core::services::stream::{Source, Value};
use cara_core::time::Duration;
use embassy_time::Timer;

use crate::functions::MyFunctionList;
use crate::stream_cell::{Cell, StreamCell};
use crate::streams::Stream;

/// Bytes that wait for a subscriber.
pub const LOG_BYTES: usize = 1024;
/// Bytes of a piece; with [`PAUSE`] at most 5 KB a second.
const PIECE: usize = 256;
/// Between two pieces.
const PAUSE: Duration = Duration::from_millis(50);
/// Bytes of the values of a piece.
const BLOCK: usize = PIECE + 24;
/// What the board publishes: the position of the first byte, the build id, and bytes of the log. Other programs read it:
/// `docs/boards.md`.
const STREAM: &str = "log(at: int, build: int, piece: bytes[256])";
/// A memory that is not this was never written.
const MARK: u32 = 0x4C4F_4721;

/// The newest bytes of a log. Any content is valid, so that it can lie in memory that a start does not touch.
pub struct Log {
    mark: AtomicU32,
    /// Of the firmware that wrote it, or 0 before it has said so.
    build: AtomicU32,
    /// Bytes that were ever written; it wraps.
    written: AtomicU32,
    bytes: [AtomicU8; LOG_BYTES],
}

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Log").field("written", &self.written).finish_non_exhaustive()
    }
}

impl Default for Log {
    fn default() -> Self {
        Self::new()
    }
}

impl Log {
    /// An empty one.
    pub const fn new() -> Self {
        const { assert!(LOG_BYTES.is_power_of_two(), "positions wrap at a multiple of it") };
        let bytes = [const { AtomicU8::new(0) }; LOG_BYTES];
        Self { mark: AtomicU32::new(0), build: AtomicU32::new(0), written: AtomicU32::new(0), bytes }
    }

    /// Writes bytes; never waits. Two writers at a time mix what they write: `defmt`'s loggers have a critical section.
    pub fn write(&self, bytes: &[u8]) {
        let mut at = self.written();
        for byte in bytes {
            if let Some(place) = self.place(at) {
                place.store(*byte, Ordering::Relaxed);
            }
            at = at.wrapping_add(1);
        }
        self.written.store(at, Ordering::Release);
    }

    fn written(&self) -> u32 {
        if self.mark.swap(MARK, Ordering::Relaxed) != MARK {
            self.written.store(0, Ordering::Relaxed);
            self.build.store(0, Ordering::Relaxed);
        }
        self.written.load(Ordering::Acquire)
    }

    /// Forgets what another firmware has written: it is not to be read as this one's.
    fn belong_to(&self, build: u32) {
        self.written();
        let before = self.build.swap(build, Ordering::Relaxed);
        if before != 0 && before != build {
            self.written.store(0, Ordering::Release);
        }
    }

    /// The bytes behind `from` as far as there are; from where on.
    fn read<'b>(&self, from: u32, into: &'b mut [u8; PIECE]) -> (u32, &'b [u8]) {
        let written = self.written();
        let kept = written.min(LOG_BYTES as u32);
        // What is ahead is of another life.
        let waits = written.wrapping_sub(from).min(kept);
        let from = written.wrapping_sub(waits);
        let length = PIECE.min(waits as usize);
        let mut at = from;
        for byte in into.iter_mut().take(length) {
            *byte = self.place(at).map_or(0, |place| place.load(Ordering::Relaxed));
            at = at.wrapping_add(1);
        }
        (from, into.get(..length).unwrap_or_default())
    }

    fn place(&self, at: u32) -> Option<&AtomicU8> {
        self.bytes.get(at as usize % LOG_BYTES)
    }
}

/// The piece that is sent next, in static memory.
#[derive(Debug)]
pub struct LogCell {
    piece: StreamCell<BLOCK>,
    /// It was published, and not sent.
    waits: CoreCell<bool>,
}

impl Default for LogCell {
    fn default() -> Self {
        Self::new()
    }
}

impl LogCell {
    /// Without a piece.
    pub const fn new() -> Self {
        Self { piece: StreamCell::new(), waits: CoreCell::new(false) }
    }
}

impl Source for LogCell {
    fn version(&self) -> u32 {
        self.piece.version()
    }

    fn newest(&self, look: &mut dyn FnMut(&Value<'_>)) {
        self.piece.newest(look);
    }

    fn taken(&self) {
        self.waits.set(false);
    }
}

impl Cell for LogCell {
    fn publish(&self, signature: Signature<'_>, values: &ParametersView) -> Result<(), Error> {
        self.waits.set(true);
        self.piece.publish(signature, values)
    }
}

/// The log as a stream of this unit.
pub struct LogStream<T: 'static> {
    log: &'static Log,
    build: i64,
    stream: Stream<T>,
    cell: &'static LogCell,
}

impl<T> fmt::Debug for LogStream<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.stream.fmt(f)
    }
}

impl<T> MyFunctionList<T> {
    /// Adds the stream `log`. The board publishes its list, and [runs](LogStream::run) what this returns in a task of its own.
    /// `build` has the first eight bytes of the build id in the firmware's ELF, the first the highest, or is 0 if it has none. What
    /// a firmware of another build has left in `log` is forgotten.
    ///
    /// [`Error::NameTaken`], [`Error::Full`].
    pub fn add_log(&self, log: &'static Log, cell: &'static LogCell, build: i64) -> Result<LogStream<T>, Error> {
        let definition = Definition::stream(STREAM).map_err(|_| Error::BadName)?;
        let stream = self.add_defined(&definition, PAUSE, BLOCK, cell)?;
        log.belong_to(build as u32);
        Ok(LogStream { log, build, stream, cell })
    }
}

impl<T> LogStream<T> {
    /// Hands out piece after piece, each when the one before has been sent.
    pub async fn run(&self) -> ! {
        let mut from = 0;
        loop {
            if !self.cell.waits.get() {
                from = self.publish(from);
            }
            Timer::after_micros(PAUSE.as_micros()).await;
        }
    }

    /// Where the next piece begins.
    fn publish(&self, from: u32) -> u32 {
        let mut bytes = [0; PIECE];
        let (at, piece) = self.log.read(from, &mut bytes);
        if !piece.is_empty() {
            // Fails only when the stream has been removed.
            let _ = values(at, self.build, piece).and_then(|values| self.stream.publish(&values));
        }
        at.wrapping_add(piece.len() as u32)
    }
}

fn values(at: u32, build: i64, piece: &[u8]) -> Result<Parameters, Error> {
    let mut values = Parameters::new();
    values.add_int("at", 1)?;
    values.set_value("at", i64::from(at))?;
    values.add_int("build", 1)?;
    values.set_value("build", build)?;
    values.add_bytes("piece", PIECE as u32)?;
    values.set_value("piece", piece)?;
    Ok(values)
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::block;

    use super::*;

    /// All that can be read from there on, and where it begins.
    fn all(log: &Log, from: u32) -> (u32, heapless::Vec<u8, LOG_BYTES>) {
        let mut found = heapless::Vec::new();
        let mut piece = [0; PIECE];
        let (first, bytes) = log.read(from, &mut piece);
        assert!(found.extend_from_slice(bytes).is_ok());
        loop {
            let next = first.wrapping_add(found.len() as u32);
            let (at, bytes) = log.read(next, &mut piece);
            assert_eq!(at, next);
            if bytes.is_empty() {
                return (first, found);
            }
            assert!(found.extend_from_slice(bytes).is_ok());
        }
    }

    fn has(log: &Log, from: u32, first: u32, bytes: &[u8]) {
        let (at, found) = all(log, from);
        assert_eq!((at, found.as_slice()), (first, bytes));
    }

    #[test]
    fn pieces_follow_each_other_and_what_is_overwritten_is_seen_by_the_position() {
        let log = Log::new();
        has(&log, 0, 0, b"");
        let bytes: [u8; LOG_BYTES + 10] = core::array::from_fn(|byte| byte as u8);
        log.write(&bytes[..300]);
        has(&log, 0, 0, &bytes[..300]);
        log.write(&bytes[300..]);
        has(&log, 0, 10, &bytes[10..]);
        has(&log, 1_000, 1_000, &bytes[1_000..]);
        has(&log, bytes.len() as u32, bytes.len() as u32, b"");
    }

    #[test]
    fn memory_that_was_never_written_is_empty_and_positions_wrap() {
        let log = Log { mark: AtomicU32::new(7), ..Log::new() };
        log.written.store(1_000_000, Ordering::Relaxed);
        has(&log, 0, 0, b"");
        log.written.store(u32::MAX - 1, Ordering::Relaxed);
        log.write(b"wraps");
        // So shortly behind the wrap only what is behind it is known to be there.
        has(&log, u32::MAX - 1, 0, b"aps");
        log.write(b"!");
        has(&log, 3, 3, b"!");
    }

    #[test]
    fn what_another_firmware_has_left_is_forgotten() {
        let log = Log::new();
        log.write(b"before it joins");
        log.belong_to(7);
        has(&log, 0, 0, b"before it joins");
        log.belong_to(7);
        has(&log, 0, 0, b"before it joins");
        log.belong_to(8);
        has(&log, 0, 0, b"");
    }

    #[test]
    fn a_piece_fits_what_the_stream_declares() {
        let fits = |length: usize| length > PIECE && length <= BLOCK;
        assert!(Definition::stream(STREAM).is_ok_and(|definition| {
            let results = || definition.signature().results();
            let length = values(u32::MAX, i64::MIN, &[7; PIECE]).and_then(|values| block::measure(results(), &values));
            block::longest(results()).is_some_and(fits) && length.is_ok_and(fits)
        }));
    }
}
