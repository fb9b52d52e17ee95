//! Leases that the peer's calls hold on functions of this unit (docs/safety.md): granted with a call, prolonged by renewals,
//! and ended by a release, a stop or time. The order of steps matters throughout: a safe hook must never stop a motion that
//! began after it was due.

use super::Event;
use super::due::Part;
use super::obeying::Obedience;
use super::peer_clock::sent_at_earliest;
use super::permitting::may;
use super::wire::Wire;
use crate::config::LEASES;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::identity::Identity;
use crate::distribution::message::{Control, Release, Renewal, RequestHeader};
use crate::error::{Error, Limit};
use crate::host::connections::LinkCounter;
use crate::services::access::Verb;
use crate::services::calls::{CallHead, Calls, Cancelled, RunningCall};
use crate::services::lease::{Claim, Granted, Latch, Lease, LeaseEnd, Order, Service, Stage};
use crate::services::{Context, Port};
use crate::storage::take_at;
use crate::time::{Duration, Instant};

/// Ends of leases that the peer has yet to be notified of. If this is full, the answer to its next renewal notifies it.
type Ends = heapless::Vec<(u32, LeaseEnd), LEASES>;

/// The peer's live orders, and the claim that they are made under.
pub(super) struct Granting {
    pub(super) granted: heapless::Vec<Granted, LEASES>,
    ends: Ends,
    pub(super) obedience: Obedience,
}

impl Granting {
    pub(super) const fn new() -> Self {
        Self { granted: heapless::Vec::new(), ends: Ends::new(), obedience: Obedience::new() }
    }

    /// Whether a message waits for send capacity.
    pub(super) fn has_news(&self) -> bool {
        !self.ends.is_empty() || self.obedience.has_news
    }

