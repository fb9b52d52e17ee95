//! Firmware in QEMU against the Linux manager: real machine code of a Cortex-M3 or M4 behind a virtual cable, in a network
//! namespace that the program makes for itself.
//!
//! Everything is checked from what the manager sees and from what the board logs; waits are bounded generously, and
//! nothing is judged by its time.

mod board;
mod checks;
mod count;
mod faults;
mod hand_over;
mod kept_away;
mod keys;
mod line;
mod load;
mod logs;
mod machine;
mod manager;
mod places;
mod rp2040;
mod security;
mod serial;
mod session;
mod signals;
mod standby;
mod streams;
mod trace;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use cara_processes::network::{self, Own};
use clap::{Parser, Subcommand};

use board::Bench;
use checks::Check;
use keys::Keys;
use machine::Machine;

/// Runs an image of an emulated board and checks what it does.
#[derive(Parser)]
struct Arguments {
    /// The AGV's image.
    #[arg(long)]
    image: PathBuf,
    /// The board that it is for.
    #[arg(long, value_enum, default_value = "lm3s6965evb")]
    board: Machine,
    /// The same with random numbers that are the same in each life, and with a service that takes lists.
    #[arg(long)]
    constant: Option<PathBuf>,
    /// How often the board loses power and comes back.
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u32).range(1..))]
    restarts: u32,
    /// Only the checks whose names contain this.
    #[arg(long, default_value = "")]
    only: String,
    /// Says what the board logs.
    #[arg(long)]
    logs: bool,
    /// The `cara` command; the one beside this program if not given.
    #[arg(long)]
    cara: Option<PathBuf>,
    /// Boards and managers are told to be insecure, in place of being given keys; for images without a cipher.
    #[arg(long)]
    insecure: bool,
    #[command(subcommand)]
    part: Option<Part>,
}

/// Parts of the test that are processes of their own.
#[derive(Subcommand)]
enum Part {
    /// A manager that can be killed.
    Manager {
        /// Its keys; without them it is insecure.
        #[arg(long)]
        key_file: Option<PathBuf>,
        /// Where it keeps its term.
        #[arg(long)]
        state: Option<PathBuf>,
    },
    /// A vehicle that can hold its own state for ever.
    Vehicle {
        /// An m_unit with an actuator, for two callers.
        #[arg(long)]
        shared: bool,
    },
    /// Puts a board under load and prints how deep its stack was.
    Stack {
        /// What the image is.
        of: load::Image,
    },
    /// Prints how many instructions a board executes between a request and its reply, and whose they are.
    Instructions {
        /// What the image is.
        of: count::Image,
        /// Prints the functions with the most instructions instead.
        #[arg(long)]
        profile: bool,
    },
    /// Makes things fail while a vehicle drives, and measures how long its motors go on.
    Faults(faults::Faults),
    /// Attacks a board that dials the attacker.
    Security(security::Security),
    /// Measures how long boards take to join beside recorded and forged discovery.
    KeptAway(kept_away::KeptAway),
    /// Ends sessions by signals at random moments, and fails if one leaves keys behind.
    Ends {
        /// How many.
        #[arg(long, default_value_t = 300)]
        times: u32,
    },
    /// Calls a board whose hundred lines a second `cara logs` shows; for an image with the features `faults` and `logs`, and a
    /// `cara` with the feature `defmt`.
    Logs,
    /// Calls a board that publishes values meanwhile; for an image with streams.
    Streams(streams::Streams),
    /// Runs a board on a serial line; for an image with SLIP, or with a line without IP.
    Serial(serial::Serial),
    /// Kills and freezes a board's manager, which has a standby.
    Standby(standby::Standby),
    /// Hands a board over between two managers; for an image that can be.
    HandOver,
    /// Runs an RP2040 with a W5500 in rp2040js; with `--board rp2040`, for its image.
    Rp2040,
    /// Starts a session: a board, its manager and a prompt for `cara`.
    Session(session::Session),
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let outcome = match &arguments.part {
        Some(Part::Manager { key_file, state }) => {
            manager::stand_alone(key_file.as_deref(), state.as_deref()).map(|()| ExitCode::SUCCESS)
        }
        Some(Part::Vehicle { shared: true }) => faults::stand_alone_shared().map(|()| ExitCode::SUCCESS),
        Some(Part::Vehicle { shared: false }) => faults::stand_alone().map(|()| ExitCode::SUCCESS),
        Some(Part::Ends { times }) => session::ends(&arguments, *times).map(|()| ExitCode::SUCCESS),
        _ => in_own_network(&arguments),
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("firmware: {error:#}");
        ExitCode::FAILURE
    })
}

