//! Terms of managers.

use core::fmt;

/// What decides which of two managers of one identity commands: the newer one. A manager claims the next term at its start
/// and keeps it; a vehicle keeps the newest that it has obeyed, and refuses managers of an older one.
///
/// Terms are compared as serial numbers (RFC 1982), so that a counter that has wrapped, or stands anywhere, has a next one
/// that is newer: no vehicle is locked out for good.
///
/// ```
/// use cara_core::term::Term;
///
/// assert!(Term(5).is_newer_than(Term(4)) && Term(5).is_newer_than(Term::NONE));
/// let last = Term(u32::MAX);
/// assert_eq!(last.next(), Term(1));
/// assert!(last.next().is_newer_than(last));
/// ```
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Term(pub u32);

impl Term {
    /// Never set: older than every other one.
    pub const NONE: Self = Self(0);

    /// Whether a manager of this term commands, and one of the `other` term does not.
    pub const fn is_newer_than(self, other: Self) -> bool {
        match (self, other) {
            (Self::NONE, _) => false,
            (_, Self::NONE) => true,
            _ => (self.0.wrapping_sub(other.0) as i32) > 0,
        }
    }

    /// The one that follows; never [`NONE`](Self::NONE).
    pub const fn next(self) -> Self {
        match self.0.wrapping_add(1) {
            0 => Self(1),
            term => Self(term),
        }
    }

    /// The newer one of two.
    pub const fn newer(self, other: Self) -> Self {
        if other.is_newer_than(self) { other } else { self }
    }
}

impl fmt::Display for Term {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_next_term_is_newer_wherever_the_counter_stands(term in prop_oneof![any::<u32>(), 0..3_u32, u32::MAX - 3..]) {
            let term = Term(term);
            prop_assert!(term.next().is_newer_than(term) && !term.is_newer_than(term.next()));
            prop_assert!(!term.is_newer_than(term) && term.next() != Term::NONE);
            prop_assert_eq!((term.newer(term.next()), term.next().newer(term)), (term.next(), term.next()));
        }

        #[test]
        fn of_two_terms_one_is_newer_at_most(one in any::<u32>(), other in any::<u32>()) {
            let (one, other) = (Term(one), Term(other));
            prop_assert!(!(one.is_newer_than(other) && other.is_newer_than(one)));
            // Whatever a vehicle has obeyed, the manager that it fences claims one that the vehicle takes.
            let claimed = one.newer(other).next();
            prop_assert!(!one.is_newer_than(claimed));
        }
    }
}
