//! Every scenario once on the simulator, in the weather that it says.

use std::process::ExitCode;

use cara_scenarios::{Port, suite};

fn main() -> ExitCode {
    suite::main(Port::Simulator, 2)
}
