//! Writes lists and records into a `Parameters`: element by element, after all used bytes, in the layout of a block. The old
//! value is replaced only when the new one is complete, so that an error leaves it unchanged.
//!
//! The inner types are in the same arena, so they are read step by step by offset: a borrowed slice would prevent writing.

use super::nested;
use super::parameters::ParametersView;
use super::spec::{LIST_HEAD, RawSpec, padding_after, split_element};
use super::value::{IntoValue, Target, Type, saturate};
use crate::ability::{Ability, NESTED, Nested};
use crate::bytes::copy;
use crate::error::{Error, Limit};

/// Adds elements to a list, in order.
///
/// An element that fails to be added leaves the list as it was.
pub struct ListWriter<'p> {
    view: &'p mut ParametersView,
    index: u8,
    /// Offset of the next element.
    at: usize,
    element: Made,
    count: u32,
    most: u32,
}

/// Sets the fields of a record, each once and in order.
pub struct RecordWriter<'p> {
    view: &'p mut ParametersView,
    index: u8,
    /// Offset of the next field's value.
    at: usize,
    /// Offset of the next field's type.
    field_at: usize,
    left: u32,
}

/// The target of one value: a variable, an element of a list, or a field of a record.
pub struct Slot<'a>(To<'a>);

enum To<'a> {
    /// A variable other than a list or record.
    Variable(Target<'a>),
    /// The list or record at an index.
    Nested(<Nested as Ability>::Of<(&'a mut ParametersView, usize)>),
    /// The next part of a list or record that is being written.
    Part(<Nested as Ability>::Of<Part<'a>>),
}

/// The next part of a list or record that is being written; after writing, its end.
struct Part<'a> {
    view: &'a mut ParametersView,
    index: u8,
    at: usize,
    made: Made,
    end: &'a mut Option<usize>,
}

/// A type, and the offset of its inner types in the arena.
#[derive(Clone, Copy)]
struct Made {
    kind: Type,
    size: u32,
    inner_at: usize,
}

impl<'a> From<Target<'a>> for Slot<'a> {
    #[inline]
    fn from(target: Target<'a>) -> Self {
        Self(To::Variable(target))
    }
}

impl Slot<'_> {
    /// Sets it to a number, a truth value, an array of them, a `&str` or a `&[u8]`.
    #[inline]
    pub fn set(self, value: impl IntoValue) -> Result<(), Error> {
        match self.0 {
            To::Variable(target) => value.into_value(target),
            To::Nested(nested) => {
                Err(Error::WrongType { index: Nested::get::<(&mut ParametersView, usize)>(nested).1 as u8 })
            }
            To::Part(part) => {
                Nested::get::<Part<'_>>(part).write(|view, index, at, made| leaf(view, index, at, made, value))
            }
        }
    }

    /// Sets it to a list.
    pub fn list(self, write: impl FnOnce(&mut ListWriter<'_>) -> Result<(), Error>) -> Result<(), Error> {
        match self.0 {
            To::Variable(target) => Err(Error::WrongType { index: target.index }),
            To::Nested(nested) => {
                let (view, place): (&mut ParametersView, _) = Nested::get(nested);
                view.write_list(place, write)
            }
            To::Part(part) => {
                Nested::get::<Part<'_>>(part).write(|view, index, at, made| list(view, index, at, made, write))
            }
        }
    }

    /// Sets it to a record.
    pub fn record(self, write: impl FnOnce(&mut RecordWriter<'_>) -> Result<(), Error>) -> Result<(), Error> {
        match self.0 {
            To::Variable(target) => Err(Error::WrongType { index: target.index }),
            To::Nested(nested) => {
                let (view, place): (&mut ParametersView, _) = Nested::get(nested);
                view.write_record(place, write)
            }
            To::Part(part) => {
                Nested::get::<Part<'_>>(part).write(|view, index, at, made| record(view, index, at, made, write))
            }
        }
    }
}

impl Part<'_> {
    fn write(
        self,
        write: impl FnOnce(&mut ParametersView, u8, usize, Made) -> Result<usize, Error>,
    ) -> Result<(), Error> {
        *self.end = Some(write(self.view, self.index, self.at, self.made)?);
        Ok(())
    }
}

/// Lets `write` set a part; returns its end.
fn part(
    view: &mut ParametersView,
    index: u8,
    at: usize,
    made: Made,
    write: impl FnOnce(Slot<'_>) -> Result<(), Error>,
) -> Result<usize, Error> {
    let mut end = None;
    if let Some(part) = Nested::of(Part { view, index, at, made, end: &mut end }) {
        write(Slot(To::Part(part)))?;
    }
    end.ok_or(Error::MissingArgument { index })
}

impl ListWriter<'_> {
    /// Adds a number, a truth value, an array of them, a `&str` or a `&[u8]`.
    ///
    /// Errors: [`Error::WrongType`], [`Error::WrongSize`], also for an element too many, [`Error::OutOfRange`], [`Error::Full`].
    pub fn push(&mut self, value: impl IntoValue) -> Result<(), Error> {
        self.add(|view, index, at, element| leaf(view, index, at, element, value))
    }

    /// Adds a list; errors as for [`push`](Self::push), and those of `write`.
    pub fn push_list(&mut self, write: impl FnOnce(&mut ListWriter<'_>) -> Result<(), Error>) -> Result<(), Error> {
        self.add(|view, index, at, element| list(view, index, at, element, write))
    }

    /// Adds a record; errors as for [`push`](Self::push), and those of `write`.
    pub fn push_record(&mut self, write: impl FnOnce(&mut RecordWriter<'_>) -> Result<(), Error>) -> Result<(), Error> {
        self.add(|view, index, at, element| record(view, index, at, element, write))
    }

    /// Adds an element that `write` sets.
    pub fn push_with(&mut self, write: impl FnOnce(Slot<'_>) -> Result<(), Error>) -> Result<(), Error> {
        self.add(|view, index, at, element| part(view, index, at, element, write))
    }

    fn add(
        &mut self,
        write: impl FnOnce(&mut ParametersView, u8, usize, Made) -> Result<usize, Error>,
    ) -> Result<(), Error> {
        let count = self.count.saturating_add(1);
        if count > self.most {
            return Err(Error::WrongSize { index: self.index, expected: self.most, found: count });
        }
        self.at = write(self.view, self.index, self.at, self.element)?;
        self.count = count;
        Ok(())
    }
}

impl RecordWriter<'_> {
    /// Sets the next field to a number, a truth value, an array of them, a `&str` or a `&[u8]`.
    ///
    /// Errors: [`Error::UnknownVariable`] if the next field has another name, [`Error::WrongType`], [`Error::WrongSize`],
    /// [`Error::OutOfRange`], [`Error::Full`].
    pub fn set(&mut self, name: &str, value: impl IntoValue) -> Result<(), Error> {
        self.field(name, |view, index, at, field| leaf(view, index, at, field, value))
    }

    /// Sets the next field, a list; errors as for [`set`](Self::set), and those of `write`.
    pub fn set_list(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut ListWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.field(name, |view, index, at, field| list(view, index, at, field, write))
    }

    /// Sets the next field, a record; errors as for [`set`](Self::set), and those of `write`.
    pub fn set_record(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut RecordWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.field(name, |view, index, at, field| record(view, index, at, field, write))
    }

    /// Lets `write` set the next field.
    pub fn set_with(&mut self, name: &str, write: impl FnOnce(Slot<'_>) -> Result<(), Error>) -> Result<(), Error> {
        self.field(name, |view, index, at, field| part(view, index, at, field, write))
    }

    fn field(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut ParametersView, u8, usize, Made) -> Result<usize, Error>,
    ) -> Result<(), Error> {
        let left = self.left.checked_sub(1).ok_or(Error::UnknownVariable)?;
        let made = self.view.arena().get(self.field_at..).unwrap_or_default();
        let (field, behind) =
            RawSpec::split(made).filter(|(field, _)| field.name == name.as_bytes()).ok_or(Error::UnknownVariable)?;
        let next = self.field_at.saturating_add(made.len().saturating_sub(behind.len()));
        let inner_at = next.saturating_sub(field.inner.len());
        let made = Made { kind: field.kind, size: field.size, inner_at };
        self.at = write(self.view, self.index, self.at, made)?;
        (self.field_at, self.left) = (next, left);
        Ok(())
    }
}

impl ParametersView {
    /// The variable at an index, to be set, of any type.
    #[doc(hidden)]
    #[inline]
    pub fn slot_of(&mut self, place: usize) -> Result<Slot<'_>, Error> {
        if !NESTED || !self.value_of(place)?.kind().is_nested() {
            return self.target_of(place).map(Slot::from);
        }
        Nested::of((self, place)).map(To::Nested).map(Slot).ok_or(Error::WrongType { index: place as u8 })
    }

    pub(super) fn write_list(
        &mut self,
        place: usize,
        write: impl FnOnce(&mut ListWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.write_nested(place, |view, index, at, made| list(view, index, at, made, write))
    }

    pub(super) fn write_record(
        &mut self,
        place: usize,
        write: impl FnOnce(&mut RecordWriter<'_>) -> Result<(), Error>,
    ) -> Result<(), Error> {
        self.write_nested(place, |view, index, at, made| record(view, index, at, made, write))
    }

    fn write_nested(
        &mut self,
        place: usize,
        write: impl FnOnce(&mut Self, u8, usize, Made) -> Result<usize, Error>,
    ) -> Result<(), Error> {
        let value = self.value_at(place).ok_or(Error::UnknownVariable)?;
        let (kind, size) = (value.kind(), value.size());
        let inner_at = self.inner_at(place).ok_or(Error::UnknownVariable)?;
        let start = self.used();
        let end = write(self, place as u8, start, Made { kind, size, inner_at })?;
        self.replace_nested(place, end.saturating_sub(start));
        Ok(())
    }
}

/// Writes a value other than a list or record; returns its end.
fn leaf(view: &mut ParametersView, index: u8, at: usize, made: Made, value: impl IntoValue) -> Result<usize, Error> {
    let Made { kind, size, .. } = made;
    if kind.is_nested() {
        return Err(Error::WrongType { index });
    }
    let full = Error::Full(Limit::ParametersBytes);
    let declared = kind.bytes_of(size).ok_or(full)?;
    let head = if kind.is_fixed() { 0 } else { LIST_HEAD };
    let start = at.saturating_add(head);
    let most = declared.checked_next_multiple_of(8).ok_or(full)?;
    // A text may be shorter than declared, and fit even if the declared length would not.
    let free = view.room_at(start, most).ok_or(full)?;
    let is_short = free.len() < declared;
    if is_short && kind.is_fixed() {
        return Err(full);
    }
    let place = if is_short { free } else { free.get_mut(..declared).ok_or(full)? };
    let mut length = saturate(if kind.is_fixed() { declared } else { 0 });
    let set = value.into_value(Target { index, kind, size, length: &mut length, bytes: place });
    set.map_err(|error| if is_short && matches!(error, Error::WrongSize { .. }) { full } else { error })?;
    let padding = padding_after(length as usize);
    let end = start.saturating_add(length as usize).saturating_add(padding);
    view.room_at(end.saturating_sub(padding), padding).and_then(|free| free.get_mut(..padding)).ok_or(full)?.fill(0);
    if head > 0 {
        put(view, at, &u64::from(length).to_le_bytes())?;
    }
    Ok(end)
}

/// Writes a list; returns its end.
fn list(
    view: &mut ParametersView,
    index: u8,
    at: usize,
    made: Made,
    write: impl FnOnce(&mut ListWriter<'_>) -> Result<(), Error>,
) -> Result<usize, Error> {
    if made.kind != Type::List {
        return Err(Error::WrongType { index });
    }
    put(view, at, &[0; LIST_HEAD])?;
    let start = at.saturating_add(LIST_HEAD);
    let element = view.arena().get(made.inner_at..).and_then(split_element);
    let (kind, size, behind) = element.ok_or(Error::Malformed)?;
    let inner_at = view.arena().len().saturating_sub(behind.len());
    let element = Made { kind, size, inner_at };
    let mut writer = ListWriter { view, index, at: start, element, count: 0, most: made.size };
    write(&mut writer)?;
    let ListWriter { view, count, at: end, .. } = writer;
    put(view, at, &nested::list_head(count, end.saturating_sub(start)))?;
    Ok(end)
}

/// Writes a record; returns its end.
fn record(
    view: &mut ParametersView,
    index: u8,
    at: usize,
    made: Made,
    write: impl FnOnce(&mut RecordWriter<'_>) -> Result<(), Error>,
) -> Result<usize, Error> {
    if made.kind != Type::Record {
        return Err(Error::WrongType { index });
    }
    let mut writer = RecordWriter { view, index, at, field_at: made.inner_at, left: made.size };
    write(&mut writer)?;
    if writer.left > 0 { Err(Error::MissingArgument { index }) } else { Ok(writer.at) }
}

fn put(view: &mut ParametersView, at: usize, bytes: &[u8]) -> Result<(), Error> {
    let full = Error::Full(Limit::ParametersBytes);
    let place = view.room_at(at, bytes.len()).and_then(|free| free.get_mut(..bytes.len())).ok_or(full)?;
    copy(bytes, place);
    Ok(())
}
