//! Exclusive leadership with an authority of the test: who may claim, what the loss of the key ends, and what it does not.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cara_std::control::Control;
use cara_std::{
    Actuator, Authority, BuildError, Builder, Claim, CommunicationSystem, Constraints, Definition, Error, Fleet,
    Identity, Key, MUnit, Parameters, ParametersView, Peer, Renew, Served, ServiceError, ServiceOptions, StartError,
    Unit, UnitEvent,
};

use crate::support::{Gate, PATIENCE, counter, fleet, system, unit, until};

/// So long a key lasts, by the authority's clock.
const LASTS: Duration = Duration::from_millis(600);

/// What managers of one identity share.
#[derive(Default)]
struct Shared {
    holder: Option<(usize, u64, Instant)>,
    revision: u64,
    is_down: bool,
    /// It fails so many times more, and then panics so many times.
    fails: usize,
    panics: usize,
    /// An answer comes only when this is open.
    hangs: Option<Arc<Gate>>,
}

/// The authority as one manager sees it.
#[derive(Clone)]
struct Fake {
    number: usize,
    shared: Arc<Mutex<Shared>>,
    asked: Arc<AtomicUsize>,
}

impl Fake {
    fn new() -> Self {
        let shared = Arc::new(Mutex::new(Shared { revision: 100, ..Shared::default() }));
        Self { number: 1, shared, asked: Arc::default() }
    }

    /// The same authority for another manager.
    fn other(&self) -> Self {
        Self { number: self.number + 1, shared: self.shared.clone(), asked: Arc::default() }
    }

    fn set_down(&self, is_down: bool) {
        self.shared.lock().unwrap().is_down = is_down;
    }

    /// Another one has the key, whatever it was.
    fn take_away(&self) {
        let mut shared = self.shared.lock().unwrap();
        shared.revision += 50;
        shared.holder = Some((0, shared.revision, Instant::now() + PATIENCE));
    }

    fn give_free(&self) {
        self.shared.lock().unwrap().holder = None;
    }

    fn holder(&self) -> Option<usize> {
        self.shared.lock().unwrap().holder.map(|(number, ..)| number)
    }

    /// Waits until it was asked so many times more.
    fn was_asked(&self, times: usize) {
        let before = self.asked.load(Ordering::SeqCst);
        until("it was asked", || self.asked.load(Ordering::SeqCst) >= before + times);
    }
}

impl Authority for Fake {
    fn hold(&mut self, _: &Identity, _: Fleet) -> Result<Option<Key>, Box<dyn std::error::Error + Send + Sync>> {
        self.asked.fetch_add(1, Ordering::SeqCst);
        let hangs = self.shared.lock().unwrap().hangs.clone();
        if let Some(gate) = hangs {
            gate.pass();
        }
        let mut shared = self.shared.lock().unwrap();
        if shared.is_down || shared.fails > 0 {
            shared.fails = shared.fails.saturating_sub(1);
            return Err("it is down".into());
        }
        if shared.panics > 0 {
            shared.panics -= 1;
            drop(shared);
            panic!("as an authority with a bug");
        }
        let now = Instant::now();
        let revision = match shared.holder.filter(|(.., until)| now < *until) {
            Some((number, revision, _)) if number == self.number => revision,
            Some(_) => return Ok(None),
            None => {
                shared.revision += 1;
                shared.revision
            }
        };
        shared.holder = Some((self.number, revision, now + LASTS));
        Ok(Some(Key { revision, lasts: LASTS.into() }))
    }

    fn release(&mut self) {
        let mut shared = self.shared.lock().unwrap();
        shared.holder = shared.holder.filter(|(number, ..)| *number != self.number);
    }
}

fn manager(fleet: u32, state: &Path) -> Builder<(), MUnit> {
    system(fleet).control(Control::Off).state_folder(state)
}

/// A vehicle that is driven by `go`.
fn vehicle(fleet: u32, state: &Path) -> (Unit, Actuator) {
    let agv = unit("agv", 7, fleet).state_folder(state).build().unwrap();
    let drive = agv.my_function_list().actuator(|| ()).unwrap();
    let options = ServiceOptions::new().moves(&drive, Duration::from_secs(1));
    let go = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    agv.my_function_list().add_service(&Definition::parse("go()").unwrap(), options, go).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    (agv, drive)
}