    /// Starts the lease of a call, counted from when the call was made. Replaces the lease of an earlier call of the peer at
    /// once, unless that lease is dead: then its hook has to run first.
    pub(super) fn grant<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        head: &CallHead,
        length: Duration,
    ) -> Result<Option<Order>, Error> {
        let end = Lease::seen_end(head.sent_at + length);
        if end <= cx.now {
            return Err(Error::Expired);
        }
        if self.obedience.gives_way() {
            return Err(Error::Busy);
        }
        let under = self.obedience.may_move(wire, cx).ok_or(Error::Busy)?;
        let service = service_of(cx, head.slot, head.generation);
        let is_same = |known: &Granted| {
            known.slot == head.slot || share_a_lease(service, service_of(cx, known.slot, known.generation))
        };
        // A later call has begun already: this one was overtaken in another class, or on the other of stream and datagram.
        let moves_it = |slot| {
            let function = cx.functions.function(slot);
            slot == head.slot || function.is_some_and(|function| share_a_lease(service, Some(function.handler)))
        };
        if wire.publishing.ordered_after(head.number).any(moves_it) {
            return Err(Error::Replaced);
        }
        let known = self.granted.iter().position(is_same);
        let earlier = known.and_then(|index| self.granted.get(index)).copied();
        // That lease's safe hook has yet to run, from `poll`. A grant now would let a motion begin that this hook then stops.
        if earlier.is_some_and(|earlier| earlier.end <= cx.now) {
            return Err(Error::Busy);
        }
        if earlier.is_none() && self.granted.is_full() {
            return Err(Error::Full(Limit::Leases));
        }
        let claim = Claim {
            holder: wire.identity().map_or(0, Identity::id),
            replaces: earlier.and_then(|earlier| earlier.order),
            takes_over: head.takes_over,
            operator: head.operator,
            link: wire.hello().map_or(0, |hello| hello.nonce as u32),
            call: head.id,
            under,
            made: head.sent_at,
        };
        // Write the service's lease before the table: if the service refuses, this session is unchanged.
        let order = match service.map_or(Ok(None), |service| service.begin_lease(cx.now, end, &claim)) {
            Ok(order) => order,
            Err(error) => {
                // A reader checked the lease with a later clock than `cx.now`, and has stopped the motion.
                if let Some(index) = known.filter(|_| error == Error::Busy) {
                    self.cut_lease(wire, cx, index);
                }
                return Err(error);
            }
        };
        let (slot, generation) = (head.slot, head.generation);
        let granted = Granted { call: head.id, slot, generation, order, length, end };
        wire.due.hasten(Part::Leases, end);
        wire.publishing.note_order(slot, head.number);
        match known.and_then(|index| self.granted.get_mut(index)) {
            Some(known) => {
                let replaced = core::mem::replace(known, granted).call;
                self.notify_end(wire, cx, replaced, LeaseEnd::Replaced);
            }
            None => self.granted.push(granted).map_err(|_| Error::Full(Limit::Leases))?,
        }
        Ok(order)
    }

    /// Prolongs the lease of a call, counted from when the renewal was made.
    pub(super) fn renewed<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        calls: &Calls<P::Storage>,
        cx: &mut Context<'_, P>,
        renewal: &Renewal,
    ) {
        let Some(index) = self.granted.iter().position(|granted| granted.call == renewal.call) else {
            wire.link.counters.count(LinkCounter::RenewalsIgnored);
            // A call that is in flight or queued has no lease yet.
            let Renewal { call, class, .. } = *renewal;
            if calls.has_arrived(class, call) && !calls.is_waiting(class, call) {
                self.notify_end(wire, cx, call, LeaseEnd::Expired);
            }
            return;
        };
        let Some(granted) = self.granted.get(index).copied() else { return };
        // The call started a function that has been replaced since: do not prolong it.
        if cx.functions.lookup(granted.slot, granted.generation).is_err() {
            wire.link.counters.count(LinkCounter::RenewalsIgnored);
            return;
        }
        let Some(sent_at) = sent_at_earliest(cx.now, renewal.stamp, renewal.since) else { return };
        let wanted_at = Instant::from_micros(sent_at.as_micros().saturating_sub(renewal.age.as_micros()));
        let end = Lease::seen_end(wanted_at + granted.length);
        // A late renewal shortens nothing that an earlier one granted, and revives no dead lease.
        if end > granted.end && granted.end > cx.now {
            self.prolong(wire, cx, index, end);
        }
    }

    fn prolong<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, index: usize, end: Instant) {
        let Some(granted) = self.granted.get_mut(index) else { return };
        let service = service_of(cx, granted.slot, granted.generation);
        if service.is_some_and(|service| granted.order.is_none_or(|order| service.renew_lease(order, end))) {
            granted.end = end;
        } else {
            // A reader checked the lease with a later clock, a call of another peer has taken it over, or the service is gone.
            self.cut_lease(wire, cx, index);
        }
    }

    /// The application has finished what an order started. Returns `false` if no call of this peer has that order.
    pub(super) fn end_order<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        lease: &Lease,
        order: Order,
    ) -> bool {
        // Compare with this order, not the newest: another may have begun after the application saw that this one was done.
        let is_meant = |granted: &Granted| {
            granted.order == Some(order) && lease_of(cx, granted).is_some_and(|word| core::ptr::eq(word, lease))
        };
        let index = self.granted.iter().position(is_meant);
        let granted = index.and_then(|index| self.granted.get(index));
        let service = granted.and_then(|granted| service_of(cx, granted.slot, granted.generation));
        let is_finished = service.is_some_and(|service| service.finish_lease(cx.now, order));
        if is_finished && let Some(granted) = index.and_then(|index| take_at(&mut self.granted, index)) {
            self.notify_end(wire, cx, granted.call, LeaseEnd::Finished);
        }
        is_finished
    }

    /// Ends the lease of a call that has failed here, if it holds one.
    pub(super) fn cut_call<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, call: u32) {
        if let Some(index) = self.granted.iter().position(|granted| granted.call == call) {
            self.cut_lease(wire, cx, index);
        }
    }

    /// Executes a stop: ends the orders that it covers before its handler runs, and keeps calls that were made before it from
    /// beginning, on any link.
    #[inline(never)]
    pub(super) fn stop_orders<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, header: &RequestHeader) {
        let latch = Latch { by: wire.identity().map_or(0, Identity::id), reason: 0 };
        let charge = service_of(cx, header.slot, header.generation).and_then(Service::lease);
        // Inhibit the unit before its services, whose locks may be held: another thread may add a service now.
        if charge.is_none() {
            cx.functions.stopped().inhibit(cx.now, latch);
        }
        // Write all leases first, which takes no lock: a port may wait for a service's lock below, when all motion has ended.
        Self::each_of(cx, charge, &mut |service| {
            if let Some(lease) = service.lease() {
                lease.inhibit(cx.now, latch);
            }
        });
        Self::each_of(cx, charge, &mut |service| service.inhibit(cx.now, latch));
        if self.was_stopped(cx) {
            wire.due.set(Part::Leases, cx.now);
        }
        wire.publishing.actuators_due = true;
    }

    /// Executes a reset, whose handler has returned results. Fails with [`Error::Inhibited`] if the actuator was stopped again
    /// after the reset was requested.
    #[inline(never)]
    pub(super) fn reset_orders<P: Port>(
        wire: &mut Wire<P>,
        cx: &Context<'_, P>,
        head: &RunningCall,
    ) -> Result<(), Error> {
        // The caller has seen the reset fail, and does not expect anything to move.
        if head.deadline <= cx.now || head.cancelled != Cancelled::No {
            return Err(Error::Expired);
        }
        // Without its function nobody knows what it was to reset: without an actuator that would be all.
        let service = service_of(cx, head.slot, head.generation).ok_or(Error::StaleFunction)?;
        let charge = service.lease();
        let (mut latched, mut any) = (None, false);
        wire.publishing.actuators_due = true;
        Self::each_of(cx, charge, &mut |service| {
            service.reset(cx.now, head.sent_at);
            latched = latched.or_else(|| service.lease().and_then(Lease::latch));
        });
        Self::each_of(cx, None, &mut |service| any |= service.lease().is_some_and(Lease::is_inhibited));
        if charge.is_none() {
            cx.functions.stopped().reset(cx.now, head.sent_at);
        } else if !any {
            cx.functions.stopped().reset_by_parts(cx.now, head.sent_at);
        }
        latched.map_or(Ok(()), |latch| Err(latch.into()))
    }

    /// Calls `act` for each service with a lease that a stop or reset covers: those of its actuator, or all. What only stops or resets
    /// an actuator counts: a function that moves it, added later, is then stopped or reset already. Not generic, to save code.
    #[inline(never)]
    fn each_of<P: Port>(cx: &Context<'_, P>, charge: Option<&Lease>, act: &mut dyn FnMut(&dyn Service)) {
        // Including functions that this peer cannot see.
        for function in (0..cx.functions.places()).filter_map(|place| cx.functions.function(Slot(place))) {
            let lease = function.handler.lease();
            let is_meant = |lease: &Lease| charge.is_none_or(|charge| core::ptr::eq(charge, lease));
            if lease.is_some_and(is_meant) {
                act(function.handler);
            }
        }
    }

    /// The number by which functions of this unit name the actuator that they share; 0 for a function that shares none.
    pub(super) fn actuator_of<P: Port>(wire: &Wire<P>, cx: &Context<'_, P>, service: &dyn Service) -> u8 {
        let shares = |slot: &Slot| {
            let function = cx.functions.function(*slot);
            function.is_some_and(|function| share_a_lease(Some(function.handler), Some(service)))
        };
        let mut sharing = wire.publishing.all_slots().filter(shares);
        let first = sharing.next().filter(|_| sharing.next().is_some());
        first.and_then(|first| u8::try_from(first.0.saturating_add(1)).ok()).unwrap_or(0)
    }

    /// Ends the leases of services that were removed, and notifies their callers.
    pub(super) fn cut_gone<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        for index in 0..self.granted.len() {
            let granted = self.granted.get(index);
            if granted.is_some_and(|granted| service_of(cx, granted.slot, granted.generation).is_none()) {
                self.cut_lease(wire, cx, index);
            }
        }
    }

    /// Ends the leases that the access table no longer allows.
    pub(super) fn cut_forbidden<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        for index in 0..self.granted.len() {
            let Some(slot) = self.granted.get(index).map(|granted| granted.slot) else { return };
            if !may(wire, cx, slot, Verb::Call) {
                self.cut_lease(wire, cx, index);
            }
        }
    }

    /// Makes a lease expire now.
    pub(super) fn cut_lease<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, index: usize) {
        let Some(granted) = self.granted.get_mut(index) else { return };
        granted.end = cx.now;
        wire.due.set(Part::Leases, cx.now);
        let service = service_of(cx, granted.slot, granted.generation);
        if let Some((service, order)) = service.zip(granted.order) {
            service.cut_lease(order);
        }
    }

    /// Ends the lease of a call that its caller gave up; its hook runs as if it had expired. A call that is queued or still in
    /// flight will not begin.
    pub(super) fn released<P: Port>(
        &mut self,
        calls: &mut Calls<P::Storage>,
        cx: &mut Context<'_, P>,
        release: Release,
    ) -> Option<Event> {
        let Release { call, class } = release;
        calls.give_up(class, call);
        self.end_released(cx, |granted| granted.call == call)
    }

    /// The same for all calls of a function with ids up to `id`.
    pub(super) fn released_all<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        slot: Slot,
        id: u32,
    ) -> Option<Event> {
        wire.publishing.release(slot, id);
        self.end_released(cx, |granted| granted.slot == slot && granted.call <= id)
    }

    fn end_released<P: Port>(
        &mut self,

        cx: &mut Context<'_, P>,
        is_released: impl Fn(&Granted) -> bool,
    ) -> Option<Event> {
        let index = self.granted.iter().position(is_released);
        let granted = index.and_then(|index| take_at(&mut self.granted, index))?;
        // If the lease had ended before, report that end and not the release.
        let how = if is_live(cx, &granted) { LeaseEnd::Released } else { how_it_died(cx, &granted) };
        if expire_granted(cx, &granted, how) { Some(Event::LeaseExpired(granted.slot)) } else { None }
    }

    /// Whether a stop covers a dead order whose safe hook has not run, of any link: then its handler waits for the hook.
    #[inline(never)]
    pub(super) fn awaits_hook<P: Port>(cx: &Context<'_, P>, slot: Slot, generation: Generation) -> bool {
        let mut awaits = false;
        let charge = service_of(cx, slot, generation).and_then(Service::lease);
        Self::each_of(cx, charge, &mut |service| {
            awaits |= service.lease().is_some_and(Lease::awaits_hook);
        });
        awaits
    }

    /// Whether the peer has no live order, nothing is stopping, and no hook is due.
    pub(super) fn is_quiet<P: Port>(&self, wire: &Wire<P>, cx: &Context<'_, P>) -> bool {
        let is_busy = |lease: &Lease| lease.awaits_hook() || lease.stage(cx.now) == Stage::Stopping;
        let functions = wire.publishing.all_slots().filter_map(|slot| cx.functions.function(slot));
        self.granted.is_empty() && !functions.filter_map(|function| function.handler.lease()).any(is_busy)
    }

    /// Whether an order of the peer was stopped by the vehicle itself, or through another link.
    pub(super) fn was_stopped<P: Port>(&self, cx: &Context<'_, P>) -> bool {
        self.granted.iter().any(|granted| is_dead(cx, granted))
    }

    /// Removes one lease that has ended; returns its function if the safe hook has to run.
    pub(super) fn expire_lease<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) -> Option<Slot> {
        loop {
            let due = |granted: &Granted| granted.end <= cx.now || is_dead(cx, granted);
            let index = self.granted.iter().position(due);
            let Some(granted) = index.and_then(|index| take_at(&mut self.granted, index)) else { break };
            let why = how_it_died(cx, &granted);
            if expire_granted(cx, &granted, why) {
                wire.publishing.actuators_due |= why == LeaseEnd::Stopped;
                wire.link.counters.count(LinkCounter::LeasesExpired);
                self.notify_end(wire, cx, granted.call, why);
                return Some(granted.slot);
            }
            let is_gone = service_of(cx, granted.slot, granted.generation).is_none();
            self.notify_end(wire, cx, granted.call, if is_gone { LeaseEnd::Expired } else { LeaseEnd::Replaced });
        }
        let next = self.granted.iter().map(|granted| granted.end).min();
        wire.due.set(Part::Leases, next.unwrap_or(Instant::FAR_FUTURE));
        None
    }

    fn notify_end<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, call: u32, why: LeaseEnd) {
        if !wire.send_control(cx, &Control::LeaseEnded { call, why }) {
            let _ = self.ends.push((call, why));
        }
    }

    /// Notifies the peer of ends that waited for send capacity.
    pub(super) fn send_ends<P: Port>(&mut self, wire: &mut Wire<P>, cx: &mut Context<'_, P>) {
        while let Some(&(call, why)) = self.ends.last()
            && wire.send_control(cx, &Control::LeaseEnded { call, why })
        {
            self.ends.pop();
        }
    }
}

