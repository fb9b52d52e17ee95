//! What is asked about the unit and its nodes.

use std::ops::ControlFlow;

use cara_std::control::protocol::{Answer, NodeInfo, Question};
use cara_std::control::{Control, execute};
use cara_std::{Authority, Constraints, Duration, Error, Fleet, Identity, Key};

use crate::support::{Depot, PATIENCE, ask, call, manager, refused, until, vehicle, vehicle_of};

fn set(node: Option<&str>, constraint: &str, value: u64) -> Question {
    Question::Set { node: node.map(str::to_owned), constraint: constraint.to_owned(), value }
}

fn nodes(answers: &[Answer]) -> Vec<&NodeInfo> {
    answers.iter().filter_map(|answer| if let Answer::Node(node) = answer { Some(node) } else { None }).collect()
}

#[test]
fn the_unit_tells_who_it_is() {
    let depot = Depot::new();
    let mut client = depot.client();
    assert_eq!((client.unit().unit.as_str(), client.unit().fleet), ("manager/1", depot.fleet));
    let answers = ask(&mut client, Question::Unit).unwrap();
    let [Answer::Unit(unit)] = &answers[..] else { panic!("{answers:?}") };
    assert_eq!((unit.name.as_str(), unit.id, unit.role.as_str(), unit.fleet), ("manager", 1, "m_unit", depot.fleet));
    assert_eq!((unit.tcp_port, unit.discovery_port), (depot.system.tcp_port(), depot.system.discovery_port()));
    assert_eq!(unit.epoch, format!("{:016x}", depot.system.epoch().0));
    assert!(unit.interfaces.iter().any(|interface| interface.address == "127.0.0.1" && interface.up), "{unit:?}");
    assert_eq!(unit.constraints.request_timeout_us, Constraints::M_UNIT.request_timeout.as_micros());
    assert_eq!((unit.connected, unit.leading), (0, None));
    let again = ask(&mut client, Question::Unit).unwrap();
    assert!(matches!(&again[..], [Answer::Unit(later)] if later.uptime_ms >= unit.uptime_ms));
}

/// An authority that gives its key, until the test ends.
struct Always;

impl Authority for Always {
    fn hold(&mut self, _: &Identity, _: Fleet) -> Result<Option<Key>, Box<dyn std::error::Error + Send + Sync>> {
        Ok(Some(Key { revision: 7, lasts: PATIENCE.into() }))
    }

    fn release(&mut self) {}
}

#[test]
fn a_manager_with_an_authority_tells_whether_it_leads() {
    let depot = Depot::of(|fleet, directory| {
        manager("manager", 1, fleet).authority(Always).control(Control::Path(directory.join("manager.sock")))
    });
    let leading = |depot: &Depot| {
        let answers = ask(&mut depot.client(), Question::Unit).unwrap();
        let [Answer::Unit(unit)] = &answers[..] else { panic!("{answers:?}") };
        unit.leading
    };
    assert_eq!(leading(&depot), Some(true));
}

#[test]
fn nodes_are_told_with_what_is_known_of_them() {
    let (depot, agv) = Depot::with_agv();
    let mut client = depot.client();
    let answers = ask(&mut client, Question::Nodes { offering: None }).unwrap();
    let [node] = nodes(&answers)[..] else { panic!("{answers:?}") };
    assert_eq!((node.name.as_str(), node.id, node.role.as_str(), node.connected), ("agv", 7, "s_unit", true));
    assert_eq!((node.functions, node.version), (4, Some(2)));
    assert_eq!(node.epoch.as_deref(), Some(format!("{:016x}", agv.epoch().0).as_str()));
    assert_eq!(node.limits.unwrap().calls, agv.constraints().calls_per_peer);
    assert!(node.address.as_ref().unwrap().starts_with("127."), "{node:?}");
    let offering = |function: &str| Question::Nodes { offering: Some(function.to_owned()) };
    assert_eq!(nodes(&ask(&mut client, offering("go_to")).unwrap()).len(), 1);
    assert_eq!(nodes(&ask(&mut client, offering("fly")).unwrap()).len(), 0);
    agv.stop();
    until("it has left", || {
        let answers = ask(&mut client, Question::Nodes { offering: None }).unwrap();
        let node = nodes(&answers)[0].clone();
        !node.connected && node.limits.is_none() && node.epoch.is_none() && node.functions == 0
    });
}

