//! Two messages that prove that both ends have the pair's key, and agree on keys with forward secrecy: a pair key that
//! leaks later does not reveal them.
//!
//! The **prologue** is what both ends must have seen alike: a hash over it goes into every key, so that a bit that was
//! changed on the way fails the handshake. The initiator is the end that was dialled, since it has both hellos first. A
//! rekey is begun by the dialler. An end decides and runs nothing before a sealed frame of the other end has opened. The
//! first message proves its sender as well where the prologue has fresh bytes of the responder.

use blake2::{Blake2s256, Digest};
use noise_protocol::patterns::noise_nn_psk0;
use noise_protocol::{HandshakeState, U8Array};
use noise_rust_crypto::sensitive::Sensitive;

use crate::channel::Channel;
use crate::keys::PairKey;
use crate::suite::{Blake2s, ChaCha20Poly1305, X25519};

/// Bytes of each of the two messages: a public key and a tag.
pub const MESSAGE_BYTES: usize = 48;

/// A handshake that cannot go on: the other end has another key or another prologue, or the message was changed. One
/// error for all, so that an attacker that tries keys learns nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the handshake failed: the other end has another key for this pair, or a message was changed")]
pub struct HandshakeError;

/// The end that begins, until the other one has answered. It keeps what its message was made of, and makes
/// it again when the answer comes: the state of a handshake is three times as large.
pub struct Initiator {
    key: PairKey,
    prologue: [u8; 32],
    ephemeral: Sensitive<[u8; 32]>,
}

type State = HandshakeState<X25519, ChaCha20Poly1305, Blake2s>;

/// What both ends have agreed on.
pub struct Agreed {
    /// The frames of the link.
    pub channel: Channel,
    /// A number that is this link's alone: it depends on all that both ends have sent, and on the pair's key.
    pub binding: [u8; 32],
}

/// What both ends have seen, in the order of its coming: the dialler's, then that of the end that was dialled.
pub fn prologue(dialler: &[u8], dialed: &[u8]) -> [u8; 32] {
    let mut transcript = Transcript::new();
    transcript.add(dialler);
    transcript.add(dialed);
    transcript.prologue()
}

/// The prologue of a handshake that rekeys a link: it covers the one before, and by that all that this one covered.
pub fn renewal(binding: &[u8; 32]) -> [u8; 32] {
    Blake2s256::new_with_prefix(b"CARA renewal 1").chain_update(binding).finalize().into()
}

/// The prologue while it is being seen.
pub struct Transcript(Blake2s256);

impl Transcript {
    /// Nothing seen yet.
    pub fn new() -> Self {
        Self(Blake2s256::new_with_prefix(b"CARA prologue 1"))
    }

    /// The next part: the dialler's, then that of the end that was dialled.
    pub fn add(&mut self, part: &[u8]) {
        self.0.update((part.len() as u64).to_le_bytes());
        self.0.update(part);
    }

    /// The prologue of what was seen.
    pub fn prologue(self) -> [u8; 32] {
        self.0.finalize().into()
    }
}

impl Default for Transcript {
    fn default() -> Self {
        Self::new()
    }
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
        let started =
            Self { key: key.clone(), prologue: *prologue, ephemeral: Sensitive::<[u8; 32]>::from_slice(ephemeral) };
        let (_, message) = started.state()?;
        Ok((started, message))
    }

    /// As it is when the message has been made.
    fn state(&self) -> Result<(State, [u8; MESSAGE_BYTES]), HandshakeError> {
        let mut state = state(true, &self.key, &self.prologue, &self.ephemeral);
        let message = write(&mut state)?;
        Ok((state, message))
    }

    /// Takes the responder's answer, which proves its identity.
    pub fn finish(self, message: &[u8]) -> Result<Agreed, HandshakeError> {
        let (mut state, _) = self.state()?;
        read(&mut state, message)?;
        let (to_responder, to_initiator) = state.get_ciphers();
        Ok(Agreed { channel: Channel::new(to_responder, to_initiator), binding: binding(&state) })
    }
}

/// The other end answers an initiator's message. The channel must open a frame before anything that
/// came is believed.
pub fn answer(
    key: &PairKey,
    prologue: &[u8; 32],
    ephemeral: &[u8; 32],
    message: &[u8],
) -> Result<(Agreed, [u8; MESSAGE_BYTES]), HandshakeError> {
    let mut state = state(false, key, prologue, ephemeral);
    read(&mut state, message)?;
    let answer = write(&mut state)?;
    let (to_responder, to_initiator) = state.get_ciphers();
    Ok((Agreed { channel: Channel::new(to_initiator, to_responder), binding: binding(&state) }, answer))
}

fn binding(state: &State) -> [u8; 32] {
    let mut binding = [0; 32];
    binding.iter_mut().zip(state.get_hash()).for_each(|(to, from)| *to = *from);
    binding
}
