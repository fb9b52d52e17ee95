//! The variables of a signature: name, type, size and, for lists and records, the inner types.
//!
//! The inner types of a list are its element's type u8 and size u32, then the element's inner types; those of a record are its
//! fields, each a variable. Recursion here is at most [`DEPTH`] deep, since signatures are checked before they are stored.

use core::fmt;

use super::name::check_name;
use super::value::{Type, saturate};
use crate::config::DEPTH;
use crate::error::{Error, Limit};

/// Name, type and size of one argument or result, or of a field of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VariableSpec<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its type.
    pub kind: Type,
    /// Its size: exactly this many numbers or truth values, at most this many bytes of a string or bytes, at most this many
    /// elements of a list, or the number of a record's fields.
    pub size: u32,
    /// The inner types of a list or record, as encoded in a signature; empty for other types.
    pub inner: &'a [u8],
}

/// A [`VariableSpec`] with an unvalidated name, for comparison only: validating UTF-8 would dominate the cost of a
/// short request.
#[derive(Clone, Copy, Debug)]
pub(super) struct RawSpec<'a> {
    pub(super) name: &'a [u8],
    pub(super) kind: Type,
    pub(super) size: u32,
    pub(super) inner: &'a [u8],
}

/// The arguments or the results of a [`Signature`](super::function::Signature), in its order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VariableSpecs<'a> {
    pub(super) left: u8,
    pub(super) rest: &'a [u8],
}
impl<'a> VariableSpecs<'a> {
    /// Capacity in bytes of a `Parameters` with all of them.
    pub fn parameters_bytes(self) -> u32 {
        let bytes = self.raw().try_fold(0_usize, |sum, spec| sum.checked_add(bytes_of_variable(spec)?));
        bytes.map_or(u32::MAX, saturate)
    }

    /// The variable of this name.
    pub fn named(mut self, name: &str) -> Option<VariableSpec<'a>> {
        self.find(|spec| spec.name == name)
    }

    /// The variables, without validation of their names.
    pub(super) fn raw(mut self) -> impl Iterator<Item = RawSpec<'a>> + Clone {
        core::iter::from_fn(move || self.next_raw())
    }

    #[inline]
    pub(super) fn next_raw(&mut self) -> Option<RawSpec<'a>> {
        self.left = self.left.checked_sub(1)?;
        let (spec, rest) = RawSpec::split(self.rest)?;
        self.rest = rest;
        Some(spec)
    }

    #[inline]
    pub(super) fn of_checked(bytes: Option<&'a [u8]>) -> Self {
        match bytes.and_then(<[u8]>::split_first) {
            Some((&left, rest)) => Self { left, rest },
            None => Self { left: 0, rest: &[] },
        }
    }

    /// The bytes that follow the variables, none of which has been read yet.
    #[inline]
    pub(super) fn behind(&self) -> Option<&'a [u8]> {
        (0..self.left).try_fold(self.rest, |rest, _| {
            let (&[kind, length, size @ ..], rest) = rest.split_first_chunk::<6>()?;
            let rest = rest.get(usize::from(length)..)?;
            match Type::from_wire(kind) {
                Some(kind) if kind.is_nested() => behind(kind, u32::from_le_bytes(size), rest),
                _ => Some(rest),
            }
        })
    }

    pub(super) fn split(bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let (&count, start) = bytes.split_first()?;
        let mut rest = start;
        for _ in 0..count {
            rest = VariableSpec::split(rest)?.1;
        }
        Some((Self { left: count, rest: start }, rest))
    }
}

impl<'a> Iterator for VariableSpecs<'a> {
    type Item = VariableSpec<'a>;

    fn next(&mut self) -> Option<VariableSpec<'a>> {
        self.left = self.left.checked_sub(1)?;
        let (spec, rest) = VariableSpec::split(self.rest)?;
        self.rest = rest;
        Some(spec)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (0, Some(usize::from(self.left)))
    }
}

