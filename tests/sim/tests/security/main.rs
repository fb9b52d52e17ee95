//! What an attacker without the keys can do to secured units: each test counts its attempts and successes.
//!
//! - [`ends`]: two secured sessions, with every frame and datagram between them in the attacker's hands;
//! - [`frames`]: changed, cut, moved, left out and repeated frames;
//! - [`discovery`]: changed, spoofed and repeated datagrams of discovery;
//! - [`kept_away`]: recorded and forged discovery while a vehicle starts, and how long it takes to join;
//! - [`orders`]: orders, renewals, releases, stops and resets, forged, repeated and held back;
//! - [`renewals`]: recordings from before a link was rekeyed, and revoked or wrong keys;
//! - [`suites`]: offers of cipher suites that are changed, removed or answered with others;
//! - [`terms`]: forged answers and hellos that claim a newer term;
//! - [`vectors`]: the bytes of a conversation, as committed;
//! - [`fleet`]: wrong keys, no keys, plain against secured, floods, on the virtual network.

mod claims;
mod discovery;
mod ends;
mod fleet;
mod frames;
mod kept_away;
mod orders;
mod renewals;
mod suites;
mod vectors;

/// Attempts of one kind, and how many of them came to something.
struct Tally {
    what: &'static str,
    attempts: u64,
    successes: u64,
}

impl Tally {
    fn new(what: &'static str) -> Self {
        Self { what, attempts: 0, successes: 0 }
    }

    fn note(&mut self, success: bool) {
        self.attempts += 1;
        self.successes += u64::from(success);
    }

    /// Prints the figures; none may have come to anything, and there must have been some.
    fn close(self) {
        println!("{}: {} attempts, {} successes", self.what, self.attempts, self.successes);
        assert!(self.attempts > 0 && self.successes == 0, "{}: {} of {}", self.what, self.successes, self.attempts);
    }
}
