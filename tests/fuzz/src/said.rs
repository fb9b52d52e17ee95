//! What a peer says on a link that has joined, as a script wants it: mostly numbers that mean something to the unit.

use std::sync::LazyLock;

use cara_core::config::Priority;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::message::{
    Control, Release, Renewal, RequestHeader, SampleHeader, SessionBody, encode_failure, encode_progress, encode_reply,
};
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::Report;
use cara_core::host::frame::Frame;
use cara_core::time::{Duration, Instant};

use crate::peer::Peer;
use crate::script::Script;
use crate::unit::Link;

/// How it is to travel.
pub(crate) enum Said {
    /// As a message.
    Message(Priority, Vec<u8>),
    /// As a session body, in the stream or a datagram.
    Body(Vec<u8>),
    /// The same, where it releases a call, or all calls of a function up to that one.
    Release(Option<Slot>, u32, Vec<u8>),
    /// As a frame.
    Frame(Vec<u8>),
}

/// The functions that a peer offers: slot, text, attributes.
pub(crate) const OFFERED: [(&str, Attributes); 4] = [
    ("ask(x: int) -> (x: int)", Attributes::NORMAL),
    ("move()", Attributes { lease: Some(Duration::from_millis(300)), ..Attributes::NORMAL }),
    ("halt()", Attributes { stop: true, priority: Priority::Emergency, ..Attributes::NORMAL }),
    ("heat(x: int)", Attributes { stream: Some(10), ..Attributes::NORMAL }),
];

/// The control message that publishes them.
pub(crate) static PUBLISHED: LazyLock<Vec<u8>> = LazyLock::new(published);

fn published() -> Vec<u8> {
    let mut bytes = Vec::new();
    for (slot, (text, attributes)) in OFFERED.iter().enumerate() {
        let is_stream = attributes.stream.is_some();
        let definition = if is_stream { Definition::stream(text) } else { Definition::parse(text) };
        let definition = definition.expect("it is a signature");
        let (attributes, signature) = (attributes.encode(), definition.as_bytes());
        let publish = Control::Publish { slot: slot as u16, generation: 0, attributes: &attributes, signature };
        let mut out = [0; 200];
        bytes.extend_from_slice(&publish.encode(&mut out).expect("it is short")[usize::from(slot > 0) * 4..]);
    }
    let mut out = [0; 60];
    bytes.extend_from_slice(&Control::ListEnd { serial: 1 }.encode(&mut out).expect("it is short")[4..]);
    bytes
}

fn priority(script: &mut Script<'_>) -> Priority {
    Priority::from_wire(script.below(4)).unwrap_or_default()
}

/// An id of one of the last calls of the peer, or any.
fn call(script: &mut Script<'_>, peer: &Peer) -> u32 {
    match script.byte() {
        back @ ..0xF0 => peer.last.wrapping_sub(u32::from(back % 8)),
        _ => script.number() as u32,
    }
}

/// The unit's clock, as the peer may have heard it: some time ago, ahead, or anything.
fn stamp(script: &mut Script<'_>, now: Instant) -> u64 {
    match script.byte() {
        ago @ ..0xD0 => now.as_micros().saturating_sub(u64::from(ago) * 1_000),
        ahead @ ..0xE0 => now.as_micros().saturating_add(u64::from(ahead - 0xD0)),
        ago @ ..0xF0 => now.as_micros().saturating_sub(u64::from(ago - 0xDF) * 1_000_000),
        _ => script.number(),
    }
}

/// Notes until when a call may have been wanted.
fn note(link: &mut Link, call: u32, stamp: u64, since: Duration) {
    let at = Instant::from_micros(stamp) + since;
    let said = link.said.entry(call).or_insert(Instant::START);
    *said = at.max(*said);
}

fn request(script: &mut Script<'_>, peer: &mut Peer, link: &mut Link, now: Instant) -> Said {
    let flags = script.byte();
    let id = if flags & 0x80 == 0 { peer.last.wrapping_add(1) } else { call(script, peer) };
    peer.last = peer.last.max(id);
    let slot = script.below(13);
    let (stamp, since) = if flags & 0x40 == 0 {
        (now.as_micros(), Duration::ZERO)
    } else {
        (stamp(script, now), Duration::from_micros(script.number() & 0xFFFF_FFFF))
    };
    note(link, id, stamp, since);
    let header = RequestHeader {
        id,
        slot: Slot(slot.into()),
        generation: Generation(u16::from(flags & 0x20 != 0 && script.flag())),
        wants_reply: flags & 1 == 0,
        wants_progress: flags & 2 != 0,
        takes_over: flags & 4 != 0,
        operator: flags & 8 != 0,
        unknown: if flags & 0x3F == 0x3F { 0x20 } else { 0 },
        remaining: Duration::from_millis(if flags & 0x10 == 0 { 2_000 } else { script.number() & 0xFFFF }),
        stamp,
        since,
        number: if flags & 0x20 == 0 { id } else { script.number() as u32 },
    };
    let block = match slot {
        2 | 7 | 8 => 5_u64.to_le_bytes().to_vec(),
        9 => script.bytes().to_vec(),
        _ => Vec::new(),
    };
    let priority = match slot {
        3 | 4 => Priority::Emergency,
        2 => Priority::High,
        _ => Priority::Normal,
    };
    let priority = if flags & 0x30 == 0x30 { self::priority(script) } else { priority };
    Said::Message(priority, [&header.encode()[..], &block].concat())
}

