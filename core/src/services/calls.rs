//! Calls of a peer: at most once, begun in order within a class, side by side, bounded.
//!
//! A call that may begin now becomes a ticket, whatever else runs; one for which no slot is free waits in its class's
//! queue, and those behind it wait as well. Some slots are kept for emergencies, and one place to wait, so that other
//! calls cannot keep them out, nor two calls of one emergency service those of another one.

use crate::bytes;
use crate::config::{EMERGENCY_BYTES, Priority, WINDOW};
use crate::distribution::function_list::{Generation, Slot};
use crate::error::{Error, Limit};
use crate::storage::{Buffer, Buffers, Storage, take_at};
use crate::time::{Duration, Instant};

/// Which ids of one class have been seen. Serves the stream and datagrams alike.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    newest: u32,
    seen: u64,
}

/// What the window says about an id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Seen {
    /// New, and recorded now.
    Never,
    /// Recorded before: a duplicate, to be dropped without an answer, since the first copy is answered.
    Before,
    /// Below the window, so that it cannot be decided.
    TooOld,
}

impl Window {
    fn note(&mut self, id: u32) -> Seen {
        if id > self.newest {
            let ahead = id.saturating_sub(self.newest);
            self.seen = self.seen.checked_shl(ahead).unwrap_or(0) | 1;
            self.newest = id;
            return Seen::Never;
        }
        let behind = self.newest.saturating_sub(id);
        if behind >= WINDOW {
            return Seen::TooOld;
        }
        let bit = 1_u64.checked_shl(behind).unwrap_or(0);
        if self.seen & bit != 0 && !cfg!(cara_planted = "double_execution") {
            return Seen::Before;
        }
        self.seen |= bit;
        Seen::Never
    }

    /// Whether an id was noted, or is so old that it may have been.
    fn knows(&self, id: u32) -> bool {
        let behind = self.newest.saturating_sub(id);
        let bit = 1_u64.checked_shl(behind).unwrap_or(0);
        id <= self.newest && (behind >= WINDOW || self.seen & bit != 0)
    }
}

/// Names a call that runs: to be answered exactly once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Ticket {
    index: u16,
    id: u32,
}

/// A call that was accepted, without its arguments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CallHead {
    /// The caller's id of it.
    pub id: u32,
    /// The function called.
    pub slot: Slot,
    /// The life of the function.
    pub generation: Generation,
    /// Its class.
    pub priority: Priority,
    /// Whether the caller waits.
    pub wants_reply: bool,
    /// Whether it takes over what another caller moves.
    pub takes_over: bool,
    /// Whether an operator of the caller's unit made it.
    pub operator: bool,
    /// Whether its results let what was stopped move again; known once it begins.
    pub resets: bool,
    /// After this the caller no longer waits, and the call is not begun.
    pub deadline: Instant,
    /// The earliest time at which the caller can have made the request: its age is counted from here.
    pub sent_at: Instant,
}

/// So many requests that were given up before they arrived are remembered beside the windows.
const UNWANTED: usize = 8;

/// Bytes of a call's head in a queue.
const HEAD_BYTES: usize = 32;
/// Where its deadline is.
const DEADLINE: usize = 16;

/// Calls of one peer that run or wait.
pub(crate) struct Calls<S: Storage> {
    windows: [Window; 4],
    /// Requests that the caller gave up before they arrived here.
    unwanted: heapless::Vec<(u32, Priority), UNWANTED>,
    running: S::Slice<Option<CallHead>>,
    queues: [Option<Queue<S>>; 3],
    emergency: Option<(CallHead, heapless::Vec<u8, EMERGENCY_BYTES>)>,
    held: u16,
    /// When the next request is due by the minimum interval.
    due: Instant,
}

struct Queue<S: Storage> {
    buffer: Buffer<S>,
    start: usize,
    end: usize,
}

/// Calls of one emergency service that one peer may have running; the next one is told `Busy`.
const EMERGENCIES_OF_ONE: usize = 2;

