//! Leases: a motion goes on only while the caller renews it.
//!
//! [`Lease`] is what the application reads, from a motor's interrupt if it likes: a few atomic loads say whether the
//! motion may go on. It is dead again when nothing polls, so a busy or hung executor cannot keep a vehicle moving.
//!
//! A service has one lease, and each call that begins is an [`Order`] of it. The newest order holds the lease; an earlier
//! one stays dead for ever, whatever comes after it.

use core::num::NonZeroU32;
use core::sync::atomic::{AtomicBool, AtomicU8, AtomicU16, AtomicU32, Ordering};

use crate::config::Priority;
use crate::distribution::claim;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::latch::LatchWord;
pub(crate) use crate::distribution::latch::odd_millis;
pub use crate::distribution::message::{ActuatorState, LastOrder, Latch, LeaseEnd, OrderOutcome, trace_id};
use crate::error::{Error, ServiceError};
use crate::services::heart::Renew;
use crate::services::requests::CallId;
use crate::time::{Duration, Instant};

/// One call's hold of a service's [`Lease`]. Numbers rise, and repeat after 2^32 calls of one service.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Order(NonZeroU32);

impl Order {
    const fn number(self) -> u32 {
        self.0.get()
    }
}

/// On whose behalf an order begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Claim {
    /// The ID number of the caller.
    pub holder: u32,
    /// The caller's own order, which gives way.
    pub replaces: Option<Order>,
    /// The order of any other caller gives way as well.
    pub takes_over: bool,
    /// An operator of the caller's unit made it, and not its program: they hold for themselves.
    pub operator: bool,
    /// The caller's name for the link, as in [`LastOrder`].
    pub link: u32,
    /// The caller's id of the call.
    pub call: u32,
    /// What the caller commands with.
    pub under: claim::Claim,
    /// When it was made: an order that is older than a stop does not begin, whatever was reset since.
    pub made: Instant,
}

/// Longest ramp, in milliseconds.
const LONGEST_RAMP: u16 = 60_000;
/// A reader's clock may be so many milliseconds behind the unit's.
const NEWER: u32 = 10;

/// Says until when a leased service may act. Written by the unit, read anywhere. Services that share one move the same
/// thing: one order of all of them holds it.
///
/// A reader may be later than the unit, which renews the lease as of the time at which it began to look at a renewal: an
/// interrupt can fall between, and a thread can be held up there. So a lease that has been seen dead remembers it, and no
/// renewal revives it: only a new order does.
///
/// There is no compare-and-swap on the smallest boards. Each write is one store, and the stores come in an order in which
/// a reader that falls between two of them sees less than there is: dead where it might be live, never the reverse. Two
/// writers side by side would undo that: a renewal could revive what the other one has just ended. The unit writes by the
/// methods of [`Service`], which take turns.
#[derive(Debug, Default)]
pub struct Lease {
    /// The end in milliseconds of the port's clock, wrapping, with the lowest bit set; 0 when there is none.
    end: AtomicU32,
    /// A reader has been told that it has passed its end, or the unit has cut it: its safe hook is due.
    seen_dead: AtomicBool,
    /// An operator of `holder` made the order.
    operator: AtomicBool,
    /// The order that holds it, or held it last; 0 before the first.
    order: AtomicU32,
    /// The ID number of the one that made it.
    holder: AtomicU32,
    /// That one's name for the link.
    link: AtomicU32,
    /// That one's name for the call.
    call: AtomicU32,
    /// That one's claim: term and claimant, the lower halves first.
    claim: [AtomicU32; 4],
    /// How it ended, as the number of a [`LeaseEnd`].
    how: AtomicU8,
    /// While it is latched, no order begins.
    latch: LatchWord,
    /// How long what moves takes to stand still, in milliseconds.
    ramp: AtomicU16,
    /// When the last order was stopped, as `end` has its time; 0 where none was since the last one began.
    stopped: AtomicU32,
}

/// What may be done for an order, as of now: for a loop that moves what cannot stand still at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// What it wants.
    Live,
    /// Nothing but to slow down: it is over, and its [ramp](Lease::set_ramp) is not.
    Stopping,
    /// Nothing: power off.
    Dead,
}

/// The order that something was to be done for has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the order has ended: its caller no longer wants it, or it was stopped")]
pub struct Ended;

/// So that a service may use `?`: what it was asked for it does not do.
impl From<Ended> for ServiceError {
    fn from(Ended: Ended) -> Self {
        Self::NotReady
    }
}

