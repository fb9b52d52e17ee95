//! One link as the threads share it: the session under its lock, who waits for what, and who reads.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, TryLockError};
use std::task::Waker;
use std::thread::Thread;

use cara_core::distribution::function_list::Slot;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::services::Port;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::requests::CallId;
use cara_core::services::unit::Session;
use cara_core::time::{Duration, Instant};
use cara_secure::link::Cipher;
use core::net::SocketAddr;

use super::Registration;
use super::peers::PeerCell;
use super::reader::Reader;
use crate::storage::Boxed;
use crate::sys::datagram::Datagrams;
use crate::sys::stream::Stream;
use crate::threads;

/// Linux, as the core's port.
pub(crate) enum Linux {}

impl Port for Linux {
    type Storage = Boxed;
    type Cipher = Cipher;
}

/// Calls that leave no room for more hold up what follows them for so long after the last one has ended.
const STALLED: Duration = Duration::from_millis(20);

/// Bytes of sealed frames that wait for a stream at a time: three messages of 20,000 characters go out with one system
/// call. An emergency that is behind them in the stream has gone out as a datagram as well.
const SEALED_AHEAD: usize = 64 * 1024;

/// One link of the unit.
pub(crate) struct LinkCell {
    /// The unit's number among those that its threads drive.
    seat: u16,
    pub(crate) id: LinkId,
    /// Tells this link from an earlier one with the same id.
    pub(crate) serial: u32,
    pub(crate) stream: Stream,
    pub(crate) peer: OnceLock<Arc<PeerCell>>,
    /// The peer has told what it offers.
    introduced: AtomicBool,
    state: Mutex<LinkState>,
    /// The stream took bytes, or the link ended.
    pub(crate) room: Condvar,
}

/// What the lock of a link protects.
pub(crate) struct LinkState {
    pub(crate) session: Session<Linux>,
    pub(crate) waiters: Vec<Waiter>,
    pub(crate) reader: Reader,
    /// The last handler that ran for this link was quick.
    pub(crate) quick: bool,
    /// The peer has called here.
    pub(crate) is_called: bool,
    /// The pool's count of calls when it last served this link.
    pub(crate) served: usize,
    /// When it did.
    pub(crate) served_at: Option<Instant>,
    /// When a caller last had its reply.
    pub(crate) replied_at: Option<Instant>,
    /// It is among the links that the clock looks at because they are left to a caller.
    pub(crate) kept: bool,
    /// What the epoll set watches the stream for.
    pub(crate) registration: Registration,
    /// It is not in the epoll set, for as long as it is watched for nothing.
    pub(crate) is_out: bool,
    /// The connection is still being opened.
    pub(crate) connecting: bool,
    /// Bytes that were read and cannot be looked at yet, behind those that were.
    pub(crate) leftover: Vec<u8>,
    pub(crate) leftover_at: usize,
    /// When a call last ended, or there was no room for more of them.
    pub(crate) moved_at: Instant,
    /// The timer that is set for the session.
    pub(crate) timer: Instant,
    /// Somebody waits for the answer to a ping.
    pub(crate) pinging: bool,
    /// What it has counted is among the sums of links that have ended.
    pub(crate) retired: bool,
    /// What is to be done when the lock is given up.
    pub(crate) notices: Vec<Notice>,
    /// A thread acts on earlier ones.
    pub(crate) telling: bool,
}

/// Somebody who waits for a reply.
pub(crate) struct Waiter {
    pub(crate) id: CallId,
    pub(crate) wake: Wake,
    pub(crate) outcome: Option<Outcome>,
}

impl Waiter {
    pub(crate) fn finish(&mut self, outcome: Outcome) {
        self.outcome = Some(outcome);
        self.wake.wake();
    }
}

/// How to wake somebody.
pub(crate) enum Wake {
    Thread(Thread),
    Task(Option<Waker>),
}

/// How a call ended: the signature and the block of its results, or why there are none.
pub(crate) type Outcome = Result<(Box<[u8]>, Box<[u8]>), Error>;

/// What happened under a link's lock and is acted upon without it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Notice {
    /// Its safe hook has been told.
    LeaseExpired(Slot),
    LeaseEnded {
        call: CallId,
        slot: Slot,
        why: LeaseEnd,
    },
    Failed(CallId, Error),
    ListChanged,
    Acknowledged {
        serial: u32,
        skipped: u16,
    },
    Joined,
    Answered,
    Left(CloseReason),
}

