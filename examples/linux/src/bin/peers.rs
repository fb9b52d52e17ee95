//! m_unit with m_unit: two equals that offer the same service and call each other's, in both directions.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use anyhow::Result;
use cara_examples::{Network, Stop, log_to_stderr, say};
use cara_std::{
    CommunicationSystem, Definition, Parameters, ParametersView, Peer, Served, ServiceError, ServiceOptions,
};
use clap::Parser;

/// Time between two looks and between two calls.
const PERIOD: Duration = Duration::from_millis(50);

/// One of two equals; start another one with another name and ID.
#[derive(Parser)]
struct Options {
    #[arg(long, default_value = "zone-1")]
    name: String,
    #[arg(long, default_value_t = 1)]
    id: u32,
    /// Calls that each of the two makes.
    #[arg(long, default_value_t = 5)]
    calls: u32,
    #[command(flatten)]
    network: Network,
}

/// What the other one has done here.
#[derive(Default)]
struct Done {
    calls: AtomicU32,
    finished: AtomicBool,
}

fn main() -> Result<()> {
    let Options { name, id, calls, network } = Options::parse();
    log_to_stderr();
    let stop = Stop::new(network.attended)?;
    let zone = network.place(CommunicationSystem::builder(&name, id)?).build()?;
    let served = offer(&zone)?;
    zone.start()?;
    zone.broadcast();
    let (mut made, mut reported) = (0, false);
    let outcome = loop {
        if let Some(outcome) = stop.wait_for(PERIOD) {
            break outcome;
        }
        let peer = other(&zone);
        match &peer {
            Some(peer) if made < calls => hand_over(peer, &mut made)?,
            Some(peer) if !reported => reported = notify(peer),
            _ => {}
        }
        // One of the two ends first; then the other one has no peer left to tell.
        if served.finished.load(Ordering::Acquire) && (reported || peer.is_none()) {
            break Ok(());
        }
    };
    say!("made {made} calls, served {}", served.calls.load(Ordering::Relaxed));
    zone.stop();
    outcome
}

/// Publishes `take_over`, and `finished`, by which the other one says that it needs nothing more.
fn offer(zone: &CommunicationSystem) -> Result<Arc<Done>> {
    let served = Arc::new(Done::default());
    let (at_take_over, at_finished) = (served.clone(), served.clone());
    let take_over = move |call: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        let agv: i64 = view.variable("agv")?;
        at_take_over.calls.fetch_add(1, Ordering::Relaxed);
        say!("served {}: agv {agv} taken over", call.caller);
        Ok(view.set_value("taken", true)?)
    };
    let finished = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        at_finished.finished.store(true, Ordering::Release);
        Ok(())
    };
    let functions = zone.my_function_list();
    let take_over_is = Definition::parse("take_over(agv: int) -> (taken: bool)")?;
    functions.add_service(&take_over_is, ServiceOptions::new(), take_over)?;
    functions.add_service(&Definition::parse("finished()")?, ServiceOptions::new().idempotent(), finished)?;
    zone.publish_my_function_list()?;
    Ok(served)
}

fn other(zone: &CommunicationSystem) -> Option<Peer> {
    zone.nodes_offering("take_over").into_iter().next()
}

/// Says that this one needs nothing more; whether it was heard.
fn notify(peer: &Peer) -> bool {
    let heard = peer.block_request("finished", &mut Parameters::new());
    heard.inspect_err(|error| say!("{} did not hear it: {error}", peer.identity())).is_ok()
}

fn hand_over(peer: &Peer, made: &mut u32) -> Result<()> {
    let mut parameters = Parameters::new();
    parameters.add_int("agv", 1)?;
    parameters.add_bool("taken", 1)?;
    parameters.set_value("agv", *made)?;
    peer.block_request("take_over", &mut parameters)?;
    say!("called {}: agv {made} taken over: {}", peer.identity(), parameters.variable::<bool>("taken")?);
    *made += 1;
    Ok(())
}
