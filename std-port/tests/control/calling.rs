//! Calls, round trips and events.

use std::ops::ControlFlow;

use cara_std::control::execute;
use cara_std::control::protocol::{Answer, ArgumentValue, CallQuestion, Failure, LONGEST_LINE, Number, Question};
use cara_std::{Parameters, ParametersView, Served, ServiceError, ServiceOptions};

use crate::support::{Depot, argument, ask, call, ping, refused, until};

fn every_type() -> Vec<cara_std::control::protocol::Argument> {
    let floats = vec![
        Number::Finite(0.1),
        Number::Other("NaN".into()),
        Number::Other("-inf".into()),
        Number::Finite(f64::MIN_POSITIVE),
    ];
    vec![
        argument("i", 2, ArgumentValue::Int(vec![i64::MIN, i64::MAX])),
        argument("f", 4, ArgumentValue::Float(floats)),
        argument("s", 20, ArgumentValue::String("Fähre \"7\"\n".into())),
        argument("b", 2, ArgumentValue::Bool(vec![true, false])),
        argument("y", 8, ArgumentValue::Bytes("00ff7f".into())),
    ]
}

/// The only outcome.
fn outcome(answers: &[Answer]) -> Result<Vec<cara_std::control::protocol::Argument>, Failure> {
    let [Answer::Called { node, id, results, error, .. }] = answers else { panic!("{answers:?}") };
    assert_eq!((node.as_str(), *id), ("agv", 7));
    error.clone().map_or(Ok(results.clone()), Err)
}

#[test]
fn a_call_takes_every_type_both_ways() {
    let (depot, _agv) = Depot::with_agv();
    let answers = ask(&mut depot.client(), Question::Call(call(Some("agv"), "echo", every_type()))).unwrap();
    assert_eq!(outcome(&answers).unwrap(), every_type());
    assert!(matches!(&answers[..], [Answer::Called { call: None, took_us, .. }] if *took_us > 0));
}

#[test]
fn a_call_that_cannot_be_says_what_is_wrong_and_shows_the_signature() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let mut failure = |function: &str, arguments| {
        outcome(&ask(&mut client, Question::Call(call(Some("agv"), function, arguments))).unwrap()).unwrap_err()
    };
    let unknown = failure("fly", vec![]);
    assert_eq!(unknown.error, "UnknownFunction");
    assert!(unknown.text.contains("go_to"), "{unknown}");
    let position = |size, value| vec![argument("position", size, value)];
    let missing = failure("go_to", vec![]);
    assert_eq!(missing.error, "MissingArgument");
    assert!(missing.text.contains("go_to(position: int[2])"), "{missing}");
    assert_eq!(failure("go_to", position(2, ArgumentValue::Float(vec![Number::Finite(0.0); 2]))).error, "WrongType");
    assert_eq!(failure("go_to", position(3, ArgumentValue::Int(vec![1, 2, 3]))).error, "WrongSize");
    let short = failure("go_to", position(2, ArgumentValue::Int(vec![1])));
    assert!(short.error == "WrongSize" && short.text.contains("'position'"), "{short}");
    assert_eq!(failure("go_to", position(8, ArgumentValue::Bytes("zz".into()))).error, "BadBytes");
    assert_eq!(failure("go_to", position(u32::MAX, ArgumentValue::Int(vec![1]))).error, "TooLarge");
    let bad_name = failure("go_to", vec![argument("posi tion", 1, ArgumentValue::Int(vec![1]))]);
    assert_eq!(bad_name.error, "BadName");
    let service = failure("fail", vec![]);
    assert_eq!((service.error.as_str(), service.cause.as_str()), ("Service", "peer"));
}

#[test]
fn a_call_that_takes_long_ends_in_time() {
    let (depot, _agv) = Depot::with_agv();
    let question = CallQuestion { timeout_ms: Some(50), ..call(Some("agv"), "slow", vec![]) };
    let failure = outcome(&ask(&mut depot.client(), Question::Call(question)).unwrap()).unwrap_err();
    assert_eq!((failure.error.as_str(), failure.cause.as_str()), ("TimedOut", "peer"));
    depot.gate.open();
}

#[test]
fn options_that_cannot_be_are_refused() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let plain = || call(Some("agv"), "fail", vec![]);
    let priority = CallQuestion { priority: Some("urgent".into()), ..plain() };
    assert_eq!(refused(&mut client, Question::Call(priority)), "UnknownPriority");
    let datagram = CallQuestion { best_effort: true, ..plain() };
    assert_eq!(refused(&mut client, Question::Call(datagram)), "BadQuestion");
    assert_eq!(refused(&mut client, Question::Call(call(Some("x"), "fail", vec![]))), "UnknownNode");
    let all = ask(&mut client, Question::Call(call(None, "fly", vec![]))).unwrap();
    let [Answer::Called { error: Some(failure), .. }] = &all[..] else { panic!("{all:?}") };
    assert_eq!((failure.error.as_str(), failure.cause.as_str()), ("UnknownFunction", "peer"));
}

