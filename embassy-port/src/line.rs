//! A serial line without an IP stack at either end: one link and datagrams, over any UART that has embedded-io-async's `Read`
//! and `Write`. The page `docs/serial-native.md` has the whole recipe, with the other end.
//!
//! [`new`] makes the [`Line`], which [`cara_embassy::new`](crate::new) takes in place of a network stack, and the line's two
//! halves. Each half runs in a task of its own, on the executor of the unit's runner.
//!
//! A unit on a line has one link. Nothing tells it that the wire was pulled: keep-alives do, and the lease of whatever moves.

use core::cell::RefCell;
use core::fmt;
use core::future::poll_fn;
use core::mem::MaybeUninit;
use core::net::{Ipv4Addr, SocketAddrV4};
use core::pin::pin;
use core::task::{Context, Poll};

use cara_core::config::LINE_FRAME_BYTES;
use cara_core::error::CloseReason;
use cara_core::host::line::{self as host, State};
use cara_core::time::{Duration, Instant};
use embassy_sync::waitqueue::WakerRegistration;
use embedded_io_async::{Read, Write};

use crate::connection::{Progress, copy};
use crate::time::{now, timer};

pub use cara_core::host::line::Counters;

/// The address of the unit at the other end, as [`Config::manager_address`](crate::Config::manager_address) and
/// [`Peer::address`](crate::Peer::address) have it. It says nothing: a line has no addresses.
pub const PEER: Ipv4Addr = Ipv4Addr::new(169, 254, 0, 1);
/// This unit's own.
const OWN: Ipv4Addr = Ipv4Addr::new(169, 254, 0, 2);
/// Bytes read at a time.
const PIECE: usize = 32;
/// Pause after an error of the UART, so that a broken one does not keep the processor busy.
const AFTER_ERROR: Duration = Duration::from_millis(1);

/// The line's memory, about 4 KiB.
pub struct Memory(MaybeUninit<RefCell<Shared>>);

impl Memory {
    /// Without a line.
    pub const fn new() -> Self {
        Self(MaybeUninit::uninit())
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}

impl fmt::Debug for Memory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Memory").finish_non_exhaustive()
    }
}

/// A line of that rate, and its halves. `seed` should differ from boot to boot.
// Kept apart: merged into its caller, the line would lie on the stack while the unit is made.
#[inline(never)]
pub fn new(memory: &'static mut Memory, bits_per_second: u32, seed: u64) -> (Line, Incoming, Outgoing) {
    let (unit, incoming, outgoing) = (WakerRegistration::new(), WakerRegistration::new(), WakerRegistration::new());
    let line = host::Line::new(bits_per_second, seed);
    let line = Line(memory.0.write(RefCell::new(Shared { line, unit, incoming, outgoing })));
    (line, Incoming(line), Outgoing { line, bits_per_second })
}

/// What the unit and both halves work on, one at a time.
struct Shared {
    line: host::Line,
    unit: WakerRegistration,
    incoming: WakerRegistration,
    outgoing: WakerRegistration,
}

/// A serial line, for [`cara_embassy::new`](crate::new). Copies are the same line.
#[derive(Clone, Copy)]
pub struct Line(&'static RefCell<Shared>);

impl fmt::Debug for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.look(host::Line::state))
    }
}

impl Line {
    /// Frames that were damaged or sent again, and datagrams that were dropped.
    pub fn counters(&self) -> Counters {
        self.look(host::Line::counters)
    }

    fn look<R>(self, look: impl FnOnce(&host::Line) -> R) -> R {
        look(&self.0.borrow().line)
    }

    /// Does something after which there may be a frame to send.
    fn act<R>(self, act: impl FnOnce(&mut host::Line) -> R) -> R {
        let shared = &mut *self.0.borrow_mut();
        shared.outgoing.wake();
        act(&mut shared.line)
    }
}

/// The receiving half of the line.
#[derive(Debug)]
pub struct Incoming(Line);

