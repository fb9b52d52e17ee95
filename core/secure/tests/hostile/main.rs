//! What an attacker on the wire can do to a handshake and a channel.
#![allow(clippy::unwrap_used, clippy::indexing_slicing)]

use cara_core::error::CloseReason;
use cara_core::host::secure::Seal;
use cara_secure::channel::{Channel, TAG_BYTES};
use cara_secure::handshake::{HandshakeError, Initiator, MESSAGE_BYTES, answer, prologue};
use cara_secure::keys::PairKey;
use cara_secure::suite::Suite;
use proptest::prelude::*;

const ONE: [u8; 32] = [3; 32];
const OTHER: [u8; 32] = [4; 32];

fn key() -> PairKey {
    PairKey::new([9; 32])
}

fn channels() -> (Channel, Channel) {
    let prologue = prologue(b"a", b"b");
    let (initiator, message) = Initiator::begin(Suite::ChaChaPoly, &key(), &prologue, &ONE).unwrap();
    let (responder, reply) = answer(Suite::ChaChaPoly, &key(), &prologue, &OTHER, &message).unwrap();
    (initiator.finish(&reply).unwrap().channel, responder.channel)
}

fn seal(channel: &mut Channel, text: &[u8]) -> Vec<u8> {
    let mut frame = [text, &[0; TAG_BYTES]].concat();
    channel.seal(&mut frame).unwrap();
    frame
}

#[test]
fn every_flipped_bit_of_a_handshake_fails_it() {
    let prologue = prologue(b"a", b"b");
    let (_, message) = Initiator::begin(Suite::ChaChaPoly, &key(), &prologue, &ONE).unwrap();
    let (_, reply) = answer(Suite::ChaChaPoly, &key(), &prologue, &OTHER, &message).unwrap();
    for bit in 0..MESSAGE_BYTES * 8 {
        let flip = |mut bytes: [u8; MESSAGE_BYTES]| {
            bytes[bit / 8] ^= 1 << (bit % 8);
            bytes
        };
        assert!(
            answer(Suite::ChaChaPoly, &key(), &prologue, &OTHER, &flip(message)).is_err(),
            "bit {bit} of the first message"
        );
        let (initiator, _) = Initiator::begin(Suite::ChaChaPoly, &key(), &prologue, &ONE).unwrap();
        assert_eq!(initiator.finish(&flip(reply)).err(), Some(HandshakeError), "bit {bit} of the second message");
    }
}

#[test]
fn another_key_or_prologue_fails_at_the_first_message() {
    let right = prologue(b"a", b"b");
    let (_, message) = Initiator::begin(Suite::ChaChaPoly, &key(), &right, &ONE).unwrap();
    let other_key = PairKey::new([8; 32]);
    assert!(answer(Suite::ChaChaPoly, &other_key, &right, &OTHER, &message).is_err());
    for wrong in [prologue(b"a", b"c"), prologue(b"ab", b""), prologue(b"b", b"a"), [0; 32]] {
        assert!(answer(Suite::ChaChaPoly, &key(), &wrong, &OTHER, &message).is_err());
    }
    for length in (0..100).filter(|length| *length != MESSAGE_BYTES) {
        assert!(answer(Suite::ChaChaPoly, &key(), &right, &OTHER, &vec![0; length]).is_err());
    }
}

/// Each end gets its own message back: a reflected message is no answer.
#[test]
fn a_reflected_message_is_no_answer() {
    let prologue = prologue(b"a", b"b");
    let (initiator, message) = Initiator::begin(Suite::ChaChaPoly, &key(), &prologue, &ONE).unwrap();
    assert!(initiator.finish(&message).is_err());
}

/// A replayed first message is answered, but its sender can then open and seal nothing.
#[test]
fn a_recorded_handshake_leads_to_no_channel() {
    let prologue = prologue(b"a", b"b");
    let (initiator, message) = Initiator::begin(Suite::ChaChaPoly, &key(), &prologue, &ONE).unwrap();
    let (_, reply) = answer(Suite::ChaChaPoly, &key(), &prologue, &OTHER, &message).unwrap();
    let recorded = seal(&mut initiator.finish(&reply).unwrap().channel, b"go_to");
    let (mut later, _) = answer(Suite::ChaChaPoly, &key(), &prologue, &[5; 32], &message).unwrap();
    assert_eq!(later.channel.open(&mut recorded.clone()), Err(CloseReason::Protocol));
}

/// Points of small order would give the same secret with every key.
#[test]
fn points_of_small_order_are_refused() {
    let prologue = prologue(b"a", b"b");
    let (initiator, _) = Initiator::begin(Suite::ChaChaPoly, &key(), &prologue, &ONE).unwrap();
    let mut reply = [0; MESSAGE_BYTES];
    reply[0] = 1;
    assert!(initiator.finish(&reply).is_err());
}

#[test]
fn a_frame_that_was_changed_moved_or_repeated_ends_the_channel() {
    let (mut one, _) = channels();
    let frames = [seal(&mut one, b"first"), seal(&mut one, b"second")];
    for bit in 0..frames[0].len() * 8 {
        let (_, mut other) = channels();
        let mut changed = frames[0].clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert_eq!(other.open(&mut changed), Err(CloseReason::Protocol), "bit {bit}");
        assert_eq!(other.open(&mut frames[0].clone()), Err(CloseReason::Protocol), "it goes on after a forged frame");
    }
    let (_, mut other) = channels();
    assert!(other.open(&mut frames[1].clone()).is_err(), "a frame was left out");
    let (_, mut other) = channels();
    assert_eq!(other.open(&mut frames[0].clone()).unwrap(), b"first");
    assert!(other.open(&mut frames[0].clone()).is_err(), "a frame came twice");
}

#[test]
fn a_frame_does_not_open_where_it_was_sealed() {
    let (mut one, _) = channels();
    let mut frame = seal(&mut one, b"go_to");
    assert!(one.open(&mut frame).is_err());
}

#[test]
fn short_frames_are_refused() {
    let (mut one, mut other) = channels();
    for length in 0..TAG_BYTES {
        assert!(one.seal(&mut vec![0; length]).is_err());
        assert!(other.open(&mut vec![0; length]).is_err());
    }
}

proptest! {
    #[test]
    fn whatever_is_sealed_opens(texts in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..200), 0..20)) {
        let (mut one, mut other) = channels();
        for text in texts {
            let (mut there, mut back) = (seal(&mut one, &text), seal(&mut other, &text));
            prop_assert_eq!(&*other.open(&mut there).unwrap(), &*text);
            prop_assert_eq!(&*one.open(&mut back).unwrap(), &*text);
        }
    }
}
