//! `cargo xtask demo --warehouse`: a warehouse of vehicles as processes, which is broken while it works. The run checks itself:
//! `examples/warehouse`.

use std::ffi::OsStr;
use std::process::ExitCode;

use anyhow::Result;
use cara_processes::network::{self, Own};

use crate::firmware::NOT_ALLOWED;
use crate::groups::Outcome;
use crate::{binaries, firmware};

/// Options of the demonstration.
#[derive(clap::Args)]
pub(crate) struct Options {
    /// A warehouse in place of the listing: a manager, a mechanic and many vehicles, and what fails.
    #[arg(long)]
    pub(crate) warehouse: bool,
    /// How many vehicles, up to 200 on the example's floors; 14 unless given.
    #[arg(long, requires = "warehouse")]
    vehicles: Option<u32>,
    /// For how many minutes orders come and things are broken; about a minute unless given.
    #[arg(long, requires = "warehouse")]
    minutes: Option<u32>,
    /// Starts, charges, orders and faults are the same for a seed.
    #[arg(long, requires = "warehouse")]
    seed: Option<u64>,
    /// Two managers stand by for each other.
    #[arg(long, requires = "warehouse")]
    standby: bool,
    /// The last vehicle is firmware in QEMU.
    #[arg(long, requires = "warehouse")]
    board: bool,
}

/// Runs the warehouse; its exit code says whether all was as it has to be.
pub(crate) fn run(options: &Options) -> Result<ExitCode> {
    let numbers = [
        ("--vehicles", options.vehicles.map(u64::from)),
        ("--minutes", options.minutes.map(u64::from)),
        ("--seed", options.seed),
    ];
    let given = numbers.iter().filter_map(|(name, number)| Some([(*name).to_owned(), (*number)?.to_string()]));
    let standby = options.standby.then(|| "--standby".to_owned());
    let given: Vec<String> = given.flatten().chain(standby).collect();
    let code = if options.board {
        with_board(&given)?
    } else {
        binaries::debug("warehouse")?.args(["run"]).args(given).code()?
    };
    Ok(match code {
        Some(0) => ExitCode::SUCCESS,
        Some(NOT_ALLOWED) => ExitCode::from(NOT_ALLOWED as u8),
        _ => ExitCode::FAILURE,
    })
}

/// A short run with an emulated board among the vehicles.
pub(crate) fn check() -> Outcome {
    firmware::emulated(|| with_board(&[]))
}

/// This host on the board's cable, and the board.
const ADDRESSES: [&str; 2] = ["10.77.0.1/24", "10.77.0.2/24"];
const CABLE: &str = "cable0";

/// A run with an emulated board, in a network of its own; its exit code.
fn with_board(given: &[String]) -> Result<Option<i32>> {
    let image = firmware::warehouse_image()?;
    // A board is given its keys by the command beside the program.
    binaries::build(&["cara"])?;
    let warehouse = binaries::debug("warehouse")?;
    let again = ["demo", "--warehouse", "--board"].into_iter().chain(given.iter().map(String::as_str));
    match network::own(again, &["qemu-system-arm"], true)? {
        Own::Inside => {}
        Own::Ended(status) => return Ok(status.code()),
        Own::Impossible(reason) => {
            eprintln!("a board needs root, or a user that may make namespaces and open /dev/net/tun: {reason}");
            return Ok(Some(NOT_ALLOWED));
        }
    }
    let [host, board] = ADDRESSES;
    network::run("ip link set lo up")?;
    network::run(&format!("ip tuntap add name {CABLE} mode tap"))?;
    network::run(&format!("ip address add {host} brd + dev {CABLE}"))?;
    network::run(&format!("ip link set {CABLE} up"))?;
    let words = ["run", "--cable", CABLE, "--address", board, "--board"].map(OsStr::new);
    warehouse.args(words).args([&image]).args(given).code()
}
