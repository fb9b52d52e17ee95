//! Values in a block: where each ends, and the contents of lists and records.
//!
//! In a block a list is `[count u32][body u32]` and its elements, each padded to 8 bytes; a record is its fields in order. A
//! `Parameters` stores them in the same layout, so sending copies bytes and reading needs no memory: [`Elements`] and [`Fields`]
//! iterate over the bytes.
//!
//! Recursion here is at most [`DEPTH`] deep, since signatures are checked before they are stored.

use super::spec::{Bounds, LIST_HEAD, RawSpec, VariableSpec, VariableSpecs, can_be, least, padding_after};
use super::value::{Type, Value, Variable, saturate};
use crate::bytes::is_text;
use crate::config::DEPTH;
use crate::error::Error;

/// The value at the start of `block`, and what follows; `None` if it is cut off, too long or not padded with zeros.
pub(super) fn split<'b>(spec: RawSpec<'_>, block: &'b [u8]) -> Option<(&'b [u8], &'b [u8])> {
    let (length, rest) = if spec.kind.is_fixed() {
        (spec.kind.bytes_of(spec.size)?, block)
    } else {
        let (&head, rest) = block.split_first_chunk::<8>()?;
        // The upper half has to be zero, so that a longer value fails here.
        let length = u32::try_from(u64::from_le_bytes(head)).ok().filter(|&length| length <= spec.size)?;
        (length as usize, rest)
    };
    let (value, rest) = rest.split_at_checked(length)?;
    let (padding, rest) = rest.split_at_checked(padding_after(length))?;
    padding.iter().all(|&byte| byte == 0).then_some((value, rest))
}

pub(super) fn is_canonical(kind: Type, value: &[u8]) -> bool {
    match kind {
        Type::String => is_text(value),
        Type::Bool => value.iter().all(|&byte| byte <= 1),
        Type::Int | Type::Float | Type::Bytes | Type::List | Type::Record => true,
    }
}

/// Whether a value of a list or record can be sent or stored as `spec`; returns its size in bytes.
pub(super) fn measure(spec: RawSpec<'_>, value: Value<'_>, index: u8) -> Result<usize, Error> {
    if value.size != spec.size || value.inner != spec.inner {
        let own = RawSpec { name: &[], kind: value.kind, size: value.size, inner: value.inner };
        if !can_be(own, spec, Bounds::Free) {
            return Err(Error::WrongType { index });
        }
        if check(spec, value.bytes).is_none_or(|(_, rest)| !rest.is_empty()) {
            // If the list is too long, report its count of elements, not its declared size.
            let found = match split_list(value.bytes) {
                Some((count, ..)) if spec.kind == Type::List && count > spec.size => count,
                _ => value.size,
            };
            return Err(Error::WrongSize { index, expected: spec.size, found });
        }
    }
    Ok(value.bytes.len())
}

/// A list or record that is being walked.
enum Open<'s> {
    /// A list: the elements left, and the bytes that follow its body.
    List {
        left: u32,
        element: RawSpec<'s>,
        behind: usize,
    },
    Record(VariableSpecs<'s>),
}

/// Checks the list or record at the start of a block; returns it and what follows, or `None` if it is malformed.
pub(super) fn check<'b>(spec: RawSpec<'_>, block: &'b [u8]) -> Option<(&'b [u8], &'b [u8])> {
    walk(spec, block, true)
}

/// The same for checked bytes: skips the bodies of lists.
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
                    // Detect a false count here, before it causes as many steps.
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

/// Count, length of the body, and the bytes that follow, at the start of a list.
fn split_list(bytes: &[u8]) -> Option<(u32, usize, &[u8])> {
    let (count, rest) = bytes.split_first_chunk::<4>()?;
    let (body, rest) = rest.split_first_chunk::<4>()?;
    Some((u32::from_le_bytes(*count), u32::from_le_bytes(*body) as usize, rest))
}

/// The value at the start of checked bytes, without its padding, and what follows.
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
    /// How many elements are left.
    pub const fn len(&self) -> u32 {
        self.left
    }

    /// Whether no elements are left.
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
    /// The elements of a list; none for other types.
    pub fn elements(&self) -> Elements<'a> {
        let element = self.raw_spec().element();
        let list = element.and_then(|element| Some((element, split_list(self.bytes)?)));
        match list {
            Some((element, (left, _, rest))) => Elements { left, element, rest, index: self.index },
            None => Elements { left: 0, element: self.raw_spec(), rest: &[], index: self.index },
        }
    }

    /// The fields of a record; none for other types.
    pub fn fields(&self) -> Fields<'a> {
        Fields { specs: self.raw_spec().fields(), rest: self.bytes, index: self.index }
    }

    /// The field with this name; [`Error::UnknownVariable`] if there is none.
    pub fn field(&self, name: &str) -> Result<Value<'a>, Error> {
        self.fields().find(|field| field.name == name).map(|field| field.value).ok_or(Error::UnknownVariable)
    }

    /// Its type, as a variable without a name.
    pub const fn spec(&self) -> VariableSpec<'a> {
        VariableSpec { name: "", kind: self.kind, size: self.size, inner: self.inner }
    }

    pub(super) const fn raw_spec(&self) -> RawSpec<'a> {
        RawSpec { name: &[], kind: self.kind, size: self.size, inner: self.inner }
    }
}

/// The encoded head of a list.
pub(super) fn list_head(count: u32, body: usize) -> [u8; LIST_HEAD] {
    (u64::from(count) | u64::from(saturate(body)).wrapping_shl(32)).to_le_bytes()
}

#[cfg(test)]
#[cfg(feature = "nested")]
mod tests;
