//! Lists and records: what they are made of in a signature, and their values in a block.
//!
//! In a signature a list is followed by its element's type u8 and size u32, and by what that is made of; a record by its
//! fields, each a variable. In a block a list is `[count u32][body u32]` and its elements, each padded to 8 bytes; a record is
//! its fields in order. Values lie in a `Parameters` as in a block, so that sending one copies it, and reading one needs no
//! memory: [`Elements`] and [`Fields`] walk over the bytes.
//!
//! What is recursive here is at most [`DEPTH`] deep, since signatures are checked before they are stored.

use core::fmt;

use super::block::{is_canonical, padding_after, split};
use super::function::{RawSpec, VariableSpec, VariableSpecs};
use super::name::check_name;
use super::parameters::Variable;
use super::value::{Type, Value, saturate};
use crate::config::DEPTH;
use crate::error::{Error, Limit};

/// Bytes of an element's type and size.
const ELEMENT_HEAD: usize = 5;
/// Bytes of a list's count and of the length of its body.
pub(super) const LIST_HEAD: usize = 8;

impl<'a> RawSpec<'a> {
    /// What the elements of a list are.
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

/// The type and size of an element, and what follows them.
pub(super) const fn split_element(bytes: &[u8]) -> Option<(Type, u32, &[u8])> {
    let Some((&[kind, size @ ..], rest)) = bytes.split_first_chunk::<ELEMENT_HEAD>() else { return None };
    let Some(kind) = Type::from_wire(kind) else { return None };
    Some((kind, u32::from_le_bytes(size), rest))
}

/// What follows the insides of a list or record, which begin at `rest`. Each turn takes bytes, so it ends.
pub(super) fn behind(mut kind: Type, mut size: u32, mut rest: &[u8]) -> Option<&[u8]> {
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

/// The insides of a list or record, and what follows them.
pub(super) fn split_inner(kind: Type, size: u32, bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let rest = behind(kind, size, bytes)?;
    bytes.split_at_checked(bytes.len().checked_sub(rest.len())?)
}

/// Checks what a variable of a signature is made of: depth, names, and that an element takes bytes, since a count of
/// elements that take none would cost its sender nothing.
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

/// Bytes of the shortest value in a block: numbers as they are, texts and lists empty. All of them are zero.
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

/// Bytes of the longest value in a block; `None` where that exceeds the address space.
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
    /// Those of texts, bytes and lists may differ: the value tells whether it fits.
    Free,
    /// Those of the first are at most those of the second, so that every value fits.
    Fit,
}

/// Whether a value of the one type can be one of the other.
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

/// A type and its size; `None` where there is none.
type Shape = Option<(Type, u32)>;

/// Where in a variable two units differ: adds the way to it, and returns what each has there. A way without room ends at a
/// name.
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
        // What is behind a name without room is left out as well: it would seem to be in what stands before.
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

/// Whether the peer's field can be ours, where both are.
fn is_same_field((ours, theirs): (Option<RawSpec<'_>>, Option<RawSpec<'_>>), bounds: Bounds) -> bool {
    let (Some(ours), Some(theirs)) = (ours, theirs) else { return false };
    // An argument goes there, a result comes from there.
    let (from, to) = if bounds == Bounds::Free { (ours, theirs) } else { (theirs, ours) };
    from.name == to.name && can_be(from, to, bounds)
}

/// Whether a value of a list or record can be sent or stored as `spec`, and the bytes that it takes.
pub(super) fn measure(spec: RawSpec<'_>, value: Value<'_>, index: u8) -> Result<usize, Error> {
    if value.size != spec.size || value.inner != spec.inner {
        let own = RawSpec { name: &[], kind: value.kind, size: value.size, inner: value.inner };
        if !can_be(own, spec, Bounds::Free) {
            return Err(Error::WrongType { index });
        }
        if check(spec, value.bytes).is_none_or(|(_, rest)| !rest.is_empty()) {
            // Of a list that has too many elements their count, and not how many it may have.
            let found = match split_list(value.bytes) {
                Some((count, ..)) if spec.kind == Type::List && count > spec.size => count,
                _ => value.size,
            };
            return Err(Error::WrongSize { index, expected: spec.size, found });
        }
    }
    Ok(value.bytes.len())
}

/// A list or record that has begun and not ended.
enum Open<'s> {
    /// A list: elements that are still to come, and how many bytes are left behind its body.
    List {
        left: u32,
        element: RawSpec<'s>,
        behind: usize,
    },
    Record(VariableSpecs<'s>),
}

/// The list or record at the start of a block, all of it checked, and what follows it. `None` if it is malformed.
pub(super) fn check<'b>(spec: RawSpec<'_>, block: &'b [u8]) -> Option<(&'b [u8], &'b [u8])> {
    walk(spec, block, true)
}

/// The same in bytes that were checked: bodies of lists are passed over.
pub(super) fn extent<'b>(spec: RawSpec<'_>, block: &'b [u8]) -> Option<(&'b [u8], &'b [u8])> {
    walk(spec, block, false)
}

