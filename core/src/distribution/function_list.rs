//! The paper's `Function_list`: a unit's own functions with their handlers, and the functions of a peer.
//!
//! A request names a function by slot and generation. Adding a function does not affect others; removing or replacing one changes
//! the generation of its slot only, so a request with an outdated list gets a definite error.

use core::fmt;

use super::function::Signature;
use super::latch::LatchWord;
use super::table::Table;
pub(crate) use super::table::Wish;
pub use super::table::{Entry, Function, Generation, Slot};
use crate::ability::HELP;
use crate::error::{Error, Limit};
use crate::storage::Storage;

use super::attributes::Attributes;

/// A unit's own functions (paper: `my_function_list`).
///
/// Adding a function does not make it visible to peers; publishing does.
///
/// ```
/// use cara_core::distribution::function::{Attributes, Definition};
/// use cara_core::distribution::function_list::{Entry, FunctionList};
/// use cara_core::storage::Lent;
///
/// // A port lends room for 4 functions in 256 bytes of signatures.
/// let entries: &'static mut [_] = Box::leak(Box::new([const { Entry::<()>::empty() }; 4]));
/// let bytes: &'static mut [u8] = Box::leak(Box::new([0; 256]));
/// let mut list: FunctionList<Lent, ()> = FunctionList::new(entries, bytes);
///
/// let call_mechanic = Definition::parse("call_mechanic(code: int) -> (minutes: int)").unwrap();
/// list.add_function(&call_mechanic, Attributes::default(), ())?;
/// assert_eq!(list.show_functions().to_string(), "call_mechanic(code: int) -> (minutes: int)\n");
/// # Ok::<(), cara_core::error::Error>(())
/// ```
#[doc(alias = "Function_list")]
pub struct FunctionList<S: Storage, H: 'static> {
    table: Table<S, H>,
    /// Set by a stop of all, and by removing a latched function: functions that are added later inherit it.
    stopped: LatchWord,
}

impl<S: Storage, H: 'static> FunctionList<S, H> {
    /// An empty list with capacity for one function per entry, and for `bytes` of signatures.
    pub fn new(entries: S::Slice<Entry<H>>, bytes: S::Slice<u8>) -> Self {
        Self { table: Table::new(entries, bytes), stopped: LatchWord::new() }
    }

    /// The unit's own latch: set by a stop of all, and where a latched actuator loses its last function.
    pub const fn stopped(&self) -> &LatchWord {
        &self.stopped
    }

    pub(crate) fn insert(
        &mut self,
        signature: Signature<'_>,
        attributes: Attributes,
        handler: H,
    ) -> Result<Slot, Error> {
        if self.find(signature.name()).is_some() {
            return Err(Error::NameTaken);
        }
        let index = self.table.free_index().ok_or(Error::Full(Limit::Functions))?;
        let slot = Slot(u16::try_from(index).map_err(|_| Error::Full(Limit::Functions))?);
        self.table.put(index, slot, attributes, signature.as_bytes(), handler)?;
        Ok(slot)
    }

    pub(crate) fn take(&mut self, name: &str) -> Result<(Slot, H), Error> {
        let index = self.table.find(name).ok_or(Error::UnknownFunction)?;
        let stored = self.table.take(index).ok_or(Error::UnknownFunction)?;
        self.table.bump(index);
        Ok((stored.slot, stored.handler))
    }

    pub(crate) fn swap(
        &mut self,
        signature: Signature<'_>,
        attributes: Attributes,
        handler: H,
    ) -> Result<(Slot, H), Error> {
        let index = self.table.find(signature.name()).ok_or(Error::UnknownFunction)?;
        let freed = self.table.function(index).map_or(0, |old| old.signature.as_bytes().len());
        if signature.as_bytes().len() > self.table.free_bytes().saturating_add(freed) {
            return Err(Error::Full(Limit::SignatureBytes));
        }
        let old = self.table.take(index).ok_or(Error::UnknownFunction)?;
        self.table.bump(index);
        self.table.put(index, old.slot, attributes, signature.as_bytes(), handler)?;
        Ok((old.slot, old.handler))
    }

    /// The slot of the function with this name.
    pub fn find(&self, name: &str) -> Option<Slot> {
        self.table.find(name).map(|index| Slot(index as u16))
    }

    /// The function in a slot.
    pub fn function(&self, slot: Slot) -> Option<Function<'_, H>> {
        self.table.function(usize::from(slot.0))
    }

    /// The function that a request names; [`Error::StaleFunction`] if it was removed or replaced since,
    /// [`Error::UnknownFunction`] if there never was one.
    pub(crate) fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, H>, Error> {
        let entry = self.table.entries.get(usize::from(slot.0)).ok_or(Error::UnknownFunction)?;
        if entry.generation != generation {
            return Err(Error::StaleFunction);
        }
        self.table.of(entry).ok_or(Error::UnknownFunction)
    }

    /// The generation of a slot, even an empty one.
    pub fn generation(&self, slot: Slot) -> Option<Generation> {
        self.table.entries.get(usize::from(slot.0)).map(|entry| entry.generation)
    }

    /// The functions, ordered by slot.
    pub fn iter(&self) -> impl Iterator<Item = Function<'_, H>> + Clone {
        self.table.iter()
    }

    /// How many slots there are, including empty ones.
    pub(crate) fn places(&self) -> u16 {
        u16::try_from(self.table.entries.len()).unwrap_or(u16::MAX)
    }

    /// Number of functions.
    pub fn len(&self) -> usize {
        self.iter().count()
    }

    /// Whether there are no functions.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The text form of each function, one per line.
    pub fn show_functions(&self) -> impl fmt::Display + '_ {
        Lines(self.iter())
    }
}