impl<'a> RawSpec<'a> {
    #[inline]
    pub(super) fn split(bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let (&[kind, length, size @ ..], rest) = bytes.split_first_chunk::<6>()?;
        let (name, rest) = rest.split_at_checked(usize::from(length))?;
        let (kind, size) = (Type::from_wire(kind)?, u32::from_le_bytes(size));
        let (inner, rest) = if kind.is_nested() { split_inner(kind, size, rest)? } else { (&[][..], rest) };
        Some((Self { name, kind, size, inner }, rest))
    }
}

impl<'a> VariableSpec<'a> {
    /// A variable other than a list or record.
    pub const fn flat(name: &'a str, kind: Type, size: u32) -> Self {
        Self { name, kind, size, inner: &[] }
    }

    /// The element of a list, without a name; `None` for other types.
    pub fn element(&self) -> Option<Self> {
        self.raw().element().map(|element| Self {
            name: "",
            kind: element.kind,
            size: element.size,
            inner: element.inner,
        })
    }

    /// The fields of a record; none for other types.
    pub fn fields(&self) -> VariableSpecs<'a> {
        self.raw().fields()
    }

    pub(super) const fn raw(&self) -> RawSpec<'a> {
        RawSpec { name: self.name.as_bytes(), kind: self.kind, size: self.size, inner: self.inner }
    }

    fn split(bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let (RawSpec { name, kind, size, inner }, rest) = RawSpec::split(bytes)?;
        let name = core::str::from_utf8(name).ok()?;
        Some((Self { name, kind, size, inner }, rest))
    }
}

/// Bytes of an element's type and size.
const ELEMENT_HEAD: usize = 5;
/// Bytes of the head of a list's value: the count of elements and the length of its body.
pub(super) const LIST_HEAD: usize = 8;

impl<'a> RawSpec<'a> {
    /// The element of a list.
    pub(super) fn element(&self) -> Option<Self> {
        if self.kind != Type::List {
            return None;
        }
        let (kind, size, inner) = split_element(self.inner)?;
        Some(RawSpec { name: &[], kind, size, inner })
    }

    /// The fields of a record.
    pub(super) fn fields(&self) -> VariableSpecs<'a> {
        match (self.kind, u8::try_from(self.size)) {
            (Type::Record, Ok(left)) => VariableSpecs { left, rest: self.inner },
            _ => VariableSpecs { left: 0, rest: &[] },
        }
    }
}

/// An element's type and size, and the bytes that follow them.
pub(super) const fn split_element(bytes: &[u8]) -> Option<(Type, u32, &[u8])> {
    let Some((&[kind, size @ ..], rest)) = bytes.split_first_chunk::<ELEMENT_HEAD>() else { return None };
    let Some(kind) = Type::from_wire(kind) else { return None };
    Some((kind, u32::from_le_bytes(size), rest))
}

/// The bytes that follow the inner types of a list or record at `rest`. Terminates, since each round consumes bytes.
fn behind(mut kind: Type, mut size: u32, mut rest: &[u8]) -> Option<&[u8]> {
    let mut fields = 0_u32;
    loop {
        match kind {
            Type::List => {
                (kind, size, rest) = split_element(rest)?;
                continue;
            }
            Type::Record => fields = fields.checked_add(size)?,
            _ => {}
        }
        let Some(left) = fields.checked_sub(1) else { return Some(rest) };
        fields = left;
        let (&[byte, length, number @ ..], named) = rest.split_first_chunk::<6>()?;
        (kind, size) = (Type::from_wire(byte)?, u32::from_le_bytes(number));
        rest = named.get(usize::from(length)..)?;
    }
}

/// The inner types of a list or record, and the bytes that follow them.
fn split_inner(kind: Type, size: u32, bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let rest = behind(kind, size, bytes)?;
    bytes.split_at_checked(bytes.len().checked_sub(rest.len())?)
}

/// Checks the inner types of a variable: depth, names, and that no element is empty, since a large count of empty elements would
/// cost its sender nothing.
pub(super) fn check_inner(spec: RawSpec<'_>) -> Result<(), Error> {
    if spec.kind.is_nested() {
        return check_at(spec, 0);
    }
    if spec.inner.is_empty() { Ok(()) } else { Err(Error::Malformed) }
}

