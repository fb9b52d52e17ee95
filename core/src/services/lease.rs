//! Leases: motion continues only while its caller renews it (docs/safety.md, "The bound").
//!
//! The application reads a [`Lease`], even in a motor's interrupt: a few atomic loads tell whether motion may continue. A lease
//! ends by itself if nothing polls, so a busy or hung executor cannot keep a vehicle moving.
//!
//! A service has one lease; each call that begins is an [`Order`] of it. The newest order holds the lease; an earlier one is dead
//! for good, whatever comes after it.

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

/// One call's hold of a service's [`Lease`]. The numbers wrap after 2^32 calls of one service.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Order(NonZeroU32);

impl Order {
    const fn number(self) -> u32 {
        self.0.get()
    }
}

/// Who begins an order, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Claim {
    /// The ID number of the calling unit.
    pub holder: u32,
    /// The caller's own earlier order, which the new one may replace.
    pub replaces: Option<Order>,
    /// Also replaces another caller's order.
    pub takes_over: bool,
    /// Made by an operator of the calling unit and not by its program: the two are different holders.
    pub operator: bool,
    /// The caller's nonce of the link, as in [`LastOrder`].
    pub link: u32,
    /// The caller's id of the call.
    pub call: u32,
    /// The claim under which the caller commands.
    pub under: claim::Claim,
    /// When the call was made: an order made before a stop does not begin, even after a reset.
    pub made: Instant,
}

/// Longest ramp, in milliseconds.
const LONGEST_RAMP: u16 = 60_000;
/// Tolerance for a reader whose clock reading is older than the unit's, in milliseconds.
const NEWER: u32 = 10;

/// Until when a leased service may act. Written by the unit, read anywhere. Services that share a lease move the same thing: one
/// order at a time holds it.
///
/// A reader's time may be later than the unit's, which renews as of the time at which it began to process a renewal: an interrupt
/// may fall between, or a thread be held up. So a lease that was once seen dead records that, and only a new order revives it, no
/// renewal.
///
/// The smallest boards have no compare-and-swap. Each write is a single store, and stores are ordered such that a reader between
/// two of them may see a live lease as dead, never the reverse. Two concurrent writers would break that: a renewal could revive
/// what the other has just ended. So all writes go through [`Service`], whose methods take turns.
#[derive(Debug, Default)]
pub struct Lease {
    /// The end in milliseconds of the port's clock, modulo 2^32, with the lowest bit set; 0 if there is no order.
    end: AtomicU32,
    /// A reader has seen the end pass, or the unit has cut the lease: the safe hook is due.
    seen_dead: AtomicBool,
    /// Whether the order was made by an operator of `holder`.
    operator: AtomicBool,
    /// The order that holds the lease, or was the last to hold it; 0 before the first.
    order: AtomicU32,
    /// The ID number of the unit that made the order.
    holder: AtomicU32,
    /// That unit's nonce of the link.
    link: AtomicU32,
    /// That unit's id of the call.
    call: AtomicU32,
    /// That unit's claim: term, then claimant, each with the lower half first.
    claim: [AtomicU32; 4],
    /// How the order ended, as the number of a [`LeaseEnd`].
    how: AtomicU8,
    /// While this is set, no order begins.
    latch: LatchWord,
    /// How long the motion takes to come to rest, in milliseconds.
    ramp: AtomicU16,
    /// When the last order began to stop, in the format of `end`; 0 if it did not, or another has begun since.
    stopped: AtomicU32,
}

/// What a loop that cannot stop its motion at once may do for an order now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Do what the order wants.
    Live,
    /// Only slow down: the order is over, its [ramp](Lease::set_ramp) is not.
    Stopping,
    /// Nothing: power off.
    Dead,
}

/// The order has ended, so what was to be done for it was not done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the order has ended: its caller no longer wants it, or it was stopped")]
pub struct Ended;

