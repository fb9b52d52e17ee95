//! Two managers on one network, and an s_unit that joins only its own: it holds its manager's name and ID number.

use std::time::Duration;

use anyhow::Result;
use cara_examples::{Network, Stop, log_to_stderr, say};
use cara_std::{CommunicationSystem, Unit};
use clap::Parser;

/// How often the managers search.
const SEARCH_EVERY: Duration = Duration::from_millis(250);
/// How often both managers have searched when this ends; the wrong one has had each of them.
const SEARCHES: u32 = 8;

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
    let manager = |name, id| -> Result<CommunicationSystem> {
        let builder = CommunicationSystem::builder(name, id)?.fleet(network.fleet);
        Ok(builder.interfaces(network.interfaces()).build_system()?)
    };
    let (north, south) = (manager("north", 1)?, manager("south", 2)?);
    let agv = Unit::builder("agv-1", 11, "south", 2)?.fleet(network.fleet);
    let agv = agv.interfaces(network.interfaces()).build_unit()?;
    north.start()?;
    south.start()?;
    agv.start()?;
    for _ in 0..SEARCHES {
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
