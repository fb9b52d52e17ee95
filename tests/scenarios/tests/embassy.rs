//! Every scenario that boards can, on a switch in memory and in virtual time, under its fault profile.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Embassy, 2)
}
