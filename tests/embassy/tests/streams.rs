//! Streams between boards: one publishes, the other one reads into memory that it has from the start.

use std::cell::{Cell, RefCell};
use std::pin::pin;
use std::rc::Rc;
use std::task::{Context, Waker};

use cara_core::distribution::identity::Identity;
use cara_core::error::{Error, Limit};
use cara_core::host::connections::LinkCounter;
use cara_core::time::Duration;
use cara_embassy::{
    Config, Handle, Limits, Publisher, StreamCell, Subscription, SubscriptionCell, Variables, resources,
};
use cara_embassy_host::{Bench, Board, dropping, hold, is_held, keys};

const LONG: Duration = Duration::from_secs(30);
const EVERY: Duration = Duration::from_millis(20);
const LIMITS: Limits = Limits { links: 2, message_buffers: 6, ..Limits::S_UNIT };

type Unit = Handle<()>;
type Memory = resources!((), LIMITS);

#[derive(Variables, Clone, Copy, Debug, PartialEq)]
struct Pose {
    position: [f64; 2],
    number: u32,
}

fn start(board: &Board, config: Config) -> Unit {
    let memory = Box::leak(Box::new(Memory::new()));
    let (unit, mut runner) = cara_embassy::new(board.network(), memory, config, ()).unwrap();
    board.spawn(async move { runner.run().await });
    unit
}

fn leaked<V>(value: V) -> &'static V {
    Box::leak(Box::new(value))
}

/// A manager that reads, a vehicle that publishes, and the bench below both.
struct Pair {
    bench: Bench,
    boards: [Board; 2],
    manager: Unit,
    agv: Unit,
    pose: Publisher<Pose, ()>,
}

impl Pair {
    fn met(seed: u64) -> Self {
        let bench = Bench::new(seed);
        let boards = [bench.board(), bench.board()];
        let [manager, agv] = [Identity::m_unit("manager", 1).unwrap(), Identity::s_unit("agv", 7).unwrap()];
        let [for_manager, for_agv] = [&manager, &agv].map(|own| keys(0, own, 0, bench.random(u64::MAX)));
        let manager = start(&boards[0], Config::m_unit("manager", 1, for_manager).unwrap());
        let agv = start(&boards[1], Config::s_unit("agv", 7, "manager", 1, for_agv).unwrap());
        let list = agv.my_function_list();
        let pose = list.add_stream_of::<Pose, _>("pose", EVERY, leaked(StreamCell::<24>::new())).unwrap();
        agv.publish_my_function_list().unwrap();
        let pair = Self { bench, boards, manager, agv, pose };
        assert!(pair.bench.run_until(|| pair.knows("pose"), LONG));
        pair
    }

    fn knows(&self, stream: &str) -> bool {
        self.manager.peer("agv").is_ok_and(|agv| agv.their_function_list().contains(stream))
    }

    fn subscribe<const BYTES: usize>(&self, stream: &str, interval: Duration) -> Subscription<()> {
        let cell = leaked(SubscriptionCell::<BYTES>::new());
        self.manager.peer("agv").unwrap().subscribe(stream, interval, cell).unwrap()
    }

    fn publish(&self, number: u32) {
        self.pose.publish(&Pose { position: [0.5, -2.0], number }).unwrap();
    }

    fn sent(&self) -> u64 {
        self.agv.counted(LinkCounter::SamplesSent)
    }
}

fn newest(subscription: &Subscription<()>) -> Option<(u32, Duration)> {
    let (pose, age) = subscription.newest::<Pose>()?.unwrap();
    assert_eq!(pose.position, [0.5, -2.0]);
    Some((pose.number, age))
}

#[test]
fn a_board_reads_the_newest_value_with_its_age() {
    let pair = Pair::met(1);
    pair.publish(1);
    let made = pair.bench.now();
    pair.bench.run_for(Duration::from_secs(3));
    let pose = pair.subscribe::<64>("pose", Duration::ZERO);
    assert!(newest(&pose).is_none());
    assert!(pair.bench.run_until(|| newest(&pose).is_some(), LONG), "the last value comes at once");
    let is_old_enough = |at_most: Duration| {
        let (age, least) = (newest(&pose).unwrap().1, pair.bench.now().since(made));
        assert!(age >= least && age <= least + at_most, "{age:?} {least:?}");
    };
    is_old_enough(Duration::from_secs(1));
    for number in 2..=9 {
        pair.publish(number);
    }
    assert!(pair.bench.run_until(|| newest(&pose).is_some_and(|(number, _)| number == 9), LONG));
    assert!(pair.sent() <= 3, "those between are passed over: {}", pair.sent());
    // A value stays when its node is gone, and grows older.
    let (made, sent) = (pair.bench.now(), pair.sent());
    pair.boards[1].cut_power();
    pair.bench.run_for(Duration::from_secs(10));
    assert!(newest(&pose).unwrap().1 >= pair.bench.now().since(made));
    assert_eq!(sent, 2);
}

