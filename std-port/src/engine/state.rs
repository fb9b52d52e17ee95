//! Where the application's state lies. Its gate decides who has it, so nobody waits here for longer than a moment.
//!
//! Readers run side by side only where the state is `Sync`, and most states need not be. So it lies in a mutex until a service
//! reads it, which only a state that is `Sync` can have, and in a read-write lock from then on.

use std::any::Any;
use std::sync::{Mutex, OnceLock, RwLock};

use crate::locks::{lock, read, write};

pub(crate) struct State<T> {
    /// Empty once the state is shared.
    alone: Mutex<Option<T>>,
    /// An `RwLock<T>`. Erased, as its own type would ask every state to be `Sync`.
    shared: OnceLock<Box<dyn Any + Send + Sync>>,
}

impl<T: 'static> State<T> {
    pub(crate) const fn new(state: T) -> Self {
        Self { alone: Mutex::new(Some(state)), shared: OnceLock::new() }
    }

    fn shared(&self) -> Option<&RwLock<T>> {
        self.shared.get()?.downcast_ref()
    }

    /// `None` never: the state is in one of the two places.
    pub(crate) fn change<R>(&self, act: impl FnOnce(&mut T) -> R) -> Option<R> {
        match self.shared() {
            Some(shared) => Some(act(&mut write(shared))),
            None => lock(&self.alone).as_mut().map(act),
        }
    }

    /// As [`change`](Self::change), beside others that read.
    pub(crate) fn read<R>(&self, act: impl FnOnce(&T) -> R) -> Option<R>
    where
        T: Send + Sync,
    {
        if self.shared.get().is_none() {
            // The first readers may come at the same time: those that find it empty find it shared, since it is so under this lock.
            let mut alone = lock(&self.alone);
            if let Some(state) = alone.take() {
                self.shared.get_or_init(|| Box::new(RwLock::new(state)));
            }
        }
        self.shared().map(|shared| act(&read(shared)))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;

    #[test]
    fn the_first_readers_share_the_state_and_it_can_be_changed_afterwards() {
        let (state, both) = (State::new(1), Barrier::new(2));
        assert_eq!(state.change(|number| *number += 1), Some(()));
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| {
                    // Each is inside until the other one is.
                    let seen = state.read(|number| {
                        both.wait();
                        *number
                    });
                    assert_eq!(seen, Some(2));
                });
            }
        });
        assert_eq!(state.change(|number| *number += 1), Some(()));
        assert_eq!(state.read(|number| *number), Some(3));
    }

    /// Such a state has no readers, and needs none to be lent.
    #[test]
    fn a_state_that_is_not_sync_is_lent_to_one_at_a_time() {
        let state = State::new(std::cell::Cell::new(1));
        std::thread::scope(|scope| {
            scope.spawn(|| state.change(|number| number.set(2)));
        });
        assert_eq!(state.change(|number| number.get()), Some(2));
    }
}
