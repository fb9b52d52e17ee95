//! Where tables and buffers are: lent by the port and sized at run time, so that no size is a type parameter of the machines.
//!
//! A state machine names the *kind* of storage (`S: Storage`); its provider chooses the length of each slice: statics on a board
//! ([`Lent`]), boxed slices on Linux and in the simulator (a type of the port).

use core::ops::DerefMut;

/// A kind of owned slice. Two exist: [`Lent`] here and boxed slices in ports that have an allocator.
pub trait Storage: 'static {
    /// An owned slice of `T`.
    type Slice<T: 'static>: DerefMut<Target = [T]>;

    /// Lengthens a slice, filling it up with `value`s; does nothing without an allocator.
    fn lengthen<T: 'static>(slice: &mut Self::Slice<T>, length: usize, value: impl FnMut() -> T) {
        let _ = (slice, length, value);
    }
}

/// Slices lent for `'static`, as from a `static` on a board.
#[derive(Debug, Clone, Copy)]
pub enum Lent {}

impl Storage for Lent {
    type Slice<T: 'static> = &'static mut [T];
}

/// Boxed slices, for the core's own tests.
#[cfg(test)]
#[derive(Debug, Clone, Copy)]
pub(crate) enum Boxed {}

#[cfg(test)]
impl Storage for Boxed {
    type Slice<T: 'static> = std::boxed::Box<[T]>;

    fn lengthen<T: 'static>(slice: &mut Self::Slice<T>, length: usize, value: impl FnMut() -> T) {
        let mut values = core::mem::take(slice).into_vec();
        values.resize_with(length.max(values.len()), value);
        *slice = values.into();
    }
}

/// Removes an element; the last one takes its place. `None` if the index is out of bounds, where the list's own method panics.
#[inline]
pub(crate) fn take_at<T, const N: usize>(list: &mut heapless::Vec<T, N>, index: usize) -> Option<T> {
    (index < list.len()).then(|| list.swap_remove(index))
}

/// A buffer for one whole message, taken from a [`Buffers`] pool and returned to it.
pub type Buffer<S> = <S as Storage>::Slice<u8>;

/// The bounded pool of full message buffers that all links of a unit share.
///
/// If several threads share one pool, the port's implementation locks.
pub trait Buffers<S: Storage> {
    /// Takes a buffer; `None` if all are in use, which the caller counts and reports.
    fn take(&mut self) -> Option<Buffer<S>>;
    /// Returns a buffer.
    fn give(&mut self, buffer: Buffer<S>);
    /// Takes a buffer out of the pool if at least `left` others remain in it.
    fn take_leaving(&mut self, left: usize) -> Option<Buffer<S>> {
        let buffer = self.take()?;
        if left == 0 {
            return Some(buffer);
        }
        match self.take_leaving(left.saturating_sub(1)) {
            Some(other) => {
                self.give(other);
                Some(buffer)
            }
            None => {
                self.give(buffer);
                None
            }
        }
    }
}

/// How many buffers sending leaves in the pool: two units that are full of messages to each other can still read.
pub const LEFT_BY_SENDING: usize = 1;
/// How many buffers waiting calls leave in the pool: they proceed only when answers are sent, which need one.
pub const LEFT_BY_WAITING: usize = 2;

/// A pool over lent slots, for single-threaded ports.
pub struct Pool<S: Storage> {
    slots: S::Slice<Option<Buffer<S>>>,
}

impl<S: Storage> Pool<S>
where
    Buffer<S>: 'static,
{
    /// A pool of the buffers in `slots`; slots may be empty.
    pub fn new(slots: S::Slice<Option<Buffer<S>>>) -> Self {
        Self { slots }
    }

    /// How many buffers are free now.
    pub fn free(&self) -> usize {
        self.slots.iter().filter(|slot| slot.is_some()).count()
    }
}

impl<S: Storage> Buffers<S> for Pool<S> {
    fn take(&mut self) -> Option<Buffer<S>> {
        self.slots.iter_mut().find_map(Option::take)
    }

    fn give(&mut self, buffer: Buffer<S>) {
        if let Some(slot) = self.slots.iter_mut().find(|slot| slot.is_none()) {
            *slot = Some(buffer);
        }
    }
}
