//! The shortest way through: two units on loopback, over real sockets.

mod keyed;

use std::time::{Duration, Instant};

use cara_std::{CommunicationSystem, Error, Interfaces, Parameters, ParametersView, Served, ServiceError, Unit};

/// A fleet of its own, so that tests on one machine do not meet.
fn fleet() -> u32 {
    use std::hash::{BuildHasher, Hasher};
    std::hash::RandomState::new().build_hasher().finish() as u32
}

fn until(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn pair() -> (CommunicationSystem, Unit<[i64; 2]>) {
    let fleet = fleet();
    let (manager, agv) = keyed::pair(fleet);
    let manager = manager.interfaces(Interfaces::Loopback).build().unwrap();
    let agv = agv.interfaces(Interfaces::Loopback).state([3_i64, 4]).build().unwrap();
    let mut position = Parameters::new();
    position.add_int("position", 2).unwrap();
    let pos_info = |state: &mut [i64; 2], _: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        view.set_value("position", *state).map_err(|_| ServiceError::BadResults)
    };
    agv.my_function_list().add_function("pos_info", &position, pos_info).unwrap();
    let mut text = Parameters::<40_000>::sized();
    text.add_string("text", 20_000).unwrap();
    let echo = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    agv.my_function_list().add_function("echo", &text, echo).unwrap();
    agv.publish_my_function_list().unwrap();
    (manager, agv)
}

#[test]
fn a_manager_finds_an_agv_and_calls_it() {
    let (manager, agv) = pair();
    manager.start().unwrap();
    assert_eq!(manager.number_of_s_units(), 0);
    agv.start().unwrap();
    until("the AGV has joined", || manager.number_of_s_units() == 1);
    let peer = manager.s_units().remove(0);
    assert!(peer.wait_for_function("echo", cara_std::Duration::from_secs(30)));

    let mut pos = Parameters::new();
    pos.add_int("position", 2).unwrap();
    peer.block_request("pos_info", &mut pos).unwrap();
    assert_eq!(pos.variable::<[i64; 2]>("position"), Ok([3, 4]));

    let mut text = Parameters::<40_000>::sized();
    text.add_string("text", 20_000).unwrap();
    let long = "x".repeat(20_000);
    text.set_value("text", long.as_str()).unwrap();
    for _ in 0..100 {
        peer.block_request("echo", &mut text).unwrap();
    }
    assert_eq!(text.variable::<&str>("text"), Ok(long.as_str()));
    assert_eq!(peer.block_request("no_such_function", &mut pos), Err(Error::UnknownFunction));

    agv.stop();
    until("the AGV has left", || manager.number_of_s_units() == 0);
    assert_eq!(peer.block_request("pos_info", &mut pos), Err(Error::NotConnected));
}

#[test]
fn a_handler_that_holds_a_weak_handle_does_not_keep_the_unit() {
    let (manager, agv) = pair();
    let alive = std::sync::Arc::new(());
    let (weak, held) = (agv.downgrade(), alive.clone());
    let definition = "call_home()".parse().unwrap();
    let call_home = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        let _ = (&held, weak.upgrade());
        Ok(())
    };
    agv.my_function_list().add_service(&definition, cara_std::ServiceOptions::new(), call_home).unwrap();
    manager.start().unwrap();
    agv.start().unwrap();
    until("the AGV has joined", || manager.number_of_s_units() == 1);
    drop(agv);
    until("the AGV has left", || manager.number_of_s_units() == 0);
    until("its handlers are gone", || std::sync::Arc::strong_count(&alive) == 1);
}

#[test]
fn a_function_that_could_not_be_served_is_refused_when_it_is_added() {
    let (manager, _) = pair();
    let definition = "log(text: string[1000000])".parse().unwrap();
    let log = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let added = manager.my_function_list().add_service(&definition, cara_std::ServiceOptions::new(), log);
    assert!(matches!(added, Err(Error::TooLarge { .. })), "{added:?}");
    assert!(manager.my_function_list().is_empty());
}
