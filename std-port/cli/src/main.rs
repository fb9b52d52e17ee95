//! The `cara` command: what is on the network, why something is not, and calls from the command line.

use clap::Parser;

/// Shows and calls the nodes of a CARA fleet.
#[derive(Parser)]
#[command(name = "cara", version, max_term_width = 120)]
struct Arguments {}

fn main() {
    let Arguments {} = Arguments::parse();
}
