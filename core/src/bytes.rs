//! Byte operations that cannot panic: those of slices panic if lengths differ, and the optimiser cannot always exclude that.

use core::ops::Range;

/// Copies slices of equal length; does nothing if the lengths differ.
#[inline]
pub(crate) fn copy(from: &[u8], to: &mut [u8]) {
    if from.len() == to.len() {
        to.copy_from_slice(from);
    }
}

/// Whether two names are equal. Compares words: the `memcmp` of boards compares bytes.
pub(crate) fn are_same(one: &[u8], other: &[u8]) -> bool {
    let ((words, rest), (other_words, other_rest)) = (one.as_chunks::<4>(), other.as_chunks::<4>());
    let same = |(one, other): (&[u8; 4], &[u8; 4])| u32::from_ne_bytes(*one) == u32::from_ne_bytes(*other);
    one.len() == other.len()
        && words.iter().zip(other_words).all(same)
        && rest.iter().zip(other_rest).all(|(one, other)| one == other)
}

/// The bytes as text, if they are UTF-8.
pub(crate) fn as_text(bytes: &[u8]) -> Option<&str> {
    #[cfg(feature = "simd")]
    let text = simdutf8::basic::from_utf8(bytes);
    #[cfg(not(feature = "simd"))]
    let text = core::str::from_utf8(bytes);
    text.ok()
}

/// Whether the bytes are UTF-8, with a fast path for ASCII. Not inlined, because its loop would run out of registers.
#[inline(never)]
pub(crate) fn is_text(bytes: &[u8]) -> bool {
    (cfg!(not(feature = "simd")) && bytes.is_ascii()) || as_text(bytes).is_some()
}

/// Moves the bytes of `range` to the front; does nothing if the range is out of bounds.
pub(crate) fn move_down(bytes: &mut [u8], range: Range<usize>) {
    if range.start <= range.end && range.end <= bytes.len() {
        bytes.copy_within(range, 0);
    }
}

/// Moves the last `count` bytes to the front, in order; does nothing if there are fewer.
pub(crate) fn rotate_up(bytes: &mut [u8], count: usize) {
    let Some((front, back)) = bytes.len().checked_sub(count).and_then(|at| bytes.split_at_mut_checked(at)) else {
        return;
    };
    front.reverse();
    back.reverse();
    bytes.reverse();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_lengths_are_copied_and_others_left_alone() {
        let mut to = [0; 3];
        copy(&[1, 2], &mut to);
        assert_eq!(to, [0; 3]);
        copy(&[1, 2, 3], &mut to);
        assert_eq!(to, [1, 2, 3]);
    }

    #[test]
    fn a_range_inside_moves_and_others_leave_the_bytes_alone() {
        let mut bytes = [1, 2, 3, 4, 5];
        move_down(&mut bytes, 3..6);
        move_down(&mut bytes, Range { start: 4, end: 3 });
        assert_eq!(bytes, [1, 2, 3, 4, 5]);
        move_down(&mut bytes, 1..5);
        assert_eq!(bytes, [2, 3, 4, 5, 5]);
    }

    #[test]
    fn the_last_bytes_come_to_the_front_and_more_than_all_leave_them_alone() {
        let mut bytes = [1, 2, 3, 4, 5];
        rotate_up(&mut bytes, 6);
        rotate_up(&mut bytes, 0);
        rotate_up(&mut bytes, 5);
        assert_eq!(bytes, [1, 2, 3, 4, 5]);
        rotate_up(&mut bytes, 2);
        assert_eq!(bytes, [4, 5, 1, 2, 3]);
    }
}
