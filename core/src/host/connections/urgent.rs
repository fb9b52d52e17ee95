//! The link's own send buffer, for what goes between chunks: frames of the protocol itself, emergencies, and a short
//! message when no other is queued.

use crate::bytes;

/// So many bytes, sealed up to a point and filled up to another.
pub(super) struct Urgent<const BYTES: usize> {
    bytes: [u8; BYTES],
    sealed: usize,
    filled: usize,
}

impl<const BYTES: usize> Urgent<BYTES> {
    pub(super) const fn new() -> Self {
        Self { bytes: [0; BYTES], sealed: 0, filled: 0 }
    }

    pub(super) const fn len(&self) -> usize {
        self.filled
    }

    pub(super) const fn is_empty(&self) -> bool {
        self.filled == 0
    }

    /// `count` more bytes, to be written now; `None` if fewer are free.
    pub(super) fn append(&mut self, count: usize) -> Option<&mut [u8]> {
        let end = self.filled.checked_add(count)?;
        let span = self.bytes.get_mut(self.filled..end)?;
        self.filled = end;
        Some(span)
    }

    /// What can be written: the sealed frames.
    pub(super) fn sealed(&self) -> &[u8] {
        self.bytes.get(..self.sealed).unwrap_or_default()
    }

    pub(super) const fn has_sealed(&self) -> bool {
        self.sealed > 0
    }

    /// The frames that are not sealed.
    pub(super) fn unsealed(&mut self) -> &mut [u8] {
        self.bytes.get_mut(self.sealed..self.filled).unwrap_or_default()
    }

    pub(super) const fn has_unsealed(&self) -> bool {
        self.sealed < self.filled
    }

    /// The first of the frames that are not sealed, of `length` bytes, is sealed now.
    pub(super) fn note_sealed(&mut self, length: usize) {
        self.sealed = self.sealed.saturating_add(length).min(self.filled);
    }

    /// The first `count` bytes are written.
    pub(super) fn drop_front(&mut self, count: usize) {
        if count < self.filled {
            bytes::move_down(&mut self.bytes, count..self.filled);
        }
        self.filled = self.filled.saturating_sub(count);
        self.sealed = self.sealed.saturating_sub(count);
    }

    pub(super) const fn clear(&mut self) {
        (self.sealed, self.filled) = (0, 0);
    }
}
