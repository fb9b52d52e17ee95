//! What a build of the core can do: its features. The code of an ability that is off is checked like all other, and left out of
//! the program; what its events carry cannot be made, and its state takes no room.

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

/// Values that change, sent to those that subscribe to them.
pub const STREAMS: bool = Streams::IS_ON;
/// Failures with text and values, progress of running calls, and their cancellation.
pub const DETAILS: bool = Details::IS_ON;
/// Lists and records.
pub const NESTED: bool = Nested::IS_ON;
/// Calls that wait begin by their deadlines. Where the build cannot, they begin as they came, whatever the constraints say.
pub const SCHEDULING: bool = cfg!(feature = "scheduling");
/// Calls that cannot make their deadlines can be refused. Where the build cannot, none is.
pub const ADMISSION: bool = cfg!(feature = "admission");
/// Lines for people behind signatures.
pub const HELP: bool = cfg!(feature = "help");

/// An ability as a type, [`On`] or [`Off`].
pub trait Ability {
    /// Whether the build has it.
    const IS_ON: bool;
    /// A `T` where the ability is on; otherwise what cannot be, so that a `match` needs no arm for it.
    type Of<T>;
    /// `None` where the ability is off.
    fn of<T>(value: T) -> Option<Self::Of<T>>;
    /// The value.
    fn get<T>(of: Self::Of<T>) -> T;
}

/// An ability that this build has.
#[derive(Clone, Copy, Debug)]
pub enum On {}

/// An ability that this build has not.
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

/// The state of an ability. Where that is off it takes no room, and stays as it began.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct State<T, const IS_ON: usize>([T; IS_ON]);

/// How the state of an ability begins.
pub(crate) trait Begins: Copy + 'static {
    const BEGIN: &'static Self;
}

impl<T: Begins, const IS_ON: usize> State<T, IS_ON> {
    pub(crate) const NEW: Self = Self([*T::BEGIN; IS_ON]);

    pub(crate) const fn get_mut(&mut self) -> Option<&mut T> {
        self.0.as_mut_slice().first_mut()
    }

    /// Changes it, where there is any.
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
