//! The paper's `Function_list`: one's own functions with their handlers, and the functions of a peer.
//!
//! A function is named by slot and generation. Adding a function invalidates no other; removing or replacing one
//! changes the generation of its slot only, so that a request with old news is a typed error.

use core::fmt;

use serde::{Deserialize, Serialize};

use super::function::{Attributes, Definition, Signature};
use super::value::{copy, saturate};
use crate::error::{Error, Limit};
use crate::storage::Storage;

/// A function's place in its owner's list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Slot(pub u16);

/// Tells apart the functions that have been in one slot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Generation(pub u16);

/// A function in a list. `H` is its handler; `()` in a peer's list.
pub struct Function<'a, H = ()> {
    /// Its place.
    pub slot: Slot,
    /// The generation of its place.
    pub generation: Generation,
    /// Its name, arguments and results.
    pub signature: Signature<'a>,
    /// How it wants to be called.
    pub attributes: Attributes,
    /// What runs it.
    pub handler: &'a H,
}

impl<'a, H> Function<'a, H> {
    /// Its name.
    pub const fn name(&self) -> &'a str {
        self.signature.name()
    }
}

impl<H> Clone for Function<'_, H> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<H> Copy for Function<'_, H> {}

impl<H> fmt::Debug for Function<'_, H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}: {}", self.slot.0, self.generation.0, self.signature)
    }
}

/// Room for one function; ports allocate a slice of empty ones.
pub struct Entry<H = ()> {
    generation: Generation,
    function: Option<Stored<H>>,
}

struct Stored<H> {
    slot: Slot,
    at: u32,
    length: u16,
    attributes: Attributes,
    handler: H,
}

impl<H> Entry<H> {
    /// Room without a function.
    pub const fn empty() -> Self {
        Self { generation: Generation(0), function: None }
    }
}

impl<H> Default for Entry<H> {
    fn default() -> Self {
        Self::empty()
    }
}

/// One's own functions (paper: `my_function_list`).
///
/// Adding a function makes it visible to nobody; publishing does.
///
/// ```
/// use cara_core::distribution::function::{Attributes, Definition};
/// use cara_core::distribution::function_list::{Entry, FunctionList};
/// use cara_core::storage::Lent;
///
/// // A port lends room for 4 functions in 256 bytes of signatures.
/// let entries = Box::leak(Box::new([const { Entry::<fn()>::empty() }; 4]));
/// let bytes = Box::leak(Box::new([0; 256]));
/// let mut list: FunctionList<Lent, fn()> = FunctionList::new(entries, bytes);
///
/// let call_mechanic = Definition::parse("call_mechanic(code: int) -> (minutes: int)").unwrap();
/// list.add_function(&call_mechanic, Attributes::default(), || ())?;
/// assert_eq!(list.show_functions().to_string(), "call_mechanic(code: int) -> (minutes: int)\n");
/// # Ok::<(), cara_core::error::Error>(())
/// ```
#[doc(alias = "Function_list")]
pub struct FunctionList<S: Storage, H: 'static> {
    table: Table<S, H>,
}