/// The functions that a peer has published to this unit (paper: `their_function_list`).
pub struct TheirFunctionList<S: Storage> {
    table: Table<S, ()>,
    skipped: u32,
    /// Limits of its growth: functions, and bytes of signatures.
    most: (usize, usize),
}

impl<S: Storage> TheirFunctionList<S> {
    /// An empty list with capacity for one function per entry, and for `bytes` of signatures.
    pub fn new(entries: S::Slice<Entry>, bytes: S::Slice<u8>) -> Self {
        Self { table: Table::new(entries, bytes), skipped: 0, most: (0, 0) }
    }

    /// Sets how many functions, and bytes of signatures, the list may grow to if the storage has an allocator. It then stores
    /// help, too, as long as there is capacity for all functions.
    pub(crate) const fn let_grow(&mut self, functions: usize, bytes: usize) {
        self.most = (functions, bytes);
    }

    /// Stores a function that the peer has published in a slot. It replaces the function in the slot and any other of its name.
    ///
    /// On an error the slot is empty, and the function counts as skipped: [`Error::Full`], or [`Error::Malformed`] for a
    /// signature that this version cannot decode.
    pub(crate) fn insert(
        &mut self,
        slot: Slot,
        generation: Generation,
        attributes: Attributes,
        signature: &[u8],
    ) -> Result<(), Error> {
        self.remove(slot);
        let signature = match Signature::decode(signature) {
            Ok(signature) => signature,
            Err(error) => {
                self.skip();
                return Err(error);
            }
        };
        let name = signature.name();
        if let Some(index) = self.table.find(name) {
            self.table.take(index);
        }
        // A list of fixed size, as on a board, never stores help. A growing one drops all help rather than skip a function.
        let keeps_help = HELP && self.most.1 > 0;
        let kept = if keeps_help { signature } else { signature.without_help() };
        let mut put = self.put(slot, generation, attributes, kept.as_bytes());
        if keeps_help && put == Err(Error::Full(Limit::SignatureBytes)) {
            self.table.forget_help();
            put = self.put(slot, generation, attributes, signature.without_help().as_bytes());
        }
        if put.is_err() {
            self.skip();
        }
        put
    }

    /// Counts a function that the peer has published and that is not stored.
    pub(crate) const fn skip(&mut self) {
        self.skipped = self.skipped.saturating_add(1);
    }

    /// Removes the function in a slot; `false` if there was none.
    pub fn remove(&mut self, slot: Slot) -> bool {
        self.index_of(slot).and_then(|index| self.table.take(index)).is_some()
    }

    /// Shows the functions that `wanted` accepts and hides the others, which stay stored and can be shown again.
    pub(crate) fn show_only(&mut self, mut wanted: impl FnMut(&str) -> bool) {
        for index in 0..self.table.entries.len() {
            let Some(hidden) = self.table.function(index).map(|function| !wanted(function.name())) else { continue };
            if let Some(entry) = self.table.entries.get_mut(index) {
                entry.hidden = hidden;
            }
        }
    }

