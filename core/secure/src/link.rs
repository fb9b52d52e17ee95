//! The cipher of one link, from its hellos to its end: [`Noise`], and [`Cipher`] for units that choose their mode at their start.

use blake2::digest::Mac;
use cara_core::config::Mode;
use cara_core::distribution::hello;
use cara_core::error::CloseReason;
use cara_core::host::secure::{CONFIRMATION_BYTES, PROOF_BYTES, Plain, Seal, Secure, Unopened};
use zeroize::{Zeroize, ZeroizeOnDrop};

use crate::channel::{Channel, TAG_BYTES};
use crate::datagram::{self, DatagramError, DatagramKey, Opener, Sealer};
use crate::handshake::{self, Agreed, Initiator, Transcript};
use crate::keys::{KEY_BYTES, PairKey, keyed};
use crate::suite::{AES_GCM, Suite};

/// What a handshake needs: the pair's key, and 32 random bytes that are used for nothing else.
#[derive(Zeroize, ZeroizeOnDrop)]
pub struct Credentials {
    key: PairKey,
    other: Option<PairKey>,
    fresh: Fresh,
}

impl Credentials {
    /// Credentials with this key.
    pub const fn new(key: PairKey, fresh: [u8; KEY_BYTES]) -> Self {
        Self { key, other: None, fresh: Fresh(fresh) }
    }

    /// Also accepts a peer with `other`, the key of the previous or next generation, so that a running fleet can change keys.
    #[must_use]
    pub fn or(mut self, other: Option<PairKey>) -> Self {
        self.other = other;
        self
    }
}

/// The random bytes of one handshake.
#[derive(Clone, Zeroize, ZeroizeOnDrop)]
struct Fresh([u8; KEY_BYTES]);

impl Fresh {
    fn secret(&self, purpose: &[u8; 4], binding: &[u8]) -> [u8; KEY_BYTES] {
        let mut mac = keyed(&self.0);
        mac.update(purpose);
        mac.update(binding);
        mac.finalize().into_bytes().into()
    }

    /// The ephemeral secret of the handshake. Derived from the prologue, too: so two links have different keys even if both ends
    /// draw the same bytes twice.
    fn ephemeral(&self, prologue: &[u8; 32]) -> [u8; KEY_BYTES] {
        self.secret(b"ephe", prologue)
    }

    /// The key of this end's datagrams; differs from the other end's even if both draw the same bytes.
    fn datagrams(&self, suite: Suite, began: bool, binding: &[u8; 32]) -> DatagramKey {
        DatagramKey::new(suite, self.secret(if began { b"dgrI" } else { b"dgrR" }, binding))
    }
}

/// The cipher of a secured link.
pub struct Noise(State);

// Each link has one; boxing the large variants would need an allocator.
#[allow(clippy::large_enum_variant)]
enum State {
    Introducing(Transcript, Suites),
    Proving(Proving),
    Sealing(Sealing),
    Ended,
}

/// The suites of a link before its handshake, a bit each.
struct Suites {
    offered: u16,
    /// Of those, what the hellos so far offer.
    common: u16,
}

impl Suites {
    const fn new(offered: u16) -> Self {
        Self { offered, common: offered }
    }
}

/// A handshake in progress.
#[allow(clippy::large_enum_variant)]
enum Proving {
    Initiating(Initiator, Fresh),
    Responding(Suite, [u8; 32], Credentials),
}

/// A message to send, if there is one.
type Message = Option<[u8; PROOF_BYTES]>;

impl Proving {
    /// Begins; the initiator has a message to send.
    fn begin(
        suite: Suite,
        begins: bool,
        prologue: [u8; 32],
        credentials: Credentials,
    ) -> Result<(Self, Message), CloseReason> {
        if !begins {
            return Ok((Self::Responding(suite, prologue, credentials), None));
        }
        let started = Initiator::begin(suite, &credentials.key, &prologue, &credentials.fresh.ephemeral(&prologue));
        let (initiator, message) = started.map_err(|_| CloseReason::BadProof)?;
        Ok((Self::Initiating(initiator, credentials.fresh.clone()), Some(message)))
    }

