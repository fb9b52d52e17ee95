//! The paper's listing in typed form: the AGV and its manager share the traits, and no name of a function or variable stands in
//! a text. Both run in one process here.

use std::ops::ControlFlow;
use std::thread::sleep;
use std::time::Duration;

use anyhow::Result;
use cara_examples::{Network, Stop, log_to_stderr, say};
use cara_std::keys::FleetKeys;
use cara_std::{CommunicationSystem, Identity, Renew, ServiceError, TypedCall, Unit, Variables, interface};
use clap::Parser;

/// How long a step of the AGV takes.
const STEP: Duration = Duration::from_millis(50);
/// The hall reaches this far from its middle.
const HALL: i64 = 100;
/// The code of the failure for a position that is out of it.
const OUT_OF_THE_HALL: u16 = 1;
/// How long the AGV may take to call its mechanic.
const PATIENCE: Duration = Duration::from_secs(10);

/// An AGV.
#[interface]
trait Agv {
    /// Tells where it is.
    #[idempotent]
    #[returns(position)]
    fn pos_info(&mut self) -> [i64; 2];

    /// Drives there, while its caller wants it, and tells how far it is.
    #[actuator(drive)]
    #[lease(ms = 400)]
    fn go_to(
        &mut self,
        call: &impl TypedCall<Left, Blocked>,
        #[unit = "m"] position: [i64; 2],
    ) -> Result<(), ServiceError>;
}

/// What it has to go, in metres.
#[derive(Variables)]
struct Left {
    left: i64,
}

/// Where it is when it cannot go on.
#[derive(Variables, Debug)]
struct Blocked {
    at: [i64; 2],
}

/// What a manager offers to its AGVs.
#[interface]
trait Mechanic {
    /// Tells in how many minutes a mechanic comes.
    #[returns(minutes)]
    fn call_mechanic(&mut self, #[size(64)] fault: &str) -> i64;
}

/// The AGV's state.
struct Vehicle {
    position: [i64; 2],
}

impl Vehicle {
    fn step(&mut self, to: [i64; 2]) {
        self.position.iter_mut().zip(to).for_each(|(at, to)| *at += (to - *at).signum());
    }

    fn left(&self, to: [i64; 2]) -> i64 {
        self.position.iter().zip(to).map(|(at, to)| (to - at).abs()).max().unwrap_or(0)
    }
}

impl Agv for Vehicle {
    fn pos_info(&mut self) -> [i64; 2] {
        self.position
    }

    fn go_to(&mut self, call: &impl TypedCall<Left, Blocked>, position: [i64; 2]) -> Result<(), ServiceError> {
        if position.iter().any(|side| side.abs() > HALL) {
            return Err(call.fail_with(OUT_OF_THE_HALL, "the hall ends before", &Blocked { at: self.position }));
        }
        say!("driving to {position:?}");
        while self.position != position {
            sleep(STEP);
            // No step is made once the order has ended.
            call.commit(|| self.step(position))?;
            call.progress(&Left { left: self.left(position) })?;
        }
        Ok(())
    }
}

/// The manager's state.
struct Workshop;

impl Mechanic for Workshop {
    fn call_mechanic(&mut self, fault: &str) -> i64 {
        say!("call_mechanic: {fault}");
        5
    }
}

/// The paper's listing with typed services: an AGV and its manager in one process.
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
    let keys = network.draw_keys(&["AGV_manager/1@m_unit", "agv-1/11"])?;
    let agv = agv(network, &keys)?;
    let ring = keys.ring(&Identity::m_unit("AGV_manager", 1)?)?;
    let builder = network.place_with(CommunicationSystem::builder("AGV_manager", 1)?, ring).state(Workshop);
    // The listing begins.
    let agv_manager = builder.build()?;
    agv_manager.start()?;
    while agv_manager.number_of_s_units() < 1 {
        agv_manager.broadcast();
        sleep(Duration::from_millis(100));
    }
    let s_unit = &agv_manager.s_units()[0];
    print!("{}", s_unit.their_function_list().show_functions());
    let client = AgvClient::at(s_unit).renewing(Renew::Process);
    let position = client.pos_info().wait()?;
    say!("position {position:?}");
    client.go_to([1, 2]).send()?;
    agv_manager.my_function_list().serve(MechanicServer)?;
    s_unit.publish_my_function_list()?;
    agv_manager.publish_my_function_list()?;
    // The listing ends.
    call_mechanic(&agv)?;
    for position in [[4, 6], [400, 6]] {
        let arrived = client
            .go_to(position)
            .watch(|Left { left }| {
                say!("{left} m to go");
                ControlFlow::Continue(())
            })
            .wait();
        match arrived {
            Ok(()) => say!("arrived at {position:?}"),
            Err(failed) => say!("{failed}: {:?}", failed.values()),
        }
    }
    say!("ended at {:?}", client.pos_info().wait()?);
    agv_manager.stop();
    agv.stop();
    Ok(())
}

fn agv(network: Network, keys: &FleetKeys) -> Result<Unit<Vehicle>> {
    let ring = keys.ring(&Identity::s_unit("agv-1", 11)?)?;
    let builder = network.place_with(Unit::builder("agv-1", 11, "AGV_manager", 1)?, ring);
    let agv = builder.state(Vehicle { position: [0, 0] }).build()?;
    // Each step is committed, so nothing moves behind the end of its order: the hook has nothing to switch off.
    let drive = agv.my_function_list().actuator(|| ())?;
    agv.my_function_list().serve(AgvServer { drive })?;
    agv.publish_my_function_list()?;
    agv.start()?;
    Ok(agv)
}

/// The AGV calls the mechanic that its manager offers.
fn call_mechanic(agv: &Unit<Vehicle>) -> Result<()> {
    let manager = agv.manager().ok_or(cara_std::Error::NotConnected)?;
    anyhow::ensure!(manager.wait_for_function("call_mechanic", PATIENCE), "no mechanic is offered");
    let minutes = MechanicClient::at(&manager).call_mechanic("a wheel squeaks").wait()?;
    say!("a mechanic comes in {minutes} minutes");
    Ok(())
}
