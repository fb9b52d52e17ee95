//! Claims: which of two managers of one identity commands (docs/concepts.md, "Two managers of one identity").

use core::fmt;

use super::authenticator::{Authenticator, CODE_BYTES};
use super::identity::Identity;
use crate::config::Mode;

/// A manager's right to command: the higher claim wins. The claimant is drawn at random for each claim, so no two are equal.
///
/// ```
/// use cara_core::distribution::claim::Claim;
///
/// let kept = Claim { term: 5, claimant: 9 };
/// assert!(kept.raised(1) > kept && kept > Claim { term: 5, claimant: 8 } && kept > Claim::NONE);
/// assert!(Claim { term: u64::MAX, claimant: 9 }.raised(0) > Claim { term: u64::MAX, claimant: 9 }, "nothing wraps");
/// ```
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Claim {
    /// Increases with each claim.
    pub term: u64,
    /// Random, for this claim only.
    pub claimant: u64,
}

impl Claim {
    /// Lower than all others.
    pub const NONE: Self = Self { term: 0, claimant: 0 };

    /// A claim above this one, with this claimant. At the highest term the claimant increases instead.
    pub const fn raised(self, claimant: u64) -> Self {
        match self.term.checked_add(1) {
            Some(term) => Self { term, claimant },
            None => Self { term: u64::MAX, claimant: self.claimant.saturating_add(1) },
        }
    }

    /// The bytes that the tag authenticates. No datagram begins like this.
    fn bytes(self) -> [u8; 21] {
        let [t0, t1, t2, t3, t4, t5, t6, t7] = self.term.to_le_bytes();
        let [c0, c1, c2, c3, c4, c5, c6, c7] = self.claimant.to_le_bytes();
        let [k0, k1, k2, k3, k4] = *b"claim";
        [k0, k1, k2, k3, k4, t0, t1, t2, t3, t4, t5, t6, t7, c0, c1, c2, c3, c4, c5, c6, c7]
    }

    /// Adds the tag, made with the manager's key with itself. `None` without that key.
    pub fn tagged(self, manager: &Identity, authenticator: &dyn Authenticator) -> Option<TaggedClaim> {
        let tag = match authenticator.mode() {
            Mode::Plain => [0; CODE_BYTES],
            Mode::Secured => authenticator.sign_for(manager, &self.bytes())?,
        };
        Some(TaggedClaim { claim: self, tag })
    }
}

impl fmt::Display for Claim {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:04x}", self.term, self.claimant >> 48)
    }
}

/// A claim with its tag. Only managers of the identity can make or check the tag; a vehicle stores and presents it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TaggedClaim {
    /// The claim.
    pub claim: Claim,
    /// Its tag; zeros in plain mode.
    pub tag: [u8; CODE_BYTES],
}

impl TaggedClaim {
    /// No claim, without a tag.
    pub const NONE: Self = Self { claim: Claim::NONE, tag: [0; CODE_BYTES] };

    /// Whether a manager of this identity made the claim. In plain mode always `true`.
    pub fn is_genuine(&self, manager: &Identity, authenticator: &dyn Authenticator) -> bool {
        match authenticator.mode() {
            Mode::Plain => true,
            Mode::Secured => authenticator.is_of(manager, &self.claim.bytes(), &self.tag),
        }
    }
}

/// Length of a pair key's fingerprint.
pub const KEY_FINGERPRINT_BYTES: usize = 6;

/// A claim that a vehicle has obeyed, as stored. It is valid as long as the vehicle has the pair key under which it was obeyed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoredClaim {
    /// The claim.
    pub tagged: TaggedClaim,
    /// The fingerprint of that key. Of a vehicle that was handed over, XORed with that of the key with the manager that it was
    /// configured with: it says both, and counts with neither alone.
    pub key: [u8; KEY_FINGERPRINT_BYTES],
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;
    use std::format;

    use super::*;
    use crate::host::secure::Plain;

    /// Has a key with one manager. A code is the end of what it stands for: another claim has another one.
    struct Keyed(Identity);

    impl Authenticator for Keyed {
        fn mode(&self) -> Mode {
            Mode::Secured
        }

        fn sign_for_fleet(&self, _: &[u8]) -> [u8; CODE_BYTES] {
            [0; CODE_BYTES]
        }

        fn is_of_fleet(&self, _: &[u8], _: &[u8; CODE_BYTES]) -> bool {
            false
        }

        fn sign_for(&self, peer: &Identity, datagram: &[u8]) -> Option<[u8; CODE_BYTES]> {
            datagram.last_chunk().filter(|_| *peer == self.0).copied()
        }

        fn is_of(&self, peer: &Identity, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool {
            self.sign_for(peer, datagram) == Some(*code)
        }
    }

    #[test]
    fn a_tag_is_of_one_claim_and_of_one_key() {
        let [own, other] = [1, 2].map(|id| Identity::m_unit("manager", id).unwrap());
        let keyed = Keyed(own.clone());
        let claim = Claim { term: 5, claimant: 9 };
        let tagged = claim.tagged(&own, &keyed).unwrap();
        assert!(tagged.claim == claim && tagged.is_genuine(&own, &keyed) && !tagged.is_genuine(&other, &keyed));
        for claim in [Claim { term: 6, ..claim }, Claim { claimant: 8, ..claim }] {
            assert!(!TaggedClaim { claim, ..tagged }.is_genuine(&own, &keyed), "{claim}");
        }
        assert_eq!(claim.tagged(&other, &keyed), None, "there is no key");
        let plain = claim.tagged(&own, &Plain).unwrap();
        assert!(plain == TaggedClaim { claim, tag: [0; CODE_BYTES] } && plain.is_genuine(&own, &Plain));
        assert!(!plain.is_genuine(&own, &keyed), "a claim of plain mode counts in plain mode only");
    }

    #[test]
    fn a_claim_is_shown_by_its_term_and_what_tells_its_claimant_from_others() {
        assert_eq!(format!("{}", Claim { term: 12, claimant: 0x00ab_0000_0000_0001 }), "12.00ab");
    }

    proptest! {
        #[test]
        fn a_raised_claim_is_higher_wherever_the_counter_stands(
            term in prop_oneof![any::<u64>(), 0..3_u64, u64::MAX - 3..],
            one in 0..u64::MAX,
            other: u64,
        ) {
            let claim = Claim { term, claimant: one };
            prop_assert!(claim.raised(other) > claim);
        }
    }
}
