//! Requests to every node, with an outcome for each.

use cara_core::error::{Error, ServiceError};

use crate::scenario::scenarios;
use crate::{Seen, Service, Spec, World, number, secs};

scenarios![
    a_blocking_request_to_all_has_an_outcome_for_each: "asynchronous request", Rough, [], ["RequestsRun"];
    an_asynchronous_request_to_all_has_an_id_for_each: "asynchronous request", Rough, [], ["failure came back"];
];

/// A manager with three AGVs, of which one fails; with the service of the others.
fn fleet(world: &mut dyn World) -> (crate::Unit, Service) {
    let service = Service::numbered("note");
    let failing = Service::numbered("note").does(|_, _| Err(ServiceError::Failed(7)));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("one", 1).service(&service));
    world.add(Spec::agv("two", 2).service(&service));
    world.add(Spec::agv("bad", 3).service(&failing));
    world.wait("all have joined", || manager.nodes_offering("note").len() == 3, secs(60));
    (manager, service)
}

fn a_blocking_request_to_all_has_an_outcome_for_each(world: &mut dyn World) {
    let (manager, service) = fleet(world);
    manager.change(|limits| limits.request_timeout = secs(20));
    let outcomes = manager.begin_all("note", &number("n", 5));
    let outcomes = world.finish(&outcomes).expect("the manager runs");
    assert_eq!(outcomes.len(), 3);
    for (peer, outcome) in outcomes {
        let expected = if peer.name() == "bad" { Err(Error::Service(ServiceError::Failed(7))) } else { Ok(()) };
        assert_eq!(outcome, expected, "{peer}");
    }
    assert_eq!(service.diary().values(), [5, 5]);
}

fn an_asynchronous_request_to_all_has_an_id_for_each(world: &mut dyn World) {
    let (manager, service) = fleet(world);
    let requested = manager.request_all("note", &number("n", 5));
    assert_eq!(requested.len(), 3);
    assert!(requested.iter().all(|(_, result)| result.is_ok()), "{requested:?}");
    let bad = requested.iter().find(|(peer, _)| peer.name() == "bad").expect("it was asked").1;
    world.wait("two ran", || service.diary().runs() == 2, secs(20));
    let failed = Seen::Failed(bad.expect("it was accepted"), Error::Service(ServiceError::Failed(7)));
    world.wait("the failure comes back", || manager.count(|event| *event == failed) == 1, secs(20));
    world.reached("failure came back");
}