impl<S: Storage, H: 'static> FunctionList<S, H> {
    /// An empty list with room for as many functions as there are entries, and for `bytes` of signatures.
    pub fn new(entries: S::Slice<Entry<H>>, bytes: S::Slice<u8>) -> Self {
        Self { table: Table::new(entries, bytes) }
    }

    /// Adds a function; [`Error::NameTaken`] or [`Error::Full`] leave the list unchanged.
    pub fn add_function(&mut self, definition: &Definition, attributes: Attributes, handler: H) -> Result<Slot, Error> {
        if self.find(definition.name()).is_some() {
            return Err(Error::NameTaken);
        }
        let index = self.table.free_index().ok_or(Error::Full(Limit::Functions))?;
        let slot = Slot(u16::try_from(index).map_err(|_| Error::Full(Limit::Functions))?);
        self.table.put(index, slot, attributes, definition.as_bytes(), handler)?;
        Ok(slot)
    }

    /// Removes a function and returns its slot and handler; [`Error::UnknownFunction`].
    pub fn remove(&mut self, name: &str) -> Result<(Slot, H), Error> {
        let index = self.table.find(name).ok_or(Error::UnknownFunction)?;
        let stored = self.table.take(index).ok_or(Error::UnknownFunction)?;
        self.table.bump(index);
        Ok((stored.slot, stored.handler))
    }

    /// Puts another function in the place of the one of its name; [`Error::UnknownFunction`] or [`Error::Full`] leave
    /// the list unchanged.
    pub fn replace(&mut self, definition: &Definition, attributes: Attributes, handler: H) -> Result<Slot, Error> {
        let index = self.table.find(definition.name()).ok_or(Error::UnknownFunction)?;
        let freed = self.table.function(index).map_or(0, |old| old.signature.as_bytes().len());
        if definition.as_bytes().len() > self.table.free_bytes().saturating_add(freed) {
            return Err(Error::Full(Limit::SignatureBytes));
        }
        let old = self.table.take(index).ok_or(Error::UnknownFunction)?;
        self.table.bump(index);
        self.table.put(index, old.slot, attributes, definition.as_bytes(), handler)?;
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

    /// The handler of the function in a place, for one that changes with each call.
    pub fn handler_mut(&mut self, slot: Slot) -> Option<&mut H> {
        let entry = self.table.entries.get_mut(usize::from(slot.0))?;
        entry.function.as_mut().map(|stored| &mut stored.handler)
    }

    /// The function that a request names: [`Error::StaleFunction`] if it was removed or replaced since,
    /// [`Error::UnknownFunction`] if there never was one.
    pub fn lookup(&self, slot: Slot, generation: Generation) -> Result<Function<'_, H>, Error> {
        let entry = self.table.entries.get(usize::from(slot.0)).ok_or(Error::UnknownFunction)?;
        if entry.generation != generation {
            return Err(Error::StaleFunction);
        }
        self.function(slot).ok_or(Error::UnknownFunction)
    }

    /// The generation of a place, of an empty one as well.
    pub fn generation(&self, slot: Slot) -> Option<Generation> {
        self.table.entries.get(usize::from(slot.0)).map(|entry| entry.generation)
    }

    /// The functions by slot.
    pub fn iter(&self) -> impl Iterator<Item = Function<'_, H>> + Clone {
        self.table.iter()
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
    only: Option<&'static [&'static str]>,
    skipped: u32,
}

impl<S: Storage> TheirFunctionList<S> {
    /// An empty list with room for as many functions as there are entries, and for `bytes` of signatures.
    pub fn new(entries: S::Slice<Entry>, bytes: S::Slice<u8>) -> Self {
        Self { table: Table::new(entries, bytes), only: None, skipped: 0 }
    }

    /// Keeps functions of these names only from now on; the others count as skipped.
    pub const fn keep_only(&mut self, names: &'static [&'static str]) {
        self.only = Some(names);
    }

    /// Takes in what the peer told about one of its slots; the news replaces whatever was in the slot or had the name.
    ///
    /// [`Error::Malformed`] leaves the list unchanged. [`Error::Full`] counts as skipped, and what was replaced is gone.
    pub fn insert(
        &mut self,
        slot: Slot,
        generation: Generation,
        attributes: Attributes,
        signature: &[u8],
    ) -> Result<(), Error> {
        let name = Signature::decode(signature)?.name();
        self.remove(slot);
        if let Some(index) = self.table.find(name) {
            self.table.take(index);
        }
        if self.only.is_some_and(|names| !names.contains(&name)) {
            self.skipped = self.skipped.saturating_add(1);
            return Ok(());
        }
        let put = self.put(slot, generation, attributes, signature);
        if put.is_err() {
            self.skipped = self.skipped.saturating_add(1);
        }
        put
    }

    /// Removes what is in a slot; `false` if nothing was.
    pub fn remove(&mut self, slot: Slot) -> bool {
        self.index_of(slot).and_then(|index| self.table.take(index)).is_some()
    }

    /// Removes everything and forgets what was skipped.
    pub fn clear(&mut self) {
        for entry in self.table.entries.iter_mut() {
            entry.function = None;
        }
        self.table.used = 0;
        self.skipped = 0;
    }

    /// The place of the function of this name in the peer's list.
    pub fn find(&self, name: &str) -> Option<Slot> {
        self.table.find(name).and_then(|index| self.table.function(index)).map(|function| function.slot)
    }

    /// The function of this name.
    pub fn named(&self, name: &str) -> Option<Function<'_>> {
        self.table.find(name).and_then(|index| self.table.function(index))
    }

    /// The function in a place of the peer's list.
    pub fn function(&self, slot: Slot) -> Option<Function<'_>> {
        self.index_of(slot).and_then(|index| self.table.function(index))
    }

    /// The functions in no particular order.
    pub fn iter(&self) -> impl Iterator<Item = Function<'_>> + Clone {
        self.table.iter()
    }

    /// Number of functions that are kept.
    pub fn len(&self) -> usize {
        self.iter().count()
    }

    /// Whether no function is kept.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Functions that the peer told of and that were not kept, since the last [`clear`](Self::clear).
    pub const fn skipped(&self) -> u32 {
        self.skipped
    }

    /// The text form of each function on a line.
    pub fn show_functions(&self) -> impl fmt::Display + '_ {
        Lines(self.iter())
    }

    fn put(
        &mut self,
        slot: Slot,
        generation: Generation,
        attributes: Attributes,
        signature: &[u8],
    ) -> Result<(), Error> {
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

/// Entries, and one arena for all their signatures without gaps.
struct Table<S: Storage, H: 'static> {
    entries: S::Slice<Entry<H>>,
    bytes: S::Slice<u8>,
    used: usize,
}

