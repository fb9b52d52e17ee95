//! The types of the IDL (paper, section 2), their values, and the Rust types that convert to and from them.
//!
//! Integers are encoded as `i64` and floats as `f64` bits; narrower Rust types are converted with a check. Only `Display` formats
//! floats, so that no float formatting is linked into firmware that shows no values.

use core::fmt;

use crate::ability::NESTED;
use crate::bytes::{as_text, copy};
use crate::error::Error;

pub use super::element::Element;

/// A type of the IDL. One byte on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Type {
    /// 64-bit signed integers, exactly `size` of them.
    Int = 0,
    /// 64-bit floating-point numbers, exactly `size` of them.
    Float = 1,
    /// UTF-8 text of at most `size` bytes.
    String = 2,
    /// Truth values, exactly `size` of them.
    Bool = 3,
    /// At most `size` bytes.
    Bytes = 4,
    /// At most `size` elements of one other type.
    List = 5,
    /// Named fields, `size` of them, each with its own type.
    Record = 6,
}

impl Type {
    /// The types without inner types.
    pub const FLAT: [Self; 5] = [Self::Int, Self::Float, Self::String, Self::Bool, Self::Bytes];

    /// The type with this number on the wire.
    pub(crate) const fn from_wire(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Int),
            1 => Some(Self::Float),
            2 => Some(Self::String),
            3 => Some(Self::Bool),
            4 => Some(Self::Bytes),
            5 if NESTED => Some(Self::List),
            6 if NESTED => Some(Self::Record),
            _ => None,
        }
    }

    /// Its name in a signature's text; lists and records are written otherwise there.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Int => "int",
            Self::Float => "float",
            Self::String => "string",
            Self::Bool => "bool",
            Self::Bytes => "bytes",
            Self::List => "list",
            Self::Record => "record",
        }
    }

    /// Whether a size n means exactly n numbers or truth values.
    pub const fn is_fixed(self) -> bool {
        matches!(self, Self::Int | Self::Float | Self::Bool)
    }

    /// Whether it has inner types. Constant without the feature `nested`, so that code for such types is left out.
    #[inline]
    pub const fn is_nested(self) -> bool {
        NESTED && matches!(self, Self::List | Self::Record)
    }

    /// Bytes of one element; 0 for lists and records, whose elements differ.
    pub const fn width(self) -> usize {
        match self {
            Self::Int | Self::Float => 8,
            Self::String | Self::Bool | Self::Bytes => 1,
            Self::List | Self::Record => 0,
        }
    }

    /// Bytes that `size` elements take; `None` if that exceeds the address space.
    pub const fn bytes_of(self, size: u32) -> Option<usize> {
        (size as usize).checked_mul(self.width())
    }
}

impl fmt::Display for Type {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// The value of one variable, borrowed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Value<'a> {
    pub(crate) index: u8,
    pub(crate) kind: Type,
    pub(crate) size: u32,
    /// The inner types of a list or record, as in a signature.
    pub(crate) inner: &'a [u8],
    pub(crate) bytes: &'a [u8],
}

impl<'a> Value<'a> {
    /// The variable's type.
    pub const fn kind(&self) -> Type {
        self.kind
    }

    /// The variable's declared size.
    pub const fn size(&self) -> u32 {
        self.size
    }

    /// The value as it is in memory: little-endian words, one byte per truth value, text; lists and records as in a block.
    pub const fn raw(&self) -> &'a [u8] {
        self.bytes
    }

    /// The integers; none for another type.
    pub fn ints(&self) -> impl Iterator<Item = i64> + Clone + use<'a> {
        self.words(Type::Int).map(i64::from_le_bytes)
    }

    /// The floating-point numbers; none for another type.
    pub fn floats(&self) -> impl Iterator<Item = f64> + Clone + use<'a> {
        self.words(Type::Float).map(f64::from_le_bytes)
    }

    /// The truth values; none for another type.
    pub fn bools(&self) -> impl Iterator<Item = bool> + Clone + use<'a> {
        let bytes = if self.kind == Type::Bool { self.bytes } else { &[] };
        bytes.iter().map(|&byte| byte != 0)
    }

    /// The text; `None` for another type.
    pub fn text(&self) -> Option<&'a str> {
        if self.kind != Type::String {
            return None;
        }
        as_text(self.bytes)
    }

    /// The value as `T`: a number, a truth value, an array of them, a `&str` or a `&[u8]`.
    pub fn read<T: FromValue<'a>>(&self) -> Result<T, Error> {
        T::from_value(*self)
    }

    fn words(&self, kind: Type) -> impl Iterator<Item = [u8; 8]> + Clone + use<'a> {
        let bytes = if self.kind == kind { self.bytes } else { &[] };
        bytes.as_chunks::<8>().0.iter().copied()
    }

    const fn wrong_type(&self) -> Error {
        Error::WrongType { index: self.index }
    }

    fn wrong_size(&self, found: usize) -> Error {
        let count = if self.kind.is_fixed() { self.size } else { saturate(self.bytes.len()) };
        Error::WrongSize { index: self.index, expected: count, found: saturate(found) }
    }
}

impl fmt::Debug for Value<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}[{}]", self.kind, self.size)
    }
}

/// One variable's value, borrowed for setting it.
pub struct Target<'a> {
    pub(crate) index: u8,
    pub(crate) kind: Type,
    pub(crate) size: u32,
    pub(crate) length: &'a mut u32,
    pub(crate) bytes: &'a mut [u8],
}