fn check_at(spec: RawSpec<'_>, depth: usize) -> Result<(), Error> {
    if !spec.kind.is_nested() {
        return Ok(());
    }
    if depth >= DEPTH {
        return Err(Error::Full(Limit::Depth));
    }
    let deeper = depth.saturating_add(1);
    if behind(spec.kind, spec.size, spec.inner).is_none_or(|rest| !rest.is_empty()) {
        return Err(Error::Malformed);
    }
    if let Some(element) = spec.element() {
        check_at(element, deeper)?;
        return if least(element) == 0 { Err(Error::Malformed) } else { Ok(()) };
    }
    if spec.size == 0 || spec.size > u32::from(u8::MAX) {
        return Err(Error::Full(Limit::Variables));
    }
    let mut fields = spec.fields();
    for position in 0.. {
        let Some(field) = fields.next_raw() else { break };
        check_name(core::str::from_utf8(field.name).map_err(|_| Error::Malformed)?)?;
        if spec.fields().raw().take(position).any(|earlier| earlier.name == field.name) {
            return Err(Error::NameTaken);
        }
        check_at(field, deeper)?;
    }
    Ok(())
}

/// Bytes of the shortest value in a block, with empty texts and lists. All these bytes are zero.
pub(super) fn least(spec: RawSpec<'_>) -> usize {
    match spec.kind {
        Type::List | Type::String | Type::Bytes => LIST_HEAD,
        Type::Record => spec.fields().raw().map(least).fold(0, usize::saturating_add),
        Type::Int | Type::Float | Type::Bool => {
            let bytes = spec.kind.bytes_of(spec.size).unwrap_or(usize::MAX);
            bytes.saturating_add(padding_after(bytes))
        }
    }
}

/// Bytes of the longest value in a block; `None` if that exceeds the address space.
pub(super) fn longest(spec: RawSpec<'_>) -> Option<usize> {
    match spec.kind {
        Type::List => (spec.size as usize).checked_mul(longest(spec.element()?)?)?.checked_add(LIST_HEAD),
        Type::Record => spec.fields().raw().try_fold(0_usize, |sum, field| sum.checked_add(longest(field)?)),
        kind => {
            let head = if kind.is_fixed() { 0 } else { LIST_HEAD };
            kind.bytes_of(spec.size)?.checked_next_multiple_of(8)?.checked_add(head)
        }
    }
}

/// How the sizes of two variables are compared.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Bounds {
    /// Those of texts, bytes and lists may differ: whether a value fits is checked when it is there.
    Free,
    /// Those of the first type are at most those of the second, so that every value fits.
    Fit,
}

/// Whether a value of one type is accepted by the other.
pub(super) fn can_be(one: RawSpec<'_>, other: RawSpec<'_>, bounds: Bounds) -> bool {
    let size = || bounds == Bounds::Free || one.size <= other.size;
    one.kind == other.kind
        && match one.kind {
            Type::Int | Type::Float | Type::Bool => one.size == other.size,
            Type::String | Type::Bytes => size(),
            Type::List => {
                let elements = one.element().zip(other.element());
                size() && elements.is_some_and(|(one, other)| can_be(one, other, bounds))
            }
            Type::Record => {
                let mut fields = one.fields().raw().zip(other.fields().raw());
                one.size == other.size
                    && fields.all(|(one, other)| one.name == other.name && can_be(one, other, bounds))
            }
        }
}

/// A type and its size, if there is one.
type Shape = Option<(Type, u32)>;

