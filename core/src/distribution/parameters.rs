//! The paper's `Parameters`: named variables with a type and a size, passed to a service and updated by its results.
//!
//! [`Parameters`] contains its bytes, without a heap; functions take a [`ParametersView`], to which `Parameters` of any size
//! coerce. Names and values lie in one arena. A value reserves its declared size, so setting it never moves another; a list or
//! record takes the size of its present value, and moves what follows.

use core::fmt;
use core::ops::{Deref, DerefMut};

use crate::config::{PARAMETERS_BYTES, VARIABLES};
use crate::error::{Error, Limit};

use super::name::check_name;
pub use super::nested::{Elements, Fields};
use super::spec::{self, RawSpec, VariableSpec};
pub use super::value::{Element, FromValue, IntoValue, Target, Type, Value, Variable};
use super::value::{read_elements, saturate};
pub use super::writer::{ListWriter, RecordWriter, Slot};
use crate::bytes::{are_same, copy, move_down, rotate_up};

/// Variables in `BYTES` bytes of names and values (paper, listing line 11).
///
/// ```
/// use cara_core::distribution::parameters::Parameters;
///
/// let mut pos = Parameters::new();
/// pos.add_int("position", 2)?;
/// pos.set_value("position", [1, 2])?;
/// let coordinates: [i64; 2] = pos.variable("position")?;
/// assert_eq!(coordinates, [1, 2]);
/// # Ok::<(), cara_core::error::Error>(())
/// ```
pub type Parameters<const BYTES: usize = PARAMETERS_BYTES> = ParametersInner<[u8; BYTES]>;

/// [`Parameters`] of any size, behind a reference or a box.
///
/// ```
/// use cara_core::distribution::parameters::{Parameters, ParametersView};
///
/// fn stop(parameters: &mut ParametersView) -> Result<(), cara_core::error::Error> {
///     parameters.add_bool("stopped", 1)?;
///     parameters.set_value("stopped", true)
/// }
/// stop(&mut Parameters::<64>::sized())?;
/// # Ok::<(), cara_core::error::Error>(())
/// ```
pub type ParametersView = ParametersInner<[u8]>;

/// The type behind [`Parameters`] and [`ParametersView`]; not named directly.
#[derive(Clone)]
pub struct ParametersInner<B: ?Sized> {
    table: [Entry; VARIABLES],
    /// 32 bits like `used`, so that `bytes` is aligned and copied word by word.
    count: u32,
    used: u32,
    bytes: B,
}

/// One variable. The arena has its inner types if it is a list or record, then its name and its value.
#[derive(Clone, Copy)]
struct Entry {
    value_at: u32,
    size: u32,
    /// The present length of the value in bytes.
    length: u32,
    name_length: u8,
    kind: Type,
    inner_length: u16,
}

impl Entry {
    const EMPTY: Self = Self { value_at: 0, size: 0, length: 0, name_length: 0, kind: Type::Int, inner_length: 0 };
}

impl Parameters {
    /// Empty parameters with the default capacity.
    pub const fn new() -> Self {
        Self::sized()
    }
}

impl<const BYTES: usize> ParametersInner<[u8; BYTES]> {
    /// Empty parameters with this capacity in bytes: `Parameters::<2048>::sized()`.
    pub const fn sized() -> Self {
        Self { table: [Entry::EMPTY; VARIABLES], count: 0, used: 0, bytes: [0; BYTES] }
    }
}

impl<B: Arena + ?Sized> ParametersInner<B> {
    /// Adds `size` integers, all 0.
    ///
    /// [`Error::NameTaken`], [`Error::BadName`] or [`Error::Full`] leave the parameters unchanged, as in all methods that add.
    pub fn add_int(&mut self, name: &str, size: u32) -> Result<(), Error> {
        self.add(name, Type::Int, size)
    }

    /// Adds `size` floating-point numbers, all 0.
    pub fn add_float(&mut self, name: &str, size: u32) -> Result<(), Error> {
        self.add(name, Type::Float, size)
    }

    /// Adds `size` truth values, all `false`.
    pub fn add_bool(&mut self, name: &str, size: u32) -> Result<(), Error> {
        self.add(name, Type::Bool, size)
    }

    /// Adds an empty text of at most `maximum` bytes.
    ///
    /// ```
    /// use cara_core::distribution::parameters::Parameters;
    ///
    /// let mut message = Parameters::new();
    /// message.add_string("text", 200)?;
    /// message.set_value("text", "battery low")?;
    /// assert_eq!(message.variable::<&str>("text")?, "battery low");
    /// # Ok::<(), cara_core::error::Error>(())
    /// ```
    pub fn add_string(&mut self, name: &str, maximum: u32) -> Result<(), Error> {
        self.add(name, Type::String, maximum)
    }

