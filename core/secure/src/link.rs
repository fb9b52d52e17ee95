//! The cipher of one link, from its first hello to its end: [`Noise`], and [`Cipher`] for units that choose their mode
//! when they start.

use blake2::digest::Mac;
use cara_core::config::Mode;
use cara_core::error::CloseReason;
use cara_core::host::secure::{CONFIRMATION_BYTES, PROOF_BYTES, Plain, Seal, Secure, Unopened};
use zeroize::{Zeroize, ZeroizeOnDrop};

use crate::channel::{Channel, TAG_BYTES};
use crate::datagram::{self, DatagramError, DatagramKey, Opener, Sealer};
use crate::handshake::{self, Agreed, Initiator, Transcript};
use crate::keys::{KEY_BYTES, PairKey, keyed};

/// What a link is proven with: the pair's key, and 32 bytes that were drawn for this link and are used for nothing else.
#[derive(Zeroize, ZeroizeOnDrop)]
pub struct Credentials {
    key: PairKey,
    other: Option<PairKey>,
    fresh: [u8; KEY_BYTES],
}

impl Credentials {
    /// To prove `key`.
    pub const fn new(key: PairKey, fresh: [u8; KEY_BYTES]) -> Self {
        Self { key, other: None, fresh }
    }

    /// Also takes a peer that dials with `other`, the key of the generation before or behind: so keys are changed in a
    /// fleet that runs, first at those that are dialled.
    #[must_use]
    pub fn or(mut self, other: Option<PairKey>) -> Self {
        self.other = other;
        self
    }

    fn secret(&self, purpose: &[u8; 4], binding: &[u8]) -> [u8; KEY_BYTES] {
        let mut mac = keyed(&self.fresh);
        mac.update(purpose);
        mac.update(binding);
        mac.finalize().into_bytes().into()
    }

    /// The handshake's own secret. The keys that come of it do not depend on the prologue by themselves; made like this
    /// they do, so two links have two keys even if both ends draw what they drew before.
    fn ephemeral(&self, prologue: &[u8; 32]) -> [u8; KEY_BYTES] {
        self.secret(b"ephe", prologue)
    }

    /// The key of this end's datagrams, another one than that of the other end whatever is drawn.
    fn datagrams(&self, dialed: bool, binding: &[u8; 32]) -> DatagramKey {
        DatagramKey::new(self.secret(if dialed { b"dgrI" } else { b"dgrR" }, binding))
    }
}

/// The cipher of a secured link.
pub struct Noise(State);

// One of them lives in each link; boxing the larger ones would need an allocator.
#[allow(clippy::large_enum_variant)]
enum State {
    Introducing(Transcript),
    Initiating(Initiator, Credentials),
    Responding([u8; 32], Credentials),
    Sealing(Sealing),
    Ended,
}

/// A link whose ends have agreed on keys.
struct Sealing {
    channel: Channel,
    sealer: Sealer,
    /// Once the peer has told its key.
    opener: Option<Opener>,
}

impl Sealing {
    fn new(agreed: Agreed, dialed: bool, credentials: &Credentials) -> Self {
        let own = credentials.datagrams(dialed, &agreed.binding);
        Self { channel: agreed.channel, sealer: Sealer::new(own, 0), opener: None }
    }
}

impl Noise {
    /// The cipher of a link that begins.
    pub fn new() -> Self {
        Self(State::Introducing(Transcript::new()))
    }

    fn sealing(&mut self) -> Option<&mut Sealing> {
        if let State::Sealing(sealing) = &mut self.0 { Some(sealing) } else { None }
    }
}

impl Default for Noise {
    fn default() -> Self {
        Self::new()
    }
}

impl Seal for Noise {
    fn overhead(&self) -> usize {
        TAG_BYTES
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        self.sealing().ok_or(CloseReason::Protocol)?.channel.seal(frame)
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        match &mut self.0 {
            State::Sealing(sealing) => sealing.channel.open(frame),
            State::Ended => Err(CloseReason::Protocol),
            State::Introducing(_) | State::Initiating(..) | State::Responding(..) => Ok(frame),
        }
    }
}

impl Secure for Noise {
    type Credentials = Credentials;

    fn mode(&self) -> Mode {
        Mode::Secured
    }

    fn is_sealing(&self) -> bool {
        matches!(self.0, State::Sealing(_))
    }

    fn introduce(&mut self, hello: &[u8]) {
        if let State::Introducing(transcript) = &mut self.0 {
            transcript.add(hello);
        }
    }