#[test]
fn all_are_called_at_the_same_time() {
    let depot = Depot::new();
    let _agvs: Vec<_> = (0..4).map(|id| depot.agv(&format!("agv{id}"), id)).collect();
    let mut client = depot.client();
    let slow = CallQuestion { timeout_ms: Some(20_000), ..call(None, "slow", vec![]) };
    let system = depot.system.clone();
    let waiting = || {
        let counters = system.counters();
        counters.iter().find(|(name, _)| *name == "CallsInFlight").unwrap().1
    };
    std::thread::scope(|scope| {
        let asking = scope.spawn(|| ask(&mut client, Question::Call(slow)).unwrap());
        until("all four are under way", || waiting() == 4);
        depot.gate.open();
        let mut ids: Vec<_> = asking
            .join()
            .unwrap()
            .iter()
            .map(|answer| match answer {
                Answer::Called { id, error: None, .. } => *id,
                other => panic!("{other:?}"),
            })
            .collect();
        ids.sort();
        assert_eq!(ids, [0, 1, 2, 3]);
    });
    let answers = ask(&mut client, Question::Call(call(None, "echo", every_type()))).unwrap();
    assert_eq!(answers.len(), 4);
    assert!(
        answers
            .iter()
            .all(|answer| matches!(answer, Answer::Called { results, error: None, .. } if *results == every_type()))
    );
    let asynchronous = CallQuestion { asynchronous: true, ..call(None, "fail", vec![]) };
    let answers = ask(&mut client, Question::Call(asynchronous)).unwrap();
    assert!(
        answers.len() == 4
            && answers.iter().all(|answer| matches!(answer, Answer::Called { call: Some(_), error: None, .. }))
    );
}

/// No node is passed over in silence.
#[test]
fn a_call_of_all_tells_who_was_not_called() {
    let depot = Depot::new();
    let agvs: Vec<_> = (0..3).map(|id| depot.agv(&format!("agv{id}"), id)).collect();
    agvs[0].stop();
    agvs[1].my_function_list().remove("fail").unwrap();
    let peer = |id: u32| depot.system.roster().into_iter().find(|peer| peer.id() == id).unwrap();
    until("one has left", || !peer(0).is_connected());
    until("one has withdrawn it", || !peer(1).their_function_list().contains("fail"));
    let mut client = depot.client();
    for asynchronous in [false, true] {
        let question = CallQuestion { asynchronous, ..call(None, "fail", vec![]) };
        let answers = ask(&mut client, Question::Call(question)).unwrap();
        let mut reported: Vec<_> = answers
            .iter()
            .map(|answer| match answer {
                Answer::Called { id, error, .. } => (*id, error.as_ref().map(|failure| failure.error.clone())),
                other => panic!("{other:?}"),
            })
            .collect();
        reported.sort();
        let ran = (!asynchronous).then(|| "Service".to_owned());
        assert_eq!(reported, [(0, Some("NotConnected".into())), (1, Some("UnknownFunction".into())), (2, ran)]);
    }
    // Also where no node offers it; what is retired is not missed.
    assert!(peer(0).retire());
    let answers = ask(&mut client, Question::Call(call(None, "fly", vec![]))).unwrap();
    assert_eq!(answers.len(), 2, "{answers:?}");
}

#[test]
fn round_trips_are_measured_without_a_function() {
    let (depot, _agv) = Depot::with_agv();
    let mut client = depot.client();
    let measured = |answers: Vec<Answer>| {
        let times: Vec<f64> = answers
            .iter()
            .map(|answer| match answer {
                Answer::Sample { us: Some(us), error: None } => *us,
                other => panic!("{other:?}"),
            })
            .collect();
        assert!(times.iter().all(|us| *us > 0.0 && us.is_finite()), "{times:?}");
        times.len()
    };
    assert_eq!(measured(ask(&mut client, ping("agv", 20, 20_000)).unwrap()), 20);
    let sent = |counters: &[(&'static str, u64)]| counters.iter().find(|(name, _)| *name == "RequestsSent").unwrap().1;
    assert_eq!(sent(&depot.system.s_unit("agv").unwrap().counters()), 0, "a ping calls no function");
    assert_eq!(refused(&mut client, ping("x", 1, 1)), "UnknownNode");
}

/// Callers of one link have their turns.
#[test]
fn many_ping_a_node_at_the_same_time() {
    let (depot, agv) = Depot::with_agv();
    let peer = depot.system.s_unit("agv").unwrap();
    let back = agv.manager().unwrap();
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| (0..20).for_each(|_| assert!(peer.ping(crate::support::PATIENCE).is_ok())));
            scope.spawn(|| (0..20).for_each(|_| assert!(back.ping(crate::support::PATIENCE).is_ok())));
        }
    });
}

