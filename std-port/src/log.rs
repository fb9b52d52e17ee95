//! The log of a unit: over its link a stream whose values are pieces of the log, as those of boards, and the same pieces for the
//! operators of an m_unit.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::sync::mpsc::channel;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};

use cara_core::distribution::function::Definition;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::time::Duration;

use crate::engine::streams::OwnStream;
use crate::engine::{Engine, arena};
use crate::error::system_refused;
use crate::my_function_list::MyFunctionList;

/// Bytes that wait for a subscriber.
const KEPT: usize = 16 * 1024;
/// Bytes of one write; the rest is cut off.
const LONGEST: usize = 4096;
/// Ends a write that was cut off.
const CUT: &[u8] = b" [cut off]\n";
/// Bytes of a piece: with its position it fits a peer that takes messages of 1 KiB.
const PIECE: usize = 960;
/// Between two pieces: at most 48 KB a second.
const PAUSE: Duration = Duration::from_millis(20);
/// As boards publish it, without their build id: the position of the first byte in the log, and bytes of the log.
const STREAM: &str = "log(at: int, piece: bytes[960])";

/// The log of this program for `cara logs`: of an s_unit as a stream ([`add_log`](MyFunctionList::add_log)), of an m_unit at its
/// control socket (`CommunicationSystem::show_log`).
///
/// The newest 16 KiB wait until a subscriber takes them, in pieces, behind everything else that the link sends; the lines before
/// are lost, and the reader sees how many bytes. Writing never waits for the link. A write of more than 4 KiB is cut off.
///
/// With `tracing-subscriber` it is a writer. Leave lines of the level `TRACE` out: sending a piece writes some.
///
/// ```no_run
/// use cara_std::{Log, Unit};
///
/// let log = Log::default();
/// // fmt().with_ansi(false).with_writer({ let log = log.clone(); move || log.clone() }).init();
/// let agv = Unit::new("agv", 7, "depot", 1)?;
/// agv.my_function_list().add_log(&log)?;
/// agv.publish_my_function_list()?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Default)]
pub struct Log(Arc<Shared>);

impl fmt::Debug for Log {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Log").finish_non_exhaustive()
    }
}

#[derive(Default)]
struct Shared {
    kept: Mutex<Kept>,
    changed: Condvar,
}

#[derive(Default)]
struct Kept {
    /// The position of the first byte in the log; it wraps.
    at: u32,
    bytes: VecDeque<u8>,
    /// A piece was published, and no link has taken it.
    waits: bool,
}

impl Kept {
    fn write(&mut self, text: &[u8]) {
        match text.get(..LONGEST) {
            Some(begin) if text.len() > LONGEST => self.bytes.extend(begin.iter().chain(CUT)),
            _ => self.bytes.extend(text),
        }
        let too_many = self.bytes.len().saturating_sub(KEPT);
        if too_many > 0 {
            // Up to the end of a line, so that no half of one is shown.
            let rest = self.bytes.iter().skip(too_many - 1).position(|byte| *byte == b'\n');
            self.take(rest.map_or(too_many, |rest| too_many + rest));
        }
    }

    fn take(&mut self, bytes: usize) -> (u32, Vec<u8>) {
        let at = self.at;
        self.at = at.wrapping_add(bytes as u32);
        (at, self.bytes.drain(..bytes).collect())
    }

    /// The piece behind a position, and where it begins: with the oldest byte that is kept if those before are lost or not `seen`.
    #[cfg(feature = "control")]
    fn after(&self, seen: Option<u32>) -> Option<(u32, Vec<u8>)> {
        let ahead = seen.map_or(0, |seen| seen.wrapping_sub(self.at) as usize);
        let from = if ahead <= self.bytes.len() { ahead } else { 0 };
        let piece: Vec<u8> = self.bytes.range(from..).take(PIECE).copied().collect();
        (!piece.is_empty()).then(|| (self.at.wrapping_add(from as u32), piece))
    }

    /// The next piece and its position, unless the one before waits.
    fn piece(&mut self) -> Option<(u32, Vec<u8>)> {
        if self.waits || self.bytes.is_empty() {
            return None;
        }
        self.waits = true;
        Some(self.take(self.bytes.len().min(PIECE)))
    }
}

impl Shared {
    /// It is held for a copy at most, and what holds it writes no log.
    fn lock(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn taken(&self) {
        self.lock().waits = false;
        self.changed.notify_all();
    }
}

/// Of an m_unit, whose operators each read as far as they are.
#[cfg(feature = "control")]
impl Log {
    /// The signature of a piece.
    pub(crate) fn definition() -> Result<Definition, Error> {
        Definition::stream(STREAM).map_err(|_| Error::BadName)
    }

