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
    Actuator, AnyCall, AsyncState, CallError, Config, Handle, Handler, Limits, LongCall, ServiceOptions, TypedCall,
    TypedTaken, Variables, interface, resources,
};
use cara_embassy_host::{Bench, Board, keys};

const LONG: Duration = Duration::from_secs(30);
const LIMITS: Limits = Limits { links: 4, message_buffers: 6, calls: 8, ..Limits::S_UNIT };

/// A fork's state.
#[derive(Default)]
struct Fork {
    height: f64,
    losses: u32,
    driving: Option<Driving>,
}

/// What has been taken, and how many metres are left.
type Driving = (TypedTaken<Fork, Left, TooHeavy>, u8);

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

#[derive(Variables, Debug, PartialEq)]
struct Arrived {
    metres: u8,
}

/// Its calls are taken.
#[interface]
trait Drive {
    fn drive(
        &mut self,
        call: &impl LongCall<Left, TooHeavy, State = Fork>,
        metres: u8,
    ) -> Result<Arrived, ServiceError>;
}

impl Drive for Fork {
    fn drive(
        &mut self,
        call: &impl LongCall<Left, TooHeavy, State = Fork>,
        metres: u8,
    ) -> Result<Arrived, ServiceError> {
        if metres == 0 {
            return Ok(Arrived { metres });
        }
        self.driving = Some((call.take(), metres));
        // It has no caller any more.
        let second = call.take();
        assert!(second.is_cancelled());
        Err(ServiceError::NotReady)
    }
}

/// Drives a metre each 50 ms, and none above 9 metres.
async fn drive(unit: Unit) {
    loop {
        embassy_time::Timer::after_millis(50).await;
        let Some((call, left)) = unit.with_state(|fork| fork.driving.take()).unwrap() else { continue };
        if call.is_cancelled() {
            unit.with_state(|fork| fork.losses += 1).unwrap();
        } else if left > 9 {
            call.fail_with(3, "it is too far", &TooHeavy { kilograms: 900 }).await;
        } else if left == 0 {
            call.finish(&Arrived { metres: 7 }).await;
        } else {
            call.progress(&Left { left: f32::from(left) }).unwrap();
            unit.with_state(|fork| fork.driving = Some((call, left - 1))).unwrap();
        }
    }
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
    let (unit, mut runner) = cara_embassy::new(board.network(), memory, config, Fork::default()).unwrap();
    board.spawn(async move { runner.run().await });
    (board, unit)
}

/// A manager and the fork, which publishes what `offer` adds.
fn pair(bench: &Bench, offer: impl FnOnce(Unit)) -> (Board, Unit, Unit) {
    let (board, calling, serving, _) = pair_with_boards(bench, offer);
    (board, calling, serving)
}

/// The same, with the board of the fork.
fn pair_with_boards(bench: &Bench, offer: impl FnOnce(Unit)) -> (Board, Unit, Unit, Board) {
    let (manager, agv) = (Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap());
    let (board, calling) = start(bench, &manager, |keys| Config::m_unit("manager", 1, keys).unwrap());
    let (at_fork, serving) = start(bench, &agv, |keys| Config::s_unit("agv", 7, "manager", 1, keys).unwrap());
    offer(serving);
    serving.publish_my_function_list().unwrap();
    let knows =
        || calling.peer("agv").is_ok_and(|peer| peer.their_function_list().len() == serving.my_function_list().len());
    assert!(bench.run_until(knows, LONG), "they meet");
    (board, calling, serving, at_fork)
}

fn finish<R: 'static>(bench: &Bench, board: &Board, future: impl Future<Output = R> + 'static) -> R {
    let result = Rc::new(RefCell::new(None));
    let reported = Rc::clone(&result);
    board.spawn(async move {
        let ended = future.await;
        reported.replace(Some(ended));
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
        let client = LiftClient::at(&peer);
        assert_eq!(client.load().await, Ok(Load { kilograms: 900, label: [7, 8] }));
        assert_eq!(client.renewing(Renew::Process).lift_to(1.5).await, Ok(()));
        assert_eq!(client.height().await, Ok(1.5));
        assert!(MOTOR.is_live(cara_embassy::now()));
        assert_eq!(client.halt().await, Ok(()));
        assert!(!MOTOR.is_live(cara_embassy::now()));
        assert!(matches!(client.lift_to(2.0).await, Err(CallError { error: Error::Inhibited { .. }, .. })));
        embassy_time::Timer::after_secs(1).await;
        assert_eq!(client.free().await, Ok(()));
        client.lift_to(3.0).send().unwrap();
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
    let reported = finish(&bench, &board, async move { LiftClient::at(&peer).lift_to(1.5).await });
    let reported = reported.unwrap_err().to_string();
    assert!(reported.contains("lift_to") && reported.contains("height is int there and float here"), "{reported}");
}

#[test]
fn a_method_takes_its_call_and_a_task_tells_how_far_it_is() {
    let bench = Bench::new(4);
    let (board, manager, fork, at_fork) =
        pair_with_boards(&bench, |unit| unit.my_function_list().serve(DriveServer).unwrap());
    at_fork.spawn(drive(fork));
    let peer = manager.peer("agv").unwrap();
    finish(&bench, &board, async move {
        let client = DriveClient::at(&peer);
        let mut reported = Vec::new();
        let heard = |Left { left }| {
            reported.push(left);
            ControlFlow::Continue(())
        };
        assert_eq!(client.drive(3).watch(heard).await, Ok(Arrived { metres: 7 }));
        assert_eq!(reported, [3.0, 2.0, 1.0]);
        let failed = client.drive(10).watch(|_| unreachable!("it does not begin")).await.unwrap_err();
        assert_eq!(failed.error, Error::Service(ServiceError::Failed(3)));
        assert_eq!((failed.text(), failed.values()), ("it is too far", Some(TooHeavy { kilograms: 900 })));
        assert_eq!(client.drive(0).await, Ok(Arrived { metres: 0 }), "without taking it");
        let failed = client.drive(9).watch(|_| ControlFlow::Break(())).await.unwrap_err();
        assert_eq!(failed.error, Error::Cancelled);
    });
    assert!(bench.run_until(|| fork.with_state(|fork| fork.losses).unwrap() == 1, LONG), "its service sees it");
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
        let client = LiftClient::at(&peer);
        let failed = client.tilt(6).watch(|_| unreachable!("nothing is told")).await.unwrap_err();
        assert_eq!(failed.error, Error::Service(ServiceError::Failed(3)));
        assert_eq!((failed.text(), failed.values()), ("it is too heavy", Some(TooHeavy { kilograms: 900 })));
        assert_eq!(client.tilt(5).watch(|_| ControlFlow::Continue(())).await, Ok(()));
        let client = TiltClient::at(&peer);
        assert_eq!(client.tilt(5).await, Ok(()));
        let failed = client.tilt(6).watch(|_| unreachable!("nothing is told")).await.unwrap_err();
        assert_eq!(failed.values(), Some(TooHeavy { kilograms: 900 }));
    });
}
