//! Typed services on boards: one serves, the other one calls.

use std::cell::RefCell;
use std::ops::ControlFlow;
use std::rc::Rc;

use cara_core::distribution::identity::Identity;
use cara_core::error::{Error, ServiceError};
use cara_core::services::heart::Renew;
use cara_core::services::lease::Lease;
use cara_core::time::Duration;
use cara_embassy::{
    Actuator, AnyCall, AsyncState, CallError, Config, Handle, Handler, Limits, ServiceOptions, TypedCall, Variables,
    interface, resources,
};
use cara_embassy_host::{Bench, Board, keys};

const LONG: Duration = Duration::from_secs(30);
const LIMITS: Limits = Limits { links: 4, message_buffers: 6, calls: 8, ..Limits::S_UNIT };

/// A fork's state.
#[derive(Default)]
struct Fork {
    height: f64,
    losses: u32,
}

#[derive(Variables, Debug, PartialEq)]
struct Load {
    kilograms: u16,
    label: [u8; 2],
}

#[derive(Variables, Debug, PartialEq)]
struct Left {
    left: f32,
}

#[derive(Variables, Debug, PartialEq)]
struct TooHeavy {
    kilograms: u16,
}

#[interface]
trait Lift {
    #[returns(height)]
    fn height(&self) -> f64;

    #[actuator(motor)]
    #[lease(ms = 400)]
    fn lift_to(&mut self, call: &impl AnyCall, height: f64) -> Result<(), ServiceError>;

    #[priority(emergency)]
    #[actuator(motor)]
    #[stop]
    fn halt();

    #[actuator(motor)]
    #[reset]
    fn free(&mut self) -> Result<(), ServiceError>;

    fn load(&mut self) -> Load;

    fn tilt(&mut self, call: &impl TypedCall<Left, TooHeavy>, degrees: u8) -> Result<(), ServiceError>;
}

/// How a program for Linux would serve `tilt`.
#[interface]
trait Tilt {
    async fn tilt(
        state: &impl AsyncState<Self>,
        call: &impl TypedCall<Left, TooHeavy>,
        degrees: u8,
    ) -> Result<(), ServiceError>;
}

impl Lift for Fork {
    fn height(&self) -> f64 {
        self.height
    }

    fn lift_to(&mut self, call: &impl AnyCall, height: f64) -> Result<(), ServiceError> {
        assert_eq!(call.caller().name(), "manager");
        call.commit(|| self.height = height)?;
        Ok(())
    }

    fn halt() {}

    fn free(&mut self) -> Result<(), ServiceError> {
        Ok(())
    }

    fn load(&mut self) -> Load {
        Load { kilograms: 900, label: [7, 8] }
    }

    fn tilt(&mut self, call: &impl TypedCall<Left, TooHeavy>, degrees: u8) -> Result<(), ServiceError> {
        call.progress(&Left { left: f32::from(degrees) })?;
        if degrees > 5 { Err(call.fail_with(3, "it is too heavy", &TooHeavy { kilograms: 900 })) } else { Ok(()) }
    }
}

static MOTOR: Lease = Lease::new();
static TILTED: Lease = Lease::new();

type Unit = Handle<Fork>;
type Memory = resources!(Fork, LIMITS);

fn start(bench: &Bench, identity: &Identity, config: impl FnOnce(cara_embassy::Security) -> Config) -> (Board, Unit) {
    let board = bench.board();
    let memory = Box::leak(Box::new(Memory::new()));
    let config = config(keys(0, identity, 0, bench.random(u64::MAX)));
    let (unit, mut runner) = cara_embassy::new(board.stack(), memory, config, Fork::default()).unwrap();
    board.spawn(async move { runner.run().await });
    (board, unit)
}

/// A manager and the fork, which publishes what `offer` adds.
fn pair(bench: &Bench, offer: impl FnOnce(Unit)) -> (Board, Unit, Unit) {
    let (manager, agv) = (Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap());
    let (board, calling) = start(bench, &manager, |keys| Config::m_unit("manager", 1, keys).unwrap());
    let (_, serving) = start(bench, &agv, |keys| Config::s_unit("agv", 7, "manager", 1, keys).unwrap());
    offer(serving);
    serving.publish_my_function_list().unwrap();
    let knows =
        || calling.peer("agv").is_ok_and(|peer| peer.their_function_list().len() == serving.my_function_list().len());
    assert!(bench.run_until(knows, LONG), "they meet");
    (board, calling, serving)
}