    /// Adds an empty array of at most `maximum` bytes.
    pub fn add_bytes(&mut self, name: &str, maximum: u32) -> Result<(), Error> {
        self.add(name, Type::Bytes, maximum)
    }

    /// Adds a variable of any type except list and record, with the value 0, `false` or empty.
    pub fn add(&mut self, name: &str, kind: Type, size: u32) -> Result<(), Error> {
        self.as_mut_view().add_variable(VariableSpec::flat(name, kind, size))
    }

    /// Adds a variable as a signature declares it, with the value 0, `false` or empty; the fields of a record likewise.
    #[cfg_attr(feature = "nested", doc = "```")]
    #[cfg_attr(not(feature = "nested"), doc = "```ignore")]
    /// use cara_core::distribution::{function::Definition, parameters::Parameters};
    ///
    /// let order = Definition::parse("order(nodes: {id: string[32], x: float}[..50])").unwrap();
    /// let mut parameters = Parameters::new();
    /// for argument in order.signature().arguments() {
    ///     parameters.add_spec(argument)?;
    /// }
    /// parameters.set_list("nodes", |nodes| {
    ///     nodes.push_record(|node| {
    ///         node.set("id", "a")?;
    ///         node.set("x", 1.5)
    ///     })
    /// })?;
    /// for node in parameters.list("nodes")? {
    ///     assert_eq!((node.field("id")?.read::<&str>()?, node.field("x")?.read::<f64>()?), ("a", 1.5));
    /// }
    /// # Ok::<(), cara_core::error::Error>(())
    /// ```
    pub fn add_spec(&mut self, spec: VariableSpec<'_>) -> Result<(), Error> {
        self.as_mut_view().add_variable(spec)
    }

