//! The optional features of the core, as types and constants. Code of a feature that is off is still type-checked, then left out
//! of the program: its events cannot be constructed, and its state is empty.

use core::convert::Infallible;
use core::ops::Deref;

#[cfg(not(feature = "details"))]
pub use Off as Details;
#[cfg(not(feature = "nested"))]
pub use Off as Nested;
#[cfg(not(feature = "streams"))]
pub use Off as Streams;
#[cfg(feature = "details")]
pub use On as Details;
#[cfg(feature = "nested")]
pub use On as Nested;
#[cfg(feature = "streams")]
pub use On as Streams;

/// Streams: values that change, sent to subscribers.
pub const STREAMS: bool = Streams::IS_ON;
/// Failures with text and values, progress of running calls, and cancellation.
pub const DETAILS: bool = Details::IS_ON;
/// Hand-over of a vehicle to another manager.
pub const HAND_OVER: bool = cfg!(feature = "hand-over");
/// Lists and records.
pub const NESTED: bool = Nested::IS_ON;
/// Waiting calls begin by deadline. Without this they begin in order of arrival, whatever the constraints are.
pub const SCHEDULING: bool = cfg!(feature = "scheduling");
/// Calls that cannot make their deadlines can be refused. Without this none is.
pub const ADMISSION: bool = cfg!(feature = "admission");
/// Help and units in signatures.
pub const HELP: bool = cfg!(feature = "help");

/// A feature as a type, [`On`] or [`Off`].
pub trait Ability {
    /// Whether the build has it.
    const IS_ON: bool;
    /// `T` if the feature is on; otherwise an uninhabited type, so that a `match` needs no arm for it.
    type Of<T>;
    /// `None` if the feature is off.
    fn of<T>(value: T) -> Option<Self::Of<T>>;
    /// The value.
    fn get<T>(of: Self::Of<T>) -> T;
}

/// A feature that this build has.
#[derive(Clone, Copy, Debug)]
pub enum On {}

/// A feature that this build lacks.
#[derive(Clone, Copy, Debug)]
pub enum Off {}

impl Ability for On {
    const IS_ON: bool = true;
    type Of<T> = T;

    fn of<T>(value: T) -> Option<T> {
        Some(value)
    }

    fn get<T>(of: T) -> T {
        of
    }
}

impl Ability for Off {
    const IS_ON: bool = false;
    type Of<T> = Infallible;

    fn of<T>(_: T) -> Option<Infallible> {
        None
    }

    fn get<T>(of: Infallible) -> T {
        match of {}
    }
}

/// The state of a feature. If that is off, it is empty and `change` does nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct State<T, const IS_ON: usize>([T; IS_ON]);

/// The initial state of a feature.
pub(crate) trait Begins: Copy + 'static {
    const BEGIN: &'static Self;
}

impl<T: Begins, const IS_ON: usize> State<T, IS_ON> {
    pub(crate) const NEW: Self = Self([*T::BEGIN; IS_ON]);

    pub(crate) const fn get_mut(&mut self) -> Option<&mut T> {
        self.0.as_mut_slice().first_mut()
    }

    /// Changes the state, if there is any.
    pub(crate) fn change(&mut self, change: impl FnOnce(&mut T)) {
        if let Some(state) = self.get_mut() {
            change(state);
        }
    }
}

impl<T: Begins, const IS_ON: usize> Deref for State<T, IS_ON> {
    type Target = T;

    fn deref(&self) -> &T {
        self.0.first().unwrap_or(T::BEGIN)
    }
}

impl<T: Begins, const IS_ON: usize> Default for State<T, IS_ON> {
    fn default() -> Self {
        Self::NEW
    }
}
