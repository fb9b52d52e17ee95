//! Extensible lists: hello, who-has, announce and control messages consist of items; readers skip those that they do not know.
//!
//! | bytes | meaning |
//! |---|---|
//! | 0–1 | kind, little-endian; bit 15: the reader must understand it. 0 is padding |
//! | 2–3 | length of the body |
//! | 4– | the body; zeros up to a multiple of 4 |
//!
//! A body may be longer than its reader knows, which ignores the rest. A shorter one is malformed.

use super::compact::Reader;

/// Kinds of items in hello, who-has and announce. They share one namespace, so that a kind has one meaning.
pub(super) mod kind {
    /// Identity and epoch of the sender.
    pub(in crate::distribution) const UNIT: u16 = 1;
    /// The manager that the sender belongs to, or searches for.
    pub(in crate::distribution) const WANTED: u16 = 2;
    /// The session's parameters of this link.
    pub(in crate::distribution) const LINK: u16 = 3;
    /// The sender's limits.
    pub(in crate::distribution) const LIMITS: u16 = 4;
    /// A search.
    pub(in crate::distribution) const SEARCH: u16 = 5;
    /// Connected nodes, which need not answer.
    pub(in crate::distribution) const KNOWN: u16 = 6;
    /// An answer.
    pub(in crate::distribution) const ANSWER: u16 = 7;
    /// The claim of a manager.
    pub(in crate::distribution) const CLAIM: u16 = 8;
    /// The highest claim of the reader's identity that the sender has obeyed.
    pub(in crate::distribution) const OBEYED: u16 = 9;
    /// The sender stands by: it answers nobody and accepts no links.
    pub(in crate::distribution) const STANDBY: u16 = 10;
}

/// Every item begins at a multiple of this, relative to the first.
pub(crate) const ALIGNMENT: usize = 4;
/// Length of kind and length.
const HEADER_BYTES: usize = 4;
/// Set in the kind of an item that a reader must not skip.
const MUST_UNDERSTAND: u16 = 1 << 15;
/// The kind of padding.
const ROOM: u16 = 0;

/// One item.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Item<'b> {
    /// The kind, including the bit for items that must be understood.
    pub kind: u16,
    /// The content.
    pub body: &'b [u8],
}

/// The bytes are not a list of items.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Malformed;

impl<'b> Item<'b> {
    /// Reads fields from the front of the body, and ignores the rest, which is of a later version.
    pub(crate) fn read<T>(&self, read: impl FnOnce(&mut Reader<'b>) -> T) -> Result<T, Malformed> {
        let mut reader = Reader::new(self.body);
        let value = read(&mut reader);
        if reader.is_sound() { Ok(value) } else { Err(Malformed) }
    }

    /// Skips an item of an unknown kind and counts it in `skipped`; an error if it must be understood.
    pub(crate) fn skip(&self, skipped: &mut u16) -> Result<(), Malformed> {
        if self.kind & MUST_UNDERSTAND != 0 {
            return Err(Malformed);
        }
        *skipped = skipped.saturating_add(1);
        Ok(())
    }
}

/// Iterates over a list of items. Ends after an error.
#[derive(Clone, Debug)]
pub struct Items<'b> {
    rest: &'b [u8],
}

impl<'b> Items<'b> {
    /// The items in `bytes`.
    pub const fn new(bytes: &'b [u8]) -> Self {
        Self { rest: bytes }
    }

    /// The bytes of the remaining items.
    pub(crate) const fn rest(&self) -> &'b [u8] {
        self.rest
    }
}

impl<'b> Iterator for Items<'b> {
    type Item = Result<Item<'b>, Malformed>;

    #[cfg_attr(target_os = "none", inline(never))]
    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let bytes = core::mem::take(&mut self.rest);
            if bytes.is_empty() {
                return None;
            }
            let Some((item, rest)) = split(bytes) else { return Some(Err(Malformed)) };
            self.rest = rest;
            if item.kind != ROOM {
                return Some(Ok(item));
            }
        }
    }
}

fn split(bytes: &[u8]) -> Option<(Item<'_>, &[u8])> {
    let (&[k0, k1, l0, l1], rest) = bytes.split_first_chunk::<HEADER_BYTES>()?;
    let length = usize::from(u16::from_le_bytes([l0, l1]));
    let (padded, rest) = rest.split_at_checked(length.next_multiple_of(ALIGNMENT))?;
    Some((Item { kind: u16::from_le_bytes([k0, k1]), body: padded.get(..length)? }, rest))
}

