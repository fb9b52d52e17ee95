//! Every scenario once on the simulator with secured units, under its fault profile.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Secured, 2)
}
