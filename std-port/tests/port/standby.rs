//! Two managers of one identity in processes of their own, each with a folder of state: one commands, the other stands by.
//!
//! The child is this test binary again, with [`as_child`] as its only test. It ends when its standard input does.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_processes::network::Namespace;
use cara_std::control::{Client, Control};
use cara_std::{
    BuildError, Claim, Constraints, Definition, Interfaces, ParametersView, Served, ServiceError, ServiceOptions,
    StartError, Unit, UnitEvent,
};
use rustix::process::{Pid, Signal, kill_process};

use crate::support::{PATIENCE, counter, fleet, number, system, system_by_default, unit, until, value, within};

const PART: &str = "CARA_TEST_STANDBY";
/// How often the manager that commands is killed; a measurement sets more.
pub(crate) const RUNS: &str = "CARA_TEST_RUNS";
/// Between two commands to a vehicle, and between two looks.
const PAUSE: Duration = Duration::from_millis(20);

/// A vehicle has executed a command of this process, under this claim.
type Obeyed = (Instant, i64, Claim);

/// A manager that stands by, and commands every vehicle all the time once it may.
pub(crate) struct Manager {
    child: Child,
    lines: Receiver<String>,
}

impl Manager {
    fn start(fleet: u32, state: &Path) -> Self {
        Self::start_on(None, fleet, state)
    }

    /// On a host of its own, or here on loopback.
    pub(crate) fn start_on(host: Option<&Namespace>, fleet: u32, state: &Path) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "standby::as_child", "--ignored", "--test-threads=1", "--nocapture"]);
        command.env(PART, format!("{fleet} {} {}", host.is_some(), state.display()));
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = match host {
            Some(host) => host.within(|| Ok(command.spawn()?)).unwrap(),
            None => command.spawn().unwrap(),
        };
        let (output, (say, lines)) = (BufReader::new(child.stdout.take().unwrap()), channel());
        std::thread::spawn(move || output.lines().map_while(Result::ok).try_for_each(|line| say.send(line)));
        let manager = Self { child, lines };
        manager.says("waits");
        manager
    }

    pub(crate) fn number(&self) -> i64 {
        i64::from(self.child.id())
    }

    /// Waits until it says so.
    pub(crate) fn says(&self, what: &str) {
        let end = Instant::now() + PATIENCE;
        // The first one stands behind the test's name.
        while !self.lines.recv_timeout(end.saturating_duration_since(Instant::now())).unwrap().ends_with(what) {}
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub(crate) fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
#[ignore = "run by the other tests here, in processes of their own"]
fn as_child() {
    let part = std::env::var(PART).expect("the part to play");
    let [fleet, is_on_host, state] = part.splitn(3, ' ').collect::<Vec<_>>().try_into().unwrap();
    let manager = system_by_default("manager", 1, fleet.parse().unwrap()).interfaces(interfaces(is_on_host == "true"));
    let manager = manager.control(Control::Off).standby().state_folder(state).build().unwrap();
    let events = manager.events();
    manager.start().unwrap();
    let commanding = manager.clone();
    std::thread::spawn(move || {
        let mut own = number(i64::from(std::process::id()));
        loop {
            for vehicle in commanding.nodes_offering("drive") {
                let _ = vehicle.call("drive", &mut own).send();
            }
            std::thread::sleep(PAUSE);
        }
    });
    std::thread::spawn(move || {
        for event in events {
            match event {
                UnitEvent::StandsBy { .. } => println!("waits"),
                UnitEvent::TookCommand { .. } => println!("commands"),
                _ => {}
            }
        }
    });
    // It is killed, or its parent has ended.
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
    std::process::exit(0);
}

fn interfaces(is_on_host: bool) -> Interfaces {
    if is_on_host { Interfaces::All } else { Interfaces::Loopback }
}

/// Vehicles, and what each has executed.
pub(crate) struct Vehicles {
    fleet: u32,
    units: Vec<Unit>,
    obeyed: Vec<Arc<Mutex<Vec<Obeyed>>>>,
}

impl Vehicles {
    fn start(fleet: u32, state: &Path) -> Self {
        Self::start_on(false, fleet, state)
    }

    /// On the host of this thread, or here on loopback.
    pub(crate) fn start_on(is_host: bool, fleet: u32, state: &Path) -> Self {
        let mut vehicles = Self { fleet, units: Vec::new(), obeyed: Vec::new() };
        for (name, id) in [("agv-7", 7), ("agv-8", 8), ("agv-9", 9)] {
            let unit = unit(name, id, fleet).interfaces(interfaces(is_host)).state_folder(state).build().unwrap();
            let obeyed = Arc::<Mutex<Vec<Obeyed>>>::default();
            let (noted, claimed) = (obeyed.clone(), unit.downgrade());
            let drive = move |_: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
                let claim = claimed.upgrade().ok_or(ServiceError::NotReady)?.claim();
                noted.lock().unwrap().push((Instant::now(), value(view), claim));
                Ok(())
            };
            let options = ServiceOptions::new().lease(Duration::from_secs(1), || ());
            unit.my_function_list()
                .add_service(&Definition::parse("drive(number: int)").unwrap(), options, drive)
                .unwrap();
            unit.publish_my_function_list().unwrap();
            unit.start().unwrap();
            vehicles.units.push(unit);
            vehicles.obeyed.push(obeyed);
        }
        vehicles
    }

    /// When each has first obeyed a manager since then, once all have.
    pub(crate) fn obey(&self, manager: i64, since: Instant) -> Vec<Instant> {
        let first = |obeyed: &Arc<Mutex<Vec<Obeyed>>>| {
            let obeyed = obeyed.lock().unwrap();
            obeyed.iter().find(|(at, by, _)| *at >= since && *by == manager).map(|(at, ..)| *at)
        };
        let all = || self.obeyed.iter().map(first).collect::<Option<Vec<_>>>();
        if !within(PATIENCE, || all().is_some()) {
            let last: Vec<_> = self.obeyed.iter().map(|obeyed| obeyed.lock().unwrap().last().copied()).collect();
            panic!("not in time: all vehicles obey {manager} since {since:?}. What each obeyed last: {last:?}");
        }
        all().unwrap()
    }

    /// Two managers were never obeyed by turns, by whichever vehicles: claims never decrease, and each claim is of one process.
    pub(crate) fn check(&self) {
        let mut obeyed: Vec<_> = self.obeyed.iter().flat_map(|obeyed| obeyed.lock().unwrap().clone()).collect();
        obeyed.sort_by_key(|(at, ..)| *at);
        for pair in obeyed.windows(2) {
            let ((_, by, claim), (_, then, after)) = (pair[0], pair[1]);
            assert!(claim <= after && (claim == after) == (by == then), "{claim} of {by}, then {after} of {then}");
        }
    }
}