    fn prove(&mut self, dialed: bool, credentials: Credentials) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        let State::Introducing(transcript) = core::mem::replace(&mut self.0, State::Ended) else {
            return Err(CloseReason::Protocol);
        };
        let prologue = transcript.prologue();
        if !dialed {
            self.0 = State::Responding(prologue, credentials);
            return Ok(None);
        }
        let begun = Initiator::begin(&credentials.key, &prologue, &credentials.ephemeral(&prologue));
        let (initiator, message) = begun.map_err(|_| CloseReason::BadProof)?;
        self.0 = State::Initiating(initiator, credentials);
        Ok(Some(message))
    }

    fn answer(&mut self, message: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        let (sealing, answer) = match core::mem::replace(&mut self.0, State::Ended) {
            State::Initiating(initiator, credentials) => {
                let agreed = initiator.finish(message).map_err(|_| CloseReason::BadProof)?;
                (Sealing::new(agreed, true, &credentials), None)
            }
            State::Responding(prologue, credentials) => {
                let (agreed, answer) = respond(&prologue, &credentials, message)?;
                (Sealing::new(agreed, false, &credentials), Some(answer))
            }
            _ => return Err(CloseReason::Protocol),
        };
        self.0 = State::Sealing(sealing);
        Ok(answer)
    }

    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES] {
        let mut confirmation = [0; CONFIRMATION_BYTES];
        if let State::Sealing(sealing) = &self.0 {
            let told = core::iter::once(&0).chain(sealing.sealer.key().expose());
            confirmation.iter_mut().zip(told).for_each(|(to, from)| *to = *from);
        }
        confirmation
    }

    fn confirmed(&mut self, confirmation: &[u8]) -> Result<(), CloseReason> {
        let (&generation, key) = confirmation.split_first().ok_or(CloseReason::Protocol)?;
        let key = DatagramKey::new(key.try_into().map_err(|_| CloseReason::Protocol)?);
        self.sealing().ok_or(CloseReason::Protocol)?.opener = Some(Opener::new(key, generation));
        Ok(())
    }

    fn datagram_room(&self) -> (usize, usize) {
        (datagram::HEADER_BYTES, TAG_BYTES)
    }

    fn seal_datagram(&mut self, bound: &[u8], datagram: &mut [u8]) -> bool {
        self.sealing().and_then(|sealing| sealing.sealer.seal(bound, datagram)).is_some()
    }

    fn open_datagram<'d>(&mut self, bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], Unopened> {
        let opener = self.sealing().and_then(|sealing| sealing.opener.as_mut()).ok_or(Unopened::Forged)?;
        opener.open(bound, datagram).map_err(|error| match error {
            DatagramError::Repeated => Unopened::Repeated,
            DatagramError::Short | DatagramError::Key | DatagramError::Forged => Unopened::Forged,
        })
    }
}

/// Answers with whichever key the message was made with.
fn respond(
    prologue: &[u8; 32],
    credentials: &Credentials,
    message: &[u8],
) -> Result<(Agreed, [u8; PROOF_BYTES]), CloseReason> {
    let ephemeral = credentials.ephemeral(prologue);
    let keys = core::iter::once(&credentials.key).chain(&credentials.other);
    let mut answers = keys.filter_map(|key| handshake::answer(key, prologue, &ephemeral, message).ok());
    answers.next().ok_or(CloseReason::BadProof)
}

/// The cipher of a link of a unit that chooses its mode when it starts.
#[allow(clippy::large_enum_variant)]
pub enum Cipher {
    /// Everything travels as it is.
    Plain(Plain),
    /// Secured.
    Noise(Noise),
}

impl Cipher {
    /// The cipher of a link that begins.
    pub fn new(mode: Mode) -> Self {
        match mode {
            Mode::Plain => Self::Plain(Plain),
            Mode::Secured => Self::Noise(Noise::new()),
        }
    }
}

macro_rules! either {
    ($cipher:expr, $inner:ident => $act:expr) => {
        match $cipher {
            Cipher::Plain($inner) => $act,
            Cipher::Noise($inner) => $act,
        }
    };
}

impl Seal for Cipher {
    fn overhead(&self) -> usize {
        either!(self, cipher => cipher.overhead())
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        either!(self, cipher => cipher.seal(frame))
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        either!(self, cipher => cipher.open(frame))
    }
}

impl Secure for Cipher {
    type Credentials = Credentials;

    fn mode(&self) -> Mode {
        either!(self, cipher => cipher.mode())
    }

    fn is_sealing(&self) -> bool {
        either!(self, cipher => cipher.is_sealing())
    }

    fn introduce(&mut self, hello: &[u8]) {
        either!(self, cipher => cipher.introduce(hello));
    }

    fn prove(&mut self, dialed: bool, credentials: Credentials) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        match self {
            Self::Plain(plain) => plain.prove(dialed, ()),
            Self::Noise(noise) => noise.prove(dialed, credentials),
        }
    }

    fn answer(&mut self, message: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        either!(self, cipher => cipher.answer(message))
    }

    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES] {
        either!(self, cipher => cipher.confirmation())
    }

    fn confirmed(&mut self, confirmation: &[u8]) -> Result<(), CloseReason> {
        either!(self, cipher => cipher.confirmed(confirmation))
    }

    fn datagram_room(&self) -> (usize, usize) {
        either!(self, cipher => cipher.datagram_room())
    }

    fn seal_datagram(&mut self, bound: &[u8], datagram: &mut [u8]) -> bool {
        either!(self, cipher => cipher.seal_datagram(bound, datagram))
    }

    fn open_datagram<'d>(&mut self, bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], Unopened> {
        either!(self, cipher => cipher.open_datagram(bound, datagram))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each link of a board has one.
    #[test]
    fn a_cipher_takes_no_more_than_640_bytes() {
        assert!(size_of::<Cipher>() <= 640, "{}", size_of::<Cipher>());
    }
}