/// Pads the `length` bytes in `out` to `whole`, both multiples of four; returns the new length.
pub(crate) fn fill(length: usize, whole: usize, out: &mut [u8]) -> Option<usize> {
    let Some(room) = whole.checked_sub(length).filter(|room| *room >= HEADER_BYTES) else { return Some(length) };
    let (header, zeros) = out.get_mut(length..whole)?.split_first_chunk_mut::<HEADER_BYTES>()?;
    let [l0, l1] = u16::try_from(room.saturating_sub(HEADER_BYTES)).ok()?.to_le_bytes();
    *header = [0, 0, l0, l1];
    zeros.fill(0);
    Some(whole)
}

/// A list of items of these kinds, each with a body that `put` makes.
#[cfg(test)]
pub(crate) fn list<B: Copy>(items: &[(u16, B)], put: impl Fn(&mut super::compact::Writer<'_>, B)) -> std::vec::Vec<u8> {
    let mut out = [0xAA; 600];
    let mut writer = super::compact::Writer::new(&mut out);
    for (kind, body) in items {
        let item = writer.begin(*kind);
        put(&mut writer, *body);
        writer.end(item);
    }
    let used = writer.finish().unwrap_or(0);
    out.get(..used).unwrap_or(&[]).to_vec()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::arithmetic_side_effects)]
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    fn list(items: &[(u16, &[u8])]) -> Vec<u8> {
        super::list(items, |writer, body| writer.bytes(body))
    }

    #[test]
    fn items_travel() {
        let bytes = list(&[(1, &[1, 2, 3]), (0, &[9; 7]), (0x8002, &[]), (3, &[4; 4])]);
        assert_eq!(bytes.len(), 8 + 12 + 4 + 8);
        assert_eq!(bytes[..8], [1, 0, 3, 0, 1, 2, 3, 0]);
        let items: Vec<_> = Items::new(&bytes).map(|item| item.unwrap()).map(|item| (item.kind, item.body)).collect();
        assert_eq!(items, [(1, &[1, 2, 3][..]), (0x8002, &[]), (3, &[4; 4])]);
    }

    #[test]
    fn a_longer_body_is_read_and_a_shorter_one_is_malformed() {
        let item = Item { kind: 1, body: &[1, 0, 7] };
        assert_eq!(item.read(|reader| (reader.u16(), reader.flag())), Ok((1, false)));
        assert_eq!(item.read(|reader| reader.bytes(4)), Err(Malformed));
    }

    #[test]
    fn only_what_must_be_understood_is_not_skipped() {
        let mut skipped = 0;
        assert_eq!(Item { kind: 77, body: &[] }.skip(&mut skipped), Ok(()));
        assert_eq!(Item { kind: 77 | MUST_UNDERSTAND, body: &[] }.skip(&mut skipped), Err(Malformed));
        assert_eq!(skipped, 1);
    }

    #[test]
    fn room_fills_up_to_a_length() {
        let mut out = [0xAA; 40];
        assert_eq!(fill(8, 20, &mut out), Some(20));
        assert_eq!(out[8..21], [0, 0, 8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xAA]);
        assert!(Items::new(&out[8..20]).next().is_none());
        assert_eq!(
            (fill(20, 20, &mut out), fill(24, 20, &mut out), fill(36, 44, &mut out)),
            (Some(20), Some(24), None)
        );
    }

    proptest! {
        #[test]
        fn whatever_the_bytes_are_the_list_ends(bytes in prop::collection::vec(prop_oneof![any::<u8>(), 0..6_u8], 0..80)) {
            let items = Items::new(&bytes).collect::<Vec<_>>();
            prop_assert!(items.len() <= bytes.len() / HEADER_BYTES + 1);
            prop_assert!(items.iter().rev().skip(1).all(Result::is_ok), "nothing follows an error");
        }

        #[test]
        fn every_cut_between_two_items_is_seen(bodies in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..20), 1..5)) {
            let items: Vec<(u16, &[u8])> = bodies.iter().map(|body| (1, &body[..])).collect();
            let bytes = list(&items);
            prop_assert_eq!(Items::new(&bytes).filter(Result::is_ok).count(), bodies.len());
            prop_assert!(Items::new(&bytes[..bytes.len() - 1]).any(|item| item.is_err()));
        }
    }
}
