//! Deadlines of the nodes in a binary heap, so that neither setting nor finding the next one looks at all nodes.

use super::table::{NONE, Table};
use crate::host::port::Port;
use crate::time::Instant;

/// What is due for a node: one task at a time, since they exclude each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Task {
    /// Dial it.
    Dial,
    /// Give up the dial.
    GiveUp,
    /// Challenge its link: a newcomer has its identity.
    Challenge,
    /// Let its link end once nothing moves: a manager with a higher claim wants to command.
    Yield,
    /// End the link, which has not answered the challenge: the newcomer replaces it.
    Supersede,
    /// Notify the newcomer that it is admitted.
    Admit,
    /// Notify the newcomer that the older link is alive.
    Refuse,
}

impl<P: Port> Table<P> {
    /// Schedules a node's task, in place of the one before.
    pub(super) fn schedule(&mut self, place: usize, at: Instant, task: Task) {
        let Some(known) = self.node_mut(place) else { return };
        known.task = Some(task);
        known.due = at;
        let held = known.heap;
        if held != NONE {
            let position = self.sift_up(usize::from(held));
            self.sift_down(position);
            return;
        }
        let last = self.due_len;
        self.due_len = last.saturating_add(1);
        self.set_heap(last, place);
        self.sift_up(last);
    }

    /// Cancels a node's task.
    pub(super) fn cancel(&mut self, place: usize) {
        let Some(known) = self.node_mut(place) else { return };
        known.task = None;
        let held = core::mem::replace(&mut known.heap, NONE);
        if held == NONE {
            return;
        }
        let position = usize::from(held);
        self.due_len = self.due_len.saturating_sub(1);
        let last = self.due_len;
        if position != last {
            self.set_heap(position, self.at_heap(last));
            let position = self.sift_up(position);
            self.sift_down(position);
        }
    }

    /// The earliest deadline.
    pub(super) fn next_due(&self) -> Instant {
        if self.due_len == 0 { Instant::FAR_FUTURE } else { self.due_of(0) }
    }

    /// Removes the first task that is due.
    pub(super) fn pop_due(&mut self, now: Instant) -> Option<(usize, Task)> {
        if self.due_len == 0 || self.due_of(0) > now {
            return None;
        }
        let place = self.at_heap(0);
        let task = self.node(place)?.task;
        self.cancel(place);
        task.map(|task| (place, task))
    }

    fn at_heap(&self, position: usize) -> usize {
        self.order.get(position).map_or(usize::MAX, |row| usize::from(row.due))
    }

    fn due_of(&self, position: usize) -> Instant {
        self.node(self.at_heap(position)).map_or(Instant::FAR_FUTURE, |known| known.due)
    }

    fn set_heap(&mut self, position: usize, place: usize) {
        if let Some(row) = self.order.get_mut(position) {
            row.due = u16::try_from(place).unwrap_or(NONE);
        }
        if let Some(known) = self.node_mut(place) {
            known.heap = u16::try_from(position).unwrap_or(NONE);
        }
    }

    fn swap_heap(&mut self, one: usize, other: usize) {
        let (first, second) = (self.at_heap(one), self.at_heap(other));
        self.set_heap(one, second);
        self.set_heap(other, first);
    }

    /// Moves an entry towards the root as far as needed; returns its new position.
    fn sift_up(&mut self, mut position: usize) -> usize {
        while position > 0 {
            let parent = position.saturating_sub(1) / 2;
            if self.due_of(parent) <= self.due_of(position) {
                break;
            }
            self.swap_heap(parent, position);
            position = parent;
        }
        position
    }

    fn sift_down(&mut self, mut position: usize) {
        loop {
            let left = position.saturating_mul(2).saturating_add(1);
            let right = left.saturating_add(1);
            if left >= self.due_len {
                return;
            }
            let earlier = if right < self.due_len && self.due_of(right) < self.due_of(left) { right } else { left };
            if self.due_of(position) <= self.due_of(earlier) {
                return;
            }
            self.swap_heap(position, earlier);
            position = earlier;
        }
    }
}