/// Finds where the type of a variable differs between two units: appends the path to `path`, and returns both types there. A path
/// that is too long is cut after a name.
pub(super) fn difference<const N: usize>(
    ours: Option<VariableSpec<'_>>,
    theirs: Option<VariableSpec<'_>>,
    bounds: Bounds,
    path: &mut heapless::String<N>,
) -> (Shape, Shape) {
    let (mut here, mut there) = (ours.map(|spec| spec.raw()), theirs.map(|spec| spec.raw()));
    let mut has_room = true;
    while let Some((one, other)) = here.zip(there) {
        let (way, next) = if one.kind == Type::List && other.kind == Type::List {
            if bounds == Bounds::Fit && other.size > one.size {
                break;
            }
            ("[]", (one.element(), other.element()))
        } else if one.kind == Type::Record && other.kind == Type::Record {
            let mut pairs = (one.fields(), other.fields());
            let Some(pair) = core::iter::from_fn(|| Some((pairs.0.next_raw(), pairs.1.next_raw())))
                .take_while(|(one, other)| one.is_some() || other.is_some())
                .find(|pair| !is_same_field(*pair, bounds))
            else {
                break;
            };
            (".", pair)
        } else {
            break;
        };
        (here, there) = next;
        let name = here.or(there).map_or(&[][..], |spec| spec.name);
        // Once a name does not fit, leave out all that follow: they would seem to be fields of the name before it.
        let name = core::str::from_utf8(name).unwrap_or_default();
        has_room &= path.len().saturating_add(way.len()).saturating_add(name.len()) <= N;
        if has_room {
            let _ = path.push_str(way).and_then(|()| path.push_str(name));
        }
        if here.zip(there).is_some_and(|(one, other)| one.name != other.name) {
            there = None;
        }
    }
    let shape = |spec: RawSpec<'_>| (spec.kind, spec.size);
    (here.map(shape), there.map(shape))
}

/// Whether the peer's field is compatible with ours, if both exist.
fn is_same_field((ours, theirs): (Option<RawSpec<'_>>, Option<RawSpec<'_>>), bounds: Bounds) -> bool {
    let (Some(ours), Some(theirs)) = (ours, theirs) else { return false };
    // Arguments go to the peer, results come from it.
    let (from, to) = if bounds == Bounds::Free { (ours, theirs) } else { (theirs, ours) };
    from.name == to.name && can_be(from, to, bounds)
}

/// Bytes that a variable takes in a [`Parameters`]; `None` if that exceeds the address space.
pub(super) fn bytes_of_variable(spec: RawSpec<'_>) -> Option<usize> {
    if spec.kind.is_nested() {
        return least(spec).checked_add(spec.inner.len())?.checked_add(spec.name.len());
    }
    spec.kind.bytes_of(spec.size)?.checked_add(spec.name.len())
}

/// Number of zero bytes after `length` bytes that align the next value to 8.
pub(super) const fn padding_after(length: usize) -> usize {
    length.wrapping_neg() & 7
}

/// The text form of a type: `int[2]`, `{x: float}[..8]`, `int?` for `int[..1]`.
fn show(f: &mut fmt::Formatter<'_>, spec: RawSpec<'_>) -> fmt::Result {
    show_at(f, spec, 0)
}

fn show_at(f: &mut fmt::Formatter<'_>, spec: RawSpec<'_>, depth: usize) -> fmt::Result {
    if !spec.kind.is_nested() {
        f.write_str(spec.kind.word())?;
        return if spec.kind.is_fixed() && spec.size == 1 { Ok(()) } else { write!(f, "[{}]", spec.size) };
    }
    if depth >= DEPTH {
        return f.write_str("…");
    }
    let deeper = depth.saturating_add(1);
    if let Some(element) = spec.element() {
        show_at(f, element, deeper)?;
        return if spec.size == 1 { f.write_str("?") } else { write!(f, "[..{}]", spec.size) };
    }
    f.write_str("{")?;
    for (index, field) in spec.fields().raw().enumerate() {
        let comma = if index > 0 { ", " } else { "" };
        write!(f, "{comma}{}: ", core::str::from_utf8(field.name).unwrap_or_default())?;
        show_at(f, field, deeper)?;
    }
    f.write_str("}")
}

impl fmt::Display for VariableSpec<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.name)?;
        show(f, self.raw())
    }
}

impl fmt::Display for VariableSpecs<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("(")?;
        for (index, spec) in self.enumerate() {
            if index > 0 {
                f.write_str(", ")?;
            }
            fmt::Display::fmt(&spec, f)?;
        }
        f.write_str(")")
    }
}
