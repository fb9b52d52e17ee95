//! Failures with text and values, progress, and calls that are given up, between boards.

use std::cell::{Cell, RefCell};
use std::ops::ControlFlow;
use std::pin::pin;
use std::rc::Rc;
use std::task::{Context, Waker};

use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, Limit, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_embassy::{Config, Failure, Handle, Handler, Limits, ServiceOptions, TakenCall, resources};
use cara_embassy_host::{Bench, Board, keys};

const LONG: Duration = Duration::from_secs(30);
const LIMITS: Limits = Limits { links: 2, message_buffers: 6, ..Limits::S_UNIT };
const GO: &str = "go(number: int) -> (number: int) progress (left: int) fails (at: int[2])";
const FAILED: Error = Error::Service(ServiceError::Failed(7));

type Unit = Handle<()>;
type Memory = resources!((), LIMITS);

fn start(board: &Board, config: Config) -> Unit {
    let memory = Box::leak(Box::new(Memory::new()));
    let (unit, mut runner) = cara_embassy::new(board.network(), memory, config, ()).unwrap();
    board.spawn(async move { runner.run().await });
    unit
}

/// A manager that calls, a vehicle whose task serves `go`, and the bench below both.
struct Pair {
    bench: Bench,
    boards: [Board; 2],
    manager: Unit,
    agv: Unit,
}

impl Pair {
    fn met(seed: u64, serve: impl AsyncFn(TakenCall<()>, &ParametersView) + 'static) -> Self {
        let bench = Bench::new(seed);
        let boards = [bench.board(), bench.board()];
        let [manager, agv] = [Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap()];
        let [for_manager, for_agv] = [&manager, &agv].map(|own| keys(0, own, 0, bench.random(u64::MAX)));
        let manager = start(&boards[0], Config::m_unit("manager", 1, for_manager).unwrap());
        let agv = start(&boards[1], Config::s_unit("agv", 7, "manager", 1, for_agv).unwrap());
        agv.my_function_list().add_service(GO, ServiceOptions::new(), Handler::task()).unwrap();
        let refuse = Handler::free(&|call, _| Err(call.fail(Failure::new(4, "not at this time"))));
        agv.my_function_list().add_service("refuse()", ServiceOptions::new(), refuse).unwrap();
        let echo = Handler::free(&|_, _| Ok(()));
        agv.my_function_list().add_service("echo(number: int) -> (number: int)", ServiceOptions::new(), echo).unwrap();
        agv.publish_my_function_list().unwrap();
        boards[1].spawn(async move {
            let mut parameters = Parameters::<512>::sized();
            loop {
                let call = agv.next_call("go", &mut parameters).await.unwrap();
                serve(call, &parameters).await;
            }
        });
        let pair = Self { bench, boards, manager, agv };
        let knows = || pair.manager.peer("agv").is_ok_and(|agv| agv.their_function_list().contains("echo"));
        assert!(pair.bench.run_until(knows, LONG));
        pair
    }

    /// How a call of the manager ends, and what it has told.
    fn watch(&self, go_on: impl Fn(i64) -> ControlFlow<()> + 'static) -> (Result<(), Error>, Vec<i64>) {
        let (ended, heard) = (Rc::<Cell<Option<_>>>::default(), Rc::<RefCell<Vec<_>>>::default());
        let (end, hear, agv) = (ended.clone(), heard.clone(), self.manager.peer("agv").unwrap());
        self.boards[0].spawn(async move {
            let on_progress = |reported: &ParametersView| {
                hear.borrow_mut().push(reported.variable("left").unwrap());
                go_on(*hear.borrow().last().unwrap())
            };
            let mut parameters = one("number", 1);
            end.set(Some(agv.call("go", &mut parameters).watch(on_progress).await.map_err(Error::from)));
        });
        assert!(self.bench.run_until(|| ended.get().is_some(), LONG));
        (ended.get().unwrap(), heard.take())
    }

    /// How a call of the manager ends, and what it is told of its failure.
    fn ask(&self, function: &'static str, options: RequestOptions) -> (Result<(), Error>, Option<Failure>) {
        let ended = Rc::<RefCell<Option<_>>>::default();
        let (reported, agv) = (ended.clone(), self.manager.peer("agv").unwrap());
        self.boards[0].spawn(async move {
            let outcome = agv.call(function, &mut one("number", 1)).with(options).await;
            let why = outcome.as_ref().err().and_then(|failed| failed.failure().cloned());
            *reported.borrow_mut() = Some((outcome.map_err(Error::from), why));
        });
        assert!(self.bench.run_until(|| ended.borrow().is_some(), LONG));
        ended.take().unwrap()
    }
}

fn one(name: &str, value: i64) -> Parameters {
    let mut parameters = Parameters::new();
    parameters.add_int(name, 1).unwrap();
    parameters.set_value(name, value).unwrap();
    parameters
}

#[test]
fn a_failure_brings_its_text_and_its_values() {
    let explains = Rc::new(Cell::new(true));
    let says = explains.clone();
    let pair = Pair::met(1, async move |call: TakenCall<()>, _: &ParametersView| {
        if !says.get() {
            return call.reply(Err(ServiceError::Failed(7))).await;
        }
        let mut blocked = Failure::new(7, "the way is blocked");
        blocked.values_mut().add_int("at", 2).unwrap();
        blocked.values_mut().set_value("at", [3, 4]).unwrap();
        call.fail(&blocked).await;
    });
    let (outcome, why) = pair.ask("go", RequestOptions::new());
    let why = why.expect("its service has said why");
    assert_eq!((outcome, why.code(), why.text()), (Err(FAILED), 7, "the way is blocked"));
    assert_eq!(why.values().variable("at"), Ok([3_i64, 4]));
    // What was said of an earlier call is not said of this one.
    explains.set(false);
    let (outcome, why) = pair.ask("go", RequestOptions::new());
    assert!(outcome == Err(FAILED) && why.is_none(), "{why:?}");
    // A handler that the runner runs says it as well.
    let (outcome, why) = pair.ask("refuse", RequestOptions::new());
    assert_eq!(outcome, Err(Error::Service(ServiceError::Failed(4))));
    assert_eq!(why.expect("it has said why").text(), "not at this time");
}

