//! Authentication of discovery datagrams: a trait, and plain mode, which has none.

use super::identity::Identity;
use crate::config::Mode;
use crate::host::secure::Plain;

/// Length of a code.
pub const CODE_BYTES: usize = 16;

/// Makes and checks the codes of [`WhoHas`](super::datagram::WhoHas) and [`Announce`](super::datagram::Announce); lent to each
/// call of a [`Node`](super::connection_handler::Node) that may need it. A code covers everything before it in the datagram.
pub trait Authenticator {
    /// The unit's mode. In plain mode datagrams have no codes, and the methods below are not called.
    fn mode(&self) -> Mode;

    /// The code that proves that `datagram` comes from a unit of this fleet.
    fn sign_for_fleet(&self, datagram: &[u8]) -> [u8; CODE_BYTES];

    /// Whether `code` proves that.
    fn is_of_fleet(&self, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool;

    /// The code that proves to `peer` that `datagram` comes from this unit. `None` without a key for the pair.
    fn sign_for(&self, peer: &Identity, datagram: &[u8]) -> Option<[u8; CODE_BYTES]>;

    /// Whether `code` proves that `datagram` comes from `peer`. `false` without a key for the pair.
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