/// Exit code of a test that could not be run; it has shown nothing.
const SKIPPED: u8 = 77;

fn in_own_network(arguments: &Arguments) -> Result<ExitCode> {
    let emulator = if matches!(arguments.part, Some(Part::Rp2040)) { "node" } else { "qemu-system-arm" };
    match network::own(std::env::args_os().skip(1), &[emulator], true)? {
        Own::Inside => inside(arguments).map(|()| ExitCode::SUCCESS),
        Own::Ended(status) if status.success() => after(arguments).map(|()| ExitCode::SUCCESS),
        Own::Ended(status) => bail!("failed: {status}"),
        Own::Impossible(reason) => {
            eprintln!("skipped: {reason}");
            eprintln!(
                "a board needs a network of its own: root, or a user that may make namespaces and open /dev/net/tun"
            );
            Ok(ExitCode::from(SKIPPED))
        }
    }
}

fn inside(arguments: &Arguments) -> Result<()> {
    signals::clean_up_at_signals()?;
    match &arguments.part {
        Some(Part::Session(session)) => session::run(arguments, session),
        Some(Part::Instructions { of, profile }) => count::run(&bench(arguments)?, &arguments.image, *of, *profile),
        Some(Part::Faults(faults)) => faults::run(bench(arguments)?.counting(), faults),
        Some(Part::Security(options)) => security::run(&bench(arguments)?, options),
        Some(Part::KeptAway(options)) => kept_away::run(&bench(arguments)?, options),
        Some(Part::Logs) => logs::run(&bench(arguments)?),
        Some(Part::Streams(options)) => streams::run(&bench(arguments)?, options),
        Some(Part::Serial(options)) => serial::run(&bench(arguments)?, options),
        Some(Part::Standby(options)) => standby::run(&bench(arguments)?, options),
        Some(Part::HandOver) => {
            let keys = Keys::of_two_managers(arguments.cara.as_deref())?;
            hand_over::run(&Bench::new(arguments.board, &arguments.image, arguments.logs, keys)?)
        }
        Some(Part::Rp2040) => rp2040::run(arguments),
        Some(Part::Stack { of }) => load::run(&bench(arguments)?, *of),
        _ => run(arguments),
    }
}

/// A bench for boards, with freshly drawn keys.
fn bench(arguments: &Arguments) -> Result<Bench> {
    let cara = arguments.cara.as_deref();
    let keys = if arguments.insecure { Keys::insecure(cara)? } else { Keys::of_boards(cara)? };
    Bench::new(arguments.board, &arguments.image, arguments.logs, keys)
}

/// What is tested from outside, because it makes a network of its own.
fn after(arguments: &Arguments) -> Result<()> {
    if arguments.part.is_some() || !SESSION.contains(&arguments.only) {
        return Ok(());
    }
    let start = Instant::now();
    let reported = session::test(arguments).context(SESSION)?;
    println!("{SESSION:48} {:6.1} s  {reported}", start.elapsed().as_secs_f64());
    Ok(())
}

/// The check of [`session`].
const SESSION: &str = "an emulator session answers what is typed";

fn run(arguments: &Arguments) -> Result<()> {
    let bench = bench(arguments)?.with_constant(arguments.constant.clone());
    let passed = run_checks(&checks::CHECKS, &bench, arguments)?;
    if passed == 0 && !SESSION.contains(&arguments.only) {
        bail!("no check has `{}` in its name", arguments.only);
    }
    println!("{passed} checks of firmware passed");
    Ok(())
}

/// Runs those checks that are asked for; how many.
fn run_checks(checks: &[Check], bench: &Bench, arguments: &Arguments) -> Result<usize> {
    let chosen = checks.iter().filter(|check| check.name.contains(&arguments.only));
    chosen.clone().try_for_each(|check| {
        let start = Instant::now();
        let reported = (check.run)(bench, arguments.restarts).with_context(|| check.name.to_owned())?;
        println!("{:48} {:6.1} s  {reported}", check.name, start.elapsed().as_secs_f64());
        anyhow::Ok(())
    })?;
    Ok(chosen.count())
}