impl Target<'_> {
    /// The variable's type.
    pub const fn kind(&self) -> Type {
        self.kind
    }

    /// The variable's declared size.
    pub const fn size(&self) -> u32 {
        self.size
    }

    /// Sets the value from bytes that were checked against the type and size.
    pub(crate) fn set_checked(self, bytes: &[u8]) {
        if let Some(place) = self.bytes.get_mut(..bytes.len()) {
            copy(bytes, place);
            *self.length = saturate(bytes.len());
        }
    }

    fn set_raw(self, bytes: &[u8]) -> Result<(), Error> {
        let index = self.index;
        let wrong = Error::WrongSize { index, expected: self.size, found: saturate(bytes.len()) };
        copy(bytes, self.bytes.get_mut(..bytes.len()).ok_or(wrong)?);
        *self.length = saturate(bytes.len());
        Ok(())
    }

    fn set_elements<T: Element>(self, elements: &[T]) -> Result<(), Error> {
        if self.kind == Type::Bytes
            && let Some(bytes) = T::as_bytes(elements)
        {
            return self.set_raw(bytes);
        }
        if self.kind != T::KIND {
            return Err(Error::WrongType { index: self.index });
        }
        if elements.len() != self.size as usize {
            let found = saturate(elements.len());
            return Err(Error::WrongSize { index: self.index, expected: self.size, found });
        }
        if !elements.iter().all(|element| element.fits()) {
            return Err(Error::OutOfRange);
        }
        for (place, element) in self.bytes.chunks_exact_mut(T::KIND.width()).zip(elements) {
            element.store(place);
        }
        Ok(())
    }
}

/// A Rust type that a variable can be read as.
///
/// Implemented for integers, floats and `bool`, arrays of them, `&str` and `&[u8]`. The size must be exact.
pub trait FromValue<'a>: Sized {
    /// Reads the value; [`Error::WrongType`], [`Error::WrongSize`] or [`Error::OutOfRange`].
    fn from_value(value: Value<'a>) -> Result<Self, Error>;
}

/// A Rust type that a variable can be set from.
///
/// Implemented for integers, floats and `bool`, arrays and slices of them, `&str` and `&[u8]`. Setting is
/// all-or-nothing.
pub trait IntoValue {
    /// Sets the value; [`Error::WrongType`], [`Error::WrongSize`] or [`Error::OutOfRange`], and then it is unchanged.
    fn into_value(self, target: Target<'_>) -> Result<(), Error>;
}

impl<T: Element> FromValue<'_> for T {
    fn from_value(value: Value<'_>) -> Result<Self, Error> {
        let mut element = [T::default()];
        read_elements(value, &mut element)?;
        let [element] = element;
        Ok(element)
    }
}

impl<T: Element, const N: usize> FromValue<'_> for [T; N] {
    fn from_value(value: Value<'_>) -> Result<Self, Error> {
        let mut elements = [T::default(); N];
        read_elements(value, &mut elements)?;
        Ok(elements)
    }
}

impl<'a> FromValue<'a> for &'a str {
    fn from_value(value: Value<'a>) -> Result<Self, Error> {
        value.text().ok_or_else(|| value.wrong_type())
    }
}

impl<'a> FromValue<'a> for &'a [u8] {
    fn from_value(value: Value<'a>) -> Result<Self, Error> {
        if value.kind == Type::Bytes { Ok(value.bytes) } else { Err(value.wrong_type()) }
    }
}

impl<T: Element> IntoValue for T {
    fn into_value(self, target: Target<'_>) -> Result<(), Error> {
        target.set_elements(&[self])
    }
}

impl<T: Element, const N: usize> IntoValue for [T; N] {
    fn into_value(self, target: Target<'_>) -> Result<(), Error> {
        target.set_elements(&self)
    }
}

impl<T: Element, const N: usize> IntoValue for &[T; N] {
    fn into_value(self, target: Target<'_>) -> Result<(), Error> {
        target.set_elements(self)
    }
}

impl<T: Element> IntoValue for &[T] {
    fn into_value(self, target: Target<'_>) -> Result<(), Error> {
        target.set_elements(self)
    }
}

impl IntoValue for &str {
    fn into_value(self, target: Target<'_>) -> Result<(), Error> {
        if target.kind != Type::String {
            return Err(Error::WrongType { index: target.index });
        }
        target.set_raw(self.as_bytes())
    }
}

/// Reads a whole value into `elements`; on an error they are unchanged.
pub(crate) fn read_elements<T: Element>(value: Value<'_>, elements: &mut [T]) -> Result<(), Error> {
    let found = elements.len();
    if value.kind == Type::Bytes
        && let Some(bytes) = T::as_bytes_mut(elements)
    {
        if bytes.len() != value.bytes.len() {
            return Err(value.wrong_size(found));
        }
        copy(value.bytes, bytes);
        return Ok(());
    }
    if value.kind != T::KIND {
        return Err(value.wrong_type());
    }
    if found != value.size as usize {
        return Err(value.wrong_size(found));
    }
    let places = value.bytes.chunks_exact(T::KIND.width());
    if places.clone().any(|place| T::load(place).is_none()) {
        return Err(Error::OutOfRange);
    }
    for (element, place) in elements.iter_mut().zip(places) {
        *element = T::load(place).unwrap_or_default();
    }
    Ok(())
}

/// The length as u32, saturating.
pub(crate) fn saturate(length: usize) -> u32 {
    u32::try_from(length).unwrap_or(u32::MAX)
}

/// One variable of a [`ParametersView`](super::parameters::ParametersView), borrowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variable<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its type.
    pub kind: Type,
    /// Its declared size.
    pub size: u32,
    /// Its value.
    pub value: Value<'a>,
}