#[test]
fn who_was_refused_is_told_by_name_with_the_reason() {
    let (depot, agv) = Depot::with_agv();
    let duplicate = vehicle("agv", 7, depot.fleet).build().unwrap();
    duplicate.start().unwrap();
    let mut client = depot.client();
    until("the duplicate is refused", || {
        let answers = ask(&mut client, Question::Nodes { offering: None }).unwrap();
        answers.iter().any(|answer| match answer {
            Answer::Refused(refused) => {
                assert!(refused.ago_ms < 60_000 && !refused.text.is_empty(), "{refused:?}");
                refused.node.as_deref() == Some("agv/7") && refused.reason == "DuplicateIdentity"
            }
            _ => false,
        })
    });
    let finding = depot.system.findings().remove(0);
    assert_eq!(finding.identity.as_ref().map(|identity| identity.id()), Some(7));
    // Once it has joined, that it was refused before is no news.
    agv.stop();
    until("the duplicate has joined", || duplicate.is_connected());
    until("it is not told as refused", || {
        let answers = ask(&mut client, Question::Nodes { offering: None }).unwrap();
        !answers.iter().any(|answer| matches!(answer, Answer::Refused(_)))
    });
}

#[test]
fn functions_are_told_with_their_attributes() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    for node in ["agv", "agv/7", "#7"] {
        let answers = ask(&mut client, Question::Functions { node: node.to_owned() }).unwrap();
        let functions: Vec<_> = answers
            .iter()
            .map(|answer| match answer {
                Answer::Function(function) => function,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(functions.len(), 4);
        let go_to = functions.iter().find(|function| function.name == "go_to").unwrap();
        assert_eq!(go_to.signature, "go_to(position: int[2])");
        assert_eq!(go_to.attributes.to_string(), "high, lease 2000 ms, idempotent");
        let fail = functions.iter().find(|function| function.name == "fail").unwrap();
        assert_eq!(fail.attributes.to_string(), "normal");
    }
}

#[test]
fn a_node_that_is_not_meant_alone_is_a_failure_that_lists_what_there_is() {
    let depot = Depot::new();
    let mut client = depot.client();
    let functions = |node: &str| Question::Functions { node: node.to_owned() };
    assert!(ask(&mut client, functions("duplicate")).unwrap_err().text.contains("none has joined"));
    let _agvs = [depot.agv("duplicate", 7), depot.agv("duplicate", 8)];
    let failure = ask(&mut client, functions("duplicate")).unwrap_err();
    assert_eq!((failure.error.as_str(), failure.cause.as_str()), ("AmbiguousNode", "configuration"));
    assert!(failure.text.contains("duplicate/7") && failure.text.contains("duplicate/8"), "{failure}");
    let failure = ask(&mut client, functions("duplicate/9")).unwrap_err();
    assert_eq!(failure.error, "UnknownNode");
    assert!(failure.text.contains("duplicate/7, duplicate/8"), "{failure}");
    assert!(ask(&mut client, functions("duplicate/8")).is_ok());
}

#[test]
fn every_question_about_a_node_fails_for_one_that_is_away() {
    let (depot, agv) = Depot::with_agv();
    agv.stop();
    until("it has left", || depot.system.number_of_s_units() == 0);
    let mut client = depot.client();
    let node = || "agv".to_owned();
    assert_eq!(refused(&mut client, Question::Functions { node: node() }), "NotConnected");
    let answers = ask(&mut client, crate::support::ping("agv", 1, 100)).unwrap();
    assert!(
        matches!(&answers[..], [Answer::Sample { us: None, error: Some(failure) }] if failure.error == "NotConnected")
    );
    let answers = ask(&mut client, Question::Call(call(Some("agv"), "echo", vec![]))).unwrap();
    assert!(matches!(&answers[..], [Answer::Called { error: Some(failure), .. }] if failure.error == "NotConnected"));
    let all = ask(&mut client, Question::Call(call(None, "echo", vec![]))).unwrap();
    let [Answer::Called { error: Some(failure), .. }] = &all[..] else { panic!("{all:?}") };
    assert_eq!(failure.error, "NotConnected");
}

#[test]
fn searching_and_publishing_are_done() {
    let (depot, agv) = Depot::with_agv();
    let mut client = depot.client();
    assert_eq!(ask(&mut client, Question::Search).unwrap(), []);
    let nothing =
        |_: &cara_std::Served, _: &mut cara_std::ParametersView| -> Result<(), cara_std::ServiceError> { Ok(()) };
    let add = |name: &str| {
        let definition = format!("{name}()").parse().unwrap();
        depot.system.my_function_list().add_service(&definition, Default::default(), nothing).unwrap();
    };
    let offers = |name: &str| agv.manager().unwrap().their_function_list().contains(name);
    add("one");
    assert_eq!(ask(&mut client, Question::Publish { node: Some("agv".into()), timeout_ms: 20_000 }).unwrap(), []);
    assert!(offers("one"));
    add("two");
    assert_eq!(ask(&mut client, Question::Publish { node: None, timeout_ms: 20_000 }).unwrap(), []);
    assert!(offers("two"));
    assert_eq!(refused(&mut client, Question::Publish { node: Some("x".into()), timeout_ms: 1 }), "UnknownNode");
}

#[test]
fn constraints_are_set_for_all_and_for_one() {
    let (depot, agv) = Depot::with_agv();
    let mut client = depot.client();
    let answers = ask(&mut client, set(None, "request_timeout", 1_500_000)).unwrap();
    assert!(matches!(&answers[..], [Answer::Constraints(now)] if now.request_timeout_us == 1_500_000), "{answers:?}");
    assert_eq!(depot.system.constraints().request_timeout, Duration::from_millis(1_500));
    let answers = ask(&mut client, set(Some("agv"), "minimum_interval_us", 30_000_000)).unwrap();
    assert!(matches!(&answers[..], [Answer::Constraints(now)] if now.minimum_interval_us == 30_000_000), "{answers:?}");
    assert_eq!(depot.system.constraints().minimum_interval, Duration::ZERO, "the others are not concerned");
    let peer = depot.system.s_unit("agv").unwrap();
    until("it is told", || agv.manager().unwrap().limits().is_some_and(|limits| limits.minimum_interval == 30_000_000));
    // One call, and the next one comes too soon.
    let mut asynchronous = call(Some("agv"), "fail", vec![]);
    asynchronous.asynchronous = true;
    ask(&mut client, Question::Call(asynchronous.clone())).unwrap();
    let answers = ask(&mut client, Question::Call(asynchronous)).unwrap();
    assert!(matches!(&answers[..], [Answer::Called { error: Some(failure), .. }] if failure.error == "TooSoon"));
    // What is set for all later leaves what was set for one, and so does a reconnection.
    ask(&mut client, set(None, "minimum_interval", 1)).unwrap();
    assert_eq!(peer.constraints().minimum_interval, Duration::from_secs(30));
    agv.stop();
    until("it has left", || !peer.is_connected());
    let again = depot.agv("agv", 7);
    until("it is told again", || {
        again.manager().and_then(|manager| manager.limits()).is_some_and(|limits| limits.minimum_interval == 30_000_000)
    });
    assert_eq!(peer.constraints().request_timeout, Duration::from_millis(1_500), "as it was when it was set");
}

#[test]
fn a_constraint_that_cannot_be_is_refused_with_its_bounds() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let before = depot.system.constraints();
    for (name, value, bound) in [
        ("maximum_nodes", 0, "1 to 65535"),
        ("maximum_nodes", u64::MAX, "ulimit -Hn"),
        ("message_size", 1 << 20, "262144"),
        ("chunk_size", 1, "4096"),
        ("chunk_size", 4097, "4096"),
        ("keep_alive", 1, "1000"),
        ("calls_per_peer", 0, "1 to"),
    ] {
        let failure = ask(&mut client, set(None, name, value)).unwrap_err();
        assert_eq!(failure.error, "BadConstraint", "{name} {value}");
        assert!(failure.text.contains(bound), "{name} {value}: {failure}");
    }
    let failure = ask(&mut client, set(None, "speed", 1)).unwrap_err();
    assert_eq!(failure.error, "UnknownConstraint");
    assert!(failure.text.contains("minimum_interval"), "{failure}");
    assert_eq!(refused(&mut client, set(Some("agv"), "speed", 1)), "UnknownConstraint");
    let failure = ask(&mut client, set(Some("agv"), "message_size", 2_000)).unwrap_err();
    assert!(failure.error == "BadConstraint" && failure.text.contains("one for all"), "{failure}");
    assert_eq!(refused(&mut client, set(Some("agv"), "calls_per_peer", 0)), "BadConstraint");
    assert_eq!(depot.system.constraints(), before);
    let peer = depot.system.s_unit("agv").unwrap();
    let other = Constraints { message_size: 2_000, ..before };
    assert_eq!(peer.set_constraints(other), Err(Error::BadConstraint));
    assert_eq!(peer.constraints(), before);
}