/// Lets a service use `?`.
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

    /// Whether the service may act at `now`, for whichever order holds the lease. `now` must not lie in the future. Never true
    /// after the granted end, which is rounded down; once false, it stays false until the next order.
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

    /// Sets how long an order is [stopping](Stage::Stopping) when it ends other than by being finished or replaced. Meanwhile no
    /// other order begins ([`Error::Busy`]). Set it before the first order; at most a minute. The safe hook runs when the ramp
    /// begins. Motion has to be at rest when the loop reads [`stage`](Self::stage) as dead: the bound is lease plus ramp.
    pub fn set_ramp(&self, span: Duration) {
        self.ramp.store(span.as_millis().min(LONGEST_RAMP.into()) as u16, Ordering::Release);
    }

    /// As [`is_live`](Self::is_live), plus the stage between live and dead.
    pub fn stage(&self, now: Instant) -> Stage {
        if self.is_live(now) {
            return Stage::Live;
        }
        let end = self.end.load(Ordering::Acquire);
        // The unit has not noticed the end yet: the lease was cut, or has expired.
        let runs_out = end != 0 && (is_before(now, end) || self.is_on_ramp(now, end));
        let is_stopping =
            if self.stopped.load(Ordering::Acquire) == 0 { runs_out && self.has_ramp() } else { self.is_stopping(now) };
        if is_stopping { Stage::Stopping } else { Stage::Dead }
    }

    /// The same for one order, which is dead as soon as a newer one holds the lease.
    pub fn stage_for(&self, order: Order, now: Instant) -> Stage {
        let stage = if self.is_held_by(order) { self.stage(now) } else { Stage::Dead };
        // See `is_live_for`.
        if self.is_held_by(order) { stage } else { Stage::Dead }
    }

    fn has_ramp(&self) -> bool {
        self.ramp.load(Ordering::Acquire) != 0
    }

    /// Whether the ramp of the last order is not over. Clocks wrap: true again every 49 days if no order has begun since.
    fn is_stopping(&self, now: Instant) -> bool {
        self.is_on_ramp(now, self.stopped.load(Ordering::Acquire))
    }

    fn is_on_ramp(&self, now: Instant, started: u32) -> bool {
        // The reader's clock reading may be a little older than the unit's.
        let since = ((now.as_micros() / 1_000) as u32).wrapping_sub(started).wrapping_add(NEWER);
        started != 0 && self.has_ramp() && since < u32::from(self.ramp.load(Ordering::Acquire)).saturating_add(NEWER)
    }

    /// The same for one order: once dead it stays dead, even if another order holds the lease.
    pub fn is_live_for(&self, order: Order, now: Instant) -> bool {
        // A new order stores its number first, its end last: if the number is unchanged after the end was read, the end is its
        // own.
        self.is_held_by(order) && self.is_live(now) && self.is_held_by(order)
    }

    /// Whether `order` is the newest one, live or dead.
    pub(crate) fn is_held_by(&self, order: Order) -> bool {
        self.order.load(Ordering::Acquire) == order.number()
    }

    /// Whether the lease lasts beyond `at` as it stands, for measurements. Records nothing, so `at` may lie in the future.
    pub fn lasts_beyond(&self, at: Instant) -> bool {
        let ended = self.seen_dead.load(Ordering::Acquire) || self.is_inhibited();
        !ended && is_before(at, self.end.load(Ordering::Acquire))
    }

    /// How long the lease still lasts as it stands: zero after its end, `None` without an order. Records nothing, like
    /// [`Lease::lasts_beyond`].
    pub fn left(&self, now: Instant) -> Option<Duration> {
        let end = self.end.load(Ordering::Acquire);
        let (millis, rest) = (now.as_micros() / 1_000, now.as_micros() % 1_000);
        let left = i64::from(end.wrapping_sub(millis as u32) as i32).saturating_mul(1_000);
        let left = u64::try_from(left).unwrap_or(0).saturating_sub(rest);
        (end != 0).then(|| Duration::from_micros(left))
    }

    /// [`begin`](Self::begin) for a caller. Errors: [`Error::Held`] if another unit, or the other of operator and program, holds
    /// the lease and is not taken over; [`Error::Busy`] if an earlier order is dead and its safe hook has yet to run;
    /// [`Error::Inhibited`] after a stop; [`Error::Expired`] if the call was made before a stop.
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

    /// Begins an order, live until [`Lease::seen_end`] of `end`. `None` if the safe hook of a dead order has yet to run.
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
        // A reader may have seen the earlier order dead in between, or a stop may have come.
        if self.seen_dead.load(Ordering::Acquire) || self.is_inhibited() {
            self.order.store(before, Ordering::Release);
            self.end.store(end_before, Ordering::Release);
            return None;
        }
        Some(Order(order))
    }

    /// Prolongs the order until [`Lease::seen_end`] of `end`. `false` if it has ended or was seen dead, which is final.
    #[must_use]
    pub fn renew(&self, order: Order, end: Instant) -> bool {
        let ended = self.seen_dead.load(Ordering::Acquire) || self.is_inhibited() || !self.has_order();
        if ended || !self.is_held_by(order) {
            return false;
        }
        self.end.store(odd_millis(end) as u32, Ordering::Release);
        // A reader may have seen it dead in between.
        !self.seen_dead.load(Ordering::Acquire)
    }

    /// When a lease granted until `end` is seen as dead: up to 2 ms earlier. The unit ends it at that moment, too.
    pub fn seen_end(end: Instant) -> Instant {
        Instant::from_micros(odd_millis(end).saturating_mul(1_000))
    }

    /// Marks an order dead. Its safe hook is due, and no other order begins before [`Lease::end`].
    pub fn cut(&self, order: Order) {
        if self.is_held_by(order) {
            self.seen_dead.store(true, Ordering::Release);
        }
    }

    /// Stops whichever order holds the lease, and lets none begin until [`reset`](Self::reset): for a stop by a peer, or the
    /// vehicle's own, such as a bumper's, with `latch.by` 0. May be called from an interrupt. An existing latch stays, with the
    /// time of the newest stop. The safe hook is due as after [`cut`](Self::cut).
    pub fn inhibit(&self, now: Instant, latch: Latch) {
        self.latch.note(latch);
        self.stop_at(now, self.end.load(Ordering::Acquire));
        self.latch.close(now);
        self.seen_dead.store(true, Ordering::Release);
    }

    /// Inherits a latch: of the service that this one replaces, or of the unit.
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

    /// Ends the latch if the last stop was before `made`, when the reset was requested: an earlier request does not undo a later
    /// stop, nor one made within 3 ms of it.
    pub fn reset(&self, now: Instant, made: Instant) {
        self.latch.reset(now, made);
    }

    /// The latch, if it is set.
    pub fn latch(&self) -> Option<Latch> {
        self.latch.latch()
    }

    /// Whether no order may begin.
    pub fn is_inhibited(&self) -> bool {
        self.latch.is_inhibited()
    }

    /// Whether an order is dead and has not been ended: its safe hook has to run before anything else.
    pub fn awaits_hook(&self) -> bool {
        self.seen_dead.load(Ordering::Acquire) && self.has_order()
    }

    /// Whether this order is dead and has not been ended: it was cut or inhibited, or a reader saw its time pass.
    pub(crate) fn is_cut(&self, order: Order) -> bool {
        self.seen_dead.load(Ordering::Acquire) && self.is_held_by(order)
    }

    /// Starts the ramp unless it has started: at `now`, or at the end of the lease if that was earlier.
    fn stop_at(&self, now: Instant, end: u32) {
        if self.stopped.load(Ordering::Acquire) == 0 {
            let started = if is_before(now, end) { odd_millis(now) as u32 } else { end };
            self.stopped.store(started, Ordering::Release);
        }
    }

    /// Ends an order; `false` if a newer one holds the lease.
    pub fn end(&self, now: Instant, order: Order, how: LeaseEnd) -> bool {
        let held = self.is_held_by(order);
        if held {
            self.end_any(now, how);
        }
        held
    }

    /// Ends an order whose work is finished: no hook runs. `false` if it is dead, since it then was not finished.
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

    /// The state of the actuator. May mix in part of a concurrent write: see [`Service::state`].
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

    /// Differs whenever the [state](Self::state) does; 0 in the initial state.
    pub(crate) fn changes(&self) -> u32 {
        let order = self.order.load(Ordering::Acquire);
        let latched = self.latch.changes();
        order.wrapping_mul(2).wrapping_add(self.has_order().into()) ^ latched.reverse_bits()
    }

    fn has_order(&self) -> bool {
        self.end.load(Ordering::Acquire) != 0
    }

    /// Ends whichever order holds the lease, as when the service is removed. Returns whether its safe hook has to run.
    pub fn clear(&self, now: Instant) -> bool {
        let has_order = self.has_order();
        if has_order {
            self.end_any(now, LeaseEnd::Expired);
        }
        has_order
    }
}

