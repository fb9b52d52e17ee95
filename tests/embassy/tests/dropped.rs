//! Tasks that end with their last waker while the machine has it: whatever was in their frames is given up, however much it is.

use std::cell::{Cell, RefCell};
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Waker};

use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{Error, ServiceError};
use cara_core::services::heart::Renew;
use cara_core::services::lease::Lease;
use cara_core::time::Duration;
use cara_embassy::{Config, Handle, Handler, Limits, Resources, ServiceOptions, TakenCall, resources};
use cara_embassy_host::{Bench, Board, dropping, is_held, keys, number};

const LONG: Duration = Duration::from_secs(30);
/// As much as a message needs from board to board. Neither renewals nor keep-alives come as often.
const AT_ONCE: Duration = Duration::from_millis(20);
/// Of the leases here.
const LEASE: Duration = Duration::from_secs(20);
const CALLS: usize = 8;
/// Calls that run at once; some places are kept for emergencies.
const TAKEN: usize = 6;
const LIMITS: Limits = Limits { links: 2, message_buffers: 8, calls: CALLS, tasks: 8, ..Limits::S_UNIT };

type Unit = Handle<()>;
type Pending = Pin<Box<dyn Future<Output = Result<(), Error>>>>;

thread_local! {
    static MADE_SAFE: Cell<u32> = const { Cell::new(0) };
}

fn start(board: &Board, config: Config) -> Unit {
    let memory: &'static mut resources!((), LIMITS) = Box::leak(Box::new(Resources::new()));
    let (unit, mut runner) = cara_embassy::new(board.network(), memory, config, ()).unwrap();
    board.spawn(async move { runner.run().await });
    unit
}

/// A vehicle that calls its manager: `lift` starts something that is held, and `wait` is answered when a task does so.
struct Pair {
    bench: Bench,
    boards: [Board; 2],
    manager: Unit,
    agv: Unit,
}

impl Pair {
    fn met(seed: u64) -> Self {
        let bench = Bench::new(seed);
        let boards = [bench.board(), bench.board()];
        let [manager, agv] = [Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap()];
        let [for_manager, for_agv] = [&manager, &agv].map(|own| keys(0, own, 0, bench.random(u64::MAX)));
        let manager = start(&boards[0], Config::m_unit("manager", 1, for_manager).unwrap());
        let agv = start(&boards[1], Config::s_unit("agv", 7, "manager", 1, for_agv).unwrap());
        let lease = Box::leak(Box::new(Lease::new()));
        let lift = ServiceOptions::new().lease(LEASE, lease, &|| MADE_SAFE.set(MADE_SAFE.get() + 1));
        let functions = manager.my_function_list();
        functions.add_service("lift(n: int)", lift, Handler::free(&|_, _| Ok(()))).unwrap();
        functions.add_service("wait(n: int)", ServiceOptions::new(), Handler::task()).unwrap();
        manager.publish_my_function_list().unwrap();
        let pair = Self { bench, boards, manager, agv };
        assert!(pair.bench.run_until(|| pair.knows(), LONG));
        pair
    }

    fn knows(&self) -> bool {
        self.agv.peer("manager").is_ok_and(|manager| manager.their_function_list().contains("wait"))
    }

