//! What the port does beside the rules that scenarios show: memory, tasks that take calls, cable and address,
//! cancelling.

use std::cell::{Cell, RefCell};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use cara_core::config::{Constraints, SECURED_PORT};
use cara_core::distribution::claim::{Claim, KEY_FINGERPRINT_BYTES, StoredClaim, TaggedClaim};
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{CloseReason, Constraint, Error, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::services::access::{Functions, Rule, Verbs, Who};
use cara_core::services::heart::Renew;
use cara_core::services::lease::Lease;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_embassy::{Config, Handle, Handler, Hook, LeaseWatch, Limits, Security, ServiceOptions, UnitEvent, resources};
use cara_embassy_host::{Bench, Board, dropping, is_held, keys, number};
use embassy_net::tcp::TcpSocket;
use embassy_time::{Timer, with_timeout};

const SHORT: Duration = Duration::from_secs(5);
const LONG: Duration = Duration::from_secs(30);

/// The state of each unit here.
#[derive(Default)]
struct State {
    stops: u32,
    losses: u32,
    /// What was done, in order.
    done: Vec<&'static str>,
}

type Unit = Handle<State>;
const LIMITS: Limits = Limits { links: 4, message_buffers: 6, calls: 8, tasks: 2, ..Limits::S_UNIT };
type Manager = resources!(State, LIMITS);

fn start(board: &Board, config: Config) -> Unit {
    let memory = Box::leak(Box::new(Manager::new()));
    let (unit, mut runner) = cara_embassy::new(board.network(), memory, config, State::default()).unwrap();
    board.spawn(async move { runner.run().await });
    unit
}

fn proof(bench: &Bench, own: &Identity) -> Security {
    keys(0, own, 0, bench.random(u64::MAX))
}

fn manager_identity() -> Identity {
    Identity::m_unit("manager", 1).unwrap()
}

fn agv_identity() -> Identity {
    Identity::s_unit("agv", 7).unwrap()
}

fn agv_config(bench: &Bench) -> Config {
    Config::s_unit("agv", 7, "manager", 1, proof(bench, &agv_identity())).unwrap()
}

fn manager(bench: &Bench) -> (Board, Unit) {
    let board = bench.board();
    let unit = start(&board, Config::m_unit("manager", 1, proof(bench, &manager_identity())).unwrap());
    (board, unit)
}

fn agv(bench: &Bench) -> (Board, Unit) {
    let board = bench.board();
    let unit = start(&board, agv_config(bench));
    unit.on_manager_lost(&|state| state.losses += 1);
    (board, unit)
}

fn doubling(unit: Unit) {
    let double = Handler::method(&|_, _, parameters| {
        let n: i64 = parameters.variable("n").map_err(|_| ServiceError::BadResults)?;
        parameters.set_value("n", 2 * n).map_err(|_| ServiceError::BadResults)
    });
    unit.my_function_list().add_service("double(n: int) -> (n: int)", ServiceOptions::new(), double).unwrap();
}

/// Runs a future on a board, and time until it is over.
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

fn ask(bench: &Bench, board: &Board, unit: Unit, peer: &str, function: &str, n: i64) -> Result<i64, Error> {
    let (peer, function) = (unit.peer(peer).unwrap(), function.to_owned());
    finish(bench, board, async move {
        let mut parameters = number(n);
        peer.call(&function, &mut parameters).renewing(Renew::Process).await?;
        parameters.variable("n")
    })
}

fn knows(unit: Unit, peer: &str, function: &str) -> bool {
    unit.nodes_offering(function).any(|found| found.identity().name() == peer)
}

#[test]
fn a_board_serves_its_manager_and_asks_it() {
    let bench = Bench::new(1);
    let ((manager_board, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    for unit in [manager, agv] {
        doubling(unit);
        unit.publish_my_function_list().unwrap();
    }
    assert!(bench.run_until(|| knows(manager, "agv", "double") && knows(agv, "manager", "double"), SHORT));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "double", 21), Ok(42));
    assert_eq!(ask(&bench, &agv_board, agv, "manager", "double", 4), Ok(8));
    assert_eq!(ask(&bench, &agv_board, agv, "manager", "halve", 4), Err(Error::UnknownFunction));
    let list = manager.peer("agv").unwrap().their_function_list().show_functions().to_string();
    assert_eq!(list, "double(n: int) -> (n: int)\n");
}

thread_local! {
    /// What the flash of a board stores.
    static KEPT: core::cell::Cell<StoredClaim> = const { core::cell::Cell::new(NOTHING) };
}

const NOTHING: StoredClaim = StoredClaim { tagged: TaggedClaim::NONE, key: [0; KEY_FINGERPRINT_BYTES] };

fn store(claim: &StoredClaim) -> bool {
    KEPT.set(*claim);
    true
}

/// A board stores the claim that it obeys before it moves under it, and refuses a lower one in its next life, until that one is
/// raised because nobody answers for the higher one; a manager that hears a higher one steps down.
#[test]
fn a_board_obeys_the_highest_claim_and_fences_lower_ones() {
    let bench = Bench::new(21);
    let claim = |term| Claim { term, claimant: 1 };
    let manager_of = |term| {
        let board = bench.board();
        let config = Config::m_unit("manager", 1, proof(&bench, &manager_identity())).unwrap();
        let unit = start(&board, config.claim(claim(term), |_| true));
        (board, unit)
    };
    let agv_of = || {
        let board = bench.board();
        let agv = start(&board, agv_config(&bench).obeyed_claim(KEPT.get(), store));
        driving(&board, agv);
        agv.publish_my_function_list().unwrap();
        (board, agv)
    };
    let ((first_board, first), (agv_board, agv)) = (manager_of(5), agv_of());
    assert!(bench.run_until(|| knows(first, "agv", "go_to"), LONG));
    assert_eq!(KEPT.get(), NOTHING, "not at joining");
    assert_eq!(ask(&bench, &first_board, first, "agv", "go_to", 1), Ok(1));
    assert_eq!((KEPT.get().tagged.claim, agv.claim()), (claim(5), claim(5)));
    let (second_board, second) = manager_of(6);
    assert!(bench.run_until(|| agv.claim() == claim(6) && second.is_connected(), LONG));
    assert!(!first.is_connected(), "it has stepped down");
    assert!(bench.run_until(|| knows(second, "agv", "go_to"), LONG));
    assert_eq!(KEPT.get().tagged.claim, claim(5), "nothing has moved under it");
    assert_eq!(ask(&bench, &second_board, second, "agv", "go_to", 1), Ok(1));
    assert_eq!(KEPT.get().tagged.claim, claim(6));

    [first_board, second_board, agv_board].iter().for_each(Board::cut_power);
    let ((_, third), (_, agv)) = (manager_of(5), agv_of());
    assert_eq!(agv.claim(), claim(6), "it is stored");
    assert!(!bench.run_until(|| third.is_connected(), Duration::from_secs(2)), "it is refused");
    assert!(bench.run_until(|| third.is_connected(), LONG), "it is raised");
    assert!(third.claim() > claim(6), "{} and {}", third.claim(), agv.claim());
    assert!(bench.run_until(|| agv.claim() == third.claim(), SHORT), "{} and {}", third.claim(), agv.claim());
}

/// The access table of a board.
const DOUBLERS: [Rule; 1] = [Rule::new(Who::node("manager", 1), Functions::Named(&["double"]), Verbs::CALL)];
const OTHERS: [Rule; 1] = [Rule::new(Who::node("manager", 2), Functions::All, Verbs::CALL)];

#[test]
fn a_board_has_a_table_from_the_start_and_gets_another_while_it_runs() {
    let bench = Bench::new(8);
    let (manager_board, manager) = manager(&bench);
    let board = bench.board();
    let config = agv_config(&bench).access(&DOUBLERS);
    let agv = start(&board, config);
    doubling(agv);
    agv.my_function_list()
        .add_service("secret(n: int) -> (n: int)", ServiceOptions::new(), Handler::method(&|_, _, _| Ok(())))
        .unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "double"), SHORT));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "double", 21), Ok(42));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "secret", 1), Err(Error::UnknownFunction));
    agv.set_access(Some(&OTHERS));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "double", 1), Err(Error::NotAllowed));
    assert_eq!(agv.counted(LinkCounter::RequestsForbidden), 1);
    assert!(bench.run_until(|| !knows(manager, "agv", "double"), SHORT));
    agv.set_access(None);
    assert!(bench.run_until(|| knows(manager, "agv", "secret") && knows(manager, "agv", "double"), SHORT));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "secret", 3), Ok(3));
}