/// The manager's vehicle, once it offers what it does.
fn offering(manager: &CommunicationSystem) -> Peer<()> {
    until("the vehicle offers to go", || !manager.nodes_offering("go").is_empty());
    manager.nodes_offering("go").remove(0)
}

fn leading(events: &Receiver<UnitEvent>) -> Claim {
    loop {
        match events.recv_timeout(PATIENCE).unwrap() {
            UnitEvent::Leading { claim } => return claim,
            UnitEvent::NotLeading => panic!("it does not lead"),
            _ => {}
        }
    }
}

fn not_leading(events: &Receiver<UnitEvent>) {
    while events.recv_timeout(PATIENCE).unwrap() != UnitEvent::NotLeading {}
}

fn exclusive(peer: &Peer<()>) -> Result<(), Error> {
    peer.call("go", &mut Parameters::new()).only_while_leading().wait().map_err(Error::from)
}

#[test]
fn the_first_manager_gets_the_key_and_the_second_does_not_start() {
    let (fleet, folder, authority) = (fleet(), tempfile::tempdir().unwrap(), Fake::new());
    let [first, second] = ["first", "second"].map(|name| folder.path().join(name));
    let plain = system(fleet).control(Control::Off).insecure().authority(authority.clone()).build();
    assert!(matches!(plain, Err(BuildError::AuthorityWithoutKeys)), "{plain:?}");

    // Where nobody heard of another one, its revision alone makes the claim higher.
    let other = authority.other();
    let manager = |state: &Path, authority: &Fake| {
        self::manager(fleet, state).beside_another().authority(authority.clone()).build().unwrap()
    };
    let one = manager(&first, &authority);
    let events = one.events();
    one.start().unwrap();
    assert_eq!((one.claim().term, leading(&events)), (102, one.claim()));
    assert_eq!((one.is_leading(), counter(&one.counters(), "Leading")), (true, 1));
    let two = manager(&second, &other);
    let refused = two.start();
    assert!(matches!(&refused, Err(StartError::NoAuthority { why, .. }) if why.contains("another")), "{refused:?}");
    assert_eq!((two.claim(), two.is_leading()), (Claim::NONE, false), "nothing was claimed");

    one.stop();
    assert!(!one.is_leading());
    until("the key is free", || authority.holder().is_none());
    two.start().unwrap();
    assert_eq!(two.claim().term, 103, "above the revision, though it has a folder of its own");
}

#[test]
fn the_loss_of_the_authority_ends_no_link_and_no_order_but_calls_that_are_for_a_leader() {
    let (fleet, folder, authority) = (fleet(), tempfile::tempdir().unwrap(), Fake::new());
    let (agv, drive) = vehicle(fleet, &folder.path().join("agv"));
    let depot = manager(fleet, &folder.path().join("depot")).authority(authority.clone()).build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    let claim = leading(&events);
    let peer = offering(&depot);
    exclusive(&peer).unwrap();
    let order = peer.call("go", &mut Parameters::new()).renewing(Renew::Process).hold().wait().unwrap();
    let lease = drive.watch();
    assert!(lease.is_live());

    authority.set_down(true);
    not_leading(&events);
    assert!(!depot.is_leading());
    assert_eq!(exclusive(&peer), Err(Error::NoAuthority));
    let sent = peer.call("go", &mut Parameters::new()).only_while_leading().send();
    assert_eq!(sent.map_err(Error::from), Err(Error::NoAuthority));
    assert!(lease.is_live() && peer.is_connected(), "the order goes on, and the link");
    assert_eq!(agv.claim(), claim);
    // The key is another one's for a while.
    authority.take_away();
    authority.set_down(false);
    authority.was_asked(2);
    assert_eq!((exclusive(&peer), depot.claim()), (Err(Error::NoAuthority), claim), "no other claim without the key");

    authority.give_free();
    let after = leading(&events);
    assert!(after.term == 153 && after == depot.claim(), "{after} is above the other one's revision");
    until("the vehicle obeys the raised claim", || agv.claim() == after);
    assert!(lease.is_live() && peer.is_connected(), "the same order");
    drop(order);
    until("the order ends with what holds it", || !lease.is_live());
    until("it goes for a leader again", || exclusive(&peer).is_ok());
}

