//! What one peer knows of this unit's functions, and the notifications that it has yet to get.

use super::subscription::Subscription;
use crate::ability::{STREAMS, State};
use crate::distribution::function_list::{Generation, Slot};
use crate::services::access::Bucket;
use crate::storage::Storage;
use crate::time::{Duration, Instant};

/// One of this unit's functions as one peer sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Publication {
    pub(super) wanted: Option<Generation>,
    pub(super) advertised: Option<Generation>,
    /// It was visible at some time, so a call of it is refused as stale and not as unknown.
    ever: bool,
    /// The peer has released its requests with ids up to this one.
    released: u32,
    /// The highest number of a request that began an order. Later arrivals with lower numbers are refused as replaced.
    ordered: u32,
    /// The rest of the peer's rate limit.
    bucket: Bucket,
    /// The peer's subscription, if this is a stream.
    subscription: State<Subscription, { STREAMS as usize }>,
}

/// Whether a peer may call a function.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Advertised {
    Now,
    Earlier,
    Never,
}

/// Everything that one peer is to be notified of.
pub(super) struct Publishing<S: Storage> {
    pub(super) table: S::Slice<Publication>,
    /// The highest number of a request that began an order, over all functions.
    newest_order: u32,
    /// Version of the unit's publications when this link last read them.
    pub(super) version: u32,
    pub(super) dirty: bool,
    pub(super) serial: u32,
    pub(super) end_due: bool,
    /// The newest serial that the peer has acknowledged.
    acknowledged: u32,
    pub(super) acknowledgement_due: Option<u32>,
    pub(super) limits_due: bool,
    /// The state of an actuator may differ from what the peer was sent.
    pub(super) actuators_due: bool,
    /// Combines all [`Lease::changes`] as they were last sent, to detect a change without storing each.
    pub(super) actuators_reported: u32,
    pub(super) refusals: Refusals,
}

/// Requests that the access table refused, counted for the log.
pub(super) struct Refusals {
    /// Since the last log line.
    count: u32,
    /// Earliest time of the next log line.
    next: Instant,
}

impl Refusals {
    /// Counts a refusal; returns how many there were since the last log line, if a new line may be written.
    pub(super) fn count(&mut self, now: Instant) -> Option<u32> {
        self.count = self.count.saturating_add(1);
        (now >= self.next).then_some(self.count)
    }

    pub(super) fn was_logged(&mut self, now: Instant) {
        *self = Self { count: 0, next: now + Duration::from_secs(1) };
    }
}

impl<S: Storage> Publishing<S> {
    pub(super) fn new(table: S::Slice<Publication>) -> Self {
        Self {
            table,
            newest_order: 0,
            version: 0,
            dirty: false,
            serial: 0,
            end_due: false,
            acknowledged: 0,
            acknowledgement_due: None,
            limits_due: false,
            actuators_due: false,
            actuators_reported: 0,
            refusals: Refusals { count: 0, next: Instant::START },
        }
    }

    /// The table, cleared for the next session.
    pub(super) fn into_table(mut self) -> S::Slice<Publication> {
        self.table.iter_mut().for_each(|publication| *publication = Publication::default());
        self.table
    }

    pub(super) fn slots(&self) -> usize {
        self.table.len()
    }

    pub(super) fn grow(&mut self, mut table: S::Slice<Publication>) -> S::Slice<Publication> {
        if table.len() < self.table.len() {
            return table;
        }
        for (new, old) in table.iter_mut().zip(self.table.iter()) {
            *new = *old;
        }
        core::mem::swap(&mut self.table, &mut table);
        table
    }

    pub(super) fn advertised(&self, slot: Slot, generation: Generation) -> Advertised {
        match self.table.get(usize::from(slot.0)) {
            Some(publication) if publication.wanted == Some(generation) => Advertised::Now,
            Some(publication) if publication.ever => Advertised::Earlier,
            _ => Advertised::Never,
        }
    }

