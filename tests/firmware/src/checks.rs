//! The checks, in their order. Each begins with an empty network and says in a word what it has seen.

mod calls;
mod limits;
mod lists;
pub(crate) mod losses;
pub(crate) mod restarts;
mod security;
mod terms;

use anyhow::Result;

use crate::board::Bench;

/// A check.
pub(crate) struct Check {
    pub(crate) name: &'static str,
    pub(crate) run: fn(&Bench, u32) -> Result<String>,
}

/// All of them.
pub(crate) const CHECKS: [Check; 21] = [
    Check { name: "it is found by broadcast and shows its functions", run: calls::found },
    Check { name: "it drives where it is sent, and arrives", run: calls::driven },
    Check { name: "it stops when nobody renews its lease", run: calls::not_renewed },
    Check { name: "wrong calls are refused and the rest goes on", run: calls::wrong },
    Check { name: "what is too long is refused on either side", run: limits::oversize },
    Check { name: "a peer that sends too much loses its link only", run: limits::breaks_its_limit },
    Check { name: "a best-effort request is served", run: calls::best_effort },
    Check { name: "it calls the manager's mechanic", run: calls::mechanic },
    Check { name: "of forty functions it keeps what it has room for", run: calls::many_functions },
    Check { name: "it skips a function with lists that it cannot read", run: lists::unreadable_function },
    Check { name: "an order of 50 nodes is refused before it is sent", run: lists::large_order },
    Check { name: "a call to a hung board ends in time", run: losses::hung },
    Check { name: "an idle cable is pulled and plugged in again", run: losses::idle_cable },
    Check { name: "a pulled cable stops it, and it returns", run: losses::cable },
    Check { name: "a killed manager stops it, and a new one finds it", run: losses::manager },
    Check { name: "without keys it joins no manager", run: security::no_keys },
    Check { name: "with keys of others it joins no manager", run: security::other_keys },
    Check { name: "a board that is told to be insecure is", run: security::insecure },
    Check { name: "no two lives have one key", run: security::lives },
    Check { name: "after its restart it refuses an older manager", run: terms::kept },
    Check { name: "it comes back from every loss of power", run: restarts::run },
];

/// Those that run on an RP2040 as well, in plain mode.
pub(crate) const RP2040: [Check; 7] = [
    Check { name: "it is found by broadcast and shows its functions", run: calls::found },
    Check { name: "it drives where it is sent, and arrives", run: calls::driven },
    Check { name: "it stops when nobody renews its lease", run: calls::not_renewed },
    Check { name: "wrong calls are refused and the rest goes on", run: calls::wrong },
    Check { name: "a pulled cable stops it, and it returns", run: losses::cable },
    Check { name: "a killed manager stops it, and a new one finds it", run: losses::manager },
    Check { name: "it comes back from every loss of power", run: restarts::run },
];

/// Those that run on an RP2040 with keys.
pub(crate) const RP2040_SECURED: [Check; 3] = [
    Check { name: "without keys it joins no manager", run: security::no_keys },
    Check { name: "with keys of others it joins no manager", run: security::other_keys },
    Check { name: "after its restart it refuses an older manager", run: terms::kept },
];
