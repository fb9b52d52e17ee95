//! A unit and its peers, and the steps of a script: the engine of the targets that have links.

use cara_core::config::{Constraints, Mode, Priority, VERSIONS};
use cara_core::distribution::authenticator::CODE_BYTES;
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::hello::{ClaimReport, Hello, Limits};
use cara_core::distribution::identity::{Epoch, Role};
use cara_core::error::{CloseReason, Error, ServiceError};
use cara_core::services::call::Callee;
use cara_core::services::heart::Renew;
use cara_core::services::lease::Latch;
use cara_core::services::session::{Delivery, RequestOptions};
use cara_core::storage::Buffers as _;
use cara_core::time::{Duration, Instant};

use crate::peer::Peer;
use crate::said::{self, Said};
use crate::script::Script;
use crate::unit::services::{FUNCTIONS, offered};
use crate::unit::{Arguments, FLEET, Keyed, LINKS, ROOTS, Unit, address, identity, manager};

/// A unit and the other ends of its links.
pub(crate) struct Play {
    pub(crate) unit: Unit,
    pub(crate) peers: [Option<Peer>; LINKS],
    opened: u64,
}

/// Where the unit's clock may stand at first: it counts milliseconds modulo 2^32 and microseconds from its start.
const CLOCKS: [u64; 4] = [10_000_000, (1 << 32) * 1_000 - 300_000, (1 << 31) * 1_000 - 300_000, 1];

impl Play {
    pub(crate) fn new(script: &mut Script<'_>, mode: Mode) -> Self {
        let start = script.byte();
        let role = if start & 1 == 0 { Role::SUnit } else { Role::MUnit };
        let now = Instant::from_micros(CLOCKS[usize::from(start >> 1) % CLOCKS.len()]);
        let unit = Unit::new(now, role, mode, u64::from(start >> 3));
        Self { unit, peers: std::array::from_fn(|_| None), opened: 0 }
    }

    pub(crate) fn is_manager(&self) -> bool {
        self.unit.hub.node.identity().role() == Role::MUnit
    }

    /// The hello of a peer: of the unit's counterpart, or of another unit.
    pub(crate) fn hello(&mut self, who: u8) -> Hello {
        let who = if who == 0 { u8::from(!self.is_manager()) } else { who };
        let identity = identity(who);
        self.opened += 1;
        let is_manager = identity.role() == Role::MUnit;
        let claim = TaggedClaim { claim: Claim { term: 3, claimant: 4 }, tag: [0; CODE_BYTES] };
        Hello {
            versions: VERSIONS,
            capabilities: 0,
            fleet: FLEET,
            identity,
            wanted: (!is_manager).then(manager),
            epoch: Epoch(3),
            claim: is_manager.then_some(ClaimReport { tagged: claim, since: ClaimReport::NEVER }),
            obeyed: None,
            nonce: self.opened,
            limits: Limits { message_size: 1_024, chunk_size: 512, calls: 4, minimum_interval: 0 },
            link: 2,
            udp_port: 7_000,
            stamp: 77,
            keep_alive: 1_000,
            skipped: 0,
        }
    }

    /// A stream is opened by a peer, or by the unit to it.
    pub(crate) fn open(&mut self, index: usize, dialed: bool, own: Hello, root: u8) {
        let host = 10 + own.identity.id() as u8;
        let keys = Keyed::new(self.unit.mode(), root, own.identity.clone());
        self.unit.open(index, dialed, host, Some(&own.identity));
        self.peers[index] = Some(Peer::new(self.unit.mode(), !dialed, &own, keys, address(host)));
    }

    /// A genuine link, if the unit admits it.
    pub(crate) fn join(&mut self, index: usize, dialed: bool, own: Hello) {
        self.open(index, dialed, own, ROOTS[0]);
        for _ in 0..6 {
            self.carry(index);
        }
        let published = said::PUBLISHED.clone();
        self.say(index, Said::Message(Priority::High, published), false);
    }

    /// The first link has joined.
    pub(crate) fn has_joined(&self) -> bool {
        self.unit.links[0].as_ref().is_some_and(|link| link.joined)
    }

    /// The peer takes what the unit has written, and answers.
    pub(crate) fn carry(&mut self, index: usize) {
        let written = std::mem::take(&mut self.unit.mail.streams[index]);
        if let Some(peer) = &mut self.peers[index] {
            let answer = peer.hear(&written);
            for (to, mut datagram) in std::mem::take(&mut self.unit.mail.datagrams) {
                if to == peer.address {
                    peer.hear_datagram(&mut datagram);
                }
            }
            self.arrive(index, &answer);
            self.unit.with(index, |link, cx| link.session.writable(cx));
        }
        self.unit.settle();
        self.forget();
    }

    /// Bytes reach the unit.
    pub(crate) fn arrive(&mut self, index: usize, bytes: &[u8]) {
        crate::saw("stream", "", bytes);
        if let Some(link) = self.unit.links[index].as_mut().filter(|link| link.inbox.len() < 1 << 15) {
            link.inbox.extend_from_slice(bytes);
        }
    }

