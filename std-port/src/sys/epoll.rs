//! Readiness: one epoll set in which several threads may wait, and the eventfd that wakes one of them.

use std::fmt;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use cara_core::time::Duration;
use rustix::event::epoll::{self, CreateFlags, Event, EventData, EventFlags};
use rustix::event::{EventfdFlags, PollFd, PollFlags, eventfd, poll};
use rustix::io::{Errno, read, write};

use super::timespec;

/// What a descriptor is watched for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interest {
    /// Bytes, connections or the peer's end of stream to read.
    pub readable: bool,
    /// Room to write, or the end of a connect in progress.
    pub writable: bool,
    /// When the set reports it.
    pub trigger: Trigger,
}

/// When the set reports that a descriptor is ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trigger {
    /// At each wait, as long as it is ready.
    Level,
    /// When something new arrives; what is left unread is not reported again.
    Edge,
    /// Once; then never until [`Epoll::modify`] arms it again.
    OneShot,
}

impl Interest {
    /// Readable at each wait: for listeners, datagram sockets and wakers.
    pub const READ_LEVEL: Self = Self { readable: true, writable: false, trigger: Trigger::Level };
    /// Readable when something new arrives: for links that are drained until would-block.
    pub const READ_EDGE: Self = Self { readable: true, writable: false, trigger: Trigger::Edge };
    /// Readable once: for links whose reader arms them again.
    pub const READ_ONCE: Self = Self { readable: true, writable: false, trigger: Trigger::OneShot };
    /// Writable once: for a connect in progress.
    pub const WRITE_ONCE: Self = Self { readable: false, writable: true, trigger: Trigger::OneShot };

    /// The same, and writable as well.
    pub(crate) const fn and_writable(self) -> Self {
        Self { writable: true, ..self }
    }

    fn flags(self) -> EventFlags {
        let mut flags = EventFlags::empty();
        flags.set(EventFlags::IN | EventFlags::RDHUP, self.readable);
        flags.set(EventFlags::OUT, self.writable);
        match self.trigger {
            Trigger::Level => {}
            Trigger::Edge => flags |= EventFlags::ET,
            Trigger::OneShot => flags |= EventFlags::ONESHOT,
        }
        flags
    }
}

/// One descriptor that is ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ready {
    /// The token that the descriptor was added with.
    pub token: u64,
    /// There is something to read, the end of the stream and errors included.
    pub readable: bool,
    /// There is room to write, or a connect has ended.
    pub writable: bool,
    /// The peer or the network closed the stream; what was received before can still be read.
    pub hung_up: bool,
}

impl From<&Event> for Ready {
    fn from(event: &Event) -> Self {
        let (flags, data) = (event.flags, event.data);
        let failed = flags.intersects(EventFlags::ERR | EventFlags::HUP);
        Self {
            token: data.u64(),
            readable: failed || flags.intersects(EventFlags::IN | EventFlags::RDHUP),
            writable: failed || flags.intersects(EventFlags::OUT),
            hung_up: failed || flags.intersects(EventFlags::RDHUP),
        }
    }
}

/// The buffer that a waiting thread keeps from wait to wait.
pub struct Events {
    raw: Box<[Event]>,
    count: usize,
}

impl Events {
    /// Room for `capacity` descriptors per wait, at least one.
    pub fn new(capacity: usize) -> Self {
        let empty = Event { flags: EventFlags::empty(), data: EventData::new_u64(0) };
        Self { raw: vec![empty; capacity.max(1)].into_boxed_slice(), count: 0 }
    }

    /// What the last wait found.
    pub fn iter(&self) -> impl Iterator<Item = Ready> + '_ {
        self.raw.iter().take(self.count).map(Ready::from)
    }

    /// Whether the last wait found nothing.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }
}

impl fmt::Debug for Events {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}

/// A set of descriptors, each with a token, in which any number of threads may wait.
///
/// A descriptor leaves the set when its last owner closes it; [`Epoll::remove`] is for those that live on.
#[derive(Debug)]
pub struct Epoll {
    set: OwnedFd,
}