    /// Finishes: what both ends have agreed on, the key of this end's datagrams, and the responder's answer.
    fn finish(self, message: &[u8]) -> Result<(Agreed, DatagramKey, Message), CloseReason> {
        match self {
            Self::Initiating(initiator, fresh) => {
                let agreed = initiator.finish(message).map_err(|_| CloseReason::BadProof)?;
                let own = fresh.datagrams(agreed.channel.suite(), true, &agreed.binding);
                Ok((agreed, own, None))
            }
            Self::Responding(suite, prologue, credentials) => {
                let (agreed, answer) = respond(suite, &prologue, &credentials, message)?;
                let own = credentials.fresh.datagrams(suite, false, &agreed.binding);
                Ok((agreed, own, Some(answer)))
            }
        }
    }
}

/// A link whose ends have agreed on keys.
struct Sealing {
    channel: Channel,
    /// The hash of the last handshake, which the next one covers.
    binding: [u8; 32],
    sealer: Sealer,
    /// `None` until the peer has sent its key.
    opener: Option<Opener>,
    renewing: Renewing,
}

/// A handshake that rekeys the link.
#[allow(clippy::large_enum_variant)]
enum Renewing {
    No,
    Proving(Proving),
    Turning(Turning),
}

/// New keys, while the two directions change over to them.
struct Turning {
    /// The new keys, or the old ones of a direction that has changed over.
    channel: Channel,
    /// The new key of this end's datagrams.
    own: DatagramKey,
    sent: bool,
    received: bool,
    /// The peer has sent the new key of its datagrams.
    confirmed: bool,
}

impl Sealing {
    fn new(agreed: Agreed, own: DatagramKey) -> Self {
        Self {
            channel: agreed.channel,
            binding: agreed.binding,
            sealer: Sealer::new(own, 0),
            opener: None,
            renewing: Renewing::No,
        }
    }

    /// Begins a handshake that rekeys the link.
    fn prove(&mut self, begins: bool, credentials: Credentials) -> Result<Message, CloseReason> {
        if !matches!(self.renewing, Renewing::No) {
            return Err(CloseReason::Protocol);
        }
        let suite = self.channel.suite();
        let (proving, message) = Proving::begin(suite, begins, handshake::renewal(&self.binding), credentials)?;
        self.renewing = Renewing::Proving(proving);
        Ok(message)
    }

    fn answer(&mut self, message: &[u8]) -> Result<Message, CloseReason> {
        let Renewing::Proving(proving) = core::mem::replace(&mut self.renewing, Renewing::No) else {
            return Err(CloseReason::Protocol);
        };
        let (Agreed { channel, binding }, own, answer) = proving.finish(message)?;
        self.binding = binding;
        self.renewing = Renewing::Turning(Turning { channel, own, sent: false, received: false, confirmed: false });
        Ok(answer)
    }

    /// The generation and key of this end's datagrams, to be sent to the peer.
    const fn reported(&self) -> (u8, &DatagramKey) {
        match &self.renewing {
            Renewing::Turning(turning) => (self.next_generation(), &turning.own),
            Renewing::No | Renewing::Proving(_) => (self.sealer.generation(), self.sealer.key()),
        }
    }

    const fn next_generation(&self) -> u8 {
        self.sealer.generation().wrapping_add(1)
    }

    fn confirmed(&mut self, generation: u8, key: DatagramKey) -> Result<(), CloseReason> {
        match (&mut self.opener, &mut self.renewing) {
            (opener @ None, Renewing::No) if generation == 0 => *opener = Some(Opener::new(key, generation)),
            (Some(opener), Renewing::Turning(turning))
                if turning.received && !turning.confirmed && generation == opener.generation().wrapping_add(1) =>
            {
                opener.replace(key, generation);
                turning.confirmed = true;
            }
            _ => return Err(CloseReason::Protocol),
        }
        Ok(())
    }

    fn turn(&mut self) -> Result<(), CloseReason> {
        match &mut self.renewing {
            Renewing::Turning(turning) if !turning.sent => {
                self.channel.swap_sending(&mut turning.channel);
                turning.sent = true;
                Ok(())
            }
            _ => Err(CloseReason::Protocol),
        }
    }

    fn turned(&mut self) -> Result<(), CloseReason> {
        match &mut self.renewing {
            Renewing::Turning(turning) if !turning.received => {
                self.channel.swap_receiving(&mut turning.channel);
                turning.received = true;
                Ok(())
            }
            _ => Err(CloseReason::Protocol),
        }
    }

