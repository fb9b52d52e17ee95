//! Calls of a peer: executed at most once, begun in order within a class, run side by side, bounded.
//!
//! A call that may begin gets a slot, whatever else runs. If none is free, it waits in the queue of its class, with all later
//! calls of that class behind it. Some slots and a queue are reserved for emergencies, so that other calls cannot keep them out;
//! nor can one emergency service keep out another.

use crate::bytes;
use crate::config::{EMERGENCY_BYTES, Priority, WINDOW};
use crate::distribution::function_list::{Generation, Slot};
use crate::error::{Error, Limit};
use crate::storage::{Buffer, Buffers, Storage, take_at};
use crate::time::{Duration, Instant};

/// The sliding window of ids seen in one class, over stream and datagrams together.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    newest: u32,
    seen: u64,
}

/// Whether an id was seen before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Seen {
    /// It is new, and now recorded.
    Never,
    /// It is a duplicate: drop it without an answer, since the first copy is answered.
    Before,
    /// It is below the window, so it may be a duplicate.
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
        if self.seen & bit != 0 {
            return Seen::Before;
        }
        self.seen |= bit;
        Seen::Never
    }

    /// Whether an id was seen, or is so old that it may have been.
    fn knows(&self, id: u32) -> bool {
        let behind = self.newest.saturating_sub(id);
        let bit = 1_u64.checked_shl(behind).unwrap_or(0);
        id <= self.newest && (behind >= WINDOW || self.seen & bit != 0)
    }
}

/// Names a running call, which is to be answered exactly once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Ticket {
    index: u16,
    id: u32,
}

impl Ticket {
    /// The ticket of these [parts](Self::parts), for ports that store it in them.
    pub const fn of(index: u16, id: u32) -> Self {
        Self { index, id }
    }

    /// Its place among the running calls of its link, and the caller's id.
    pub const fn parts(self) -> (u16, u32) {
        (self.index, self.id)
    }
}

/// Whether the caller has given a running call up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Cancelled {
    /// It has not.
    #[default]
    No,
    /// It has, and the port has yet to be notified.
    Untold,
    /// The port has been notified.
    Report,
}

/// An accepted call, without its arguments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct CallHead {
    /// The caller's id.
    pub(crate) id: u32,
    /// The function called.
    pub(crate) slot: Slot,
    /// The generation of the function.
    pub(crate) generation: Generation,
    /// Its class.
    pub(crate) priority: Priority,
    /// Whether the caller waits.
    pub(crate) wants_reply: bool,
    /// Whether the caller asked for progress.
    pub(crate) wants_progress: bool,
    /// Whether it takes over an actuator that another caller holds.
    pub(crate) takes_over: bool,
    /// Whether an operator made it, and not the caller's program.
    pub(crate) operator: bool,
    /// Whether it moves, stops or resets something: then no call overtakes it, and it overtakes none.
    pub(crate) keeps_order: bool,
    /// When the caller stops waiting; the call does not begin later.
    pub(crate) deadline: Instant,
    /// The earliest time at which the caller can have made the request, from which its age counts.
    pub(crate) sent_at: Instant,
    /// The caller's number of the call: later calls have higher ones.
    pub(crate) number: u32,
}

/// What the answer of a running call needs. Small, since each link has many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RunningCall {
    pub(crate) id: u32,
    pub(crate) slot: Slot,
    pub(crate) generation: Generation,
    pub(crate) priority: Priority,
    pub(crate) wants_reply: bool,
    pub(crate) wants_progress: bool,
    /// Whether the caller has given it up.
    pub(crate) cancelled: Cancelled,
    /// Whether returning results resets a stop.
    pub(crate) resets: bool,
    pub(crate) deadline: Instant,
    pub(crate) sent_at: Instant,
}

/// How many requests that were given up before they arrived are remembered beside the windows.
const UNWANTED: usize = 8;