fn lease_of<'c, P: Port>(cx: &Context<'c, P>, granted: &Granted) -> Option<&'c Lease> {
    service_of(cx, granted.slot, granted.generation).and_then(Service::lease)
}

/// Whether an order was ended other than by its link, and its safe hook is due.
fn is_dead<P: Port>(cx: &Context<'_, P>, granted: &Granted) -> bool {
    lease_of(cx, granted).zip(granted.order).is_some_and(|(lease, order)| lease.is_cut(order))
}

fn is_live<P: Port>(cx: &Context<'_, P>, granted: &Granted) -> bool {
    granted.end > cx.now && !is_dead(cx, granted)
}

/// How an order ended that its caller had not given up.
fn how_it_died<P: Port>(cx: &Context<'_, P>, granted: &Granted) -> LeaseEnd {
    let is_inhibited = lease_of(cx, granted).is_some_and(Lease::is_inhibited);
    if is_inhibited { LeaseEnd::Stopped } else { LeaseEnd::Expired }
}

/// Whether two services move the same actuator.
fn share_a_lease(one: Option<&dyn Service>, other: Option<&dyn Service>) -> bool {
    let leases = one.and_then(Service::lease).zip(other.and_then(Service::lease));
    leases.is_some_and(|(one, other)| core::ptr::eq(one, other))
}

fn service_of<'c, P: Port>(cx: &Context<'c, P>, slot: Slot, generation: Generation) -> Option<&'c dyn Service> {
    cx.functions.lookup(slot, generation).ok().map(|function| function.handler)
}

/// Ends an order; returns whether the safe hook has to run. Not if a call of another peer has taken over the lease, since its
/// motion continues, nor if the service was removed, since its hook ran then.
pub(super) fn expire_granted<P: Port>(cx: &Context<'_, P>, granted: &Granted, how: LeaseEnd) -> bool {
    let service = service_of(cx, granted.slot, granted.generation);
    service.is_some_and(|service| granted.order.is_none_or(|order| service.expire_lease(cx.now, order, how)))
}
