//! `cara call --hold`: the operator keeps the lease, and gives it up by going away.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_processes::ticker::unless_held_up;
use cara_std::{
    Definition, Error, LeaseWatch, Parameters, ParametersView, Renew, RequestOptions, Served, ServiceError,
    ServiceOptions, Unit,
};

use crate::support::{PATIENCE, Running, Stage};

const LEASE: Duration = Duration::from_millis(2_400);

/// A vehicle that drives until it is told that it has arrived, or until its lease ends.
struct Driver {
    unit: Unit,
    lease: LeaseWatch,
    /// That of the last call.
    order: Arc<Mutex<Option<LeaseWatch>>>,
    made_safe: Arc<AtomicU32>,
}

impl Driver {
    fn join(stage: &Stage) -> Self {
        stage.know("driver", 99);
        let unit = stage.vehicle("driver", 99).build().unwrap();
        let order = Arc::<Mutex<Option<LeaseWatch>>>::default();
        let newest = order.clone();
        let drive = move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            newest.lock().unwrap().clone_from(&call.lease);
            Ok(())
        };
        let look = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let made_safe = Arc::new(AtomicU32::new(0));
        let counted = made_safe.clone();
        let safe = move || {
            counted.fetch_add(1, Ordering::SeqCst);
        };
        let options = ServiceOptions::new().lease(LEASE, safe);
        let functions = unit.my_function_list();
        let lease = functions.add_service(&Definition::parse("drive()").unwrap(), options, drive).unwrap();
        let carry = |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            call.lease.as_ref().unwrap().wait_until_ended();
            // As a program that was killed.
            Err(ServiceError::Failed(137))
        };
        let short = ServiceOptions::new().lease(LEASE, || {});
        functions.add_service(&Definition::parse("carry()").unwrap(), short, carry).unwrap();
        functions.add_service(&Definition::parse("look()").unwrap(), ServiceOptions::new(), look).unwrap();
        unit.publish_my_function_list().unwrap();
        unit.start().unwrap();
        until(|| stage.cara(&["functions", "driver"]).out.contains("drive()"));
        Self { unit, lease, order, made_safe }
    }

    /// `cara call driver --hold drive`, when the vehicle has driven for some lengths of its lease.
    fn held(&self, stage: &Stage) -> Running {
        let mut running = Running::start(stage.command(&["call", "driver", "--hold", "drive"]));
        running.expect("drive()");
        let start = Instant::now();
        while start.elapsed() < 2 * LEASE {
            assert!(self.lease.is_live(), "the lease was not renewed");
            std::thread::sleep(Duration::from_millis(10));
        }
        running
    }

    fn made_safe(&self) -> u32 {
        self.made_safe.load(Ordering::SeqCst)
    }
}

/// Runs a test in which the lease of a vehicle is renewed in time.
fn while_renewed(test: impl Fn(&Stage, &Driver)) {
    unless_held_up(LEASE, || {
        let stage = Stage::with(&[]);
        test(&stage, &Driver::join(&stage));
    });
}

fn until(mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "it does not happen");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn what_is_held_goes_on_until_it_has_finished() {
    while_renewed(|stage, driver| {
        let mut held = driver.held(stage);
        let order = driver.order.lock().unwrap().clone().unwrap();
        assert!(driver.unit.end_order(&order));
        held.expect("finished");
        assert_eq!(held.end(), 0);
        assert_eq!(driver.made_safe(), 0, "what has finished needs no safe hook");
    });
}

#[test]
fn who_goes_away_stops_what_is_held() {
    while_renewed(|stage, driver| {
        let held = driver.held(stage);
        held.interrupt();
        until(|| driver.made_safe() == 1);
        assert!(!driver.lease.is_live());
        held.end();
    });
}

/// A stopped process keeps its connection open, and nothing but the missing signs of life tells the manager.
#[test]
fn what_is_held_stops_when_its_command_is_stopped_by_a_signal() {
    while_renewed(|stage, driver| {
        let held = driver.held(stage);
        held.freeze();
        until(|| driver.made_safe() == 1);
        assert!(!driver.lease.is_live());
        held.thaw();
        assert_eq!(held.end(), 1, "it goes on as one that has lost what it held");
        assert_eq!(driver.made_safe(), 1);
    });
}

/// The manager has events all the time, and still detects at once that the lease is no longer held.
#[test]
fn who_goes_away_is_noticed_among_many_events() {
    while_renewed(|stage, driver| {
        let held = driver.held(stage);
        // It ends with this test, also where that fails.
        let (unit, busy) = (driver.unit.clone(), Arc::new(()));
        let wanted = Arc::downgrade(&busy);
        let events = std::thread::spawn(move || {
            let functions = unit.my_function_list();
            let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
            while wanted.strong_count() > 0 {
                functions.add_service(&Definition::parse("news()").unwrap(), ServiceOptions::new(), nothing).unwrap();
                unit.publish_my_function_list().unwrap();
                std::thread::sleep(Duration::from_millis(5));
                functions.remove("news").unwrap();
            }
        });
        held.interrupt();
        until(|| driver.made_safe() == 1);
        drop(busy);
        events.join().unwrap();
        held.end();
    });
}

#[test]
fn a_lost_vehicle_ends_the_holding() {
    while_renewed(|stage, driver| {
        let mut held = driver.held(stage);
        driver.unit.stop();
        held.expect("it stopped there");
        assert_eq!(held.end(), 1);
    });
}