/// Below this, the kernel's milliseconds are too coarse, and the wait is made with a finer call.
const COARSE: Duration = Duration::from_millis(4);

impl Epoll {
    /// An empty set.
    pub fn new() -> io::Result<Self> {
        Ok(Self { set: epoll::create(CreateFlags::CLOEXEC)? })
    }

    /// Watches `fd`; its events carry `token`.
    pub fn add(&self, fd: impl AsFd, token: u64, interest: Interest) -> io::Result<()> {
        Ok(epoll::add(&self.set, fd, EventData::new_u64(token), interest.flags())?)
    }

    /// Watches `fd` for something else, arms a one-shot descriptor again, or re-reports an edge that is still there.
    pub fn modify(&self, fd: impl AsFd, token: u64, interest: Interest) -> io::Result<()> {
        Ok(epoll::modify(&self.set, fd, EventData::new_u64(token), interest.flags())?)
    }

    /// Takes `fd` out of the set; one that is not in it is fine.
    pub fn remove(&self, fd: impl AsFd) -> io::Result<()> {
        match epoll::delete(&self.set, fd) {
            Ok(()) | Err(Errno::NOENT) => Ok(()),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Waits until something is ready or `timeout` has passed (`None`: for as long as it takes), and fills `events`.
    ///
    /// A signal ends the wait early with no events. Never returns before a time-out of its own by more than its
    /// rounding; time-outs below 4 ms are kept to some 50 µs, longer ones to a millisecond.
    pub fn wait(&self, events: &mut Events, timeout: Option<Duration>) -> io::Result<()> {
        events.count = 0;
        let timeout = match timeout {
            Some(short) if short > Duration::ZERO && short < COARSE => {
                if !wait_readable(self.set.as_fd(), short)? {
                    return Ok(());
                }
                Some(Duration::ZERO)
            }
            other => other,
        };
        // More than this many milliseconds do not fit the kernel's argument.
        let timeout = timeout.map(|span| timespec(span.min(Duration::from_secs(86_400))));
        match epoll::wait(&self.set, &mut *events.raw, timeout.as_ref()) {
            Ok(count) => events.count = count,
            Err(Errno::INTR) => {}
            Err(errno) => return Err(errno.into()),
        }
        Ok(())
    }
}

/// Waits until `fd` can be read, with a resolution of microseconds; `false` after `timeout` or a signal.
pub(crate) fn wait_readable(fd: BorrowedFd<'_>, timeout: Duration) -> io::Result<bool> {
    let mut fds = [PollFd::from_borrowed_fd(fd, PollFlags::IN | PollFlags::RDHUP)];
    match poll(&mut fds, Some(&timespec(timeout))) {
        Ok(count) => Ok(count > 0),
        Err(Errno::INTR) => Ok(false),
        Err(errno) => Err(errno.into()),
    }
}

/// Wakes a thread that waits in an [`Epoll`] set; any thread may call it, at any time, any number of times.
#[derive(Debug)]
pub struct Waker {
    counter: OwnedFd,
}

impl Waker {
    /// A waker that belongs to no set yet; add it with [`Interest::READ_LEVEL`] or [`Interest::READ_EDGE`].
    pub fn new() -> io::Result<Self> {
        Ok(Self { counter: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)? })
    }

    /// Makes the waker readable: level-triggered, until [`reset`](Self::reset); edge-triggered, for one thread.
    pub fn wake(&self) {
        // A full counter means that the waker is readable already; nothing else can fail here.
        let _ = write(&self.counter, &1u64.to_ne_bytes());
    }

    /// Makes the waker unreadable again; whether it was readable.
    pub fn reset(&self) -> bool {
        let mut count = [0u8; 8];
        read(&self.counter, &mut count).is_ok()
    }
}

impl AsFd for Waker {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.counter.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::os::unix::net::UnixStream;
    use std::time::Instant;

