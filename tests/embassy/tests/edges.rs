//! Calls that wait for a task, answers that wait for room, claims that wait for standstill: what comes in between.

use std::cell::{Cell, RefCell};
use std::pin::pin;
use std::rc::Rc;
use std::task::Context;

use cara_core::config::Priority;
use cara_core::distribution::claim::{Claim, KEY_FINGERPRINT_BYTES, StoredClaim, TaggedClaim};
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{Error, ServiceError};
use cara_core::services::heart::Renew;
use cara_core::services::lease::{Lease, Stage};
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_embassy::{
    Config, Handle, Handler, Limits, Resources, Security, ServiceOptions, TakenCall, UnitEvent, resources,
};
use cara_embassy_host::{Bench, Board, dropping, is_held, keys, number};
use embassy_time::{Duration as Span, with_timeout};

const SHORT: Duration = Duration::from_secs(5);
const LONG: Duration = Duration::from_secs(30);

const NOTHING: StoredClaim = StoredClaim { tagged: TaggedClaim::NONE, key: [0; KEY_FINGERPRINT_BYTES] };

type Unit = Handle<()>;
type Outcomes = Rc<RefCell<Vec<(i64, Result<(), Error>)>>>;

const MANAGER: Limits = Limits { links: 4, message_buffers: 8, calls: 12, ..Limits::S_UNIT };
const NO_TASK: Limits = Limits { tasks: 0, ..Limits::S_UNIT };
const TWO_TASKS: Limits = Limits { tasks: 2, ..Limits::S_UNIT };

fn leaked<V>(value: V) -> &'static mut V {
    Box::leak(Box::new(value))
}

macro_rules! start {
    ($board:expr, $limits:expr, $config:expr) => {{
        let memory: &'static mut resources!((), $limits) = leaked(Resources::new());
        let (unit, mut runner) = cara_embassy::new($board.network(), memory, $config, ()).unwrap();
        $board.spawn(async move { runner.run().await });
        unit
    }};
}

fn proof(bench: &Bench, own: &Identity) -> Security {
    keys(0, own, 0, bench.random(u64::MAX))
}

fn manager_config(bench: &Bench) -> Config {
    Config::m_unit("manager", 1, proof(bench, &Identity::m_unit("manager", 1).unwrap())).unwrap()
}

fn agv_config(bench: &Bench) -> Config {
    Config::s_unit("agv", 7, "manager", 1, proof(bench, &Identity::s_unit("agv", 7).unwrap())).unwrap()
}

fn manager(bench: &Bench) -> (Board, Unit) {
    let board = bench.board();
    let unit = start!(board, MANAGER, manager_config(bench));
    (board, unit)
}

fn knows(unit: Unit, function: &str) -> bool {
    unit.nodes_offering(function).next().is_some()
}

/// Calls a function of the vehicle; when the call ends, its outcome is with the others.
fn call(board: &Board, unit: Unit, function: &'static str, n: i64, outcomes: &Outcomes) {
    let offering = unit.nodes_offering(function).next();
    let (peer, outcomes) = (offering.expect("a node offers it"), Rc::clone(outcomes));
    board.spawn(async move {
        let mut parameters = number(n);
        if function == "list" {
            parameters.add_string("text", 400).unwrap();
        }
        let options = RequestOptions { timeout: Some(LONG), renew: Renew::Process, ..RequestOptions::default() };
        let outcome = peer.call(function, &mut parameters).with(options).await;
        outcomes.borrow_mut().push((n, outcome.map_err(Error::from)));
    });
}

/// Takes the next call of a function, if one comes within a second: its argument and what answers it.
fn take(bench: &Bench, board: &Board, unit: Unit, function: &'static str) -> Option<(i64, TakenCall<()>)> {
    let taken = Rc::new(RefCell::new(None));
    let put = Rc::clone(&taken);
    board.spawn(async move {
        let mut parameters = Parameters::new();
        let call = with_timeout(Span::from_secs(1), unit.next_call(function, &mut parameters)).await;
        let call = call.ok().map(|call| (parameters.variable("n").unwrap(), call.unwrap()));
        put.replace(Some(call));
    });
    assert!(bench.run_until(|| taken.borrow().is_some(), SHORT));
    taken.take().unwrap()
}

thread_local! {
    static MADE_SAFE: Cell<u32> = const { Cell::new(0) };
}