/// Whether a time precedes the end of a lease, if there is one.
const fn is_before(time: Instant, end: u32) -> bool {
    let time = (time.as_micros() / 1_000) as u32;
    // Times wrap. A lease is far shorter than half of the range, so the sign of the difference tells the order.
    end != 0 && (end.wrapping_sub(time) as i32) > 0
}

/// What the core needs of a port's service: its lease, if it has one, and all writes to it.
///
/// The default methods suit a port that drives all links of a unit in one thread. A port with several threads performs each write
/// under a lock of the service, and starts the safe hook of [`expire_lease`](Self::expire_lease) under the same lock: otherwise
/// the hook of one order could stop the motion of the next, which another peer's call began in between.
pub trait Service {
    /// The lease that the application reads.
    fn lease(&self) -> Option<&Lease> {
        None
    }

    /// The newest value, if the function is a stream.
    fn stream(&self) -> Option<&dyn crate::services::stream::Source> {
        None
    }

    /// [`Lease::claim`]; `Ok(None)` for a service without a lease.
    fn begin_lease(&self, now: Instant, end: Instant, claim: &Claim) -> Result<Option<Order>, Error> {
        self.lease().map(|lease| lease.claim(now, end, claim)).transpose()
    }

    /// [`Lease::inhibit`]. A port that runs safe hooks itself starts that of the order that this stops.
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

