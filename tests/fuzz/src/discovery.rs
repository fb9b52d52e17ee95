//! Datagrams of discovery: searches and answers of anybody, genuine ones among them.

use cara_core::config::{Mode, PLAIN_MAGIC, SECURED_MAGIC, VERSIONS};
use cara_core::distribution::authenticator::CODE_BYTES;
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::datagram::{Announce, WhoHas};
use cara_core::distribution::hello::ClaimReport;
use cara_core::distribution::identity::{Epoch, Identity, Role};
use cara_core::time::Duration;

use crate::play::Play;
use crate::script::Script;
use crate::unit::{FLEET, Keyed, ROOTS, address, identity, manager};

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    let mode = if script.flag() { Mode::Plain } else { Mode::Secured };
    let mut play = Play::new(&mut script, mode);
    let mut heard = Heard::default();
    while !script.is_over() {
        step(&mut script, &mut play, &mut heard);
    }
    play.end();
}

/// What has come that a unit may act on.
#[derive(Default)]
pub(crate) struct Heard {
    /// A datagram with codes of the fleet's keys.
    is_genuine: bool,
}

/// One datagram, or some time.
pub(crate) fn step(script: &mut Script<'_>, play: &mut Play, heard: &mut Heard) {
    let act = script.below(16);
    match act {
        0..11 => {
            let mut bytes = datagram(script, play, heard, act);
            let host = 10 + script.below(6);
            play.unit.datagram(address(host), &mut bytes);
            play.unit.settle();
        }
        11 => play.unit.pass(Duration::from_millis(u64::from(script.byte()) * 10)),
        12 => play.unit.pass(Duration::from_millis(u64::from(script.byte()) * 100)),
        13 => {
            let now = play.unit.now;
            match script.below(5) {
                0 => play.unit.hub.node.broadcast(now),
                1 => play.unit.hub.node.network_changed(now),
                2 => drop(play.unit.hub.node.take_duplicate()),
                3 if play.is_manager() => play.unit.hub.node.take_over(now),
                _ if play.is_manager() => play.unit.hub.node.stand_by(now),
                _ => {}
            }
        }
        14 => play.unit.stores = script.flag(),
        _ => dial(script, play),
    }
    assert!(
        heard.is_genuine || play.unit.mode() == Mode::Plain || play.unit.dials.is_empty(),
        "it dials whom nobody has vouched for"
    );
    play.unit.settle();
}

/// A dial that it wants is made, or fails.
fn dial(script: &mut Script<'_>, play: &mut Play) {
    let Some((_, wanted)) = play.unit.dials.pop() else { return };
    let free = play.unit.links.iter().position(Option::is_none);
    match free.filter(|_| script.flag()) {
        Some(free) => {
            let hello = play.hello(if script.flag() { 0 } else { script.below(6) });
            play.join(free, true, hello);
        }
        None => {
            let now = play.unit.now;
            play.unit.hub.node.dial_failed(now, wanted.as_ref());
        }
    }
}

fn claim(script: &mut Script<'_>, of: &Identity, keys: &Keyed) -> Option<ClaimReport> {
    let claim = Claim { term: script.number(), claimant: script.number() };
    let tagged = match script.below(4) {
        0 => return None,
        1 => TaggedClaim { claim, tag: [7; CODE_BYTES] },
        _ => claim.tagged(of, &keys.codes).unwrap_or_default(),
    };
    Some(ClaimReport { tagged, since: script.number() as u32 })
}

fn datagram(script: &mut Script<'_>, play: &mut Play, heard: &mut Heard, act: u8) -> Vec<u8> {
    let mode = play.unit.mode();
    let who = identity(script.below(6));
    let own = play.unit.hub.node.identity().clone();
    let root = ROOTS[usize::from(script.byte() > 0xD0)];
    // Another member of the fleet may speak in the name of this one.
    let speaker = if script.byte() > 0xC0 { identity(script.below(6)) } else { who.clone() };
    let is_genuine = root == ROOTS[0] && speaker == who;
    let keys = Keyed::new(mode, root, speaker);
    let mut out = [0; 700];
    let bytes = match act {
        0..4 => {
            let search = WhoHas {
                identity: who,
                epoch: Epoch(script.below(3).into()),
                sequence: script.number() as u32,
                nonce: script.number(),
                wanted: script.flag().then(manager),
                tcp_port: script.number() as u16,
                expected: script.number() as u16,
                known: (0..script.below(3)).map(|_| cara_core::distribution::datagram::short_hash(&own)).collect(),
                standby: script.byte() > 0xC0,
                skipped: 0,
            };
            search.encode(FLEET, &keys.codes, &mut out).map(<[u8]>::to_vec)
        }
        4..9 => {
            let is_m_unit = who.role() == Role::MUnit;
            // The nonce of the unit's own last question, as one on its network hears it.
            let asked = play.unit.mail.asked();
            let nonce = if script.byte() < 0xC0 { asked.unwrap_or(0) } else { script.number() };
            let manager = identity(1);
            let answer = Announce {
                claim: if is_m_unit { claim(script, &who, &keys) } else { None },
                obeyed: if is_m_unit {
                    None
                } else {
                    claim(script, &manager, &Keyed::new(mode, root, manager.clone()))
                },
                identity: who,
                epoch: Epoch(script.below(3).into()),
                sequence: script.number() as u32,
                nonce,
                tcp_port: 7_000,
                room: script.number() as u16,
                expected: script.number() as u16,
                skipped: 0,
            };
            heard.is_genuine |= is_genuine;
            answer.encode(FLEET, &keys.codes, Some(&own), &mut out).map(<[u8]>::to_vec)
        }
        9 => {
            let magic = if mode == Mode::Plain { PLAIN_MAGIC } else { SECURED_MAGIC };
            let kind = script.below(5);
            let head = [VERSIONS.last, kind, VERSIONS.last, script.below(3)];
            Some([&magic[..], &head, &FLEET.0.to_le_bytes(), script.bytes()].concat())
        }
        _ => Some(script.bytes().to_vec()),
    };
    let mut bytes = bytes.unwrap_or_default();
    if script.byte() > 0xE0 {
        let at = usize::from(script.byte());
        if let Some(byte) = bytes.get_mut(at) {
            *byte ^= script.byte();
        }
    }
    bytes
}