/// Drives for as long as its lease is live, at most as many ticks of 20 ms as it was told.
async fn drive(unit: Unit) {
    let mut parameters = Parameters::new();
    while let Ok(call) = unit.next_call("go_to", &mut parameters).await {
        let ticks: i64 = parameters.variable("n").unwrap_or(0);
        let lease = call.lease.expect("it has one");
        let mut driven = 0;
        while driven < ticks && lease.is_live() {
            Timer::after_millis(20).await;
            driven += 1;
        }
        let result = parameters.set_value("n", driven).map_err(|_| ServiceError::BadResults);
        unit.end_order(&lease);
        call.reply(result.map(|()| &*parameters)).await;
    }
}

fn driving(board: &Board, unit: Unit) {
    // Of this board alone: other tests drive theirs by clocks of their own, at the same time.
    let go_to = Box::leak(Box::new(Lease::new()));
    let options = ServiceOptions::new()
        .lease(Duration::from_millis(400), go_to, &|| {})
        .then(&|state: &mut State| state.stops += 1);
    unit.my_function_list().add_service("go_to(n: int) -> (n: int)", options, Handler::task()).unwrap();
    board.spawn(drive(unit));
}

#[test]
fn a_task_takes_calls_and_awaits_before_it_replies() {
    let bench = Bench::new(2);
    let ((manager_board, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    driving(&agv_board, agv);
    doubling(agv);
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "go_to"), SHORT));
    let before = bench.now();
    let driven = Rc::new(RefCell::new(None));
    let (reported, peer) = (Rc::clone(&driven), manager.peer("agv").unwrap());
    manager_board.spawn(async move {
        let mut parameters = number(50);
        let driven = peer.call("go_to", &mut parameters).renewing(Renew::Process).await;
        reported.replace(Some(driven.map_err(Error::from).and_then(|()| parameters.variable("n"))));
    });
    bench.run_for(Duration::from_millis(100));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "double", 1), Ok(2), "other services run meanwhile");
    assert!(driven.borrow().is_none());
    assert!(bench.run_until(|| driven.borrow().is_some(), LONG));
    assert_eq!(*driven.borrow(), Some(Ok(50_i64)));
    assert!(bench.now().since(before) >= Duration::from_secs(1));
    assert_eq!(agv.with_state(|state| state.stops), Ok(0), "what is finished needs no safe hook");
}

