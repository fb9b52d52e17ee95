//! Handshakes: a genuine peer, whose bytes are changed on their way, or one with another key, fleet or name.

use cara_core::config::Mode;
use cara_core::distribution::identity::Fleet;
use cara_core::error::CloseReason;
use cara_core::host::frame::Frame;
use cara_core::time::Duration;

use crate::play::Play;
use crate::said::put_item;
use crate::script::Script;
use crate::unit::{FLEET, ROOTS};

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    let how = script.byte();
    let mode = if how & 1 == 0 { Mode::Secured } else { Mode::Plain };
    let mut play = Play::new(&mut script, mode);
    let mut hello = play.hello(if how & 2 == 0 { 0 } else { script.below(6) });
    if how & 4 != 0 {
        match script.below(8) {
            0 => hello.fleet = Fleet(script.byte().into()),
            1 => hello.versions.first = script.byte(),
            2 => hello.wanted = None,
            3 => hello.epoch.0 = script.number(),
            4 => hello.claim = None,
            5 => hello.limits.chunk_size = script.number() as u16,
            6 => hello.limits.message_size = script.number() as u32,
            _ => (hello.stamp, hello.keep_alive) = (script.number(), script.number() as u32),
        }
    }
    let root = ROOTS[usize::from(how & 8 != 0)];
    let fits = hello.fleet == FLEET && (root == ROOTS[0] || mode == Mode::Plain);
    play.open(0, how & 16 != 0, hello, root);
    let mut is_changed = false;
    while !script.is_over() {
        if script.below(4) != 0 {
            let written = std::mem::take(&mut play.unit.mail.streams[0]);
            let Some(peer) = &mut play.peers[0] else { break };
            let genuine = peer.hear(&written);
            let mut bytes = genuine.clone();
            change(&mut script, &mut bytes);
            let is_cut = bytes.len() < genuine.len();
            play.arrive(0, &bytes);
            play.unit.with(0, |link, cx| link.session.writable(cx));
            play.unit.settle();
            // What comes behind the last frame of a handshake does not change it, nor does a stream that ends.
            let is_changed_now =
                if play.has_joined() { !bytes.starts_with(&genuine) } else { !genuine.starts_with(&bytes) };
            is_changed |= is_changed_now;
            if is_cut {
                play.unit.with(0, |link, _| link.session.disconnected(CloseReason::Reset));
            }
        } else {
            match script.below(4) {
                0 => play.unit.pass(Duration::from_millis(u64::from(script.byte()) * 10)),
                1 => {
                    play.unit.with(0, |link, cx| link.session.close(cx, CloseReason::Stopped));
                }
                _ => play.carry(0),
            }
        }
        play.unit.settle();
        let joined = play.has_joined();
        assert!(!joined || fits, "a peer of another fleet, or without the key, has joined");
        if joined {
            assert!(!is_changed || mode == Mode::Plain, "a handshake was changed, and its peer has joined");
            break;
        }
    }
    play.end();
}

fn change(script: &mut Script<'_>, bytes: &mut Vec<u8>) {
    let at = usize::from(script.byte()).min(bytes.len());
    match script.below(9) {
        0 => {
            if let Some(byte) = bytes.get_mut(at) {
                *byte ^= script.byte();
            }
        }
        1 => bytes.truncate(at),
        2 => drop(bytes.splice(at..at, script.bytes().iter().copied())),
        3 => bytes.extend_from_within(..at),
        4 => {
            let mut frame = [0; 300];
            let body = script.bytes();
            let frame_of = match script.below(6) {
                0 => Frame::Hello(body),
                1 => Frame::Proof(body),
                2 => Frame::Confirm(body),
                3 => Frame::Ping,
                4 => Frame::Session(body),
                _ => Frame::Close(at as u8),
            };
            let length = cara_core::host::frame::encode(&frame_of, 0, &mut frame);
            drop(bytes.splice(0..0, frame[..length].iter().copied()));
        }
        5 => {
            // Another item at the end of what may be a hello.
            put_item(u16::from(script.byte()) << 8 | u16::from(script.byte()), script.bytes(), bytes);
            let length = bytes.len().saturating_sub(2) as u16;
            if let Some(head) = bytes.first_chunk_mut() {
                *head = length.to_le_bytes();
            }
        }
        _ => {}
    }
}
