//! A node, whether it is connected or not, and what is known of it beyond its links.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use cara_core::config::Constraints;
use cara_core::counters::Counters;
use cara_core::distribution::identity::Identity;
use cara_core::error::{CloseReason, Error};
use cara_core::host::connections::LinkCounter;
use cara_core::services::requests::CallId;
use cara_core::time::{Duration, Instant};

use super::clocks::{ClockOffset, Measured};
use super::link::LinkCell;
use super::streams::Streams;
use crate::locks::lock;

/// The counters of a link, or of many.
pub(crate) type LinkCounters = Counters<LinkCounter, { LinkCounter::COUNT }>;

/// A node, connected or not. There may be thousands: what most never have is boxed.
pub(crate) struct PeerCell {
    pub(crate) identity: Identity,
    link: Mutex<Option<Arc<LinkCell>>>,
    /// When it joined last.
    joined: Mutex<Option<std::time::Instant>>,
    /// When and why its last link ended.
    left: Mutex<Option<Box<(std::time::Instant, CloseReason)>>>,
    /// When and from where it asked for this unit last, since it was connected.
    searched: Mutex<Option<Box<(std::time::Instant, SocketAddr)>>>,
    /// What differs for this node from the unit's constraints, whether it is connected or not.
    own: Mutex<Option<Box<OwnConstraints>>>,
    /// The newest call of each function that was to move something, and the link that it was made by.
    orders: Mutex<BTreeMap<String, (u32, CallId)>>,
    /// Its streams that are read here.
    pub(crate) streams: Streams,
    /// What its earlier links have counted.
    earlier: Mutex<Option<Box<LinkCounters>>>,
    /// How far its clock is from this unit's, while it is connected and tells it.
    clock: Mutex<Option<Box<Measured>>>,
    /// It has told what it offers since it has its place, on this link or an earlier one.
    pub(super) introduced: AtomicBool,
    /// The operator has taken it off the roster.
    retired: AtomicBool,
}

/// The constraints that a node may have of its own.
#[derive(Clone, Copy)]
struct OwnConstraints {
    request_timeout: Duration,
    minimum_interval: Duration,
    calls_per_peer: u16,
}