impl Incoming {
    /// Reads, for ever. The UART's driver must buffer what comes until this task has its turn: 100 bytes are 9 ms at 115,200
    /// baud. What is lost is sent again.
    pub async fn run(self, mut uart: impl Read) -> ! {
        let mut piece = [0; PIECE];
        loop {
            match uart.read(&mut piece).await {
                Ok(length) if length > 0 => self.receive(piece.get(..length).unwrap_or_default()).await,
                _ => timer(now() + AFTER_ERROR).await,
            }
        }
    }

    async fn receive(&self, bytes: &[u8]) {
        let mut rest = bytes;
        while !rest.is_empty() {
            let consumed = {
                let shared = &mut *self.0.0.borrow_mut();
                // Nothing happens on the line before a frame ends.
                if rest.contains(&0) {
                    shared.unit.wake();
                    shared.outgoing.wake();
                }
                shared.line.receive(rest, now())
            };
            rest = rest.get(consumed..).unwrap_or_default();
            // The next datagram takes the place of this one.
            poll_fn(|cx| self.poll_taken(cx)).await;
        }
    }

    /// Waits until the unit has taken the datagram that has come.
    fn poll_taken(&self, context: &Context<'_>) -> Poll<()> {
        let shared = &mut *self.0.0.borrow_mut();
        if !shared.line.has_datagram() {
            return Poll::Ready(());
        }
        shared.incoming.register(context.waker());
        Poll::Pending
    }
}

/// The sending half of the line.
#[derive(Debug)]
pub struct Outgoing {
    line: Line,
    bits_per_second: u32,
}

impl Outgoing {
    /// Writes, for ever. A frame that the UART does not take is sent again.
    pub async fn run(self, mut uart: impl Write) -> ! {
        let mut buffer = [0; LINE_FRAME_BYTES];
        loop {
            let length = poll_fn(|cx| self.poll_frame(&mut buffer, cx)).await;
            let frame = buffer.get(..length).unwrap_or_default();
            // Some drivers take more than is on the wire, and an emergency cannot overtake what they have.
            let sent = now() + self.time_of(length);
            if uart.write_all(frame).await.is_err() || uart.flush().await.is_err() {
                timer(now() + AFTER_ERROR).await;
            }
            timer(sent).await;
        }
    }

    /// How long the wire takes for so many bytes of ten bits.
    fn time_of(&self, bytes: usize) -> Duration {
        let micros = (bytes as u64).saturating_mul(10_000_000).checked_div(self.bits_per_second.into());
        Duration::from_micros(micros.unwrap_or(0))
    }

    /// Waits for a frame to send; its length.
    fn poll_frame(&self, buffer: &mut [u8; LINE_FRAME_BYTES], context: &mut Context<'_>) -> Poll<usize> {
        let shared = &mut *self.line.0.borrow_mut();
        loop {
            let length = shared.line.transmit(now(), buffer).len();
            if matches!(shared.line.state(), State::Ended(_)) {
                shared.unit.wake();
            }
            if length > 0 {
                return Poll::Ready(length);
            }
            shared.outgoing.register(context.waker());
            if pin!(timer(shared.line.deadline())).poll(context).is_pending() {
                return Poll::Pending;
            }
        }
    }
}

/// The datagrams of a unit on a line.
pub(crate) struct Port {
    pub(crate) line: Line,
    /// Where they come to.
    pub(crate) port: u16,
}

impl Port {
    /// A line is always there.
    pub(crate) const fn address(&self) -> Option<Ipv4Addr> {
        Some(OWN)
    }

    pub(crate) const fn is_cut(&self) -> bool {
        false
    }

    pub(crate) const fn wake_on_change(&self, _: &mut Context<'_>) {}

    pub(crate) fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        self.line.act(|line| line.send_datagram(to.port(), self.port, datagram))
    }