fn walk<'b>(spec: RawSpec<'_>, block: &'b [u8], checks: bool) -> Option<(&'b [u8], &'b [u8])> {
    let mut open: heapless::Vec<Open<'_>, DEPTH> = heapless::Vec::new();
    let (mut next, mut rest) = (spec, block);
    loop {
        match next.kind {
            Type::List => {
                let (count, body);
                (count, body, rest) = split_list(rest)?;
                let behind = rest.len().checked_sub(body)?;
                let element = next.element()?;
                if !checks {
                    rest = rest.get(body..)?;
                } else {
                    // A count that lies is found here, before anything is done as often as it says.
                    let fits =
                        count == 0 || least(element).checked_mul(count as usize).is_some_and(|least| least <= body);
                    if count > next.size || !body.is_multiple_of(8) || !fits {
                        return None;
                    }
                    open.push(Open::List { left: count, element, behind }).ok()?;
                }
            }
            Type::Record => open.push(Open::Record(next.fields())).ok()?,
            kind => {
                let value;
                (value, rest) = split(next, rest)?;
                if checks && !is_canonical(kind, value) {
                    return None;
                }
            }
        }
        next = loop {
            match open.last_mut() {
                None => return block.split_at_checked(block.len().checked_sub(rest.len())?),
                Some(Open::List { left, element, behind }) => match left.checked_sub(1) {
                    Some(fewer) => {
                        *left = fewer;
                        break *element;
                    }
                    None if rest.len() != *behind => return None,
                    None => {}
                },
                Some(Open::Record(fields)) => {
                    if let Some(field) = fields.next_raw() {
                        break field;
                    }
                }
            }
            open.pop();
        };
    }
}

/// Count and length of the body at the start of a list, and what follows them.
fn split_list(bytes: &[u8]) -> Option<(u32, usize, &[u8])> {
    let (count, rest) = bytes.split_first_chunk::<4>()?;
    let (body, rest) = rest.split_first_chunk::<4>()?;
    Some((u32::from_le_bytes(*count), u32::from_le_bytes(*body) as usize, rest))
}

/// The value at the start of checked bytes, without its padding, and what follows it.
fn take<'a>(spec: RawSpec<'a>, bytes: &'a [u8], index: u8) -> Option<(Value<'a>, &'a [u8])> {
    let (value, rest) = if spec.kind.is_nested() { extent(spec, bytes)? } else { split(spec, bytes)? };
    Some((Value { index, kind: spec.kind, size: spec.size, inner: spec.inner, bytes: value }, rest))
}

/// The elements of a list, in order.
#[derive(Clone, Debug)]
pub struct Elements<'a> {
    left: u32,
    element: RawSpec<'a>,
    rest: &'a [u8],
    index: u8,
}

impl Elements<'_> {
    /// How many are left.
    pub const fn len(&self) -> u32 {
        self.left
    }

    /// Whether none is left.
    pub const fn is_empty(&self) -> bool {
        self.left == 0
    }
}

impl<'a> Iterator for Elements<'a> {
    type Item = Value<'a>;

    fn next(&mut self) -> Option<Value<'a>> {
        self.left = self.left.checked_sub(1)?;
        let (value, rest) = take(self.element, self.rest, self.index)?;
        self.rest = rest;
        Some(value)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (0, Some(self.left as usize))
    }
}

/// The fields of a record, in order.
#[derive(Clone, Debug)]
pub struct Fields<'a> {
    specs: VariableSpecs<'a>,
    rest: &'a [u8],
    index: u8,
}

impl<'a> Iterator for Fields<'a> {
    type Item = Variable<'a>;

    fn next(&mut self) -> Option<Variable<'a>> {
        let spec = self.specs.next_raw()?;
        let (value, rest) = take(spec, self.rest, self.index)?;
        self.rest = rest;
        let name = core::str::from_utf8(spec.name).ok()?;
        Some(Variable { name, kind: spec.kind, size: spec.size, value })
    }
}

impl<'a> Value<'a> {
    /// The elements of a list; none for another type.
    pub fn elements(&self) -> Elements<'a> {
        let element = self.raw_spec().element();
        let list = element.and_then(|element| Some((element, split_list(self.bytes)?)));
        match list {
            Some((element, (left, _, rest))) => Elements { left, element, rest, index: self.index },
            None => Elements { left: 0, element: self.raw_spec(), rest: &[], index: self.index },
        }
    }

    /// The fields of a record; none for another type.
    pub fn fields(&self) -> Fields<'a> {
        Fields { specs: self.raw_spec().fields(), rest: self.bytes, index: self.index }
    }

    /// The field of this name; [`Error::UnknownVariable`] where there is none.
    pub fn field(&self, name: &str) -> Result<Value<'a>, Error> {
        self.fields().find(|field| field.name == name).map(|field| field.value).ok_or(Error::UnknownVariable)
    }

    pub(super) const fn raw_spec(&self) -> RawSpec<'a> {
        RawSpec { name: &[], kind: self.kind, size: self.size, inner: self.inner }
    }
}

/// The text form of a type: `int[2]`, `{x: float}[..8]`.
pub(super) fn show(f: &mut fmt::Formatter<'_>, spec: RawSpec<'_>) -> fmt::Result {
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
        return write!(f, "[..{}]", spec.size);
    }
    f.write_str("{")?;
    for (index, field) in spec.fields().raw().enumerate() {
        let comma = if index > 0 { ", " } else { "" };
        write!(f, "{comma}{}: ", core::str::from_utf8(field.name).unwrap_or_default())?;
        show_at(f, field, deeper)?;
    }
    f.write_str("}")
}

/// `length` elements or bytes as a list's head has them.
pub(super) fn list_head(count: u32, body: usize) -> [u8; LIST_HEAD] {
    (u64::from(count) | u64::from(saturate(body)).wrapping_shl(32)).to_le_bytes()
}

#[cfg(test)]
#[cfg(feature = "nested")]
mod tests;