/// Of so many slots, those that are kept for emergencies.
const fn kept(slots: usize) -> usize {
    if slots < 8 { 1 } else { slots / 4 }
}

/// Slots that a link needs for so many calls to run at the same time, those that are kept for emergencies included.
pub const fn slots_for(running: usize) -> usize {
    let kept = if running < 6 { 1 } else { running / 3 };
    running.saturating_add(kept)
}

impl<S: Storage> Calls<S> {
    /// `running` bounds the calls that run at the same time; one slot in four, at least one, is kept for emergencies.
    pub(crate) fn new(running: S::Slice<Option<CallHead>>) -> Self {
        Self {
            windows: [Window::default(); 4],
            unwanted: heapless::Vec::new(),
            running,
            queues: [const { None }; 3],
            emergency: None,
            held: 0,
            due: Instant::START,
        }
    }

    /// Notes a request's id in the window of its class.
    pub(crate) fn note(&mut self, priority: Priority, id: u32) -> Seen {
        let seen = self.windows.get_mut(usize::from(priority.to_wire())).map_or(Seen::TooOld, |window| window.note(id));
        if self.unwanted.is_empty() || seen != Seen::Never {
            return seen;
        }
        let unwanted = self.unwanted.len();
        self.unwanted.retain(|unwanted| *unwanted != (id, priority));
        if self.unwanted.len() < unwanted { Seen::Before } else { Seen::Never }
    }

    /// Whether a request has arrived, as far back as the window of its class reaches.
    pub(crate) fn has_arrived(&self, class: Priority, id: u32) -> bool {
        self.windows.get(usize::from(class.to_wire())).is_some_and(|window| window.knows(id))
    }

    /// Whether a call has arrived and not begun yet.
    pub(crate) fn is_waiting(&self, class: Priority, id: u32) -> bool {
        match queue_index(class) {
            None => self.emergency.as_ref().is_some_and(|(head, _)| head.id == id),
            Some(index) => {
                self.queues.get(index).and_then(Option::as_ref).is_some_and(|queue| queue.find(id).is_some())
            }
        }
    }

    /// The caller no longer wants a call. One that waits runs out at once, and is refused when its turn comes; one that has
    /// not arrived is passed over when it does.
    pub(crate) fn give_up(&mut self, class: Priority, id: u32) {
        if !self.has_arrived(class, id) {
            return self.keep_out(class, id);
        }
        match queue_index(class) {
            None => {
                if let Some((head, _)) = self.emergency.as_mut().filter(|(head, _)| head.id == id) {
                    head.deadline = Instant::START;
                }
            }
            Some(index) => {
                if let Some(queue) = self.queues.get_mut(index).and_then(Option::as_mut) {
                    queue.run_out(id);
                }
            }
        }
    }

    /// A window that went ahead to this id would take earlier requests that are still on their way for too old.
    fn keep_out(&mut self, class: Priority, id: u32) {
        let known = self.unwanted.contains(&(id, class));
        if !known && self.unwanted.push((id, class)).is_err() {
            let oldest = self.unwanted.iter().enumerate().min_by_key(|(_, (id, _))| *id).map(|(index, _)| index);
            if let Some((oldest, its_class)) = oldest.and_then(|index| take_at(&mut self.unwanted, index)) {
                self.note(its_class, oldest);
            }
            let _ = self.unwanted.push((id, class));
        }
    }

    /// Whether any call has not begun yet.
    pub(crate) fn any_waiting(&self) -> bool {
        self.emergency.is_some() || self.queues.iter().any(Option::is_some)
    }

    /// The callee's side of the minimum interval. One request may come early by a whole interval, because a network
    /// does not keep distances.
    pub(crate) fn interval(&mut self, now: Instant, interval: Duration) -> Result<(), Error> {
        if interval == Duration::ZERO {
            return Ok(());
        }
        let wait = self.due.since(now + interval);
        if wait > Duration::ZERO {
            return Err(Error::TooSoon { wait });
        }
        self.due = self.due.max(now) + interval;
        Ok(())
    }