    /// The elements of a list. Errors: [`Error::UnknownVariable`], [`Error::WrongType`].
    pub fn list(&self, name: &str) -> Result<Elements<'_>, Error> {
        let value = self.value(name)?;
        if value.kind() == Type::List { Ok(value.elements()) } else { Err(Error::WrongType { index: value.index }) }
    }

    /// The fields of a record. Errors: [`Error::UnknownVariable`], [`Error::WrongType`].
    pub fn record(&self, name: &str) -> Result<Fields<'_>, Error> {
        let value = self.value(name)?;
        if value.kind() == Type::Record { Ok(value.fields()) } else { Err(Error::WrongType { index: value.index }) }
    }

    /// Sets a list to the elements that `write` adds. On an error, including one of `write`, the old value stays.
    pub fn set_list(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut ListWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let view = self.as_mut_view();
        let index = view.find(name.as_bytes()).ok_or(Error::UnknownVariable)?;
        view.write_list(index, write)
    }

    /// Sets a record; `write` must set all fields in order. On an error the old value stays.
    pub fn set_record(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut RecordWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let view = self.as_mut_view();
        let index = view.find(name.as_bytes()).ok_or(Error::UnknownVariable)?;
        view.write_record(index, write)
    }

    /// Sets a variable from a number, a truth value, an array or slice of them, a `&str` or a `&[u8]`.
    ///
    /// Numbers and truth values must be as many as declared; text and bytes may be shorter. On an error the old value stays.
    ///
    /// ```
    /// use cara_core::distribution::parameters::Parameters;
    /// use cara_core::error::Error;
    ///
    /// let mut pos = Parameters::new();
    /// pos.add_int("position", 2)?;
    /// pos.set_value("position", [1, 2])?;
    /// let wrong = pos.set_value("position", [1, 2, 3]);
    /// assert_eq!(wrong, Err(Error::WrongSize { index: 0, expected: 2, found: 3 }));
    /// # Ok::<(), Error>(())
    /// ```
    pub fn set_value(&mut self, name: &str, value: impl IntoValue) -> Result<(), Error> {
        let view = self.as_mut_view();
        let index = view.find(name.as_bytes()).ok_or(Error::UnknownVariable)?;
        value.into_value(view.target(index).ok_or(Error::UnknownVariable)?)
    }

    /// Reads a variable as `T`: a number, a truth value, an array of them, a `&str` or a `&[u8]`.
    ///
    /// The type must match and the size must be exact; a number that a narrower `T` can't hold is
    /// [`Error::OutOfRange`].
    ///
    /// ```
    /// use cara_core::distribution::parameters::Parameters;
    /// use cara_core::error::Error;
    ///
    /// let mut speed = Parameters::new();
    /// speed.add_int("limit", 1)?;
    /// speed.set_value("limit", 300)?;
    /// assert_eq!(speed.variable::<u16>("limit"), Ok(300));
    /// assert_eq!(speed.variable::<u8>("limit"), Err(Error::OutOfRange));
    /// # Ok::<(), Error>(())
    /// ```
    #[doc(alias = "get_variable")]
    pub fn variable<'a, T: FromValue<'a>>(&'a self, name: &str) -> Result<T, Error> {
        T::from_value(self.value(name)?)
    }

    /// Reads all elements of a variable into a slice of exactly that length. On an error the slice is unchanged.
    ///
    /// ```
    /// use cara_core::distribution::parameters::Parameters;
    ///
    /// let mut pos = Parameters::new();
    /// pos.add_int("position", 2)?;
    /// let mut coordinates = [9; 2];
    /// pos.variable_into("position", &mut coordinates)?;
    /// assert_eq!(coordinates, [0, 0]);
    /// # Ok::<(), cara_core::error::Error>(())
    /// ```
    #[doc(alias = "get_variable")]
    pub fn variable_into<T: Element>(&self, name: &str, elements: &mut [T]) -> Result<(), Error> {
        read_elements(self.value(name)?, elements)
    }

    /// Removes all variables.
    pub fn clear(&mut self) {
        self.count = 0;
        self.used = 0;
    }

    /// Replaces all variables by those of `other`. [`Error::Full`] leaves the parameters unchanged.
    pub fn copy_from(&mut self, other: &ParametersView) -> Result<(), Error> {
        self.as_mut_view().replace_by(other)
    }

    /// Bytes that are free for more names and values.
    pub fn remaining(&self) -> usize {
        self.as_view().bytes.len().saturating_sub(self.used as usize)
    }

    /// Number of variables.
    pub const fn len(&self) -> usize {
        self.count as usize
    }

    /// Whether there are no variables.
    pub const fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The variables in the order in which they were added.
    pub fn iter(&self) -> impl Iterator<Item = Variable<'_>> + Clone {
        let view = self.as_view();
        (0..self.len()).filter_map(move |index| {
            let entry = view.table.get(index)?;
            let name = core::str::from_utf8(view.name_of(entry)).ok()?;
            Some(Variable { name, kind: entry.kind, size: entry.size, value: view.value_at(index)? })
        })
    }

    /// The value of a variable of any type.
    pub fn value(&self, name: &str) -> Result<Value<'_>, Error> {
        let view = self.as_view();
        view.named(name.as_bytes()).ok_or(Error::UnknownVariable)
    }

    /// The parameters as a type without their capacity.
    pub fn as_view(&self) -> &ParametersView {
        B::view(self)
    }

    /// The parameters as a type without their capacity.
    pub fn as_mut_view(&mut self) -> &mut ParametersView {
        B::view_mut(self)
    }
}

impl ParametersView {
    fn add_variable(&mut self, spec: VariableSpec<'_>) -> Result<(), Error> {
        check_name(spec.name)?;
        spec::check_inner(spec.raw())?;
        if self.find(spec.name.as_bytes()).is_some() {
            return Err(Error::NameTaken);
        }
        self.add_checked(spec.raw())
    }