impl Lease {
    /// A lease without an order.
    pub const fn new() -> Self {
        Self {
            end: AtomicU32::new(0),
            seen_dead: AtomicBool::new(false),
            operator: AtomicBool::new(false),
            order: AtomicU32::new(0),
            holder: AtomicU32::new(0),
            link: AtomicU32::new(0),
            call: AtomicU32::new(0),
            claim: [const { AtomicU32::new(0) }; 4],
            how: AtomicU8::new(0),
            latch: LatchWord::new(),
            ramp: AtomicU16::new(0),
            stopped: AtomicU32::new(0),
        }
    }

    /// Whether the service may act at `now`, which is no time to come, for whichever order holds the lease. Never later
    /// than what was granted: the end is rounded down. Once it has said no, it says so until the next order.
    pub fn is_live(&self, now: Instant) -> bool {
        if self.seen_dead.load(Ordering::Acquire) {
            return false;
        }
        let end = self.end.load(Ordering::Acquire);
        let live = is_before(now, end) && !self.is_inhibited();
        if end != 0 && !live {
            self.seen_dead.store(true, Ordering::Release);
        }
        live
    }

    /// So long an order is [stopping](Stage::Stopping) when it has ended in any other way than by being finished or replaced,
    /// and until then no other one begins ([`Error::Busy`]). To be set before the first order; at most a minute. The safe
    /// hook runs when the ramp begins, and what moves is to stand still when the loop that reads [`stage`](Self::stage) finds
    /// it dead: lease and ramp are the bound.
    pub fn set_ramp(&self, span: Duration) {
        self.ramp.store(span.as_millis().min(LONGEST_RAMP.into()) as u16, Ordering::Release);
    }

    /// As [`is_live`](Self::is_live), with what comes between live and dead.
    pub fn stage(&self, now: Instant) -> Stage {
        if self.is_live(now) {
            return Stage::Live;
        }
        let end = self.end.load(Ordering::Acquire);
        // The unit has not looked at it since: it was cut, or its time is over.
        let runs_out = end != 0 && (is_before(now, end) || self.is_on_ramp(now, end));
        let is_stopping =
            if self.stopped.load(Ordering::Acquire) == 0 { runs_out && self.has_ramp() } else { self.is_stopping(now) };
        if is_stopping { Stage::Stopping } else { Stage::Dead }
    }

    /// The same for one order; it is dead at once where a newer one holds the lease.
    pub fn stage_for(&self, order: Order, now: Instant) -> Stage {
        let stage = if self.is_held_by(order) { self.stage(now) } else { Stage::Dead };
        // As in `is_live_for`.
        if self.is_held_by(order) { stage } else { Stage::Dead }
    }

    fn has_ramp(&self) -> bool {
        self.ramp.load(Ordering::Acquire) != 0
    }

    /// Whether the ramp of an order that was ended is not over. Again for as long each 49 days, where no order has begun since.
    fn is_stopping(&self, now: Instant) -> bool {
        self.is_on_ramp(now, self.stopped.load(Ordering::Acquire))
    }

    fn is_on_ramp(&self, now: Instant, started: u32) -> bool {
        // A reader may have looked at the clock a little before the unit did.
        let since = ((now.as_micros() / 1_000) as u32).wrapping_sub(started).wrapping_add(NEWER);
        started != 0 && self.has_ramp() && since < u32::from(self.ramp.load(Ordering::Acquire)).saturating_add(NEWER)
    }

    /// The same for one order: once it is dead it stays so, also when another order holds the lease.
    pub fn is_live_for(&self, order: Order, now: Instant) -> bool {
        // A new order stores its number first and its end last. So the end read in between is this order's own if the
        // number is still the same behind it.
        self.is_held_by(order) && self.is_live(now) && self.is_held_by(order)
    }

    /// Whether `order` is the newest one, live or dead.
    pub(crate) fn is_held_by(&self, order: Order) -> bool {
        self.order.load(Ordering::Acquire) == order.number()
    }

    /// Whether it lasts beyond `at` as things are, for measurements: nothing is remembered, so `at` may be to come.
    pub fn lasts_beyond(&self, at: Instant) -> bool {
        let ended = self.seen_dead.load(Ordering::Acquire) || self.is_inhibited();
        !ended && is_before(at, self.end.load(Ordering::Acquire))
    }

