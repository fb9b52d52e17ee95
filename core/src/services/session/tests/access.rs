//! What the access table lets a peer see, call and publish.

use super::super::Event;
use super::pair::Pair;
use super::setup::Setup;
use super::side::Table;
use super::{none, x};
use crate::config::Priority;
use crate::error::Error;
use crate::host::connections::LinkCounter;
use crate::services::access::{Functions, Rate, Rule, Verb, Verbs, Who};
use crate::services::heart::Renew;
use crate::services::lease::LeaseEnd;
use crate::services::requests::CallId;
use crate::services::session::RequestOptions;
use crate::time::Duration;
use proptest::prelude::*;
use std::string::{String, ToString};
use std::vec;
use std::vec::Vec;

type Row = Rule<&'static str, Vec<&'static str>>;

const MANAGER: Who = Who::node("manager", 1);

fn row(who: Who, functions: &[&'static str], verbs: Verbs) -> Row {
    Rule { who, functions: Functions::Named(functions.to_vec()), verbs, rate: None }
}

fn table(rows: impl Into<Vec<Row>>) -> Option<Table> {
    Some(Table(rows.into()))
}

/// A pair whose AGV offers `pos_info` and `go`, with an access table.
fn under(table: Option<Table>) -> Pair {
    let mut pair = Pair::live();
    pair.agv.table = table;
    pair.agv.offer("pos_info() -> (position: int[2])", |pos| pos.set_value("position", [3, 4]));
    pair.agv.offer("go(x: int)", |_| Ok(()));
    pair.publish();
    pair
}

fn seen(pair: &Pair) -> Vec<String> {
    pair.manager.session.their_function_list().iter().map(|function| function.name().to_string()).collect()
}

/// The manager calls a function that was not published to it, by guessing its slot.
fn call_by_guess(pair: &mut Pair, definition: &str, slot: u16) -> Error {
    pair.manager.hear_of(definition, slot, 0);
    let (name, _) = definition.split_once('(').unwrap();
    let id = pair.manager.call(name, &x(1)).unwrap();
    pair.settle();
    pair.manager.outcome(id).unwrap().unwrap_err()
}

#[test]
fn a_peer_sees_and_calls_what_a_rule_allows_and_nothing_else() {
    let mut pair = under(table([row(MANAGER, &["pos_info"], Verbs::CALL)]));
    assert_eq!(seen(&pair), ["pos_info"]);
    let id = pair.manager.call("pos_info", &none()).unwrap();
    pair.settle();
    assert!(pair.manager.outcome(id).unwrap().is_ok());
    assert_eq!(pair.manager.call("go", &x(1)), Err(Error::UnknownFunction));
    assert_eq!(call_by_guess(&mut pair, "go(x: int)", 1), Error::NotAllowed);
    assert_eq!((pair.agv.ran(), pair.agv.counter(LinkCounter::RequestsForbidden)), (vec!["pos_info"], 1));
}

#[test]
fn taking_over_is_a_right_of_its_own() {
    let both = Verbs::CALL.and(Verbs::TAKE_OVER);
    let options = RequestOptions { take_over: true, ..RequestOptions::default() };
    let mut pair = under(table([row(MANAGER, &["go"], Verbs::CALL)]));
    let outcome = |pair: &mut Pair, options: &RequestOptions| {
        let id = pair.manager.request_with("go", &x(1), options, true).unwrap();
        pair.settle();
        pair.manager.outcome(id).unwrap().map(drop)
    };
    assert_eq!(outcome(&mut pair, &options), Err(Error::NotAllowed));
    assert_eq!(outcome(&mut pair, &RequestOptions::default()), Ok(()));
    pair.agv.set_table(table([row(MANAGER, &["go"], both)]));
    assert_eq!(outcome(&mut pair, &options), Ok(()));

    // The table changes while a call waits.
    let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
    pair.agv.offer_held("go(x: int)");
    pair.publish();
    let ids = [&RequestOptions::default(), &options]
        .map(|options| pair.manager.request_with("go", &x(1), options, true).unwrap());
    pair.settle();
    pair.agv.set_table(table([row(MANAGER, &["go"], Verbs::CALL)]));
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert_eq!(pair.manager.outcome(ids[1]).unwrap().unwrap_err(), Error::NotAllowed);
    assert_eq!(pair.agv.ran(), ["go"]);
}

#[test]
fn an_unlisted_peer_sees_nothing() {
    for rows in
        [vec![], vec![row(Who::node("manager", 2), &["go"], Verbs::ALL), row(Who::S_UNITS, &["go"], Verbs::ALL)]]
    {
        let mut pair = under(table(rows));
        assert!(seen(&pair).is_empty());
        assert_eq!(call_by_guess(&mut pair, "go(x: int)", 1), Error::NotAllowed);
        assert!(pair.agv.ran().is_empty());
    }
}

#[test]
fn what_may_be_listed_is_seen_and_not_called() {
    let mut pair = under(table([row(MANAGER, &["go"], Verbs::LIST)]));
    assert_eq!(seen(&pair), ["go"]);
    let id = pair.manager.call("go", &x(1)).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::NotAllowed);
    assert!(pair.agv.ran().is_empty());
}