impl LinkCell {
    pub(crate) fn new(
        seat: u16,
        id: LinkId,
        serial: u32,
        stream: Stream,
        session: Session<Linux>,
        connecting: bool,
    ) -> Self {
        let state = LinkState {
            session,
            waiters: Vec::new(),
            reader: Reader::default(),
            quick: false,
            is_called: false,
            served: 0,
            served_at: None,
            replied_at: None,
            kept: false,
            registration: Registration { readable: true, writable: connecting },
            is_out: false,
            connecting,
            leftover: Vec::new(),
            leftover_at: 0,
            moved_at: Instant::START,
            timer: Instant::FAR_FUTURE,
            pinging: false,
            retired: false,
            notices: Vec::new(),
            telling: false,
        };
        Self {
            seat,
            id,
            serial,
            stream,
            peer: OnceLock::new(),
            introduced: AtomicBool::new(false),
            state: Mutex::new(state),
            room: Condvar::new(),
        }
    }

    /// The peer has told what it offers.
    pub(crate) fn introduce(&self) {
        self.introduced.store(true, Ordering::Release);
    }

    /// Whether the peer has told what it offers.
    pub(crate) fn is_introduced(&self) -> bool {
        self.introduced.load(Ordering::Acquire)
    }

    /// The epoll token: unit, id and serial, so that an event of an earlier link with the same id is known.
    pub(crate) fn token(&self) -> u64 {
        threads::token(self.seat, u64::from(self.serial) << 16 | u64::from(self.id.0))
    }

    /// Handlers run outside of this lock, and no code under it leaves the state half changed.
    pub(crate) fn lock(&self) -> MutexGuard<'_, LinkState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The state, unless somebody has it now.
    pub(crate) fn try_lock(&self) -> Option<MutexGuard<'_, LinkState>> {
        match self.state.try_lock() {
            Ok(state) => Some(state),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        }
    }
}

impl LinkState {
    /// What was read cannot be looked at yet: nothing more is read meanwhile, so that the peer feels it.
    pub(crate) fn is_paused(&self) -> bool {
        self.leftover_at < self.leftover.len()
    }

    /// Whether to look no further at what was read, because the calls that wait leave no room for more: they run, and
    /// what follows stays where it is, so that the peer feels it. Replies may be among what follows, so it is looked at
    /// where somebody waits for one, and requests that find no room are refused.
    pub(crate) fn holds_back(&self) -> bool {
        self.waiters.is_empty() && self.session.is_live() && !self.session.has_call_room()
    }

    /// The calls that leave no room do not get on: what follows them is to be looked at.
    pub(crate) fn is_stalled(&self, now: Instant) -> bool {
        self.is_paused() && now >= self.moved_at + STALLED
    }

    /// Notes how a call ended and wakes who waits for it.
    pub(crate) fn finish(&mut self, id: CallId, outcome: Outcome) {
        if let Some(waiter) = self.waiters.iter_mut().find(|waiter| waiter.id == id) {
            waiter.finish(outcome);
        }
    }

    /// Takes out how a call ended, if it has.
    pub(crate) fn take_outcome(&mut self, id: CallId) -> Option<Outcome> {
        let index = self.waiters.iter().position(|waiter| waiter.id == id)?;
        self.waiters.get(index)?.outcome.as_ref()?;
        self.waiters.swap_remove(index).outcome
    }

    /// Nobody waits for a call any more.
    pub(crate) fn forget(&mut self, id: CallId) {
        self.waiters.retain(|waiter| waiter.id != id);
    }
}

impl Wake {
    pub(crate) fn wake(&mut self) {
        match self {
            Self::Thread(thread) => thread.unpark(),
            Self::Task(waker) => {
                if let Some(waker) = waker.take() {
                    waker.wake();
                }
            }
        }
    }
}

/// The port's `Mailman`, lent to the core for one call on one link, or for the node without a link.
pub(crate) struct StdMailman<'a> {
    pub(crate) stream: Option<&'a Stream>,
    pub(crate) datagrams: &'a Datagrams,
}

impl Mailman for StdMailman<'_> {
    fn write(&mut self, _link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.stream.map_or(Ok(0), |stream| stream.send(slices))
    }

    fn seals_ahead(&self) -> usize {
        SEALED_AHEAD
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.datagrams.send_to(to, datagram)
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.datagrams.broadcast(datagram)
    }
}
