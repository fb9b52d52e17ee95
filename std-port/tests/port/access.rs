//! Access control: tables that are set, and files that change while the unit runs.

use std::fs;
use std::io::Write;
use std::path::Path;

use cara_std::access::{AccessError, AccessTable, Functions, OwnedRule, Rate, Verbs, Who};
use cara_std::{Error, Unit};

use crate::support::{ask, counter, fleet, meet, number, pair, service, system, unit, until};

fn rule(who: Who<String>, functions: &[&str], verbs: Verbs) -> OwnedRule {
    let names = functions.iter().map(|&name| name.to_owned()).collect();
    OwnedRule { who, functions: Functions::Named(names), verbs, rate: None }
}

fn manager() -> Who<String> {
    Who::node("manager".to_owned(), 1)
}

fn offer(agv: &Unit) {
    for name in ["go", "stop"] {
        agv.my_function_list().add_function(name, &number(0), service(|number| number + 1)).unwrap();
    }
}

#[test]
fn a_table_that_is_set_while_the_unit_runs_is_in_force_at_once() {
    let (manager_system, agv) = pair();
    offer(&agv);
    let (peer, _) = meet(&manager_system, &agv);
    assert_eq!((ask(&peer, "go", 1), agv.access()), (Ok(2), None));
    agv.set_access(Some(vec![rule(manager(), &["stop"], Verbs::CALL)].into()));
    // Whether or not the manager has read the news yet.
    let refused = ask(&peer, "go", 1);
    assert!(matches!(refused, Err(Error::NotAllowed | Error::UnknownFunction)), "{refused:?}");
    assert_eq!(ask(&peer, "stop", 1), Ok(2));
    until("it sees what it may", || peer.their_function_list().names().collect::<Vec<_>>() == ["stop"]);
    agv.set_access(Some(vec![rule(manager(), &["go"], Verbs::LIST)].into()));
    until("it sees the other", || peer.their_function_list().names().collect::<Vec<_>>() == ["go"]);
    assert_eq!(ask(&peer, "go", 1), Err(Error::NotAllowed));
    assert!(counter(&agv.counters(), "RequestsForbidden") >= 1);
    agv.set_access(None);
    until("it sees everything", || peer.their_function_list().len() == 2);
    assert_eq!(ask(&peer, "go", 1), Ok(2));
}

#[test]
fn what_a_vehicle_may_not_publish_cannot_be_called_and_is_there_when_it_may() {
    let fleet = fleet();
    let publish = |functions: &[&str]| vec![rule(Who::S_UNITS, functions, Verbs::PUBLISH)].into();
    let system = system(fleet).access(publish(&["stop"])).build().unwrap();
    let agv = unit("agv", 7, fleet).build().unwrap();
    offer(&agv);
    agv.publish_my_function_list().unwrap();
    system.start().unwrap();
    agv.start().unwrap();
    until("the list has come", || system.nodes_offering("stop").len() == 1);
    let peer = system.s_unit("agv").unwrap();
    assert_eq!(ask(&peer, "go", 1), Err(Error::UnknownFunction));
    assert_eq!(counter(&peer.counters(), "FunctionsForbidden"), 1);
    system.set_access(Some(publish(&["go"])));
    assert_eq!((ask(&peer, "go", 1), ask(&peer, "stop", 1)), (Ok(2), Err(Error::UnknownFunction)));
}

#[test]
fn a_rate_is_kept_and_a_blocking_call_is_told() {
    let (manager_system, agv) = pair();
    offer(&agv);
    // Slow enough that a loaded machine does not give a call back meanwhile.
    let rare = Rate::new(2, cara_std::Duration::from_secs(3600));
    let rated = OwnedRule { rate: Some(rare), ..rule(manager(), &["go"], Verbs::CALL) };
    agv.set_access(Some(vec![rated].into()));
    agv.publish_my_function_list().unwrap();
    manager_system.start().unwrap();
    agv.start().unwrap();
    until("the list has come", || manager_system.nodes_offering("go").len() == 1);
    let peer = manager_system.s_unit("agv").unwrap();
    assert_eq!([1, 2].map(|value| ask(&peer, "go", value)), [Ok(2), Ok(3)]);
    assert!(matches!(ask(&peer, "go", 3), Err(Error::TooSoon { .. })));
    assert!(counter(&agv.counters(), "RequestsTooSoon") >= 1);
}

