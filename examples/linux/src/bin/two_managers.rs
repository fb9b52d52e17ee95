//! Two managers on one network, and an s_unit that joins only its own: it holds its manager's name and ID number.

use std::time::{Duration, Instant};

use anyhow::Result;
use cara_examples::{Network, Stop, log_to_stderr, say};
use cara_std::{CommunicationSystem, Identity, Unit};
use clap::Parser;

/// How often the managers search.
const SEARCH_EVERY: Duration = Duration::from_millis(250);
/// How often both managers have searched at least when this ends; the wrong one has had each of them.
const SEARCHES: u32 = 8;
/// How long they search at most until the AGV has its manager and they have each other.
const PATIENCE: Duration = Duration::from_secs(30);

/// Two managers and an s_unit, in one process.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    network: Network,
}

fn main() -> Result<()> {
    let Options { network } = Options::parse();
    log_to_stderr();
    let stop = Stop::new(network.attended)?;
    // Keys for three units that are in one process. The AGV has one for its own manager, and the managers for each other.
    let mut keys = network.draw_keys(&["north/1@m_unit", "south/2@m_unit"])?;
    keys.add(&Identity::s_unit("agv-1", 11)?, &[Identity::m_unit("south", 2)?])?;
    let manager = |name, id| -> Result<CommunicationSystem> {
        let ring = keys.ring(&Identity::m_unit(name, id)?)?;
        Ok(network.place_with(CommunicationSystem::builder(name, id)?, ring).build()?)
    };
    let (north, south) = (manager("north", 1)?, manager("south", 2)?);
    let ring = keys.ring(&Identity::s_unit("agv-1", 11)?)?;
    let agv = network.place_with(Unit::builder("agv-1", 11, "south", 2)?, ring).build()?;
    north.start()?;
    south.start()?;
    agv.start()?;
    let has_joined = || south.number_of_s_units() == 1 && agv.is_connected();
    let is_complete = || has_joined() && [&north, &south].iter().all(|manager| manager.number_of_m_units() == 1);
    let (start, mut searches) = (Instant::now(), 0);
    while searches < SEARCHES || !is_complete() && start.elapsed() < PATIENCE {
        searches += 1;
        north.broadcast();
        south.broadcast();
        if let Some(outcome) = stop.wait_for(SEARCH_EVERY) {
            return outcome;
        }
    }
    say!(
        "north has {} s_units {:?} and {} m_units",
        north.number_of_s_units(),
        north.s_units(),
        north.number_of_m_units()
    );
    say!(
        "south has {} s_units {:?} and {} m_units",
        south.number_of_s_units(),
        south.s_units(),
        south.number_of_m_units()
    );
    say!("the manager of agv-1 is {:?}", agv.manager());
    [&north, &south].iter().for_each(|manager| manager.stop());
    agv.stop();
    Ok(())
}