#[test]
fn without_a_lease_there_is_nothing_to_hold() {
    let stage = Stage::with(&[]);
    let _driver = Driver::join(&stage);
    stage.ends(2, &["call", "driver", "--hold", "--detached", "look"]).says("has no lease");
    stage.ends(2, &["call", "driver", "--hold", "--async", "drive"]);
    stage.ends(2, &["call", "driver", "--detached", "drive"]).says("--hold");
}

#[test]
fn a_call_that_its_own_lease_has_ended_says_so() {
    let stage = Stage::with(&[]);
    let _driver = Driver::join(&stage);
    let ended = stage.ends(1, &["call", "driver", "carry"]);
    ended.says("the lease of `carry` (2.4").says("ended before it had finished").says("--hold").says("code 137");
}

#[test]
fn a_newer_holding_takes_over() {
    while_renewed(|stage, driver| {
        let (older, newer) = (driver.held(stage), driver.held(stage));
        assert_eq!(older.end(), 1);
        assert!(driver.lease.is_live());
        newer.interrupt();
        until(|| driver.made_safe() == 1);
        newer.end();
    });
}

#[test]
fn what_the_program_of_a_manager_moves_is_held_unless_it_is_taken_over() {
    unless_held_up(LEASE, || {
        let stage = Stage::empty();
        let manager = stage.manager().build().unwrap();
        manager.start().unwrap();
        let driver = Driver::join(&stage);
        let peer = manager.s_unit("driver").unwrap();
        let wanted = RequestOptions::renewing(Renew::Process);
        let program = || peer.call("drive", &mut Parameters::new()).with(wanted).wait();
        assert_eq!(program(), Ok(()));
        stage.ends(1, &["call", "driver", "drive"]).says("driver/99: Held: ").says("is held by unit 1:");
        stage.ends(1, &["call", "driver", "--hold", "--detached", "drive"]).says("is held by unit 1:");
        assert_eq!(stage.ends(1, &["call", "driver", "drive", "--json"]).json()["error"]["error"], "Held");
        assert_eq!(driver.made_safe(), 0);
        let mut held = Running::start(stage.command(&["call", "driver", "--hold", "--take-over", "drive"]));
        held.expect("drive()");
        assert_eq!(program(), Err(Error::Held { by: 1, operator: true }.into()));
        assert!(driver.lease.is_live());
        held.interrupt();
        until(|| driver.made_safe() == 1);
        held.end();
        until(|| program() == Ok(()));
    });
}

#[test]
fn ctrl_c_ends_it_also_where_the_shell_ignores_it() {
    let stage = Stage::with(&[]);
    let driver = Driver::join(&stage);
    let cara = stage.command(&["call", "driver", "--hold", "drive"]);
    let mut shell = std::process::Command::new("sh");
    shell.args(["-c", "trap '' INT; exec \"$@\"", "sh"]).arg(cara.get_program()).args(cara.get_args());
    shell.env("CARA_CONTROL_DIR", stage.control());
    let mut held = Running::start(shell);
    held.expect("drive()");
    held.interrupt();
    assert_eq!(held.end(), 130);
    until(|| driver.made_safe() == 1);
}

#[test]
fn what_is_held_ends_with_standard_input() {
    while_renewed(|stage, driver| {
        let mut held = driver.held(stage);
        held.type_in("anything\n");
        std::thread::sleep(LEASE);
        assert!(driver.lease.is_live(), "what is typed ends nothing");
        held.type_no_more();
        until(|| driver.made_safe() == 1);
        assert_eq!(held.end(), 1);
        // Nothing begins where it has ended before.
        stage.ends(2, &["call", "driver", "--hold", "drive"]).says("--detached");
        let mut command = stage.command(&["call", "driver", "--hold", "drive"]);
        let a_file = std::fs::File::open(env!("CARGO_BIN_EXE_cara")).unwrap();
        assert_eq!(command.stdin(a_file).output().unwrap().status.code(), Some(2));
        assert_eq!(driver.made_safe(), 1);
    });
}

#[test]
fn what_is_held_ends_when_what_reads_its_output_has_gone() {
    while_renewed(|stage, driver| {
        let mut held = driver.held(stage);
        held.read_no_more();
        until(|| driver.made_safe() == 1);
        assert_eq!(held.end(), 1);
    });
}

/// A terminal that hangs up without a signal, as where a shell has ended before or ignores it.
#[test]
fn what_is_held_ends_when_its_terminal_hangs_up() {
    while_renewed(|stage, driver| {
        let (ours, theirs) = crate::terminal::pair();
        let mut command = stage.command(&["call", "driver", "--hold", "drive"]);
        let end = || std::process::Stdio::from(theirs.try_clone().unwrap());
        let mut held = command.stdin(end()).stdout(end()).stderr(end()).spawn().unwrap();
        drop((command, theirs));
        until(|| driver.lease.is_live());
        std::thread::sleep(LEASE);
        assert!(driver.lease.is_live());
        drop(ours);
        until(|| driver.made_safe() == 1);
        assert_eq!(held.wait().unwrap().code(), Some(1));
    });
}

#[test]
fn what_is_held_detached_goes_on_until_its_command_ends() {
    while_renewed(|stage, driver| {
        let mut held = Running::start(stage.command(&["call", "driver", "--hold", "--detached", "drive"]));
        held.expect("drive()");
        held.type_no_more();
        held.read_no_more();
        let start = Instant::now();
        while start.elapsed() < 2 * LEASE {
            assert!(driver.lease.is_live(), "it has ended");
            std::thread::sleep(Duration::from_millis(10));
        }
        assert_eq!(driver.made_safe(), 0);
        held.kill();
        until(|| driver.made_safe() == 1);
    });
}
