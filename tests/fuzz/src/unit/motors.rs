//! What may move: a record of each motor's order beside the unit's own, kept from events alone.

use std::rc::Rc;

use cara_core::distribution::function_list::Slot;
use cara_core::services::lease::{Lease, Order};
use cara_core::time::{Duration, Instant};

use super::Unit;
use super::services::LEASES;

/// A motor and what is known of it.
pub(crate) struct Motor {
    pub(crate) lease: Rc<Lease>,
    /// The order that has begun, until its safe hook has run or it is finished.
    pub(crate) open: Option<Open>,
    /// It was stopped, and no reset has been answered since.
    pub(crate) is_stopped: bool,
    /// How often it was stopped.
    pub(crate) stops: u32,
    /// Its order ended, and its hook ran, when a function was replaced or removed: for another function the hook runs once more.
    is_cleared: bool,
}

/// An order that has begun.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Open {
    pub(crate) order: Order,
    pub(crate) link: usize,
    slot: Slot,
    /// It was dead when the motor looked, so its safe hook comes before any other order.
    pub(crate) is_dead: bool,
}

impl Motor {
    pub(crate) fn all() -> Vec<Self> {
        let motor =
            |_| Self { lease: Rc::new(Lease::new()), open: None, is_stopped: false, stops: 0, is_cleared: false };
        LEASES.iter().map(motor).collect()
    }

    /// A call has begun that moves it.
    pub(crate) fn began(&mut self, order: Order, link: usize, slot: Slot, now: Instant) {
        assert!(!self.open.is_some_and(|open| open.is_dead), "an order begins before the safe hook of the one before");
        assert!(!self.is_stopped, "an order begins behind a stop");
        assert!(self.lease.is_live_for(order, now), "an order is dead when it begins");
        self.open = Some(Open { order, link, slot, is_dead: false });
        self.is_cleared = false;
    }

    /// A function of it is gone.
    pub(crate) fn clear(&mut self, now: Instant) {
        if self.lease.clear(now) {
            self.open = None;
            self.is_cleared = true;
        }
    }

    /// Its safe hook runs.
    pub(crate) fn made_safe(&mut self, link: usize, now: Instant) {
        match self.open.take() {
            Some(open) => assert_eq!(open.link, link, "a link stops what another one has begun"),
            None => assert!(self.is_cleared, "a safe hook without an order"),
        }
        self.is_cleared = false;
        assert!(!self.lease.is_live(now), "a motor moves behind its safe hook");
    }

    pub(crate) fn stop(&mut self) {
        self.is_stopped = true;
        self.stops += 1;
    }

    /// The call of a link that has begun its order, and the slot of its function.
    pub(crate) fn mover(&self, link: usize) -> Option<(u32, Slot)> {
        let open = self.open.filter(|open| open.link == link && !open.is_dead)?;
        self.lease.state().last.map(|last| (last.call, open.slot))
    }

    fn look(&mut self, now: Instant, bound: impl FnOnce(&Open, u32) -> Option<Instant>) {
        let is_live = self.lease.is_live(now);
        let is_inhibited = self.lease.is_inhibited();
        assert!(!(is_live && self.is_stopped), "a motor moves behind a stop");
        assert!(!self.is_stopped || is_inhibited, "a latch has ended without a reset");
        self.is_stopped |= is_inhibited;
        let Some(open) = &mut self.open else {
            return assert!(!is_live, "a motor moves without an order");
        };
        open.is_dead |= !is_live;
        if is_live {
            assert!(self.lease.is_live_for(open.order, now), "a motor moves for an order that has not begun");
            let call = self.lease.state().last.map_or(0, |last| last.call);
            let bound = bound(open, call).expect("an order outlives its link");
            assert!(now < bound, "an order lasts longer than what its caller has said: {now:?}, {bound:?}");
        }
    }
}

impl Unit {
    /// The motors' loops look, each at its own moment.
    pub(crate) fn look_at_motors(&mut self) {
        let Self { motors, links, now, .. } = self;
        for (motor, length) in motors.iter_mut().zip(LEASES) {
            motor.look(*now, |open, call| {
                Some(links.get(open.link)?.as_ref()?.wanted(call, open.slot) + Duration::from_millis(length))
            });
        }
    }
}