    /// The value of the variable at an index; [`Error::UnknownVariable`] if there is none.
    #[doc(hidden)]
    pub fn value_of(&self, place: usize) -> Result<Value<'_>, Error> {
        self.value_at(place).filter(|_| place < self.len()).ok_or(Error::UnknownVariable)
    }

    /// The variable at an index, to be set.
    pub(crate) fn target_of(&mut self, place: usize) -> Result<Target<'_>, Error> {
        if place < self.len() { self.target(place).ok_or(Error::UnknownVariable) } else { Err(Error::UnknownVariable) }
    }

    /// Adds a variable whose name is valid and not taken.
    pub(super) fn add_checked(&mut self, spec: RawSpec<'_>) -> Result<(), Error> {
        let nested = if spec.kind.is_nested() { spec::least(spec) } else { 0 };
        let target = self.reserve(spec, nested)?;
        if spec.kind.is_fixed() || spec.kind.is_nested() {
            target.bytes.fill(0);
            *target.length = saturate(target.bytes.len());
        }
        Ok(())
    }

    /// As [`add_checked`](Self::add_checked), with a value that was checked against type and size.
    pub(super) fn add_with(&mut self, spec: RawSpec<'_>, value: &[u8]) -> Result<(), Error> {
        self.reserve(spec, value.len())?.set_checked(value);
        Ok(())
    }

    /// Reserves a new variable without setting its value; that of a list or record takes `nested` bytes.
    fn reserve(&mut self, spec: RawSpec<'_>, nested: usize) -> Result<Target<'_>, Error> {
        let RawSpec { name, kind, size, inner } = spec;
        let index = self.count;
        let full = Error::Full(Limit::ParametersBytes);
        // `ok_or` would copy each slice into a `Result` and out again.
        let Some(place) = self.table.get_mut(index as usize) else { return Err(Error::Full(Limit::Variables)) };
        let Some(length) = (if kind.is_nested() { Some(nested) } else { kind.bytes_of(size) }) else {
            return Err(full);
        };
        let Some((_, mut free)) = self.bytes.split_at_mut_checked(self.used as usize) else { return Err(full) };
        let mut value_at = self.used.saturating_add(saturate(name.len()));
        let mut inner_length = 0;
        if kind.is_nested() {
            let inner_place;
            (inner_place, free) = free.split_at_mut_checked(inner.len()).ok_or(full)?;
            copy(inner, inner_place);
            value_at = value_at.saturating_add(saturate(inner.len()));
            // The inner types come from a signature, or were checked like one, so this cannot fail.
            inner_length = u16::try_from(inner.len()).map_err(|_| Error::Full(Limit::SignatureBytes))?;
        }
        let Some((name_place, free)) = free.split_at_mut_checked(name.len()) else { return Err(full) };
        let Some(value) = free.get_mut(..length) else { return Err(full) };
        copy(name, name_place);
        *place = Entry { value_at, size, length: 0, name_length: name.len() as u8, kind, inner_length };
        self.used = value_at.saturating_add(saturate(length));
        self.count = index.saturating_add(1);
        Ok(Target { index: index as u8, kind, size, length: &mut place.length, bytes: value })
    }

    fn replace_by(&mut self, other: &Self) -> Result<(), Error> {
        let full = Error::Full(Limit::ParametersBytes);
        let used = other.used as usize;
        let from = other.bytes.get(..used).ok_or(full)?;
        copy(from, self.bytes.get_mut(..used).ok_or(full)?);
        self.table = other.table;
        self.count = other.count;
        self.used = other.used;
        Ok(())
    }

    #[inline]
    pub(super) fn find(&self, name: &[u8]) -> Option<usize> {
        self.table.iter().take(self.len()).position(|entry| are_same(self.name_of(entry), name))
    }

    #[inline]
    pub(super) fn named(&self, name: &[u8]) -> Option<Value<'_>> {
        self.find(name).and_then(|index| self.value_at(index))
    }

    #[inline]
    pub(crate) fn value_at(&self, index: usize) -> Option<Value<'_>> {
        let entry = self.table.get(index)?;
        let start = entry.value_at as usize;
        let bytes = self.bytes.get(start..start.saturating_add(entry.length as usize))?;
        let inner = if entry.kind.is_nested() { self.inner_of(entry) } else { &[] };
        Some(Value { index: index as u8, kind: entry.kind, size: entry.size, inner, bytes })
    }

    /// The whole arena, including unused bytes.
    pub(super) const fn arena(&self) -> &[u8] {
        &self.bytes
    }

    pub(super) const fn used(&self) -> usize {
        self.used as usize
    }

    /// Up to `most` unused bytes from an offset on.
    pub(super) fn room_at(&mut self, at: usize, most: usize) -> Option<&mut [u8]> {
        let (_, free) = self.bytes.split_at_mut_checked(at)?;
        let end = free.len().min(most);
        free.get_mut(..end)
    }

    /// Sets a list or record from bytes that were checked against its type.
    pub(super) fn set_nested(&mut self, index: usize, bytes: &[u8]) -> Result<(), Error> {
        let start = self.used as usize;
        let place = self.bytes.get_mut(start..start.saturating_add(bytes.len()));
        copy(bytes, place.ok_or(Error::Full(Limit::ParametersBytes))?);
        self.replace_nested(index, bytes.len());
        Ok(())
    }

    /// Moves `length` bytes, which lie behind all used bytes, into the value of a list or record.
    pub(super) fn replace_nested(&mut self, index: usize, length: usize) {
        let Some(entry) = self.table.get_mut(index) else { return };
        let (at, old) = (entry.value_at, entry.length as usize);
        entry.length = saturate(length);
        let end = (self.used as usize).saturating_add(length);
        let Some(region) = self.bytes.get_mut(at as usize..end).filter(|region| region.len() >= length) else { return };
        rotate_up(region, length);
        if let Some(behind) = region.get_mut(length..) {
            let until = behind.len();
            move_down(behind, old..until);
        }
        let moved = |place: u32| place.saturating_add(saturate(length)).saturating_sub(saturate(old));
        for later in self.table.iter_mut().take(self.count as usize).filter(|later| later.value_at > at) {
            later.value_at = moved(later.value_at);
        }
        self.used = moved(self.used);
    }

    /// The offset in the arena of the inner types of the variable at `index`.
    pub(super) fn inner_at(&self, index: usize) -> Option<usize> {
        let entry = self.table.get(index)?;
        let behind = usize::from(entry.name_length).checked_add(usize::from(entry.inner_length))?;
        (entry.value_at as usize).checked_sub(behind)
    }

    fn inner_of(&self, entry: &Entry) -> &[u8] {
        let end = (entry.value_at as usize).saturating_sub(usize::from(entry.name_length));
        self.bytes.get(end.saturating_sub(usize::from(entry.inner_length))..end).unwrap_or_default()
    }

    /// Sets the variable at `index` from bytes that were checked against its type and size.
    #[inline]
    pub(crate) fn set_checked(&mut self, index: usize, bytes: &[u8]) {
        if let Some(target) = self.target(index) {
            target.set_checked(bytes);
        }
    }

    fn target(&mut self, index: usize) -> Option<Target<'_>> {
        let entry = self.table.get_mut(index)?;
        let start = entry.value_at as usize;
        let length = if entry.kind.is_nested() { entry.length as usize } else { entry.kind.bytes_of(entry.size)? };
        let end = start.saturating_add(length);
        let bytes = self.bytes.get_mut(start..end)?;
        Some(Target { index: index as u8, kind: entry.kind, size: entry.size, length: &mut entry.length, bytes })
    }

    #[inline]
    fn name_of(&self, entry: &Entry) -> &[u8] {
        let end = entry.value_at as usize;
        self.bytes.get(end.saturating_sub(usize::from(entry.name_length))..end).unwrap_or_default()
    }
}

