//! Hosts that fail under a manager and a vehicle, each a process, while the manager calls all the time and holds an order:
//! descriptors, memory, disks, clocks, suspension. `cargo xtask hosts` runs it; it needs root, and mounts file systems.

mod disk;
mod group;
mod injecting;
mod motion;
mod pair;
mod units;

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use cara_processes::faults::{self, CALM, PATIENCE, Table};

use disk::Way;
use pair::{MANAGER, Pair, VEHICLE};

/// What fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// This process may open nothing more.
    Descriptors(usize),
    /// This process gets no more memory.
    Allocations(usize),
    /// This process is killed as its group of processes has too little memory.
    Killed(usize),
    /// The disk with the folder of state of this process.
    State(usize, Way),
    /// The disk with the log and the black box of `cara node`, and with a recording.
    Records(Way),
    /// The time of day, by so many seconds.
    Clock(i64),
    /// These processes stand still.
    Suspended(&'static [usize]),
    /// The vehicle goes on on a host that has been up for so many days more.
    Uptime(u32),
}

const HOURS: i64 = 5 * 3_600;

const FAULTS: [(&str, Kind); 21] = [
    ("no descriptors: manager", Kind::Descriptors(MANAGER)),
    ("no descriptors: vehicle", Kind::Descriptors(VEHICLE)),
    ("no memory: manager", Kind::Allocations(MANAGER)),
    ("no memory: vehicle", Kind::Allocations(VEHICLE)),
    ("killed for memory: manager", Kind::Killed(MANAGER)),
    ("killed for memory: vehicle", Kind::Killed(VEHICLE)),
    ("full disk: manager's state", Kind::State(MANAGER, Way::Full)),
    ("full disk: vehicle's state", Kind::State(VEHICLE, Way::Full)),
    ("full disk: log, black box, recording", Kind::Records(Way::Full)),
    ("read-only disk: manager's state", Kind::State(MANAGER, Way::ReadOnly)),
    ("read-only disk: vehicle's state", Kind::State(VEHICLE, Way::ReadOnly)),
    ("read-only disk: log, black box, recording", Kind::Records(Way::ReadOnly)),
    ("frozen disk: manager's state", Kind::State(MANAGER, Way::Frozen)),
    ("frozen disk: vehicle's state", Kind::State(VEHICLE, Way::Frozen)),
    ("frozen disk: log, black box, recording", Kind::Records(Way::Frozen)),
    ("clock 5 h ahead", Kind::Clock(HOURS)),
    ("clock 5 h back", Kind::Clock(-HOURS)),
    ("suspended: manager", Kind::Suspended(&[MANAGER])),
    ("suspended: vehicle", Kind::Suspended(&[VEHICLE])),
    ("suspended: both", Kind::Suspended(&[MANAGER, VEHICLE])),
    ("vehicle's host is up 60 days", Kind::Uptime(60)),
];

impl Kind {
    /// Whether this process may end by itself meanwhile.
    fn may_end(self, side: usize) -> bool {
        match self {
            Self::Allocations(one) | Self::Killed(one) => side == one,
            // Nothing commands without its claim on the disk.
            Self::State(one, _) => side == MANAGER && one == MANAGER,
            _ => false,
        }
    }
}

#[test]
fn calls_go_on_behind_each_fault() {
    let (each, kind) = faults::options();
    let mut table = Table::new(&["stood after", "crashes", "CPU meanwhile"]);
    let mut failed = Vec::new();
    for (name, kind) in FAULTS.iter().filter(|fault| fault.0.contains(&kind)) {
        if let Err(error) = inject(name, *kind, each, &mut table) {
            failed.push(format!("{name}: {error:#}"));
        }
        eprintln!("{name}");
    }
    println!("{table}");
    assert!(failed.is_empty(), "{failed:#?}");
}

fn inject(name: &str, kind: Kind, each: usize, table: &mut Table) -> Result<()> {
    let mut pair = Pair::start(kind)?;
    let mut took = (0..each).map(|number| break_once(&mut pair, kind, number, each)).collect::<Result<Vec<_>>>()?;
    let (calls, motion, crashes, busiest) = pair.end();
    let stood = motion.longest.map_or("—".to_owned(), |longest| format!("{:.2} s", longest.as_secs_f64()));
    let more = [stood, crashes.to_string(), format!("{:.0} %", busiest * 100.0)];
    table.row(name, &mut took, calls.counts(), calls.lost(), &more);
    ensure!(calls.lost() == 0, "calls ran twice, were answered and never ran, or had no outcome: {}", calls.lost());
    ensure!(motion.overdue == 0, "the vehicle moved on behind its lease, times: {}", motion.overdue);
    ensure!(crashes == 0, "a process ended that must not, times: {crashes}");
    ensure!(busiest < BUSY, "a process is busy with its fault: {busiest:.2} of a processor");
    Ok(())
}

/// Of a processor. A process that tries again and again without a pause takes more, beside other work too; this one 4 %.
const BUSY: f64 = 0.25;

/// One fault; how long it took from its end until a call was answered.
fn break_once(pair: &mut Pair, kind: Kind, number: usize, each: usize) -> Result<Duration> {
    pair.until(&format!("calm before fault {number}"), |pair| pair.answered_in_turn >= CALM && pair.motion.drives)?;
    pair.watch(Instant::now() + Duration::from_millis(u64::from(cara_processes::random_fleet() % 300)))?;
    pair.allow(kind);
    let lasts = faults::lasts(number, each);
    let before = pair.processor_times();
    injecting::begin(pair, kind, number)?;
    pair.watch(Instant::now() + lasts)?;
    pair.busy_since(before, lasts);
    let ended = injecting::end(pair, kind)?;
    pair.until(&format!("an answer {PATIENCE:?} behind fault {number}"), |pair| pair.answered > Some(ended))?;
    pair.allowed = None;
    pair.grace = Duration::ZERO;
    Ok(pair.answered.map_or(Duration::ZERO, |answered| answered - ended))
}

#[test]
#[ignore = "run by the other test here, in processes of their own"]
fn as_child() {
    units::play().unwrap();
}
