//! Calls of a peer: at most once, in order within a class, bounded.
//!
//! A call that may run now becomes a ticket; one whose class is busy waits in the class's queue. An emergency has a
//! place of its own in both, so that nothing else can keep it out.

use crate::bytes;
use crate::config::{EMERGENCY_BYTES, Priority, WINDOW};
use crate::distribution::function_list::{Generation, Slot};
use crate::error::{Error, Limit};
use crate::storage::{Buffer, Buffers, Storage};
use crate::time::{Duration, Instant};

/// Which ids of one class have been seen. Serves the stream and datagrams alike.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    newest: u32,
    seen: u64,
}

/// What the window knows of an id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Seen {
    /// It is new, and noted now.
    Never,
    /// It was noted before: a second copy, to be dropped without an answer since the first is answered.
    Before,
    /// So far below the newest one that nobody knows.
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
    /// After this the caller no longer waits, and the call is not begun.
    pub deadline: Instant,
    /// The earliest time at which the caller can have made the request: its age is counted from here.
    pub made: Instant,
}

/// Bytes of a call's head in a queue.
const HEAD_BYTES: usize = 32;

/// Calls of one peer that run or wait.
pub(crate) struct Calls<S: Storage> {
    windows: [Window; 4],
    running: S::Slice<Option<CallHead>>,
    /// The call that keeps its class busy.
    active: [Option<Ticket>; 4],
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

impl<S: Storage> Calls<S> {
    /// `running` bounds the calls that run at the same time; one slot is kept for an emergency.
    pub(crate) fn new(running: S::Slice<Option<CallHead>>) -> Self {
        Self {
            windows: [Window::default(); 4],
            running,
            active: [None; 4],
            queues: [const { None }; 3],
            emergency: None,
            held: 0,
            due: Instant::START,
        }
    }

