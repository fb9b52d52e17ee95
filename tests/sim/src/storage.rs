//! Boxed slices as the storage of the core's machines.

use cara_core::storage::Storage;

/// Storage sized at run time on the heap.
#[derive(Debug, Clone, Copy)]
pub enum Boxed {}

impl Storage for Boxed {
    type Slice<T: 'static> = Box<[T]>;
}

impl Boxed {
    /// `count` default values.
    pub fn slice<T: Default>(count: usize) -> Box<[T]> {
        (0..count).map(|_| T::default()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cara_core::storage::{Buffers, Pool};

    #[test]
    fn a_pool_of_boxed_buffers_lends_what_it_holds_and_no_more() {
        let slots = (0..2).map(|_| Some(Boxed::slice::<u8>(16))).collect();
        let mut pool: Pool<Boxed> = Pool::new(slots);
        let first = pool.take().expect("two are free");
        assert_eq!(first.len(), 16);
        assert!(pool.take().is_some());
        assert!(pool.take().is_none());
        pool.give(first);
        assert_eq!(pool.free(), 1);
    }
}