thread_local! {
    static MADE_SAFE: Cell<u32> = const { Cell::new(0) };
}

fn made_safe() {
    MADE_SAFE.set(MADE_SAFE.get() + 1);
}

/// When the end of each call was told.
type Ends = Rc<RefCell<Vec<(i64, Instant)>>>;

/// Calls of `haul` in tasks of their own, each of which does no more than await the end of what was started.
fn hauling(board: &Board, unit: Unit, length: Duration) -> (Ends, Rc<RefCell<Vec<LeaseWatch>>>) {
    let lease = Box::leak(Box::new(Lease::new()));
    let options = ServiceOptions::new().lease(length, lease, &made_safe).then(&|state: &mut State| state.stops += 1);
    unit.my_function_list().add_service("haul(n: int)", options, Handler::task()).unwrap();
    let (ended, orders) = (Ends::default(), Rc::new(RefCell::new(Vec::new())));
    let (reported, started, own) = (Rc::clone(&ended), Rc::clone(&orders), board.clone());
    board.spawn(async move {
        let mut parameters = Parameters::new();
        while let Ok(call) = unit.next_call("haul", &mut parameters).await {
            started.borrow_mut().extend(call.lease);
            let (reported, number) = (Rc::clone(&reported), parameters.variable("n").unwrap());
            own.spawn(async move {
                call.lease_ended().await;
                reported.borrow_mut().push((number, cara_embassy::now()));
                call.reply(Ok(&Parameters::new())).await;
            });
        }
    });
    (ended, orders)
}

/// As much as a message needs from board to board, and the 2 ms by which the end of a lease is rounded down.
const AT_ONCE: Duration = Duration::from_millis(20);

#[test]
fn a_hold_that_is_dropped_while_the_machine_is_in_use_is_released_behind_it() {
    let bench = Bench::new(21);
    let ((_manager_board, manager), (board, agv)) = (manager(&bench), agv(&bench));
    let lift = ServiceOptions::new().lease(LONG, Box::leak(Box::new(Lease::new())), &made_safe);
    manager.my_function_list().add_service("lift(n: int)", lift, Handler::method(&|_, _, _| Ok(()))).unwrap();
    doubling(manager);
    manager.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(agv, "manager", "lift"), SHORT));
    let peer = agv.peer("manager").unwrap();
    let held = finish(&bench, &board, async move {
        peer.call("lift", &mut number(1)).renewing(Renew::Process).hold().await.unwrap()
    });
    let (peer, mut parameters) = (agv.peer("manager").unwrap(), number(1));
    let mut asks = peer.call("double", &mut parameters).into_future();
    let waker = dropping(held);
    assert!(Pin::new(&mut asks).poll(&mut Context::from_waker(&waker)).is_pending());
    drop(waker);
    assert!(is_held() && MADE_SAFE.get() == 0, "it is held");
    // The machine has the last waker, and drops it for this one.
    assert!(Pin::new(&mut asks).poll(&mut Context::from_waker(Waker::noop())).is_pending());
    assert!(!is_held());
    assert!(bench.run_until(|| MADE_SAFE.get() == 1, SHORT), "it is released");
}

