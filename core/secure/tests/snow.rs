//! Another implementation of Noise interoperates with this one, in both roles.
#![allow(clippy::unwrap_used, clippy::indexing_slicing)]

use cara_core::host::secure::Seal;
use cara_secure::channel::{Channel, FRAMES_PER_KEY, TAG_BYTES};
use cara_secure::handshake::{Initiator, MESSAGE_BYTES, answer, prologue, renewal};
use cara_secure::keys::PairKey;
use cara_secure::suite::Suite;

const CHACHA: (Suite, &str) = (Suite::ChaChaPoly, "Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s");
#[cfg(not(feature = "ring"))]
const SUITES: [(Suite, &str); 1] = [CHACHA];
#[cfg(feature = "ring")]
const SUITES: [(Suite, &str); 2] = [CHACHA, (Suite::AesGcm, "Noise_NNpsk0_25519_AESGCM_BLAKE2s")];
const KEY: [u8; 32] = [9; 32];

fn snow(name: &str, prologue: &[u8; 32], initiates: bool) -> snow::HandshakeState {
    let builder = snow::Builder::new(name.parse().unwrap()).psk(0, &KEY).unwrap().prologue(prologue).unwrap();
    if initiates { builder.build_initiator().unwrap() } else { builder.build_responder().unwrap() }
}

fn seal(channel: &mut Channel, text: &[u8]) -> Vec<u8> {
    let mut frame = [text, &[0; TAG_BYTES]].concat();
    channel.seal(&mut frame).unwrap();
    frame
}

/// Frames in both directions, past a rekey.
fn talk(mut channel: Channel, theirs: snow::HandshakeState) {
    let mut theirs = theirs.into_transport_mode().unwrap();
    let mut buffer = [0; 128];
    for number in 0..3_u32 {
        let text = number.to_le_bytes();
        let length = theirs.read_message(&seal(&mut channel, &text), &mut buffer).unwrap();
        assert_eq!(buffer[..length], text);
        let length = theirs.write_message(&text, &mut buffer).unwrap();
        assert_eq!(channel.open(&mut buffer[..length]).unwrap(), text);
    }
}

#[test]
fn snow_answers() {
    for (suite, name) in SUITES {
        let prologue = prologue(b"hello of one", b"hello of the other");
        let (initiator, message) = Initiator::begin(suite, &PairKey::new(KEY), &prologue, &[3; 32]).unwrap();
        let mut theirs = snow(name, &prologue, false);
        assert_eq!(theirs.read_message(&message, &mut []).unwrap(), 0);
        let mut reply = [0; MESSAGE_BYTES];
        assert_eq!(theirs.write_message(&[], &mut reply).unwrap(), MESSAGE_BYTES);
        talk(initiator.finish(&reply).unwrap().channel, theirs);
    }
}

#[test]
fn snow_begins() {
    for (suite, name) in SUITES {
        let prologue = prologue(b"hello of one", b"hello of the other");
        let mut theirs = snow(name, &prologue, true);
        let mut message = [0; MESSAGE_BYTES];
        assert_eq!(theirs.write_message(&[], &mut message).unwrap(), MESSAGE_BYTES);
        let (agreed, reply) = answer(suite, &PairKey::new(KEY), &prologue, &[4; 32], &message).unwrap();
        assert_eq!(theirs.read_message(&reply, &mut []).unwrap(), 0);
        talk(agreed.channel, theirs);
    }
}

/// The handshake that rekeys a live link covers the previous handshake hash as Noise defines it.
#[test]
fn snow_takes_part_in_a_renewal_in_both_roles() {
    for (suite, name) in SUITES {
        let first = prologue(b"hello of one", b"hello of the other");
        let mut theirs = snow(name, &first, true);
        let mut message = [0; MESSAGE_BYTES];
        theirs.write_message(&[], &mut message).unwrap();
        let (agreed, reply) = answer(suite, &PairKey::new(KEY), &first, &[4; 32], &message).unwrap();
        theirs.read_message(&reply, &mut []).unwrap();
        assert_eq!(theirs.get_handshake_hash(), agreed.binding);

        let again = renewal(&agreed.binding);
        let (initiator, message) = Initiator::begin(suite, &PairKey::new(KEY), &again, &[5; 32]).unwrap();
        let mut theirs = snow(name, &again, false);
        theirs.read_message(&message, &mut []).unwrap();
        let mut reply = [0; MESSAGE_BYTES];
        theirs.write_message(&[], &mut reply).unwrap();
        let agreed = initiator.finish(&reply).unwrap();
        assert_eq!(theirs.get_handshake_hash(), agreed.binding);
        talk(agreed.channel, theirs);

        let third = renewal(&agreed.binding);
        let mut theirs = snow(name, &third, true);
        let mut message = [0; MESSAGE_BYTES];
        theirs.write_message(&[], &mut message).unwrap();
        assert!(answer(suite, &PairKey::new(KEY), &again, &[6; 32], &message).is_err(), "of another handshake");
        let (agreed, reply) = answer(suite, &PairKey::new(KEY), &third, &[6; 32], &message).unwrap();
        theirs.read_message(&reply, &mut []).unwrap();
        talk(agreed.channel, theirs);
    }
}

/// Both ends rekey after the same frame; snow does so when asked.
#[test]
fn keys_change_after_a_million_frames() {
    let prologue = prologue(b"", b"");
    let mut theirs = snow(CHACHA.1, &prologue, true);
    let mut message = [0; MESSAGE_BYTES];
    theirs.write_message(&[], &mut message).unwrap();
    let (agreed, reply) = answer(CHACHA.0, &PairKey::new(KEY), &prologue, &[4; 32], &message).unwrap();
    let mut channel = agreed.channel;
    theirs.read_message(&reply, &mut []).unwrap();
    let mut theirs = theirs.into_transport_mode().unwrap();
    let mut frame = [0; TAG_BYTES];
    let mut nothing = [0; TAG_BYTES];
    for _ in 0..FRAMES_PER_KEY {
        channel.seal(&mut frame).unwrap();
        theirs.read_message(&frame, &mut nothing).unwrap();
    }
    channel.seal(&mut frame).unwrap();
    assert!(theirs.read_message(&frame, &mut nothing).is_err(), "the key has not changed");
    theirs.rekey_incoming();
    assert_eq!(theirs.read_message(&frame, &mut nothing).unwrap(), 0);
}
