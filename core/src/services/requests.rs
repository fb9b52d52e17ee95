//! This unit's calls that wait for a reply, and the check of the minimum interval.

use crate::config::{EMERGENCY_CALLS, Priority};
use crate::distribution::function_list::{Generation, Slot};
use crate::error::{Error, Limit};
use crate::storage::Storage;
use crate::time::{Duration, Instant};

/// Names a request within its session. Each request has a higher one than the last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CallId(pub u32);

/// The position of a call among those of its link, in the order in which they were made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Made(u32);

impl Made {
    pub(crate) const fn number(self) -> u32 {
        self.0
    }
}

/// A call that waits for its reply.
#[derive(Clone, Copy, Debug)]
pub struct Pending {
    pub(crate) id: CallId,
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    pub(crate) deadline: Instant,
    /// The class of a call whose function has a lease: the call is released if it fails.
    pub(crate) leased: Option<Priority>,
    /// The class of the call.
    pub(crate) class: Priority,
    /// The call has ended, and its release has not been sent in the stream yet.
    pub(crate) release_unsent: bool,
}

/// The table of calls in flight to one peer: lent slots, indexed by id, and a few reserved for emergencies.
pub struct Requests<S: Storage> {
    pending: S::Slice<Option<Pending>>,
    /// How many slots of `pending` are taken.
    in_flight: usize,
    /// Emergencies that found no free slot in `pending`.
    urgent: [Option<Pending>; EMERGENCY_CALLS],
    next_id: u32,
    /// How many calls have been made, including those that wait to be sent.
    made: u32,
    last_request: Option<Instant>,
}

impl<S: Storage> Requests<S> {
    /// A table with these slots.
    pub fn new(pending: S::Slice<Option<Pending>>) -> Self {
        Self { pending, in_flight: 0, urgent: [None; EMERGENCY_CALLS], next_id: 1, made: 0, last_request: None }
    }

    /// [`Error::TooSoon`] if `interval` has not passed since the last request.
    pub(crate) fn gate(&self, now: Instant, interval: Duration) -> Result<(), Error> {
        let Some(last) = self.last_request else { return Ok(()) };
        let wait = (last + interval).since(now);
        if wait == Duration::ZERO { Ok(()) } else { Err(Error::TooSoon { wait }) }
    }

    /// Records that a request was sent, for [`gate`](Self::gate).
    pub(crate) fn sent(&mut self, now: Instant) {
        self.last_request = Some(now);
    }

    /// An id for a request without a reply. `None` if the ids are used up.
    pub(crate) fn next_id(&mut self) -> Option<CallId> {
        let id = self.next_id;
        self.next_id = id.checked_add(1)?;
        Some(CallId(id))
    }

    /// Numbers a call, which may be sent later. Cannot overflow: calls are no more than ids, and the link ends at the last id.
    pub(crate) fn make(&mut self) -> Made {
        self.made = self.made.saturating_add(1);
        Made(self.made)
    }

    /// The number of a call that is sent now: the one that it got when it was made, or a new one if that was of an earlier link.
    pub(crate) fn made(&mut self, earlier: Option<Made>) -> Made {
        match earlier {
            Some(made) if made.0 <= self.made => made,
            _ => self.make(),
        }
    }

    /// The newest id; 0 before the first.
    pub(crate) const fn newest(&self) -> CallId {
        CallId(self.next_id.saturating_sub(1))
    }

    /// An id and a slot for a call; an emergency may take a reserved slot.
    pub(crate) fn open(
        &mut self,
        slot: Slot,
        generation: Generation,
        deadline: Instant,
        class: Priority,
        leased: bool,
        is_urgent: bool,
    ) -> Result<Option<CallId>, Error> {
        let pending = |id| Pending {
            id,
            slot,
            generation,
            deadline,
            leased: leased.then_some(class),
            class,
            release_unsent: false,
        };
        if self.in_flight >= self.pending.len() {
            return if is_urgent { self.open_urgent(&pending(CallId(0))) } else { Err(Error::Full(Limit::Calls)) };
        }
        // An id determines its slot, so skip ids whose slot is taken. One is free, so the loop finds it.
        for _ in 0..self.pending.len() {
            let Some(id) = self.next_id() else { return Ok(None) };
            let Some(place) = self.place(id) else { continue };
            if place.is_none() {
                *place = Some(pending(id));
                self.in_flight = self.in_flight.saturating_add(1);
                return Ok(Some(id));
            }
        }
        Err(Error::Full(Limit::Calls))
    }

