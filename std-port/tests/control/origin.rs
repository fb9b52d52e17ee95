//! A program that moves a vehicle, and an operator of the same unit that wants to.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use cara_std::control::protocol::{Answer, CallQuestion, Failure, Question};
use cara_std::{Error, Parameters, ParametersView, Peer, Renew, Served, ServiceError, ServiceOptions, UnitEvent};

use crate::support::{Depot, ask, call, until};

/// So long that nothing here ends by time.
const LEASE: cara_std::Duration = cara_std::Duration::from_secs(600);

fn drive(take_over: bool) -> CallQuestion {
    CallQuestion { take_over, ..call(Some("agv"), "drive", vec![]) }
}

/// What an operator's call has come to.
fn outcome(answers: &[Answer]) -> Result<(), Failure> {
    let [Answer::Called { error, .. }] = answers else { panic!("{answers:?}") };
    error.clone().map_or(Ok(()), Err)
}

/// What a call of the unit's program comes to.
fn wanted_by_program(peer: &Peer<()>) -> Result<(), Error> {
    peer.call("drive", &mut Parameters::new()).renewing(Renew::Process).wait().map_err(Error::from)
}

#[test]
fn an_operator_and_the_program_of_one_manager_hold_a_vehicle_for_themselves() {
    let (depot, agv) = Depot::with_agv();
    let hooks = Arc::new(AtomicUsize::new(0));
    let counted = hooks.clone();
    let safe = move || {
        counted.fetch_add(1, Ordering::SeqCst);
    };
    let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let options = ServiceOptions::new().lease(LEASE, safe);
    let lease = agv.my_function_list().add_service(&"drive()".parse().unwrap(), options, nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    let peer = depot.system.s_unit("agv").unwrap();
    until("it is known", || peer.function("drive").is_some());
    let (events, mut client) = (depot.system.events(), depot.client());

    // The program holds it, and an operator does not get it by calling.
    assert_eq!(wanted_by_program(&peer), Ok(()));
    for question in [Question::Call(drive(false)), Question::Hold(drive(false))] {
        let refused = outcome(&ask(&mut client, question).unwrap()).unwrap_err();
        assert_eq!(refused.error, "Held");
        assert!(refused.text.contains("is held by unit 1:"), "{refused}");
    }
    assert!(lease.is_live());

    // He takes it over, and the program is told, and does not get it back by calling.
    let mut holding = client.ask(&Question::Hold(drive(true))).unwrap();
    assert!(matches!(holding.next(), Some(Ok(Answer::Called { error: None, .. }))));
    until("the program is told", || {
        events.try_iter().any(|event| matches!(event, UnitEvent::LeaseEnded { why, .. } if why.word() == "replaced"))
    });
    let held = Error::Held { by: 1, operator: true };
    assert_eq!(wanted_by_program(&peer), Err(held));
    assert!(held.to_string().contains("is held by an operator of unit 1:"), "{held}");

    // Operators are one another's.
    let mut second = depot.client();
    let mut newer = second.ask(&Question::Hold(drive(false))).unwrap();
    assert!(matches!(newer.next(), Some(Ok(Answer::Called { error: None, .. }))));
    let end = holding.next().unwrap().unwrap_err();
    assert!(end.to_string().contains("took over"), "{end}");
    assert_eq!((wanted_by_program(&peer), lease.is_live(), hooks.load(Ordering::SeqCst)), (Err(held), true, 0));

    // What he gives up is made safe, and the program has it again.
    drop(second);
    until("it is made safe", || hooks.load(Ordering::SeqCst) == 1);
    until("the program has it", || wanted_by_program(&peer) == Ok(()));
    assert!(lease.is_live());
}

/// Whose answer was lost: an operator's call in between does not count.
#[test]
fn what_the_program_asks_of_its_own_call_is_not_an_operators() {
    let (depot, agv) = Depot::with_agv();
    let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let options = ServiceOptions::new().lease(LEASE, || {});
    agv.my_function_list().add_service(&"drive()".parse().unwrap(), options, nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    let peer = depot.system.s_unit("agv").unwrap();
    until("it is known", || peer.function("drive").is_some());
    assert_eq!(wanted_by_program(&peer), Ok(()));
    until("it runs", || peer.outcome_of("drive") == cara_std::OrderOutcome::Runs);
    let refused = outcome(&ask(&mut depot.client(), Question::Call(drive(false))).unwrap()).unwrap_err();
    assert_eq!(refused.error, "Held");
    assert_eq!(peer.outcome_of("drive"), cara_std::OrderOutcome::Runs);
}
