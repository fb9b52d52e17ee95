//! Boxed slices: the core's tables and buffers, sized when the unit starts.

use cara_core::storage::Storage;

/// Names boxed slices as the kind of storage of a state machine.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Boxed {}

impl Storage for Boxed {
    type Slice<T: 'static> = Box<[T]>;

    fn lengthen<T: 'static>(slice: &mut Box<[T]>, length: usize, value: impl FnMut() -> T) {
        let mut values = std::mem::take(slice).into_vec();
        values.reserve_exact(length.saturating_sub(values.len()));
        values.resize_with(length.max(values.len()), value);
        *slice = values.into_boxed_slice();
    }
}

/// A slice of `length` copies of `value`.
pub(crate) fn filled<T: Clone>(length: usize, value: T) -> Box<[T]> {
    vec![value; length].into_boxed_slice()
}

/// A slice of `length` values, each made by `value`; for types that cannot be cloned.
pub(crate) fn filled_with<T>(length: usize, value: impl FnMut() -> T) -> Box<[T]> {
    std::iter::repeat_with(value).take(length).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slices_have_the_length_asked_for() {
        assert_eq!(*filled(3, 7u8), [7, 7, 7]);
        let mut next = 0;
        let counted = filled_with(3, || {
            next += 1;
            next
        });
        assert_eq!(*counted, [1, 2, 3]);
        assert!(filled(0, 1u64).is_empty());
    }
}