/// How many of the waiting calls are compared to find the earliest deadline; calls behind them are not.
const LOOKED_AT: usize = 16;

/// Bytes of a call's head in a queue.
const HEAD_BYTES: usize = 36;
/// Offset of the deadline in the head.
const DEADLINE: usize = 16;

/// Calls of one peer that run or wait.
pub(crate) struct Calls<S: Storage> {
    windows: [Window; 4],
    /// Requests that the caller gave up before they arrived here.
    unwanted: heapless::Vec<(u32, Priority), UNWANTED>,
    running: S::Slice<Option<RunningCall>>,
    queues: [Option<Queue<S>>; 3],
    /// Waiting emergencies: capacity for one of the longest, or several shorter ones.
    emergencies: ([u8; HEAD_BYTES + EMERGENCY_BYTES], Span),
    held: u16,
    /// When the next request may come by the minimum interval.
    due: Instant,
    /// Refused as [`Error::Busy`]: their refusals wait for capacity.
    pub(crate) refused: Refused,
}

/// Ids of requests that lie within 64 of each other, and which of them wait for a reply.
#[derive(Clone, Copy, Default)]
pub(crate) struct Refused {
    first: u32,
    ids: u64,
    waiting: u64,
}

impl Refused {
    /// `false` for an id that is too far from the others.
    pub(crate) fn insert(&mut self, id: u32, wants_reply: bool) -> bool {
        if self.ids == 0 {
            self.first = id;
        }
        // A call that waited may be refused behind one that came later.
        if let Some(back @ 1..) = self.first.checked_sub(id) {
            if self.ids.leading_zeros() < back {
                return false;
            }
            (self.first, self.ids, self.waiting) = (id, self.ids << back, self.waiting << back);
        }
        let bit = 1_u64.checked_shl(id.wrapping_sub(self.first)).unwrap_or(0);
        self.ids |= bit;
        self.waiting |= if wants_reply { bit } else { 0 };
        bit != 0
    }

    /// The first id, and whether it waits for a reply.
    pub(crate) fn first(&self) -> Option<(u32, bool)> {
        (self.ids != 0).then_some((self.first, self.waiting & 1 != 0))
    }

    pub(crate) fn remove_first(&mut self) {
        let ahead = (self.ids & !1).trailing_zeros();
        self.ids = (self.ids & !1).checked_shr(ahead).unwrap_or(0);
        self.waiting = self.waiting.checked_shr(ahead).unwrap_or(0);
        self.first = self.first.wrapping_add(ahead);
    }
}

struct Queue<S: Storage> {
    buffer: Buffer<S>,
    span: Span,
}

/// The range of a queue's bytes that waiting calls occupy.
#[derive(Clone, Copy, Default)]
struct Span {
    start: usize,
    end: usize,
}

/// How many calls of one emergency service a peer may have running or waiting; the next is `Busy`.
const EMERGENCIES_OF_ONE: usize = 2;

/// How many of these slots are reserved for emergencies.
const fn kept(slots: usize) -> usize {
    if slots < 8 { 1 } else { slots / 4 }
}

/// Slots that a link needs to run this many calls at a time, including the slots reserved for emergencies.
pub const fn slots_for(running: usize) -> usize {
    let kept = if running < 6 { 1 } else { running / 3 };
    running.saturating_add(kept)
}

impl<S: Storage> Calls<S> {
    /// `running` bounds the calls that run at a time; one slot in four, but at least one, is reserved for emergencies.
    pub(crate) fn new(running: S::Slice<Option<RunningCall>>) -> Self {
        Self {
            windows: [Window::default(); 4],
            unwanted: heapless::Vec::new(),
            running,
            queues: [const { None }; 3],
            emergencies: ([0; _], Span::default()),
            held: 0,
            due: Instant::START,
            refused: Refused::default(),
        }
    }