#[test]
fn a_task_awaits_the_end_of_its_own_call() {
    let bench = Bench::new(15);
    let ((_manager_board, manager), (board, agv)) = (manager(&bench), agv(&bench));
    let length = Duration::from_secs(60);
    let (ended, orders) = hauling(&board, agv, length);
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "haul"), SHORT));
    let peer = manager.peer("agv").unwrap();
    let numbers = || ended.borrow().iter().map(|(number, _)| *number).collect::<Vec<_>>();
    let call = |number_of: i64, renew| {
        let options = RequestOptions { renew, ..RequestOptions::default() };
        peer.call("haul", &mut number(number_of)).with(options).send().unwrap();
        bench.run_for(Duration::from_secs(1));
    };
    let stops = || agv.with_state(|state| state.stops).unwrap();
    call(1, Renew::Process);
    assert_eq!(numbers(), [0; 0]);
    call(2, Renew::Process);
    assert_eq!((numbers(), stops()), (vec![1], 0), "the first was replaced, without the hook");
    peer.release("haul").unwrap();
    bench.run_for(AT_ONCE);
    assert_eq!((numbers(), stops()), (vec![1, 2], 1), "the second was released");
    call(3, Renew::Process);
    let order = |number: usize| orders.borrow()[number - 1];
    assert!(!agv.end_order(&order(2)), "the second has ended");
    bench.run_for(AT_ONCE);
    assert_eq!((numbers(), stops()), (vec![1, 2], 1), "the third goes on");
    assert!(agv.end_order(&order(3)));
    bench.run_for(AT_ONCE);
    assert_eq!((numbers(), stops()), (vec![1, 2, 3], 1), "the third has finished");
    let asked = bench.now();
    call(4, Renew::Never);
    assert!(bench.run_until(|| ended.borrow().len() == 4, Duration::from_secs(90)));
    let took = ended.borrow()[3].1.since(asked);
    assert!(took <= length + AT_ONCE && took + AT_ONCE >= length, "{} ms", took.as_millis());
    assert_eq!(MADE_SAFE.get(), 2);
    call(5, Renew::Process);
    agv.my_function_list().remove("haul").unwrap();
    assert_eq!(MADE_SAFE.get(), 3, "the service of the fifth is gone");
    bench.run_for(AT_ONCE);
    assert_eq!((numbers(), MADE_SAFE.get()), (vec![1, 2, 3, 4, 5], 3));
}

