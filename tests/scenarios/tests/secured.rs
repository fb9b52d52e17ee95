//! Every scenario once on the simulator with secured units, in the weather that it says.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Secured, 2)
}
