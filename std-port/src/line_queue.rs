//! Lines for a file, a terminal or a pipe, written by a thread of their own.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, channel, sync_channel};
use std::time::{Duration, Instant};

/// Most lines that wait to be written: at 1 KiB a line, 1 MiB.
const CAPACITY: usize = 1024;
/// Between two tries of a flush to get into a full queue.
const PAUSE: Duration = Duration::from_millis(5);

/// A bounded queue in front of something that may hang, such as a log on a disk that does not answer, or a terminal that
/// is held with Ctrl-S. [`write`](Self::write) never waits: a full queue drops the line and counts it. So a thread that
/// renews, watches or stops something can log.
///
/// ```
/// use std::io::Write;
/// use cara_std::LineQueue;
///
/// let log = LineQueue::new("log", |line, _lost| std::io::stderr().write_all(line))?;
/// log.write(b"joined\n");
/// assert!(log.flush(std::time::Duration::from_secs(1)) && log.lost() == 0);
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// With `tracing-subscriber` it is a writer: `fmt().with_writer(move || log.clone())`.
#[derive(Clone, Debug)]
pub struct LineQueue {
    lines: SyncSender<Line>,
    lost: Arc<AtomicU64>,
}

enum Line {
    Text(Vec<u8>),
    /// Everything before it has been written.
    Flushed(std::sync::mpsc::Sender<()>),
}

impl LineQueue {
    /// Starts the thread that hands each line to `write`, with how many have been [`lost`](Self::lost) so far. It ends with
    /// the last clone of the queue.
    pub fn new(name: &str, write: impl FnMut(&[u8], u64) -> io::Result<()> + Send + 'static) -> io::Result<Self> {
        let (lines, queued) = sync_channel(CAPACITY);
        let lost = Arc::<AtomicU64>::default();
        let counted = lost.clone();
        std::thread::Builder::new().name(name.to_owned()).spawn(move || write_all(&queued, &counted, write))?;
        Ok(Self { lines, lost })
    }

    /// Queues a line; never waits.
    pub fn write(&self, line: &[u8]) {
        if self.lines.try_send(Line::Text(line.to_vec())).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Lines that the full queue dropped, or that could not be written.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Waits until all earlier lines have been written, at most for `at_most`; whether they have. For the end of a program.
    pub fn flush(&self, at_most: Duration) -> bool {
        let end = Instant::now() + at_most;
        let (flushed, is_flushed) = channel();
        let mut mark = Line::Flushed(flushed);
        while let Err(TrySendError::Full(back)) = self.lines.try_send(mark) {
            if Instant::now() >= end {
                return false;
            }
            mark = back;
            std::thread::sleep(PAUSE);
        }
        is_flushed.recv_timeout(end.saturating_duration_since(Instant::now())).is_ok()
    }
}

impl io::Write for LineQueue {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        Self::write(self, line);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn write_all(queued: &Receiver<Line>, lost: &AtomicU64, mut write: impl FnMut(&[u8], u64) -> io::Result<()>) {
    for line in queued {
        match line {
            Line::Text(text) => {
                if write(&text, lost.load(Ordering::Relaxed)).is_err() {
                    lost.fetch_add(1, Ordering::Relaxed);
                }
            }
            // The flush may have given up.
            Line::Flushed(flushed) => drop(flushed.send(())),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::testing::until;

    const LONG: Duration = Duration::from_secs(20);

    #[test]
    fn lines_are_written_in_order_and_those_that_cannot_be_are_counted() {
        let written = Arc::<Mutex<Vec<u8>>>::default();
        let to = written.clone();
        let queue = LineQueue::new("test", move |line, _| match line {
            b"bad" => Err(io::ErrorKind::StorageFull.into()),
            line => {
                to.lock().unwrap().extend_from_slice(line);
                Ok(())
            }
        });
        let queue = queue.unwrap();
        for line in [&b"one "[..], b"bad", b"two"] {
            queue.write(line);
        }
        assert!(queue.flush(LONG));
        assert_eq!((written.lock().unwrap().as_slice(), queue.lost()), (&b"one two"[..], 1));
    }

    #[test]
    fn a_writer_that_hangs_holds_nothing_up_and_what_does_not_fit_is_counted() {
        let (go_on, hangs) = sync_channel::<()>(0);
        let queue = LineQueue::new("test", move |_, _| {
            let _ = hangs.recv();
            Ok(())
        });
        let queue = queue.unwrap();
        // The thread takes the first line and hangs with it; the queue holds as many as it may, and one is too many.
        for _ in 0..CAPACITY + 2 {
            queue.write(b"line");
        }
        until(|| {
            queue.write(b"line");
            queue.lost() > 0
        });
        assert!(!queue.flush(Duration::from_millis(20)), "nothing of it is written");
        let lost = queue.lost();
        drop(go_on);
        assert!(queue.flush(LONG));
        assert_eq!(queue.lost(), lost);
    }
}