/// One that commands, and one that stands by. Of two that start at once both may command for a moment, so the second starts later.
fn led(vehicles: &Vehicles, state: impl Fn(&str) -> PathBuf) -> (Manager, Manager) {
    let start = Instant::now();
    let active = Manager::start(vehicles.fleet, &state("0"));
    vehicles.obey(active.number(), start);
    (active, Manager::start(vehicles.fleet, &state("1")))
}

#[test]
fn a_standby_commands_when_the_manager_is_killed() {
    let runs = std::env::var(RUNS).ok().and_then(|runs| runs.parse().ok()).unwrap_or(2);
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let state = |name: &str| folder.path().join(name);
    let vehicles = Vehicles::start(fleet, &state("vehicles"));
    let (mut active, mut standby) = led(&vehicles, state);
    let (mut first, mut last) = (Vec::new(), Vec::new());
    for run in 0..runs {
        let killed = Instant::now();
        active.kill();
        let mut took: Vec<_> = vehicles.obey(standby.number(), killed).iter().map(|at| *at - killed).collect();
        took.sort();
        first.push(took[0]);
        last.push(took[took.len() - 1]);
        // Each has a folder of its own for all of its lives.
        active = standby;
        standby = Manager::start(fleet, &state(&(run % 2).to_string()));
    }
    drop((active, standby));
    vehicles.check();
    show("killed", first, last);
}

/// Of all runs, when the first vehicle obeyed, and the last.
pub(crate) fn show(fault: &str, first: Vec<Duration>, last: Vec<Duration>) {
    for (what, mut took) in [("first", first), ("last", last)] {
        took.sort();
        let [median, worst] = [took.len() / 2, took.len() - 1].map(|index| took[index]);
        println!("{fault}: the {what} vehicle obeys, of {} runs: median {median:.2?}, worst {worst:.2?}", took.len());
    }
}

#[test]
fn a_frozen_manager_stands_by_when_it_goes_on_and_commands_again_in_its_turn() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let state = |name: &str| folder.path().join(name);
    let vehicles = Vehicles::start(fleet, &state("vehicles"));
    let (active, standby) = led(&vehicles, state);
    let frozen = Instant::now();
    active.signal(Signal::STOP);
    vehicles.obey(standby.number(), frozen);
    let thawed = Instant::now();
    active.signal(Signal::CONT);
    active.says("waits");
    vehicles.obey(standby.number(), Instant::now());
    let fenced = |(at, by, _): &Obeyed| *at >= thawed && *by == active.number();
    assert!(!vehicles.obeyed.iter().any(|obeyed| obeyed.lock().unwrap().iter().any(fenced)), "it is not obeyed");
    let killed = Instant::now();
    standby.kill();
    vehicles.obey(active.number(), killed);
    drop(active);
    vehicles.check();
    assert!(vehicles.units.iter().all(|unit| unit.claim().term >= 3));
}

#[test]
fn a_standby_needs_keys_and_starts_beside_a_manager() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let plain = system(fleet).control(Control::Off).insecure().standby().build();
    assert!(matches!(plain, Err(BuildError::StandbyWithoutKeys)), "{plain:?}");
    let socket = folder.path().join("sockets/manager");
    let build = |name: &str| {
        system_by_default("manager", 1, fleet)
            .control(Control::Path(socket.clone()))
            .state_folder(folder.path().join(name))
    };
    let manager = build("manager").build().unwrap();
    manager.start().unwrap();
    let standby = build("standby").standby().build().unwrap();
    let events = standby.events();
    standby.start().unwrap();
    assert!(matches!(events.recv_timeout(PATIENCE), Ok(UnitEvent::StandsBy { by: None })));
    assert!(standby.is_standby() && standby.claim() == Claim::NONE);
    assert_eq!(standby.constraints(), Constraints::STANDBY);
    // Another manager is refused by the one that runs, and not by a standby.
    let refused = build("another").build().unwrap().start();
    assert!(matches!(refused, Err(StartError::AlreadyRunning { .. })), "{refused:?}");
    until("it has heard the manager", || counter(&standby.counters(), "AnnounceHeard") > 0);
    let claim = manager.claim();
    manager.stop();
    until("it commands", || !standby.is_standby());
    assert!(standby.claim() > claim, "it has heard that one's claim");
    until("it has the control socket of this host", || Client::connect(&socket).is_ok());
}