#[test]
fn a_watch_sees_what_happens() {
    let depot = Depot::new();
    let (mut watching, mut other) = (depot.client(), depot.client());
    let mut answers = watching.ask(&Question::Watch).unwrap();
    let mut next = |wanted: &str| loop {
        match answers.next().unwrap().unwrap() {
            Answer::Event { event, node, text, .. } if event == wanted => return (node, text),
            Answer::Event { .. } => {}
            other => panic!("{other:?}"),
        }
    };
    next("watching");
    let agv = depot.agv("agv", 7);
    assert_eq!(next("joined").0.as_deref(), Some("agv/7"));
    assert_eq!(next("list_changed").0.as_deref(), Some("agv/7"));
    let failing = CallQuestion { asynchronous: true, ..call(Some("agv"), "fail", vec![]) };
    let answers = ask(&mut other, Question::Call(failing)).unwrap();
    let [Answer::Called { call: Some(id), .. }] = answers[..] else { panic!("{answers:?}") };
    let (node, text) = next("request_failed");
    assert!(node.as_deref() == Some("agv/7") && text.contains(&format!("call {id}")), "{text}");
    agv.stop();
    assert_eq!(next("left").0.as_deref(), Some("agv/7"));
    depot.system.stop();
    // What is on its way comes; then the connection ends.
    assert!(watching.ask(&Question::Unit).is_err() || watching.ask(&Question::Unit).is_err());
}

/// A client that reads events more slowly than they come gets the number that it missed.
#[test]
fn a_slow_watch_loses_events_and_is_told_how_many() {
    let (depot, _agv) = Depot::with_agv();
    let peer = depot.system.s_unit("agv").unwrap();
    let lost = || depot.system.counters().iter().find(|(name, _)| *name == "EventsLost").unwrap().1;
    let (started, begins) = std::sync::mpsc::channel();
    std::thread::scope(|scope| {
        let watching = scope.spawn(|| {
            let mut reported = 0;
            execute(&depot.system, &Question::Watch, &mut |answer| match answer {
                Answer::Event { event, .. } if event == "watching" => {
                    started.send(()).unwrap();
                    until("events are lost", || lost() > 0);
                    ControlFlow::Continue(())
                }
                Answer::Event { event, text, .. } if event == "lost" => {
                    reported = text.split(' ').next().unwrap().parse().unwrap();
                    ControlFlow::Break(())
                }
                _ => ControlFlow::Continue(()),
            });
            reported
        });
        begins.recv().unwrap();
        while lost() == 0 {
            // A full queue makes room by and by.
            let _ = peer.request("fail", &Parameters::new());
        }
        let reported: u64 = watching.join().unwrap();
        assert!(reported > 0 && reported <= lost());
    });
}