    /// Whether a call of this class may begin at once: a slot is free, nothing of the class waits, and no other class has
    /// a call that came before and may begin.
    pub(crate) fn is_idle(&self, priority: Priority) -> bool {
        if self.free_slot(priority == Priority::Emergency).is_none() {
            return false;
        }
        !self.any_waiting() || !self.class_waits(priority) && (priority == Priority::Emergency || !self.can_begin())
    }

    /// An empty slot; the last ones are for emergencies, which take those first.
    fn free_slot(&self, emergency: bool) -> Option<usize> {
        if emergency {
            return self.running.iter().rposition(Option::is_none);
        }
        let free = self.running.len().saturating_sub(kept(self.running.len()));
        self.running.iter().take(free).position(Option::is_none)
    }

    fn class_waits(&self, priority: Priority) -> bool {
        match queue_index(priority) {
            None => self.emergency.is_some(),
            Some(index) => self.queues.get(index).is_some_and(Option::is_some),
        }
    }

    /// [`Error::Busy`] when the peer has as many calls here as it may; of an emergency service it may have two running,
    /// whatever else there is.
    pub(crate) fn admit(&self, slot: Slot, is_emergency: bool, limit: u16) -> Result<(), Error> {
        let free = if is_emergency { self.emergencies_of(slot) < EMERGENCIES_OF_ONE } else { self.held < limit };
        if free { Ok(()) } else { Err(Error::Busy) }
    }

    fn emergencies_of(&self, slot: Slot) -> usize {
        let same = |head: &&CallHead| head.slot == slot && head.priority == Priority::Emergency;
        self.running.iter().flatten().filter(same).count()
    }

    /// Whether one more call of any class with a block of `bytes` could wait, as far as this peer's own calls go.
    pub(crate) fn has_room(&self, limit: u16, bytes: usize) -> bool {
        let needed = HEAD_BYTES.saturating_add(bytes);
        self.held < limit && self.queues.iter().flatten().all(|queue| queue.room() >= needed)
    }

    /// Begins a call; one of an emergency service may take a slot that is kept for those.
    pub(crate) fn begin(&mut self, head: CallHead, is_emergency: bool) -> Result<Ticket, Error> {
        let index = self.free_slot(is_emergency).ok_or(Error::Busy)?;
        let place = self.running.get_mut(index).ok_or(Error::Full(Limit::IncomingCalls))?;
        *place = Some(head);
        self.held = self.held.saturating_add(1);
        Ok(Ticket { index: index as u16, id: head.id })
    }

    /// The call of a ticket, unless it was answered already.
    pub(crate) fn call(&self, ticket: Ticket) -> Option<CallHead> {
        self.running.get(usize::from(ticket.index)).copied().flatten().filter(|head| head.id == ticket.id)
    }

    /// Ends a call; `false` when it was ended already.
    pub(crate) fn end(&mut self, ticket: Ticket) -> bool {
        let Some(place) = self.running.get_mut(usize::from(ticket.index)) else { return false };
        if place.take_if(|head| head.id == ticket.id).is_none() {
            return false;
        }
        self.held = self.held.saturating_sub(1);
        true
    }

    /// Keeps a call until it may begin. If it needs a buffer, it leaves so many others in the pool.
    pub(crate) fn wait(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        left: usize,
        head: CallHead,
        block: &[u8],
    ) -> Result<(), Error> {
        let Some(index) = queue_index(head.priority) else { return self.wait_emergency(head, block) };
        let slot = self.queues.get_mut(index).ok_or(Error::Busy)?;
        let queue = match slot {
            Some(queue) => queue,
            None => slot.insert(Queue { buffer: buffers.take_leaving(left).ok_or(Error::Busy)?, start: 0, end: 0 }),
        };
        let result = queue.push(head, block);
        if result.is_ok() {
            self.held = self.held.saturating_add(1);
        } else if queue.is_empty()
            && let Some(queue) = slot.take()
        {
            buffers.give(queue.buffer);
        }
        result
    }