    /// A reserved slot for an emergency when the table is full.
    #[cold]
    fn open_urgent(&mut self, pending: &Pending) -> Result<Option<CallId>, Error> {
        let free = self.urgent.iter().position(Option::is_none).ok_or(Error::Full(Limit::Calls))?;
        let Some(id) = self.next_id() else { return Ok(None) };
        if let Some(place) = self.urgent.get_mut(free) {
            *place = Some(Pending { id, ..*pending });
        }
        Ok(Some(id))
    }

    /// Ends a call and frees its slot. `None` if it had ended before.
    pub(crate) fn close(&mut self, id: CallId) -> Option<Pending> {
        self.take(id, false)
    }

    /// Removes a call that waits for its reply, or one whose release has yet to be sent.
    fn take(&mut self, id: CallId, release_unsent: bool) -> Option<Pending> {
        let is_meant = |pending: &mut Pending| pending.id == id && pending.release_unsent == release_unsent;
        if let Some(pending) = self.place(id).and_then(|place| place.take_if(is_meant)) {
            self.in_flight = self.in_flight.saturating_sub(1);
            return Some(pending);
        }
        self.take_urgent(id, release_unsent)
    }

    #[cold]
    fn take_urgent(&mut self, id: CallId, release_unsent: bool) -> Option<Pending> {
        let is_meant = |pending: &mut Pending| pending.id == id && pending.release_unsent == release_unsent;
        self.urgent.iter_mut().find_map(|place| place.take_if(is_meant))
    }

    /// Ends one call whose deadline has passed.
    pub(crate) fn expire(&mut self, now: Instant) -> Option<Pending> {
        let due = self.waiting().find(|pending| pending.deadline <= now).map(|pending| pending.id);
        due.and_then(|id| self.close(id))
    }

    /// Ends any one call, because the link has ended.
    pub(crate) fn interrupt(&mut self) -> Option<CallId> {
        let id = self.waiting().map(|pending| pending.id).min()?;
        self.close(id).map(|pending| pending.id)
    }

    /// A call that waits for its reply.
    pub(crate) fn waiting_for(&self, id: CallId) -> Option<&Pending> {
        let index = (id.0 as usize).checked_rem(self.pending.len())?;
        let place = self.pending.get(index)?.as_ref().filter(|pending| pending.id == id);
        place.or_else(|| self.urgent.iter().flatten().find(|pending| pending.id == id)).filter(|it| !it.release_unsent)
    }

    fn waiting(&self) -> impl Iterator<Item = &Pending> {
        self.all().filter(|pending| !pending.release_unsent)
    }

    fn all(&self) -> impl Iterator<Item = &Pending> {
        self.pending.iter().chain(&self.urgent).flatten()
    }

    /// Keeps a call that was just closed in its slot until its release has been sent.
    pub(crate) fn keep_unsent_release(&mut self, pending: Pending) {
        let kept = Some(Pending { release_unsent: true, ..pending });
        match self.place(pending.id) {
            Some(place) if place.is_none() => {
                *place = kept;
                self.in_flight = self.in_flight.saturating_add(1);
            }
            // It was an emergency in a reserved slot, and another call has the slot of its id.
            _ => self.urgent.iter_mut().filter(|place| place.is_none()).take(1).for_each(|place| *place = kept),
        }
    }

    /// A call whose release has yet to be sent, and its class.
    pub(crate) fn unsent_release(&self) -> Option<(CallId, Priority)> {
        let due = self.all().find(|pending| pending.release_unsent)?;
        due.leased.map(|class| (due.id, class))
    }

    /// The release has been sent.
    pub(crate) fn release_sent(&mut self, id: CallId) {
        self.take(id, true);
    }

    /// Moves to more slots: a multiple of the present number, since ids determine slots modulo that number. Returns the unused
    /// slots: the new ones if they do not fit.
    pub(crate) fn grow(&mut self, mut pending: S::Slice<Option<Pending>>) -> S::Slice<Option<Pending>> {
        let times = pending.len().checked_rem(self.pending.len());
        if pending.len() < self.pending.len() || times.is_some_and(|rest| rest != 0) {
            return pending;
        }
        pending.iter_mut().for_each(|slot| *slot = None);
        core::mem::swap(&mut self.pending, &mut pending);
        for call in pending.iter().flatten() {
            if let Some(place) = self.place(call.id) {
                *place = Some(*call);
            }
        }
        pending
    }

    /// How many calls may be in flight.
    pub(crate) fn slots(&self) -> usize {
        self.pending.len()
    }

    /// The slots, cleared for the next session.
    pub(crate) fn into_slots(mut self) -> S::Slice<Option<Pending>> {
        self.pending.iter_mut().for_each(|slot| *slot = None);
        self.pending
    }

    /// How many calls wait for a reply.
    pub fn in_flight(&self) -> usize {
        self.in_flight.saturating_add(self.urgent.iter().flatten().count())
    }