    /// [`Lease::end`], because the caller no longer wants the order or it was stopped. If this returns `true`, the safe hook is
    /// due: the session reports [`LeaseExpired`](crate::services::session::Event::LeaseExpired) for ports that have not started
    /// it here.
    fn expire_lease(&self, now: Instant, order: Order, how: LeaseEnd) -> bool {
        self.lease().is_none_or(|lease| lease.end(now, order, how))
    }

    /// [`Lease::state`], not during a write.
    fn state(&self) -> ActuatorState {
        self.lease().map(Lease::state).unwrap_or_default()
    }
}

impl Service for () {}

/// The lease that a call of the peer holds on a function of this unit, or on several that share an actuator.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Granted {
    /// The peer's id of the call.
    pub(crate) call: u32,
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    /// `None` if the port has no [`Lease`] for the service.
    pub(crate) order: Option<Order>,
    pub(crate) length: Duration,
    pub(crate) end: Instant,
}

/// The lease that a call of this unit holds at the peer, until it is released. Behind that, while the stream has no capacity for the
/// release, only its call, slot and class count: also of a call that was never renewed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Held {
    pub(crate) call: CallId,
    pub(crate) slot: Slot,
    /// Whether an operator made it.
    pub(crate) operator: bool,
    pub(crate) class: Priority,
    /// Its length in milliseconds, as the peer has published it.
    pub(crate) lease: u32,
    /// How long the call renews it.
    pub(crate) renew: Renew,
    /// When it is renewed next; in the far future if no longer, while its release has yet to be sent in the stream.
    pub(crate) next: Instant,
    /// When the peer last answered a renewal.
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
