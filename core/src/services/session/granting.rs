//! Leases that the peer's calls hold on functions of this unit.

use super::timing::sent_at_earliest;
use super::{Event, Session};
use crate::config::LEASES;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::message::{Control, Release, Renewal};
use crate::error::{Error, Limit};
use crate::host::connections::LinkCounter;
use crate::services::calls::CallHead;
use crate::services::lease::{Granted, Lease, LeaseEnd, Order, Service};
use crate::services::{Context, Port};
use crate::storage::take_at;
use crate::time::{Duration, Instant};

/// Ends of leases that the peer is still to be told. One that finds no place is told when the peer renews it.
pub(super) type Ends = heapless::Vec<(u32, LeaseEnd), LEASES>;

impl<P: Port> Session<P> {
    /// A call begins the lease of its function, as of when it was made. It takes the place of an earlier call's at once,
    /// but not that of a lease that is dead: its hook comes first.
    pub(super) fn grant(
        &mut self,
        cx: &mut Context<'_, P>,
        head: &CallHead,
        length: Duration,
    ) -> Result<Option<Order>, Error> {
        let end = Lease::seen_end(head.sent_at + length);
        if end <= cx.now {
            return Err(Error::Expired);
        }
        let known = self.granted.iter().position(|known| known.slot == head.slot);
        let earlier = known.and_then(|index| self.granted.get(index)).copied();
        // The safe hook of that lease is still to run, from `poll`. Granting now would let a new motion begin before it, and the hook
        // would then stop the new one.
        if earlier.is_some_and(|earlier| earlier.end <= cx.now) {
            return Err(Error::Busy);
        }
        if earlier.is_none() && self.granted.is_full() {
            return Err(Error::Full(Limit::Leases));
        }
        // The service's word is changed before the table here: where it refuses, nothing of this session has changed.
        let service = service_of(cx, head.slot, head.generation);
        let order = match service.map_or(Ok(None), |service| service.begin_lease(cx.now, end)) {
            Ok(order) => order,
            Err(error) => {
                // A reader has looked later than at `cx.now`, and has stopped the motion.
                if let Some(index) = known {
                    self.cut_lease(cx, index);
                }
                return Err(error);
            }
        };
        let (slot, generation) = (head.slot, head.generation);
        let granted = Granted { call: head.id, slot, generation, order, length, end };
        self.timers.lease = self.timers.lease.min(end);
        match self.granted.iter_mut().find(|known| known.slot == slot) {
            Some(known) => {
                let replaced = core::mem::replace(known, granted).call;
                self.tell_end(cx, replaced, LeaseEnd::Replaced);
            }
            None => self.granted.push(granted).map_err(|_| Error::Full(Limit::Leases))?,
        }
        Ok(order)
    }

    /// The caller still wants a call: its lease goes on, as of when the renewal was made.
    pub(super) fn renewed(&mut self, cx: &mut Context<'_, P>, renewal: &Renewal) {
        let Some(index) = self.granted.iter().position(|granted| granted.call == renewal.call) else {
            self.link.counters.add(LinkCounter::RenewalsIgnored, 1);
            // A call that is on its way or waits for its turn has no lease yet.
            let Renewal { call, class, .. } = *renewal;
            if self.calls.has_arrived(class, call) && !self.calls.is_waiting(class, call) {
                self.tell_end(cx, call, LeaseEnd::Expired);
            }
            return;
        };
        let Some(granted) = self.granted.get(index).copied() else { return };
        // A function that has been replaced since started it, and nothing of it is prolonged.
        if cx.functions.lookup(granted.slot, granted.generation).is_err() {
            self.link.counters.add(LinkCounter::RenewalsIgnored, 1);
            return;
        }
        let Some(sent_at) = sent_at_earliest(cx.now, renewal.stamp, renewal.since) else { return };
        let end = Lease::seen_end(sent_at + granted.length);
        // What was late on its way takes nothing away from what came before it, and revives nothing.
        if end > granted.end && granted.end > cx.now {
            self.prolong(cx, index, end);
        }
    }

    fn prolong(&mut self, cx: &mut Context<'_, P>, index: usize, end: Instant) {
        let Some(granted) = self.granted.get_mut(index) else { return };
        let service = service_of(cx, granted.slot, granted.generation);
        if service.is_some_and(|service| granted.order.is_none_or(|order| service.renew_lease(order, end))) {
            granted.end = end;
        } else {
            // A reader has looked later than at `cx.now`, a call of another peer has taken the lease over, or the service is
            // gone.
            self.cut_lease(cx, index);
        }
    }