    /// How long it still lasts as things are: zero once it has passed its end, `None` when nothing is granted. It is only
    /// looked at, as by [`Lease::lasts_beyond`].
    pub fn left(&self, now: Instant) -> Option<Duration> {
        let end = self.end.load(Ordering::Acquire);
        let (millis, rest) = (now.as_micros() / 1_000, now.as_micros() % 1_000);
        let left = i64::from(end.wrapping_sub(millis as u32) as i32).saturating_mul(1_000);
        let left = u64::try_from(left).unwrap_or(0).saturating_sub(rest);
        (end != 0).then(|| Duration::from_micros(left))
    }

    /// [`begin`](Self::begin) for this caller: [`Error::Held`] where another one holds it and is not taken over, be it the
    /// operator or the program of the same unit,
    /// [`Error::Busy`] where an earlier order is dead and its safe hook comes first, [`Error::Inhibited`] where it was stopped,
    /// [`Error::Expired`] where it was stopped after the call was made.
    pub fn claim(&self, now: Instant, end: Instant, claim: &Claim) -> Result<Order, Error> {
        if let Some(latch) = self.latch() {
            return Err(latch.into());
        }
        if !self.latch.is_behind_stop(now, claim.made) {
            return Err(Error::Expired);
        }
        let operator = self.operator.load(Ordering::Acquire);
        let is_own = operator == claim.operator && claim.replaces.is_some_and(|order| self.is_held_by(order));
        if !is_own && !claim.takes_over && self.is_live(now) {
            return Err(Error::Held { by: self.holder.load(Ordering::Acquire), operator });
        }
        let order = self.begin(now, end).ok_or(Error::Busy)?;
        self.holder.store(claim.holder, Ordering::Release);
        self.operator.store(claim.operator, Ordering::Release);
        self.link.store(claim.link, Ordering::Release);
        self.call.store(claim.call, Ordering::Release);
        let claim::Claim { term, claimant } = claim.under;
        for (word, value) in self.claim.iter().zip([term, term >> 32, claimant, claimant >> 32]) {
            word.store(value as u32, Ordering::Release);
        }
        Ok(order)
    }

    /// Lets the service act for a new order, until [`Lease::seen_end`] of `end`. `None` where an earlier order is dead and
    /// has not been ended: its safe hook comes first.
    pub fn begin(&self, now: Instant, end: Instant) -> Option<Order> {
        let runs = self.has_order();
        if runs && !self.is_live(now) || self.is_stopping(now) {
            return None;
        }
        self.stopped.store(0, Ordering::Release);
        let (before, end_before) = (self.order.load(Ordering::Acquire), self.end.load(Ordering::Acquire));
        let order = NonZeroU32::new(before.wrapping_add(1)).unwrap_or(NonZeroU32::MIN);
        self.order.store(order.get(), Ordering::Release);
        if !runs {
            self.seen_dead.store(false, Ordering::Release);
        }
        self.end.store(odd_millis(end) as u32, Ordering::Release);
        // The earlier order may have been seen dead in between, or all of them inhibited.
        if self.seen_dead.load(Ordering::Acquire) || self.is_inhibited() {
            self.order.store(before, Ordering::Release);
            self.end.store(end_before, Ordering::Release);
            return None;
        }
        Some(Order(order))
    }

    /// Lets the service go on until [`Lease::seen_end`] of `end`: `false` when the order has ended or been seen dead, and
    /// stays so.
    #[must_use]
    pub fn renew(&self, order: Order, end: Instant) -> bool {
        let ended = self.seen_dead.load(Ordering::Acquire) || self.is_inhibited() || !self.has_order();
        if ended || !self.is_held_by(order) {
            return false;
        }
        self.end.store(odd_millis(end) as u32, Ordering::Release);
        // It may have been seen in between.
        !self.seen_dead.load(Ordering::Acquire)
    }

    /// When a lease that is granted until `end` is seen to be dead: up to 2 ms earlier. The unit ends it at that moment
    /// too.
    pub fn seen_end(end: Instant) -> Instant {
        Instant::from_micros(odd_millis(end).saturating_mul(1_000))
    }

    /// Stops an order whose safe hook is due: no other one begins before [`Lease::end`].
    pub fn cut(&self, order: Order) {
        if self.is_held_by(order) {
            self.seen_dead.store(true, Ordering::Release);
        }
    }

    /// Stops whichever order holds it and lets none begin until [`reset`](Self::reset): a stop that a unit was sent, or the
    /// vehicle's own, as of a bumper; then `latch.by` is 0. May be called from an interrupt. The first latch stays when
    /// there is one, but with the time of the newest. The safe hook is due like that of an order that was [`cut`](Self::cut).
    pub fn inhibit(&self, now: Instant, latch: Latch) {
        self.latch.note(latch);
        self.stop_at(now, self.end.load(Ordering::Acquire));
        self.latch.close(now);
        self.seen_dead.store(true, Ordering::Release);
    }

