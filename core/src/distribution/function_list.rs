//! The paper's `Function_list`: one's own functions with their handlers, and the functions of a peer.
//!
//! A function is named by slot and generation. Adding a function invalidates no other; removing or replacing one
//! changes the generation of its slot only, so that a request with a stale list is a typed error.

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

/// One's own functions (paper: `my_function_list`).
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
    /// Closed by a stop of all, and by the removal of what was latched: what is added later begins with it.
    stopped: LatchWord,
}

impl<S: Storage, H: 'static> FunctionList<S, H> {
    /// An empty list with room for as many functions as there are entries, and for `bytes` of signatures.
    pub fn new(entries: S::Slice<Entry<H>>, bytes: S::Slice<u8>) -> Self {
        Self { table: Table::new(entries, bytes), stopped: LatchWord::new() }
    }

    /// The unit's own latch.
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

    pub(crate) fn swap(&mut self, signature: Signature<'_>, attributes: Attributes, handler: H) -> Result<Slot, Error> {
        let index = self.table.find(signature.name()).ok_or(Error::UnknownFunction)?;
        let freed = self.table.function(index).map_or(0, |old| old.signature.as_bytes().len());
        if signature.as_bytes().len() > self.table.free_bytes().saturating_add(freed) {
            return Err(Error::Full(Limit::SignatureBytes));
        }
        let old = self.table.take(index).ok_or(Error::UnknownFunction)?;
        self.table.bump(index);
        self.table.put(index, old.slot, attributes, signature.as_bytes(), handler)?;
        Ok(old.slot)
    }

    /// The place of the function of this name.
    pub fn find(&self, name: &str) -> Option<Slot> {
        self.table.find(name).map(|index| Slot(index as u16))
    }

    /// The function in a place.
    pub fn function(&self, slot: Slot) -> Option<Function<'_, H>> {
        self.table.function(usize::from(slot.0))
    }

    /// The function that a request names: [`Error::StaleFunction`] if it was removed or replaced since,
    /// [`Error::UnknownFunction`] if there never was one.
    pub(crate) fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, H>, Error> {
        let entry = self.table.entries.get(usize::from(slot.0)).ok_or(Error::UnknownFunction)?;
        if entry.generation != generation {
            return Err(Error::StaleFunction);
        }
        self.table.of(entry).ok_or(Error::UnknownFunction)
    }

    /// The generation of a place, of an empty one as well.
    pub fn generation(&self, slot: Slot) -> Option<Generation> {
        self.table.entries.get(usize::from(slot.0)).map(|entry| entry.generation)
    }

    /// The functions by slot.
    pub fn iter(&self) -> impl Iterator<Item = Function<'_, H>> + Clone {
        self.table.iter()
    }

    /// How many places there are, empty ones included.
    pub(crate) fn places(&self) -> u16 {
        u16::try_from(self.table.entries.len()).unwrap_or(u16::MAX)
    }

    /// Number of functions.
    pub fn len(&self) -> usize {
        self.iter().count()
    }

    /// Whether there is no function.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The text form of each function on a line.
    pub fn show_functions(&self) -> impl fmt::Display + '_ {
        Lines(self.iter())
    }
}

/// The functions that a peer has published to this unit (paper: `their_function_list`).
pub struct TheirFunctionList<S: Storage> {
    table: Table<S, ()>,
    skipped: u32,
    /// Functions and bytes of signatures that it may grow to.
    most: (usize, usize),
}

impl<S: Storage> TheirFunctionList<S> {
    /// An empty list with room for as many functions as there are entries, and for `bytes` of signatures.
    pub fn new(entries: S::Slice<Entry>, bytes: S::Slice<u8>) -> Self {
        Self { table: Table::new(entries, bytes), skipped: 0, most: (0, 0) }
    }

    /// Lets it grow to so many functions, and so many bytes of signatures, where the storage has an allocator. It keeps help on
    /// functions then, as long as there is room for all functions.
    pub(crate) const fn let_grow(&mut self, functions: usize, bytes: usize) {
        self.most = (functions, bytes);
    }

    /// Applies what the peer published about one of its slots; it replaces the function in the slot and any of the same
    /// name.
    ///
    /// On an error what was in the slot is gone, and the function counts as skipped: [`Error::Full`], or [`Error::Malformed`]
    /// for a signature that this version cannot read.
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
        // A list that does not grow, as on a board, has no use for help. Rather all without it than one function skipped.
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

    /// The peer has published a function that is not kept.
    pub(crate) const fn skip(&mut self) {
        self.skipped = self.skipped.saturating_add(1);
    }

    /// Removes what is in a slot; `false` if nothing was.
    pub fn remove(&mut self, slot: Slot) -> bool {
        self.index_of(slot).and_then(|index| self.table.take(index)).is_some()
    }

    /// Shows the functions whose names are wanted and hides the others, which stay stored: they can be shown again.
    pub(crate) fn show_only(&mut self, mut wanted: impl FnMut(&str) -> bool) {
        for index in 0..self.table.entries.len() {
            let Some(hidden) = self.table.function(index).map(|function| !wanted(function.name())) else { continue };
            if let Some(entry) = self.table.entries.get_mut(index) {
                entry.hidden = hidden;
            }
        }
    }

    /// What this unit wants of a stream.
    pub(crate) fn wish_mut(&mut self, slot: Slot) -> Option<&mut Wish> {
        let index = self.index_of(slot)?;
        self.table.entries.get_mut(index)?.wish.get_mut()
    }

    /// A stream of which the peer has not been told what this unit wants: its place, its generation and the interval.
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

    /// Removes everything and forgets what was skipped.
    pub fn clear(&mut self) {
        self.table.clear();
        self.skipped = 0;
    }

    /// The slices, with nothing in them.
    pub(crate) fn into_slices(mut self) -> (S::Slice<Entry>, S::Slice<u8>) {
        self.table.clear();
        (self.table.entries, self.table.bytes)
    }

    /// The place of the function of this name in the peer's list.
    pub fn find(&self, name: &str) -> Option<Slot> {
        self.named(name).map(|function| function.slot)
    }

    /// The function of this name.
    pub fn named(&self, name: &str) -> Option<Function<'_>> {
        self.table.find(name).and_then(|index| self.shown(index))
    }

    /// The function in a place of the peer's list.
    pub fn function(&self, slot: Slot) -> Option<Function<'_>> {
        self.index_of(slot).and_then(|index| self.shown(index))
    }

    /// The functions in no particular order.
    pub fn iter(&self) -> impl Iterator<Item = Function<'_>> + Clone {
        (0..self.table.entries.len()).filter_map(|index| self.shown(index))
    }

    /// Number of functions that are kept and shown.
    pub fn len(&self) -> usize {
        self.iter().count()
    }

    /// Whether no function is kept.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Functions that the peer published and that were not kept, since the last [`clear`](Self::clear).
    pub const fn skipped(&self) -> u32 {
        self.skipped
    }

    /// The text form of each function on a line.
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

    /// Where a slot of the peer is kept: at its own index wherever possible, so that most lookups take one step.
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