    /// Records the id of a request in the window of its class.
    pub(crate) fn note(&mut self, priority: Priority, id: u32) -> Seen {
        let seen = self.windows.get_mut(usize::from(priority.to_wire())).map_or(Seen::TooOld, |window| window.note(id));
        if self.unwanted.is_empty() || seen != Seen::Never {
            return seen;
        }
        let unwanted = self.unwanted.len();
        self.unwanted.retain(|unwanted| *unwanted != (id, priority));
        if self.unwanted.len() < unwanted { Seen::Before } else { Seen::Never }
    }

    /// Whether a request has arrived, as far as the window of its class can tell.
    pub(crate) fn has_arrived(&self, class: Priority, id: u32) -> bool {
        self.windows.get(usize::from(class.to_wire())).is_some_and(|window| window.knows(id))
    }

    /// Whether a call has arrived and not begun yet.
    pub(crate) fn is_waiting(&self, class: Priority, id: u32) -> bool {
        match queue_index(class) {
            None => self.emergencies.1.find(&self.emergencies.0, id).is_some(),
            Some(index) => {
                let queue = self.queues.get(index).and_then(Option::as_ref);
                queue.is_some_and(|queue| queue.span.find(&queue.buffer, id).is_some())
            }
        }
    }

    /// The bytes of a class's queue, and the part in use; `None` if it has no buffer.
    fn queue(&mut self, class: Priority) -> Option<(&mut [u8], &mut Span)> {
        match queue_index(class) {
            None => Some((&mut self.emergencies.0, &mut self.emergencies.1)),
            Some(index) => {
                let queue = self.queues.get_mut(index)?.as_mut()?;
                Some((&mut queue.buffer, &mut queue.span))
            }
        }
    }

    /// Returns the buffer of a class to the pool once its queue is empty.
    fn give_drained(&mut self, buffers: &mut dyn Buffers<S>, class: Priority) {
        let queue = queue_index(class).and_then(|index| self.queues.get_mut(index));
        if let Some(queue) = queue.and_then(|queue| queue.take_if(|queue| queue.span.is_empty())) {
            buffers.give(queue.buffer);
        }
    }

    /// The caller gives a call up. A waiting call expires at once and is refused in its turn; a later arrival is dropped.
    pub(crate) fn give_up(&mut self, class: Priority, id: u32) {
        if !self.has_arrived(class, id) {
            return self.keep_out(class, id);
        }
        if let Some((bytes, span)) = self.queue(class) {
            span.run_out(bytes, id);
        }
    }

