//! What a survey keeps of what it hears.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use cara_core::config::{Mode, VERSIONS, Versions};
use cara_core::distribution::claim::Claim;
use cara_core::distribution::datagram::{Datagram, Header};
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};

use super::NAME;
use crate::sys::interfaces::Interface;

/// What shows that a datagram comes from its fleet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Nothing: plain mode, in which every host can speak as any unit.
    Plain,
    /// The fleet's code is right. A unit's name is no more than what another one of the fleet may have said.
    Proven {
        /// The generation of the key with which it was made.
        generation: u32,
        /// Equal for keys that are known to be of one root: a root, or a unit's file, has both.
        root: u32,
    },
    /// Secured, and made with none of the keys that the survey has of that fleet.
    OtherKeys,
    /// Secured, and the survey has no keys of that fleet, or the datagram carries no code for the fleet.
    Unchecked,
}

impl Standing {
    /// Whether both say the same, of whatever generation.
    fn is_like(self, other: Self) -> bool {
        std::mem::discriminant(&self) == std::mem::discriminant(&other)
    }
}

/// One life of a unit, as it was heard from one address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Heard {
    /// Where its datagrams came from.
    pub source: SocketAddr,
    /// Its mode.
    pub mode: Mode,
    /// What shows that it belongs to its fleet, as heard last.
    pub standing: Standing,
    /// The protocol versions that it speaks. Where none of them is this one's, what is said below may be wrong or missing.
    pub versions: Versions,
    /// Its fleet.
    pub fleet: Fleet,
    /// Its identity; `None` if its datagrams could not be decoded beyond their header.
    pub identity: Option<Identity>,
    /// Its life.
    pub epoch: Option<Epoch>,
    /// The manager that it looks for.
    pub wanted: Option<Manager>,
    /// It is an m_unit that stands by and commands nobody, as it said last.
    pub stands_by: bool,
    /// Where it takes connections, at the source's address.
    pub tcp_port: Option<u16>,
    /// How many more nodes it takes, as it said last.
    pub room: Option<u16>,
    /// The claim of an m_unit, as it said last. Nothing proves it to a survey.
    pub claim: Option<Claim>,
    /// Searches of it.
    pub searches: u32,
    /// Answers of it.
    pub answers: u32,
    /// All other datagrams of it.
    pub others: u32,
    /// When it was first heard, since the survey was opened.
    pub first: Duration,
    /// When it was last heard, since the survey was opened.
    pub last: Duration,
    /// It was heard on the discovery port at least once, as all broadcasts are.
    pub by_broadcast: bool,
    /// Datagrams that it sent to the survey alone: its answers to questions of the survey.
    pub to_us: u32,
}

impl Heard {
    /// Where it takes connections.
    pub fn listens_at(&self) -> Option<SocketAddr> {
        self.tcp_port.map(|port| SocketAddr::new(self.source.ip(), port))
    }

    /// Whether it speaks a version that this one speaks as well.
    pub const fn same_version(&self) -> bool {
        VERSIONS.common(self.versions).is_some()
    }

    /// Whether it is a survey, of this or another host.
    pub fn is_survey(&self) -> bool {
        self.identity.as_ref().is_some_and(|identity| identity.name() == NAME && identity.role() == Role::SUnit)
    }

    pub(super) fn is(&self, news: &News) -> bool {
        self.source == news.source
            && self.mode == news.header.mode
            && self.standing.is_like(news.standing)
            && self.versions == news.header.versions
            && self.fleet == news.header.fleet
            && self.identity.as_ref() == news.identity
            && self.epoch == news.epoch
    }

    pub(super) fn new(news: &News, now: Duration) -> Self {
        Self {
            source: news.source,
            mode: news.header.mode,
            standing: news.standing,
            versions: news.header.versions,
            fleet: news.header.fleet,
            identity: news.identity.cloned(),
            epoch: news.epoch,
            wanted: None,
            stands_by: false,
            tcp_port: None,
            room: None,
            claim: None,
            searches: 0,
            answers: 0,
            others: 0,
            first: now,
            last: now,
            by_broadcast: false,
            to_us: 0,
        }
    }

    pub(super) fn take(&mut self, news: &News, now: Duration) {
        (self.last, self.standing) = (now, news.standing);
        self.by_broadcast |= news.by_broadcast;
        self.to_us = self.to_us.saturating_add(u32::from(!news.by_broadcast));
        match news.datagram {
            Some(Datagram::WhoHas(search)) => {
                self.searches = self.searches.saturating_add(1);
                self.wanted.clone_from(&search.wanted);
                self.stands_by = search.standby;
                self.tcp_port = Some(search.tcp_port).filter(|port| *port > 0);
            }
            Some(Datagram::Announce(answer)) => {
                self.answers = self.answers.saturating_add(1);
                // A standby answers nobody.
                self.stands_by = false;
                self.tcp_port = Some(answer.tcp_port).filter(|port| *port > 0);
                self.room = Some(answer.room);
                self.claim = answer.claim.map(|report| report.claim());
            }
            Some(Datagram::Session { .. }) | None => self.others = self.others.saturating_add(1),
        }
    }
}

/// A sender of datagrams that are not CARA's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Foreign {
    /// Where they came from.
    pub source: SocketAddr,
    /// How many.
    pub datagrams: u32,
}

/// Whether broadcasts leave through an interface, and come back to this host.
#[derive(Clone, Debug)]
pub struct Reach {
    /// The interface.
    pub interface: Interface,
    /// The UDP port of the broadcasts.
    pub port: u16,
    /// Broadcasts that the system took.
    pub sent: u32,
    /// Why the system did not take a broadcast, the last time.
    pub refused: Option<io::ErrorKind>,
    /// Own broadcasts that a second socket of this host heard.
    pub heard: u32,
}

/// What one datagram says.
pub(super) struct News<'n> {
    pub(super) source: SocketAddr,
    pub(super) header: Header,
    pub(super) standing: Standing,
    pub(super) identity: Option<&'n Identity>,
    pub(super) epoch: Option<Epoch>,
    pub(super) datagram: Option<&'n Datagram<'n>>,
    pub(super) by_broadcast: bool,
}
