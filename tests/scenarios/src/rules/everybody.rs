//! Requests to every node, with an outcome for each.

use cara_core::error::{Error, ServiceError};

use crate::scenario::scenarios;
use crate::{Seen, Service, Spec, World, number, secs};

scenarios![
    a_blocking_request_to_all_has_an_outcome_for_each: "asynchronous request", Rough, [ThirdUnit], ["RequestsRun"];
    an_asynchronous_request_to_all_has_an_id_for_each: "asynchronous request", Rough, [ThirdUnit], ["failure came back"];
];

/// A manager with three AGVs that offer `note`, of which one fails, one that does not offer it, and one that has left; with the
/// service of the first two.
fn fleet(world: &mut dyn World) -> (crate::Unit, Service) {
    let service = Service::numbered("note");
    let failing = Service::numbered("note").does(|_, _| Err(ServiceError::Failed(7)));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("one", 1).service(&service));
    world.add(Spec::agv("two", 2).service(&service));
    world.add(Spec::agv("bad", 3).service(&failing));
    world.add(Spec::agv("other", 4).service(&Service::numbered("wave")));
    let gone = world.add(Spec::agv("gone", 5).service(&service));
    let offering = |function: &str| {
        let mut names: Vec<String> =
            manager.nodes_offering(function).iter().map(|node| node.name().to_owned()).collect();
        names.sort();
        names
    };
    let all = || offering("note").len() == 4 && offering("wave") == ["other"];
    world.wait("all have joined", all, secs(60));
    gone.stop();
    world.wait("one has left", || offering("note") == ["bad", "one", "two"], secs(20));
    (manager, service)
}

fn a_blocking_request_to_all_has_an_outcome_for_each(world: &mut dyn World) {
    let (manager, service) = fleet(world);
    manager.change(|limits| limits.request_timeout = secs(20));
    let outcomes = manager.begin_all("note", &number("n", 5));
    let outcomes = world.finish(&outcomes).expect("the manager runs");
    assert_eq!(outcomes.len(), 5);
    for (peer, outcome) in outcomes {
        let expected = match peer.name() {
            "bad" => Err(Error::Service(ServiceError::Failed(7))),
            "other" => Err(Error::UnknownFunction),
            "gone" => Err(Error::NotConnected),
            _ => Ok(()),
        };
        assert_eq!(outcome, expected, "{peer}");
    }
    assert_eq!(service.log().values(), [5, 5]);
}

fn an_asynchronous_request_to_all_has_an_id_for_each(world: &mut dyn World) {
    let (manager, service) = fleet(world);
    let requested = manager.request_all("note", &number("n", 5));
    let outcome = |name: &str| requested.iter().find(|(peer, _)| peer.name() == name).expect("it has an outcome").1;
    assert_eq!((outcome("other"), outcome("gone")), (Err(Error::UnknownFunction), Err(Error::NotConnected)));
    assert_eq!(
        (requested.len(), requested.iter().filter(|(_, result)| result.is_ok()).count()),
        (5, 3),
        "{requested:?}"
    );
    world.wait("two ran", || service.log().runs() == 2, secs(20));
    let failed = Seen::Failed(outcome("bad").expect("it was accepted"), Error::Service(ServiceError::Failed(7)));
    world.wait("the failure comes back", || manager.count(|event| *event == failed) == 1, secs(20));
    world.reached("failure came back");
}
