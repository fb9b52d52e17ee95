//! The gateway killed at each write of its record: right before it, and right behind it.

mod fake;

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Duration;

use cara_vda5050::driver::{Driver, Vehicle};
use cara_vda5050::errors::{Kind, Refusal};
use cara_vda5050::machine::{Machine, Topic};
use cara_vda5050::message::{ActionStatus, OperatingMode, Order};
use cara_vda5050::record::{Keep, RecordLock, Store};
use cara_vda5050::state::{Command, Failure, Record, Status};
use fake::{Fake, Pair, instant, order, policy};

/// A store that is killed at a write.
struct Dying {
    store: Store,
    /// How many writes are left.
    writes: usize,
    /// The last one reaches the disk; else half of it does, beside the file that it was to replace.
    is_written: bool,
    folder: PathBuf,
}

impl Keep for Dying {
    fn start(&mut self, record: &Record) -> io::Result<()> {
        self.writes = self.writes.saturating_sub(1);
        if self.writes > 0 || self.is_written {
            self.store.start(record)?;
            while self.store.ended().transpose()?.is_none() {}
        } else {
            let text = serde_json::to_vec(record)?;
            std::fs::write(self.folder.join("0001.next"), &text[..text.len() / 2])?;
        }
        if self.writes == 0 { Err(io::Error::other("killed")) } else { Ok(()) }
    }

    fn ended(&mut self) -> Option<io::Result<()>> {
        Some(Ok(()))
    }
}

impl Vehicle for &mut Fake {
    fn status(&mut self) -> Result<Option<Status>, Failure> {
        Ok(Some(self.status.clone()))
    }

    fn tell(&mut self, command: &Command) -> Result<(), Failure> {
        self.command(command)
    }
}

/// What is compared: the states of each order's actions at its end, what the vehicle reached and did, and the record at the end.
#[derive(Debug, Default, PartialEq)]
struct Outcome {
    states: BTreeMap<String, Vec<String>>,
    reached: Vec<(String, u32)>,
    began: Vec<String>,
    ids: (String, u32),
    is_cancelled: bool,
    left: usize,
}

/// What a master sends.
enum Sent {
    Order(Order),
    Instant(&'static str, &'static str),
}

/// What the master sends next, by what the state shows: two orders with an update, a pause and an action at once, and an order that is
/// cancelled.
fn next(record: &Record, is_busy: bool) -> Option<Sent> {
    let ended = |id: &str| {
        let entry = record.actions.iter().find(|entry| entry.action.action_id == id);
        entry.map(|entry| entry.status.has_ended())
    };
    Some(match (record.order_id.as_str(), record.order_update_id) {
        ("", _) => Sent::Order(order("o1", 0, 0, "a!:beep b! c")),
        ("o1", 0) => match (ended("p1"), ended("p2")) {
            (None, _) => Sent::Instant("startPause", "p1"),
            (Some(true), None) => Sent::Instant("stopPause", "p2"),
            (Some(true), Some(true)) => Sent::Order(order("o1", 1, 2, "b! c! d!:pick=HARD")),
            _ => return None,
        },
        ("o1", _) if ended("i2").is_none() => Sent::Instant("beep", "i2"),
        ("o1", _) if !is_busy => Sent::Order(order("o2", 0, 0, "d! b!/beep")),
        ("o2", _) if !is_busy => Sent::Order(order("o3", 0, 0, "b! c! d!")),
        ("o3", _) if ended("c1").is_none() => Sent::Instant("cancelOrder", "c1"),
        _ => return None,
    })
}