fn write(path: &Path, text: &str) {
    let new = path.with_extension("new");
    fs::write(&new, text).unwrap();
    fs::rename(new, path).unwrap();
}

fn allowing(functions: &str) -> String {
    format!("[[allow]]\nwho = \"manager/1\"\nfunctions = {functions}\nverbs = \"call\"\n")
}

#[test]
fn a_file_is_followed_and_a_mistake_keeps_what_is_in_force() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("access.toml");
    let fleet = fleet();
    assert!(matches!(unit("agv", 7, fleet).access_file(&path), Err(AccessError::Unreadable { .. })));
    write(&path, "[[allow]]\nwho = \"manager\"\n");
    let error = unit("agv", 7, fleet).access_file(&path).err().unwrap().to_string();
    assert!(error.contains("access.toml:2:7: 'manager' names no node"), "{error}");
    write(&path, &allowing("\"stop\""));

    let system = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).access_file(&path).unwrap().build().unwrap();
    offer(&agv);
    agv.publish_my_function_list().unwrap();
    system.start().unwrap();
    agv.start().unwrap();
    until("the list has come", || system.nodes_offering("stop").len() == 1);
    let peer = system.s_unit("agv").unwrap();
    assert_eq!((ask(&peer, "stop", 1), ask(&peer, "go", 1)), (Ok(2), Err(Error::UnknownFunction)));

    write(&path, &allowing("\"go\""));
    until("the new table is in force", || system.nodes_offering("go").len() == 1);
    until("the old one is not", || system.nodes_offering("stop").is_empty());
    assert_eq!(ask(&peer, "go", 1), Ok(2));
    let wrong = |agv: &Unit| counter(&agv.counters(), "AccessFileWrong");
    // The table is in force before it is counted.
    until("it is counted", || counter(&agv.counters(), "AccessReloads") == 1);
    assert_eq!(wrong(&agv), 0);

    let old = agv.access().unwrap();
    // In place this time, and in one write: a file that is empty for long is a table without rules.
    let mistake = allowing("[\"go to\"]");
    assert!(mistake.len() as u64 >= path.metadata().unwrap().len());
    fs::OpenOptions::new().write(true).open(&path).unwrap().write_all(mistake.as_bytes()).unwrap();
    until("the mistake is seen", || wrong(&agv) == 1);
    assert_eq!((agv.access().unwrap(), ask(&peer, "go", 1)), (old, Ok(2)));
    fs::remove_file(&path).unwrap();
    until("it is gone", || counter(&agv.counters(), "AccessMistakes") == 2);
    assert_eq!(ask(&peer, "go", 1), Ok(2));
    write(&path, &allowing("\"*\""));
    until("it is corrected", || wrong(&agv) == 0 && peer.their_function_list().len() == 2);
}

#[test]
fn the_rules_of_a_board_are_a_table_here_as_well() {
    use cara_std::access::{Principal, Rule, Verb};
    const RULES: [Rule; 1] =
        [Rule::new(Who::node("manager", 1), Functions::Named(&["stop"]), Verbs::CALL).at(Rate::per_second(3))];
    let table = AccessTable::from(&RULES[..]);
    assert_eq!(table.to_string(), "manager/1 may call stop, 3/s\n");
    let identity = cara_std::Identity::m_unit("manager", 1).unwrap();
    assert!(table.decide(Principal::Node(&identity), "stop", Verb::Call).is_allowed());
}