#[test]
fn an_authority_that_fails_or_panics_is_asked_again() {
    let (fleet, folder, authority) = (fleet(), tempfile::tempdir().unwrap(), Fake::new());
    authority.shared.lock().unwrap().fails = 2;
    let depot = manager(fleet, folder.path()).authority(authority.clone()).build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    let claim = leading(&events);
    // Longer than the key lasts.
    authority.shared.lock().unwrap().panics = 4;
    not_leading(&events);
    assert!(leading(&events) > claim, "under a new key");
    depot.stop();
    assert_eq!(authority.holder(), None, "given back by the time that the stop returns");
}

#[test]
fn a_key_is_lost_by_the_clock_of_its_holder_while_the_authority_hangs_and_a_stop_waits_for_nothing() {
    let (fleet, folder, authority) = (fleet(), tempfile::tempdir().unwrap(), Fake::new());
    let depot = manager(fleet, folder.path()).authority(authority.clone()).build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    leading(&events);
    let gate = Arc::new(Gate::default());
    authority.shared.lock().unwrap().hangs = Some(gate.clone());
    until("it hangs", || gate.came() == 1);
    not_leading(&events);
    assert!(!depot.is_leading() && gate.came() == 1, "it did not wait for the answer");
    let stopping = Instant::now();
    depot.stop();
    assert!(stopping.elapsed() < PATIENCE / 2, "the gate is closed");
    gate.open();
    until("it is given back", || authority.holder().is_none());
}

#[test]
fn a_manager_raises_its_claim_above_a_vehicle_only_with_the_key() {
    let (fleet, folder, authority) = (fleet(), tempfile::tempdir().unwrap(), Fake::new());
    let [board, kept, depot] = ["board", "kept", "depot"].map(|name| folder.path().join(name));
    {
        // The vehicle obeys a claim that is above the next manager's first one.
        let rival = Fake::new();
        rival.shared.lock().unwrap().revision = 1000;
        let manager = manager(fleet, &kept).authority(rival).build().unwrap();
        manager.start().unwrap();
        let (agv, _) = vehicle(fleet, &board);
        until("it has moved under it", || exclusive(&offering(&manager)).is_ok());
        assert_eq!(agv.claim().term, 1002);
    }
    let depot = manager(fleet, &depot).authority(authority.clone()).build().unwrap();
    let events = depot.events();
    depot.start().unwrap();
    assert_eq!(leading(&events).term, 102);
    authority.set_down(true);
    not_leading(&events);
    let heard = Instant::now();
    {
        let (agv, _) = vehicle(fleet, &board);
        until("it is fenced", || counter(&depot.counters(), "Fenced") > 0);
        assert_eq!(agv.claim().term, 1002);
        // It is switched off, and cannot say later that nobody hears the other manager.
    }
    authority.was_asked(3);
    assert_eq!(depot.claim().term, 102, "it does not raise its claim");
    // Its next key is above all claims.
    authority.shared.lock().unwrap().revision = 2000;
    authority.set_down(false);
    until("it has raised its claim", || depot.claim().term > 1002);
    assert!(heard.elapsed() >= Duration::from_secs(3), "the key alone is no sign that nobody hears the other manager");
    until("it leads", || depot.is_leading());
    let (agv, _) = vehicle(fleet, &board);
    until("the vehicle obeys it", || agv.claim() == depot.claim());
}

#[test]
fn a_standby_with_an_authority_commands_only_with_the_key() {
    let (fleet, folder, authority) = (fleet(), tempfile::tempdir().unwrap(), Fake::new());
    authority.take_away();
    let quick = Constraints { keep_alive: Duration::from_millis(400).into(), ..Constraints::M_UNIT };
    let standby = manager(fleet, folder.path()).constraints(quick).standby();
    let standby = standby.authority(authority.clone()).build().unwrap();
    let events = standby.events();
    standby.start().unwrap();
    // It asks for the key once nobody has answered.
    authority.was_asked(3);
    assert!(standby.is_standby() && standby.claim() == Claim::NONE);
    authority.give_free();
    let claim = leading(&events);
    assert_eq!((standby.is_standby(), standby.claim(), claim.term), (false, claim, 152));
}