#[test]
fn a_pulled_cable_runs_each_hook_once_and_the_board_comes_back() {
    let bench = Bench::new(3);
    let ((_, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    static STANDING: Lease = Lease::new();
    let options = ServiceOptions::new()
        .lease(Duration::from_millis(400), &STANDING, &|| {})
        .then(&|state: &mut State| state.stops += 1);
    agv.my_function_list().add_service("go(n: int) -> (n: int)", options, Handler::method(&|_, _, _| Ok(()))).unwrap();
    agv.publish_my_function_list().unwrap();
    for round in 1..4 {
        assert!(bench.run_until(|| knows(manager, "agv", "go"), LONG), "round {round}");
        manager.peer("agv").unwrap().call("go", &mut number(round)).renewing(Renew::Process).send().unwrap();
        assert!(bench.run_until(|| STANDING.is_live(cara_embassy::now()), SHORT));
        agv_board.set_cable(false);
        assert!(bench.run_until(|| !STANDING.is_live(cara_embassy::now()), SHORT));
        bench.run_for(LONG);
        assert_eq!(agv.with_state(|state| (state.losses, state.stops)), Ok((round as u32, round as u32)));
        agv_board.set_cable(true);
    }
}

#[test]
fn a_new_address_ends_the_link_and_the_board_is_found_there() {
    let bench = Bench::new(4);
    let ((_, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    assert!(bench.run_until(|| manager.number_of_s_units() == 1 && agv.is_connected(), SHORT));
    agv_board.move_to(Ipv4Addr::new(10, 77, 9, 9));
    let there = || manager.peer("agv").unwrap().address().is_some_and(|at| *at.ip() == Ipv4Addr::new(10, 77, 9, 9));
    assert!(bench.run_until(there, LONG));
    assert_eq!(agv.with_state(|state| state.losses), Ok(1));
}

#[test]
fn what_is_cancelled_makes_room_for_the_next() {
    let bench = Bench::new(5);
    let ((manager_board, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    driving(&agv_board, agv);
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "go_to"), SHORT));
    let peer = manager.peer("agv").unwrap();
    // More calls than may be in flight, each given up.
    finish(&bench, &manager_board, async move {
        for _ in 0..20 {
            let mut parameters = number(1);
            let options = RequestOptions { timeout: Some(LONG), ..RequestOptions::default() };
            let call = peer.call("go_to", &mut parameters).with(options);
            assert!(with_timeout(embassy_time::Duration::from_millis(1), call.into_future()).await.is_err());
            Timer::after_millis(200).await;
        }
    });
    assert_eq!(manager.counted(LinkCounter::RequestsSent), 20);
    assert_eq!(manager.counted(LinkCounter::CallsCancelled), 20, "none waits for its reply any more");
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "go_to", 3), Ok(3));
}

#[test]
fn a_reply_that_is_not_fetched_delays_others_only_until_its_deadline() {
    let bench = Bench::new(6);
    let ((manager_board, manager), (_, agv)) = (manager(&bench), agv(&bench));
    doubling(agv);
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "double"), SHORT));
    let peer = manager.peer("agv").unwrap();
    finish(&bench, &manager_board, async move {
        let mut parameters = number(1);
        let options = RequestOptions { timeout: Some(Duration::from_secs(1)), ..RequestOptions::default() };
        let mut forgotten = Box::pin(peer.call("double", &mut parameters).with(options).into_future());
        // It is sent, and polled again only when its time is over.
        assert!(poll_once(&mut forgotten).await.is_none());
        Timer::after_millis(100).await;
        let mut other = number(5);
        let patient = RequestOptions { timeout: Some(LONG), ..RequestOptions::default() };
        assert_eq!(peer.call("double", &mut other).with(patient).await, Ok(()));
        assert_eq!(other.variable::<i64>("n"), Ok(10));
        assert_eq!(forgotten.await, Err(Error::TimedOut.into()));
    });
}

async fn poll_once<F: Future + Unpin>(future: &mut F) -> Option<F::Output> {
    std::future::poll_fn(|cx| {
        Poll::Ready(match std::pin::Pin::new(&mut *future).poll(cx) {
            Poll::Ready(output) => Some(output),
            Poll::Pending => None,
        })
    })
    .await
}

#[test]
fn events_tell_who_came_and_why_it_left() {
    let bench = Bench::new(7);
    let ((manager_board, manager), (_, agv)) = (manager(&bench), agv(&bench));
    let events = Rc::new(RefCell::new(Vec::new()));
    let recorded = Rc::clone(&events);
    manager_board.spawn(async move {
        loop {
            let event = manager.next_event().await;
            recorded.borrow_mut().push(event);
        }
    });
    assert!(bench.run_until(|| manager.is_connected(), SHORT));
    agv.stop();
    assert!(bench.run_until(|| !manager.is_connected(), SHORT));
    bench.run_for(SHORT);
    let peer = agv.identity();
    let left = UnitEvent::Left { peer: peer.clone(), reason: CloseReason::Stopped };
    let reported = events.borrow();
    assert_eq!((reported.first(), reported.last()), (Some(&UnitEvent::Joined { peer }), Some(&left)));
    assert!(!agv.is_connected(), "it looks for nobody any more");
}

