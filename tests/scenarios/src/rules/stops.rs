//! A stop ends what moves, and it stays: nothing begins before a reset that was asked for later.

use cara_core::config::Priority;
use cara_core::error::Error;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;

use super::met;
use crate::scenario::scenarios;
use crate::{Fault, Gate, Service, Spec, Unit, World, millis, number, secs};

scenarios![
    a_stop_of_all_stays_until_it_is_reset: "stop and reset", Light, [], ["RequestsRun"];
    a_reset_that_was_asked_for_before_a_stop_undoes_nothing: "stop and reset", Light, [], ["RequestsRun"];
    a_call_from_before_a_stop_never_begins: "stop and reset", Light, [Freeze], ["freeze", "was held up"];
];

const MOVED: [&str; 2] = ["drive", "lift"];
/// Of what the manager stopped.
const INHIBITED: Result<(), Error> = Err(Error::Inhibited { by: 1, reason: 0 });
const PATIENT: RequestOptions = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::renewing(Renew::Process) };

/// A vehicle with a drive and a fork, and its manager.
struct Vehicle {
    manager: Unit,
    agv: Unit,
    moved: [Service; 2],
    stop: Service,
    reset: Service,
}

impl Vehicle {
    /// The handler of the reset waits at this gate, if there is one.
    fn new(world: &mut dyn World, gate: Option<&Gate>) -> Self {
        // So long that nothing ends by time.
        let moved = MOVED.map(|name| Service::new(&format!("{name}(n: int[1])")).lease(secs(60)));
        let stop = Service::new("stop()").stops_all().priority(Priority::Emergency);
        let reset = Service::new("reset()").resets_all();
        // A board's emergency waits for nothing.
        let reset = if let Some(gate) = gate { reset.waits_at(gate) } else { reset.priority(Priority::Emergency) };
        let manager = world.add(Spec::manager("manager", 1));
        let services = [&moved[0], &moved[1], &stop, &reset];
        let agv = world.add(services.into_iter().fold(Spec::agv("agv", 7), Spec::service));
        for service in services {
            met(world, &manager, "agv", service.name());
        }
        Self { manager, agv, moved, stop, reset }
    }

    fn ask(&self, world: &mut dyn World, function: &str) -> Result<(), Error> {
        world.ask_with(&self.manager, "agv", function, &mut number("n", 1), PATIENT)
    }

    fn drives_and_lifts(&self, world: &mut dyn World) {
        assert_eq!(MOVED.map(|function| self.ask(world, function)), [Ok(()); 2]);
        assert_eq!(self.live(), [true; 2]);
    }

    fn live(&self) -> [bool; 2] {
        MOVED.map(|function| self.agv.lease_is_live(function))
    }

    fn is_stopped(&self, world: &mut dyn World) {
        assert_eq!(MOVED.map(|function| self.ask(world, function)), [INHIBITED; 2]);
        assert_eq!(self.live(), [false; 2]);
    }

    /// A reset counts from the earliest time at which it can have been asked for: one right behind the stop is refused.
    fn is_reset(&self, world: &mut dyn World) {
        let end = world.now() + secs(20);
        while let Err(refused) = self.ask(world, "reset") {
            assert!(refused == Error::Inhibited { by: 1, reason: 0 } && world.now() < end, "{refused:?}");
            world.run_for(millis(20));
        }
    }
}

fn a_stop_of_all_stays_until_it_is_reset(world: &mut dyn World) {
    let vehicle = Vehicle::new(world, None);
    vehicle.drives_and_lifts(world);
    assert_eq!(vehicle.ask(world, "stop"), Ok(()));
    assert_eq!(vehicle.live(), [false; 2]);
    let stops = || vehicle.moved.each_ref().map(|service| service.log().stops().len());
    world.wait("both hooks run", || stops() == [1; 2], secs(10));
    vehicle.is_stopped(world);
    // Neither time nor another stop resets it.
    world.run_for(secs(1));
    assert_eq!(vehicle.ask(world, "stop"), Ok(()));
    vehicle.is_stopped(world);
    vehicle.is_reset(world);
    assert_eq!(vehicle.live(), [false; 2], "what was stopped does not go on by itself");
    vehicle.drives_and_lifts(world);
    assert_eq!(stops(), [1; 2]);
}

fn a_reset_that_was_asked_for_before_a_stop_undoes_nothing(world: &mut dyn World) {
    let gate = Gate::default();
    let vehicle = Vehicle::new(world, Some(&gate));
    assert_eq!(vehicle.ask(world, "stop"), Ok(()));
    let runs = vehicle.reset.log().runs();
    let early = vehicle.manager.begin("agv", "reset", &number("n", 1), PATIENT);
    world.wait("its handler runs", || vehicle.reset.log().runs() == runs + 1, secs(20));
    assert_eq!(vehicle.ask(world, "stop"), Ok(()));
    gate.open();
    assert_eq!(world.finish(&early).map(drop), INHIBITED);
    vehicle.is_stopped(world);
    vehicle.is_reset(world);
    vehicle.drives_and_lifts(world);
}

/// The stop and the reset go ahead as datagrams while the stream is held up.
fn a_call_from_before_a_stop_never_begins(world: &mut dyn World) {
    let vehicle = Vehicle::new(world, None);
    vehicle.drives_and_lifts(world);
    world.fault(Fault::FreezeStreams(&vehicle.manager, &vehicle.agv, secs(2)));
    let early = vehicle.manager.begin("agv", "drive", &number("n", 1), PATIENT);
    world.run_for(millis(100));
    assert_eq!(vehicle.ask(world, "stop"), Ok(()));
    vehicle.is_reset(world);
    let [drives, _] = vehicle.moved.each_ref().map(Service::log);
    if !early.is_over() {
        world.reached("was held up");
    }
    assert_eq!(world.finish(&early).map(drop), Err(Error::Expired));
    assert_eq!((drives.runs(), vehicle.live()), (1, [false; 2]), "it was asked for before the stop");
    assert_eq!(vehicle.stop.log().runs(), 1);
    vehicle.drives_and_lifts(world);
}
