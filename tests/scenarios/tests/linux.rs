//! Every scenario that Linux can, over loopback, each on a fleet of its own.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Linux, 4)
}