#[test]
fn memory_that_cannot_hold_the_constraints_is_refused() {
    let bench = Bench::new(8);
    let config = Config::m_unit("manager", 1, Security::insecure(1)).unwrap();
    let constraints = Constraints { maximum_nodes: 4, ..Constraints::M_UNIT };
    let memory = Box::leak(Box::new(Manager::new()));
    let refused = cara_embassy::new(bench.board().network(), memory, config.constraints(constraints), State::default());
    let does_not_fit = |constraint, need, have| Error::DoesNotFit { constraint, need, have };
    assert_eq!(refused.err(), Some(does_not_fit(Constraint::MessageSize, 32 * 1024, 1024)));
    let (_, unit) = manager(&bench);
    let follow = LIMITS.constraints();
    assert_eq!((follow.maximum_nodes, follow.message_size, follow.calls_per_peer), (3, 1024, 12));
    assert_eq!(unit.constraints(), follow);
    let too_many = does_not_fit(Constraint::MaximumNodes, 5, 4);
    assert_eq!(unit.set_constraints(Constraints { maximum_nodes: 5, ..follow }), Err(too_many));
    assert_eq!(
        too_many.to_string(),
        "maximum_nodes needs links = 5, and the resources have 4: ask for less, or raise the limit"
    );
    let calls = does_not_fit(Constraint::CallsPerPeer, 9, 8);
    assert_eq!(unit.set_constraints(Constraints { calls_per_peer: 13, ..follow }), Err(calls));
    assert_eq!(unit.set_constraints(Constraints { calls_per_peer: 0, ..follow }), Err(Error::BadConstraint));
    assert_eq!(unit.constraints(), follow, "what is refused changes nothing");
    assert_eq!(unit.set_constraints(Constraints { maximum_nodes: 4, ..follow }), Ok(()));
    let huge = "huge(text: string[9000])";
    let refused = unit.my_function_list().add_service(huge, ServiceOptions::new(), Handler::task());
    assert!(matches!(refused, Err(Error::TooLarge { .. })), "{refused:?}");
    assert_eq!(
        unit.my_function_list().add_service("half(", ServiceOptions::new(), Handler::task()),
        Err(Error::BadName)
    );
}

/// Nothing is said on as many connections as the manager has links for; its node comes all the same.
#[test]
fn silent_connections_give_way_to_nodes() {
    let bench = Bench::new(9);
    let (_, manager) = manager(&bench);
    let unknown = bench.board();
    bench.run_for(Duration::from_millis(10));
    for _ in 0..8 {
        let stack = unknown.stack();
        unknown.spawn(async move {
            let (receive, send) = (Box::leak(Box::new([0; 64])), Box::leak(Box::new([0; 64])));
            let mut socket = TcpSocket::new(stack, receive, send);
            let _ = socket.connect((Ipv4Addr::new(10, 77, 0, 1), SECURED_PORT)).await;
            std::future::pending::<()>().await;
        });
    }
    bench.run_for(Duration::from_millis(10));
    let (_, agv) = agv(&bench);
    assert!(bench.run_until(|| agv.is_connected(), Duration::from_secs(2)));
    assert!(manager.node_counted(NodeCounter::GaveWay) > 0);
}

/// Counts how often a task is polled.
struct Counted<F> {
    task: F,
    polls: Rc<Cell<u32>>,
}

impl<F: Future + Unpin> Future for Counted<F> {
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<F::Output> {
        self.polls.set(self.polls.get() + 1);
        Pin::new(&mut self.task).poll(context)
    }
}

#[test]
fn an_idle_unit_lets_its_controller_sleep() {
    let bench = Bench::new(10);
    let (_, manager) = manager(&bench);
    let board = bench.board();
    let config = agv_config(&bench);
    let memory = Box::leak(Box::new(Manager::new()));
    let (agv, mut runner) = cara_embassy::new(board.network(), memory, config, State::default()).unwrap();
    let polls = Rc::new(Cell::new(0));
    let task = Box::pin(async move { runner.run().await });
    board.spawn(Counted { task, polls: Rc::clone(&polls) });
    assert!(bench.run_until(|| agv.is_connected() && manager.is_connected(), SHORT));
    bench.run_for(SHORT);
    polls.set(0);
    bench.run_for(Duration::from_secs(10));
    // Keep-alives each way, and a look at the address every 3 s.
    assert!(polls.get() <= 50, "{} times in 10 s", polls.get());
    board.set_cable(false);
    assert!(bench.run_until(|| !agv.is_connected(), Duration::from_millis(50)), "the cable goes unnoticed");
    board.set_cable(true);
    assert!(bench.run_until(|| agv.is_connected(), LONG));
    // Another task waits for a change of the network too, and embassy-net wakes one only.
    let (stack, sees) = (board.stack(), Rc::new(Cell::new(0)));
    let task = Box::pin(async move { stack.wait_link_down().await });
    board.spawn(Counted { task, polls: Rc::clone(&sees) });
    bench.run_for(SHORT);
    polls.set(0);
    bench.run_for(Duration::from_secs(10));
    assert!(polls.get() + sees.get() <= 60, "{} and {} times in 10 s", polls.get(), sees.get());
}