    /// Takes a latch along: that of the service that this one's replaces, or of the unit that it is new in.
    pub(crate) fn inherit(&self, from: &LatchWord) {
        self.latch.inherit(from);
        if self.is_inhibited() {
            self.seen_dead.store(true, Ordering::Release);
        }
    }

    /// Its latch.
    pub(crate) const fn latch_word(&self) -> &LatchWord {
        &self.latch
    }

    /// Lets orders begin again, if it was inhibited before `made`, at which the reset was asked for: an earlier wish does not
    /// undo a later stop, nor one made within 3 ms of it.
    pub fn reset(&self, now: Instant, made: Instant) {
        self.latch.reset(now, made);
    }

    /// What inhibits it.
    pub fn latch(&self) -> Option<Latch> {
        self.latch.latch()
    }

    /// Whether no order may begin.
    pub fn is_inhibited(&self) -> bool {
        self.latch.is_inhibited()
    }

    /// Whether an order is dead and has not been ended: its safe hook comes before anything else.
    pub fn awaits_hook(&self) -> bool {
        self.seen_dead.load(Ordering::Acquire) && self.has_order()
    }

    /// Whether an order is dead and has not been ended: it was cut or inhibited, or a reader saw its time pass.
    pub(crate) fn is_cut(&self, order: Order) -> bool {
        self.seen_dead.load(Ordering::Acquire) && self.is_held_by(order)
    }

    /// The ramp begins, unless it has: at `now`, or when the order's time was over.
    fn stop_at(&self, now: Instant, end: u32) {
        if self.stopped.load(Ordering::Acquire) == 0 {
            let started = if is_before(now, end) { odd_millis(now) as u32 } else { end };
            self.stopped.store(started, Ordering::Release);
        }
    }

    /// Ends an order; `false` when a newer one holds the lease.
    pub fn end(&self, now: Instant, order: Order, how: LeaseEnd) -> bool {
        let held = self.is_held_by(order);
        if held {
            self.end_any(now, how);
        }
        held
    }

    /// Ends an order because what it has started is finished: no hook runs. `false` for one that is dead, which was not.
    pub fn finish(&self, now: Instant, order: Order) -> bool {
        self.is_live_for(order, now) && self.end(now, order, LeaseEnd::Finished)
    }

    fn end_any(&self, now: Instant, how: LeaseEnd) {
        if how == LeaseEnd::Finished {
            self.stopped.store(0, Ordering::Release);
        } else {
            self.stop_at(now, self.end.load(Ordering::Acquire));
        }
        self.how.store(how as u8, Ordering::Release);
        self.end.store(0, Ordering::Release);
    }

    /// The state of what it moves. What other threads write meanwhile may be in it in part: see [`Service::state`].
    pub fn state(&self) -> ActuatorState {
        let how = LeaseEnd::of(self.how.load(Ordering::Acquire).into());
        let end = if self.has_order() { None } else { Some(how) };
        let has_started = self.order.load(Ordering::Acquire) != 0;
        let last = has_started.then(|| LastOrder {
            holder: self.holder.load(Ordering::Acquire),
            link: self.link.load(Ordering::Acquire),
            call: self.call.load(Ordering::Acquire),
            claim: self.last_claim(),
            end,
        });
        ActuatorState { latch: self.latch(), last }
    }

    fn last_claim(&self) -> claim::Claim {
        let word = |word: &AtomicU32| u64::from(word.load(Ordering::Acquire));
        let [term, term_high, claimant, claimant_high] = self.claim.each_ref().map(word);
        claim::Claim { term: term | term_high << 32, claimant: claimant | claimant_high << 32 }
    }

    /// Differs when the [state](Self::state) does; 0 for one that nothing has happened to.
    pub(crate) fn changes(&self) -> u32 {
        let order = self.order.load(Ordering::Acquire);
        let latched = self.latch.changes();
        order.wrapping_mul(2).wrapping_add(self.has_order().into()) ^ latched.reverse_bits()
    }

    fn has_order(&self) -> bool {
        self.end.load(Ordering::Acquire) != 0
    }