/// Drives what the master sends; the gateway is killed at one write, starts again, and the master repeats what it has not seen taken.
/// Also whether it was killed at all.
fn run(folder: &Path, mut kill_at: Option<usize>, is_written: bool) -> (Outcome, bool) {
    let mut vehicle = Fake::at("a");
    let (mut turns, mut was_killed, mut header_ids, mut outcome) = (0, false, Vec::new(), Outcome::default());
    loop {
        let (store, record) = Store::open(folder, "0001").unwrap();
        let kept = record.clone();
        let machine = Machine::new(record, policy(), Duration::ZERO);
        let writes = kill_at.take().unwrap_or(usize::MAX);
        let dying = Dying { store, writes, is_written, folder: folder.to_owned() };
        let mut driver = Driver::new(machine, &mut vehicle, dying);
        driver.machine.broker(true, Duration::ZERO);
        assert_eq!(*driver.machine.record(), kept);
        let is_over = loop {
            turns += 1;
            assert!(turns < 400);
            if let Err(killed) = step(&mut driver, turns, &mut header_ids, &mut outcome.states) {
                assert_eq!(killed.to_string(), "killed");
                break false;
            }
            let record = driver.machine.record();
            if record.is_cancelled && !driver.machine.is_busy() {
                break true;
            }
        };
        if !is_over {
            was_killed = true;
            continue;
        }
        let record = driver.machine.record().clone();
        assert!(header_ids.windows(2).all(|pair| pair[0] < pair[1]), "{header_ids:?}");
        vehicle.reached.dedup();
        // How far it gets before it is cancelled depends on when the gateway was killed; what begins at once, too.
        vehicle.reached.truncate(4);
        vehicle.began.sort();
        // An action at once that had not begun before the kill fails: done or not, the state says so, and the rest is the same.
        let of_i2 = |state: &mut String| state.contains("i2");
        let state = outcome.states.get_mut("o1").and_then(|states| states.extract_if(.., of_i2).next()).unwrap();
        let ran = vehicle.began.extract_if(.., |id| id == "i2").count();
        assert_eq!(ran, usize::from(state.contains("Finished")), "{state}");
        assert!(was_killed || ran == 1, "{state}");
        let ids = (record.order_id, record.order_update_id);
        let (is_cancelled, left) = (record.is_cancelled, record.nodes.len());
        let (reached, began) = (vehicle.reached, vehicle.began);
        return (Outcome { reached, began, ids, is_cancelled, left, ..outcome }, was_killed);
    }
}

fn step(
    driver: &mut Driver<&mut Fake, Dying>,
    turn: usize,
    header_ids: &mut Vec<u32>,
    ended: &mut BTreeMap<String, Vec<String>>,
) -> io::Result<()> {
    let now = Duration::from_secs(turn as u64);
    driver.turn(now)?;
    let record = driver.machine.record();
    let of_order = record.actions.iter().filter(|entry| entry.action.action_id != "i1");
    let states = of_order.map(|entry| format!("{:?}", entry.state())).collect();
    ended.insert(record.order_id.clone(), states);
    match next(record, driver.machine.is_busy()) {
        Some(Sent::Order(order)) => driver.machine.order(order),
        Some(Sent::Instant(kind, id)) => driver.machine.instant_actions(instant(kind, id)),
        None => {}
    }
    driver.keep(now)?;
    if turn == 3 {
        // This one is not repeated: if it was not kept, it is not known.
        driver.machine.instant_actions(instant("stateRequest", "i1"));
    }
    let header_id = driver.machine.header_id(Topic::State);
    driver.keep(now)?;
    header_ids.push(header_id);
    driver.vehicle_mut().step();
    Ok(())
}

#[test]
fn killed_at_each_write_the_gateway_goes_on_with_the_same_ids_and_states() {
    let folder = tempfile::tempdir().unwrap();
    let (undisturbed, _) = run(folder.path(), None, true);
    assert!(undisturbed.is_cancelled && undisturbed.left == 0 && undisturbed.reached.len() == 4, "{undisturbed:?}");
    assert_eq!(undisturbed.began, ["o1-a0n-beep", "o1-d6n-pick", "o2-b2e-beep"]);
    for is_written in [true, false] {
        let mut kills = 0;
        for write in 1.. {
            let folder = tempfile::tempdir().unwrap();
            let (outcome, was_killed) = run(folder.path(), Some(write), is_written);
            assert_eq!(outcome, undisturbed, "killed at write {write}, {is_written}");
            if !was_killed {
                break;
            }
            kills += 1;
        }
        assert!(kills >= 25, "{kills}");
        println!("killed at {kills} writes");
    }
}

/// What the vehicle was told after the copy it would not do a second time, so the gateway counts on above it.
#[test]
fn with_a_record_from_a_copy_no_number_is_used_again() {
    let mut vehicle = Fake::at("a");
    (vehicle.status.drive, vehicle.status.action) = (7, 9);
    let copy = Record { number: 3, order_id: "o0".into(), ..Record::default() };
    let mut driver = Driver::new(Machine::new(copy, policy(), Duration::ZERO), &mut vehicle, Store::nowhere());
    driver.machine.broker(true, Duration::ZERO);
    driver.turn(Duration::from_secs(1)).unwrap();
    assert_eq!(driver.machine.record().number, 9);
    driver.machine.order(order("o1", 0, 0, "a! b!"));
    (2..4).for_each(|second| driver.turn(Duration::from_secs(second)).unwrap());
    assert_eq!(driver.machine.record().drive, Some(10));
}

