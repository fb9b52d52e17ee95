//! A request runs at most once, whatever the network does to it.

use cara_core::config::Priority;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::{Delivery, RequestOptions};
use cara_sim::Path;

use super::pair;
use crate::scenario::scenarios;
use crate::{Fault, Seen, Service, World, millis, number, secs};

scenarios![
    a_doubled_datagram_runs_once: "at most once", Own, [Path], ["duplicate", "reorder", "RequestsRepeated"];
    an_emergency_travels_twice_and_runs_once: "at most once", Rough, [], ["RequestsRepeated"];
    calls_run_in_the_order_of_asking: "at most once", Rough, [], ["RequestsRun"];
];

fn distinct(mut values: Vec<i64>) -> usize {
    values.sort_unstable();
    values.dedup();
    values.len()
}

fn a_doubled_datagram_runs_once(world: &mut dyn World) {
    let service = Service::numbered("note");
    let (manager, agv) = pair(world, &service);
    let path = Path::LAN.duplicate_percent(100.0).reorder_percent(20.0).jitter(millis(3));
    world.fault(Fault::Path(&manager, &agv, path));
    let options = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::default() };
    for n in 0..40 {
        manager.request_with("agv", "note", &number("n", n), options).expect("it is accepted");
        world.run_for(millis(1));
    }
    world.run_for(millis(500));
    let values = service.log().values();
    assert_eq!(distinct(values.clone()), values.len(), "a request ran twice: {values:?}");
    assert_eq!(values.len(), 40, "nothing was lost");
    // Where datagrams are sealed their numbers tell the second copies first.
    assert!(agv.counted(LinkCounter::RequestsRepeated) + agv.counted(LinkCounter::DatagramsRepeated) > 0);
}

fn an_emergency_travels_twice_and_runs_once(world: &mut dyn World) {
    let service = Service::numbered("stop").priority(Priority::Emergency);
    let (manager, agv) = pair(world, &service);
    for n in 0..20 {
        manager.request("agv", "stop", &number("n", n)).expect("it is accepted");
        world.run_for(millis(20));
    }
    // Those that come all at once after a cut may find the reserved place taken; then the caller is told.
    let reported = || manager.count(|event| matches!(event, Seen::Failed(_, Error::Busy | Error::Expired)));
    world.wait("each ran or was reported", || service.log().runs() + reported() == 20, secs(20));
    world.wait("second copies came", || agv.counted(LinkCounter::RequestsRepeated) > 0, secs(20));
    world.run_for(millis(100));
    let values = service.log().values();
    assert_eq!(distinct(values.clone()), values.len(), "an emergency ran twice: {values:?}");
    assert_eq!(values.len() + reported(), 20);
}

fn calls_run_in_the_order_of_asking(world: &mut dyn World) {
    let service = Service::numbered("note").in_turns();
    let (manager, _agv) = pair(world, &service);
    let options = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::default() };
    let mut accepted = Vec::new();
    for n in 0..30 {
        if manager.request_with("agv", "note", &number("n", n), options).is_ok() {
            accepted.push(n);
        }
        if n % 4 == 3 {
            let wanted = accepted.len();
            world.wait("they ran", || service.log().runs() == wanted, secs(20));
        }
    }
    world.wait("all ran", || service.log().runs() == accepted.len(), secs(20));
    assert_eq!(service.log().values(), accepted);
}