/// The bytes of `Parameters`: an array or a slice.
///
/// The methods are on the generic type, not on the view alone, so that `pos.set_value("x", pos.variable::<i64>("x")? + 1)`
/// compiles.
pub trait Arena: sealed::Sealed {
    #[doc(hidden)]
    fn view(parameters: &ParametersInner<Self>) -> &ParametersView;
    #[doc(hidden)]
    fn view_mut(parameters: &mut ParametersInner<Self>) -> &mut ParametersView;
}

mod sealed {
    pub trait Sealed {}
    impl<const BYTES: usize> Sealed for [u8; BYTES] {}
    impl Sealed for [u8] {}
}

impl<const BYTES: usize> Arena for [u8; BYTES] {
    fn view(parameters: &ParametersInner<Self>) -> &ParametersView {
        parameters
    }
    fn view_mut(parameters: &mut ParametersInner<Self>) -> &mut ParametersView {
        parameters
    }
}

impl Arena for [u8] {
    fn view(parameters: &ParametersView) -> &ParametersView {
        parameters
    }
    fn view_mut(parameters: &mut ParametersView) -> &mut ParametersView {
        parameters
    }
}

impl<const BYTES: usize> Deref for ParametersInner<[u8; BYTES]> {
    type Target = ParametersView;
    fn deref(&self) -> &ParametersView {
        self
    }
}

impl<const BYTES: usize> DerefMut for ParametersInner<[u8; BYTES]> {
    fn deref_mut(&mut self) -> &mut ParametersView {
        self
    }
}

impl<const BYTES: usize> Default for ParametersInner<[u8; BYTES]> {
    fn default() -> Self {
        Self::sized()
    }
}

impl PartialEq for ParametersView {
    fn eq(&self, other: &Self) -> bool {
        self.len() == other.len() && self.iter().eq(other.iter())
    }
}

impl<const A: usize, const B: usize> PartialEq<ParametersInner<[u8; B]>> for ParametersInner<[u8; A]> {
    fn eq(&self, other: &ParametersInner<[u8; B]>) -> bool {
        **self == **other
    }
}

impl fmt::Debug for ParametersView {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_map().entries(self.iter().map(|variable| (variable.name, variable.value))).finish()
    }
}

impl<const BYTES: usize> fmt::Debug for ParametersInner<[u8; BYTES]> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&**self, f)
    }
}

#[cfg(test)]
mod tests;