    fn wait_emergency(&mut self, head: CallHead, block: &[u8]) -> Result<(), Error> {
        if self.emergency.is_some() {
            return Err(Error::Busy);
        }
        let block = heapless::Vec::from_slice(block).map_err(|_| Error::Busy)?;
        self.emergency = Some((head, block));
        self.held = self.held.saturating_add(1);
        Ok(())
    }

    /// Whether a call waits for which a slot is free.
    pub(crate) fn can_begin(&self) -> bool {
        self.next_class().is_some()
    }

    /// Whether an emergency waits for which a slot is free.
    pub(crate) fn has_next_emergency(&self) -> bool {
        self.emergency.is_some() && self.free_slot(true).is_some()
    }

    /// Takes the next call that may begin and shows its block to `look`.
    pub(crate) fn take_next<R>(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        look: impl FnOnce(CallHead, &[u8]) -> R,
    ) -> Option<(CallHead, R)> {
        let class = self.next_class()?;
        self.held = self.held.saturating_sub(1);
        let Some(index) = queue_index(class) else {
            let (head, block) = self.emergency.take()?;
            let result = look(head, &block);
            return Some((head, result));
        };
        let slot = self.queues.get_mut(index)?;
        let queue = slot.as_mut()?;
        let taken = queue.pop(class, look);
        if queue.is_empty()
            && let Some(queue) = slot.take()
        {
            buffers.give(queue.buffer);
        }
        taken
    }

    fn next_class(&self) -> Option<Priority> {
        if !self.any_waiting() {
            return None;
        }
        let may_begin =
            |class: &Priority| self.class_waits(*class) && self.free_slot(*class == Priority::Emergency).is_some();
        Priority::ALL.into_iter().find(may_begin)
    }

    /// Forgets what waits and gives the buffers back. Running calls may still be ended.
    pub(crate) fn release(&mut self, buffers: &mut dyn Buffers<S>) {
        for queue in self.queues.iter_mut().filter_map(Option::take) {
            buffers.give(queue.buffer);
        }
        self.emergency = None;
        self.held = self.running.iter().flatten().count() as u16;
    }

    /// Moves the running calls to more slots. Returns the slots that are not needed any more.
    pub(crate) fn grow(&mut self, mut running: S::Slice<Option<CallHead>>) -> S::Slice<Option<CallHead>> {
        if running.len() < self.running.len() {
            return running;
        }
        running.iter_mut().for_each(|slot| *slot = None);
        // A ticket names its slot by number.
        running.iter_mut().zip(self.running.iter()).for_each(|(new, old)| *new = *old);
        core::mem::replace(&mut self.running, running)
    }

    /// How many calls may run.
    pub(crate) fn slots(&self) -> usize {
        self.running.len()
    }

    /// The slots, all empty.
    pub(crate) fn into_slots(mut self) -> S::Slice<Option<CallHead>> {
        self.running.iter_mut().for_each(|slot| *slot = None);
        self.running
    }

    /// Calls that run or wait.
    pub(crate) const fn held(&self) -> u16 {
        self.held
    }
}

impl<S: Storage> Queue<S> {
    fn room(&self) -> usize {
        self.buffer.len().saturating_sub(self.end.saturating_sub(self.start))
    }

    fn is_empty(&self) -> bool {
        self.start >= self.end
    }

    fn push(&mut self, head: CallHead, block: &[u8]) -> Result<(), Error> {
        let needed = HEAD_BYTES.saturating_add(block.len());
        if needed > self.buffer.len().saturating_sub(self.end) {
            bytes::move_down(&mut self.buffer, self.start..self.end);
            self.end = self.end.saturating_sub(self.start);
            self.start = 0;
        }
        let end = self.end.saturating_add(needed);
        let place = self.buffer.get_mut(self.end..end).ok_or(Error::Busy)?;
        let (head_place, block_place) = place.split_first_chunk_mut().ok_or(Error::Busy)?;
        *head_place = encode_head(&head, block.len());
        bytes::copy(block, block_place);
        self.end = end;
        Ok(())
    }