    /// Remembers an id without moving the window to it: else earlier requests that are in flight would be refused as too old.
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
        !self.emergencies.1.is_empty() || self.queues.iter().any(Option::is_some)
    }

    /// The callee's check of the minimum interval. A request may be a whole interval early: the network does not keep intervals.
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

    /// Whether a call of this class may begin at once: a slot is free, none of its class waits, and no earlier one could begin.
    pub(crate) fn is_idle(&self, priority: Priority) -> bool {
        if self.free_slot(priority == Priority::Emergency).is_none() {
            return false;
        }
        !self.any_waiting() || !self.class_waits(priority) && (priority == Priority::Emergency || !self.can_begin())
    }

    /// A free slot. Emergencies take the reserved slots, at the end, first.
    fn free_slot(&self, emergency: bool) -> Option<usize> {
        if emergency {
            return self.running.iter().rposition(Option::is_none);
        }
        let free = self.running.len().saturating_sub(kept(self.running.len()));
        self.running.iter().take(free).position(Option::is_none)
    }

    fn class_waits(&self, priority: Priority) -> bool {
        match queue_index(priority) {
            None => !self.emergencies.1.is_empty(),
            Some(index) => self.queues.get(index).is_some_and(Option::is_some),
        }
    }

    /// [`Error::Busy`] if the peer has its limit of calls here. An emergency service has its own limit of two, which other calls
    /// do not count towards.
    pub(crate) fn admit(&self, slot: Slot, is_emergency: bool, limit: u16) -> Result<(), Error> {
        let free = if is_emergency { self.emergencies_of(slot) < EMERGENCIES_OF_ONE } else { self.held < limit };
        if free { Ok(()) } else { Err(Error::Busy) }
    }

    fn emergencies_of(&self, slot: Slot) -> usize {
        let same = |head: &&RunningCall| head.slot == slot && head.priority == Priority::Emergency;
        let running = self.running.iter().flatten().filter(same).count();
        let (bytes, span) = &self.emergencies;
        running.saturating_add(span.heads(bytes).filter(|(_, head, _)| head.slot == slot).count())
    }

    /// Whether one more call of any class with a block of `bytes` could wait in this peer's queues.
    pub(crate) fn has_room(&self, limit: u16, bytes: usize) -> bool {
        let needed = HEAD_BYTES.saturating_add(bytes);
        self.held < limit && self.queues.iter().flatten().all(|queue| queue.span.room(&queue.buffer) >= needed)
    }

    /// Begins a call. One of an emergency service may take a reserved slot.
    pub(crate) fn begin(&mut self, head: &CallHead, resets: bool, is_emergency: bool) -> Result<Ticket, Error> {
        let index = self.free_slot(is_emergency).ok_or(Error::Busy)?;
        let place = self.running.get_mut(index).ok_or(Error::Full(Limit::IncomingCalls))?;
        let CallHead { id, slot, generation, priority, wants_reply, wants_progress, deadline, sent_at, .. } = *head;
        let cancelled = Cancelled::No;
        *place = Some(RunningCall {
            id,
            slot,
            generation,
            priority,
            wants_reply,
            wants_progress,
            cancelled,
            resets,
            deadline,
            sent_at,
        });
        self.held = self.held.saturating_add(1);
        Ok(Ticket { index: index as u16, id: head.id })
    }

    /// The call of a ticket, unless it was answered already.
    pub(crate) fn call(&self, ticket: Ticket) -> Option<RunningCall> {
        self.running.get(usize::from(ticket.index)).copied().flatten().filter(|head| head.id == ticket.id)
    }

    /// The caller gives up a running call. Returns `false` if that was known, an error if the call does not run.
    pub(crate) fn cancel(&mut self, class: Priority, id: u32) -> Result<bool, Error> {
        let mut running = self.running.iter_mut().flatten();
        let head = running.find(|head| head.id == id && head.priority == class).ok_or(Error::Stale)?;
        let is_new = head.cancelled == Cancelled::No;
        if is_new {
            head.cancelled = Cancelled::Untold;
        }
        Ok(is_new)
    }

    /// A call that was given up, of which the port has not been notified.
    pub(crate) fn take_cancelled(&mut self) -> Option<Ticket> {
        let is_untold = |head: &RunningCall| head.cancelled == Cancelled::Untold;
        let index = self.running.iter().position(|head| head.as_ref().is_some_and(is_untold))?;
        let head = self.running.get_mut(index)?.as_mut()?;
        head.cancelled = Cancelled::Report;
        Some(Ticket { index: index as u16, id: head.id })
    }

    /// Ends a call; `false` if it had ended before.
    pub(crate) fn end(&mut self, ticket: Ticket) -> bool {
        let Some(place) = self.running.get_mut(usize::from(ticket.index)) else { return false };
        if place.take_if(|head| head.id == ticket.id).is_none() {
            return false;
        }
        self.held = self.held.saturating_sub(1);
        true
    }

    /// Queues a call. If that takes a buffer, at least `left` others have to remain in the pool.
    pub(crate) fn wait(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        left: usize,
        head: CallHead,
        block: &[u8],
    ) -> Result<(), Error> {
        if let Some(slot) = queue_index(head.priority).and_then(|index| self.queues.get_mut(index))
            && slot.is_none()
        {
            *slot = Some(Queue { buffer: buffers.take_leaving(left).ok_or(Error::Busy)?, span: Span::default() });
        }
        let (bytes, span) = self.queue(head.priority).ok_or(Error::Busy)?;
        let result = span.push(bytes, head, block);
        if result.is_ok() {
            self.held = self.held.saturating_add(1);
        } else {
            self.give_drained(buffers, head.priority);
        }
        result
    }

    /// Whether a call waits that could begin.
    pub(crate) fn can_begin(&self) -> bool {
        self.next_class().is_some()
    }

    /// Whether an emergency waits that could begin.
    pub(crate) fn has_next_emergency(&self) -> bool {
        !self.emergencies.1.is_empty() && self.free_slot(true).is_some()
    }

    /// Dequeues the next call that may begin, and shows its block to `look`.
    pub(crate) fn take_next<R>(
        &mut self,
        buffers: &mut dyn Buffers<S>,
        look: impl FnOnce(CallHead, &[u8]) -> R,
    ) -> Option<(CallHead, R)> {
        let class = self.next_class()?;
        self.held = self.held.saturating_sub(1);
        let (bytes, span) = self.queue(class)?;
        let taken = span.pop(bytes, class, look);
        self.give_drained(buffers, class);
        taken
    }

    /// Moves the call with the earliest deadline to the front of its queue. Returns whether it overtakes earlier arrivals.
    pub(crate) fn put_next_first(&mut self, now: Instant) -> bool {
        let class = self.next_class().filter(|class| *class != Priority::Emergency);
        let Some((bytes, span)) = class.and_then(|class| self.queue(class)) else { return false };
        let Some((next, size)) = span.by_deadline(bytes, now) else { return false };
        let is_first = next == span.start;
        if !is_first {
            span.put_first(bytes, next, size);
        }
        !is_first
    }

    /// Removes the call of this class with the latest deadline, so that a newcomer with an earlier one and a block of `length`
    /// bytes can wait instead.
    pub(crate) fn displace(
        &mut self,
        now: Instant,
        class: Priority,
        deadline: Instant,
        length: usize,
    ) -> Option<CallHead> {
        let (bytes, span) = self.queue(class).filter(|_| class != Priority::Emergency)?;
        let (last, head, size) = span.latest(bytes, now)?;
        let needed = HEAD_BYTES.saturating_add(length);
        if head.deadline <= deadline || span.room(bytes).saturating_add(size) < needed {
            return None;
        }
        span.put_first(bytes, last, size);
        // Keep the buffer even if it is empty now: the newcomer waits in it.
        let (head, ()) = span.pop(bytes, class, |_, _| ())?;
        self.held = self.held.saturating_sub(1);
        Some(head)
    }

    fn next_class(&self) -> Option<Priority> {
        if !self.any_waiting() {
            return None;
        }
        let may_begin =
            |class: &Priority| self.class_waits(*class) && self.free_slot(*class == Priority::Emergency).is_some();
        Priority::ALL.into_iter().find(may_begin)
    }

    /// Drops the waiting calls and returns the buffers. Running calls can still be ended.
    pub(crate) fn release(&mut self, buffers: &mut dyn Buffers<S>) {
        for queue in self.queues.iter_mut().filter_map(Option::take) {
            buffers.give(queue.buffer);
        }
        self.emergencies.1 = Span::default();
        self.held = self.running.iter().flatten().count() as u16;
    }

    /// Moves the running calls to more slots. Returns the slots that are now unused.
    pub(crate) fn grow(&mut self, mut running: S::Slice<Option<RunningCall>>) -> S::Slice<Option<RunningCall>> {
        if running.len() < self.running.len() {
            return running;
        }
        running.iter_mut().for_each(|slot| *slot = None);
        // Keep each index: tickets contain it.
        running.iter_mut().zip(self.running.iter()).for_each(|(new, old)| *new = *old);
        core::mem::replace(&mut self.running, running)
    }

    /// How many calls can run.
    pub(crate) fn slots(&self) -> usize {
        self.running.len()
    }

    /// The slots, cleared for the next session.
    pub(crate) fn into_slots(mut self) -> S::Slice<Option<RunningCall>> {
        self.running.iter_mut().for_each(|slot| *slot = None);
        self.running
    }

    /// How many calls run or wait.
    pub(crate) const fn held(&self) -> u16 {
        self.held
    }
}

