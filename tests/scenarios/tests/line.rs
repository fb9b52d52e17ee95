//! Every scenario of at most two units that a serial line can, between two boards in virtual time, under its fault profile.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Line, 2)
}
