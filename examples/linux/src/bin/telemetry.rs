//! Best effort: an AGV streams its speed in datagrams, and its manager takes what comes. A lost measurement is not sent
//! again, and none delays a newer one.

use std::time::Duration;

use anyhow::Result;
use cara_apps::telemetry::{REPORT, Received, report};
use cara_examples::{NameAndId, Network, Stop, log_to_stderr, say};
use cara_std::{
    CommunicationSystem, Definition, Delivery, ParametersView, RequestOptions, Served, ServiceOptions, Unit, UnitEvent,
};
use clap::{Parser, Subcommand};

/// Time between two measurements.
const PERIOD: Duration = Duration::from_millis(10);
/// How often the receiver says what came.
const SHOW_EVERY: Duration = Duration::from_millis(200);

/// A stream of measurements between two processes.
#[derive(Parser)]
struct Options {
    #[command(subcommand)]
    role: Role,
    #[command(flatten)]
    network: Network,
}

#[derive(Subcommand)]
enum Role {
    /// Takes measurements until the AGV leaves.
    Receive {
        #[arg(long, default_value = "AGV_manager")]
        name: String,
        #[arg(long, default_value_t = 1)]
        id: u32,
    },
    /// Sends measurements.
    Send {
        #[arg(long, default_value = "agv-1")]
        name: String,
        #[arg(long, default_value_t = 11)]
        id: u32,
        #[arg(long, value_name = "NAME/ID", default_value = "AGV_manager/1")]
        manager: NameAndId,
        /// How many.
        #[arg(long, default_value_t = 500)]
        count: i64,
    },
}

fn main() -> Result<()> {
    let Options { role, network } = Options::parse();
    log_to_stderr();
    let stop = Stop::new(network.attended)?;
    match role {
        Role::Receive { name, id } => receive(&name, id, network, &stop),
        Role::Send { name, id, manager, count } => send((&name, id), &manager, count, network, &stop),
    }
}

fn receive(name: &str, id: u32, network: Network, stop: &Stop) -> Result<()> {
    let builder = network.place(CommunicationSystem::builder(name, id)?);
    let manager = builder.state(Received::default()).build()?;
    let take = |received: &mut Received, _: &Served, view: &mut ParametersView| received.report(view);
    manager.my_function_list().add_service(&Definition::parse(REPORT)?, ServiceOptions::new(), take)?;
    manager.publish_my_function_list()?;
    let (events, stopper) = (manager.events(), stop.stopper());
    std::thread::spawn(move || {
        if events.iter().any(|event| matches!(event, UnitEvent::Left { .. })) {
            stopper.stop(Ok(()));
        }
    });
    manager.start()?;
    manager.broadcast();
    let outcome = loop {
        if let Some(outcome) = stop.wait_for(SHOW_EVERY) {
            break outcome;
        }
        show(&manager)?;
    };
    show(&manager)?;
    manager.stop();
    outcome?;
    say!("ended");
    Ok(())
}

fn show(manager: &CommunicationSystem<Received>) -> Result<()> {
    let received = manager.with_state(|received| *received)?;
    say!("received {}, missed {}, speed {:.2}", received.count, received.missed(), received.speed);
    Ok(())
}

fn send((name, id): (&str, u32), manager: &NameAndId, count: i64, network: Network, stop: &Stop) -> Result<()> {
    let unit = network.place(Unit::builder(name, id, &manager.name, manager.id)?).build()?;
    unit.start()?;
    let best_effort = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::default() };
    let (mut number, mut refused) = (0, 0);
    while number < count {
        if let Some(outcome) = stop.wait_for(PERIOD) {
            return outcome;
        }
        let Some(manager) = unit.manager().filter(|manager| manager.their_function_list().contains("report")) else {
            continue;
        };
        number += 1;
        let speed = 1.0 + (number % 100) as f64 / 100.0;
        // A report that could not be sent is not an error: the next one follows.
        refused += i64::from(manager.call("report", &mut report(number, speed)?).with(best_effort).send().is_err());
    }
    say!("sent {number}, refused here {refused}");
    unit.stop();
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::Options;
    use clap::Parser;

    #[test]
    fn options_of_the_network_stand_on_either_side_of_the_role() {
        for words in [["telemetry", "send", "--loopback"], ["telemetry", "--loopback", "send"]] {
            assert!(Options::try_parse_from(words).unwrap().network.loopback);
        }
    }
}