impl Span {
    const fn room(self, bytes: &[u8]) -> usize {
        bytes.len().saturating_sub(self.end.saturating_sub(self.start))
    }

    const fn is_empty(self) -> bool {
        self.start >= self.end
    }

    fn push(&mut self, bytes: &mut [u8], head: CallHead, block: &[u8]) -> Result<(), Error> {
        let needed = HEAD_BYTES.saturating_add(block.len());
        if needed > bytes.len().saturating_sub(self.end) {
            bytes::move_down(bytes, self.start..self.end);
            self.end = self.end.saturating_sub(self.start);
            self.start = 0;
        }
        let end = self.end.saturating_add(needed);
        let place = bytes.get_mut(self.end..end).ok_or(Error::Busy)?;
        let (head_place, block_place) = place.split_first_chunk_mut().ok_or(Error::Busy)?;
        *head_place = encode_head(&head, block.len());
        bytes::copy(block, block_place);
        self.end = end;
        Ok(())
    }

    /// The waiting calls: the offset of each, its head without the class, and its block.
    fn heads(self, bytes: &[u8]) -> impl Iterator<Item = (usize, CallHead, &[u8])> {
        let mut at = self.start;
        core::iter::from_fn(move || {
            let (head, rest) = bytes.get(at..self.end)?.split_first_chunk()?;
            let (begin, (head, length)) = (at, decode_head(head, Priority::Normal));
            at = at.saturating_add(HEAD_BYTES).saturating_add(length);
            Some((begin, head, rest.get(..length)?))
        })
    }