#[test]
fn a_call_whose_order_has_ended_makes_room_for_the_one_that_replaced_it() {
    let bench = Bench::new(31);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, Limits::S_UNIT, agv_config(&bench));
    let options = ServiceOptions::new()
        .lease(Duration::from_millis(400), leaked(Lease::new()), &|| MADE_SAFE.set(MADE_SAFE.get() + 1));
    agv.my_function_list().add_service("go_to(n: int) -> (n: int)", options, Handler::task()).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "go_to"), SHORT));
    let outcomes = Outcomes::default();
    // No task asks yet, and there is one place.
    for n in [1, 2] {
        call(&manager_board, manager, "go_to", n, &outcomes);
        bench.run_for(Duration::from_millis(100));
    }
    let (n, taken) = take(&bench, &board, agv, "go_to").expect("it waits");
    assert_eq!((n, MADE_SAFE.get()), (2, 0));
    assert_eq!(*outcomes.borrow(), [(1, Err(Error::Expired))]);
    board.spawn(async move { taken.reply(Ok(&number(2))).await });
    assert!(bench.run_until(|| outcomes.borrow().len() == 2, SHORT));
    assert_eq!(outcomes.borrow()[1], (2, Ok(())));
}

#[test]
fn a_call_that_no_task_takes_leaves_its_place_at_its_deadline() {
    let bench = Bench::new(32);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, Limits::S_UNIT, agv_config(&bench));
    for signature in ["nobody(n: int) -> (n: int)", "note(n: int) -> (n: int)"] {
        agv.my_function_list().add_service(signature, ServiceOptions::new(), Handler::task()).unwrap();
    }
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "note"), SHORT));
    let outcomes = Outcomes::default();
    call(&manager_board, manager, "nobody", 1, &outcomes);
    bench.run_for(Duration::from_millis(100));
    call(&manager_board, manager, "note", 2, &outcomes);
    assert!(bench.run_until(|| outcomes.borrow().len() == 1, SHORT));
    assert_eq!(outcomes.borrow()[0], (2, Err(Error::Busy)), "the one place is taken");
    assert!(bench.run_until(|| outcomes.borrow().len() == 2, LONG.times(2)));
    call(&manager_board, manager, "note", 3, &outcomes);
    let (n, _taken) = take(&bench, &board, agv, "note").expect("it waits");
    assert_eq!(n, 3);
}

#[test]
fn calls_of_a_task_begin_in_their_order_whatever_place_was_free() {
    let bench = Bench::new(33);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, TWO_TASKS, agv_config(&bench));
    agv.my_function_list().add_service("note(n: int) -> (n: int)", ServiceOptions::new(), Handler::task()).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "note"), SHORT));
    let outcomes = Outcomes::default();
    let send = |n| {
        call(&manager_board, manager, "note", n, &outcomes);
        bench.run_for(Duration::from_millis(100));
    };
    let next = || take(&bench, &board, agv, "note").expect("it waits");
    send(1);
    send(2);
    let one = next();
    send(3);
    let (two, three) = (next(), next());
    assert_eq!([one.0, two.0, three.0], [1, 2, 3]);
}

#[test]
fn a_call_of_a_function_that_is_gone_reaches_no_other_one() {
    let bench = Bench::new(34);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, Limits::S_UNIT, agv_config(&bench));
    let add = |signature| agv.my_function_list().add_service(signature, ServiceOptions::new(), Handler::task());
    add("one(n: int) -> (n: int)").unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "one"), SHORT));
    let outcomes = Outcomes::default();
    call(&manager_board, manager, "one", 1, &outcomes);
    bench.run_for(Duration::from_millis(100));
    agv.my_function_list().remove("one").unwrap();
    add("other(n: int) -> (n: int)").unwrap();
    assert!(take(&bench, &board, agv, "other").is_none(), "it was called for what is gone");
    assert_eq!(*outcomes.borrow(), [(1, Err(Error::StaleFunction))]);
    // A task that waits for its calls learns it as well.
    let ended = Rc::new(RefCell::new(None));
    let put = Rc::clone(&ended);
    board.spawn(async move {
        let outcome = agv.next_call("other", &mut Parameters::<512>::sized()).await;
        put.replace(Some(outcome.map(drop)));
    });
    bench.run_for(Duration::from_millis(100));
    agv.my_function_list().remove("other").unwrap();
    assert!(bench.run_until(|| ended.borrow().is_some(), SHORT));
    assert_eq!(ended.take(), Some(Err(Error::UnknownFunction)));
}

#[test]
fn a_service_that_goes_leaves_the_order_of_another_one_with_its_lease() {
    let bench = Bench::new(38);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, Limits::S_UNIT, agv_config(&bench));
    let drive: &'static Lease = leaked(Lease::new());
    let made_safe = || MADE_SAFE.set(MADE_SAFE.get() + 1);
    let options = || ServiceOptions::new().lease(Duration::from_millis(400), drive, leaked(made_safe));
    let (functions, nothing) = (agv.my_function_list(), Handler::free(&|_, _| Ok(())));
    for signature in ["go_to(n: int) -> (n: int)", "dock(n: int)", "park(n: int)"] {
        functions.add_service(signature, options(), nothing).unwrap();
    }
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "park"), SHORT));
    let outcomes = Outcomes::default();
    call(&manager_board, manager, "go_to", 1, &outcomes);
    assert!(bench.run_until(|| outcomes.borrow().len() == 1, SHORT));
    functions.remove("dock").unwrap();
    functions.replace("park(n: int, fast: bool)", options(), nothing).unwrap();
    bench.run_for(SHORT);
    assert!(drive.is_live(cara_embassy::now()) && MADE_SAFE.get() == 0, "it is renewed");
    functions.remove("go_to").unwrap();
    assert!(!drive.is_live(cara_embassy::now()) && MADE_SAFE.get() == 1, "its own service is gone");
}

