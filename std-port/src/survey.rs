//! Looking at a network without being one of its units: what can be heard, from whom, of which fleet and version.
//!
//! A [`Survey`] listens on the discovery port beside the units of the host, reads every datagram as far as it can be
//! read, and, when it is told to, asks all m_units of a fleet to show themselves ([`Survey::ask`]). It takes no link,
//! answers nobody, and sends nothing that it was not told to send. S_units that are connected say nothing to
//! strangers, so they are not heard; their manager knows them.
//!
//! ```no_run
//! use cara_std::survey::Survey;
//! use cara_std::{Fleet, Interfaces};
//! use std::time::Duration;
//!
//! let mut survey = Survey::open(Interfaces::All, 21_970)?;
//! survey.ask(Fleet(0));
//! survey.listen(Duration::from_secs(2));
//! for heard in survey.heard() {
//!     println!("{:?} at {}", heard.identity, heard.source);
//! }
//! # Ok::<(), cara_std::Error>(())
//! ```

mod heard;

use std::collections::HashSet;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io;
use std::net::{SocketAddr, SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cara_core::distribution::datagram::{Announce, Datagram, Header, SEARCH_BYTES, WhoHas};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::error::Error;
use cara_core::host::secure::Plain;

use self::heard::News;
pub use self::heard::{Foreign, Heard, Reach};
use crate::sys::datagram::{Datagrams, Socket};
use crate::sys::epoll::{Epoll, Events, Interest};
use crate::sys::interfaces::{Interface, Interfaces};
pub use cara_core::config::VERSION;

/// Most lives of units that are kept; beyond them only those that are kept already are counted on.
pub const HEARD: usize = 4096;
/// Most senders of datagrams that are not CARA's that are kept.
pub const FOREIGN: usize = 64;
/// The name under which a survey asks.
pub const NAME: &str = "cara-survey";

/// A datagram is read up to this length: the longest search, and one byte to see that it is longer.
const READ: usize = SEARCH_BYTES + 1;
/// Datagrams that are read before the time is looked at, so that a flood does not hold up the end.
const BATCH: usize = 256;
const SHARED: u64 = 0;
const VOICE: u64 = 1;

/// One who looks at a network. See the [module](self).
#[derive(Debug)]
pub struct Survey {
    ear: Datagrams,
    voice: UdpSocket,
    set: Epoll,
    opened: Instant,
    identity: Identity,
    epoch: Epoch,
    sequence: u32,
    heard: Vec<Heard>,
    foreign: Vec<Foreign>,
    reach: Vec<Reach>,
    dropped: u64,
}

impl Survey {
    /// Opens the discovery port beside the units of this host; nothing is sent.
    ///
    /// [`Error::PortInUse`] when a program that does not share it has the port.
    pub fn open(interfaces: Interfaces, discovery_port: u16) -> Result<Self, Error> {
        let ear = Datagrams::open(interfaces, discovery_port)?;
        let voice = UdpSocket::bind((interfaces.bind_address(), 0)).map_err(network)?;
        voice.set_broadcast(true).map_err(network)?;
        voice.set_nonblocking(true).map_err(network)?;
        let set = Epoll::new().map_err(network)?;
        set.add(ear.fd(Socket::Shared), SHARED, Interest::READ_LEVEL).map_err(network)?;
        set.add(&voice, VOICE, Interest::READ_LEVEL).map_err(network)?;
        let mut survey = Self {
            ear,
            voice,
            set,
            opened: Instant::now(),
            identity: Identity::s_unit(NAME, std::process::id())?,
            epoch: Epoch(random()),
            sequence: 0,
            heard: Vec::new(),
            foreign: Vec::new(),
            reach: Vec::new(),
            dropped: 0,
        };
        survey.look_at_interfaces();
        Ok(survey)
    }

    /// Asks every m_unit of `fleet` to answer, by a broadcast on each interface. What became of it is in
    /// [`reach`](Self::reach); `false` when no interface took it.
    pub fn ask(&mut self, fleet: Fleet) -> bool {
        self.look_at_interfaces();
        let (bytes, length) = self.question(fleet);
        let Some(question) = bytes.get(..length) else { return false };
        let port = self.ear.discovery_port();
        let mut sent = false;
        for reach in &mut self.reach {
            let Some(broadcast) = reach.interface.broadcast.filter(|_| reach.interface.up) else { continue };
            match send(&self.voice, SocketAddrV4::new(broadcast, port).into(), question) {
                Ok(()) => (reach.sent, sent) = (reach.sent.saturating_add(1), true),
                Err(error) => reach.refused = Some(error.kind()),
            }
        }
        sent
    }

    /// Asks who is at one address, without a broadcast. Of several units of one host, one alone is asked.
    pub fn ask_at(&mut self, fleet: Fleet, address: SocketAddr) -> io::Result<()> {
        let (bytes, length) = self.question(fleet);
        send(&self.voice, address, bytes.get(..length).unwrap_or_default())
    }

    /// Listens for `span`.
    pub fn listen(&mut self, span: Duration) {
        self.listen_until(Instant::now().checked_add(span), |_| false);
    }

    /// Listens until `enough` says so, which is asked after all that came at once, or until `end`; for ever without
    /// one.
    pub fn listen_until(&mut self, end: Option<Instant>, mut enough: impl FnMut(&Self) -> bool) {
        let mut events = Events::new(2);
        loop {
            let left = end.map(|end| end.saturating_duration_since(Instant::now()));
            if self.set.wait(&mut events, left.map(Into::into)).is_err() {
                return;
            }
            let news = events.iter().next().is_some();
            for ready in events.iter() {
                self.read(ready.token == SHARED);
            }
            if (news && enough(self)) || end.is_some_and(|end| Instant::now() >= end) {
                return;
            }
        }
    }

    /// All lives of units that were heard, in the order in which they were first heard.
    pub fn heard(&self) -> &[Heard] {
        &self.heard
    }

    /// The fleets that were heard.
    pub fn fleets(&self) -> HashSet<Fleet> {
        self.heard.iter().map(|heard| heard.fleet).collect()
    }

    /// Who sends something else to the discovery port.
    pub fn foreign(&self) -> &[Foreign] {
        &self.foreign
    }

    /// The interfaces that are used, with those that are down, and how far broadcasts come.
    pub fn reach(&self) -> &[Reach] {
        &self.reach
    }

    /// Datagrams for whose senders there was no room.
    pub const fn dropped(&self) -> u64 {
        self.dropped
    }

    /// The time since the survey was opened.
    pub fn age(&self) -> Duration {
        self.opened.elapsed()
    }

    fn question(&mut self, fleet: Fleet) -> ([u8; SEARCH_BYTES], usize) {
        self.sequence = self.sequence.wrapping_add(1);
        let question = WhoHas {
            identity: self.identity.clone(),
            epoch: self.epoch,
            sequence: self.sequence,
            nonce: random() | 1,
            wanted: None,
            tcp_port: 0,
            expected: 0,
            known: Default::default(),
        };
        let mut bytes = [0; SEARCH_BYTES];
        let length = question.encode(fleet, &Plain, &mut bytes).map_or(0, <[u8]>::len);
        (bytes, length)
    }

    /// Interfaces come and go; what is known of one stays with its address.
    fn look_at_interfaces(&mut self) {
        let found: Arc<[Interface]> = self.ear.targets();
        self.reach.retain(|reach| found.iter().any(|interface| interface.address == reach.interface.address));
        for interface in found.iter() {
            match self.reach.iter_mut().find(|reach| reach.interface.address == interface.address) {
                Some(known) => known.interface = interface.clone(),
                None => self.reach.push(Reach { interface: interface.clone(), sent: 0, refused: None, heard: 0 }),
            }
        }
    }

    /// Reads all that waits on one of the sockets.
    fn read(&mut self, shared: bool) {
        let mut buffer = [0; READ];
        for _ in 0..BATCH {
            let received = match shared {
                true => self.ear.receive(Socket::Shared, &mut buffer),
                false => receive(&self.voice, &mut buffer),
            };
            let Some((length, source)) = received else { return };
            self.note(source, buffer.get(..length).unwrap_or_default(), shared);
        }
    }

    fn note(&mut self, source: SocketAddr, bytes: &[u8], by_broadcast: bool) {
        if self.is_own(source) {
            if let Some(reach) = self.reach.iter_mut().find(|reach| source.ip() == reach.interface.address) {
                reach.heard = reach.heard.saturating_add(1);
            }
            return;
        }
        let Ok((header, body)) = Header::decode(bytes) else { return self.note_foreign(source) };
        let datagram = header.read(body).ok();
        let (identity, epoch) = match &datagram {
            Some(
                Datagram::WhoHas(WhoHas { identity, epoch, .. }) | Datagram::Announce(Announce { identity, epoch, .. }),
            ) => (Some(identity), Some(*epoch)),
            Some(Datagram::Session { .. }) | None => (None, None),
        };
        self.note_unit(&News { source, header, identity, epoch, datagram: datagram.as_ref(), by_broadcast });
    }

    fn is_own(&self, source: SocketAddr) -> bool {
        let own_port = self.voice.local_addr().is_ok_and(|own| own.port() == source.port());
        own_port && (source.ip().is_loopback() || self.reach.iter().any(|reach| reach.interface.address == source.ip()))
    }

    fn note_unit(&mut self, news: &News) {
        let now = self.opened.elapsed();
        let place = match self.heard.iter().position(|known| known.is(news)) {
            Some(place) => place,
            None if self.heard.len() >= HEARD => {
                self.dropped = self.dropped.saturating_add(1);
                return;
            }
            None => {
                self.heard.push(Heard::new(news, now));
                self.heard.len().saturating_sub(1)
            }
        };
        let Some(heard) = self.heard.get_mut(place) else { return };
        heard.take(news, now);
    }

    fn note_foreign(&mut self, source: SocketAddr) {
        let full = self.foreign.len() >= FOREIGN;
        match self.foreign.iter_mut().find(|known| known.source == source) {
            Some(known) => known.datagrams = known.datagrams.saturating_add(1),
            None if full => self.dropped = self.dropped.saturating_add(1),
            None => self.foreign.push(Foreign { source, datagrams: 1 }),
        }
    }
}

fn receive(voice: &UdpSocket, buffer: &mut [u8]) -> Option<(usize, SocketAddr)> {
    loop {
        match voice.recv_from(buffer) {
            Ok(received) => return Some(received),
            // What an earlier question met at its target; the next datagram is unharmed.
            Err(error) if is_earlier(&error) => {}
            Err(_) => return None,
        }
    }
}

fn send(voice: &UdpSocket, to: SocketAddr, bytes: &[u8]) -> io::Result<()> {
    // A refusal that an earlier datagram met is reported by the next send, which itself was not tried.
    for _ in 0..3 {
        match voice.send_to(bytes, to) {
            Ok(_) => return Ok(()),
            Err(error) if is_earlier(&error) => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::ErrorKind::ConnectionRefused.into())
}

fn is_earlier(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::Interrupted | io::ErrorKind::ConnectionRefused)
}

/// Bits that differ from call to call.
fn random() -> u64 {
    RandomState::new().build_hasher().finish()
}

fn network(error: io::Error) -> Error {
    tracing::warn!(%error, "the survey could not be opened");
    Error::Network
}

#[cfg(test)]
mod tests;
