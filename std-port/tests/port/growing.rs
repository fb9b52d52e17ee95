//! Parameters that grow, in all forms of a call and of a handler.

use std::ops::ControlFlow;

use cara_std::{
    Canceller, CommunicationSystem, Constraints, Definition, Error, GrowingParameters, Parameters, ParametersView,
    Peer, RequestOptions, Served, ServiceError, ServiceOptions, Unit,
};

use crate::support::{fleet, meet, retire_absent, system, unit};

/// Longer than the room that growing parameters begin with.
const TEXT: u32 = 20_000;
const ELEMENTS: u32 = 3_000;

fn reported() -> Definition {
    format!("tell(number: int) -> (text: string[{TEXT}])").parse().unwrap()
}

fn listed(name: &str) -> Definition {
    format!("{name}() -> (list: int[..{ELEMENTS}])").parse().unwrap()
}

fn notify(_: &Served, results: &mut ParametersView) -> Result<(), ServiceError> {
    let text = "y".repeat(TEXT as usize);
    results.set_value("text", text.as_str()).map_err(|_| ServiceError::BadResults)
}

fn list(_: &Served, results: &mut ParametersView) -> Result<(), ServiceError> {
    let listed = results.set_list("list", |list| (0..ELEMENTS).try_for_each(|element| list.push(i64::from(element))));
    listed.map_err(|_| ServiceError::BadResults)
}

/// A handler by value.
fn with_list(mut parameters: GrowingParameters) -> GrowingParameters {
    parameters.set_list("list", |list| (0..ELEMENTS).try_for_each(|element| list.push(i64::from(element)))).unwrap();
    parameters
}

fn asked() -> GrowingParameters {
    let mut asked = GrowingParameters::new();
    asked.add_int("number", 1).unwrap();
    asked
}

/// A manager and a unit that takes and returns more than usual.
fn roomy_pair() -> (CommunicationSystem, Unit) {
    let fleet = fleet();
    let roomy = Constraints { message_size: 32 * 1024, ..Constraints::S_UNIT };
    (system(fleet).build().unwrap(), unit("agv", 7, fleet).constraints(roomy).build().unwrap())
}

fn assert_lists(peer: &Peer, function: &str) {
    let mut parameters = GrowingParameters::new();
    peer.block_request(function, &mut parameters).unwrap();
    assert_eq!(parameters.list("list").unwrap().len(), ELEMENTS, "{function}");
}

#[test]
fn growing_parameters_have_room_for_the_results_of_every_form_of_call() {
    let (manager, agv) = roomy_pair();
    agv.my_function_list().add_service(&reported(), ServiceOptions::new(), notify).unwrap();
    agv.my_function_list().add_service(&listed("list"), ServiceOptions::new(), list).unwrap();
    let (peer, _) = meet(&manager, &agv);
    retire_absent(&manager);
    let options = RequestOptions::default();

    let mut fixed = Parameters::new();
    fixed.add_int("number", 1).unwrap();
    assert!(matches!(peer.block_request("tell", &mut fixed), Err(Error::ResultWouldNotFit { .. })));

    let has_text = |parameters: &ParametersView| {
        assert_eq!(parameters.variable::<&str>("text").map(str::len), Ok(TEXT as usize));
    };
    let mut parameters = asked();
    peer.block_request("tell", &mut parameters).unwrap();
    has_text(&parameters);
    peer.block_request("tell", &mut parameters).unwrap();
    let mut parameters = asked();
    peer.call("tell", &mut parameters).with(options).watch(|_| ControlFlow::Continue(())).wait().unwrap();
    has_text(&parameters);
    let mut parameters = asked();
    peer.call("tell", &mut parameters)
        .with(options)
        .cancelled_by(&Canceller::new())
        .watch(|_| ControlFlow::Continue(()))
        .wait()
        .unwrap();
    has_text(&parameters);
    let mut parameters = asked();
    drop(peer.call("tell", &mut parameters).with(options).hold().wait().unwrap());
    has_text(&parameters);
    for (_, outcome) in manager.call_all("tell", &asked()).with(options).wait() {
        has_text(&outcome.unwrap());
    }
    peer.request("tell", &asked()).unwrap();

    // How long a list is, is not known before the call has run.
    assert_lists(&peer, "list");
    assert_eq!(peer.block_request("no_such", &mut parameters), Err(Error::UnknownFunction));
    agv.stop();
    manager.stop();
}

#[test]
fn growing_parameters_that_the_peer_has_no_room_for_are_refused() {
    let (manager, agv) = roomy_pair();
    let taken = "take(long: bytes[100000])".parse().unwrap();
    agv.my_function_list().add_service(&taken, ServiceOptions::new(), notify).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let mut parameters = GrowingParameters::new();
    parameters.add_bytes("long", 100_000).unwrap();
    parameters.set_value("long", &[1_u8; 100_000][..]).unwrap();
    assert_eq!(peer.block_request("take", &mut parameters), Err(Error::TooLarge { limit: 32 * 1024 }));
    agv.stop();
    manager.stop();
}

#[test]
fn handlers_by_value_take_and_return_growing_parameters() {
    let (manager, agv) = roomy_pair();
    let functions = agv.my_function_list();
    functions.add_service(&listed("free"), ServiceOptions::new(), with_list).unwrap();
    let method = |_: &mut (), parameters: GrowingParameters| with_list(parameters);
    functions.add_service(&listed("method"), ServiceOptions::new(), method).unwrap();
    let (peer, _) = meet(&manager, &agv);
    assert_lists(&peer, "free");
    assert_lists(&peer, "method");
    agv.stop();
    manager.stop();
}

#[cfg(feature = "async")]
#[test]
fn tasks_call_and_serve_with_growing_parameters() {
    let (manager, agv) = roomy_pair();
    let functions = agv.my_function_list();
    functions.add_service(&listed("list"), ServiceOptions::new(), list).unwrap();
    let future = |parameters: GrowingParameters| async { with_list(parameters) };
    functions.add_service(&listed("future"), ServiceOptions::new(), future).unwrap();
    let reported = |_: Served, parameters: GrowingParameters| async { Ok(with_list(parameters)) };
    functions.add_service(&listed("told"), ServiceOptions::new(), reported).unwrap();
    let (peer, _) = meet(&manager, &agv);
    retire_absent(&manager);
    assert_lists(&peer, "future");
    assert_lists(&peer, "told");
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    runtime.block_on(async {
        let options = RequestOptions::default();
        let mut parameters = GrowingParameters::new();
        peer.call("list", &mut parameters).with(options).await.unwrap();
        assert_eq!(parameters.list("list").unwrap().len(), ELEMENTS);
        let mut held = GrowingParameters::new();
        drop(peer.call("list", &mut held).with(options).hold().await.unwrap());
        assert_eq!(held, parameters);
        let all = manager.call_all("list", &GrowingParameters::new()).with(options).await;
        assert_eq!(all.len(), 1);
        assert!(all.into_iter().all(|(_, outcome)| outcome == Ok(parameters.clone())));
    });
    agv.stop();
    manager.stop();
}
