//! What the unit's access table lets its operator do.

use cara_std::access::{Functions, OwnedRule, Rate, Verbs, Who};
use cara_std::control::protocol::{Answer, ArgumentValue, Question};

use crate::support::{Depot, argument, ask, call, refused, until};

fn rules(operator: &[&str], verbs: Verbs) -> Vec<OwnedRule> {
    let names = operator.iter().map(|&name| name.to_owned()).collect();
    vec![
        OwnedRule { who: Who::S_UNITS, functions: Functions::All, verbs: Verbs::ALL, rate: None },
        OwnedRule { who: Who::Operator, functions: Functions::Named(names), verbs, rate: None },
    ]
}

fn names(answers: &[Answer]) -> Vec<&str> {
    answers
        .iter()
        .filter_map(|answer| if let Answer::Function(known) = answer { Some(known.name.as_str()) } else { None })
        .collect()
}

fn error(answers: &[Answer]) -> Option<&str> {
    let [Answer::Called { error, .. }] = answers else { panic!("{answers:?}") };
    error.as_ref().map(|failure| failure.error.as_str())
}

#[test]
fn without_a_rule_of_its_own_the_operator_sees_and_calls_nothing() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let functions = || Question::Functions { node: "agv".into() };
    assert_eq!(names(&ask(&mut client, functions()).unwrap()).len(), 4);
    depot.system.set_access(Some(rules(&[], Verbs::ALL).into()));
    assert!(names(&ask(&mut client, functions()).unwrap()).is_empty());
    for question in [
        Question::Call(call(Some("agv"), "fail", vec![])),
        Question::Call(call(None, "fail", vec![])),
        Question::Hold(call(Some("agv"), "go_to", vec![])),
        Question::Nodes { offering: Some("fail".into()) },
    ] {
        assert_eq!(refused(&mut client, question), "NotAllowed");
    }
    let failure = ask(&mut client, Question::Call(call(Some("agv"), "fail", vec![]))).unwrap_err();
    assert!(failure.text.contains("'fail'") && failure.text.contains("operator"), "{failure}");
    let counted = depot.system.counters();
    assert!(counted.iter().any(|(name, count)| *name == "OperatorForbidden" && *count >= 4), "{counted:?}");
}

#[test]
fn the_operator_does_what_its_rule_allows_as_often_as_it_does() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let mut table = rules(&["fail"], Verbs::CALL);
    table[1].rate = Some(Rate::new(2, cara_std::Duration::from_secs(3600)));
    depot.system.set_access(Some(table.into()));
    assert_eq!(names(&ask(&mut client, Question::Functions { node: "agv".into() }).unwrap()), ["fail"]);
    let ask_fail = || Question::Call(call(Some("agv"), "fail", vec![]));
    for _ in 0..2 {
        assert_eq!(error(&ask(&mut client, ask_fail()).unwrap()), Some("Service"));
    }
    assert_eq!(refused(&mut client, ask_fail()), "TooSoon");
    assert_eq!(refused(&mut client, Question::Call(call(Some("agv"), "slow", vec![]))), "NotAllowed");
    let counted = depot.system.counters();
    assert!(counted.contains(&("OperatorForbidden", 2)), "each refusal is counted: {counted:?}");
}

#[test]
fn the_operator_takes_over_only_where_a_rule_says_so() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let take = || cara_std::control::protocol::CallQuestion { take_over: true, ..call(Some("agv"), "fail", vec![]) };
    depot.system.set_access(Some(rules(&["fail"], Verbs::CALL).into()));
    for question in [Question::Call(take()), Question::Hold(take())] {
        let failure = ask(&mut client, question).unwrap_err();
        assert!(failure.error == "NotAllowed" && failure.text.contains("take over 'fail'"), "{failure}");
    }
    depot.system.set_access(Some(rules(&["fail"], Verbs::CALL.and(Verbs::TAKE_OVER)).into()));
    assert_eq!(error(&ask(&mut client, Question::Call(take())).unwrap()), Some("Service"));
}

#[test]
fn no_rate_holds_off_a_stop_of_the_operator() {
    let (depot, agv) = Depot::with_agv();
    let nothing =
        |_: &cara_std::Served, _: &mut cara_std::ParametersView| -> Result<(), cara_std::ServiceError> { Ok(()) };
    let stops = cara_std::ServiceOptions::new().stops_all().priority(cara_std::Priority::Emergency);
    agv.my_function_list().add_service(&"halt()".parse().unwrap(), stops, nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    until("the manager knows it", || depot.system.nodes_offering("halt").len() == 1);
    let mut table = rules(&["halt", "fail"], Verbs::CALL);
    table[1].rate = Some(Rate::new(1, cara_std::Duration::from_secs(3600)));
    depot.system.set_access(Some(table.into()));
    let mut client = depot.client();
    for _ in 0..4 {
        assert_eq!(error(&ask(&mut client, Question::Call(call(Some("agv"), "halt", vec![]))).unwrap()), None);
    }
    let ask_fail = || Question::Call(call(Some("agv"), "fail", vec![]));
    assert!(ask(&mut client, ask_fail()).is_ok());
    assert_eq!(refused(&mut client, ask_fail()), "TooSoon", "of others it does");
}

#[test]
fn publishing_is_a_permission_too() {
    let depot = Depot::new();
    let list = depot.system.my_function_list();
    let nothing =
        |_: &cara_std::Served, _: &mut cara_std::ParametersView| -> Result<(), cara_std::ServiceError> { Ok(()) };
    list.add_service(&"report()".parse().unwrap(), cara_std::ServiceOptions::new(), nothing).unwrap();
    let publish = || Question::Publish { node: None, timeout_ms: 1_000 };
    depot.system.set_access(Some(rules(&["report"], Verbs::CALL).into()));
    assert_eq!(refused(&mut depot.client(), publish()), "NotAllowed");
    depot.system.set_access(Some(rules(&["report"], Verbs::PUBLISH).into()));
    assert_eq!(ask(&mut depot.client(), publish()), Ok(vec![]));
}

#[test]
fn what_the_operator_holds_ends_with_the_permission() {
    let (depot, _agv) = Depot::with_agv();
    depot.system.set_access(Some(rules(&["go_to"], Verbs::CALL).into()));
    let position = vec![argument("position", 2, ArgumentValue::Int(vec![1, 2]))];
    let mut client = depot.client();
    let mut answers = client.ask(&Question::Hold(call(Some("agv"), "go_to", position))).unwrap();
    assert!(matches!(answers.next(), Some(Ok(Answer::Called { error: None, .. }))));
    depot.system.set_access(Some(rules(&[], Verbs::CALL).into()));
    let end = answers.next().unwrap();
    assert!(end.as_ref().is_err_and(|error| error.to_string().contains("access table")), "{end:?}");
}
