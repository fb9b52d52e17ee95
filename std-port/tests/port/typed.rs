//! Typed services between real units.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use cara_std::typed::BAD_ARGUMENT;
use cara_std::{
    AnyCall, CallError, Definition, Duration, Error, Parameters, Priority, Renew, RequestOptions, ServiceError,
    ServiceOptions, Variables, interface,
};

use crate::support::{fleet, meet, system, unit, until};

#[derive(Variables, Clone, Copy, Debug, Default, PartialEq)]
enum Mode {
    #[default]
    Idle,
    Driving,
}

#[derive(Variables, Clone, Debug, Default, PartialEq)]
struct State {
    position: [i64; 2],
    mode: Mode,
    #[size(100)]
    said: String,
}

#[interface]
trait Drive {
    #[idempotent]
    fn state(&self) -> State;

    #[actuator(motor)]
    #[lease(ms = 60_000)]
    fn go_to(&mut self, call: &impl AnyCall, position: [i64; 2], speed: u8) -> Result<(), ServiceError>;

    #[priority(emergency)]
    #[actuator(motor)]
    #[stop]
    fn halt();

    #[actuator(motor)]
    #[reset]
    fn free(&mut self);

    #[returns(count)]
    fn say(&mut self, #[size(100)] text: &str) -> Result<u32, ServiceError>;
}

impl Drive for State {
    fn state(&self) -> State {
        self.clone()
    }

    fn go_to(&mut self, call: &impl AnyCall, position: [i64; 2], _: u8) -> Result<(), ServiceError> {
        assert_eq!(call.caller().name(), "manager");
        call.commit(|| (self.position, self.mode) = (position, Mode::Driving))?;
        Ok(())
    }

    fn halt() {}

    fn free(&mut self) {
        self.mode = Mode::Idle;
    }

    fn say(&mut self, text: &str) -> Result<u32, ServiceError> {
        self.said.push_str(text);
        u32::try_from(self.said.len()).map_err(|_| ServiceError::NotReady)
    }
}

#[test]
fn a_typed_vehicle_is_driven_stopped_and_reset() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(State::default()).build().unwrap());
    let safe = Arc::new(AtomicUsize::new(0));
    let counted = safe.clone();
    let hook = move || {
        counted.fetch_add(1, Ordering::SeqCst);
    };
    let motor = agv.my_function_list().actuator(hook).unwrap();
    let order = motor.watch();
    agv.my_function_list().serve(DriveServer { motor }).unwrap();
    assert_eq!(
        agv.my_function_list().serve(DriveServer { motor: agv.my_function_list().actuator(|| ()).unwrap() }),
        Err(Error::NameTaken)
    );
    let (peer, _) = meet(&manager, &agv);
    let client = DriveClient::at(&peer);
    assert_eq!(client.state(), Ok(State::default()));
    assert_eq!(client.say("on the way"), Ok(10));
    let held = client.renewing(Renew::Process).hold_go_to([1, 2], 3).unwrap();
    assert!(order.is_live());
    assert_eq!(client.state(), Ok(State { position: [1, 2], mode: Mode::Driving, said: "on the way".into() }));
    assert_eq!(client.halt(), Ok(()));
    assert!(!order.is_live());
    until("the hook has run", || safe.load(Ordering::SeqCst) == 1);
    assert!(matches!(client.go_to([5, 5], 3), Err(CallError::Call(Error::Inhibited { .. }))));
    drop(held);
    until("it may move again", || client.free().is_ok() && client.go_to([5, 5], 3).is_ok());
    let wanted = RequestOptions { timeout: Some(Duration::from_secs(5)), ..RequestOptions::new() };
    client.with(wanted).request_say("!").unwrap();
    until("the request has run", || client.state().is_ok_and(|state| state.said == "on the way!"));
    manager.stop();
    agv.stop();
}

#[test]
fn typed_and_dynamic_ends_understand_each_other() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(State::default()).build().unwrap());
    let motor = agv.my_function_list().actuator(|| ()).unwrap();
    agv.my_function_list().serve(DriveServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &agv);
    assert!(agv.my_function_list().show_functions().contains("go_to(position: int[2], speed: int)\n"));
    let halt = peer.function("halt").unwrap();
    assert!(halt.attributes.stop && halt.attributes.priority == Priority::Emergency);
    let mut call = Parameters::new();
    call.add_int("position", 2).unwrap();
    call.add_int("speed", 1).unwrap();
    call.set_value("speed", 300).unwrap();
    let refused = Err(Error::Service(ServiceError::Failed(BAD_ARGUMENT)));
    assert_eq!(peer.block_request("go_to", &mut call), refused, "a u8");
    call.set_value("speed", 255).unwrap();
    call.set_value("position", [7, 8]).unwrap();
    peer.block_request("go_to", &mut call).unwrap();
    let mut state = Parameters::new();
    peer.block_request("state", &mut state).unwrap();
    assert_eq!(State::from_parameters(&state).unwrap().position, [7, 8]);
    manager.stop();
    agv.stop();
}

#[test]
fn another_version_of_the_vehicle_is_told_before_anything_is_sent() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let calls = Arc::new(AtomicUsize::new(0));
    let counted = calls.clone();
    let run = move |_: &cara_std::Call, _: &mut cara_std::ParametersView| -> Result<(), ServiceError> {
        counted.fetch_add(1, Ordering::SeqCst);
        Ok(())
    };
    let go_to = Definition::parse("go_to(position: float[2], speed: int)").unwrap();
    agv.my_function_list().add_service(&go_to, ServiceOptions::new(), run.clone()).unwrap();
    let say = Definition::parse("say(text: string[20]) -> (count: int, left: int)").unwrap();
    agv.my_function_list().add_service(&say, ServiceOptions::new(), run).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let client = DriveClient::at(&peer);
    let Err(CallError::Mismatch(mismatch)) = client.go_to([1, 2], 3) else { panic!("it is told") };
    assert_eq!(
        mismatch.to_string(),
        "the peer's go_to is of another version: its argument position is float[2] there and int[2] here: update one of the two"
    );
    assert!(matches!(client.request_go_to([1, 2], 3), Err(CallError::Mismatch(_))));
    assert_eq!(calls.load(Ordering::SeqCst), 0);
    assert_eq!(client.state(), Err(CallError::Call(Error::UnknownFunction)));
    assert_eq!(
        client.say("a newer version gives more"),
        Err(CallError::Call(Error::WrongSize { index: 0, expected: 20, found: 26 }))
    );
    assert_eq!(client.say("short enough"), Ok(0));
    assert_eq!(calls.load(Ordering::SeqCst), 1);
    manager.stop();
    agv.stop();
    assert_eq!(client.say("gone"), Err(CallError::Call(Error::NotConnected)));
}

#[cfg(feature = "async")]
#[test]
fn a_task_of_any_thread_awaits_a_typed_call() {
    let fleet = fleet();
    let (manager, agv) =
        (system(fleet).build().unwrap(), unit("agv", 7, fleet).state(State::default()).build().unwrap());
    let motor = agv.my_function_list().actuator(|| ()).unwrap();
    agv.my_function_list().serve(DriveServer { motor }).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_time().build().unwrap();
    let task = runtime.spawn(async move { DriveAsyncClient::at(&peer).say("hello").await });
    assert_eq!(runtime.block_on(task).unwrap(), Ok(5));
    manager.stop();
    agv.stop();
}
