//! Services that are methods of the application's type: one in the paper's form, one in place. The type is the one that
//! the paper passes as a template parameter.

use std::time::Duration;

use anyhow::{Result, bail};
use cara_apps::depot::{Depot, STORE, TAKE};
use cara_examples::{Network, Stop, log_to_stderr, say};
use cara_std::{CommunicationSystem, Definition, Identity, Parameters, ParametersView, Served, ServiceOptions, Unit};
use clap::Parser;

/// How long the two may take to meet.
const PATIENCE: Duration = Duration::from_secs(10);

/// A depot whose services are methods, and a manager that calls them, in one process.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    network: Network,
}

fn main() -> Result<()> {
    let Options { network } = Options::parse();
    log_to_stderr();
    let stop = Stop::new(network.attended)?;
    let stopper = stop.stopper();
    std::thread::spawn(move || stopper.stop(run(network)));
    stop.wait()
}

fn run(network: Network) -> Result<()> {
    let keys = network.draw_keys(&["manager/1@m_unit", "depot/11"])?;
    let ring = keys.ring(&Identity::s_unit("depot", 11)?)?;
    let depot = network.place_with(Unit::builder("depot", 11, "manager", 1)?, ring);
    let depot = depot.state(Depot::default()).build()?;
    let functions = depot.my_function_list();
    let take = |depot: &mut Depot, _: &Served, parcels: &mut ParametersView| depot.take(parcels);
    functions.add_service(&Definition::parse(STORE)?, ServiceOptions::new(), Depot::store)?;
    functions.add_service(&Definition::parse(TAKE)?, ServiceOptions::new(), take)?;
    depot.publish_my_function_list()?;
    depot.start()?;

    let ring = keys.ring(&Identity::m_unit("manager", 1)?)?;
    let manager = network.place_with(CommunicationSystem::builder("manager", 1)?, ring).build()?;
    let joined = manager.events();
    manager.start()?;
    manager.broadcast();
    joined.recv_timeout(PATIENCE)?;
    let peer = manager.s_unit("depot")?;
    if !peer.wait_for_function("take", PATIENCE) {
        bail!("the depot has not published its functions");
    }
    print!("{}", peer.their_function_list().show_functions());
    let mut parcels = Parameters::new();
    parcels.add_int("parcels", 1)?;
    for (function, count) in [("store", 5), ("take", 3), ("take", 3)] {
        parcels.set_value("parcels", count)?;
        match peer.block_request(function, &mut parcels) {
            Ok(()) => say!("{function} {count}: {} parcels are there", parcels.variable::<i64>("parcels")?),
            Err(error) => say!("{function} {count}: {error}"),
        }
    }
    say!("state: {:?}", depot.with_state(|depot| depot.clone())?);
    manager.stop();
    depot.stop();
    Ok(())
}