    /// The renewal is complete. The old keys are dropped, except for late datagrams of the peer.
    fn acknowledged(&mut self) -> Result<(), CloseReason> {
        match &self.renewing {
            Renewing::Turning(turning) if turning.sent && turning.confirmed => {
                self.sealer = Sealer::new(turning.own.clone(), self.next_generation());
                self.renewing = Renewing::No;
                Ok(())
            }
            _ => Err(CloseReason::Protocol),
        }
    }

    fn is_worn(&self) -> bool {
        self.channel.is_worn() || self.sealer.is_worn() || self.opener.as_ref().is_some_and(Opener::is_worn)
    }
}

impl Noise {
    /// The cipher of a new link.
    pub fn new() -> Self {
        Self(State::Introducing(Transcript::new(), Suites::new(Mode::Secured.suites())))
    }

    /// The same, which offers AES-256-GCM as well: for hosts with instructions for it. Changes nothing without the feature `ring`.
    #[must_use]
    pub fn offering_aes(mut self) -> Self {
        if let State::Introducing(_, suites) = &mut self.0 {
            *suites = Suites::new(suites.offered | AES_GCM);
        }
        self
    }

    /// The suite of the link, once its ends have proven themselves.
    pub fn suite(&self) -> Option<Suite> {
        self.sealed().map(|sealing| sealing.channel.suite())
    }

    const fn sealing(&mut self) -> Option<&mut Sealing> {
        if let State::Sealing(sealing) = &mut self.0 { Some(sealing) } else { None }
    }

    const fn sealed(&self) -> Option<&Sealing> {
        if let State::Sealing(sealing) = &self.0 { Some(sealing) } else { None }
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

    fn turn(&mut self) -> Result<(), CloseReason> {
        self.sealing().ok_or(CloseReason::Protocol)?.turn()
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        match &mut self.0 {
            State::Sealing(sealing) => sealing.channel.open(frame),
            State::Ended => Err(CloseReason::Protocol),
            State::Introducing(..) | State::Proving(_) => Ok(frame),
        }
    }
}

impl Secure for Noise {
    type Credentials = Credentials;

    fn mode(&self) -> Mode {
        Mode::Secured
    }

    fn is_sealing(&self) -> bool {
        self.sealed().is_some()
    }

    fn offer(&self, hello: &mut [u8]) {
        if let State::Introducing(_, suites) = &self.0 {
            hello::offer(suites.offered, hello);
        }
    }

    fn introduce(&mut self, hello: &[u8]) {
        if let State::Introducing(transcript, suites) = &mut self.0 {
            transcript.add(hello);
            suites.common &= hello::suites(hello);
        }
    }

    fn prove(&mut self, begins: bool, credentials: Credentials) -> Result<Message, CloseReason> {
        if let Some(sealing) = self.sealing() {
            return sealing.prove(begins, credentials);
        }
        let State::Introducing(transcript, suites) = core::mem::replace(&mut self.0, State::Ended) else {
            return Err(CloseReason::Protocol);
        };
        let suite = Suite::of(suites.common);
        let (proving, message) = Proving::begin(suite, begins, transcript.prologue(), credentials)?;
        self.0 = State::Proving(proving);
        Ok(message)
    }

    fn answer(&mut self, message: &[u8]) -> Result<Message, CloseReason> {
        if let Some(sealing) = self.sealing() {
            return sealing.answer(message);
        }
        let State::Proving(proving) = core::mem::replace(&mut self.0, State::Ended) else {
            return Err(CloseReason::Protocol);
        };
        let (agreed, own, answer) = proving.finish(message)?;
        self.0 = State::Sealing(Sealing::new(agreed, own));
        Ok(answer)
    }

    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES] {
        let mut confirmation = [0; CONFIRMATION_BYTES];
        if let Some((generation, key)) = self.sealed().map(Sealing::reported) {
            let reported = core::iter::once(&generation).chain(key.expose());
            confirmation.iter_mut().zip(reported).for_each(|(to, from)| *to = *from);
        }
        confirmation
    }

    fn confirmed(&mut self, confirmation: &[u8]) -> Result<(), CloseReason> {
        let (&generation, key) = confirmation.split_first().ok_or(CloseReason::Protocol)?;
        let key = key.try_into().map_err(|_| CloseReason::Protocol)?;
        let sealing = self.sealing().ok_or(CloseReason::Protocol)?;
        sealing.confirmed(generation, DatagramKey::new(sealing.channel.suite(), key))
    }

    fn turned(&mut self) -> Result<(), CloseReason> {
        self.sealing().ok_or(CloseReason::Protocol)?.turned()
    }

