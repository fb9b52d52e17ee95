//! Every scenario that boards can, on a switch in memory and in virtual time, in the weather that it says.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Embassy, 2)
}