#[test]
fn a_task_tells_how_far_it_is_and_its_caller_hears_it() {
    let reported = Rc::<RefCell<Vec<_>>>::default();
    let reports = reported.clone();
    let pair = Pair::met(2, async move |call: TakenCall<()>, arguments: &ParametersView| {
        for values in [one("left", 2), one("left", 1), one("wrong", 0)] {
            reports.borrow_mut().push(call.progress(&values));
        }
        embassy_time::Timer::after_millis(50).await;
        reports.borrow_mut().push(call.progress(&one("left", 0)));
        embassy_time::Timer::after_millis(50).await;
        call.reply(Ok(arguments)).await;
    });
    assert_eq!(pair.watch(|_| ControlFlow::Continue(())), (Ok(()), vec![2, 0]));
    let reported = reported.take();
    let full = Err(Error::Full(Limit::SendQueue));
    assert_eq!((reported[0], reported[1], reported[3]), (Ok(()), full, Ok(())));
    assert!(!matches!(reported[2], Ok(()) | Err(Error::Full(_))), "{reported:?}");
    assert_eq!(pair.agv.counted(LinkCounter::ProgressSent), 2);
    assert_eq!(pair.manager.counted(LinkCounter::ProgressReceived), 2);
    // A caller that does not want to know is sent nothing.
    assert_eq!(pair.ask("go", RequestOptions { progress: true, ..RequestOptions::new() }).0, Ok(()));
    assert_eq!(pair.agv.counted(LinkCounter::ProgressSent), 2);
}

#[test]
fn a_caller_gives_a_call_up_by_what_it_hears() {
    let ended = Rc::new(Cell::new(0));
    let count = ended.clone();
    let pair = Pair::met(4, async move |call: TakenCall<()>, arguments: &ParametersView| {
        let mut left = 9;
        while !call.is_cancelled() {
            left -= 1;
            let _ = call.progress(&one("left", left));
            embassy_time::Timer::after_millis(50).await;
        }
        count.set(count.get() + 1);
        call.reply(Ok(arguments)).await;
    });
    let outcome = pair.watch(|left| if left > 6 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) });
    assert_eq!(outcome, (Err(Error::Cancelled), vec![8, 7, 6]));
    assert!(pair.bench.run_until(|| ended.get() == 1, LONG), "its service is told");
    assert_eq!(pair.agv.counted(LinkCounter::RunningCancelled), 1);
}

/// What is told waits in the room for replies, and holds none of them up.
#[test]
fn what_a_call_tells_makes_way_for_the_reply_of_another_one() {
    let pair = Pair::met(5, async move |call: TakenCall<()>, arguments: &ParametersView| {
        call.progress(&one("left", 1)).unwrap();
        embassy_time::Timer::after_millis(200).await;
        call.reply(Ok(arguments)).await;
    });
    let agv = pair.manager.peer("agv").unwrap();
    let mut waits = pin!(async {
        let mut parameters = one("number", 1);
        agv.call("go", &mut parameters).watch(|_| ControlFlow::Break(())).await
    });
    let mut look = || waits.as_mut().poll(&mut Context::from_waker(Waker::noop()));
    assert!(look().is_pending());
    assert!(pair.bench.run_until(|| pair.manager.counted(LinkCounter::ProgressReceived) == 1, LONG));
    assert_eq!(pair.ask("echo", RequestOptions::new()).0, Ok(()));
    assert!(look().is_pending(), "the reply has taken its place");
}

#[test]
fn a_task_sees_that_its_call_is_given_up() {
    let ended = Rc::new(Cell::new(0));
    let count = ended.clone();
    let pair = Pair::met(3, async move |call: TakenCall<()>, arguments: &ParametersView| {
        assert!(!call.is_cancelled() && call.deadline > cara_embassy::now());
        call.given_up().await;
        assert!(call.is_cancelled());
        count.set(count.get() + 1);
        call.reply(Ok(arguments)).await;
    });
    let short = RequestOptions { timeout: Some(Duration::from_millis(300)), ..RequestOptions::new() };
    let before = pair.bench.now();
    let agv = pair.manager.peer("agv").unwrap();
    pair.boards[0].spawn(async move {
        let outcome = agv.call("go", &mut one("number", 1)).with(short).await;
        assert_eq!(outcome.map_err(Error::from), Err(Error::TimedOut));
    });
    pair.bench.run_for(Duration::from_millis(100));
    // Nothing says that the time of its caller is over.
    pair.boards[1].lose_frames_of(&pair.boards[0]);
    assert!(pair.bench.run_until(|| ended.get() == 1, LONG), "its caller waits no longer");
    let after = pair.bench.now().since(before);
    assert!(after > Duration::from_millis(290) && after < Duration::from_millis(400), "{after:?}");
    pair.boards[1].heal();
    // Of a call that nobody waits for, only the end of its link is one.
    pair.manager.peer("agv").unwrap().request("go", &one("number", 1)).unwrap();
    pair.bench.run_for(LONG);
    assert_eq!(ended.get(), 1);
    pair.boards[0].cut_power();
    assert!(pair.bench.run_until(|| ended.get() == 2, LONG), "its caller is gone");
}