/// An error about arguments would reveal that the function exists.
#[test]
fn a_request_is_refused_before_its_arguments_are_looked_at() {
    let mut pair = under(table([row(MANAGER, &["go"], Verbs::LIST)]));
    pair.manager.hear_of("go(x: string[40])", 1, 0);
    let text = super::parameters(|parameters| {
        parameters.add_string("x", 40).unwrap();
    });
    let id = pair.manager.call("go", &text).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::NotAllowed);
}

#[test]
fn an_asynchronous_request_is_refused_too_and_in_a_datagram_as_well() {
    let mut pair = under(table([row(MANAGER, &["go"], Verbs::LIST)]));
    let id = pair.manager.notify("go", &x(1)).unwrap();
    pair.run(Duration::from_millis(1));
    assert!(pair.manager.has(&Event::Failed(id, Error::NotAllowed)));
    let emergency = RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::default() };
    pair.manager.request_with("go", &x(1), &emergency, false).unwrap();
    pair.settle();
    assert!(pair.agv.ran().is_empty());
    assert!(pair.agv.counter(LinkCounter::RequestsForbidden) >= 2);
}

#[test]
fn a_change_of_the_table_withdraws_and_tells() {
    let mut pair = under(table([row(MANAGER, &["pos_info"], Verbs::CALL)]));
    let serial = pair.agv.set_table(table([row(MANAGER, &["go"], Verbs::CALL)]));
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 0 }));
    assert_eq!(seen(&pair), ["go"]);
    let id = pair.manager.call("go", &x(1)).unwrap();
    pair.settle();
    assert!(pair.manager.outcome(id).unwrap().is_ok());
    pair.agv.set_table(None);
    pair.settle();
    assert_eq!(seen(&pair).len(), 2, "without a table everything that is published is seen");
}

#[test]
fn a_call_that_waits_is_looked_at_again_before_it_begins() {
    let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
    pair.agv.offer_held("go(x: int)");
    pair.publish();
    let ids = [1, 2].map(|value| pair.manager.call("go", &x(value)).unwrap());
    pair.settle();
    assert_eq!(pair.agv.ran(), ["go"], "the second one waits");
    pair.agv.set_table(table([]));
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert_eq!(pair.manager.outcome(ids[0]).unwrap().unwrap_err(), Error::ResultLost, "what has begun is answered");
    assert_eq!(pair.manager.outcome(ids[1]).unwrap().unwrap_err(), Error::NotAllowed);
    assert_eq!((pair.agv.ran(), pair.agv.counter(LinkCounter::RequestsForbidden)), (vec!["go"], 1));
}

#[test]
fn a_lease_ends_with_the_permission() {
    let mut pair = Pair::live();
    let slots = [("go()", "go"), ("turn()", "turn")].map(|(definition, name)| {
        let slot = pair.agv.offer_leased(definition, Duration::from_millis(500));
        pair.publish();
        let renewed = RequestOptions { renew: Renew::Process, ..RequestOptions::default() };
        pair.manager.request_with(name, &none(), &renewed, true).unwrap();
        pair.settle();
        slot
    });
    pair.agv.set_table(table([row(MANAGER, &["turn"], Verbs::CALL)]));
    assert!(!pair.agv.is_live(slots[0]), "at once");
    pair.settle();
    assert!(pair.agv.has(&Event::LeaseExpired(slots[0])));
    assert!(pair.manager.is_reported(CallId(1), LeaseEnd::Expired));
    pair.run(Duration::from_secs(2));
    assert!(!pair.agv.is_live(slots[0]) && pair.agv.is_live(slots[1]));
}

#[test]
fn what_a_peer_may_not_publish_is_not_seen() {
    let mut pair = Pair::live();
    pair.manager.table = table([row(Who::S_UNITS, &["pos_info"], Verbs::PUBLISH)]);
    pair.agv.offer("pos_info() -> (position: int[2])", |_| Ok(()));
    pair.agv.offer("go(x: int)", |_| Ok(()));
    let serial = pair.agv.publish();
    pair.settle();
    assert_eq!(seen(&pair), ["pos_info"]);
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 0 }), "there was room");
    assert_eq!(pair.manager.counter(LinkCounter::FunctionsForbidden), 1);
    pair.manager.set_table(table([]));
    assert!(seen(&pair).is_empty(), "nor what it might before");
    assert_eq!(pair.manager.call("pos_info", &none()), Err(Error::UnknownFunction));
    pair.manager.set_table(table([row(Who::S_UNITS, &["go"], Verbs::PUBLISH)]));
    assert_eq!(seen(&pair), ["go"], "what it may from here on is there");
    assert!(pair.manager.call("go", &x(1)).is_ok());
    pair.manager.set_table(None);
    assert_eq!(seen(&pair).len(), 2);
}