    /// Ends whichever order holds it, as when the service is removed: whether there is one, whose safe hook is to run.
    pub fn clear(&self, now: Instant) -> bool {
        let has_order = self.has_order();
        if has_order {
            self.end_any(now, LeaseEnd::Expired);
        }
        has_order
    }
}

/// Whether a time comes before the end of a lease, if there is one.
const fn is_before(time: Instant, end: u32) -> bool {
    let time = (time.as_micros() / 1_000) as u32;
    // A lease is far shorter than half of the range, so the sign of the difference tells the order.
    end != 0 && (end.wrapping_sub(time) as i32) > 0
}

/// What the core asks of a port's service: where its lease is, if it has one, and all writes to it.
///
/// The writes do for a port that drives all links of a unit in one thread. A port that drives them in several does each
/// write under a lock of the service, and starts the safe hook of [`expire_lease`](Self::expire_lease) under the same
/// lock: a call of another peer that begins in between would be stopped by the hook of the one before it.
pub trait Service {
    /// The lease that the application reads.
    fn lease(&self) -> Option<&Lease> {
        None
    }

    /// The newest value, of a stream.
    fn stream(&self) -> Option<&dyn crate::services::stream::Source> {
        None
    }

    /// [`Lease::claim`]; `Ok(None)` for a service without a lease.
    fn begin_lease(&self, now: Instant, end: Instant, claim: &Claim) -> Result<Option<Order>, Error> {
        self.lease().map(|lease| lease.claim(now, end, claim)).transpose()
    }

    /// [`Lease::inhibit`]. A port that runs safe hooks by itself starts that of an order which this stops.
    fn inhibit(&self, now: Instant, latch: Latch) {
        if let Some(lease) = self.lease() {
            lease.inhibit(now, latch);
        }
    }

    /// [`Lease::reset`]
    fn reset(&self, now: Instant, made: Instant) {
        if let Some(lease) = self.lease() {
            lease.reset(now, made);
        }
    }

    /// [`Lease::renew`]
    fn renew_lease(&self, order: Order, end: Instant) -> bool {
        self.lease().is_none_or(|lease| lease.renew(order, end))
    }

    /// [`Lease::cut`]
    fn cut_lease(&self, order: Order) {
        if let Some(lease) = self.lease() {
            lease.cut(order);
        }
    }

    /// [`Lease::finish`]
    fn finish_lease(&self, now: Instant, order: Order) -> bool {
        self.lease().is_some_and(|lease| lease.finish(now, order))
    }

    /// [`Lease::end`], because its caller no longer wants it or it was stopped. Where this is `true`, the safe hook is due:
    /// the event [`LeaseExpired`](crate::services::session::Event::LeaseExpired) says so to a port that has not started it
    /// here.
    fn expire_lease(&self, now: Instant, order: Order, how: LeaseEnd) -> bool {
        self.lease().is_none_or(|lease| lease.end(now, order, how))
    }

    /// [`Lease::state`], between two writes.
    fn state(&self) -> ActuatorState {
        self.lease().map(Lease::state).unwrap_or_default()
    }
}

impl Service for () {}

/// The lease that a call of the peer holds on a function of this unit: one for each function, or for all that share it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Granted {
    /// The peer's id of the call.
    pub(crate) call: u32,
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    /// `None` where the port has no [`Lease`] for the service.
    pub(crate) order: Option<Order>,
    pub(crate) length: Duration,
    pub(crate) end: Instant,
}

/// The lease that a call of this unit holds on a function of the peer, until it is released.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Held {
    pub(crate) call: CallId,
    pub(crate) slot: Slot,
    /// An operator made it.
    pub(crate) operator: bool,
    pub(crate) class: Priority,
    /// In milliseconds, as the peer has published it.
    pub(crate) lease: u32,
    /// For how long the call wants it.
    pub(crate) renew: Renew,
    /// The next renewal; in the far future when it is renewed no more, and its release has yet to be sent in the stream.
    pub(crate) next: Instant,
    /// When the peer answered a renewal last.
    pub(crate) answered: Instant,
}

impl Held {
    /// Whether it is renewed.
    pub(crate) fn is_renewed(&self) -> bool {
        self.next != Instant::FAR_FUTURE
    }

    /// The lease's length.
    pub(crate) fn length(&self) -> Duration {
        Duration::from_millis(self.lease.into())
    }
}

#[cfg(test)]
#[allow(clippy::arithmetic_side_effects, clippy::indexing_slicing, clippy::unwrap_used)]
// A model of the Linux port includes this file by its path, where a plain `mod tests` would look beside it.
#[path = "lease/tests.rs"]
mod tests;
