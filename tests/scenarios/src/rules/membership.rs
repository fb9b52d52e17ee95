//! Membership: which units connect.

use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::error::{CloseReason, Refusal};

use super::met;
use crate::scenario::scenarios;
use crate::{Fault, Seen, Service, Spec, Unit, UnknownClient, World, millis, number, secs};

scenarios![
    an_index_keeps_its_meaning_when_another_node_leaves: "47", Rough, [ThirdUnit], ["agv came back"];
    an_agv_joins_its_own_manager_only: "23", Rough, [ThirdUnit], ["WrongManager"];
    different_fleets_do_not_meet: "fleet", Rough, [ThirdUnit], ["DatagramFleet"];
    another_version_is_refused_by_name: "version", Rough, [UnknownClients],
        ["DatagramVersion", "datagram was counted", "client was told"];
    the_maximum_of_nodes_refuses_the_next: "51", Rough, [ThirdUnit], ["RefusedFull"];
    two_m_units_meet_and_call_both_ways: "18, 20", Rough, [], ["Dialled"];
    an_m_unit_meets_the_m_units_that_it_has_chosen: "a choice of m_units", Rough, [Choice, ThirdUnit], ["WrongManager"];
    an_m_unit_has_m_units_and_s_units: "16–17, 19", Rough, [ThirdUnit], ["Joined"];
    an_agv_finds_its_manager_at_a_new_address: "address change", Rough, [AddressChange], ["address-change"];
];

fn an_index_keeps_its_meaning_when_another_node_leaves(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let mut agvs = Vec::new();
    for (name, id) in [("one", 30), ("two", 20), ("three", 10)] {
        agvs.push(world.add(Spec::agv(name, id)));
        world.wait("it has joined", || manager.is_connected(name), secs(40));
    }
    let names = || manager.s_units().iter().map(|(identity, _)| identity.name().to_owned()).collect::<Vec<_>>();
    assert_eq!(names(), ["one", "two", "three"]);
    world.wait("all count", || manager.number_of_s_units() == 3, secs(10));
    agvs[1].stop();
    world.wait("two has left", || manager.number_of_s_units() == 2, secs(10));
    assert_eq!(names(), ["one", "two", "three"]);
    assert!(manager.s_units()[0].1 && !manager.s_units()[1].1 && manager.s_units()[2].1);
    agvs[1].start();
    world.wait("two is back", || manager.number_of_s_units() == 3, secs(40));
    world.reached("agv came back");
    assert_eq!(names(), ["one", "two", "three"]);
}

fn an_agv_joins_its_own_manager_only(world: &mut dyn World) {
    let other_id = world.add(Spec::manager("manager", 2));
    let other_name = world.add(Spec::manager("boss", 1));
    let agv = world.add(Spec::agv("agv", 7));
    world.run_for(millis(1_500));
    assert!(agv.peers().is_empty() && other_id.number_of_s_units() + other_name.number_of_s_units() == 0);
    let own = world.add(Spec::manager("manager", 1));
    world.wait("it has joined its own", || own.number_of_s_units() == 1 && !agv.peers().is_empty(), secs(40));
    assert_eq!(other_id.number_of_s_units() + other_name.number_of_s_units(), 0);
    assert_eq!(agv.peers(), [own.identity()]);
}

fn different_fleets_do_not_meet(world: &mut dyn World) {
    let here = world.add(Spec::manager("manager", 1));
    let there = world.add(Spec::manager("manager", 1).fleet(1));
    let agv = world.add(Spec::agv("agv", 7).fleet(1));
    world.wait("the fleet of the two meets", || there.number_of_s_units() == 1 && !agv.peers().is_empty(), secs(40));
    here.broadcast();
    world.run_for(millis(500));
    assert_eq!((here.peers(), agv.peers()), (vec![], vec![there.identity()]));
}

fn another_version_is_refused_by_name(world: &mut dyn World) {
    let service = Service::numbered("note");
    let (manager, _agv) = super::pair(world, &service);
    world.fault(Fault::UnknownClient(&manager, UnknownClient::OtherVersion));
    if manager.node_counted(NodeCounter::DatagramVersion) > 0 {
        world.reached("datagram was counted");
    }
    let refusal = Refusal::Version(UnknownClient::OTHER_VERSIONS);
    let refused = Seen::NotJoined(CloseReason::Refused(refusal));
    world.wait("this side shows it", || manager.count(|event| *event == refused) == 1, secs(20));
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn the_maximum_of_nodes_refuses_the_next(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1).limits(|limits| limits.maximum_nodes = 2));
    let _agvs = [world.add(Spec::agv("one", 1).service(&Service::numbered("note"))), world.add(Spec::agv("two", 2))];
    world.wait("two have joined", || manager.number_of_s_units() == 2, secs(40));
    met(world, &manager, "one", "note");
    let third = world.add(Spec::agv("three", 3));
    let full = Seen::NotJoined(CloseReason::Refused(Refusal::Full));
    world.wait("the third is told", || third.count(|event| *event == full) > 0, secs(40));
    assert_eq!(manager.number_of_s_units(), 2);
    assert_eq!(world.ask(&manager, "one", "note", &mut number("n", 1)), Ok(()), "those that are there go on");
    manager.change(|limits| limits.maximum_nodes = 3);
    world.wait("the third joins", || manager.number_of_s_units() == 3, secs(60));
    assert_eq!(world.ask(&manager, "one", "note", &mut number("n", 2)), Ok(()));
}

