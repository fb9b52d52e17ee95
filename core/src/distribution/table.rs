//! Storage of both function lists: entries by index, and one contiguous arena for all signatures.

use core::fmt;

use serde::{Deserialize, Serialize};

use super::attributes::Attributes;
use super::function::Signature;
use super::value::saturate;
use crate::ability::{Begins, STREAMS, State};
use crate::bytes::{copy, move_down};
use crate::error::{Error, Limit};
use crate::storage::Storage;

/// Index of a function in its owner's list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Slot(pub u16);

/// Distinguishes the functions that have been in one slot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Generation(pub u16);

/// A function in a list. `H` is the type of its handler; `()` in a peer's list.
pub struct Function<'a, H: ?Sized = ()> {
    /// Its slot.
    pub slot: Slot,
    /// The generation of its slot.
    pub generation: Generation,
    /// Its name, arguments and results.
    pub signature: Signature<'a>,
    /// Its priority, lease and other attributes.
    pub attributes: &'a Attributes,
    /// Its handler.
    pub handler: &'a H,
}

impl<'a, H: ?Sized> Function<'a, H> {
    /// Its name.
    pub fn name(&self) -> &'a str {
        self.signature.name()
    }
}

impl<H: ?Sized> Clone for Function<'_, H> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<H: ?Sized> Copy for Function<'_, H> {}

impl<H: ?Sized> fmt::Debug for Function<'_, H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}: {}", self.slot.0, self.generation.0, self.signature)
    }
}

/// Memory for one function; ports allocate a slice of empty entries.
pub struct Entry<H = ()> {
    pub(super) generation: Generation,
    /// Stored, but hidden by the access table.
    pub(super) hidden: bool,
    /// This unit's subscription, if it is a stream.
    pub(super) wish: State<Wish, { STREAMS as usize }>,
    pub(super) function: Option<Stored<H>>,
}

/// The interval of a subscription that does not exist.
pub const NO_SUBSCRIPTION: u32 = u32::MAX;

/// A unit's subscription to a stream of its peer: the interval in milliseconds, or [`NO_SUBSCRIPTION`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Wish {
    pub(crate) interval: u32,
    /// As last sent to the peer.
    pub(crate) advertised: u32,
}

impl Begins for Wish {
    const BEGIN: &'static Self = &Self { interval: NO_SUBSCRIPTION, advertised: NO_SUBSCRIPTION };
}

pub(super) struct Stored<H> {
    pub(super) slot: Slot,
    at: u32,
    length: u16,
    attributes: Attributes,
    pub(super) handler: H,
}

impl<H> Entry<H> {
    /// An entry without a function.
    pub const fn empty() -> Self {
        Self { generation: Generation(0), hidden: false, wish: State::NEW, function: None }
    }
}

impl<H> Default for Entry<H> {
    fn default() -> Self {
        Self::empty()
    }
}

/// The length to grow to: half as much again, at least `needed`, and at most `most`; unchanged if it suffices.
fn longer(length: usize, needed: usize, most: usize) -> usize {
    if length >= needed { length } else { length.saturating_add(length / 2).max(needed).min(most) }
}

/// The entries, and one contiguous arena for all signatures.
pub(super) struct Table<S: Storage, H: 'static> {
    pub(super) entries: S::Slice<Entry<H>>,
    pub(super) bytes: S::Slice<u8>,
    used: usize,
    len: usize,
}