#[test]
fn tasks_that_wait_for_calls_let_their_controller_sleep() {
    const TASKS: usize = 6;
    let bench = Bench::new(23);
    let ((manager_board, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    agv.my_function_list().add_service("twice(n: int) -> (n: int)", ServiceOptions::new(), Handler::task()).unwrap();
    let polls = Rc::new(Cell::new(0));
    for _ in 0..TASKS {
        let task = Box::pin(async move {
            let mut parameters = Parameters::new();
            while let Ok(call) = agv.next_call("twice", &mut parameters).await {
                let n = parameters.variable::<i64>("n").map_or(0, |n| n * 2);
                let result = parameters.set_value("n", n).map_err(|_| ServiceError::BadResults);
                call.reply(result.map(|()| &*parameters)).await;
            }
        });
        agv_board.spawn(Counted { task, polls: Rc::clone(&polls) });
    }
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "twice"), SHORT));
    polls.set(0);
    bench.run_for(Duration::from_secs(10));
    // Four are woken when a call comes, and two look each 100 ms.
    assert!(polls.get() <= 250, "{} times in 10 s", polls.get());
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "twice", 4), Ok(8));
}

/// No task of the vehicle runs any more, as when a handler hangs: its motor sees the lease end in time all the same,
/// and what is to be made safe is made so before anything else that waits.
#[test]
fn a_starved_vehicle_stops_by_its_lease_and_is_made_safe_first() {
    let bench = Bench::new(11);
    let ((manager_board, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    static MOVING: Lease = Lease::new();
    let length = Duration::from_millis(400);
    let safe: &'static Hook<State> = &|state| state.done.push("made safe");
    let options = ServiceOptions::new().lease(length, &MOVING, &|| {}).then(safe);
    agv.my_function_list().add_service("go(n: int) -> (n: int)", options, Handler::method(&|_, _, _| Ok(()))).unwrap();
    let recorded = Handler::method(&|state: &mut State, _, _| {
        state.done.push("served");
        Ok(())
    });
    agv.my_function_list().add_service("note(n: int)", ServiceOptions::new(), recorded).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "note"), SHORT));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "go", 1), Ok(1));
    bench.run_for(Duration::from_secs(1));
    let live = || MOVING.is_live(cara_embassy::now());
    assert!(live(), "the manager renews it");
    agv_board.suspend(Duration::from_millis(1_500));
    let starved = bench.now();
    manager.peer("agv").unwrap().request("note", &number(1)).unwrap();
    assert!(bench.run_until(|| !live(), SHORT));
    assert!(bench.now().since(starved) <= length, "the bound is the lease");
    assert_eq!(agv.with_state(|state| state.done.len()), Ok(0), "nothing runs yet");
    assert!(bench.run_until(|| agv.with_state(|state| state.done.len()) == Ok(2), SHORT));
    assert_eq!(agv.with_state(|state| state.done.clone()), Ok(vec!["made safe", "served"]));
}

/// The motor's interrupt falls while the runner is at work on a renewal that it has begun to look at in time.
#[test]
fn what_a_motors_interrupt_has_seen_dead_no_renewal_revives() {
    let bench = Bench::new(14);
    let ((manager_board, manager), (_, agv)) = (manager(&bench), agv(&bench));
    static MOVING: Lease = Lease::new();
    let length = Duration::from_millis(400);
    let options = ServiceOptions::new().lease(length, &MOVING, &|| {}).then(&|state: &mut State| state.stops += 1);
    agv.my_function_list().add_service("go(n: int) -> (n: int)", options, Handler::method(&|_, _, _| Ok(()))).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(bench.run_until(|| knows(manager, "agv", "go"), SHORT));
    for round in 1..4 {
        assert_eq!(ask(&bench, &manager_board, manager, "agv", "go", 1), Ok(1), "a new order moves it");
        bench.run_for(Duration::from_secs(1));
        assert!(MOVING.is_live(bench.now()), "the manager renews it");
        assert!(!MOVING.is_live(bench.now() + length));
        assert!(!bench.run_until(|| MOVING.is_live(bench.now()), SHORT), "renewals go on, and move nothing");
        assert_eq!(agv.with_state(|state| state.stops), Ok(round), "the hook is not left out");
    }
}