    pub(crate) fn forget(&mut self) {
        for (peer, link) in self.peers.iter_mut().zip(&self.unit.links) {
            if link.is_none() {
                *peer = None;
            }
        }
    }

    /// The peer says something on a link that its handshake has opened.
    fn say(&mut self, index: usize, said: Said, by_datagram: bool) {
        self.note_release(index, &said);
        let Some(peer) = self.peers[index].as_mut().filter(|peer| peer.is_live) else { return };
        let mut datagram = match &said {
            Said::Body(body) | Said::Release(_, _, body) if by_datagram => Some(peer.datagram(body)),
            Said::Message(priority, message) if by_datagram => {
                Some(peer.datagram(&[&[3, priority.to_wire()][..], message].concat()))
            }
            _ => None,
        };
        let from = peer.address;
        if let Some(datagram) = &mut datagram {
            return self.unit.datagram(from, datagram);
        }
        let bytes = match said {
            Said::Message(priority, message) => peer.message(priority, &message),
            Said::Body(body) | Said::Release(_, _, body) => peer.raw(&[&[6][..], &body].concat()),
            Said::Frame(bytes) => bytes,
        };
        self.arrive(index, &bytes);
    }

    /// What a peer releases moves no more once the unit has read that. Behind bytes that are no frames nothing need be read.
    fn note_release(&mut self, index: usize, said: &Said) {
        let Some(link) = self.unit.links[index].as_mut().filter(|link| !link.is_loose && link.joined) else { return };
        let Said::Release(slot, call, _) = said else { return };
        for (moving, of) in self.unit.motors.iter().filter_map(|motor| motor.mover(index)) {
            let is_meant = slot.map_or(moving == *call, |slot| slot == of && moving <= *call);
            if is_meant {
                link.released.insert((moving, of));
            }
        }
    }

    /// One step of a link that has joined, of its unit, or of time.
    pub(crate) fn step(&mut self, script: &mut Script<'_>, index: usize) {
        match script.below(32) {
            0..12 => {
                let how = script.byte();
                let now = self.unit.now;
                if let Some((peer, link)) = self.peers[index].as_mut().zip(self.unit.links[index].as_mut()) {
                    let said = said::next(script, peer, link, now);
                    self.say(index, said, how & 3 == 3);
                }
                // More may follow before the unit reads.
                if how & 0x30 == 0x30 {
                    return;
                }
            }
            12 => self.carry(index),
            13..16 => self.unit.pass(Duration::from_millis(u64::from(script.byte()))),
            16 => self.unit.pass(Duration::from_millis(u64::from(script.byte()) * 40)),
            17 => {
                // The host was suspended.
                self.unit.now = self.unit.now + Duration::from_millis(u64::from(script.byte()) * 100);
            }
            18..21 => self.call(script, index),
            21 => self.control(script, index),
            22 | 23 => {
                let link = self.unit.links[index].as_mut().filter(|link| !link.held.is_empty());
                let count = link.as_ref().map_or(1, |link| link.held.len()) as u8;
                if let Some((call, stops)) = link.map(|link| link.held.remove(usize::from(script.below(count)))) {
                    let results = match script.below(4) {
                        0 => Err(Error::Service(ServiceError::Failed(4))),
                        _ => Ok(7),
                    };
                    self.unit.answer(index, call, results, Some(stops));
                }
            }
            24 => {
                let motor = usize::from(script.below(2));
                let open = self.unit.motors[motor].open;
                if let Some(open) = open.filter(|open| open.link == index) {
                    let lease = std::rc::Rc::clone(&self.unit.motors[motor].lease);
                    if self.unit.with(index, |link, cx| link.session.end_order(cx, &lease, open.order)) == Some(true) {
                        self.unit.motors[motor].open = None;
                    }
                }
            }
            25 => {
                // A bumper.
                let (motor, now) = (usize::from(script.below(2)), self.unit.now);
                let latch = Latch { by: 0, reason: u16::from(script.byte()) };
                let motor = &mut self.unit.motors[motor];
                motor.lease.inhibit(now, latch);
                motor.stop();
            }
            26 => self.change_list(script),
            27 => match script.below(4) {
                0 | 1 => self.unit.starved.extend(self.unit.pool.take()),
                _ => {
                    for buffer in std::mem::take(&mut self.unit.starved) {
                        self.unit.pool.give(buffer);
                    }
                }
            },
            28 => {
                self.unit.mail.capacity = [0, 1, 100, 1 << 16][usize::from(script.below(4))];
                self.unit.with(index, |link, cx| link.session.writable(cx));
            }
            29 => self.unit.set_table(script.below(4)),
            30 => {
                let now = self.unit.now;
                let mut values = Arguments::sized();
                values.add_int("x", 1).expect("it fits");
                let slot = self.unit.functions.find("speed");
                if let Some(function) = slot.and_then(|slot| self.unit.functions.function(slot)) {
                    let newest = function.handler.values.as_ref().expect("it is a stream");
                    newest.0.borrow_mut().publish(now, Duration::ZERO, function.signature, &values).expect("it fits");
                }
                for index in 0..LINKS {
                    self.unit.with(index, |link, cx| link.session.stream_changed(cx.now));
                }
            }
            _ => self.end_link(script, index),
        }
        self.unit.settle();
        self.forget();
    }