    /// The application has finished what calls of the leased function started: no renewal keeps it alive, no hook runs.
    pub fn end_lease(&mut self, cx: &mut Context<'_, P>, slot: Slot) {
        let index = self.granted.iter().position(|granted| granted.slot == slot);
        if let Some(granted) = index.and_then(|index| take_at(&mut self.granted, index)) {
            let service = service_of(cx, granted.slot, granted.generation);
            if let Some((service, order)) = service.zip(granted.order) {
                service.finish_lease(order);
            }
            self.tell_end(cx, granted.call, LeaseEnd::Finished);
        }
    }

    /// A call has failed here: the lease that it holds, if it does, expires at once.
    pub(super) fn cut_call(&mut self, cx: &mut Context<'_, P>, call: u32) {
        if let Some(index) = self.granted.iter().position(|granted| granted.call == call) {
            self.cut_lease(cx, index);
        }
    }

    /// Ends the leases of services that are gone: their callers are told.
    pub(super) fn cut_gone(&mut self, cx: &mut Context<'_, P>) {
        for index in 0..self.granted.len() {
            let granted = self.granted.get(index);
            if granted.is_some_and(|granted| service_of(cx, granted.slot, granted.generation).is_none()) {
                self.cut_lease(cx, index);
            }
        }
    }

    /// Lets a lease expire at once.
    pub(super) fn cut_lease(&mut self, cx: &mut Context<'_, P>, index: usize) {
        let Some(granted) = self.granted.get_mut(index) else { return };
        granted.end = cx.now;
        self.timers.lease = cx.now;
        let service = service_of(cx, granted.slot, granted.generation);
        if let Some((service, order)) = service.zip(granted.order) {
            service.cut_lease(order);
        }
    }

    /// The caller gave up a call: its lease ends now, as if it had expired. If it waits for its turn, or is still on its
    /// way, it does not begin.
    pub(super) fn released(&mut self, cx: &mut Context<'_, P>, release: Release) -> Option<Event> {
        let Release { call, class } = release;
        self.calls.give_up(class, call);
        self.end_released(cx, |granted| granted.call == call)
    }

    /// The same for all calls of a function up to `id`.
    pub(super) fn released_all(&mut self, cx: &mut Context<'_, P>, slot: Slot, id: u32) -> Option<Event> {
        self.publishing.release(slot, id);
        self.end_released(cx, |granted| granted.slot == slot && granted.call <= id)
    }

    fn end_released(&mut self, cx: &mut Context<'_, P>, is_released: impl Fn(&Granted) -> bool) -> Option<Event> {
        let index = self.granted.iter().position(is_released);
        let granted = index.and_then(|index| take_at(&mut self.granted, index))?;
        if expire_granted(cx, &granted) { Some(Event::LeaseExpired(granted.slot)) } else { None }
    }

    /// Ends a lease that is due; its function, whose hook is to run.
    pub(super) fn expire_lease(&mut self, cx: &mut Context<'_, P>) -> Option<Slot> {
        let now = cx.now;
        let due = |granted: &Granted| granted.end <= now;
        while let Some(granted) = self.granted.iter().position(due).and_then(|index| take_at(&mut self.granted, index))
        {
            if expire_granted(cx, &granted) {
                self.link.counters.add(LinkCounter::LeasesExpired, 1);
                self.tell_end(cx, granted.call, LeaseEnd::Expired);
                return Some(granted.slot);
            }
            let is_gone = service_of(cx, granted.slot, granted.generation).is_none();
            self.tell_end(cx, granted.call, if is_gone { LeaseEnd::Expired } else { LeaseEnd::Replaced });
        }
        self.timers.lease = self.granted.iter().map(|granted| granted.end).min().unwrap_or(Instant::FAR_FUTURE);
        None
    }

    fn tell_end(&mut self, cx: &mut Context<'_, P>, call: u32, why: LeaseEnd) {
        if !self.send_control(cx, &Control::LeaseEnded { call, why }) {
            let _ = self.ends.push((call, why));
        }
    }

    /// Tells the peer of ends that there was no room for.
    pub(super) fn send_ends(&mut self, cx: &mut Context<'_, P>) {
        while let Some(&(call, why)) = self.ends.last()
            && self.send_control(cx, &Control::LeaseEnded { call, why })
        {
            self.ends.pop();
        }
    }
}

fn service_of<'c, P: Port>(cx: &Context<'c, P>, slot: Slot, generation: Generation) -> Option<&'c dyn Service> {
    cx.functions.lookup(slot, generation).ok().map(|function| function.handler)
}

/// Whether the safe hook is to run: not when a call of another peer holds the lease now, whose motion goes on, and not when
/// the service is gone, with which its hook has run.
pub(super) fn expire_granted<P: Port>(cx: &Context<'_, P>, granted: &Granted) -> bool {
    let service = service_of(cx, granted.slot, granted.generation);
    service.is_some_and(|service| granted.order.is_none_or(|order| service.expire_lease(order)))
}