#[test]
fn a_subscription_that_is_dropped_while_the_machine_is_in_use_ends_behind_it() {
    let pair = Pair::met(8);
    let (agv, cell) = (pair.manager.peer("agv").unwrap(), leaked(SubscriptionCell::<64>::new()));
    let pose = agv.subscribe("pose", Duration::ZERO, cell).unwrap();
    pair.bench.run_for(Duration::from_secs(1));
    let mut waits = pin!(pair.manager.wait_until(|_| false));
    let waker = dropping(pose);
    assert!(waits.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    drop(waker);
    assert!(is_held());
    // The machine has the last waker, and drops it for this news.
    pair.agv.publish_my_function_list().unwrap();
    assert!(pair.bench.run_until(|| !is_held(), LONG));
    let _anew = agv.subscribe("pose", Duration::ZERO, cell).expect("the cell is free");
    pair.publish(1);
    assert!(pair.bench.run_until(|| pair.sent() == 1, LONG), "the stream goes on");
}

#[test]
fn a_waker_of_one_subscription_may_end_another_one() {
    let pair = Pair::met(9);
    let [mut first, second] = [(); 2].map(|()| pair.subscribe::<64>("pose", Duration::ZERO));
    let waker = dropping(second);
    let mut waits = Box::pin(first.next());
    assert!(waits.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    drop(waker);
    assert!(is_held());
    // The cell has the last waker, which gives way to this one.
    assert!(waits.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending());
    assert!(!is_held());
    drop(waits);
    pair.publish(1);
    assert!(pair.bench.run_until(|| newest(&first).is_some(), LONG), "the first one goes on");
}

/// Looks at the newest value when it is dropped.
struct Last(Subscription<()>, Rc<Cell<Option<u32>>>);

impl Drop for Last {
    fn drop(&mut self) {
        self.1.set(newest(&self.0).map(|(number, _)| number));
    }
}

#[test]
fn a_task_that_ends_with_its_waker_may_look_at_the_value_that_has_come() {
    let pair = Pair::met(10);
    let seen = Rc::new(Cell::new(None));
    let mut last = Last(pair.subscribe::<64>("pose", Duration::ZERO), seen.clone());
    // The node has answered.
    pair.bench.run_for(Duration::from_secs(1));
    let waker = {
        let mut waits = Box::pin(last.0.next());
        let waker = dropping(());
        assert!(waits.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
        waker
    };
    hold(last);
    drop(waker);
    pair.publish(7);
    assert!(pair.bench.run_until(|| !is_held(), LONG));
    assert_eq!(seen.get(), Some(7));
}

#[test]
fn a_task_waits_for_values_and_for_refusals() {
    let pair = Pair::met(2);
    let [mut pose, mut small, mut none] = [
        pair.subscribe::<64>("pose", Duration::ZERO),
        pair.subscribe::<8>("pose", Duration::ZERO),
        pair.subscribe::<64>("speed", Duration::ZERO),
    ];
    let (numbers, refusals) = (Rc::<RefCell<Vec<u32>>>::default(), Rc::<RefCell<Vec<Error>>>::default());
    let reported = numbers.clone();
    pair.boards[0].spawn(async move {
        while let Ok(()) = pose.next().await {
            reported.borrow_mut().push(newest(&pose).unwrap().0);
        }
    });
    let reported = refusals.clone();
    pair.boards[0].spawn(async move {
        let refused = small.next().await.unwrap_err();
        reported.borrow_mut().push(refused);
        let refused = none.next().await.unwrap_err();
        reported.borrow_mut().push(refused);
    });
    for number in 1..=5 {
        pair.publish(number);
        pair.bench.run_for(Duration::from_millis(50));
    }
    assert_eq!(*numbers.borrow(), [1, 2, 3, 4, 5]);
    assert_eq!(*refusals.borrow(), [Error::Full(Limit::ParametersBytes), Error::UnknownFunction]);
}

#[test]
fn a_subscription_goes_on_behind_a_reconnection_and_ends_when_it_is_dropped() {
    let pair = Pair::met(3);
    let pose = pair.subscribe::<64>("pose", Duration::ZERO);
    pair.publish(1);
    assert!(pair.bench.run_until(|| newest(&pose).is_some(), LONG));
    pair.boards[1].reset_streams();
    pair.bench.run_for(Duration::from_millis(10));
    pair.publish(2);
    assert!(pair.bench.run_until(|| newest(&pose).is_some_and(|(number, _)| number == 2), LONG));
    drop(pose);
    pair.bench.run_for(Duration::from_secs(1));
    let sent = pair.sent();
    pair.publish(3);
    pair.bench.run_for(Duration::from_secs(1));
    assert_eq!(pair.sent(), sent);
}

#[test]
fn subscriptions_share_the_shortest_interval_and_no_cell() {
    let pair = Pair::met(4);
    let peer = pair.manager.peer("agv").unwrap();
    let cells: [&'static SubscriptionCell<64>; 2] = [(); 2].map(|()| leaked(SubscriptionCell::new()));
    let subscribe = |index: usize, millis| peer.subscribe("pose", Duration::from_millis(millis), cells[index]);
    let slow = subscribe(0, 1_000).unwrap();
    assert_eq!(subscribe(0, 50).err(), Some(Error::Full(Limit::Subscriptions)));
    let numbers = Cell::new(0);
    let sent_in_a_second = || {
        let before = pair.sent();
        for _ in 0..50 {
            numbers.set(numbers.get() + 1);
            pair.publish(numbers.get());
            pair.bench.run_for(EVERY);
        }
        pair.sent() - before
    };
    assert!((1..=2).contains(&sent_in_a_second()));
    let quick = subscribe(1, 100).unwrap();
    assert!((9..=12).contains(&sent_in_a_second()));
    assert_eq!(newest(&slow), newest(&quick));
    drop(quick);
    assert!((1..=2).contains(&sent_in_a_second()));
    // The cell is free again.
    drop(slow);
    let again = subscribe(0, 0).unwrap();
    assert!(newest(&again).is_none());
    assert!((45..=52).contains(&sent_in_a_second()), "as often as the node grants");
    assert_eq!(again.latest(|lent, _| lent.len()), Some(2));
}