impl<S: Storage, H: 'static> Table<S, H> {
    fn new(entries: S::Slice<Entry<H>>, bytes: S::Slice<u8>) -> Self {
        Self { entries, bytes, used: 0 }
    }

    fn free_index(&self) -> Option<usize> {
        self.entries.iter().position(|entry| entry.function.is_none())
    }

    fn free_bytes(&self) -> usize {
        self.bytes.len().saturating_sub(self.used)
    }

    /// Stores a checked signature in a free entry.
    fn put(
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
        entry.function = Some(Stored { slot, at: saturate(self.used), length, attributes, handler });
        self.used = end;
        Ok(())
    }

    /// Empties an entry and closes the gap in the arena.
    fn take(&mut self, index: usize) -> Option<Stored<H>> {
        let removed = self.entries.get_mut(index)?.function.take()?;
        let length = usize::from(removed.length);
        if let Some(tail) = self.bytes.get_mut(removed.at as usize..self.used)
            && length <= tail.len()
        {
            tail.copy_within(length.., 0);
        }
        self.used = self.used.saturating_sub(length);
        for stored in self.entries.iter_mut().filter_map(|entry| entry.function.as_mut()) {
            if stored.at > removed.at {
                stored.at = stored.at.saturating_sub(u32::from(removed.length));
            }
        }
        Some(removed)
    }

    fn bump(&mut self, index: usize) {
        if let Some(entry) = self.entries.get_mut(index) {
            entry.generation.0 = entry.generation.0.wrapping_add(1);
        }
    }

    fn find(&self, name: &str) -> Option<usize> {
        self.entries.iter().position(|entry| {
            entry.function.as_ref().is_some_and(|stored| {
                let bytes = self.signature(stored);
                bytes.get(1..name.len().saturating_add(1)) == Some(name.as_bytes())
                    && bytes.first().map(|&length| usize::from(length)) == Some(name.len())
            })
        })
    }

    fn function(&self, index: usize) -> Option<Function<'_, H>> {
        let entry = self.entries.get(index)?;
        let stored = entry.function.as_ref()?;
        Some(Function {
            slot: stored.slot,
            generation: entry.generation,
            signature: Signature::of_checked(self.signature(stored)),
            attributes: stored.attributes,
            handler: &stored.handler,
        })
    }

    fn iter(&self) -> impl Iterator<Item = Function<'_, H>> + Clone {
        (0..self.entries.len()).filter_map(|index| self.function(index))
    }

    fn signature(&self, stored: &Stored<H>) -> &[u8] {
        let start = stored.at as usize;
        self.bytes.get(start..start.saturating_add(usize::from(stored.length))).unwrap_or_default()
    }
}

struct Lines<I>(I);

impl<'a, H: 'a, I: Iterator<Item = Function<'a, H>> + Clone> fmt::Display for Lines<I> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.clone().try_for_each(|function| writeln!(f, "{}", function.signature))
    }
}
