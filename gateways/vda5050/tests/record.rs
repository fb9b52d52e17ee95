//! The gateway killed at each write of its record: right before it, and right behind it.

mod fake;

use std::cell::RefCell;
use std::io;
use std::path::Path;
use std::rc::Rc;
use std::time::Duration;

use cara_vda5050::driver::{Driver, Vehicle};
use cara_vda5050::machine::{Machine, Topic};
use cara_vda5050::record::{Keep, Store};
use cara_vda5050::state::{Command, Failure, Record, Status};
use fake::{Fake, instant, order, policy};

/// A store that is killed at a write.
struct Dying {
    store: Store,
    /// How many writes are left.
    writes: usize,
    /// The last one reaches the disk.
    is_written: bool,
}

impl Keep for Dying {
    fn keep(&mut self, record: &Record) -> io::Result<()> {
        self.writes = self.writes.saturating_sub(1);
        if self.writes > 0 || self.is_written {
            self.store.keep(record)?;
        }
        if self.writes == 0 { Err(io::Error::other("killed")) } else { Ok(()) }
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

/// What is compared: the order's ids, what is left, the states of the actions, what the vehicle did.
type Outcome = (String, u32, usize, String, Vec<(String, u32)>, Vec<String>);

/// Drives two orders with an update; the gateway is killed at one write, starts again, and the master repeats what it has not seen taken.
/// Also whether it was killed at all.
fn run(folder: &Path, mut kill_at: Option<usize>, is_written: bool) -> (Outcome, bool) {
    let mut vehicle = Fake::at("a");
    let sent =
        [order("o1", 0, 0, "a!:beep b! c"), order("o1", 1, 2, "b! c! d!:pick=HARD"), order("o2", 0, 0, "d! b!/beep")];
    let (mut turns, mut was_killed, mut header_ids) = (0, false, Vec::new());
    loop {
        let (store, record) = Store::open(folder, "0001").unwrap();
        let kept = record.clone();
        let machine = Machine::new(record, policy(), Duration::ZERO);
        let limit = kill_at.take().unwrap_or(usize::MAX);
        let mut driver = Driver::new(machine, &mut vehicle, Dying { store, writes: limit, is_written });
        driver.machine.broker(true, Duration::ZERO);
        assert_eq!(*driver.machine.record(), kept);
        let outcome = loop {
            turns += 1;
            assert!(turns < 400);
            if let Err(killed) = step(&mut driver, &sent, turns, &mut header_ids) {
                assert_eq!(killed.to_string(), "killed");
                break None;
            }
            let record = driver.machine.record();
            let is_over = record.order_id == "o2" && !driver.machine.is_busy();
            if is_over {
                let states = record.actions.iter().map(|entry| format!("{:?}", entry.state())).collect::<Vec<_>>();
                break Some((record.order_id.clone(), record.order_update_id, record.nodes.len(), states.join("\n")));
            }
        };
        let Some((order_id, update, left, states)) = outcome else {
            was_killed = true;
            continue;
        };
        assert!(header_ids.windows(2).all(|pair| pair[0] < pair[1]), "{header_ids:?}");
        vehicle.reached.dedup();
        return ((order_id, update, left, states, vehicle.reached, vehicle.began), was_killed);
    }
}

fn step(
    driver: &mut Driver<&mut Fake, Dying>,
    sent: &[cara_vda5050::message::Order],
    turn: usize,
    header_ids: &mut Vec<u32>,
) -> io::Result<()> {
    driver.turn(Duration::from_secs(turn as u64))?;
    // The master sends what the state does not show yet.
    let record = driver.machine.record();
    let (id, update, is_busy) = (record.order_id.clone(), record.order_update_id, driver.machine.is_busy());
    let next = match (id.as_str(), update) {
        ("", _) => Some(&sent[0]),
        ("o1", 0) => Some(&sent[1]),
        ("o1", _) if !is_busy => Some(&sent[2]),
        _ => None,
    };
    if let Some(next) = next {
        driver.machine.order(next.clone());
        driver.keep()?;
    }
    if turn == 3 {
        driver.machine.instant_actions(instant("stateRequest", "i1"));
    }
    let header_id = driver.machine.header_id(Topic::State);
    driver.keep()?;
    header_ids.push(header_id);
    driver.vehicle_mut().step();
    Ok(())
}

#[test]
fn killed_at_each_write_the_gateway_goes_on_with_the_same_ids_and_states() {
    let folder = tempfile::tempdir().unwrap();
    let (undisturbed, _) = run(folder.path(), None, true);
    // Nothing is left, four edges were driven, three actions ran.
    assert_eq!((undisturbed.2, undisturbed.4.len(), undisturbed.5.len()), (0, 4, 3), "{undisturbed:?}");
    for is_written in [true, false] {
        let mut kills = 0;
        for write in 1.. {
            let folder = tempfile::tempdir().unwrap();
            let (outcome, was_killed) = run(folder.path(), Some(write), is_written);
            // An instant action that was not kept is not known; the rest is.
            let orders = |(id, update, left, states, reached, began): &Outcome| {
                let states: Vec<String> =
                    states.lines().filter(|state| !state.contains("i1")).map(str::to_owned).collect();
                (id.clone(), *update, *left, states, reached.clone(), began.clone())
            };
            assert_eq!(orders(&outcome), orders(&undisturbed), "killed at write {write}, {is_written}");
            if !was_killed {
                break;
            }
            kills += 1;
        }
        assert!(kills >= 15, "{kills}");
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

/// What a driver does, as it does it; the vehicle answers or not.
#[derive(Default)]
struct Log {
    done: Rc<RefCell<Vec<&'static str>>>,
    status: Option<Status>,
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
    fn keep(&mut self, _: &Record) -> io::Result<()> {
        self.done.borrow_mut().push("keep");
        Ok(())
    }
}

fn logged() -> (Driver<Log, Log>, Rc<RefCell<Vec<&'static str>>>) {
    let done = Rc::<RefCell<Vec<&'static str>>>::default();
    let log = |status| Log { done: done.clone(), status };
    let machine = Machine::new(Record::default(), policy(), Duration::ZERO);
    let mut driver = Driver::new(machine, log(Some(Fake::at("a").status)), log(None));
    driver.machine.broker(true, Duration::ZERO);
    driver.turn(Duration::ZERO).unwrap();
    driver.machine.order(order("o1", 0, 0, "a! b!"));
    driver.turn(Duration::ZERO).unwrap();
    assert_eq!(done.borrow().last(), Some(&"drive"));
    done.borrow_mut().clear();
    (driver, done)
}

/// Neither the disk nor a question to the vehicle comes before a stop.
#[test]
fn a_stop_is_told_first() {
    for kind in ["startPause", "cancelOrder"] {
        let (mut driver, done) = logged();
        driver.machine.instant_actions(instant(kind, "i1"));
        driver.turn(Duration::from_secs(1)).unwrap();
        assert_eq!(done.borrow()[0], "halt", "{kind}: {:?}", done.borrow());
    }
}

/// Its link lives, and it says nothing.
#[test]
fn a_vehicle_that_is_not_heard_of_counts_as_lost() {
    let (mut driver, _) = logged();
    driver.vehicle_mut().status = None;
    driver.turn(Duration::from_secs(1)).unwrap();
    assert!(!driver.is_silent() && driver.machine.is_linked(), "one question without an answer");
    driver.turn(Duration::from_secs(3)).unwrap();
    assert!(driver.is_silent() && !driver.machine.is_linked());
    driver.vehicle_mut().status = Some(Fake::at("a").status);
    driver.turn(Duration::from_secs(4)).unwrap();
    assert!(!driver.is_silent() && driver.machine.is_linked());
}
