//! Surveys of a network without being one of its units: the senders on it, with their fleet, mode and version.
//!
//! A [`Survey`] listens on the discovery port beside the units of the host, decodes every datagram as far as it can,
//! and, on request, asks all m_units of a fleet to show themselves ([`Survey::ask`]). It accepts no link, answers
//! nothing, and sends nothing unasked. Connected s_units do not answer unknown senders, so they are not heard; their
//! manager knows them.
//!
//! Discovery of secured units is signed and not sealed, so that it is readable without any key. With the fleet's
//! discovery key ([`SurveyKeys`]) its m_units answer, and [`Standing`] says which datagrams are the fleet's. Every unit
//! of a fleet has that key: it shows that a datagram comes from one of them, and not from which.
//!
//! ```no_run
//! use cara_std::survey::{Ports, Survey, SurveyKeys};
//! use cara_std::{Fleet, Interfaces};
//! use std::time::Duration;
//!
//! let mut survey = Survey::open(Interfaces::All, Ports::Usual)?.with_keys(SurveyKeys::gather());
//! survey.ask(Fleet(0));
//! survey.listen(Duration::from_secs(2));
//! for heard in survey.heard() {
//!     println!("{:?} at {}: {:?}", heard.identity, heard.source, heard.standing);
//! }
//! # Ok::<(), cara_std::Error>(())
//! ```

mod heard;
mod keys;
mod ports;

