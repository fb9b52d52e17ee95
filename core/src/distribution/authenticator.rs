//! Interface of the codes that authenticate datagrams of discovery: a trait, and plain mode, which has none.

use super::identity::Identity;
use crate::config::Mode;
use crate::host::secure::Plain;

/// Bytes of a code.
pub const CODE_BYTES: usize = 16;

/// Makes and checks the codes of [`WhoHas`](super::datagram::WhoHas) and [`Announce`](super::datagram::Announce); lent
/// to each call of a [`Node`](super::connection_handler::Node) that may need it. A code covers all of the datagram that
/// is before it.
pub trait Authenticator {
    /// The unit's mode. In plain mode datagrams carry no codes, and nothing below is asked.
    fn mode(&self) -> Mode;

    /// The code that shows that `datagram` comes from a unit of this fleet.
    fn sign_for_fleet(&self, datagram: &[u8]) -> [u8; CODE_BYTES];

    /// Whether `code` shows that.
    fn is_of_fleet(&self, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool;

    /// The code that shows to `peer` that `datagram` comes from this unit. `None` without a key for the pair.
    fn sign_for(&self, peer: &Identity, datagram: &[u8]) -> Option<[u8; CODE_BYTES]>;

    /// Whether `code` shows that `datagram` comes from `peer`. `false` without a key for the pair.
    fn is_of(&self, peer: &Identity, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool;
}

impl Authenticator for Plain {
    fn mode(&self) -> Mode {
        Mode::Plain
    }

    fn sign_for_fleet(&self, _datagram: &[u8]) -> [u8; CODE_BYTES] {
        [0; CODE_BYTES]
    }

    fn is_of_fleet(&self, _datagram: &[u8], _code: &[u8; CODE_BYTES]) -> bool {
        false
    }

    fn sign_for(&self, _peer: &Identity, _datagram: &[u8]) -> Option<[u8; CODE_BYTES]> {
        None
    }

    fn is_of(&self, _peer: &Identity, _datagram: &[u8], _code: &[u8; CODE_BYTES]) -> bool {
        false
    }
}