    /// This unit's subscription to a stream.
    pub(crate) fn wish_mut(&mut self, slot: Slot) -> Option<&mut Wish> {
        let index = self.index_of(slot)?;
        self.table.entries.get_mut(index)?.wish.get_mut()
    }

    /// A subscription that was not sent to the peer yet: its slot, generation and interval.
    pub(crate) fn untold_wish(&self) -> Option<(Slot, Generation, u32)> {
        let untold = |entry: &&Entry| entry.function.is_some() && entry.wish.interval != entry.wish.advertised;
        let entry = self.table.entries.iter().find(untold)?;
        let function = self.table.of(entry)?;
        Some((function.slot, function.generation, entry.wish.interval))
    }

    /// Hides a function.
    pub(crate) fn hide(&mut self, slot: Slot) {
        if let Some(entry) = self.index_of(slot).and_then(|index| self.table.entries.get_mut(index)) {
            entry.hidden = true;
        }
    }

    /// Removes everything and resets the count of skipped functions.
    pub fn clear(&mut self) {
        self.table.clear();
        self.skipped = 0;
    }

    /// The slices, cleared for the next session.
    pub(crate) fn into_slices(mut self) -> (S::Slice<Entry>, S::Slice<u8>) {
        self.table.clear();
        (self.table.entries, self.table.bytes)
    }

    /// The slot of the function with this name in the peer's list.
    pub fn find(&self, name: &str) -> Option<Slot> {
        self.named(name).map(|function| function.slot)
    }

    /// The function of this name.
    pub fn named(&self, name: &str) -> Option<Function<'_>> {
        self.table.find(name).and_then(|index| self.shown(index))
    }

    /// The function in a slot of the peer's list.
    pub fn function(&self, slot: Slot) -> Option<Function<'_>> {
        self.index_of(slot).and_then(|index| self.shown(index))
    }

    /// The functions, in no particular order.
    pub fn iter(&self) -> impl Iterator<Item = Function<'_>> + Clone {
        (0..self.table.entries.len()).filter_map(|index| self.shown(index))
    }

    /// Number of functions that are stored and shown.
    pub fn len(&self) -> usize {
        self.iter().count()
    }

    /// Whether no function is shown.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// How many published functions were not stored, since the last [`clear`](Self::clear).
    pub const fn skipped(&self) -> u32 {
        self.skipped
    }

    /// The text form of each function, one per line.
    pub fn show_functions(&self) -> impl fmt::Display + '_ {
        Lines(self.iter())
    }

    fn shown(&self, index: usize) -> Option<Function<'_>> {
        let hidden = self.table.entries.get(index)?.hidden;
        if hidden { None } else { self.table.function(index) }
    }

    fn put(
        &mut self,
        slot: Slot,
        generation: Generation,
        attributes: Attributes,
        signature: &[u8],
    ) -> Result<(), Error> {
        self.table.make_room(signature.len(), self.most);
        let preferred = usize::from(slot.0);
        let free = self.table.entries.get(preferred).is_some_and(|entry| entry.function.is_none());
        let index = if free { Some(preferred) } else { self.table.free_index() };
        let index = index.ok_or(Error::Full(Limit::Functions))?;
        self.table.put(index, slot, attributes, signature, ())?;
        if let Some(entry) = self.table.entries.get_mut(index) {
            entry.generation = generation;
        }
        Ok(())
    }

    /// The index of a slot of the peer: the same number wherever possible, so that most look-ups take one step.
    fn index_of(&self, slot: Slot) -> Option<usize> {
        let keeps = |entry: &Entry| entry.function.as_ref().is_some_and(|stored| stored.slot == slot);
        let preferred = usize::from(slot.0);
        if self.table.entries.get(preferred).is_some_and(keeps) {
            return Some(preferred);
        }
        self.table.entries.iter().position(keeps)
    }
}

struct Lines<I>(I);

impl<'a, H: 'a, I: Iterator<Item = Function<'a, H>> + Clone> fmt::Display for Lines<I> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.clone().try_for_each(|function| writeln!(f, "{}", function.signature))
    }
}

#[cfg(test)]
mod tests;