    /// When the first waiting call times out.
    pub(crate) fn deadline(&self) -> Instant {
        self.waiting().map(|pending| pending.deadline).min().unwrap_or(Instant::FAR_FUTURE)
    }

    fn place(&mut self, id: CallId) -> Option<&mut Option<Pending>> {
        let index = (id.0 as usize).checked_rem(self.pending.len())?;
        self.pending.get_mut(index)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::arithmetic_side_effects, clippy::indexing_slicing)]
    use super::*;
    use crate::storage::Boxed;
    use proptest::prelude::*;
    use std::collections::BTreeMap;
    use std::vec;
    use std::vec::Vec;

    fn table(slots: usize) -> Requests<Boxed> {
        Requests::new(vec![None; slots].into_boxed_slice())
    }

    fn open(requests: &mut Requests<Boxed>, deadline: u64) -> Result<Option<CallId>, Error> {
        requests.open(Slot(0), Generation(0), Instant::from_micros(deadline), Priority::Low, false, false)
    }

    #[test]
    fn a_full_table_names_its_limit_and_a_closed_call_frees_its_slot() {
        let mut requests = table(2);
        let first = open(&mut requests, 10).unwrap().unwrap();
        open(&mut requests, 10).unwrap();
        assert_eq!(open(&mut requests, 10), Err(Error::Full(Limit::Calls)));
        assert!(requests.close(first).is_some());
        assert!(requests.close(first).is_none());
        assert!(open(&mut requests, 10).unwrap().is_some());
    }

    #[test]
    fn a_call_in_a_reserved_slot_is_found_by_its_own_id_and_its_release_by_none() {
        let mut requests = table(1);
        let first = open(&mut requests, 90).unwrap().unwrap();
        let stops = [20, 21].map(|deadline| {
            let deadline = Instant::from_micros(deadline);
            requests.open(Slot(1), Generation(0), deadline, Priority::Emergency, true, true).unwrap().unwrap()
        });
        assert!(stops.iter().all(|stop| requests.waiting_for(*stop).is_some_and(|found| found.id == *stop)));
        let closed = requests.close(first).unwrap();
        requests.keep_unsent_release(closed);
        assert!(requests.waiting_for(first).is_none());
        assert_eq!(open(&mut requests, 90), Err(Error::Full(Limit::Calls)), "its slot is its own again");
    }

    #[test]
    fn no_slots_are_no_more_slots() {
        let mut requests = table(2);
        assert_eq!((requests.grow(vec![].into_boxed_slice()).len(), requests.slots()), (0, 2));
    }

    #[test]
    fn a_number_that_only_an_earlier_link_has_reached_is_not_kept() {
        let (mut earlier, mut requests) = (table(1), table(1));
        let numbers = [(); 3].map(|()| earlier.make());
        requests.make();
        assert_eq!(requests.made(Some(numbers[0])).number(), 1);
        assert_eq!(requests.made(Some(numbers[2])).number(), 2);
        assert_eq!(requests.made(None).number(), 3);
    }

    /// `docs/safety.md`, what a stop waits for: the caller's table of calls.
    #[test]
    fn a_full_table_has_slots_left_for_emergencies() {
        let stop = |requests: &mut Requests<Boxed>, deadline, leased| {
            let deadline = Instant::from_micros(deadline);
            requests.open(Slot(1), Generation(0), deadline, Priority::Emergency, leased, true).map(Option::unwrap)
        };
        let mut requests = table(2);
        let (first, _) = (open(&mut requests, 90).unwrap().unwrap(), open(&mut requests, 90).unwrap());
        let stops: Vec<_> = (0..8).map(|at| stop(&mut requests, 20 + at, at == 7).unwrap()).collect();
        assert_eq!((requests.in_flight(), requests.deadline()), (10, Instant::from_micros(20)));
        assert_eq!(stop(&mut requests, 20, false), Err(Error::Full(Limit::Calls)), "so many and no more");
        // The slot of its id is another call's, which keeps it.
        assert!(requests.close(stops[0]).is_some() && requests.close(stops[0]).is_none());
        assert!(requests.close(first).is_some());
        assert!(stop(&mut requests, 30, false).is_ok() && stop(&mut requests, 30, false).is_ok());
        assert_eq!(open(&mut requests, 90), Err(Error::Full(Limit::Calls)), "none of them is for other calls");
        let late = requests.expire(Instant::from_micros(21)).unwrap();
        assert_eq!(late.id, stops[1]);
        let leased = requests.close(stops[7]).unwrap();
        requests.keep_unsent_release(leased);
        assert_eq!(requests.unsent_release(), Some((stops[7], Priority::Emergency)));
        requests.release_sent(stops[7]);
        while requests.interrupt().is_some() {}
        assert_eq!((requests.in_flight(), requests.unsent_release()), (0, None));
    }

    #[test]
    fn a_reply_is_matched_by_its_id_and_not_by_its_slot() {
        let mut requests = table(2);
        let first = open(&mut requests, 10).unwrap().unwrap();
        assert!(requests.close(first).is_some());
        open(&mut requests, 10).unwrap();
        let third = open(&mut requests, 10).unwrap().unwrap();
        assert_eq!(third.0 % 2, first.0 % 2, "the two share a slot");
        assert!(requests.close(first).is_none(), "the late reply to the first is taken for that to the third");
        assert!(requests.close(third).is_some());
    }

    #[test]
    fn a_release_that_waits_for_room_keeps_its_slot_and_no_reply() {
        let mut requests = table(2);
        let leased =
            requests.open(Slot(0), Generation(0), Instant::from_micros(10), Priority::Low, true, false).unwrap();
        let pending = requests.expire(Instant::from_micros(10)).unwrap();
        requests.keep_unsent_release(pending);
        assert_eq!(requests.unsent_release(), Some((leased.unwrap(), Priority::Low)));
        assert!(requests.close(pending.id).is_none() && requests.expire(Instant::FAR_FUTURE).is_none());
        assert_eq!((requests.interrupt(), requests.in_flight()), (None, 1));
        requests.release_sent(pending.id);
        assert_eq!((requests.unsent_release(), requests.in_flight()), (None, 0));
    }

    #[test]
    fn the_gate_tells_how_long_to_wait() {
        let mut requests = table(1);
        let interval = Duration::from_millis(10);
        assert_eq!(requests.gate(Instant::START, interval), Ok(()));
        requests.sent(Instant::START);
        let later = Instant::from_micros(4_000);
        assert_eq!(requests.gate(later, interval), Err(Error::TooSoon { wait: Duration::from_millis(6) }));
        assert_eq!(requests.gate(Instant::from_micros(10_000), interval), Ok(()));
        let default = crate::config::Constraints::M_UNIT.minimum_interval;
        assert_eq!((default, requests.gate(Instant::START, default)), (Duration::ZERO, Ok(())), "one behind the other");
    }

    #[test]
    fn calls_in_flight_keep_their_ids_when_there_are_more_slots() {
        let mut requests = table(2);
        let ids = [30, 10].map(|deadline| open(&mut requests, deadline).unwrap().unwrap());
        assert_eq!(requests.grow(vec![None; 1].into_boxed_slice()).len(), 1, "fewer are given back");
        assert_eq!(requests.grow(vec![None; 3].into_boxed_slice()).len(), 3, "no multiple");
        assert_eq!(requests.grow(vec![None; 6].into_boxed_slice()).len(), 2);
        assert_eq!((requests.slots(), requests.in_flight()), (6, 2));
        (0..4).for_each(|_| assert!(open(&mut requests, 50).is_ok()));
        assert_eq!(open(&mut requests, 50), Err(Error::Full(Limit::Calls)));
        assert_eq!(requests.expire(Instant::from_micros(20)).map(|pending| pending.id), Some(ids[1]));
        assert_eq!(requests.close(ids[0]).unwrap().deadline, Instant::from_micros(30));
        assert_eq!(requests.in_flight(), 4);
    }

    proptest! {
        #[test]
        fn the_table_agrees_with_a_map(steps in prop::collection::vec((0..4u8, 0..40u64), 0..200)) {
            let mut requests = table(5);
            let mut model: BTreeMap<CallId, u64> = BTreeMap::new();
            let mut now = 0;
            for (step, value) in steps {
                match step {
                    0 | 1 => match open(&mut requests, now + value) {
                        Ok(id) => { model.insert(id.unwrap(), now + value); }
                        Err(_) => prop_assert_eq!(model.len(), 5),
                    },
                    2 => {
                        let id = model.keys().nth(value as usize % model.len().max(1)).copied();
                        if let Some(id) = id {
                            prop_assert!(requests.close(id).is_some());
                            model.remove(&id);
                        }
                    }
                    _ => {
                        now += value;
                        while let Some(ended) = requests.expire(Instant::from_micros(now)) {
                            prop_assert!(model.remove(&ended.id).unwrap() <= now);
                        }
                        prop_assert!(model.values().all(|deadline| *deadline > now));
                        let earliest = model.values().min().map_or(Instant::FAR_FUTURE, |d| Instant::from_micros(*d));
                        prop_assert!(requests.deadline() <= earliest);
                    }
                }
                prop_assert_eq!(requests.in_flight(), model.len());
            }
        }
    }
}