    /// The slots of this unit's functions.
    pub(super) fn all_slots(&self) -> impl Iterator<Item = Slot> + use<S> {
        (0..self.table.len()).map(|index| Slot(index as u16))
    }

    /// The peer releases its requests of a function up to `id`.
    pub(super) fn release(&mut self, slot: Slot, id: u32) {
        if let Some(publication) = self.table.get_mut(usize::from(slot.0)) {
            publication.released = publication.released.max(id);
        }
    }

    /// Whether the peer has released request `id`, so that it must not begin.
    pub(super) fn is_released(&self, slot: Slot, id: u32) -> bool {
        self.table.get(usize::from(slot.0)).is_some_and(|publication| id <= publication.released)
    }

    /// Records that the request with this number has begun an order.
    pub(super) fn note_order(&mut self, slot: Slot, number: u32) {
        self.newest_order = self.newest_order.max(number);
        if let Some(publication) = self.table.get_mut(usize::from(slot.0)) {
            publication.ordered = publication.ordered.max(number);
        }
    }

    /// The functions of which a request with a higher number has begun an order.
    pub(super) fn ordered_after(&self, number: u32) -> impl Iterator<Item = Slot> {
        let table = if number < self.newest_order { &*self.table } else { &[] };
        let later = table.iter().enumerate().filter(move |(_, publication)| publication.ordered > number);
        later.map(|(index, _)| Slot(index as u16))
    }

    /// The rest of the peer's rate limit for a function.
    pub(super) fn bucket(&mut self, slot: Slot) -> Option<&mut Bucket> {
        self.table.get_mut(usize::from(slot.0)).map(|publication| &mut publication.bucket)
    }

    /// The peer's subscription to a stream.
    pub(super) fn subscription(&mut self, slot: Slot) -> Option<&mut Subscription> {
        self.table.get_mut(usize::from(slot.0))?.subscription.get_mut()
    }

    /// How many streams the peer subscribes to.
    pub(super) fn count_subscriptions(&self) -> u16 {
        self.table.iter().filter(|publication| publication.subscription.is_active()).count() as u16
    }

    /// Resets all rate limits.
    pub(super) fn fill_buckets(&mut self) {
        self.table.iter_mut().for_each(|publication| publication.bucket = Bucket::default());
    }

    /// Sets which generation of a function the peer is to see, if any.
    pub(super) fn want(&mut self, slot: Slot, generation: Option<Generation>) {
        if let Some(publication) = self.table.get_mut(usize::from(slot.0)) {
            publication.wanted = generation;
            publication.ever |= generation.is_some();
        }
    }

    pub(super) fn acknowledge(&mut self, serial: u32) {
        self.acknowledgement_due = Some(serial);
    }

    pub(super) fn was_acknowledged(&mut self, serial: u32) {
        self.acknowledged = self.acknowledged.max(serial);
    }

    /// Whether the peer has processed this unit's list up to `serial`.
    pub(super) const fn is_acknowledged(&self, serial: u32) -> bool {
        self.acknowledged >= serial
    }

    /// Ends a set of changes. Returns the serial that the peer's acknowledgement will carry.
    pub(super) const fn end_changes(&mut self) -> u32 {
        self.serial = self.serial.wrapping_add(1);
        self.dirty = true;
        self.end_due = true;
        self.serial
    }

    /// Whether publishing to this peer has begun.
    pub(super) const fn has_begun(&self) -> bool {
        self.serial != 0
    }

    /// Whether any notification waits for capacity.
    pub(super) const fn has_news(&self) -> bool {
        let list = self.dirty || self.end_due || self.actuators_due;
        list || self.limits_due || self.acknowledgement_due.is_some()
    }

    pub(super) fn notify_limits(&mut self) {
        self.limits_due = true;
    }

    /// Publishes a function again to a peer whose information is out of date.
    pub(super) fn notify_again(&mut self, slot: Slot) {
        if let Some(publication) = self.table.get_mut(usize::from(slot.0)) {
            publication.advertised = None;
            self.dirty = true;
            self.end_due = true;
        }
    }
}
