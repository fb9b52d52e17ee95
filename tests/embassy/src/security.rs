//! Keys of units on boards.

use cara_core::config::Mode;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_embassy::Security;
use cara_secure::random::Random;
use cara_sim::Ring;

/// The keys of a unit, all of one root, or none in plain mode. What the unit draws follows from `seed`.
pub fn security(mode: Mode, own: &Identity, fleet: u32, seed: u64) -> Security {
    match mode {
        Mode::Plain => Security::insecure(seed),
        Mode::Secured => keys(0, own, fleet, seed),
    }
}

/// The keys of a unit, of one of several roots that have no key in common.
pub fn keys(root: u8, own: &Identity, fleet: u32, seed: u64) -> Security {
    let ring = Box::leak(Box::new(Ring::new(root, own.clone(), Fleet(fleet))));
    let mut random = Random::constant();
    random.stir(&seed.to_le_bytes());
    Security::keys(ring, random)
}