impl<S: Storage, H: 'static> Table<S, H> {
    pub(super) fn new(entries: S::Slice<Entry<H>>, bytes: S::Slice<u8>) -> Self {
        Self { entries, bytes, used: 0, len: 0 }
    }

    pub(super) fn free_index(&self) -> Option<usize> {
        self.entries.iter().position(|entry| entry.function.is_none())
    }

    /// Grows, if needed, for one more function with a signature of this length, up to `most` entries and bytes.
    pub(super) fn make_room(&mut self, signature: usize, most: (usize, usize))
    where
        Entry<H>: Default,
    {
        let (entries, bytes) = (self.entries.len(), self.bytes.len());
        let longest = longer(entries, self.len.saturating_add(1), most.0);
        if longest > entries {
            S::lengthen(&mut self.entries, longest, Entry::default);
        }
        let longest = longer(bytes, self.used.saturating_add(signature), most.1);
        if longest > bytes {
            S::lengthen(&mut self.bytes, longest, || 0);
        }
    }

    pub(super) fn free_bytes(&self) -> usize {
        self.bytes.len().saturating_sub(self.used)
    }

    /// Stores a checked signature in a free entry.
    pub(super) fn put(
        &mut self,
        index: usize,
        slot: Slot,
        attributes: Attributes,
        signature: &[u8],
        handler: H,
    ) -> Result<(), Error> {
        let entry = self.entries.get_mut(index).ok_or(Error::Full(Limit::Functions))?;
        let end = self.used.saturating_add(signature.len());
        let place = self.bytes.get_mut(self.used..end).ok_or(Error::Full(Limit::SignatureBytes))?;
        copy(signature, place);
        let length = signature.len() as u16;
        entry.hidden = false;
        entry.wish = State::NEW;
        entry.function = Some(Stored { slot, at: saturate(self.used), length, attributes, handler });
        self.used = end;
        self.len = self.len.saturating_add(1);
        Ok(())
    }

    /// Clears an entry and closes the gap in the arena.
    pub(super) fn take(&mut self, index: usize) -> Option<Stored<H>> {
        let removed = self.entries.get_mut(index)?.function.take()?;
        self.len = self.len.saturating_sub(1);
        self.cut_out(removed.at, usize::from(removed.length));
        Some(removed)
    }

    /// Closes a gap in the arena.
    fn cut_out(&mut self, at: u32, length: usize) {
        if let Some(tail) = self.bytes.get_mut(at as usize..self.used) {
            let end = tail.len();
            move_down(tail, length..end);
        }
        self.used = self.used.saturating_sub(length);
        for stored in self.entries.iter_mut().filter_map(|entry| entry.function.as_mut()) {
            if stored.at > at {
                stored.at = stored.at.saturating_sub(saturate(length));
            }
        }
    }

    /// Removes the help of all functions.
    pub(super) fn forget_help(&mut self) {
        for index in 0..self.entries.len() {
            let bare = self.function(index).map(|function| function.signature.without_help().as_bytes().len());
            let stored = self.entries.get_mut(index).and_then(|entry| entry.function.as_mut());
            let Some((bare, stored)) = bare.zip(stored) else { continue };
            let gap = usize::from(stored.length).saturating_sub(bare);
            stored.length = bare as u16;
            let behind = stored.at.saturating_add(saturate(bare));
            self.cut_out(behind, gap);
        }
    }

    pub(super) fn clear(&mut self) {
        for entry in self.entries.iter_mut() {
            entry.function = None;
        }
        self.len = 0;
        self.used = 0;
    }

    pub(super) fn bump(&mut self, index: usize) {
        if let Some(entry) = self.entries.get_mut(index) {
            entry.generation.0 = entry.generation.0.wrapping_add(1);
        }
    }

    pub(super) fn find(&self, name: &str) -> Option<usize> {
        self.entries.iter().position(|entry| {
            entry.function.as_ref().is_some_and(|stored| {
                let bytes = self.signature(stored);
                bytes.get(1..name.len().saturating_add(1)) == Some(name.as_bytes())
                    && bytes.first().map(|&length| usize::from(length)) == Some(name.len())
            })
        })
    }

    pub(super) fn function(&self, index: usize) -> Option<Function<'_, H>> {
        self.of(self.entries.get(index)?)
    }

    /// The function in an entry.
    pub(super) fn of<'a>(&'a self, entry: &'a Entry<H>) -> Option<Function<'a, H>> {
        let stored = entry.function.as_ref()?;
        Some(Function {
            slot: stored.slot,
            generation: entry.generation,
            signature: Signature::of_checked(self.signature(stored)),
            attributes: &stored.attributes,
            handler: &stored.handler,
        })
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = Function<'_, H>> + Clone {
        (0..self.entries.len()).filter_map(|index| self.function(index))
    }

    fn signature(&self, stored: &Stored<H>) -> &[u8] {
        let start = stored.at as usize;
        self.bytes.get(start..start.saturating_add(usize::from(stored.length))).unwrap_or_default()
    }
}
