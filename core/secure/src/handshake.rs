//! Two messages that prove that both ends have the pair's key, and agree on keys with forward secrecy: a pair key that leaks
//! later does not reveal them.
//!
//! The **prologue** is what both ends must have seen alike: its hash enters every key, so that a bit changed in transit fails the
//! handshake. The initiator is the end that was dialled, since it has both hellos first; a rekey is initiated by the dialling
//! end. An end decides and runs nothing before it has opened a sealed frame of the peer. If the prologue has fresh bytes of the
//! responder, the first message proves its sender, too.

use blake2::{Blake2s256, Digest};
use noise_protocol::patterns::noise_nn_psk0;
use noise_protocol::{Cipher, CipherState, HandshakeState, U8Array};
use noise_rust_crypto::sensitive::Sensitive;

use crate::channel::Channel;
use crate::keys::PairKey;
use crate::suite::{Blake2s, Key, Suite, X25519, with};

/// Length of each of the two messages: a public key and a tag.
pub const MESSAGE_BYTES: usize = 48;

/// The handshake failed: the peer has another key or another prologue, or a message was changed. One error for all cases, so that
/// an attacker who tries keys learns nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the handshake failed: the other end has another key for this pair, or a message was changed")]
pub struct HandshakeError;

/// The initiator, until the responder has answered. It stores what its first message was made of and makes the message again
/// then: the state of a handshake is three times as large.
pub struct Initiator {
    suite: Suite,
    key: PairKey,
    prologue: [u8; 32],
    ephemeral: Sensitive<[u8; 32]>,
}

type State<C> = HandshakeState<X25519, C, Blake2s>;

/// What both ends have agreed on.
pub struct Agreed {
    /// Seals the frames of the link.
    pub channel: Channel,
    /// The handshake hash: unique to this link, since it depends on everything both ends have sent, and on the pair's key.
    pub binding: [u8; 32],
}

/// The prologue of a link: the dialling end's hello, then the dialled end's.
pub fn prologue(dialler: &[u8], dialed: &[u8]) -> [u8; 32] {
    let mut transcript = Transcript::new();
    transcript.add(dialler);
    transcript.add(dialed);
    transcript.prologue()
}

/// The prologue of a rekey: the hash of the previous handshake, and so everything that covered.
pub fn renewal(binding: &[u8; 32]) -> [u8; 32] {
    Blake2s256::new_with_prefix(b"CARA renewal 1").chain_update(binding).finalize().into()
}

/// The prologue while it is being hashed.
pub struct Transcript(Blake2s256);

impl Transcript {
    /// An empty transcript.
    pub fn new() -> Self {
        Self(Blake2s256::new_with_prefix(b"CARA prologue 1"))
    }

    /// Adds a part: first the dialling end's, then the dialled end's.
    pub fn add(&mut self, part: &[u8]) {
        self.0.update((part.len() as u64).to_le_bytes());
        self.0.update(part);
    }

    /// The prologue of the parts added.
    pub fn prologue(self) -> [u8; 32] {
        self.0.finalize().into()
    }
}

impl Default for Transcript {
    fn default() -> Self {
        Self::new()
    }
}

fn state<C: Cipher>(initiates: bool, key: &PairKey, prologue: &[u8; 32], ephemeral: &[u8; 32]) -> State<C> {
    let ephemeral = Sensitive::<[u8; 32]>::from_slice(ephemeral);
    let mut state = HandshakeState::new(noise_nn_psk0(), initiates, prologue, None, Some(ephemeral), None, None);
    state.push_psk(key.expose());
    state
}

fn write<C: Cipher>(state: &mut State<C>) -> Result<[u8; MESSAGE_BYTES], HandshakeError> {
    let mut message = [0; MESSAGE_BYTES];
    state.write_message(&[], &mut message).map_err(|_| HandshakeError)?;
    Ok(message)
}

fn read<C: Cipher>(state: &mut State<C>, message: &[u8]) -> Result<(), HandshakeError> {
    if message.len() != MESSAGE_BYTES {
        return Err(HandshakeError);
    }
    state.read_message(message, &mut []).map_err(|_| HandshakeError)
}

impl Initiator {
    /// Begins. `ephemeral` is 32 random bytes that are used for nothing else.
    pub fn begin(
        suite: Suite,
        key: &PairKey,
        prologue: &[u8; 32],
        ephemeral: &[u8; 32],
    ) -> Result<(Self, [u8; MESSAGE_BYTES]), HandshakeError> {
        let ephemeral = Sensitive::<[u8; 32]>::from_slice(ephemeral);
        let started = Self { suite, key: key.clone(), prologue: *prologue, ephemeral };
        let message = with!(suite, C => started.state::<C>()?.1);
        Ok((started, message))
    }

    /// The state after the first message.
    fn state<C: Cipher>(&self) -> Result<(State<C>, [u8; MESSAGE_BYTES]), HandshakeError> {
        let mut state = state(true, &self.key, &self.prologue, &self.ephemeral);
        let message = write(&mut state)?;
        Ok((state, message))
    }

    /// Processes the responder's answer, which proves its identity.
    pub fn finish(self, message: &[u8]) -> Result<Agreed, HandshakeError> {
        let ([to_responder, to_initiator], binding) = with!(self.suite, C => {
            let (mut state, _) = self.state::<C>()?;
            read(&mut state, message)?;
            agreed(&state)
        });
        Ok(Agreed { channel: Channel::new(self.suite, to_responder, to_initiator), binding })
    }
}

/// The responder answers the initiator's message. It must open a frame of the channel before it believes anything.
pub fn answer(
    suite: Suite,
    key: &PairKey,
    prologue: &[u8; 32],
    ephemeral: &[u8; 32],
    message: &[u8],
) -> Result<(Agreed, [u8; MESSAGE_BYTES]), HandshakeError> {
    let (answer, ([to_responder, to_initiator], binding)) = with!(suite, C => {
        let mut state = state::<C>(false, key, prologue, ephemeral);
        read(&mut state, message)?;
        (write(&mut state)?, agreed(&state))
    });
    Ok((Agreed { channel: Channel::new(suite, to_initiator, to_responder), binding }, answer))
}

/// The keys of the two directions, the initiator's first, and the handshake hash.
fn agreed<C: Cipher>(state: &State<C>) -> ([Key; 2], [u8; 32]) {
    let (to_responder, to_initiator) = state.get_ciphers();
    let key = |cipher: CipherState<C>| Key::from_slice(cipher.extract().0.as_slice());
    let mut binding = [0; 32];
    binding.iter_mut().zip(state.get_hash()).for_each(|(to, from)| *to = *from);
    ([key(to_responder), key(to_initiator)], binding)
}