    use super::*;

    const LIMIT: Option<Duration> = Some(Duration::from_secs(30));
    const NOW: Option<Duration> = Some(Duration::ZERO);

    fn ready(set: &Epoll, timeout: Option<Duration>) -> Vec<Ready> {
        let mut events = Events::new(8);
        set.wait(&mut events, timeout).unwrap();
        events.iter().collect()
    }

    #[test]
    fn a_level_is_reported_until_it_is_read_and_an_edge_once() {
        let set = Epoll::new().unwrap();
        let (mut near, mut far) = UnixStream::pair().unwrap();
        set.add(&near, 7, Interest::READ_LEVEL).unwrap();
        assert!(ready(&set, NOW).is_empty());
        far.write_all(b"x").unwrap();
        let expected = Ready { token: 7, readable: true, writable: false, hung_up: false };
        assert_eq!(ready(&set, LIMIT), [expected]);
        assert_eq!(ready(&set, LIMIT), [expected]);

        set.modify(&near, 8, Interest::READ_EDGE).unwrap();
        assert_eq!(ready(&set, LIMIT), [Ready { token: 8, ..expected }]);
        assert!(ready(&set, NOW).is_empty(), "an edge is reported once");
        far.write_all(b"y").unwrap();
        assert_eq!(ready(&set, LIMIT).len(), 1, "a new edge is reported");
        near.read_exact(&mut [0; 2]).unwrap();
    }

    #[test]
    fn a_one_shot_is_silent_until_it_is_armed_again() {
        let set = Epoll::new().unwrap();
        let (near, mut far) = UnixStream::pair().unwrap();
        set.add(&near, 1, Interest::READ_ONCE).unwrap();
        far.write_all(b"x").unwrap();
        assert_eq!(ready(&set, LIMIT).len(), 1);
        far.write_all(b"x").unwrap();
        assert!(ready(&set, NOW).is_empty());
        set.modify(&near, 1, Interest::READ_ONCE).unwrap();
        assert_eq!(ready(&set, LIMIT).len(), 1);
    }

    #[test]
    fn room_and_hang_up_are_told_apart() {
        let set = Epoll::new().unwrap();
        let (near, far) = UnixStream::pair().unwrap();
        set.add(&near, 1, Interest::READ_LEVEL.and_writable()).unwrap();
        assert_eq!(ready(&set, LIMIT), [Ready { token: 1, readable: false, writable: true, hung_up: false }]);
        drop(far);
        let ended = ready(&set, LIMIT);
        assert!(ended.iter().all(|ready| ready.readable && ready.hung_up) && ended.len() == 1, "{ended:?}");
        set.remove(&near).unwrap();
        set.remove(&near).unwrap();
        assert!(ready(&set, NOW).is_empty());
    }

    #[test]
    fn a_waker_ends_the_wait_of_another_thread() {
        let set = Epoll::new().unwrap();
        let waker = Waker::new().unwrap();
        set.add(&waker, u64::MAX, Interest::READ_LEVEL).unwrap();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| ready(&set, LIMIT));
            waker.wake();
            assert_eq!(waiting.join().unwrap().first().map(|ready| ready.token), Some(u64::MAX));
        });
        waker.wake();
        assert!(waker.reset());
        assert!(!waker.reset());
        assert!(ready(&set, NOW).is_empty());
    }

    #[test]
    fn short_time_outs_are_kept_without_rounding_to_milliseconds() {
        let set = Epoll::new().unwrap();
        let span = Duration::from_micros(300);
        // On a busy machine most waits are longer, of so many not all.
        let is_kept = (0..5_000).any(|_| {
            let start = Instant::now();
            assert!(ready(&set, Some(span)).is_empty());
            let waited = Duration::from(start.elapsed());
            assert!(waited >= span, "{waited:?}");
            waited < Duration::from_micros(990)
        });
        assert!(is_kept);
    }
}
