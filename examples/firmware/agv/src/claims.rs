//! The highest claim that the vehicle has obeyed, in the flash that a board lends: read at the start, and written before the first
//! moving call under another one, while the vehicle stands. In plain mode it stores none: any peer could write to its flash.

use core::cell::Cell;

use cara_core::distribution::claim::StoredClaim;
use cara_settings::boots::ClaimStore;
use embassy_sync::blocking_mutex::Mutex;
use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;

use crate::{error, info};

/// A board has one unit, which stores its claim with a plain function.
static STORE: Mutex<CriticalSectionRawMutex, Cell<Option<&'static mut dyn ClaimStore>>> = Mutex::new(Cell::new(None));

/// Lends a board's flash for good.
pub(crate) fn lend(store: &'static mut dyn ClaimStore) {
    STORE.lock(|lent| lent.set(Some(store)));
}

/// The claim that is stored; `None` if no flash is lent. Of flash that cannot be read there is none, which the log tells.
pub(crate) fn stored() -> Option<StoredClaim> {
    let stored = with_store(|store| store.stored())?;
    if stored.is_none() {
        error!("the stored claim cannot be read: the managers that it refuses are forgotten");
    }
    Some(stored.unwrap_or_default())
}

/// Stores a claim; whether it is stored. Where that fails the vehicle obeys it until its next start.
pub(crate) fn store(claim: &StoredClaim) -> bool {
    let is_stored = with_store(|store| store.store(claim)) == Some(true);
    let term = claim.tagged.claim.term;
    if is_stored {
        info!("stores the claim with term {}", term);
    } else {
        error!(
            "the claim with term {} is obeyed until the next start, and cannot be stored: the flash is worn out",
            term
        );
    }
    is_stored
}

/// Takes the flash out of its static meanwhile: writing takes long, and interrupts stay on.
fn with_store<R>(run: impl FnOnce(&mut dyn ClaimStore) -> R) -> Option<R> {
    let store = STORE.lock(Cell::take)?;
    let result = run(store);
    lend(store);
    Some(result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::boxed::Box;

    use cara_core::distribution::claim::{Claim, TaggedClaim};

    struct Flash {
        claim: StoredClaim,
        writes: usize,
    }

    impl ClaimStore for Flash {
        fn stored(&mut self) -> Option<StoredClaim> {
            Some(self.claim)
        }

        fn store(&mut self, claim: &StoredClaim) -> bool {
            let Some(left) = self.writes.checked_sub(1) else { return false };
            (self.claim, self.writes) = (*claim, left);
            true
        }
    }

    fn claim(term: u64) -> StoredClaim {
        let tagged = TaggedClaim { claim: Claim { term, claimant: 1 }, tag: [2; 16] };
        StoredClaim { tagged, key: [3; 6] }
    }

    /// One test, since there is one static.
    #[test]
    fn a_claim_is_stored_in_the_flash_that_is_lent_while_that_takes_it() {
        assert!(!store(&claim(1)));
        assert_eq!(stored(), None);
        lend(Box::leak(Box::new(Flash { claim: StoredClaim::default(), writes: 1 })));
        assert_eq!(stored(), Some(StoredClaim::default()));
        assert_eq!([store(&claim(2)), store(&claim(3))], [true, false]);
        assert_eq!(stored(), Some(claim(2)));
    }
}
