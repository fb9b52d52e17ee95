//! Two messages that prove that both ends have the pair's key, and agree on keys that nobody can compute later, the key
//! of the pair in hand.
//!
//! The **prologue** is what both ends must have seen alike: a hash over it goes into every key, so that a bit that was
//! changed on the way fails the handshake. The responder knows the initiator only when the first sealed frame opens:
//! the first message alone may be a recorded one, so nothing is decided and nothing runs before that frame.

use blake2::{Blake2s256, Digest};
use noise_protocol::patterns::noise_nn_psk0;
use noise_protocol::{HandshakeState, U8Array};
use noise_rust_crypto::sensitive::Sensitive;

use crate::channel::Channel;
use crate::keys::PairKey;
use crate::suite::{Blake2s, ChaCha20Poly1305, X25519};

/// Bytes of each of the two messages: a public key and a tag.
pub const MESSAGE_BYTES: usize = 48;

/// A handshake that cannot go on: the other end has another key, or has seen another prologue, or the message was
/// changed. There is one error for all: whoever tries keys learns nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the handshake failed: the other end has another key for this pair, or somebody changed what was sent")]
pub struct HandshakeError;

/// The end that opened the connection, until the other one has answered.
pub struct Initiator(State);

type State = HandshakeState<X25519, ChaCha20Poly1305, Blake2s>;

/// What both ends have seen, in the order initiator, responder.
pub fn prologue(initiator: &[u8], responder: &[u8]) -> [u8; 32] {
    let mut hash = Blake2s256::new();
    hash.update(b"CARA prologue 1");
    for part in [initiator, responder] {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.finalize().into()
}

fn state(initiates: bool, key: &PairKey, prologue: &[u8; 32], ephemeral: &[u8; 32]) -> State {
    let ephemeral = Sensitive::<[u8; 32]>::from_slice(ephemeral);
    let mut state = State::new(noise_nn_psk0(), initiates, prologue, None, Some(ephemeral), None, None);
    state.push_psk(key.expose());
    state
}

fn write(state: &mut State) -> Result<[u8; MESSAGE_BYTES], HandshakeError> {
    let mut message = [0; MESSAGE_BYTES];
    state.write_message(&[], &mut message).map_err(|_| HandshakeError)?;
    Ok(message)
}

fn read(state: &mut State, message: &[u8]) -> Result<(), HandshakeError> {
    if message.len() != MESSAGE_BYTES {
        return Err(HandshakeError);
    }
    state.read_message(message, &mut []).map_err(|_| HandshakeError)
}

impl Initiator {
    /// Begins. `ephemeral` is 32 bytes that were drawn for this handshake and are used for nothing else.
    pub fn begin(
        key: &PairKey,
        prologue: &[u8; 32],
        ephemeral: &[u8; 32],
    ) -> Result<(Self, [u8; MESSAGE_BYTES]), HandshakeError> {
        let mut state = state(true, key, prologue, ephemeral);
        let message = write(&mut state)?;
        Ok((Self(state), message))
    }

    /// The responder has answered: it is who it says it is.
    pub fn finish(mut self, message: &[u8]) -> Result<Channel, HandshakeError> {
        read(&mut self.0, message)?;
        let (to_responder, to_initiator) = self.0.get_ciphers();
        Ok(Channel::new(to_responder, to_initiator))
    }
}

/// The end that took the connection answers an initiator's message. The channel must open a frame before anything that
/// came is believed.
pub fn answer(
    key: &PairKey,
    prologue: &[u8; 32],
    ephemeral: &[u8; 32],
    message: &[u8],
) -> Result<(Channel, [u8; MESSAGE_BYTES]), HandshakeError> {
    let mut state = state(false, key, prologue, ephemeral);
    read(&mut state, message)?;
    let answer = write(&mut state)?;
    let (to_responder, to_initiator) = state.get_ciphers();
    Ok((Channel::new(to_initiator, to_responder), answer))
}