    /// Where the head of a call is.
    fn find(&self, id: u32) -> Option<usize> {
        let mut at = self.start;
        while at < self.end {
            let head = self.buffer.get(at..self.end)?.first_chunk()?;
            let (head, length) = decode_head(head, Priority::Normal);
            if head.id == id {
                return Some(at);
            }
            at = at.saturating_add(HEAD_BYTES).saturating_add(length);
        }
        None
    }

    fn run_out(&mut self, id: u32) {
        let Some(at) = self.find(id) else { return };
        let deadline = at.saturating_add(DEADLINE)..at.saturating_add(DEADLINE).saturating_add(8);
        self.buffer.get_mut(deadline).unwrap_or_default().fill(0);
    }

    fn pop<R>(&mut self, priority: Priority, look: impl FnOnce(CallHead, &[u8]) -> R) -> Option<(CallHead, R)> {
        let waiting = self.buffer.get(self.start..self.end)?;
        let (head, rest) = waiting.split_first_chunk::<HEAD_BYTES>()?;
        let (head, length) = decode_head(head, priority);
        let result = look(head, rest.get(..length)?);
        self.start = self.start.saturating_add(HEAD_BYTES).saturating_add(length);
        Some((head, result))
    }
}

fn encode_head(head: &CallHead, block: usize) -> [u8; HEAD_BYTES] {
    let [l0, l1, l2, l3] = (block as u32).to_le_bytes();
    let [i0, i1, i2, i3] = head.id.to_le_bytes();
    let ([s0, s1], [g0, g1]) = (head.slot.0.to_le_bytes(), head.generation.0.to_le_bytes());
    let [f0, f1, f2] = [head.wants_reply, head.takes_over, head.operator].map(u8::from);
    let [d0, d1, d2, d3, d4, d5, d6, d7] = head.deadline.as_micros().to_le_bytes();
    let [m0, m1, m2, m3, m4, m5, m6, m7] = head.sent_at.as_micros().to_le_bytes();
    [
        l0, l1, l2, l3, i0, i1, i2, i3, s0, s1, g0, g1, f0, f1, f2, 0, d0, d1, d2, d3, d4, d5, d6, d7, m0, m1, m2, m3,
        m4, m5, m6, m7,
    ]
}

fn decode_head(bytes: &[u8; HEAD_BYTES], priority: Priority) -> (CallHead, usize) {
    let [l0, l1, l2, l3, i0, i1, i2, i3, s0, s1, g0, g1, wants_reply, takes_over, operator, _, rest @ ..] = *bytes;
    let [d0, d1, d2, d3, d4, d5, d6, d7, m0, m1, m2, m3, m4, m5, m6, m7] = rest;
    let head = CallHead {
        id: u32::from_le_bytes([i0, i1, i2, i3]),
        slot: Slot(u16::from_le_bytes([s0, s1])),
        generation: Generation(u16::from_le_bytes([g0, g1])),
        priority,
        wants_reply: wants_reply != 0,
        takes_over: takes_over != 0,
        operator: operator != 0,
        resets: false,
        deadline: Instant::from_micros(u64::from_le_bytes([d0, d1, d2, d3, d4, d5, d6, d7])),
        sent_at: Instant::from_micros(u64::from_le_bytes([m0, m1, m2, m3, m4, m5, m6, m7])),
    };
    (head, u32::from_le_bytes([l0, l1, l2, l3]) as usize)
}

