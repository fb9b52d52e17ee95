//! `cargo xtask demo --warehouse`: a warehouse of vehicles as processes, which is broken while it works. The run checks itself:
//! `examples/warehouse`.

use std::ffi::OsStr;
use std::path::PathBuf;
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
    /// For `cargo xtask soak`: what processes hold goes here.
    #[arg(long, requires = "minutes", hide = true)]
    soak: Option<PathBuf>,
}

impl Options {
    /// Those of a soak.
    pub(crate) fn soak(vehicles: u32, minutes: u32, seed: u64, board: bool, csv: PathBuf) -> Self {
        let (vehicles, minutes, seed) = (Some(vehicles), Some(minutes), Some(seed));
        Self { warehouse: true, vehicles, minutes, seed, standby: true, board, soak: Some(csv) }
    }
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
    let soak = options.soak.iter().flat_map(|csv| ["--soak".to_owned(), csv.to_string_lossy().into_owned()]);
    let given: Vec<String> = given.flatten().chain(standby).chain(soak).collect();
    let code = if options.board || options.soak.is_some() {
        in_own_network(options.board, options.soak.is_some(), &given)?
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
    firmware::emulated(|| in_own_network(true, false, &[]))
}

/// This host on the board's cable, and the board.
const ADDRESSES: [&str; 2] = ["10.77.0.1/24", "10.77.0.2/24"];
const CABLE: &str = "cable0";

/// A run in a network of its own, maybe with an emulated board; its exit code. A soak is of what people run: optimised.
fn in_own_network(with_board: bool, is_soak: bool, given: &[String]) -> Result<Option<i32>> {
    let image = with_board.then(firmware::warehouse_image).transpose()?;
    let built = if is_soak { binaries::release } else { binaries::debug };
    // A board is given its keys by the command beside the program, which has the page as well.
    built("cara")?;
    let warehouse = built("warehouse")?;
    // A heap for each few threads fills up over hours, which would look like a leak or hide one.
    let warehouse = if is_soak { warehouse.env("MALLOC_ARENA_MAX", "1") } else { warehouse };
    let words = ["demo", "--warehouse"].into_iter().chain(with_board.then_some("--board"));
    let again = words.chain(given.iter().map(String::as_str));
    let needs: &[&str] = if with_board { &["qemu-system-arm"] } else { &["nft"] };
    match network::own(again, needs, with_board)? {
        Own::Inside => {}
        Own::Ended(status) => return Ok(status.code()),
        Own::Impossible(reason) => {
            eprintln!(
                "this needs root, or a user that may make namespaces, and open /dev/net/tun for a board: {reason}"
            );
            return Ok(Some(NOT_ALLOWED));
        }
    }
    network::run("ip link set lo up")?;
    let Some(image) = image else { return warehouse.args(["run"]).args(given).code() };
    let [host, board] = ADDRESSES;
    network::run(&format!("ip tuntap add name {CABLE} mode tap"))?;
    network::run(&format!("ip address add {host} brd + dev {CABLE}"))?;
    network::run(&format!("ip link set {CABLE} up"))?;
    let words = ["run", "--cable", CABLE, "--address", board, "--board"].map(OsStr::new);
    warehouse.args(words).args([&image]).args(given).code()
}
