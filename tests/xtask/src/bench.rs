//! `cargo xtask bench`: the round trip against a raw socket, interleaved, with its control. The paper's whole series of
//! experiments comes with later work.

use std::path::Path;
use std::process::ExitCode;

use anyhow::Result;

use crate::command::Run;

/// Without the one that needs a thousand idle links.
const QUICK_PEERS: &str = "floor,floor_again,cara,cara_one_link";

pub(crate) fn run(quick: bool, json: Option<&Path>) -> Result<ExitCode> {
    let bench = Run::cargo().args(["run", "--release", "--quiet", "--package", "cara-bench", "--", "skeleton"]);
    let bench = bench.args(["--chars", "100,1000,20000", "--pins", "same,split"]);
    let bench = if quick {
        bench.args(["--callers", "1,8", "--calls", "200", "--rounds", "4", "--peers", QUICK_PEERS])
    } else {
        bench.args(["--callers", "1,8,64", "--calls", "400", "--rounds", "20", "--pause-ms", "0,10"])
    };
    let bench = match json {
        // The child runs in the project's root, wherever this command was started.
        Some(path) => bench.args(["--json".as_ref(), std::path::absolute(path)?.as_os_str()]),
        None => bench,
    };
    bench.stream()?;
    println!("note: availability, distribution 2 and the other systems come with the paper's experiments");
    Ok(ExitCode::SUCCESS)
}