const fn queue_index(priority: Priority) -> Option<usize> {
    match priority {
        Priority::Emergency => None,
        Priority::High => Some(0),
        Priority::Normal => Some(1),
        Priority::Low => Some(2),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::indexing_slicing, clippy::unwrap_used, clippy::panic, clippy::arithmetic_side_effects)]
    use super::*;
    use crate::storage::{Boxed, LEFT_BY_WAITING, Pool};
    use proptest::prelude::*;
    use std::collections::BTreeSet;
    use std::collections::VecDeque;
    use std::vec;
    use std::vec::Vec;

    fn calls(slots: usize) -> Calls<Boxed> {
        Calls::new(vec![None; slots].into_boxed_slice())
    }

    fn pool(count: usize, size: usize) -> Pool<Boxed> {
        Pool::new((0..count).map(|_| Some(vec![0; size].into_boxed_slice())).collect())
    }

    fn head(id: u32, priority: Priority) -> CallHead {
        CallHead {
            id,
            slot: Slot(id as u16 ^ 0x1234),
            generation: Generation(id as u16),
            priority,
            wants_reply: id.is_multiple_of(2),
            takes_over: id.is_multiple_of(3),
            operator: id.is_multiple_of(5),
            resets: false,
            deadline: Instant::from_micros(u64::from(id) << 20),
            sent_at: Instant::from_micros(u64::from(id) << 10),
        }
    }

    proptest! {
        #[test]
        fn the_window_agrees_with_a_set(ids in prop::collection::vec(1..400_u32, 0..300)) {
            let (mut window, mut seen) = (Window::default(), BTreeSet::new());
            for id in ids {
                let newest = seen.last().copied().unwrap_or(0);
                let expected = match id {
                    id if id + WINDOW <= newest => Seen::TooOld,
                    id if !seen.insert(id) => Seen::Before,
                    _ => Seen::Never,
                };
                prop_assert_eq!(window.note(id), expected);
            }
        }

        #[test]
        fn what_waits_comes_out_as_it_went_in(steps in prop::collection::vec((0..3_u8, 0..200_usize), 1..200)) {
            let (mut calls, mut pool) = (calls(4), pool(3, 600));
            let mut model: VecDeque<(CallHead, Vec<u8>)> = VecDeque::new();
            for (id, (step, length)) in (1..).zip(steps) {
                if step > 0 {
                    let (head, block) = (head(id, Priority::Low), vec![id as u8; length]);
                    let used: usize = model.iter().map(|(_, block)| block.len() + HEAD_BYTES).sum();
                    let fits = used + block.len() + HEAD_BYTES <= 600;
                    prop_assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head, &block).is_ok(), fits);
                    if fits {
                        model.push_back((head, block));
                    }
                } else {
                    let taken = calls.take_next(&mut pool, |_, block| block.to_vec());
                    prop_assert_eq!(taken, model.pop_front());
                }
                prop_assert_eq!(usize::from(calls.held()), model.len());
                prop_assert_eq!(pool.free(), LEFT_BY_WAITING + usize::from(model.is_empty()));
            }
        }
    }

    #[test]
    fn a_window_knows_what_it_has_noted_and_what_is_too_old() {
        let mut window = Window::default();
        window.note(70);
        window.note(72);
        assert_eq!([70, 71, 72, 73].map(|id| window.knows(id)), [true, false, true, false]);
        assert!(window.knows(72 - WINDOW), "it may have been noted");
    }

    #[test]
    fn a_call_that_is_released_while_it_waits_has_run_out_and_no_other() {
        let (mut calls, mut pool) = (calls(3), pool(4, 200));
        for id in 1..=3 {
            calls.wait(&mut pool, LEFT_BY_WAITING, head(id, Priority::Low), &[0; 8]).unwrap();
        }
        calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Emergency), b"").unwrap();
        assert!(calls.is_waiting(Priority::Low, 2) && !calls.is_waiting(Priority::High, 2));
        for id in 1..=3 {
            calls.note(Priority::Low, id);
        }
        calls.note(Priority::Emergency, 4);
        calls.give_up(Priority::Low, 2);
        calls.give_up(Priority::Emergency, 4);
        let mut left = || calls.take_next(&mut pool, |head, _| head).unwrap().0;
        assert_eq!(
            [left(), left(), left(), left()].map(|head| (head.id, head.deadline == Instant::START)),
            [(4, true), (1, false), (2, true), (3, false),]
        );
    }

    #[test]
    fn a_request_that_is_given_up_before_it_arrives_is_passed_over_and_those_before_it_are_not() {
        let mut calls = calls(1);
        calls.give_up(Priority::Low, 500);
        calls.give_up(Priority::Low, 500);
        let mut note = |id| calls.note(Priority::Low, id);
        assert_eq!(
            [note(3), note(499), note(500), note(500), note(501)],
            [Seen::Never, Seen::Never, Seen::Before, Seen::Before, Seen::Never,]
        );
        // Those that never come give way to others, which are kept out all the same.
        (600..620).for_each(|id| calls.give_up(Priority::Low, id));
        for id in 600..620 {
            assert_eq!(calls.note(Priority::Low, id), Seen::Before, "{id}");
        }
        assert_eq!(calls.note(Priority::Low, 620), Seen::Never);
    }

    #[test]
    fn ids_far_ahead_forget_what_was_before() {
        let mut window = Window::default();
        assert_eq!([window.note(1), window.note(u32::MAX), window.note(1)], [Seen::Never, Seen::Never, Seen::TooOld]);
        assert_eq!(window.note(u32::MAX - (WINDOW - 1)), Seen::Never);
        assert_eq!(window.note(u32::MAX), Seen::Before);
    }

    #[test]
    fn a_ticket_is_good_once_and_for_its_call_only() {
        let mut calls = calls(2);
        let first = calls.begin(head(1, Priority::Normal), false).unwrap();
        assert!(calls.end(first) && !calls.end(first));
        let second = calls.begin(head(2, Priority::Normal), false).unwrap();
        assert_eq!((calls.call(first), calls.held()), (None, 1));
        assert!(!calls.end(first));
        assert_eq!(calls.call(second).unwrap().id, 2);
    }

    #[test]
    fn an_emergency_finds_a_slot_when_all_others_are_taken() {
        let mut calls = calls(3);
        for id in 1..=2 {
            calls.begin(head(id, Priority::Normal), false).unwrap();
        }
        assert_eq!(calls.begin(head(3, Priority::High), false), Err(Error::Busy));
        assert_eq!(calls.begin(head(4, Priority::Emergency), false), Err(Error::Busy), "its class alone is not enough");
        assert!(calls.begin(head(4, Priority::Emergency), true).is_ok());
        assert_eq!(calls.admit(Slot(9), false, 3), Err(Error::Busy));
        assert_eq!(calls.admit(Slot(9), true, 3), Ok(()));
    }

    #[test]
    fn of_one_emergency_service_two_calls_run_and_leave_slots_for_those_of_others() {
        let mut calls = calls(slots_for(16));
        let same = |id| CallHead { slot: Slot(7), ..head(id, Priority::Emergency) };
        for id in 1..=16 {
            calls.begin(head(id, Priority::Normal), false).unwrap();
        }
        for id in 17..=18 {
            assert_eq!(calls.admit(Slot(7), true, 1), Ok(()));
            calls.begin(same(id), true).unwrap();
        }
        assert_eq!(calls.admit(Slot(7), true, 1), Err(Error::Busy));
        assert_eq!(calls.admit(Slot(8), true, 1), Ok(()));
        assert!(calls.is_idle(Priority::Emergency) && !calls.is_idle(Priority::High));
    }

    #[test]
    fn the_slots_that_are_asked_for_are_those_that_other_calls_may_have() {
        for running in 1..100 {
            let slots = slots_for(running);
            assert_eq!(slots - kept(slots), running, "{running} of {slots}");
        }
    }

    #[test]
    fn a_running_call_keeps_its_ticket_when_there_are_more_slots() {
        let mut calls = calls(slots_for(1));
        let first = calls.begin(head(1, Priority::Normal), false).unwrap();
        assert!(!calls.is_idle(Priority::Normal));
        assert_eq!(calls.grow(vec![None; 1].into()).len(), 1, "fewer are given back");
        assert_eq!(calls.grow(vec![Some(head(9, Priority::Normal)); slots_for(3)].into()).len(), slots_for(1));
        assert_eq!((calls.slots(), calls.running.iter().flatten().count()), (slots_for(3), 1));
        let second = calls.begin(head(2, Priority::Normal), false).unwrap();
        assert!(calls.end(first) && calls.end(second) && !calls.end(first));
    }

    #[test]
    fn a_call_begins_while_others_of_its_class_run_and_never_before_one_that_waits() {
        let (mut calls, mut pool) = (calls(slots_for(2)), pool(3, 100));
        assert!(calls.is_idle(Priority::Normal));
        let first = calls.begin(head(1, Priority::Normal), false).unwrap();
        assert!(calls.is_idle(Priority::Normal), "one runs, and there is room for another");
        calls.begin(head(2, Priority::Normal), false).unwrap();
        assert!(!calls.is_idle(Priority::Normal));
        calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::Normal), b"").unwrap();
        assert!(!calls.can_begin());
        calls.end(first);
        assert!(calls.can_begin() && !calls.is_idle(Priority::Normal), "the third comes before a fourth");
        assert!(!calls.is_idle(Priority::High), "and before one of another class that came later");
        assert_eq!(calls.take_next(&mut pool, |head, _| head.id).map(|(_, id)| id), Some(3));
        assert!(calls.is_idle(Priority::Normal));
    }

    #[test]
    fn room_ends_with_the_calls_that_may_wait_or_with_the_bytes() {
        let (mut calls, mut pool) = (calls(3), pool(4, 100));
        assert!(calls.has_room(1, 68) && !calls.has_room(0, 0));
        calls.wait(&mut pool, LEFT_BY_WAITING, head(1, Priority::Normal), b"12345678").unwrap();
        assert_eq!([(1, 0), (2, 28), (2, 29)].map(|(limit, bytes)| calls.has_room(limit, bytes)), [false, true, false]);
        assert!(calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Normal), &[0; 28]).is_ok());
    }

    #[test]
    fn one_emergency_waits_without_a_buffer() {
        let (mut calls, mut pool) = (calls(3), pool(0, 0));
        for id in 11..=13 {
            calls.begin(head(id, Priority::Emergency), true).unwrap();
        }
        calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Emergency), b"stop").unwrap();
        assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::Emergency), b"stop"), Err(Error::Busy));
        assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Normal), b"go"), Err(Error::Busy));
        assert!(!calls.can_begin());
    }

    #[test]
    fn one_request_may_come_early_by_an_interval() {
        let (mut calls, interval) = (calls(1), Duration::from_millis(10));
        let at = |millis: u64| Instant::from_micros(1_000_000 + millis * 1_000);
        assert_eq!(calls.interval(at(0), interval), Ok(()));
        assert_eq!(calls.interval(at(0), interval), Ok(()));
        assert_eq!(calls.interval(at(4), interval), Err(Error::TooSoon { wait: Duration::from_millis(6) }));
        assert_eq!(calls.interval(at(10), interval), Ok(()));
        assert_eq!(calls.interval(at(10), Duration::ZERO), Ok(()));
    }

    #[test]
    fn the_end_of_a_link_forgets_what_waits_and_keeps_what_runs() {
        let (mut calls, mut pool) = (calls(3), pool(4, 100));
        let running = calls.begin(head(1, Priority::Normal), false).unwrap();
        calls.wait(&mut pool, LEFT_BY_WAITING, head(2, Priority::Normal), b"").unwrap();
        calls.wait(&mut pool, LEFT_BY_WAITING, head(3, Priority::High), b"").unwrap();
        calls.wait(&mut pool, LEFT_BY_WAITING, head(4, Priority::Emergency), b"").unwrap();
        assert_eq!((calls.held(), pool.free()), (4, LEFT_BY_WAITING));
        calls.release(&mut pool);
        assert_eq!((calls.held(), pool.free()), (1, 4));
        assert!(calls.end(running));
        assert_eq!(calls.held(), 0);
    }

    #[test]
    fn the_last_buffers_are_left_to_answers_and_to_what_is_received() {
        let (mut calls, mut pool) = (calls(3), pool(LEFT_BY_WAITING, 100));
        assert_eq!(calls.wait(&mut pool, LEFT_BY_WAITING, head(1, Priority::Normal), b""), Err(Error::Busy));
        assert_eq!((calls.held(), pool.free()), (0, LEFT_BY_WAITING));
    }
}