fn control(script: &mut Script<'_>) -> Said {
    let mut message = vec![3, 0, 0, 0];
    for _ in 0..1 + script.below(2) {
        let mut body = Vec::new();
        let kind = u16::from(script.below(14));
        for _ in 0..script.below(8) {
            put_number(script.number(), &mut body);
        }
        if script.flag() {
            body.extend_from_slice(script.bytes());
        }
        put_item(kind, &body, &mut message);
    }
    Said::Message(Priority::High, message)
}

fn publish(script: &mut Script<'_>) -> Said {
    let (text, attributes) = OFFERED[usize::from(script.below(OFFERED.len() as u8))];
    let definition = if attributes.stream.is_some() { Definition::stream(text) } else { Definition::parse(text) };
    let definition = definition.expect("it is a signature");
    let attributes = attributes.encode();
    let control = Control::Publish {
        slot: script.below(8).into(),
        generation: script.below(3).into(),
        attributes: &attributes,
        signature: if script.flag() { script.bytes() } else { definition.as_bytes() },
    };
    let mut out = [0; 600];
    Said::Message(Priority::High, control.encode(&mut out).expect("it is short").to_vec())
}

fn reply(script: &mut Script<'_>, link: &Link) -> Said {
    let asked = link.asked.keys().nth(usize::from(script.below(4)));
    let id = asked.copied().unwrap_or_else(|| script.number() as u32);
    let head = match script.below(8) {
        0..4 => encode_reply(id, Ok(())).to_vec(),
        4 => encode_reply(id, Err(Error::Service(ServiceError::Failed(3)))).to_vec(),
        5 => encode_reply(id, Err(Error::Held { by: 3, operator: true })).to_vec(),
        6 => encode_failure(id, Error::Expired).to_vec(),
        _ => encode_progress(id).to_vec(),
    };
    let block = if script.flag() { script.bytes() } else { &[7, 0, 0, 0, 0, 0, 0, 0] };
    Said::Message(Priority::Normal, [&head[..], block].concat())
}

/// A number of an item, as postcard writes it.
pub(crate) fn put_number(mut number: u64, out: &mut Vec<u8>) {
    while number >= 0x80 {
        out.push(number as u8 | 0x80);
        number >>= 7;
    }
    out.push(number as u8);
}

/// An item of a control message, a hello or a datagram.
pub(crate) fn put_item(kind: u16, body: &[u8], out: &mut Vec<u8>) {
    out.extend_from_slice(&kind.to_le_bytes());
    out.extend_from_slice(&(body.len() as u16).to_le_bytes());
    out.extend_from_slice(body);
    out.resize(out.len().next_multiple_of(4), 0);
}

/// What the peer says next.
pub(crate) fn next(script: &mut Script<'_>, peer: &mut Peer, link: &mut Link, now: Instant) -> Said {
    match script.below(16) {
        0..4 => request(script, peer, link, now),
        4 | 5 => {
            let class = priority(script);
            let call = call(script, peer);
            let is_fresh = script.flag();
            let stamp = if is_fresh { now.as_micros() } else { stamp(script, now) };
            let (since, age) = if is_fresh { (0, 0) } else { (script.number(), script.number()) };
            let (since, age) = (Duration::from_micros(since & 0xFFFF_FFFF), Duration::from_micros(age & 0xFFFF_FFFF));
            note(link, call, stamp, since);
            Said::Body(SessionBody::renewal(&Renewal { call, class, stamp, since, age }).to_vec())
        }
        6 => {
            let release = Release { call: call(script, peer), class: priority(script) };
            if script.flag() {
                return Said::Release(None, release.call, SessionBody::release(&release).to_vec());
            }
            Said::Body(SessionBody::cancel(&release).to_vec())
        }
        7 => {
            let (slot, call) = (Slot(script.below(13).into()), call(script, peer));
            Said::Release(Some(slot), call, SessionBody::release_all(slot, call).to_vec())
        }
        8 => {
            let (received, hears, holds) = (script.number() as u32, script.flag(), script.flag());
            // No flag of its own: the inputs of the corpus keep their meaning.
            let report = Report { received, hears, holds, misses: received % 2 == 1 };
            Said::Body(match script.below(4) {
                0 => SessionBody::PING.to_vec(),
                1 => SessionBody::pong(report).to_vec(),
                2 => SessionBody::renewed(script.number() as u32).to_vec(),
                _ => SessionBody::keep_alive(stamp(script, now), report).to_vec(),
            })
        }
        9 => control(script),
        10 => publish(script),
        11 | 12 => reply(script, link),
        13 => {
            let made = stamp(script, now) as i64;
            let (slot, generation) = (Slot(script.below(5).into()), Generation(script.below(2).into()));
            let block = if script.flag() { script.bytes() } else { &[1; 8] };
            let header = SampleHeader { slot, generation, made }.encode();
            Said::Message(Priority::Low, [&header[..], block].concat())
        }
        14 => {
            link.is_loose = true;
            Said::Message(priority(script), script.bytes().to_vec())
        }
        _ => {
            link.is_loose = true;
            match script.below(6) {
                0 => Said::Frame(peer.frame(&Frame::Ping)),
                1 => Said::Frame(peer.frame(&Frame::Close(script.byte()))),
                2 => Said::Frame(peer.frame(&Frame::TURN)),
                3 => Said::Body(script.bytes().to_vec()),
                4 => Said::Frame(peer.raw(script.bytes())),
                _ => Said::Frame(script.bytes().to_vec()),
            }
        }
    }
}