#[test]
fn a_call_that_is_dropped_while_the_machine_is_in_use_is_answered_behind_it() {
    let bench = Bench::new(37);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, Limits::S_UNIT, agv_config(&bench));
    agv.my_function_list().add_service("note(n: int) -> (n: int)", ServiceOptions::new(), Handler::task()).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "note"), SHORT));
    let outcomes = Outcomes::default();
    call(&manager_board, manager, "note", 1, &outcomes);
    let (_, taken) = take(&bench, &board, agv, "note").expect("it waits");
    let mut waits = pin!(agv.wait_until(|_| false));
    let waker = dropping(taken);
    assert!(waits.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    drop(waker);
    assert!(is_held() && outcomes.borrow().is_empty());
    // The machine has the last waker, and drops it for this news.
    manager.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| !is_held(), SHORT));
    assert!(bench.run_until(|| !outcomes.borrow().is_empty(), SHORT), "it is answered");
    assert_eq!(*outcomes.borrow(), [(1, Err(Error::Service(ServiceError::NotReady)))]);
}

thread_local! {
    static LISTED: Cell<u32> = const { Cell::new(0) };
    static BRAKED: Cell<u32> = const { Cell::new(0) };
}

/// Neither a stop nor anything that moves: what a stop's rules do not help.
#[test]
fn an_emergency_does_not_wait_for_an_answer_that_nobody_reads() {
    let bench = Bench::new(35);
    let ((manager_board, manager), board) = (manager(&bench), bench.board());
    let agv = start!(board, NO_TASK, agv_config(&bench));
    let list = Handler::free(&|_, parameters| {
        LISTED.set(LISTED.get() + 1);
        parameters.set_value("text", "x".repeat(350).as_str()).map_err(|_| ServiceError::BadResults)
    });
    let brake = Handler::free(&|_, _| {
        BRAKED.set(BRAKED.get() + 1);
        Ok(())
    });
    let functions = agv.my_function_list();
    functions
        .add_service("list(n: int, text: string[400]) -> (n: int, text: string[400])", ServiceOptions::new(), list)
        .unwrap();
    functions.add_service("brake(n: int)", ServiceOptions::new().priority(Priority::Emergency), brake).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "list") && knows(manager, "brake"), SHORT));
    // What the vehicle sends does not arrive; what its manager sends does.
    manager_board.lose_frames_of(&board);
    let outcomes = Outcomes::default();
    for n in 0..10 {
        call(&manager_board, manager, "list", n, &outcomes);
        bench.run_for(Duration::from_millis(20));
    }
    assert!(LISTED.get() < 10, "{} calls have run: all answers found room", LISTED.get());
    call(&manager_board, manager, "brake", 100, &outcomes);
    bench.run_for(Duration::from_millis(20));
    assert_eq!(BRAKED.get(), 1);
}

thread_local! {
    static DRIVE: Cell<Option<&'static Lease>> = const { Cell::new(None) };
    static STORED: RefCell<Vec<Stage>> = const { RefCell::new(Vec::new()) };
}

/// A write to flash can take seconds, in which nobody switches the motors off.
#[test]
fn a_claim_is_stored_when_the_vehicle_stands_and_not_while_it_slows_down() {
    let bench = Bench::new(36);
    let drive: &'static Lease = leaked(Lease::new());
    // Shorter than a moving call waits for its claim.
    drive.set_ramp(Duration::from_millis(1_500));
    DRIVE.set(Some(drive));
    let store = |_: &StoredClaim| {
        let stage = DRIVE.get().unwrap().stage(cara_embassy::now());
        STORED.with_borrow_mut(|stored| stored.push(stage));
        true
    };
    let manager_of = |term| {
        let board = bench.board();
        let claim = Claim { term, claimant: 1 };
        let unit = start!(board, MANAGER, manager_config(&bench).claim(claim, |_| true));
        (board, unit)
    };
    let ((first_board, first), board) = (manager_of(5), bench.board());
    let agv = start!(board, Limits::S_UNIT, agv_config(&bench).obeyed_claim(NOTHING, store));
    let options = ServiceOptions::new().lease(Duration::from_millis(400), drive, &|| {});
    let go_to = Handler::free(&|_, _| Ok(()));
    agv.my_function_list().add_service("go_to(n: int) -> (n: int)", options, go_to).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(first, "go_to"), LONG));
    let outcomes = Outcomes::default();
    call(&first_board, first, "go_to", 1, &outcomes);
    assert!(bench.run_until(|| outcomes.borrow().len() == 1, SHORT));
    assert_eq!(STORED.take(), [Stage::Dead], "before it drives");
    let (second_board, second) = manager_of(6);
    assert!(bench.run_until(|| knows(second, "go_to"), LONG));
    let began = bench.now();
    let slows_down = || drive.stage(cara_embassy::now()) == Stage::Stopping;
    assert!(slows_down(), "the order of the first has ended, and its ramp has not");
    while STORED.with_borrow(Vec::is_empty) && bench.now().since(began) < LONG {
        call(&second_board, second, "go_to", 2, &outcomes);
        bench.run_for(Duration::from_millis(500));
    }
    assert_eq!(STORED.take(), [Stage::Dead]);
}

