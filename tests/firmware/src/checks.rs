//! The checks, in their order. Each begins with an empty network and says in a word what it has seen.

mod calls;
mod losses;
mod restarts;

use anyhow::Result;

use crate::board::Bench;

/// A check.
pub(crate) struct Check {
    pub(crate) name: &'static str,
    pub(crate) run: fn(&Bench, u32) -> Result<String>,
}

/// All of them.
pub(crate) const CHECKS: [Check; 10] = [
    Check { name: "it is found by broadcast and shows its functions", run: calls::found },
    Check { name: "it drives where it is sent, and arrives", run: calls::driven },
    Check { name: "it stops when nobody renews its lease", run: calls::not_renewed },
    Check { name: "wrong calls are refused and the rest goes on", run: calls::wrong },
    Check { name: "it calls the manager's mechanic", run: calls::mechanic },
    Check { name: "of forty functions it keeps what it has room for", run: calls::many_functions },
    Check { name: "a call to a hung board ends in time", run: losses::hung },
    Check { name: "a pulled cable stops it, and it returns", run: losses::cable },
    Check { name: "a killed manager stops it, and a new one finds it", run: losses::manager },
    Check { name: "it comes back from every loss of power", run: restarts::run },
];