    /// Runs a future on the board of a unit until it is over.
    fn finish<R: 'static>(&self, board: usize, future: impl Future<Output = R> + 'static) -> R {
        let result = Rc::new(RefCell::new(None));
        let reported = Rc::clone(&result);
        self.boards[board].spawn(async move {
            let ended = future.await;
            reported.replace(Some(ended));
        });
        assert!(self.bench.run_until(|| result.borrow().is_some(), LONG), "it ends");
        result.take().unwrap()
    }

    fn lift(&self) -> impl std::any::Any + use<> {
        let peer = self.agv.peer("manager").unwrap();
        self.finish(1, async move { peer.call("lift", &mut number(1)).renewing(Renew::Process).hold().await.unwrap() })
    }

    /// A call that is under way and has no answer.
    fn wait(&self) -> Pending {
        let peer = self.agv.peer("manager").unwrap();
        let mut pending: Pending = Box::pin(async move {
            let mut parameters = number(1);
            Ok(peer.call("wait", &mut parameters).timeout(LONG).await?)
        });
        assert!(pending.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending());
        pending
    }

    fn take(&self) -> TakenCall<()> {
        let unit = self.manager;
        self.finish(0, async move { unit.next_call("wait", &mut Parameters::new()).await.unwrap() })
    }

    /// As many as can be under way: none of those before has left its place taken.
    fn calls_go_through(&self) {
        let _calls: Vec<_> = (0..TAKEN).map(|_| self.wait()).collect();
        let _taken: Vec<_> = (0..TAKEN).map(|_| self.take()).collect();
    }

    /// Drops something while the machine of a unit is in use.
    fn drop_in_use(&self, unit: Unit, held: impl std::any::Any) {
        let waker = dropping(held);
        let mut waits = Box::pin(unit.next_event());
        while waits.as_mut().poll(&mut Context::from_waker(&waker)).is_ready() {
            waits = Box::pin(unit.next_event());
        }
        drop(waker);
        assert!(is_held());
        // The machine has the last waker, which gives way to this one.
        assert!(waits.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending());
        assert!(!is_held());
    }
}

#[test]
fn a_hold_is_released_at_once() {
    let pair = Pair::met(1);
    let held = pair.lift();
    // Nothing else wakes the runner meanwhile.
    pair.bench.run_for(Duration::from_millis(300));
    pair.drop_in_use(pair.agv, held);
    pair.bench.run_for(AT_ONCE);
    assert_eq!(MADE_SAFE.get(), 1);
}

#[test]
fn a_hold_is_released_behind_any_number_of_calls() {
    let pair = Pair::met(2);
    let held = pair.lift();
    let calls: Vec<_> = (1..CALLS).map(|_| pair.wait()).collect();
    pair.drop_in_use(pair.agv, (calls, held));
    pair.bench.run_for(AT_ONCE);
    assert_eq!(MADE_SAFE.get(), 1);
    pair.calls_go_through();
}

#[test]
fn holds_of_what_has_ended_take_no_place() {
    let pair = Pair::met(3);
    // Each takes the place of the one before.
    let held: Vec<_> = (0..50).map(|_| pair.lift()).collect();
    assert_eq!(MADE_SAFE.get(), 0);
    pair.drop_in_use(pair.agv, held);
    pair.bench.run_for(AT_ONCE);
    assert_eq!(MADE_SAFE.get(), 1);
}

#[test]
fn calls_whose_link_has_ended_leave_their_places() {
    let pair = Pair::met(4);
    for _ in 0..3 {
        let calls: Vec<_> = (1..CALLS).map(|_| pair.wait()).collect();
        pair.boards[0].reset_streams();
        pair.bench.run_for(AT_ONCE);
        pair.drop_in_use(pair.agv, calls);
        assert!(pair.bench.run_until(|| pair.knows(), LONG));
        pair.bench.run_for(Duration::from_secs(1));
    }
    pair.calls_go_through();
}

#[test]
fn all_calls_that_tasks_had_taken_are_answered() {
    let pair = Pair::met(5);
    let outcomes = Rc::<RefCell<Vec<Error>>>::default();
    let mut taken = Vec::new();
    for _ in 0..TAKEN {
        let (pending, reported) = (pair.wait(), Rc::clone(&outcomes));
        pair.boards[1].spawn(async move {
            let failed = pending.await.unwrap_err();
            reported.borrow_mut().push(failed);
        });
        taken.push(pair.take());
    }
    pair.drop_in_use(pair.manager, taken);
    pair.bench.run_for(AT_ONCE);
    assert_eq!(*outcomes.borrow(), [Error::Service(ServiceError::NotReady); TAKEN]);
}
