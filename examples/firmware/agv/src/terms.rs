//! The term that the vehicle obeys, in the flash that a board lends: read at the start, and written when a manager with a
//! newer one has joined. A vehicle in plain mode keeps none, since any peer could write to its flash.

use core::cell::Cell;

use cara_core::term::Term;
use cara_settings::boots::TermStore;
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;

use crate::{error, info};

/// A board has one unit, which keeps its term with a plain function.
static STORE: Mutex<CriticalSectionRawMutex, Cell<Option<&'static mut dyn TermStore>>> = Mutex::new(Cell::new(None));

/// Lends a board's flash for good.
pub(crate) fn lend(store: &'static mut dyn TermStore) {
    STORE.lock(|lent| lent.set(Some(store)));
}

/// The term that is kept; `None` if no flash is lent. Flash that cannot be read keeps none, which the log tells.
pub(crate) fn kept() -> Option<Term> {
    let stored = with_store(|store| store.stored())?;
    if stored.is_none() {
        error!("the kept term cannot be read: the managers that it refuses are forgotten");
    }
    Some(stored.unwrap_or(Term::NONE))
}

/// Keeps a newer term. Where that fails the vehicle obeys it until its next start.
pub(crate) fn keep(term: Term) {
    match with_store(|store| store.store(term)) {
        Some(true) => info!("keeps term {}", term.0),
        _ => error!("term {} is obeyed until the next start, and cannot be kept: the flash is worn out", term.0),
    }
}

/// Takes the flash out of its static meanwhile: writing takes long, and interrupts stay on.
fn with_store<R>(run: impl FnOnce(&mut dyn TermStore) -> R) -> Option<R> {
    let store = STORE.lock(Cell::take)?;
    let result = run(store);
    lend(store);
    Some(result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::boxed::Box;

    struct Flash {
        term: Term,
        writes: usize,
    }

    impl TermStore for Flash {
        fn stored(&mut self) -> Option<Term> {
            Some(self.term)
        }

        fn store(&mut self, term: Term) -> bool {
            let Some(left) = self.writes.checked_sub(1) else { return false };
            (self.term, self.writes) = (term, left);
            true
        }
    }

    /// One test, since there is one static.
    #[test]
    fn a_term_is_kept_in_the_flash_that_is_lent_while_that_takes_it() {
        keep(Term(1));
        assert_eq!(kept(), None);
        lend(Box::leak(Box::new(Flash { term: Term::NONE, writes: 1 })));
        assert_eq!(kept(), Some(Term::NONE));
        for newer in [Term(2), Term(3)] {
            keep(newer);
            assert_eq!(kept(), Some(Term(2)));
        }
    }
}