#[test]
fn who_follows_commands_gets_arguments_and_outcomes_also_of_the_program() {
    let (depot, agv) = Depot::with_agv();
    let (mut following, mut other) = (depot.client(), depot.client());
    let mut answers = following.ask(&Question::Commands).unwrap();
    assert!(matches!(answers.next().unwrap().unwrap(), Answer::Event { event, .. } if event == "watching"));
    let is_event = |answer: &Answer| matches!(answer, Answer::Event { .. });
    let mut next = || answers.find_map(|answer| Some(answer.unwrap()).filter(|answer| !is_event(answer)));
    let position = || vec![argument("position", 2, ArgumentValue::Int(vec![1, 2]))];
    let question = Question::Call(call(Some("agv"), "echo", every_type()));
    let answered = ask(&mut other, question.clone()).unwrap();
    ask(&mut other, Question::Unit).unwrap();
    let Answer::Command { by, question: asked, outcome, .. } = next().unwrap() else { panic!("no command") };
    assert_eq!((by.origin.as_str(), by.pid), ("operator", Some(std::process::id() as i32)));
    assert_eq!((*asked, outcome.as_deref()), (question, answered.first()));

    // The program's, which have the same form; one that looks only, as the operator's question before, is none.
    let peer = depot.system.s_unit("agv").unwrap();
    let mut arguments = Parameters::new();
    arguments.add_int("position", 2).unwrap();
    arguments.set_value("position", [1_i64, 2]).unwrap();
    peer.block_request("go_to", &mut arguments).unwrap();
    let Answer::Command { by, question, outcome, .. } = next().unwrap() else { panic!("no command") };
    assert_eq!((by.origin.as_str(), by.pid), ("program", None));
    let Question::Call(asked) = *question else { panic!("no call") };
    assert_eq!((asked.node.as_deref(), asked.function.as_str(), asked.arguments), (Some("agv/7"), "go_to", position()));
    assert!(matches!(outcome.as_deref(), Some(Answer::Called { error: None, took_us: 1.., .. })), "{outcome:?}");

    // So has each of a call to all.
    arguments.set_value("position", [1_i64, 2]).unwrap();
    depot.system.call_all("go_to", &arguments).wait();
    let Answer::Command { question, outcome, .. } = next().unwrap() else { panic!("no command") };
    assert!(matches!(*question, Question::Call(asked) if asked.arguments == position()));
    assert!(matches!(outcome.as_deref(), Some(Answer::Called { error: None, .. })), "{outcome:?}");

    assert!(peer.block_request("fail", &mut Parameters::new()).is_err());
    let Answer::Command { outcome, .. } = next().unwrap() else { panic!("no command") };
    let Some(Answer::Called { error: Some(failure), .. }) = outcome.as_deref() else { panic!("{outcome:?}") };
    assert_eq!(failure.error, "Service");
    agv.stop();
}

/// The longest question that is read would be a report that no follower reads: it is counted, and the next one comes.
#[test]
fn who_follows_commands_outlives_the_longest_question() {
    let (depot, agv) = Depot::with_agv();
    let (mut following, mut other) = (depot.client(), depot.client());
    let mut answers = following.ask(&Question::Commands).unwrap();
    assert!(matches!(answers.next().unwrap().unwrap(), Answer::Event { event, .. } if event == "watching"));
    let long = argument("y", 8, ArgumentValue::Bytes("0".repeat(LONGEST_LINE - 1_000)));
    let asked = ask(&mut other, Question::Call(call(Some("agv"), "echo", vec![long]))).unwrap();
    assert!(matches!(&asked[..], [Answer::Called { error: Some(_), .. }]));
    let mut is_told_lost = false;
    for _ in 0..2 {
        ask(&mut other, Question::Stop { node: None }).unwrap();
        let stop = answers.find(|answer| {
            let answer = answer.as_ref().unwrap();
            is_told_lost |= matches!(answer, Answer::Event { event, .. } if event == "lost");
            matches!(answer, Answer::Command { question, .. } if matches!(**question, Question::Stop { .. }))
        });
        assert!(stop.is_some(), "one connection for all");
    }
    assert!(is_told_lost);
    agv.stop();
}

/// The manager asks for it, and nobody who follows commands is told of that.
#[test]
fn the_clock_of_a_vehicle_is_shown_and_its_measurement_is_no_command() {
    let depot = Depot::new();
    let (mut following, mut other) = (depot.client(), depot.client());
    let mut answers = following.ask(&Question::Commands).unwrap();
    assert!(matches!(answers.next().unwrap().unwrap(), Answer::Event { event, .. } if event == "watching"));
    let agv = depot.agv("agv", 7);
    let tell = |_: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_micros() as i64;
        Ok(view.set_value("unix_us", now - 2_000_000)?)
    };
    let clock = "clock() -> (unix_us: int)".parse().unwrap();
    agv.my_function_list().add_service(&clock, ServiceOptions::new(), tell).unwrap();
    agv.publish_my_function_list().unwrap();
    let mut shown = || {
        let nodes = ask(&mut other, Question::Nodes { offering: None }).unwrap();
        nodes.into_iter().find_map(|answer| if let Answer::Node(node) = answer { node.clock } else { None })
    };
    until("it is measured", || shown().is_some());
    let measured = shown().unwrap();
    assert!((measured.offset_us + 2_000_000).unsigned_abs() <= measured.error_us + 10, "{measured:?}");
    assert!(measured.error_us < 1_000_000 && measured.age_ms < 60_000, "{measured:?}");
    assert!(measured.trouble().unwrap().ends_with("s behind"), "{measured:?}");
    let peer = depot.system.s_unit("agv").unwrap();
    assert!(peer.block_request("fail", &mut Parameters::new()).is_err());
    let mut commands = answers.filter_map(|answer| match answer.unwrap() {
        Answer::Command { question, .. } => Some(*question),
        _ => None,
    });
    assert!(matches!(commands.next(), Some(Question::Call(call)) if call.function == "fail"));
}