    fn acknowledged(&mut self) -> Result<(), CloseReason> {
        self.sealing().ok_or(CloseReason::Protocol)?.acknowledged()
    }

    fn forget_previous(&mut self) {
        if let Some(opener) = self.sealing().and_then(|sealing| sealing.opener.as_mut()) {
            opener.forget_previous();
        }
    }

    fn hears_newest(&self) -> bool {
        self.sealed().and_then(|sealing| sealing.opener.as_ref()).is_some_and(Opener::hears_newest)
    }

    fn is_worn(&self) -> bool {
        self.sealed().is_some_and(Sealing::is_worn)
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

/// Answers with the key that the message was made with.
fn respond(
    suite: Suite,
    prologue: &[u8; 32],
    credentials: &Credentials,
    message: &[u8],
) -> Result<(Agreed, [u8; PROOF_BYTES]), CloseReason> {
    let ephemeral = credentials.fresh.ephemeral(prologue);
    let keys = core::iter::once(&credentials.key).chain(&credentials.other);
    let mut answers = keys.filter_map(|key| handshake::answer(suite, key, prologue, &ephemeral, message).ok());
    answers.next().ok_or(CloseReason::BadProof)
}

/// The cipher of a link, for units that choose their mode at their start.
#[allow(clippy::large_enum_variant)]
pub enum Cipher {
    /// Nothing is encrypted.
    Plain(Plain),
    /// Secured.
    Noise(Noise),
}

impl Cipher {
    /// The cipher of a new link.
    pub fn new(mode: Mode) -> Self {
        match mode {
            Mode::Plain => Self::Plain(Plain),
            Mode::Secured => Self::Noise(Noise::new()),
        }
    }

    /// The cipher of a new link, which offers AES-256-GCM as well: [`Noise::offering_aes`].
    #[must_use]
    pub fn offering_aes(self) -> Self {
        match self {
            Self::Plain(plain) => Self::Plain(plain),
            Self::Noise(noise) => Self::Noise(noise.offering_aes()),
        }
    }

    /// The suite of a secured link, once its ends have proven themselves.
    pub fn suite(&self) -> Option<Suite> {
        if let Self::Noise(noise) = self { noise.suite() } else { None }
    }

    /// For tests that no key and number seal twice: a hash of the key, and the number, of the next frame and the next datagram.
    #[doc(hidden)]
    pub fn next_seals(&self) -> Option<[([u8; 16], u64); 2]> {
        let Self::Noise(noise) = self else { return None };
        let sealing = noise.sealed()?;
        let (key, number) = sealing.channel.next_seal();
        let datagrams = (*sealing.sealer.key().expose(), sealing.sealer.next_number());
        Some([(key, number), datagrams].map(|(key, number)| (hash(&key), number)))
    }
}

fn hash(key: &[u8; KEY_BYTES]) -> [u8; 16] {
    let hash: [u8; KEY_BYTES] = keyed(key).chain_update(b"seal").finalize().into_bytes().into();
    hash.first_chunk().copied().unwrap_or_default()
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

    fn turn(&mut self) -> Result<(), CloseReason> {
        either!(self, cipher => cipher.turn())
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

    fn offer(&self, hello: &mut [u8]) {
        either!(self, cipher => cipher.offer(hello));
    }

    fn is_sealing(&self) -> bool {
        either!(self, cipher => cipher.is_sealing())
    }

    fn introduce(&mut self, hello: &[u8]) {
        either!(self, cipher => cipher.introduce(hello));
    }

    fn prove(&mut self, begins: bool, credentials: Credentials) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        match self {
            Self::Plain(plain) => plain.prove(begins, ()),
            Self::Noise(noise) => noise.prove(begins, credentials),
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

    fn turned(&mut self) -> Result<(), CloseReason> {
        either!(self, cipher => cipher.turned())
    }

    fn acknowledged(&mut self) -> Result<(), CloseReason> {
        either!(self, cipher => cipher.acknowledged())
    }

    fn forget_previous(&mut self) {
        either!(self, cipher => cipher.forget_previous());
    }

    fn hears_newest(&self) -> bool {
        either!(self, cipher => cipher.hears_newest())
    }

    fn is_worn(&self) -> bool {
        either!(self, cipher => cipher.is_worn())
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
    #![allow(clippy::indexing_slicing, clippy::unwrap_used)]
    use super::*;
    use crate::channel::FRAMES_PER_HANDSHAKE;
    use crate::datagram::{DATAGRAMS_PER_KEY, OVERHEAD};
    use std::vec::Vec;

    fn credentials(fresh: u8) -> Credentials {
        Credentials::new(PairKey::new([5; KEY_BYTES]), [fresh; KEY_BYTES])
    }

    /// The two ends of a proof; whatever they were before.
    fn proven(dialler: &mut Noise, other: &mut Noise, fresh: u8) {
        let first = dialler.prove(true, credentials(fresh)).unwrap().unwrap();
        assert_eq!(other.prove(false, credentials(fresh + 1)), Ok(None));
        let second = other.answer(&first).unwrap().unwrap();
        assert_eq!(dialler.answer(&second), Ok(None));
    }

    /// Two ends of a live link.
    fn live() -> (Noise, Noise) {
        introduced(Noise::new().offering_aes(), Noise::new().offering_aes())
    }

    /// The same, of these two.
    fn introduced(mut dialler: Noise, mut other: Noise) -> (Noise, Noise) {
        let hellos = [hello(&dialler), hello(&other)];
        for end in [&mut dialler, &mut other] {
            hellos.iter().for_each(|hello| end.introduce(hello));
        }
        proven(&mut dialler, &mut other, 1);
        confirm(&mut dialler, &mut other).unwrap();
        confirm(&mut other, &mut dialler).unwrap();
        (dialler, other)
    }

    /// As much of a hello as a cipher reads.
    fn hello(end: &Noise) -> [u8; 8] {
        let mut hello = [0; 8];
        end.offer(&mut hello);
        hello
    }

    #[test]
    fn the_suite_is_one_that_both_offer() {
        for offers in [[false, false], [false, true], [true, false], [true, true]] {
            let [one, other] = offers.map(|aes| if aes { Noise::new().offering_aes() } else { Noise::new() });
            let (one, other) = introduced(one, other);
            let aes = cfg!(feature = "ring") && offers == [true, true];
            assert_eq!(one.suite().map(Suite::bit), Some(1 << u8::from(aes)));
            assert_eq!(one.suite(), other.suite());
        }
    }

    fn confirm(from: &mut Noise, to: &mut Noise) -> Result<(), CloseReason> {
        to.confirmed(&from.confirmation())
    }

    fn turn(from: &mut Noise, to: &mut Noise) {
        from.turn().unwrap();
        to.turned().unwrap();
    }

    fn sealed(from: &mut Noise, text: &[u8]) -> Vec<u8> {
        let mut frame = [text, &[0; TAG_BYTES]].concat();
        from.seal(&mut frame).unwrap();
        frame
    }

    fn datagram(from: &mut Noise, text: &[u8]) -> Vec<u8> {
        let mut datagram = std::vec![0; text.len() + OVERHEAD];
        datagram[datagram::HEADER_BYTES..][..text.len()].copy_from_slice(text);
        assert!(from.seal_datagram(b"plain", &mut datagram));
        datagram
    }

    /// Boards that draw the same at each start: the two directions must not seal with one key and the same numbers.
    #[test]
    fn each_direction_s_datagrams_have_their_own_key_whatever_is_drawn() {
        let (mut dialler, mut other) = live();
        for fresh in [1, 11] {
            let first = dialler.prove(true, credentials(fresh)).unwrap().unwrap();
            other.prove(false, credentials(fresh)).unwrap();
            let second = other.answer(&first).unwrap().unwrap();
            dialler.answer(&second).unwrap();
            assert_ne!(dialler.confirmation()[1..], other.confirmation()[1..]);
            turn(&mut other, &mut dialler);
            confirm(&mut other, &mut dialler).unwrap();
            turn(&mut dialler, &mut other);
            confirm(&mut dialler, &mut other).unwrap();
            dialler.acknowledged().unwrap();
            other.acknowledged().unwrap();
        }
    }

    #[test]
    fn a_renewal_changes_each_direction_at_its_own_frame() {
        let (mut dialler, mut other) = live();
        let before = [dialler.confirmation(), other.confirmation()];
        proven(&mut dialler, &mut other, 11);
        let late = sealed(&mut dialler, b"under the old key");
        turn(&mut other, &mut dialler);
        let answer = sealed(&mut other, b"under the new one");
        assert_eq!(other.open(&mut late.clone()).unwrap(), b"under the old key");
        assert_eq!(dialler.open(&mut answer.clone()).unwrap(), b"under the new one");
        confirm(&mut other, &mut dialler).unwrap();
        turn(&mut dialler, &mut other);
        assert_eq!(other.open(&mut sealed(&mut dialler, b"new too")).unwrap(), b"new too");
        confirm(&mut dialler, &mut other).unwrap();
        for (end, before) in [&dialler, &other].into_iter().zip(before) {
            assert_eq!((end.confirmation()[0], before[0]), (1, 0), "the generation");
            assert_ne!(end.confirmation()[1..], before[1..], "the key of datagrams");
        }
        assert!(other.open(&mut late.clone()).is_err(), "what was recorded ends the link");
    }

    #[test]
    fn datagrams_keep_their_key_until_the_other_end_has_the_new_one() {
        let (mut dialler, mut other) = live();
        proven(&mut dialler, &mut other, 11);
        turn(&mut other, &mut dialler);
        confirm(&mut other, &mut dialler).unwrap();
        turn(&mut dialler, &mut other);
        confirm(&mut dialler, &mut other).unwrap();
        let old = datagram(&mut other, b"old");
        assert_eq!(old[0], 0);
        other.acknowledged().unwrap();
        assert!(!dialler.hears_newest());
        let new = datagram(&mut other, b"new");
        assert_eq!(new[0], 1);
        assert_eq!(dialler.open_datagram(b"plain", &mut new.clone()).unwrap(), b"new");
        assert!(dialler.hears_newest());
        assert_eq!(dialler.open_datagram(b"plain", &mut old.clone()).unwrap(), b"old");
        let later = datagram(&mut dialler, b"late");
        dialler.acknowledged().unwrap();
        other.forget_previous();
        assert_eq!(other.open_datagram(b"plain", &mut later.clone()), Err(Unopened::Forged));
    }

    #[test]
    fn what_comes_out_of_its_turn_is_an_error() {
        let (mut dialler, mut other) = live();
        let wrong = Err(CloseReason::Protocol);
        assert_eq!((dialler.turn(), dialler.turned(), dialler.acknowledged()), (wrong, wrong, wrong));
        assert!(confirm(&mut other, &mut dialler).is_err(), "it is confirmed already");
        assert!(dialler.answer(&[0; PROOF_BYTES]).is_err());
        let (mut dialler, mut other) = live();
        proven(&mut dialler, &mut other, 11);
        assert!(dialler.prove(true, credentials(21)).is_err(), "one at a time");
        assert!(confirm(&mut other, &mut dialler).is_err(), "not before its turn");
        turn(&mut other, &mut dialler);
        assert_eq!((other.turn(), dialler.turned()), (wrong, wrong), "once each");
        let reported = other.confirmation();
        assert!(dialler.confirmed(&[&[2], &reported[1..]].concat()).is_err(), "the next generation only");
        assert_eq!(dialler.confirmed(&reported), Ok(()));
        assert!(dialler.confirmed(&reported).is_err(), "once");
        assert_eq!(dialler.acknowledged(), wrong, "not before it has turned itself");
    }

    #[test]
    fn the_generation_goes_round() {
        let (mut dialler, mut other) = live();
        for round in 1..=300_u32 {
            proven(&mut dialler, &mut other, 11);
            turn(&mut other, &mut dialler);
            confirm(&mut other, &mut dialler).unwrap();
            turn(&mut dialler, &mut other);
            confirm(&mut dialler, &mut other).unwrap();
            other.acknowledged().unwrap();
            dialler.acknowledged().unwrap();
            let mut datagram = datagram(&mut dialler, b"x");
            assert_eq!(u32::from(datagram[0]), round % 256);
            assert!(other.open_datagram(b"plain", &mut datagram).is_ok());
        }
    }

    #[test]
    fn what_has_sealed_too_much_is_worn() {
        let (mut dialler, mut other) = live();
        assert!(!dialler.is_worn());
        dialler.sealing().unwrap().sealer = Sealer::at(DATAGRAMS_PER_KEY);
        assert!(dialler.is_worn());
        assert!(!other.is_worn());
        other.sealing().unwrap().channel.jump(FRAMES_PER_HANDSHAKE);
        assert!(other.is_worn());
    }

    /// Each link of a board has one. A host's numbers its directions.
    #[test]
    fn a_cipher_takes_no_more_than_440_bytes() {
        let most = if cfg!(feature = "ring") { 488 } else { 440 };
        assert!(size_of::<Cipher>() <= most, "{}", size_of::<Cipher>());
    }
}