fn two_m_units_meet_and_call_both_ways(world: &mut dyn World) {
    let service = Service::numbered("note");
    let smaller = world.add(Spec::manager("a", 1).service(&service));
    let larger = world.add(Spec::manager("b", 2).service(&service));
    met(world, &smaller, "b", "note");
    met(world, &larger, "a", "note");
    assert_eq!(world.ask(&smaller, "b", "note", &mut number("n", 1)), Ok(()));
    assert_eq!(world.ask(&larger, "a", "note", &mut number("n", 2)), Ok(()));
    assert_eq!(service.log().values(), [1, 2]);
    assert!(smaller.node_counted(NodeCounter::Dialled) > 0);
    assert_eq!(larger.node_counted(NodeCounter::Dialled), 0, "the smaller identity dials");
}

fn an_m_unit_meets_the_m_units_that_it_has_chosen(world: &mut dyn World) {
    let service = Service::numbered("note");
    // `a` wants `b` alone, and `manager` wants neither; `station` wants all.
    let [a, b, manager, station] = [
        Spec::manager("a", 1).m_units(&[("b", 2)]),
        Spec::manager("b", 2).m_units(&[("station", 2), ("a", 1)]),
        Spec::manager("manager", 1).m_units(&[("station", 2)]),
        Spec::manager("station", 2),
    ]
    .map(|spec| world.add(spec.service(&service)));
    let agv = world.add(Spec::agv("agv", 7).service(&service));
    met(world, &a, "b", "note");
    met(world, &station, "b", "note");
    met(world, &station, "manager", "note");
    met(world, &manager, "agv", "note");
    world.wait("it is known", || !agv.peers().is_empty(), secs(10));
    world.run_for(secs(4));
    let peers = |unit: &Unit| {
        let mut names: Vec<_> = unit.peers().iter().map(|identity| identity.name().to_owned()).collect();
        names.sort();
        names
    };
    assert_eq!([peers(&a), peers(&b)], [vec!["b"], vec!["a", "station"]]);
    assert_eq!([peers(&manager), peers(&station)], [vec!["agv", "station"], vec!["b", "manager"]]);
    assert_eq!(world.ask(&a, "b", "note", &mut number("n", 1)), Ok(()));
}

/// The paper's figure 2: three m_units that know each other, and five s_units that know one of them each.
fn an_m_unit_has_m_units_and_s_units(world: &mut dyn World) {
    let service = Service::numbered("note");
    let m_units = [("one", 1), ("two", 2), ("station", 2)];
    let managers = m_units.map(|(name, id)| world.add(Spec::manager(name, id).service(&service)));
    let agvs = [0, 0, 1, 1, 2].into_iter().enumerate().map(|(number, own): (usize, usize)| {
        let (name, id) = m_units[own];
        let agv = Spec::agv(&format!("agv-{number}"), 10 + number as u32).joins(name, id);
        (world.add(agv.service(&service)), own)
    });
    let agvs: Vec<_> = agvs.collect();
    for (index, manager) in managers.iter().enumerate() {
        let own = agvs.iter().filter(|(_, own)| *own == index).count();
        let knows = || manager.nodes_offering("note").len() == 2 + own && manager.number_of_s_units() == own;
        world.wait("it knows two m_units and its s_units", knows, secs(40));
        assert_eq!(manager.peers().len(), 2 + own, "and nobody else");
    }
    for (agv, own) in &agvs {
        world.wait("it is known", || !agv.peers().is_empty(), secs(10));
        assert_eq!(agv.peers(), [managers[*own].identity()], "an s_unit has exactly one peer");
    }
    for manager in &managers {
        for node in manager.nodes_offering("note") {
            assert_eq!(world.ask(manager, node.name(), "note", &mut number("n", 1)), Ok(()));
        }
    }
    assert_eq!(service.log().values().len(), 3 * 2 + 5);
}

fn an_agv_finds_its_manager_at_a_new_address(world: &mut dyn World) {
    let (manager, agv) = super::pair(world, &Service::numbered("note"));
    world.fault(Fault::ChangeAddress(&manager));
    let lost = |unit: &Unit| unit.count(|event| matches!(event, Seen::Left(..))) > 0;
    world.wait("the loss is seen", || lost(&agv) && lost(&manager), secs(30));
    met(world, &manager, "agv", "note");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}