fn count(counters: &[(String, u64)], name: &str) -> u64 {
    counters.iter().find(|(known, _)| known == name).unwrap_or_else(|| panic!("no {name}")).1
}

#[test]
fn counters_are_told_and_sums_never_go_back() {
    let (depot, agv) = Depot::with_agv();
    let mut client = depot.client();
    ask(&mut client, Question::Call(call(Some("agv"), "fail", vec![]))).unwrap();
    let answers = ask(&mut client, Question::Counters { node: None }).unwrap();
    let [Answer::Counters { node: None, counters: unit }, Answer::Counters { node: Some(node), counters: link }] =
        &answers[..]
    else {
        panic!("{answers:?}")
    };
    assert_eq!(node, "agv/7");
    let mut names: Vec<_> = unit.iter().map(|(name, _)| name).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), unit.len(), "no name stands for two numbers");
    assert_eq!((count(unit, "Joined"), count(unit, "LinksOpen"), count(unit, "NodesConnected")), (1, 1, 1));
    assert_eq!((count(unit, "RequestsSent"), count(link, "RequestsSent")), (1, 1));
    let only = ask(&mut client, Question::Counters { node: Some("agv".into()) }).unwrap();
    assert!(matches!(&only[..], [Answer::Counters { node: Some(node), .. }] if node == "agv/7"));
    agv.stop();
    until("it has left", || depot.system.number_of_s_units() == 0);
    let unit = depot.system.counters();
    let find = |name: &str| unit.iter().find(|(known, _)| *known == name).unwrap().1;
    assert_eq!((find("RequestsSent"), find("LinksOpen"), find("NodesConnected")), (1, 0, 0));
    let peer = depot.system.s_unit("agv").unwrap();
    assert!(peer.counters().contains(&("RequestsSent", 1)));
    assert!(agv.counters().iter().any(|(name, value)| *name == "RequestsReceived" && *value == 1), "an s_unit alike");
    assert_eq!(refused(&mut client, Question::Counters { node: Some("x".into()) }), "UnknownNode");
}

