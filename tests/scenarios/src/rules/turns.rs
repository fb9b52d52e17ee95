//! A call that has begun and waits for its turn is looked at once more before its handler runs.

use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;

use super::met;
use crate::scenario::scenarios;
use crate::{Gate, Pending, Service, Spec, Unit, World, millis, number, secs};

scenarios![
    a_call_whose_order_ends_while_it_waits_does_not_begin: "lease of a service", Light, [Turns], [];
    a_call_whose_caller_goes_while_it_waits_does_not_begin: "execution", Light, [Turns], [];
];

const PATIENT: RequestOptions = RequestOptions { timeout: Some(secs(50)), ..RequestOptions::renewing(Renew::Process) };

/// Two calls: the handler of the first runs, and waits at a gate; the second has begun, and waits for its turn.
fn two(world: &mut dyn World, manager: &Unit, agv: &Unit, service: &Service, options: RequestOptions) -> [Pending; 2] {
    let (log, before) = (service.log(), service.log().runs());
    let call = |n| manager.begin("agv", service.name(), &number("n", n), options);
    let first = call(1);
    world.wait("the first one runs", || log.runs() == before + 1, secs(20));
    let started = agv.counted(LinkCounter::RequestsRun);
    let second = call(2);
    world.wait("the second one has begun", || agv.counted(LinkCounter::RequestsRun) > started, secs(20));
    [first, second]
}

fn a_call_whose_order_ends_while_it_waits_does_not_begin(world: &mut dyn World) {
    let gate = Gate::default();
    // The one ends by time; a minute is longer than any wait here.
    let of = |name: &str, lease| Service::new(&format!("{name}(n: int[1])")).lease(lease).in_turns().waits_at(&gate);
    let short = if world.is_virtual() { millis(400) } else { secs(2) };
    let (nudge, drive) = (of("nudge", short), of("drive", secs(60)));
    let stop = Service::new("stop()").stops_all();
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&nudge).service(&drive).service(&stop));
    for function in ["nudge", "drive", "stop"] {
        met(world, &manager, "agv", function);
    }
    for end in ["time", "release", "stop"] {
        gate.close();
        let service = if end == "time" { &nudge } else { &drive };
        let renew = if end == "time" { Renew::Never } else { Renew::Process };
        let (log, runs, stops) = (service.log(), service.log().runs(), service.log().stops().len());
        let [first, second] = two(world, &manager, &agv, service, RequestOptions { renew, ..PATIENT });
        match end {
            "release" => manager.release("agv", "drive").expect("it is connected"),
            "stop" => assert_eq!(world.ask(&manager, "agv", "stop", &mut number("n", 1)), Ok(())),
            _ => {}
        }
        world.wait("the safe hook runs", || log.stops().len() > stops, secs(20));
        assert!(!agv.lease_is_live(service.name()) && !first.is_over());
        gate.open();
        world.wait("both end", || first.is_over() && second.is_over(), secs(20));
        assert_eq!(second.outcome(), Some(Err(Error::Expired)), "its order has ended: {end}");
        assert_eq!(log.runs(), runs + 1, "it has begun although its order has ended: {end}");
    }
}

/// Calls that wait for a task of a board at the same time.
const WAITING: i64 = 4;

fn a_call_whose_caller_goes_while_it_waits_does_not_begin(world: &mut dyn World) {
    let gate = Gate::default();
    let service = Service::new("work(n: int[1])").in_turns().waits_at(&gate);
    let other = Service::new("other(n: int[1])").takes(millis(1));
    let manager = world.add(Spec::manager("manager", 1));
    let agv = Spec::agv("agv", 7).service(&service).service(&other).limits(|limits| limits.calls_per_peer = 8);
    let agv = world.add(agv);
    met(world, &manager, "agv", "work");
    met(world, &manager, "agv", "other");
    two(world, &manager, &agv, &service, PATIENT);
    let started = agv.counted(LinkCounter::RequestsRun);
    (1..WAITING).for_each(|n| drop(manager.begin("agv", "work", &number("n", n), PATIENT)));
    world.wait("all wait", || agv.counted(LinkCounter::RequestsRun) + 1 == started + WAITING as u64, secs(20));
    manager.stop();
    world.wait("it has gone", || !agv.is_connected("manager"), secs(20));
    manager.start();
    met(world, &manager, "agv", "other");
    let asked = world.ask(&manager, "agv", "other", &mut number("n", 1));
    assert_eq!(asked, Ok(()), "what waited for the caller that has gone takes no place");
    gate.open();
    world.wait("the handler of the first one ends", || !service.log().ended().is_empty(), secs(20));
    world.run_for(millis(500));
    assert_eq!(service.log().runs(), 1, "nobody waits for the others");
}
