//! The [postcard](https://postcard.jamesmunns.com/wire-format) format, encoded by hand: numbers as varints, texts and lists after
//! their length, one byte for a choice. What serde derives takes far more flash; tests compare the two.
//!
//! Neither direction stops at the first error: it is recorded, and returned at the end.

use super::items::ALIGNMENT;
use crate::config::NODE_NAME_BYTES;

/// Writes values in sequence.
pub(crate) struct Writer<'o> {
    out: &'o mut [u8],
    used: usize,
    fits: bool,
}

impl<'o> Writer<'o> {
    pub(crate) const fn new(out: &'o mut [u8]) -> Self {
        Self { out, used: 0, fits: true }
    }

    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn byte(&mut self, byte: u8) {
        match self.out.get_mut(self.used) {
            Some(place) => *place = byte,
            None => self.fits = false,
        }
        self.used = self.used.saturating_add(1);
    }

    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.byte(*byte);
        }
    }

    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn number(&mut self, value: u64) {
        let mut rest = value;
        while rest >= 0x80 {
            self.byte(rest as u8 | 0x80);
            rest >>= 7;
        }
        self.byte(rest as u8);
    }

    pub(crate) fn numbers(&mut self, values: &[u32]) {
        for value in values {
            self.number((*value).into());
        }
    }

    pub(crate) fn flag(&mut self, flag: bool) {
        self.byte(flag.into());
    }

    /// A text or bytes, after their length.
    pub(crate) fn text(&mut self, text: &[u8]) {
        self.number(text.len() as u64);
        self.bytes(text);
    }

    /// Begins an item of an extensible list (see [`items`](super::items)); pass the returned offset to [`end`](Self::end).
    pub(crate) fn begin(&mut self, kind: u16) -> usize {
        self.bytes(&kind.to_le_bytes());
        self.bytes(&[0, 0]);
        self.used
    }

    /// Ends the item whose body begins at `start`: fills in its length, and appends padding.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn end(&mut self, start: usize) {
        let length = self.used.saturating_sub(start);
        let place = self.out.get_mut(start.saturating_sub(2)..).and_then(|out| out.first_chunk_mut());
        match (u16::try_from(length), place) {
            (Ok(length), Some(place)) => *place = length.to_le_bytes(),
            _ => self.fits = false,
        }
        for _ in length..length.next_multiple_of(ALIGNMENT) {
            self.byte(0);
        }
    }

    /// How many bytes were written; `None` if they did not fit.
    pub(crate) const fn finish(self) -> Option<usize> {
        if self.fits { Some(self.used) } else { None }
    }
}

/// Reads values in sequence. After an error all values are zero.
pub(crate) struct Reader<'b> {
    rest: &'b [u8],
    sound: bool,
}

impl<'b> Reader<'b> {
    pub(crate) const fn new(bytes: &'b [u8]) -> Self {
        Self { rest: bytes, sound: true }
    }

    /// Records an error.
    #[cold]
    pub(crate) fn fail(&mut self) {
        self.sound = false;
        self.rest = &[];
    }

    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn byte(&mut self) -> u8 {
        match self.rest.split_first() {
            Some((byte, rest)) => {
                self.rest = rest;
                *byte
            }
            None => {
                self.fail();
                0
            }
        }
    }

    pub(crate) fn bytes(&mut self, count: usize) -> &'b [u8] {
        match self.rest.split_at_checked(count) {
            Some((bytes, rest)) => {
                self.rest = rest;
                bytes
            }
            None => {
                self.fail();
                &[]
            }
        }
    }

    /// A number that fits this many bits.
    #[cfg_attr(target_os = "none", inline(never))]
    fn number(&mut self, bits: u32) -> u64 {
        let (mut value, mut shift) = (0_u64, 0_u32);
        while shift < bits {
            let byte = self.byte();
            let part = u64::from(byte & 0x7F);
            if part.checked_shr(bits.saturating_sub(shift)).unwrap_or(0) != 0 {
                break;
            }
            value |= part.checked_shl(shift).unwrap_or(0);
            if byte & 0x80 == 0 {
                return value;
            }
            shift = shift.saturating_add(7);
        }
        self.fail();
        0
    }

    pub(crate) fn u16(&mut self) -> u16 {
        self.number(u16::BITS) as u16
    }

    pub(crate) fn u32(&mut self) -> u32 {
        self.number(u32::BITS) as u32
    }

    pub(crate) fn u64(&mut self) -> u64 {
        self.number(u64::BITS)
    }

    pub(crate) fn length(&mut self) -> usize {
        self.number(usize::BITS) as usize
    }

    pub(crate) fn flag(&mut self) -> bool {
        let byte = self.byte();
        if byte > 1 {
            self.fail();
        }
        byte == 1
    }

    /// A text or bytes, after their length.
    pub(crate) fn text(&mut self) -> &'b [u8] {
        let length = self.length();
        self.bytes(length)
    }

    /// The name of a node.
    pub(crate) fn name(&mut self) -> heapless::String<NODE_NAME_BYTES> {
        let name = core::str::from_utf8(self.text()).ok().and_then(|name| heapless::String::try_from(name).ok());
        name.unwrap_or_else(|| {
            self.fail();
            heapless::String::new()
        })
    }

    /// Whether everything requested could be read. Bytes of a later version may be left.
    pub(crate) const fn is_sound(&self) -> bool {
        self.sound
    }

    /// How many bytes are left.
    #[cfg(test)]
    pub(crate) const fn left(&self) -> usize {
        self.rest.len()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing)]
    use super::*;
    use proptest::prelude::*;

    fn read<'b, T>(bytes: &'b [u8], read: impl FnOnce(&mut Reader<'b>) -> T) -> Option<T> {
        let mut reader = Reader::new(bytes);
        let value = read(&mut reader);
        (reader.is_sound() && reader.left() == 0).then_some(value)
    }

    fn whole<'b, T: serde::Deserialize<'b>>(bytes: &'b [u8]) -> Option<T> {
        postcard::take_from_bytes(bytes).ok().and_then(|(value, rest)| rest.is_empty().then_some(value))
    }

    proptest! {
        #[test]
        fn numbers_are_written_as_postcard_writes_them(value: u64, shift in 0..64_u32) {
            let value = value >> shift;
            let (mut ours, mut theirs) = ([0; 10], [0; 10]);
            let mut writer = Writer::new(&mut ours);
            writer.number(value);
            let used = writer.finish().unwrap();
            prop_assert_eq!(&ours[..used], &*postcard::to_slice(&value, &mut theirs).unwrap());
        }

        #[test]
        fn whatever_is_read_postcard_reads_as_well(bytes in prop::collection::vec(
            prop_oneof![any::<u8>(), Just(0xFF_u8), Just(0x80), 0..4_u8], 0..12,
        )) {
            prop_assert_eq!(read(&bytes, Reader::u16), whole(&bytes));
            prop_assert_eq!(read(&bytes, Reader::u32), whole(&bytes));
            prop_assert_eq!(read(&bytes, Reader::u64), whole(&bytes));
            prop_assert_eq!(read(&bytes, Reader::length), whole(&bytes));
            prop_assert_eq!(read(&bytes, Reader::flag), whole(&bytes));
            prop_assert_eq!(read(&bytes, Reader::text), whole(&bytes));
            prop_assert_eq!(read(&bytes, Reader::name), whole(&bytes));
        }
    }

    #[test]
    fn what_does_not_fit_is_told() {
        let mut out = [0; 3];
        let mut writer = Writer::new(&mut out);
        writer.text(b"abc");
        assert_eq!(writer.finish(), None);
    }
}