#[test]
fn a_rate_refuses_what_comes_too_often_whatever_its_priority() {
    let rated = Row { rate: Some(Rate::per_second(2)), ..row(MANAGER, &["go"], Verbs::CALL) };
    let mut pair = under(table([rated, row(MANAGER, &["pos_info"], Verbs::CALL)]));
    let outcomes = |pair: &mut Pair, times: usize| {
        let ids: Vec<_> = (0..times).map(|_| pair.manager.call("go", &x(1)).unwrap()).collect();
        pair.settle();
        ids.iter().filter(|id| pair.manager.outcome(**id).unwrap().is_ok()).count()
    };
    assert_eq!(outcomes(&mut pair, 5), 2);
    pair.run(Duration::from_millis(500));
    assert_eq!(outcomes(&mut pair, 5), 1);
    let emergency = RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::default() };
    let id = pair.manager.request_with("go", &x(1), &emergency, true).unwrap();
    pair.settle();
    let refused = pair.manager.outcome(id).unwrap().unwrap_err();
    assert!(matches!(refused, Error::TooSoon { wait } if wait <= Duration::from_millis(500)), "{refused:?}");
    assert_eq!(pair.agv.counter(LinkCounter::RequestsTooSoon), 8);
    let id = pair.manager.call("pos_info", &none()).unwrap();
    pair.settle();
    assert!(pair.manager.outcome(id).unwrap().is_ok(), "another function has a rate of its own");
}

const NAMES: [&str; 3] = ["a", "b", "c"];

fn rows() -> impl Strategy<Value = Vec<Row>> {
    let who = prop::sample::select(vec![
        MANAGER,
        MANAGER,
        Who::ANYBODY,
        Who::M_UNITS,
        Who::S_UNITS,
        Who::Operator,
        Who::node("manager", 2),
    ]);
    let functions = prop::collection::vec(prop::sample::select(NAMES.to_vec()), 0..3);
    let verbs = prop::sample::select(vec![Verbs::NONE, Verbs::LIST, Verbs::CALL, Verbs::CALL, Verbs::ALL]);
    let rate = prop::sample::select(vec![None, None, Some(Rate::per_second(1))]);
    let row = (who, functions, verbs, rate).prop_map(|(who, functions, verbs, rate)| Row {
        who,
        functions: Functions::Named(functions),
        verbs,
        rate,
    });
    prop::collection::vec(row, 0..4)
}

#[derive(Clone, Debug)]
enum Step {
    /// Calls a function, published or not.
    Call(usize, Priority, bool),
    Answer,
    Change(Option<Vec<Row>>),
    Wait,
}

fn step() -> impl Strategy<Value = Step> {
    let priority = prop::sample::select(Priority::ALL.to_vec());
    prop_oneof![
        5 => (0..NAMES.len(), priority, any::<bool>()).prop_map(|(which, priority, reply)| Step::Call(which, priority, reply)),
        3 => Just(Step::Answer),
        2 => prop::option::weighted(0.9, rows()).prop_map(Step::Change),
        1 => Just(Step::Wait),
    ]
}

/// The rules once more, without the code under test, for this one manager.
fn allows(rows: &[Row], function: &str) -> bool {
    rows.iter().any(|row| {
        let Functions::Named(names) = &row.functions else { return false };
        [MANAGER, Who::ANYBODY, Who::M_UNITS].contains(&row.who)
            && names.contains(&function)
            && row.verbs.contains(Verb::Call)
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn whatever_the_table_only_what_it_allows_is_run(first in rows(), steps in prop::collection::vec(step(), 1..40)) {
        let mut pair = Pair::live();
        for name in NAMES {
            pair.agv.offer_held(&std::format!("{name}(x: int)"));
        }
        pair.agv.table = table(first.clone());
        pair.publish();
        let mut current = Some(first);
        let mut before = 0;
        for step in steps {
            match step {
                Step::Call(which, priority, reply) => {
                    pair.manager.hear_of(&std::format!("{}(x: int)", NAMES[which]), which as u16, 0);
                    let options = RequestOptions { priority: Some(priority), ..RequestOptions::default() };
                    // This end refuses calls beyond its own limit.
                    let _ = pair.manager.request_with(NAMES[which], &x(1), &options, reply);
                }
                Step::Answer if !pair.agv.held.is_empty() => pair.agv.answer_held(Ok(&*none())),
                Step::Answer => {}
                Step::Change(rows) => {
                    pair.agv.set_table(rows.clone().map(Table));
                    current = rows;
                }
                Step::Wait => pair.run(Duration::from_millis(700)),
            }
            pair.settle();
            let ran = pair.agv.ran();
            for function in &ran[before..] {
                prop_assert!(current.as_ref().is_none_or(|rows| allows(rows, function)), "{function} ran under {current:?}");
            }
            before = ran.len();
            for name in NAMES {
                let may_call = current.as_ref().is_none_or(|rows| allows(rows, name));
                prop_assert!(!may_call || seen(&pair).iter().any(|seen| seen == name), "{name} is not seen under {current:?}");
            }
        }
    }
}