fn finish<R: 'static>(bench: &Bench, board: &Board, future: impl Future<Output = R> + 'static) -> R {
    let result = Rc::new(RefCell::new(None));
    let told = Rc::clone(&result);
    board.spawn(async move {
        let ended = future.await;
        told.replace(Some(ended));
    });
    assert!(bench.run_until(|| result.borrow().is_some(), LONG), "it ends");
    result.take().unwrap()
}

#[test]
fn a_typed_board_is_called_stopped_and_reset() {
    let bench = Bench::new(1);
    let (board, manager, fork) = pair(&bench, |unit| {
        let motor = Actuator::new(&MOTOR, &|| ()).then(&|fork: &mut Fork| fork.losses += 1);
        unit.my_function_list().serve(LiftServer { motor }).unwrap();
        assert_eq!(unit.my_function_list().serve(LiftServer { motor }), Err(Error::NameTaken));
    });
    let shown = fork.my_function_list().to_string();
    assert!(shown.contains("load() -> (kilograms: int, label: int[2])\n"), "{shown}");
    let peer = manager.peer("agv").unwrap();
    finish(&bench, &board, async move {
        let client = LiftAsyncClient::at(&peer);
        assert_eq!(client.load().await, Ok(Load { kilograms: 900, label: [7, 8] }));
        assert_eq!(client.renewing(Renew::Process).lift_to(1.5).await, Ok(()));
        assert_eq!(client.height().await, Ok(1.5));
        assert!(MOTOR.is_live(cara_embassy::now()));
        assert_eq!(client.halt().await, Ok(()));
        assert!(!MOTOR.is_live(cara_embassy::now()));
        assert!(matches!(client.lift_to(2.0).await, Err(CallError::Call(Error::Inhibited { .. }))));
        embassy_time::Timer::after_secs(1).await;
        assert_eq!(client.free().await, Ok(()));
        client.request_lift_to(3.0).unwrap();
        embassy_time::Timer::after_millis(100).await;
        assert_eq!(client.height().await, Ok(3.0));
    });
    assert!(fork.with_state(|fork| fork.losses).unwrap() >= 1, "behind the stop");
}

#[test]
fn another_version_is_told_before_anything_is_sent() {
    let bench = Bench::new(2);
    let (board, manager, _) = pair(&bench, |unit| {
        let lift_to = Handler::method(&|fork: &mut Fork, _, _| {
            fork.losses += 1;
            Ok(())
        });
        unit.my_function_list().add_service("lift_to(height: int)", ServiceOptions::new(), lift_to).unwrap();
    });
    let peer = manager.peer("agv").unwrap();
    let told = finish(&bench, &board, async move { LiftAsyncClient::at(&peer).lift_to(1.5).await });
    let told = told.unwrap_err().to_string();
    assert!(told.contains("lift_to") && told.contains("height is int there and float here"), "{told}");
}

/// A service that the runner runs tells no progress, since it has ended before anything can be sent.
#[test]
fn a_typed_failure_comes_with_its_text_and_its_values() {
    let bench = Bench::new(3);
    let (board, manager, _) = pair(&bench, |unit| {
        unit.my_function_list().serve(LiftServer { motor: Actuator::new(&TILTED, &|| ()) }).unwrap();
    });
    let peer = manager.peer("agv").unwrap();
    finish(&bench, &board, async move {
        let client = LiftAsyncClient::at(&peer);
        let failed = client.watch_tilt(6, |_| unreachable!("nothing is told")).await.unwrap_err();
        assert_eq!(failed.error, CallError::Call(Error::Service(ServiceError::Failed(3))));
        assert_eq!((failed.text.as_str(), failed.values), ("it is too heavy", Some(TooHeavy { kilograms: 900 })));
        assert_eq!(client.watch_tilt(5, |_| ControlFlow::Continue(())).await, Ok(()));
        let client = TiltAsyncClient::at(&peer);
        assert_eq!(client.tilt(5).await, Ok(()));
        let failed = client.watch_tilt(6, |_| unreachable!("nothing is told")).await.unwrap_err();
        assert_eq!(failed.values, Some(TooHeavy { kilograms: 900 }));
    });
}