#[test]
fn a_damaged_record_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("0001.json"), "{\"order_id\": \"o").unwrap();
    let error = Store::open(folder.path(), "0001").unwrap_err();
    assert!(error.to_string().contains("is damaged"), "{error}");
}

#[test]
fn one_gateway_speaks_for_a_vehicle() {
    let folder = tempfile::tempdir().unwrap();
    let take = |serial_number| RecordLock::take(folder.path(), serial_number).unwrap();
    let first = take("0001");
    assert!(first.is_some() && take("0001").is_none() && take("0002").is_some());
    drop(first);
    assert!(take("0001").is_some());
}

/// What a driver does, as it does it; the vehicle answers or not.
#[derive(Default)]
struct Log {
    done: Rc<RefCell<Vec<&'static str>>>,
    status: Option<Status>,
    /// How many writes end; those behind them go on until there are more.
    writes: Rc<Cell<usize>>,
}

impl Vehicle for Log {
    fn status(&mut self) -> Result<Option<Status>, Failure> {
        self.done.borrow_mut().push("ask");
        self.status.clone().map(Some).ok_or_else(|| Failure::Lost("time-out".into()))
    }

    fn tell(&mut self, command: &Command) -> Result<(), Failure> {
        self.done.borrow_mut().push(command.word());
        Ok(())
    }
}

impl Keep for Log {
    fn start(&mut self, _: &Record) -> io::Result<()> {
        self.done.borrow_mut().push("keep");
        Ok(())
    }

    fn ended(&mut self) -> Option<io::Result<()>> {
        self.writes.set(self.writes.get().checked_sub(1)?);
        Some(Ok(()))
    }
}

type Done = Rc<RefCell<Vec<&'static str>>>;

/// At node a, without an order; also how many writes end.
fn idle() -> (Driver<Log, Log>, Done, Rc<Cell<usize>>) {
    let (done, writes) = (Done::default(), Rc::new(Cell::new(usize::MAX)));
    let log = |status| Log { done: done.clone(), status, writes: writes.clone() };
    let machine = Machine::new(Record::default(), policy(), Duration::ZERO);
    let mut driver = Driver::new(machine, log(Some(Fake::at("a").status)), log(None));
    driver.machine.broker(true, Duration::ZERO);
    driver.turn(Duration::ZERO).unwrap();
    (driver, done, writes)
}

fn logged() -> (Driver<Log, Log>, Done, Rc<Cell<usize>>) {
    let (mut driver, done, writes) = idle();
    driver.machine.order(order("o1", 0, 0, "a! b!"));
    driver.turn(Duration::ZERO).unwrap();
    assert_eq!(done.borrow().last(), Some(&"drive"));
    done.borrow_mut().clear();
    (driver, done, writes)
}

/// Neither the disk nor a question to the vehicle comes before a stop.
#[test]
fn a_stop_is_told_first() {
    for kind in ["startPause", "cancelOrder"] {
        let (mut driver, done, _) = logged();
        driver.machine.instant_actions(instant(kind, "i1"));
        driver.turn(Duration::from_secs(1)).unwrap();
        assert_eq!(done.borrow()[0], "halt", "{kind}: {:?}", done.borrow());
    }
}

/// A write that does not end: the stop is told, and it is not said. The rest waits.
#[test]
fn a_stop_waits_for_no_write_and_what_moves_does() {
    let (mut driver, done, writes) = logged();
    driver.vehicle_mut().status.as_mut().unwrap().is_ordered = true;
    writes.set(0);
    driver.machine.refuse(&Refusal::new(Kind::Validation, "a change"));
    driver.turn(Duration::from_millis(20)).unwrap();
    assert!(!driver.is_kept() && !driver.is_stuck(Duration::from_millis(900)));
    assert!(driver.is_stuck(Duration::from_millis(1_100)));
    let (begun, told) = (done.borrow().len(), |word| done.borrow().iter().filter(|done| **done == word).count());
    driver.machine.instant_actions(instant("startPause", "p1"));
    driver.turn(Duration::from_millis(40)).unwrap();
    assert_eq!(done.borrow()[begun], "halt");
    driver.machine.instant_actions(instant("stopPause", "p2"));
    driver.turn(Duration::from_millis(60)).unwrap();
    assert!(!driver.is_kept() && told("drive") == 0, "{:?}", done.borrow());
    writes.set(usize::MAX);
    // The write that was under way, then that of what came meanwhile.
    [80, 100].into_iter().for_each(|at| driver.turn(Duration::from_millis(at)).unwrap());
    assert!(driver.is_kept() && !driver.is_stuck(Duration::from_secs(9)) && told("drive") == 1, "{:?}", done.borrow());
}