#[test]
fn a_connection_without_room_is_counted() {
    // No other manager in its fleet: it would take the only link.
    let fleet = crate::support::fleet();
    let capacities = cara_std::Capacities { pending_links: 0, ..Default::default() };
    let constraints = Constraints { maximum_nodes: 1, ..Constraints::M_UNIT };
    let small = manager("small", 2, fleet).capacities(capacities).constraints(constraints);
    let small = small.control(cara_std::control::Control::Off).build().unwrap();
    small.start().unwrap();
    assert_eq!(small.control_path(), None);
    let agv = vehicle_of(("small", 2), "lone-agv", 9, fleet).build().unwrap();
    agv.start().unwrap();
    until("the only link is taken", || small.number_of_s_units() == 1);
    let refused = || small.counters().iter().find(|(name, _)| *name == "ConnectionsRefused").unwrap().1;
    let before = refused();
    let _silent: Vec<_> =
        (0..2).map(|_| std::net::TcpStream::connect(("127.0.0.1", small.tcp_port())).unwrap()).collect();
    until("both are dropped", || refused() >= before + 2);
    assert!(agv.is_connected());
}

/// What `--as NAME/ID` does.
#[test]
fn a_unit_of_this_process_answers_the_same() {
    let (depot, _agv) = Depot::with_agv();
    let mut answers = Vec::new();
    execute(&depot.system, &Question::Functions { node: "agv".into() }, &mut |answer| {
        answers.push(answer);
        ControlFlow::Continue(())
    });
    assert_eq!(answers.pop(), Some(Answer::Done));
    assert_eq!(answers, ask(&mut depot.client(), Question::Functions { node: "agv".into() }).unwrap());
    execute(&depot.system, &Question::Functions { node: "x".into() }, &mut |answer| {
        answers.push(answer);
        ControlFlow::Continue(())
    });
    assert!(matches!(answers.pop(), Some(Answer::Failed(failure)) if failure.error == "UnknownNode"));
    let mut count = 0;
    execute(&depot.system, &Question::Watch, &mut |_| {
        count += 1;
        ControlFlow::Break(())
    });
    assert_eq!(count, 1, "nothing follows when nobody reads any more");
}