    pub(crate) fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.line.act(|line| line.send_datagram(0, self.port, datagram))
    }

    /// Whatever comes wakes the task of the stream.
    pub(crate) fn receive(&mut self, into: &mut [u8], _: &Context<'_>) -> Option<Option<(usize, SocketAddrV4)>> {
        let shared = &mut *self.line.0.borrow_mut();
        let datagram = shared.line.next_datagram()?;
        shared.incoming.wake();
        let is_for_us = [0, self.port].contains(&datagram.to) && datagram.bytes.len() <= into.len();
        Some(is_for_us.then(|| (copy(datagram.bytes, into), SocketAddrV4::new(PEER, datagram.from))))
    }

    pub(crate) fn has_datagram(&self, _: &Context<'_>) -> bool {
        self.line.look(host::Line::has_datagram)
    }
}

/// What the unit does with the line's stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Doing {
    Nothing,
    Listening {
        port: u16,
    },
    Dialing,
    /// A link owns it.
    Open,
}

/// The line's stream.
pub(crate) struct Stream {
    line: Line,
    doing: Doing,
}

impl Stream {
    pub(crate) const fn new(line: Line) -> Self {
        Self { line, doing: Doing::Nothing }
    }

    fn state(&self) -> State {
        self.line.look(host::Line::state)
    }

    pub(crate) fn is_closing(&self) -> bool {
        self.state() == State::Closing
    }

    pub(crate) fn is_in_use(&self) -> bool {
        matches!(self.doing, Doing::Open | Doing::Dialing)
    }

    pub(crate) fn takes_connections(&self) -> bool {
        !self.is_in_use()
    }

    pub(crate) fn listen(&mut self, port: u16) {
        if !self.is_in_use() {
            self.doing = Doing::Listening { port };
        }
    }

    pub(crate) fn dial(&mut self, to: SocketAddrV4) -> bool {
        self.doing = Doing::Dialing;
        self.line.act(|line| {
            // Refuses a link that the other end offers.
            line.close(now());
            line.abort();
            line.dial(to.port())
        })
    }

    pub(crate) fn close(&mut self) {
        self.doing = Doing::Nothing;
        self.line.act(|line| line.close(now()));
    }

    pub(crate) fn abort(&mut self) {
        self.doing = Doing::Nothing;
        self.line.act(host::Line::abort);
    }

    pub(crate) fn progress(&mut self, now: Instant) -> Progress {
        match (self.doing, self.state()) {
            (Doing::Dialing, State::Open) => {
                self.doing = Doing::Open;
                Progress::Connected
            }
            (Doing::Dialing, State::Ended(_)) => {
                self.abort();
                Progress::Broken
            }
            (Doing::Listening { port }, State::Offered(offered)) if port == offered => {
                self.doing = Doing::Open;
                self.line.act(host::Line::accept);
                Progress::Accepted(SocketAddrV4::new(PEER, 0))
            }
            (Doing::Nothing | Doing::Listening { .. }, State::Offered(_) | State::Ended(_)) => {
                self.line.act(|line| line.close(now));
                Progress::None
            }
            _ => Progress::None,
        }
    }

    /// What happens on the line wakes the unit.
    pub(crate) const fn deadline(&self) -> Instant {
        Instant::FAR_FUTURE
    }

    pub(crate) fn write(&mut self, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        if self.state() != State::Open {
            return Err(CloseReason::Reset);
        }
        // What does not fit of a slice keeps all of the next one out.
        Ok(self.line.act(|line| slices.iter().map(|slice| line.write(slice)).sum()))
    }

    pub(crate) fn peek(&mut self, into: &mut [u8]) -> usize {
        copy(self.line.0.borrow_mut().line.peek(), into)
    }

    pub(crate) fn take(&mut self, count: usize) {
        if count > 0 {
            self.line.act(|line| line.take(count));
        }
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.doing == Doing::Open && self.state() != State::Open && self.is_empty()
    }

    pub(crate) fn has_been_read(&self) -> bool {
        self.is_empty() && !self.has_ended()
    }

    fn is_empty(&self) -> bool {
        self.line.0.borrow_mut().line.peek().is_empty()
    }

    pub(crate) fn can_write(&self) -> bool {
        self.line.look(host::Line::capacity) > 0
    }

    pub(crate) fn wake_on_news(&self, context: &Context<'_>, _: bool) {
        self.line.0.borrow_mut().unit.register(context.waker());
    }
}
