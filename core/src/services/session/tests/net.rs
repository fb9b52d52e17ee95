//! The network between two ends, as one of them writes to it.

use core::net::SocketAddr;
use std::vec::Vec;

use crate::config::{PLAIN_MAGIC, VERSIONS};
use crate::distribution::datagram::SESSION_HEADER_BYTES;
use crate::error::CloseReason;
use crate::host::mailman::{LinkId, Mailman};

/// The UDP port of both ends.
pub(super) const DATAGRAM_PORT: u16 = 21_970;

/// What happens to datagrams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Datagrams {
    Pass,
    Lost,
    Twice,
}

pub(super) struct Net {
    /// Most bytes in the pipe at a time.
    pub(super) capacity: usize,
    /// The pipe delivers nothing.
    pub(super) frozen: bool,
    pub(super) datagrams: Datagrams,
    /// Length of each write.
    pub(super) writes: Vec<usize>,
    pipe: Vec<u8>,
    queue: Vec<(u64, Vec<u8>)>,
}

impl Default for Net {
    fn default() -> Self {
        let (pipe, queue, writes) = (Vec::new(), Vec::new(), Vec::new());
        Self { capacity: 1 << 20, frozen: false, datagrams: Datagrams::Pass, writes, pipe, queue }
    }
}

impl Net {
    pub(super) fn has_room(&self) -> bool {
        self.pipe.len() < self.capacity
    }

    /// Takes what arrives at the other end: bytes of the stream, and datagrams as (nonce, body).
    pub(super) fn deliver(&mut self) -> (Vec<u8>, Vec<(u64, Vec<u8>)>) {
        let bytes = if self.frozen { Vec::new() } else { core::mem::take(&mut self.pipe) };
        (bytes, core::mem::take(&mut self.queue))
    }
}

impl Mailman<SocketAddr> for Net {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let before = self.pipe.len();
        for slice in slices {
            let count = slice.len().min(self.capacity.saturating_sub(self.pipe.len()));
            self.pipe.extend_from_slice(&slice[..count]);
        }
        let count = self.pipe.len() - before;
        if count > 0 {
            self.writes.push(count);
        }
        Ok(count)
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        assert_eq!(to.port(), DATAGRAM_PORT);
        assert_eq!((&datagram[..4], datagram[4], datagram[5]), (&PLAIN_MAGIC[..], VERSIONS.last, 3));
        let nonce = u64::from_le_bytes(datagram[16..24].try_into().unwrap());
        let copies = match self.datagrams {
            Datagrams::Lost => 0,
            Datagrams::Pass => 1,
            Datagrams::Twice => 2,
        };
        for _ in 0..copies {
            self.queue.push((nonce, datagram[SESSION_HEADER_BYTES..].to_vec()));
        }
        true
    }

    fn broadcast(&mut self, _: &[u8]) -> bool {
        panic!("a session broadcasts nothing")
    }
}
