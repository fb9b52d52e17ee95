//! What the tests of links share: a pool, a network that takes as much as it is allowed to, framed messages.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects, clippy::panic)]

use core::net::SocketAddr;
use std::vec;
use std::vec::Vec;

use super::{Inbound, Link};
use crate::config::{LINK_BUFFER_BYTES, Priority};
use crate::error::CloseReason;
use crate::host::frame::{self, ChunkWriter, Chunking, Frame};
use crate::host::mailman::{LinkId, Mailman};
use crate::host::secure::Seal;
use crate::storage::{Boxed, Pool};

/// A pool of `count` buffers of `size` bytes.
pub(super) fn pool(count: usize, size: usize) -> Pool<Boxed> {
    Pool::new((0..count).map(|_| Some(vec![0; size].into_boxed_slice())).collect())
}

/// A stream that takes `budget` bytes until it is given more.
#[derive(Default)]
pub(super) struct Wire {
    pub(super) budget: usize,
    pub(super) bytes: Vec<u8>,
    /// What the port lets be sealed ahead.
    pub(super) ahead: usize,
    /// The most that was offered at a time.
    pub(super) offered: usize,
}

impl Wire {
    pub(super) fn open() -> Self {
        Self { budget: usize::MAX, ..Self::default() }
    }
}

impl Mailman<SocketAddr> for Wire {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let before = self.bytes.len();
        self.offered = self.offered.max(slices.iter().map(|slice| slice.len()).sum());
        for slice in slices {
            let count = slice.len().min(self.budget);
            self.bytes.extend_from_slice(&slice[..count]);
            self.budget -= count;
        }
        Ok(self.bytes.len() - before)
    }

    fn seals_ahead(&self) -> usize {
        self.ahead
    }

    fn send_to(&mut self, _: SocketAddr, _: &[u8]) -> bool {
        false
    }

    fn broadcast(&mut self, _: &[u8]) -> bool {
        false
    }
}

/// A cipher that numbers its frames, so that a wrong order is seen, and changes every byte.
#[derive(Default)]
pub(super) struct Numbered {
    sealed: u8,
    opened: u8,
}

impl Seal for Numbered {
    fn overhead(&self) -> usize {
        16
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        self.sealed = self.sealed.wrapping_add(1);
        let tag = frame.len() - self.overhead();
        frame[tag..].fill(self.sealed);
        frame.iter_mut().for_each(|byte| *byte ^= 0x5A);
        Ok(())
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        self.opened = self.opened.wrapping_add(1);
        let tag = frame.len().checked_sub(self.overhead()).ok_or(CloseReason::Protocol)?;
        frame.iter_mut().for_each(|byte| *byte ^= 0x5A);
        if frame[tag..].iter().any(|byte| *byte != self.opened) {
            return Err(CloseReason::Protocol);
        }
        Ok(&mut frame[..tag])
    }
}

/// A link that takes chunks of 1 KiB and messages of 8 KiB.
pub(super) fn link<C: Seal>(cipher: C) -> Link<Boxed, C> {
    let mut link = Link::new(LinkId(0), cipher, vec![0; LINK_BUFFER_BYTES].into_boxed_slice(), 1024, 8192);
    link.set_peer_limits(1024);
    link
}

/// What came out of a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Item {
    Message(Priority, Vec<u8>),
    Session(Vec<u8>),
    Hello(Vec<u8>),
    Ping,
    Other,
}

/// Gives `piece` to the link as a port does; `false` when it paused, and then `piece` is what remains.
pub(super) fn offer<C: Seal>(
    link: &mut Link<Boxed, C>,
    pool: &mut Pool<Boxed>,
    piece: &mut Vec<u8>,
    items: &mut Vec<Item>,
) -> Result<bool, CloseReason> {
    loop {
        let received = link.receive(pool, piece)?;
        if let Some(inbound) = received.inbound {
            items.push(item(link, inbound, piece));
        }
        piece.drain(..received.consumed);
        if received.paused {
            return Ok(false);
        }
        if received.consumed == 0 && received.inbound.is_none() {
            return Ok(true);
        }
    }
}

fn item<C: Seal>(link: &Link<Boxed, C>, inbound: Inbound, lent: &[u8]) -> Item {
    match inbound {
        Inbound::Message(priority, span) => Item::Message(priority, link.view(span, lent).to_vec()),
        Inbound::Session(span) => Item::Session(link.view(span, lent).to_vec()),
        Inbound::Hello(span) => Item::Hello(link.view(span, lent).to_vec()),
        Inbound::Ping => Item::Ping,
        _ => Item::Other,
    }
}

/// Everything that `bytes` hold, read by a link of its own.
pub(super) fn read<C: Seal>(cipher: C, bytes: &[u8]) -> Vec<Item> {
    let (mut link, mut pool, mut items) = (link(cipher), pool(1, 9000), Vec::new());
    assert!(offer(&mut link, &mut pool, &mut bytes.to_vec(), &mut items).unwrap());
    items
}

/// A message as plain frames.
pub(super) fn message(priority: Priority, bytes: &[u8], chunk: usize) -> Vec<u8> {
    let chunking = Chunking { chunk, overhead: 0 };
    let mut out = vec![0; chunking.framed_length(bytes.len())];
    ChunkWriter::new(&mut out, chunking, priority, bytes.len()).unwrap().put(bytes);
    out
}

/// A frame that is no chunk.
pub(super) fn plain_frame(frame: &Frame<'_>) -> Vec<u8> {
    let mut out = [0; 600];
    let length = frame::encode(frame, 0, &mut out);
    out[..length].to_vec()
}

/// `length` bytes that differ from their neighbours and from those of other seeds.
pub(super) fn pattern(seed: u8, length: usize) -> Vec<u8> {
    (0..length).map(|at| (at as u8).wrapping_mul(31) ^ (at >> 8) as u8 ^ seed).collect()
}