    /// The offset of a call's head.
    fn find(self, bytes: &[u8], id: u32) -> Option<usize> {
        self.heads(bytes).find(|(_, head, _)| head.id == id).map(|(at, ..)| at)
    }

    fn run_out(self, bytes: &mut [u8], id: u32) {
        let Some(at) = self.find(bytes, id) else { return };
        let deadline = at.saturating_add(DEADLINE)..at.saturating_add(DEADLINE).saturating_add(8);
        bytes.get_mut(deadline).unwrap_or_default().fill(0);
    }

    /// Offset and size of the call that is next by deadline. A call that has waited half of its time-out precedes all others, so
    /// that short time-outs cannot starve long ones.
    fn by_deadline(self, bytes: &[u8], now: Instant) -> Option<(usize, usize)> {
        let (mut next, mut earliest, mut sent_at) = (None, Instant::FAR_FUTURE, Instant::START);
        for (at, head, block) in self.heads(bytes).take(LOOKED_AT) {
            if next.is_some() && head.keeps_order {
                break;
            }
            // Send times are estimates: do not let a later arrival look earlier, so that equal time-outs keep their order.
            sent_at = sent_at.max(head.sent_at);
            let due = due(&head, sent_at, now);
            if next.is_none() || due < earliest {
                (next, earliest) = (Some((at, HEAD_BYTES.saturating_add(block.len()))), due);
            }
            if head.keeps_order {
                break;
            }
        }
        next
    }

    /// The call with the latest deadline that may be displaced, with its offset and size.
    fn latest(self, bytes: &[u8], now: Instant) -> Option<(usize, CallHead, usize)> {
        let may_go = |head: &CallHead| !head.keeps_order && head.sent_at + half(head) > now;
        let (at, head, block) =
            self.heads(bytes).filter(|(_, head, _)| may_go(head)).max_by_key(|(_, head, _)| head.deadline)?;
        Some((at, head, HEAD_BYTES.saturating_add(block.len())))
    }