use std::collections::HashSet;
use std::io;
use std::net::{SocketAddr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

use cara_core::config::Mode;
use cara_core::distribution::authenticator::Authenticator;
use cara_core::distribution::datagram::{Announce, Datagram, Header, SEARCH_BYTES, WhoHas};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::error::Error;
use cara_core::host::secure::Plain;

use self::heard::News;
pub use self::heard::{Foreign, Heard, Reach, Standing};
pub use self::keys::SurveyKeys;
pub use self::ports::Ports;
use crate::sys::datagram::{Datagrams, Socket};
use crate::sys::epoll::{Epoll, Events, Interest};
use crate::sys::interfaces::Interfaces;
use crate::sys::random;
pub use cara_core::config::{VERSIONS, Versions};

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
/// The token of the voice; each ear has its index.
const VOICE: u64 = u64::MAX;

/// A survey of a network. See the [module](self).
#[derive(Debug)]
pub struct Survey {
    ports: Ports,
    ears: Vec<Datagrams>,
    voice: UdpSocket,
    set: Epoll,
    keys: SurveyKeys,
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
    /// Opens discovery ports beside the units of this host; nothing is sent.
    ///
    /// [`Error::PortInUse`] when a program that does not share it has one of them.
    pub fn open(interfaces: Interfaces, ports: impl Into<Ports>) -> Result<Self, Error> {
        let ports = ports.into();
        let set = Epoll::new().map_err(network)?;
        let mut ears = Vec::new();
        for (port, token) in ports.numbers().into_iter().zip(0..) {
            let ear = Datagrams::open(interfaces, port)?;
            set.add(ear.fd(Socket::Shared), token, Interest::READ_LEVEL).map_err(network)?;
            ears.push(ear);
        }
        let voice = UdpSocket::bind((interfaces.bind_address(), 0)).map_err(network)?;
        voice.set_broadcast(true).map_err(network)?;
        voice.set_nonblocking(true).map_err(network)?;
        set.add(&voice, VOICE, Interest::READ_LEVEL).map_err(network)?;
        let mut survey = Self {
            ports,
            ears,
            voice,
            set,
            keys: SurveyKeys::default(),
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

    /// Asks secured fleets as well, those of which there are keys.
    pub fn with_keys(mut self, keys: SurveyKeys) -> Self {
        self.keys = keys;
        self
    }

    /// The keys that it has.
    pub fn keys(&self) -> &SurveyKeys {
        &self.keys
    }

    /// Asks every m_unit of `fleet` to answer, by broadcasts on each interface: one in plain mode, and one for each key
    /// that the fleet may speak with. What became of them is in [`reach`](Self::reach); `false` when no interface took one.
    pub fn ask(&mut self, fleet: Fleet) -> bool {
        self.look_at_interfaces();
        let mut sent = false;
        for (mode, question) in self.questions(fleet) {
            let port = self.ports.of(mode);
            for reach in self.reach.iter_mut().filter(|reach| reach.port == port) {
                let Some(broadcast) = reach.interface.broadcast.filter(|_| reach.interface.up) else { continue };
                match send(&self.voice, SocketAddrV4::new(broadcast, port).into(), &question) {
                    Ok(()) => (reach.sent, sent) = (reach.sent.saturating_add(1), true),
                    Err(error) => reach.refused = Some(error.kind()),
                }
            }
        }
        sent
    }

    /// Asks the unit at one address, by unicast. Of several units of one host only one receives it.
    pub fn ask_at(&mut self, fleet: Fleet, address: SocketAddr) -> io::Result<()> {
        self.questions(fleet).iter().try_for_each(|(_, question)| send(&self.voice, address, question))
    }

    /// Listens for `span`.
    pub fn listen(&mut self, span: Duration) {
        self.listen_until(Instant::now().checked_add(span), |_| false);
    }

    /// Listens until `enough` says so, which is asked after all that came at once, or until `end`; for ever without
    /// one.
    pub fn listen_until(&mut self, end: Option<Instant>, mut enough: impl FnMut(&Self) -> bool) {
        let mut events = Events::new(3);
        loop {
            let left = end.map(|end| end.saturating_duration_since(Instant::now()));
            if self.set.wait(&mut events, left.map(Into::into)).is_err() {
                return;
            }
            let news = events.iter().next().is_some();
            for ready in events.iter() {
                self.read(ready.token);
            }
            if (news && enough(self)) || end.is_some_and(|end| Instant::now() >= end) {
                return;
            }
        }
    }

    /// All boots of units that were heard, in the order in which they were first heard.
    pub fn heard(&self) -> &[Heard] {
        &self.heard
    }

    /// The fleets that were heard.
    pub fn fleets(&self) -> HashSet<Fleet> {
        self.heard.iter().map(|heard| heard.fleet).collect()
    }

    /// Senders of other traffic to the discovery port.
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

    fn questions(&mut self, fleet: Fleet) -> Vec<(Mode, Vec<u8>)> {
        let first = self.sequence;
        let question = |sequence| WhoHas {
            identity: self.identity.clone(),
            epoch: self.epoch,
            sequence,
            nonce: random() | 1,
            wanted: None,
            tcp_port: 0,
            expected: 0,
            known: Default::default(),
            standby: false,
            skipped: 0,
        };
        let plain = encoded(&question(first.wrapping_add(1)), fleet, &Plain);
        let secured = self.keys.signers(fleet).zip(2..);
        let secured =
            secured.map(|(signer, location)| encoded(&question(first.wrapping_add(location)), fleet, &signer));
        let questions: Vec<_> = std::iter::once(plain).chain(secured).collect();
        self.sequence = first.wrapping_add(1).wrapping_add(questions.len() as u32);
        questions
    }

    /// Interfaces come and go; what is known of one stays with its address.
    fn look_at_interfaces(&mut self) {
        let before = std::mem::take(&mut self.reach);
        for ear in &self.ears {
            let port = ear.discovery_port();
            for interface in ear.targets().iter() {
                let same = |reach: &&Reach| reach.port == port && reach.interface.address == interface.address;
                let unknown = Reach { interface: interface.clone(), port, sent: 0, refused: None, heard: 0 };
                let known = before.iter().find(same).cloned().unwrap_or(unknown);
                self.reach.push(Reach { interface: interface.clone(), ..known });
            }
        }
    }

    /// Reads all that waits on one of the sockets.
    fn read(&mut self, token: u64) {
        let mut buffer = [0; READ];
        for _ in 0..BATCH {
            let ear = usize::try_from(token).ok().and_then(|ear| self.ears.get(ear));
            let (received, port) = match ear {
                Some(ear) => (ear.receive(Socket::Shared, &mut buffer), Some(ear.discovery_port())),
                None => (receive(&self.voice, &mut buffer), None),
            };
            let Some((length, source)) = received else { return };
            self.note(source, buffer.get(..length).unwrap_or_default(), port);
        }
    }

    /// Notes a datagram that came to a discovery port, or to the survey alone.
    fn note(&mut self, source: SocketAddr, bytes: &[u8], port: Option<u16>) {
        if self.is_own(source) {
            let mut reaches = self.reach.iter_mut().filter(|reach| Some(reach.port) == port);
            if let Some(reach) = reaches.find(|reach| source.ip() == reach.interface.address) {
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
        let standing = self.standing(&header, datagram.as_ref(), bytes);
        let (datagram, by_broadcast) = (datagram.as_ref(), port.is_some());
        self.note_unit(&News { source, header, standing, identity, epoch, datagram, by_broadcast });
    }

    fn standing(&self, header: &Header, datagram: Option<&Datagram>, bytes: &[u8]) -> Standing {
        match (header.mode, datagram) {
            (Mode::Plain, _) => Standing::Plain,
            (Mode::Secured, Some(Datagram::Session { .. })) => Standing::Unchecked,
            // How another version signs is not known here.
            (Mode::Secured, _) if VERSIONS.common(header.versions).is_none() => Standing::Unchecked,
            (Mode::Secured, _) => self.keys.standing(header.fleet, bytes),
        }
    }

    fn is_own(&self, source: SocketAddr) -> bool {
        let own_port = self.voice.local_addr().is_ok_and(|own| own.port() == source.port());
        own_port && (source.ip().is_loopback() || self.reach.iter().any(|reach| reach.interface.address == source.ip()))
    }

    fn note_unit(&mut self, news: &News) {
        let now = self.opened.elapsed();
        let location = match self.heard.iter().position(|known| known.is(news)) {
            Some(location) => location,
            None if self.heard.len() >= HEARD => {
                self.dropped = self.dropped.saturating_add(1);
                return;
            }
            None => {
                self.heard.push(Heard::new(news, now));
                self.heard.len().saturating_sub(1)
            }
        };
        let Some(heard) = self.heard.get_mut(location) else { return };
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

fn encoded(question: &WhoHas, fleet: Fleet, signer: &impl Authenticator) -> (Mode, Vec<u8>) {
    let mut bytes = [0; SEARCH_BYTES];
    (signer.mode(), question.encode(fleet, signer, &mut bytes).unwrap_or_default().to_vec())
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

fn network(error: io::Error) -> Error {
    tracing::warn!(%error, "the survey could not be opened");
    Error::Network
}

#[cfg(test)]
mod tests;