/// A live link is rekeyed every second, while both ends call each other and one drives.
#[test]
fn keys_are_made_anew_while_calls_go_on() {
    let bench = Bench::new(15);
    let ((manager_board, manager), (agv_board, agv)) = (manager(&bench), agv(&bench));
    static MOVING: Lease = Lease::new();
    let stop: &'static Hook<State> = &|state| state.stops += 1;
    let options = ServiceOptions::new().lease(Duration::from_millis(400), &MOVING, &|| {}).then(stop);
    agv.my_function_list().add_service("go(n: int) -> (n: int)", options, Handler::method(&|_, _, _| Ok(()))).unwrap();
    for unit in [manager, agv] {
        unit.renew_keys_every(Duration::from_secs(1));
        doubling(unit);
        unit.publish_my_function_list().unwrap();
    }
    assert!(bench.run_until(|| knows(manager, "agv", "double") && knows(agv, "manager", "double"), SHORT));
    assert_eq!(ask(&bench, &manager_board, manager, "agv", "go", 1), Ok(1));
    let answered = Rc::new(Cell::new([0; 2]));
    for (at, board, unit, peer) in [(0, &manager_board, manager, "agv"), (1, &agv_board, agv, "manager")] {
        let (answered, peer) = (Rc::clone(&answered), unit.peer(peer).unwrap());
        board.spawn(async move {
            for n in 0.. {
                let mut parameters = number(n);
                assert_eq!(peer.block_request("double", &mut parameters).await, Ok(()));
                assert_eq!(parameters.variable::<i64>("n"), Ok(2 * n));
                let mut counts = answered.get();
                counts[at] += 1;
                answered.set(counts);
            }
        });
    }
    let renewed = |unit: Unit| unit.counted(LinkCounter::KeysRenewed);
    for age in 1..20 {
        let before = answered.get();
        assert!(bench.run_until(|| renewed(manager) >= age && renewed(agv) >= age, SHORT), "keys number {age}");
        assert!(MOVING.is_live(bench.now()), "the lease is renewed across keys");
        let after = answered.get();
        assert!(before[0] < after[0] && before[1] < after[1], "{before:?} {after:?}");
    }
    assert_eq!(agv.with_state(|state| (state.stops, state.losses)), Ok((0, 0)), "the link is the same");
    let refused = |unit: Unit| unit.counted(LinkCounter::ProofsFailed);
    assert_eq!([refused(manager), refused(agv)], [0, 0]);
}

/// The driver of a W5500 asks for its cable every 500 ms, and frames come before.
#[test]
fn a_link_that_came_before_the_cable_was_noticed_stays() {
    let bench = Bench::new(16);
    let (_, manager) = manager(&bench);
    let (board, agv) = agv(&bench);
    board.notice_cable(false);
    assert!(bench.run_until(|| agv.is_connected() && manager.is_connected(), LONG));
    board.notice_cable(true);
    bench.run_for(SHORT);
    assert_eq!(agv.with_state(|state| state.losses), Ok(0));
    assert!(agv.is_connected());
}

/// Units with an explicit opt-in to plain mode, and units with keys of another fleet: each meets only its like.
#[test]
fn an_insecure_unit_meets_insecure_units_only() {
    let bench = Bench::new(12);
    let (_, manager) = manager(&bench);
    let board = bench.board();
    let agv = start(&board, Config::s_unit("agv", 7, "manager", 1, Security::insecure(7)).unwrap());
    bench.run_for(LONG);
    assert!(!agv.is_connected() && !manager.is_connected());
    let depot = bench.board();
    let other = start(&depot, Config::m_unit("manager", 1, Security::insecure(1)).unwrap());
    assert!(bench.run_until(|| agv.is_connected() && other.is_connected(), LONG));
    assert!(!manager.is_connected());
}

#[test]
fn a_unit_with_keys_of_another_root_is_not_heard() {
    let bench = Bench::new(13);
    let (_, manager) = manager(&bench);
    let board = bench.board();
    let unknown = keys(1, &agv_identity(), 0, 7);
    let agv = start(&board, Config::s_unit("agv", 7, "manager", 1, unknown).unwrap());
    bench.run_for(LONG);
    assert!(!agv.is_connected() && !manager.is_connected());
    // Also where it need not search: the link ends before the node has heard of it.
    let address = SocketAddrV4::new(Ipv4Addr::new(10, 77, 0, 1), SECURED_PORT);
    let unknown = keys(1, &agv_identity(), 0, 8);
    let board = bench.board();
    let config = Config::s_unit("agv", 7, "manager", 1, unknown).unwrap().manager_address(address);
    let agv = start(&board, config);
    bench.run_for(LONG);
    assert!(!agv.is_connected() && !manager.is_connected());
    assert!(manager.counted(LinkCounter::ProofsFailed) > 0, "it dials, and proves nothing");
    let (_, agv) = self::agv(&bench);
    assert!(bench.run_until(|| agv.is_connected() && manager.is_connected(), LONG));
}
