//! `cargo xtask`: the project's own commands. Checks and demonstrations live here; nothing that ships does.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

mod again;
mod alerts;
mod bad_input;
mod bench;
mod binaries;
mod book;
mod chaos;
mod claims;
mod command;
mod demo;
mod dependencies;
mod figures;
mod firmware;
mod fleet;
mod fuzz;
mod groups;
mod house;
mod hygiene;
mod install;
mod instructions;
mod later;
mod layers;
mod licences;
mod links;
mod manifests;
mod msrv;
mod mutants;
mod names;
mod networks;
mod orders;
mod packages;
mod panic_free;
mod paper;
mod peers;
mod planted;
mod release;
mod runner;
mod sanitize;
mod security;
mod soak;
mod source;
mod upgrade;
mod workspace;

#[derive(Parser)]
#[command(name = "cargo xtask", about = "Demonstrates, checks and measures CARA", max_term_width = 120)]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Runs a manager and three AGVs as processes, shows the paper's listing line by line, then breaks things; or a warehouse.
    Demo(demo::Options),
    /// Runs the groups of checks; without names, those of the default run.
    Test {
        /// Groups to run; `--list` shows them.
        #[arg(value_name = "GROUP")]
        groups: Vec<String>,
        /// Leaves out the slow groups and shortens the others.
        #[arg(long)]
        quick: bool,
        /// Shows the groups, what each checks and its budget, and runs none.
        #[arg(long)]
        list: bool,
        /// Runs the groups named so many times, each time as a process of its own.
        #[arg(long, value_name = "N", default_value_t = 1, requires = "groups", value_parser = clap::value_parser!(u16).range(1..))]
        times: u16,
        /// Runs beside so many threads that do nothing but keep a processor busy.
        #[arg(long, value_name = "N", default_value_t = 0)]
        busy: u16,
    },
    /// Breaks what rows of docs/paper.md say, one committed patch at a time, and requires that the row's test fails.
    Paper {
        /// Rows; all that have a patch if not given.
        #[arg(value_name = "NUMBER")]
        numbers: Vec<String>,
        /// Breaks nothing, and writes on which ports each row's tests run.
        #[arg(long, conflicts_with = "numbers")]
        write: bool,
    },
    /// Prints the sizes of the firmware images and the memory that each capacity costs.
    Sizes {
        /// Only those of this board.
        #[arg(value_name = "BOARD")]
        board: Option<String>,
        /// Also writes the figures here.
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
        /// Also writes them to docs/sizes.md, with which the checks compare.
        #[arg(long)]
        write: bool,
    },
    /// Prints how many instructions the core's operations take, on this host and on an emulated Cortex-M3.
    Instructions {
        /// Also writes the figures here.
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
        /// Also writes them to docs/instructions.md, with which the checks compare.
        #[arg(long)]
        write: bool,
    },
    /// Makes Debian packages, static archives, checksums and lists of components in target/release-files.
    Release,
    /// Makes a book of the documents, with a search, in target/book.
    Book,
    /// Counts what there is to read and to learn: lines, ways to call, public items, conditions, circles, words.
    House {
        /// Also writes the figures here.
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
    /// Repeats the paper's experiments against raw sockets, interleaved with a control, and draws its figures.
    Bench(bench::Options),
    /// Builds the other systems that `bench` measures beside CARA, and says which are absent and what brings them.
    Peers {
        /// Only these; `omniorb`, `zenoh` and so on.
        #[arg(value_name = "PEER")]
        names: Vec<String>,
    },
    /// Runs fleets on the simulator from many seeds, in which nothing may move that is not wanted; or with planted bugs.
    Orders(orders::Orders),
    /// Runs libFuzzer over the targets of tests/fuzz; or over bugs that are planted on purpose.
    Fuzz(fuzz::Fuzz),
    /// Runs fleets on the simulator under all faults at once, judged all the time; or with planted bugs.
    Chaos(chaos::Chaos),
    /// Tries mutants of what decides about motion and membership: the tests of core and simulator have to find each.
    Mutants(mutants::Mutants),
    /// Puts many s_units on one manager and measures how they join, what they cost, and how they come back.
    Fleet {
        /// How many s_units; 1,000 if not given.
        #[arg(long, value_parser = clap::value_parser!(u16).range(2..=10_000))]
        nodes: Option<u16>,
        /// Processes that share them; 1 if not given.
        #[arg(long, value_parser = clap::value_parser!(u16).range(1..=64))]
        processes: Option<u16>,
        /// Also writes the figures here.
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
    /// Breaks the network between two hosts in many ways, and prints what is lost and how long calls take to be answered again.
    Networks(networks::Faults),
    /// Breaks a manager's and a vehicle's host in many ways, descriptors to disks, and prints the same.
    Hosts(networks::Faults),
    /// Runs the warehouse for hours while everything fails, and looks at what its processes hold: nothing may grow.
    Soak(soak::Soak),
    /// Runs the Linux port's tests under the thread sanitizer, or the core's in Miri; needs a nightly compiler.
    Sanitize(sanitize::Sanitize),
    /// Attacks units on the simulator, a board in QEMU and Linux units, and prints what was tried and what came of it.
    Security(security::Security),
    /// Makes things fail while an emulated vehicle drives, and prints how long its motors went on, beside the bound.
    Faults(firmware::Faults),
    /// Runs the demonstration between this version and builds of earlier ones, either way round, and has a fleet in motion change over.
    Versions {
        /// Commits or tags; each tag `wire-N` and `v*` if not given, or else the last commit of the day before.
        #[arg(value_name = "REVISION")]
        revisions: Vec<String>,
    },
    /// Builds the firmware of a board, or of all boards; or runs an emulated one.
    Firmware {
        /// Which board.
        #[arg(value_name = "BOARD")]
        board: Option<String>,
        /// Also puts the vehicle's image on the board, through a debug probe.
        #[arg(long, requires = "board")]
        flash: bool,
        #[command(flatten)]
        session: firmware::SessionOptions,
    },
}

fn main() -> ExitCode {
    let finished = match Arguments::parse().task {
        Task::Demo(options) if options.warehouse => demo::warehouse(&options),
        Task::Demo(_) => demo::run(),
        Task::Test { list: true, .. } => runner::list(),
        Task::Test { groups, quick, times, busy, list: false } => runner::run(&groups, quick, times, busy),
        Task::Sizes { board, json, write } => firmware::sizes(board.as_deref(), json.as_deref(), write),
        Task::Versions { revisions } => later::versions(&revisions).map(|()| ExitCode::SUCCESS),
        Task::Instructions { json, write } => instructions::run(json.as_deref(), write),
        Task::Release => release::make().map(|_| ExitCode::SUCCESS),
        Task::Book => book::make().map(|_| ExitCode::SUCCESS),
        Task::House { json } => house::run(json.as_deref()),
        Task::Paper { write: true, .. } => paper::write_ports().map(|()| ExitCode::SUCCESS),
        Task::Paper { numbers, write: false } => paper::broken::run(&numbers),
        Task::Fleet { nodes, processes, json } => fleet::run(nodes, processes, json.as_deref()),
        Task::Peers { names } => peers::run(&names),
        Task::Orders(options) => orders::run(&options),
        Task::Fuzz(options) => fuzz::run(&options),
        Task::Chaos(options) => chaos::run(&options),
        Task::Mutants(options) => mutants::run(&options),
        Task::Networks(options) => networks::networks(&options),
        Task::Hosts(options) => networks::hosts(&options),
        Task::Soak(options) => soak::run(&options),
        Task::Sanitize(options) => sanitize::run(&options),
        Task::Security(options) => security::run(&options),
        Task::Faults(faults) => firmware::faults(&faults),
        Task::Bench(options) => bench::run(&options),
        Task::Firmware { board: Some(board), flash: true, .. } => firmware::flash(&board),
        Task::Firmware { board, session, .. } if session.run => firmware::session(board.as_deref(), &session),
        Task::Firmware { board, .. } => firmware::build(board.as_deref()),
    };
    finished.unwrap_or_else(|error| {
        eprintln!("xtask: {error:#}");
        ExitCode::FAILURE
    })
}
