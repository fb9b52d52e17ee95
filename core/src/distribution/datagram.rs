//! Header of session datagrams.
use super::identity::Fleet;
use crate::config::{PLAIN_MAGIC, VERSION};
/// Bytes before the body of a session datagram.
pub const SESSION_HEADER_BYTES: usize = 24;
/// The header of a session datagram to `link` of the receiver, named by the receiver's `nonce`.
pub fn session_header(fleet: Fleet, link: u16, nonce: u64) -> [u8; SESSION_HEADER_BYTES] {
    let [m0, m1, m2, m3] = PLAIN_MAGIC;
    let [f0, f1, f2, f3] = fleet.0.to_le_bytes();
    let [l0, l1] = link.to_le_bytes();
    let [n0, n1, n2, n3, n4, n5, n6, n7] = nonce.to_le_bytes();
    [m0, m1, m2, m3, VERSION, 3, 0, 0, f0, f1, f2, f3, l0, l1, 0, 0, n0, n1, n2, n3, n4, n5, n6, n7]
}