thread_local! {
    static OBEYED: Cell<StoredClaim> = const { Cell::new(NOTHING) };
    static RAISED: RefCell<Vec<bool>> = const { RefCell::new(Vec::new()) };
}

/// It would not renew its orders with other vehicles meanwhile.
#[test]
fn a_manager_raises_its_claim_while_it_holds_no_order_and_says_when_it_cannot() {
    let bench = Bench::new(39);
    let lift: &'static Lease = leaked(Lease::new());
    DRIVE.set(Some(lift));
    let manager_of = |term| {
        let board = bench.board();
        let store = |_| {
            let is_live = DRIVE.get().unwrap().is_live(cara_embassy::now());
            RAISED.with_borrow_mut(|raised| raised.push(is_live));
            // The first time it fails.
            RAISED.with_borrow(|raised| raised.len() > 1)
        };
        let unit = start!(board, MANAGER, manager_config(&bench).claim(Claim { term, claimant: 1 }, store));
        (board, unit)
    };
    let serve = |config, function, lease| {
        let board = bench.board();
        let unit = start!(board, Limits::S_UNIT, config);
        let options = ServiceOptions::new().lease(Duration::from_millis(400), lease, &|| {});
        unit.my_function_list().add_service(function, options, Handler::free(&|_, _| Ok(()))).unwrap();
        unit.publish_my_function_list().unwrap();
        (board, unit)
    };
    let agv = || {
        let store = |claim: &StoredClaim| {
            OBEYED.set(*claim);
            true
        };
        serve(agv_config(&bench).obeyed_claim(OBEYED.get(), store), "go_to(n: int) -> (n: int)", leaked(Lease::new()))
    };
    let outcomes = Outcomes::default();
    let ((first_board, first), (board, _)) = (manager_of(6), agv());
    assert!(bench.run_until(|| knows(first, "go_to"), LONG));
    call(&first_board, first, "go_to", 1, &outcomes);
    assert!(bench.run_until(|| outcomes.borrow().len() == 1 && OBEYED.get() != NOTHING, SHORT));
    [first_board, board].iter().for_each(Board::cut_power);

    let (manager_board, manager) = manager_of(5);
    let events = Rc::new(RefCell::new(Vec::new()));
    let heard = Rc::clone(&events);
    manager_board.spawn(async move {
        loop {
            let event = manager.next_event().await;
            heard.borrow_mut().push(event);
        }
    });
    let other = Config::s_unit("lift", 8, "manager", 1, proof(&bench, &Identity::s_unit("lift", 8).unwrap())).unwrap();
    let _lift = serve(other, "raise(n: int) -> (n: int)", lift);
    assert!(bench.run_until(|| knows(manager, "raise"), LONG));
    call(&manager_board, manager, "raise", 2, &outcomes);
    assert!(bench.run_until(|| outcomes.borrow().len() == 2, SHORT));
    let _agv = agv();
    bench.run_for(LONG);
    assert!(lift.is_live(cara_embassy::now()) && RAISED.with_borrow(Vec::is_empty), "it holds an order");
    manager.peer("lift").unwrap().release("raise").unwrap();
    assert!(bench.run_until(|| !RAISED.with_borrow(Vec::is_empty), LONG));
    assert!(!knows(manager, "go_to") && manager.node_counted(NodeCounter::ClaimsNotKept) == 1);
    assert!(bench.run_until(|| knows(manager, "go_to"), LONG.times(4)), "it is stored the second time");
    assert_eq!(RAISED.take(), [false, false]);
    let is_of_itself = |event: &UnitEvent| matches!(event, UnitEvent::ClaimNotKept { peer, claim } if *peer == manager.identity() && claim.term > 6);
    assert!(events.borrow().iter().any(is_of_itself), "{:?}", events.borrow());
}
