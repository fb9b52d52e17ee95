//! Interface of the cipher: traits that prove the peer's identity and seal and open frames in place, and plain mode,
//! which does neither.
//!
//! # How a secured link begins
//! Both hellos travel in clear, the dialler's first; each end gives both to [`Secure::introduce`] in that order. When
//! the peer's has come, the port brings the pair's key, and the cipher proves it with one message in each direction
//! ([`Secure::prove`], [`Secure::answer`]); the end that was dialled begins. From then on all frames are sealed. The first
//! sealed frame of each end confirms that it has the keys, and tells the key of its datagrams ([`Secure::confirmation`]).
//! Nothing that the peer has said counts before that frame has opened. The dialler may say more behind its own.
//!
//! # How a link is rekeyed
//! On a long-lived link the same proof is made again, in sealed frames, and covers what the one before has agreed on.
//! Each end marks the last frame under its old keys ([`Seal::turn`], [`Secure::turned`]) and confirms behind it, under
//! the new ones. Datagrams go on under the old key until the other end has the new one ([`Secure::acknowledged`]).

use crate::config::Mode;
use crate::error::CloseReason;

/// Bytes of a message of the proof.
pub const PROOF_BYTES: usize = 48;
/// Bytes of what each end tells in its first sealed frame.
pub const CONFIRMATION_BYTES: usize = 33;
/// Most bytes that sealing adds to a datagram, in front and behind.
pub const DATAGRAM_OVERHEAD: usize = 25;

/// Seals and opens the frames of one link, in place, without IO.
pub trait Seal {
    /// Bytes that sealing adds behind a frame's body, the same for all of a link's life. With 0, sealing changes nothing,
    /// and frames may be written in another order than they were sealed in.
    fn overhead(&self) -> usize;

    /// Seals `frame`, whose last [`overhead`](Self::overhead) bytes are room for the tag.
    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason>;

    /// Marks the frame that was sealed last as the last one under the current keys.
    fn turn(&mut self) -> Result<(), CloseReason> {
        Err(CloseReason::Protocol)
    }

    /// Opens `frame` and returns its body. Until both ends have proven themselves that is the frame as it is.
    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason>;
}

/// All that one link needs of a cipher.
pub trait Secure: Seal {
    /// What the port supplies once the peer has claimed an identity: the pair's key, and random bytes.
    type Credentials;

    /// The mode of the link.
    fn mode(&self) -> Mode;

    /// Adds to this end's hello the cipher suites that it has beside those of its mode.
    fn offer(&self, _hello: &mut [u8]) {}

    /// Frames are sealed from here on. Always so in plain mode, where there is nothing to prove.
    fn is_sealing(&self) -> bool;

    /// A hello as it travels: first the dialler's, then the other one's. The proof covers both, and so the suites they offer.
    fn introduce(&mut self, hello: &[u8]);

    /// A proof, or, where frames are sealed, a rekey. The end that `begins` gets the message to send.
    fn prove(&mut self, begins: bool, credentials: Self::Credentials)
    -> Result<Option<[u8; PROOF_BYTES]>, CloseReason>;

    /// Takes the other end's message. The end that did not begin gets the answer to send. In the proof with which a link
    /// begins it is not sealed, and everything behind it is.
    fn answer(&mut self, message: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason>;

    /// The payload of this end's first sealed frame, or of its first one under new keys.
    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES];

    /// The payload of the other end's first sealed frame, or of its first one under new keys. Datagrams under the
    /// previous key are accepted until [`forget_previous`](Self::forget_previous).
    fn confirmed(&mut self, confirmation: &[u8]) -> Result<(), CloseReason>;

    /// Marks the frame that was opened last as the other end's last one under its current keys.
    fn turned(&mut self) -> Result<(), CloseReason> {
        Err(CloseReason::Protocol)
    }

    /// The other end has this end's confirmation under the new keys, so this end seals its datagrams with them from
    /// here on.
    fn acknowledged(&mut self) -> Result<(), CloseReason> {
        Err(CloseReason::Protocol)
    }

    /// Datagrams under the key before are taken no longer.
    fn forget_previous(&mut self) {}

    /// A datagram under the newest key that the other end told has been opened.
    fn hears_newest(&self) -> bool {
        true
    }

    /// So much has been sealed with the keys that new ones are due.
    fn is_worn(&self) -> bool {
        false
    }

    /// Room that a datagram needs in front of its body and behind it, at most [`DATAGRAM_OVERHEAD`] in all.
    fn datagram_room(&self) -> (usize, usize);

    /// Seals `datagram`, a body with that room around it. `bound` travels in clear and cannot be changed. `false` when
    /// there can be none.
    fn seal_datagram(&mut self, bound: &[u8], datagram: &mut [u8]) -> bool;

    /// Opens `datagram` in place and returns its body.
    fn open_datagram<'d>(&mut self, bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], Unopened>;
}

/// Why a datagram was not opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unopened {
    /// The same, or one much newer, came before.
    Repeated,
    /// It is not the peer's, or it was changed on its way.
    Forged,
}

/// Plain mode: everything travels as it is. It has its own magic and port and never talks to a secured unit.
#[derive(Clone, Copy, Debug, Default)]
pub struct Plain;

impl Seal for Plain {
    fn overhead(&self) -> usize {
        0
    }

    fn seal(&mut self, _frame: &mut [u8]) -> Result<(), CloseReason> {
        Ok(())
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        Ok(frame)
    }
}

impl Secure for Plain {
    type Credentials = ();

    fn mode(&self) -> Mode {
        Mode::Plain
    }

    fn is_sealing(&self) -> bool {
        true
    }

    fn introduce(&mut self, _hello: &[u8]) {}

    fn prove(&mut self, _begins: bool, (): ()) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        Err(CloseReason::Protocol)
    }

    fn answer(&mut self, _message: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        Err(CloseReason::Protocol)
    }

    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES] {
        [0; CONFIRMATION_BYTES]
    }

    fn confirmed(&mut self, _confirmation: &[u8]) -> Result<(), CloseReason> {
        Err(CloseReason::Protocol)
    }

    fn datagram_room(&self) -> (usize, usize) {
        (0, 0)
    }

    fn seal_datagram(&mut self, _bound: &[u8], _datagram: &mut [u8]) -> bool {
        true
    }

    fn open_datagram<'d>(&mut self, _bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], Unopened> {
        Ok(datagram)
    }
}