    /// Notes a request's id in the window of its class.
    pub(crate) fn note(&mut self, priority: Priority, id: u32) -> Seen {
        self.windows.get_mut(usize::from(priority.to_wire())).map_or(Seen::TooOld, |window| window.note(id))
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

    /// Whether a call of this class may begin at once: nothing of the class runs or waits, and no other class has a call
    /// that came before and may begin.
    pub(crate) fn is_idle(&self, priority: Priority) -> bool {
        let active = self.active.get(usize::from(priority.to_wire())).is_some_and(Option::is_some);
        if active || !self.any_waiting() {
            return !active;
        }
        !self.class_waits(priority) && (priority == Priority::Emergency || !self.can_begin())
    }

    fn class_waits(&self, priority: Priority) -> bool {
        match queue_index(priority) {
            None => self.emergency.is_some(),
            Some(index) => self.queues.get(index).is_some_and(Option::is_some),
        }
    }

    /// [`Error::Busy`] when the peer has as many calls here as it may.
    pub(crate) fn admit(&self, priority: Priority, limit: u16) -> Result<(), Error> {
        let free = priority == Priority::Emergency || self.held < limit;
        if free { Ok(()) } else { Err(Error::Busy) }
    }

    /// Whether one more call of any class with a block of `bytes` could wait, as far as this peer's own calls go.
    pub(crate) fn has_room(&self, limit: u16, bytes: usize) -> bool {
        let needed = HEAD_BYTES.saturating_add(bytes);
        self.held < limit && self.queues.iter().flatten().all(|queue| queue.room() >= needed)
    }

    /// Begins a call.
    pub(crate) fn begin(&mut self, head: CallHead) -> Result<Ticket, Error> {
        let reserve = if head.priority == Priority::Emergency { 0 } else { 1 };
        let free = self.running.len().saturating_sub(reserve);
        let index = self.running.iter().take(free).position(Option::is_none).ok_or(Error::Busy)?;
        let place = self.running.get_mut(index).ok_or(Error::Full(Limit::IncomingCalls))?;
        *place = Some(head);
        let ticket = Ticket { index: index as u16, id: head.id };
        if let Some(active) = self.active.get_mut(usize::from(head.priority.to_wire())) {
            *active = Some(ticket);
        }
        self.held = self.held.saturating_add(1);
        Ok(ticket)
    }

    /// The call of a ticket, unless it was answered already.
    pub(crate) fn call(&self, ticket: Ticket) -> Option<CallHead> {
        self.running.get(usize::from(ticket.index)).copied().flatten().filter(|head| head.id == ticket.id)
    }

    /// Lets the next call of the class begin while this one goes on.
    pub(crate) fn detach(&mut self, ticket: Ticket) {
        let place = self.running.get(usize::from(ticket.index));
        if let Some(&Some(CallHead { priority, .. })) = place {
            self.free_class(priority, ticket);
        }
    }

    fn free_class(&mut self, priority: Priority, ticket: Ticket) {
        if let Some(active) = self.active.get_mut(usize::from(priority.to_wire())) {
            active.take_if(|active| *active == ticket);
        }
    }

    /// Ends a call; `false` when it was ended already.
    pub(crate) fn end(&mut self, ticket: Ticket) -> bool {
        let Some(place) = self.running.get_mut(usize::from(ticket.index)) else { return false };
        let Some(CallHead { priority, .. }) = *place else { return false };
        if place.take_if(|head| head.id == ticket.id).is_none() {
            return false;
        }
        self.free_class(priority, ticket);
        self.held = self.held.saturating_sub(1);
        true
    }

    /// Keeps a call until its class is idle. If it needs a buffer, it leaves so many others in the pool.
    pub(crate) fn wait(
        &mut self,
        buffers: &mut impl Buffers<S>,
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

    /// Whether a call waits whose class is idle.
    pub(crate) fn can_begin(&self) -> bool {
        self.next_class().is_some()
    }

    /// Takes the next call that may begin and shows its block to `look`.
    pub(crate) fn take_next<R>(
        &mut self,
        buffers: &mut impl Buffers<S>,
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
        Priority::ALL.into_iter().find(|&class| {
            let idle = self.active.get(usize::from(class.to_wire())).is_some_and(Option::is_none);
            idle && self.class_waits(class)
        })
    }

    /// Forgets what waits and gives the buffers back. Running calls may still be ended.
    pub(crate) fn release(&mut self, buffers: &mut impl Buffers<S>) {
        for queue in self.queues.iter_mut().filter_map(Option::take) {
            buffers.give(queue.buffer);
        }
        self.emergency = None;
        self.held = self.running.iter().flatten().count() as u16;
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
        let (head_place, block_place) = place.split_at_mut_checked(HEAD_BYTES).ok_or(Error::Busy)?;
        for (place, byte) in head_place.iter_mut().zip(encode_head(&head, block.len())) {
            *place = byte;
        }
        bytes::copy(block, block_place);
        self.end = end;
        Ok(())
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

fn encode_head(head: &CallHead, block: usize) -> impl Iterator<Item = u8> {
    let length = (block as u32).to_le_bytes();
    let wants_reply = [u8::from(head.wants_reply), 0, 0, 0];
    length
        .into_iter()
        .chain(head.id.to_le_bytes())
        .chain(head.slot.0.to_le_bytes())
        .chain(head.generation.0.to_le_bytes())
        .chain(wants_reply)
        .chain(head.deadline.as_micros().to_le_bytes())
        .chain(head.made.as_micros().to_le_bytes())
}

fn decode_head(bytes: &[u8; HEAD_BYTES], priority: Priority) -> (CallHead, usize) {
    let [l0, l1, l2, l3, i0, i1, i2, i3, s0, s1, g0, g1, wants_reply, _, _, _, rest @ ..] = *bytes;
    let [d0, d1, d2, d3, d4, d5, d6, d7, m0, m1, m2, m3, m4, m5, m6, m7] = rest;
    let head = CallHead {
        id: u32::from_le_bytes([i0, i1, i2, i3]),
        slot: Slot(u16::from_le_bytes([s0, s1])),
        generation: Generation(u16::from_le_bytes([g0, g1])),
        priority,
        wants_reply: wants_reply != 0,
        deadline: Instant::from_micros(u64::from_le_bytes([d0, d1, d2, d3, d4, d5, d6, d7])),
        made: Instant::from_micros(u64::from_le_bytes([m0, m1, m2, m3, m4, m5, m6, m7])),
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
            deadline: Instant::from_micros(u64::from(id) << 20),
            made: Instant::from_micros(u64::from(id) << 10),
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
    fn ids_far_ahead_forget_what_was_before() {
        let mut window = Window::default();
        assert_eq!([window.note(1), window.note(u32::MAX), window.note(1)], [Seen::Never, Seen::Never, Seen::TooOld]);
        assert_eq!(window.note(u32::MAX - (WINDOW - 1)), Seen::Never);
        assert_eq!(window.note(u32::MAX), Seen::Before);
    }

    #[test]
    fn a_ticket_is_good_once_and_for_its_call_only() {
        let mut calls = calls(2);
        let first = calls.begin(head(1, Priority::Normal)).unwrap();
        assert!(calls.end(first) && !calls.end(first));
        let second = calls.begin(head(2, Priority::Normal)).unwrap();
        assert_eq!((calls.call(first), calls.held()), (None, 1));
        assert!(!calls.end(first));
        assert_eq!(calls.call(second).unwrap().id, 2);
    }

    #[test]
    fn an_emergency_finds_a_slot_when_all_others_are_taken() {
        let mut calls = calls(3);
        for id in 1..=2 {
            let ticket = calls.begin(head(id, Priority::Normal)).unwrap();
            calls.detach(ticket);
        }
        assert_eq!(calls.begin(head(3, Priority::High)), Err(Error::Busy));
        assert!(calls.begin(head(4, Priority::Emergency)).is_ok());
        assert_eq!(calls.admit(Priority::High, 3), Err(Error::Busy));
        assert_eq!(calls.admit(Priority::Emergency, 3), Ok(()));
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
        calls.begin(head(1, Priority::Emergency)).unwrap();
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
        let running = calls.begin(head(1, Priority::Normal)).unwrap();
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