    /// Moves a call to the front; the others keep their order.
    fn put_first(self, bytes: &mut [u8], at: usize, size: usize) {
        let moved = bytes.get_mut(self.start..at.saturating_add(size));
        bytes::rotate_up(moved.unwrap_or_default(), size);
    }

    fn pop<R>(
        &mut self,
        bytes: &[u8],
        priority: Priority,
        look: impl FnOnce(CallHead, &[u8]) -> R,
    ) -> Option<(CallHead, R)> {
        let (_, head, block) = self.heads(bytes).next()?;
        let head = CallHead { priority, ..head };
        let result = look(head, block);
        self.start = self.start.saturating_add(HEAD_BYTES).saturating_add(block.len());
        Some((head, result))
    }
}

/// Half of a call's time-out.
const fn half(head: &CallHead) -> Duration {
    head.deadline.since(head.sent_at).divided_by(2)
}

/// The key by which waiting calls are compared: the deadline, or, once half of the time-out is over, that time, which is past and
/// so precedes all deadlines of calls that can still wait.
fn due(head: &CallHead, sent_at: Instant, now: Instant) -> Instant {
    let half = half(head);
    let due = sent_at + half;
    if due <= now { due } else { due + half }
}

fn encode_head(head: &CallHead, block: usize) -> [u8; HEAD_BYTES] {
    let [l0, l1, l2, l3] = (block as u32).to_le_bytes();
    let [i0, i1, i2, i3] = head.id.to_le_bytes();
    let ([s0, s1], [g0, g1]) = (head.slot.0.to_le_bytes(), head.generation.0.to_le_bytes());
    let [f0, f1, f2, f3] = [head.wants_reply, head.takes_over, head.operator, head.wants_progress].map(u8::from);
    let f0 = f0 | u8::from(head.keeps_order) << 1;
    let [d0, d1, d2, d3, d4, d5, d6, d7] = head.deadline.as_micros().to_le_bytes();
    let [m0, m1, m2, m3, m4, m5, m6, m7] = head.sent_at.as_micros().to_le_bytes();
    let [n0, n1, n2, n3] = head.number.to_le_bytes();
    [
        l0, l1, l2, l3, i0, i1, i2, i3, s0, s1, g0, g1, f0, f1, f2, f3, d0, d1, d2, d3, d4, d5, d6, d7, m0, m1, m2, m3,
        m4, m5, m6, m7, n0, n1, n2, n3,
    ]
}

fn decode_head(bytes: &[u8; HEAD_BYTES], priority: Priority) -> (CallHead, usize) {
    let [l0, l1, l2, l3, i0, i1, i2, i3, s0, s1, g0, g1, wants_reply, takes_over, operator, wants_progress, rest @ ..] =
        *bytes;
    let [d0, d1, d2, d3, d4, d5, d6, d7, m0, m1, m2, m3, m4, m5, m6, m7, n0, n1, n2, n3] = rest;
    let head = CallHead {
        id: u32::from_le_bytes([i0, i1, i2, i3]),
        slot: Slot(u16::from_le_bytes([s0, s1])),
        generation: Generation(u16::from_le_bytes([g0, g1])),
        priority,
        wants_reply: wants_reply & 1 != 0,
        wants_progress: wants_progress != 0,
        takes_over: takes_over != 0,
        operator: operator != 0,
        keeps_order: wants_reply & 2 != 0,
        deadline: Instant::from_micros(u64::from_le_bytes([d0, d1, d2, d3, d4, d5, d6, d7])),
        sent_at: Instant::from_micros(u64::from_le_bytes([m0, m1, m2, m3, m4, m5, m6, m7])),
        number: u32::from_le_bytes([n0, n1, n2, n3]),
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
mod tests;