/// Neither a write that does not end nor one that fails holds up the end of what runs.
#[test]
fn the_end_of_an_action_waits_for_no_write() {
    let (mut driver, done, writes) = idle();
    driver.machine.order(order("o1", 0, 0, "a!:pick=HARD b!"));
    driver.turn(Duration::ZERO).unwrap();
    assert_eq!(done.borrow().last(), Some(&"act"));
    let status = driver.vehicle_mut().status.as_mut().unwrap();
    (status.action, status.action_status) = (1, ActionStatus::Running);
    writes.set(0);
    driver.machine.refuse(&Refusal::new(Kind::Validation, "a change"));
    driver.turn(Duration::from_millis(20)).unwrap();
    assert!(!driver.is_kept());
    done.borrow_mut().clear();
    driver.machine.instant_actions(instant("cancelOrder", "c1"));
    driver.turn(Duration::from_millis(40)).unwrap();
    assert_eq!(done.borrow()[0], "end an action", "{:?}", done.borrow());
}

/// What was decided before a pause or the order's end, and waits for its write, is not told after it.
#[test]
fn what_waits_for_a_write_is_told_only_while_it_is_wanted() {
    for (way, word, kind) in [
        ("a! b!", "drive", "startPause"),
        ("a!:beep b!", "act", "startPause"),
        ("a! b!", "drive", "cancelOrder"),
        ("a!:beep b!", "act", "cancelOrder"),
    ] {
        let (mut driver, done, writes) = idle();
        // The order is written; what follows from it is not.
        writes.set(1);
        driver.machine.order(order("o1", 0, 0, way));
        driver.turn(Duration::from_millis(20)).unwrap();
        driver.machine.instant_actions(instant(kind, "i1"));
        driver.turn(Duration::from_millis(40)).unwrap();
        writes.set(usize::MAX);
        (3..6).for_each(|turn| driver.turn(Duration::from_millis(20 * turn)).unwrap());
        assert!(driver.is_kept() && !done.borrow().contains(&word), "{kind}: {:?}", done.borrow());
        driver.machine.instant_actions(instant("stopPause", "i2"));
        (6..9).for_each(|turn| driver.turn(Duration::from_millis(20 * turn)).unwrap());
        assert_eq!(done.borrow().contains(&word), kind == "startPause", "{kind}: {:?}", done.borrow());
    }
}

/// Its link lives, and it says nothing.
#[test]
fn a_vehicle_that_is_not_heard_of_counts_as_lost() {
    let (mut driver, ..) = logged();
    driver.vehicle_mut().status = None;
    driver.turn(Duration::from_secs(1)).unwrap();
    assert!(!driver.is_silent() && driver.machine.is_linked(), "one question without an answer");
    driver.turn(Duration::from_secs(3)).unwrap();
    assert!(driver.is_silent() && !driver.machine.is_linked());
    driver.vehicle_mut().status = Some(Fake::at("a").status);
    driver.turn(Duration::from_secs(4)).unwrap();
    assert!(!driver.is_silent() && driver.machine.is_linked());
}

#[test]
fn a_vehicle_out_of_service_says_so_and_does_nothing() {
    let mut pair = Pair::new("a");
    pair.machine = Machine::out_of_service("damaged", policy(), pair.now);
    pair.machine.broker(true, pair.now);
    pair.machine.status(pair.vehicle.status.clone());
    pair.machine.order(order("o1", 0, 0, "a! b!"));
    pair.machine.instant_actions(instant("beep", "i1"));
    pair.turns(10);
    assert_eq!((pair.vehicle.reached.len(), pair.vehicle.began.len()), (0, 0));
    let report = pair.machine.report().unwrap();
    assert_eq!(report.operating_mode, OperatingMode::Service);
    let fatal = |error: &&cara_vda5050::message::Error| error.error_level == cara_vda5050::message::ErrorLevel::Fatal;
    assert_eq!(report.errors.iter().find(fatal).unwrap().error_type, "outOfService");
}
