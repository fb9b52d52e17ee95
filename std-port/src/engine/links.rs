//! The table of links, their timers, and the clock's list of those that no thread reads for a moment.

use std::sync::{Arc, Mutex, RwLock, RwLockReadGuard, RwLockWriteGuard};

use cara_core::host::mailman::LinkId;
use cara_core::time::Instant;

use super::driving::Driver;
use super::link::LinkCell;
use super::watch::Watch;
use crate::config::Capacities;
use crate::locks::{Held, Rank};
use crate::timers::Timers;

/// One place for each link that there may be.
type Table = Vec<Option<Arc<LinkCell>>>;

pub(crate) struct Links {
    pub(super) driver: Arc<Driver>,
    table: RwLock<Table>,
    /// When the session of each is to be polled.
    timers: Mutex<Timers>,
    pub(super) watch: Watch,
    /// How long the tables of one link may become.
    pub(super) capacities: Capacities,
}

impl Links {
    pub(super) fn new(driver: Arc<Driver>, most: usize, capacities: Capacities) -> Self {
        let table = RwLock::new((0..most).map(|_| None).collect());
        Self { driver, table, timers: Mutex::new(Timers::new()), watch: Watch::new(), capacities }
    }

    #[track_caller]
    pub(super) fn table(&self) -> Held<RwLockReadGuard<'_, Table>> {
        Rank::Links.read(&self.table)
    }

    #[track_caller]
    pub(super) fn table_mut(&self) -> Held<RwLockWriteGuard<'_, Table>> {
        Rank::Links.write(&self.table)
    }

    pub(super) fn get(&self, id: LinkId) -> Option<Arc<LinkCell>> {
        self.table().get(usize::from(id.0)).cloned().flatten()
    }

    /// The link that an epoll token means, unless it is gone.
    pub(super) fn of_token(&self, token: u64) -> Option<Arc<LinkCell>> {
        let id = LinkId((token & 0xffff) as u16);
        self.get(id).filter(|link| link.token() == token)
    }

    pub(crate) fn all(&self) -> Vec<Arc<LinkCell>> {
        self.table().iter().flatten().cloned().collect()
    }

    pub(super) fn is_full(&self) -> bool {
        self.table().iter().all(Option::is_some)
    }

    /// The link has ended: its id is free for another one.
    pub(super) fn remove(&self, link: &LinkCell) {
        if let Some(place) = self.table_mut().get_mut(usize::from(link.id.0)) {
            place.take_if(|current| current.serial == link.serial);
        }
    }

    /// The session of a link is to be polled then; whether nothing is due before.
    pub(super) fn set_timer(&self, id: LinkId, at: Instant) -> bool {
        Rank::Leaf.lock(&self.timers).set(u32::from(id.0), at)
    }

    /// What a unit moves has been stopped: its links look at their orders now.
    pub(super) fn look_at_orders(&self) {
        Rank::Leaf.lock(&self.timers).bring_all_forward(Instant::START);
        self.driver.wake();
    }

    pub(super) fn cancel_timer(&self, id: LinkId) {
        Rank::Leaf.lock(&self.timers).cancel(u32::from(id.0));
    }

    /// A link that is due by `now`, or when the next one is.
    pub(super) fn due(&self, now: Instant) -> Result<LinkId, Instant> {
        let mut timers = Rank::Leaf.lock(&self.timers);
        match timers.pop_due(now) {
            Some(due) => Ok(LinkId(due as u16)),
            None => Err(timers.next().unwrap_or(Instant::FAR_FUTURE)),
        }
    }

    pub(super) fn next_due(&self) -> Instant {
        Rank::Leaf.lock(&self.timers).next().unwrap_or(Instant::FAR_FUTURE)
    }
}