    /// As values, the piece behind a position, and where the next one begins. Nothing is taken from other readers.
    pub(crate) fn after(&self, seen: Option<u32>) -> Option<(Box<ParametersView>, u32)> {
        let (at, piece) = self.0.lock().after(seen)?;
        Some((values(at, &piece).ok()?, at.wrapping_add(piece.len() as u32)))
    }
}

impl io::Write for Log {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        self.0.lock().write(text);
        self.0.changed.notify_all();
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<T: Send + 'static> MyFunctionList<'_, T> {
    /// Adds the stream `log`, which `cara logs` shows at the units to which the list is published. A log is of one unit.
    ///
    /// What [`add_service`](Self::add_service) refuses; [`Error::Network`] when the system refuses a thread.
    pub fn add_log(&self, log: &Log) -> Result<(), Error> {
        let definition = Definition::stream(STREAM).map_err(|_| Error::BadName)?;
        // The log may outlive the unit.
        let (shared, of_link, engine) = (log.0.clone(), Arc::downgrade(&log.0), Arc::downgrade(self.engine));
        let (start, started) = channel();
        let run = move || started.recv().map_or((), |stream| publish_all(&shared, &stream, &engine));
        std::thread::Builder::new().name("cara-log".into()).spawn(run).map_err(system_refused)?;
        let own = self.add_stream(&definition, PAUSE)?.own;
        own.on_taken(move || of_link.upgrade().iter().for_each(|shared| shared.taken()));
        // The thread is there.
        let _ = start.send((definition, Arc::downgrade(&own)));
        Ok(())
    }
}

/// Publishes each piece when the one before was taken, until something is written after the end of the unit.
fn publish_all<T: Send + 'static>(
    shared: &Shared,
    (definition, own): &(Definition, Weak<OwnStream>),
    engine: &Weak<Engine<T>>,
) {
    loop {
        let mut kept = shared.lock();
        let (at, piece) = loop {
            match kept.piece() {
                Some(piece) => break piece,
                None => kept = shared.changed.wait(kept).unwrap_or_else(PoisonError::into_inner),
            }
        };
        drop(kept);
        let Some((engine, own)) = engine.upgrade().zip(own.upgrade()) else { return };
        // Fails for no piece: it fits what the stream declares.
        let published = values(at, &piece).and_then(|values| {
            own.put(|newest| newest.publish(engine.now(), Duration::ZERO, definition.signature(), &values))
        });
        if published.is_ok() {
            engine.stream_published();
        }
    }
}

fn values(at: u32, piece: &[u8]) -> Result<Box<ParametersView>, Error> {
    let mut values = arena(PIECE);
    values.add_int("at", 1)?;
    values.set_value("at", i64::from(at))?;
    values.add_bytes("piece", PIECE as u32)?;
    values.set_value("piece", piece)?;
    Ok(values)
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use cara_core::config::Constraints;
    use cara_core::distribution::block;

    use super::*;

    fn piece(log: &Log) -> Option<(u32, Vec<u8>)> {
        log.0.lock().piece()
    }

    #[test]
    fn a_piece_follows_when_the_one_before_was_taken_and_what_is_lost_are_whole_lines() {
        let mut log = Log::default();
        log.write_all(b"one\n").unwrap();
        assert_eq!(piece(&log), Some((0, b"one\n".to_vec())));
        log.write_all(b"two\n").unwrap();
        assert_eq!(piece(&log), None, "one waits");
        log.0.taken();
        assert_eq!(piece(&log), Some((4, b"two\n".to_vec())));
        for number in 0..KEPT / 8 + 10 {
            writeln!(log, "{number:08}").unwrap();
        }
        log.0.taken();
        let (at, first) = piece(&log).unwrap();
        let line = (at - 8) / 9;
        assert!(at > 8 && first.starts_with(format!("{line:08}\n").as_bytes()), "{at} {first:?}");
        assert_eq!(first.len(), PIECE);
    }

    #[test]
    fn a_long_line_is_cut_off_and_one_without_an_end_stays_within_what_is_kept() {
        let mut log = Log::default();
        log.write_all(&[b'x'; 2 * LONGEST]).unwrap();
        let kept = log.0.lock().bytes.clone();
        assert!(kept.len() == LONGEST + CUT.len() && kept.into_iter().skip(LONGEST).eq(CUT.iter().copied()));
        (0..100).for_each(|_| log.write_all(&[b'x'; 1000]).unwrap());
        assert!(log.0.lock().bytes.len() <= KEPT);
    }

    #[cfg(feature = "control")]
    #[test]
    fn each_operator_reads_as_far_as_it_is_and_one_that_is_late_goes_on_with_what_is_kept() {
        let mut log = Log::default();
        let after = |log: &Log, seen| log.0.lock().after(seen);
        assert_eq!(after(&log, None), None);
        log.write_all(b"one\n").unwrap();
        assert_eq!(after(&log, None), Some((0, b"one\n".to_vec())));
        assert_eq!((after(&log, Some(4)), after(&log, Some(2))), (None, Some((2, b"e\n".to_vec()))));
        (0..KEPT / 8).for_each(|number| writeln!(log, "{number:08}").unwrap());
        let (at, piece) = after(&log, Some(4)).unwrap();
        let line = (at - 4) / 9;
        assert!(at > 4 && piece.starts_with(format!("{line:08}\n").as_bytes()) && piece.len() == PIECE, "{at}");
        assert_eq!(after(&log, Some(at + PIECE as u32)).unwrap().0, at + PIECE as u32);
    }

    #[test]
    fn a_piece_fits_what_a_peer_with_short_messages_takes() {
        let definition = Definition::stream(STREAM).unwrap();
        let results = || definition.signature().results();
        let length = block::measure(results(), &values(u32::MAX, &[7; PIECE]).unwrap()).unwrap();
        assert!(length <= block::longest(results()).unwrap() && length <= Constraints::S_UNIT.message_size as usize);
    }
}