    /// The unit calls a function of the peer.
    fn call(&mut self, script: &mut Script<'_>, index: usize) {
        let name = ["ask", "move", "halt", "heat"][usize::from(script.below(4))];
        let flags = script.byte();
        let mut arguments = Arguments::sized();
        arguments.add_int("x", 1).expect("it fits");
        let options = RequestOptions {
            timeout: (flags & 1 != 0).then(|| Duration::from_millis(u64::from(script.byte()))),
            priority: (flags & 2 != 0).then(|| Priority::from_wire(script.below(4)).unwrap_or_default()),
            delivery: if flags & 4 != 0 { Delivery::BestEffort } else { Delivery::Reliable },
            renew: if flags & 8 != 0 { Renew::Process } else { Renew::Never },
            take_over: flags & 16 != 0,
            operator: flags & 32 != 0,
            progress: flags & 64 != 0,
            ..RequestOptions::new()
        };
        let wants_reply = flags & 128 == 0;
        self.unit.with(index, |link, cx| {
            let made = link.session.request(cx, Callee::from(name), &arguments, &options, wants_reply);
            if let Ok(id) = made {
                assert!(link.asked.insert(id.0, wants_reply).is_none(), "an id is given twice");
            }
        });
    }

    /// The unit does something else with its link.
    fn control(&mut self, script: &mut Script<'_>, index: usize) {
        let (act, which, byte) = (script.below(10), script.below(4), script.byte());
        self.unit.with(index, |link, cx| {
            let asked = link.asked.keys().nth(usize::from(which)).copied();
            let id = cara_core::services::requests::CallId(asked.unwrap_or_else(|| byte.into()));
            match act {
                0 => {
                    link.session.cancel(cx, id);
                    link.asked.remove(&id.0);
                }
                1 => link.session.cancel_but_wait(cx, id),
                2 => drop(link.session.release(cx, cara_core::distribution::function_list::Slot(which.into()))),
                3 => drop(link.session.ping(cx)),
                4 => drop(link.session.subscribe(cx, "heat", Duration::from_millis(byte.into()))),
                5 => link.session.unsubscribe(cx, "heat"),
                6 => drop(link.session.hand_over(cx, &manager())),
                7 => link.session.hold_back(),
                8 => link.session.flush_gathered(cx),
                _ => {
                    let constraints = Constraints {
                        message_size: 64 + u32::from(byte),
                        calls_per_peer: which.into(),
                        minimum_interval: Duration::from_millis(u64::from(byte & 3)),
                        ..*link.session.constraints()
                    };
                    link.session.set_constraints(cx, constraints);
                }
            }
        });
    }

    /// A function is replaced, removed, added or hidden.
    fn change_list(&mut self, script: &mut Script<'_>) {
        let act = script.below(5);
        let leases: Vec<_> = self.unit.motors.iter().map(|motor| std::rc::Rc::clone(&motor.lease)).collect();
        let (definition, attributes, handler) = offered(usize::from(script.below(FUNCTIONS as u8)), &leases);
        let unit = &mut self.unit;
        let slot = unit.functions.find(definition.name());
        let motor = handler.motor.filter(|_| attributes.lease.is_some());
        let gone = match act {
            0 => unit.functions.replace(definition, attributes, handler).is_ok(),
            1 => unit.functions.remove(definition.name()).is_ok(),
            _ => false,
        };
        if let Some(motor) = motor.filter(|_| gone) {
            unit.motors[motor].clear(unit.now);
        }
        match (act, slot) {
            (0, _) => {
                for index in 0..LINKS {
                    self.unit.with(index, |link, cx| link.session.publish(cx));
                }
            }
            (1 | 2, Some(slot)) => {
                unit.hub.publications.withdraw(slot);
                for index in 0..LINKS {
                    self.unit.with(index, |link, cx| link.session.withdraw(cx, slot));
                }
            }
            _ => {
                let (definition, attributes, handler) = offered(usize::from(script.below(FUNCTIONS as u8)), &leases);
                let added = unit.functions.add_function(definition, attributes, handler);
                let slot = added.ok().or_else(|| unit.functions.find(definition.name()));
                if let Some(slot) = slot {
                    let _ = unit.hub.publications.publish_to_all(slot);
                }
                for index in 0..LINKS {
                    self.unit.with(index, |link, cx| link.session.publish(cx));
                }
            }
        }
    }

    fn end_link(&mut self, script: &mut Script<'_>, index: usize) {
        let act = script.below(4);
        self.unit.with(index, |link, cx| match act {
            0 => link.session.close(cx, CloseReason::Stopped),
            1 => link.session.disconnected(CloseReason::Reset),
            2 => link.session.revoke(cx),
            _ => link.session.disconnected(CloseReason::StoppedHere),
        });
    }

    pub(crate) fn end(self) {
        self.unit.end();
    }
}