impl PeerCell {
    /// The link to the node while it is connected.
    pub(crate) fn link(&self) -> Option<Arc<LinkCell>> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn is_connected(&self) -> bool {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// How long it has been connected.
    pub(crate) fn connected_for(&self) -> Option<std::time::Duration> {
        self.link()?;
        lock(&self.joined).map(|joined| joined.elapsed())
    }

    /// How long ago it left, and why, while it is not connected.
    pub(crate) fn left(&self) -> Option<(std::time::Duration, CloseReason)> {
        let left = lock(&self.left).as_deref().copied();
        left.filter(|_| !self.is_connected()).map(|(at, reason)| (at.elapsed(), reason))
    }

    pub(super) fn heard_searching(&self, from: SocketAddr) {
        *lock(&self.searched) = Some(Box::new((std::time::Instant::now(), from)));
    }

    /// How long ago it was heard searching for this unit, and from where, while it is not connected and if that was after it left.
    pub(crate) fn searched(&self) -> Option<(std::time::Duration, SocketAddr)> {
        let searched = lock(&self.searched).as_deref().copied();
        let left = lock(&self.left).as_deref().copied();
        let is_news = |at| left.is_none_or(|(left, _)| left < at);
        let heard = searched.filter(|(at, _)| !self.is_connected() && is_news(*at));
        heard.map(|(at, from)| (at.elapsed(), from))
    }

    /// Whether it is connected and what it offers is known.
    pub(crate) fn is_introduced(&self) -> bool {
        self.link().is_some_and(|link| link.is_introduced())
    }

    /// The unit's constraints with what this node has of its own.
    pub(crate) fn constraints(&self, unit: Constraints) -> Constraints {
        self.own_constraints(unit).unwrap_or(unit)
    }

    pub(super) fn own_constraints(&self, unit: Constraints) -> Option<Constraints> {
        let own = lock(&self.own).as_deref().copied()?;
        let OwnConstraints { request_timeout, minimum_interval, calls_per_peer } = own;
        Some(Constraints { request_timeout, minimum_interval, calls_per_peer, ..unit })
    }

    /// [`Error::BadConstraint`] for what cannot differ from node to node.
    pub(super) fn set_constraints(&self, unit: Constraints, wanted: Constraints) -> Result<(), Error> {
        let Constraints { request_timeout, minimum_interval, calls_per_peer, .. } = wanted;
        if wanted != (Constraints { request_timeout, minimum_interval, calls_per_peer, ..unit }) {
            return Err(Error::BadConstraint);
        }
        *lock(&self.own) = Some(Box::new(OwnConstraints { request_timeout, minimum_interval, calls_per_peer }));
        Ok(())
    }

    pub(crate) fn new(identity: &Identity) -> Arc<Self> {
        Arc::new(Self {
            identity: identity.clone(),
            link: Mutex::new(None),
            joined: Mutex::new(None),
            left: Mutex::new(None),
            searched: Mutex::new(None),
            own: Mutex::new(None),
            orders: Mutex::default(),
            streams: Streams::default(),
            earlier: Mutex::new(None),
            clock: Mutex::new(None),
            introduced: AtomicBool::new(false),
            retired: AtomicBool::new(false),
        })
    }

    /// How far its clock is from this unit's, while it is connected and where it has told that lately.
    pub(crate) fn clock_offset(&self, now: Instant) -> Option<ClockOffset> {
        self.link()?;
        lock(&self.clock).as_deref().and_then(|measured| measured.offset(now))
    }

    /// Of what was measured on this link. Nothing of a link before the present one counts.
    pub(super) fn set_clock(&self, link: &LinkCell, measured: Option<Measured>) {
        let current = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if current.as_ref().is_some_and(|current| current.serial == link.serial) {
            *lock(&self.clock) = measured.map(Box::new);
        }
    }

    /// Whether it has ever joined.
    pub(super) fn has_joined(&self) -> bool {
        lock(&self.joined).is_some()
    }

    /// Whether it has been taken off the roster, and has not joined since.
    pub(crate) fn is_retired(&self) -> bool {
        self.retired.load(Ordering::Relaxed)
    }

    /// Takes it off the roster until it joins again; `false` while it is connected.
    pub(crate) fn retire(&self) -> bool {
        let link = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if link.is_none() {
            self.retired.store(true, Ordering::Relaxed);
        }
        link.is_none()
    }

    /// A call that is to move something goes out.
    pub(super) fn ordered(&self, function: &str, link: u32, call: CallId) {
        let mut orders = lock(&self.orders);
        match orders.get_mut(function) {
            Some(known) => *known = (link, call),
            None => drop(orders.insert(function.to_owned(), (link, call))),
        }
    }

    /// The newest call of a function that was to move something, and the link that it was made by.
    pub(crate) fn last_order(&self, function: &str) -> Option<(u32, CallId)> {
        lock(&self.orders).get(function).copied()
    }

    pub(super) fn earlier(&self) -> LinkCounters {
        lock(&self.earlier).as_deref().cloned().unwrap_or_default()
    }

    pub(super) fn keep(&self, counters: &LinkCounters) {
        lock(&self.earlier).get_or_insert_default().merge(counters);
    }

    pub(super) fn join(&self, link: Arc<LinkCell>) {
        *lock(&self.joined) = Some(std::time::Instant::now());
        let mut current = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        self.retired.store(false, Ordering::Relaxed);
        *current = Some(link);
        *lock(&self.searched) = None;
        *lock(&self.clock) = None;
    }

    /// The link has ended; a newer one stays.
    pub(crate) fn leave(&self, link: &LinkCell, reason: CloseReason) {
        let mut current = self.link.lock().unwrap_or_else(PoisonError::into_inner);
        if current.as_ref().is_some_and(|current| current.serial == link.serial) {
            *lock(&self.left) = Some(Box::new((std::time::Instant::now(), reason)));
            *current = None;
        }
    }
}
