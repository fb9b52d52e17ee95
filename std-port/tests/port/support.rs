//! Units on loopback, in a fleet of their own.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cara_std::{
    Builder, CommunicationSystem, Error, Identity, Interfaces, MUnit, Parameters, ParametersView, Peer, Renew,
    RequestOptions, SUnit, Served, ServiceError, Unit,
};

use crate::keyed::{M_UNIT, S_UNIT, keyed};

/// Longest wait for anything that is to happen.
pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// A fleet of its own, so that tests on one machine do not meet.
pub(crate) fn fleet() -> u32 {
    RandomState::new().build_hasher().finish() as u32
}

/// Waits until `condition` holds.
pub(crate) fn until(what: &str, condition: impl FnMut() -> bool) {
    assert!(within(PATIENCE, condition), "not in time: {what}");
}

/// Whether `condition` comes to hold within `span`.
pub(crate) fn within(span: Duration, mut condition: impl FnMut() -> bool) -> bool {
    let end = Instant::now() + span;
    while !condition() {
        if Instant::now() >= end {
            return false;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    true
}

/// The manager of a fleet, to be given a state or built.
pub(crate) fn system(fleet: u32) -> Builder<(), MUnit> {
    system_named("manager", 1, fleet)
}

pub(crate) fn system_named(name: &str, id: u32, fleet: u32) -> Builder<(), MUnit> {
    system_by_default(name, id, fleet).constraints(M_UNIT)
}

/// With the limits that it has by itself, which are others for a standby.
pub(crate) fn system_by_default(name: &str, id: u32, fleet: u32) -> Builder<(), MUnit> {
    let builder = CommunicationSystem::builder(name, id).unwrap().interfaces(Interfaces::Loopback);
    let others = [m_units(), s_units()].concat();
    keyed(builder, fleet, &Identity::m_unit(name, id).unwrap(), &others)
}

/// An s_unit of that manager.
pub(crate) fn unit(name: &str, id: u32, fleet: u32) -> Builder<(), SUnit> {
    unit_of(("manager", 1), name, id, fleet)
}

/// An s_unit of another manager. It has a key for `manager/1` as well, and so has that for it.
pub(crate) fn unit_of(manager: (&str, u32), name: &str, id: u32, fleet: u32) -> Builder<(), SUnit> {
    let own = Identity::s_unit(name, id).unwrap();
    assert!(s_units().contains(&own), "the managers have no key for {own}: name it in s_units");
    let builder = Unit::builder(name, id, manager.0, manager.1).unwrap().interfaces(Interfaces::Loopback);
    let manager = Identity::m_unit(manager.0, manager.1).unwrap();
    keyed(builder, fleet, &own, &[m_units(), vec![manager]].concat()).constraints(S_UNIT)
}

/// All m_units of these tests.
fn m_units() -> Vec<Identity> {
    [("manager", 1), ("one", 1), ("two", 2)].map(|(name, id)| Identity::m_unit(name, id).unwrap()).to_vec()
}

/// All s_units of these tests.
fn s_units() -> Vec<Identity> {
    let single = [
        ("agv", 7),
        ("first", 1),
        ("second", 2),
        ("stranger", 1),
        ("right", 3),
        ("never", 1),
        ("astray", 2),
        ("quick", 1),
        ("frozen", 2),
        ("bystander", 2),
        ("stranger", 9),
    ];
    let single = single.into_iter().map(|(name, id)| (name.to_owned(), id));
    let many =
        (0..64).flat_map(|id| [(format!("agv{id}"), id), (format!("agv-{id}"), id), (format!("agv-{id}"), 10 + id)]);
    single.chain(many).map(|(name, id)| Identity::s_unit(&name, id).unwrap()).collect()
}

/// A manager and an s_unit `agv`, not started.
pub(crate) fn pair() -> (CommunicationSystem, Unit) {
    let fleet = fleet();
    (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap())
}

/// Starts both, publishes both lists and waits until they have met. Returns each one's view of the other.
pub(crate) fn meet<T: Send + 'static, U: Send + 'static>(
    manager: &CommunicationSystem<T>,
    agv: &Unit<U>,
) -> (Peer<T>, Peer<U>) {
    publish(manager, agv);
    manager.start().unwrap();
    agv.start().unwrap();
    let peer = manager.node(&agv.identity()).expect("the manager has a key for it");
    until("the two have met", || peer.is_connected() && agv.is_connected());
    let back = agv.manager().unwrap();
    until("lists have come", || {
        peer.their_function_list().len() == agv.my_function_list().len()
            && back.their_function_list().len() == manager.my_function_list().len()
    });
    (peer, back)
}

/// Takes those off the manager's roster that a test has not started: all of them have keys.
pub(crate) fn retire_absent<T: Send + 'static>(manager: &CommunicationSystem<T>) {
    manager.roster().iter().filter(|peer| !peer.is_connected()).for_each(|absent| assert!(absent.retire()));
}

pub(crate) fn publish<T: Send + 'static, U: Send + 'static>(manager: &CommunicationSystem<T>, agv: &Unit<U>) {
    manager.publish_my_function_list().unwrap();
    agv.publish_my_function_list().unwrap();
}

/// One int.
pub(crate) fn number(value: i64) -> Parameters {
    let mut number = Parameters::new();
    number.add_int("number", 1).unwrap();
    number.set_value("number", value).unwrap();
    number
}

pub(crate) fn value(parameters: &ParametersView) -> i64 {
    parameters.variable("number").unwrap()
}

/// A service in place, free.
pub(crate) fn service(
    act: impl Fn(i64) -> i64 + Send + Sync + 'static,
) -> impl Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static {
    move |_, view| {
        let number = act(value(view));
        view.set_value("number", number).map_err(|_| ServiceError::BadResults)
    }
}

/// Calls `function` with a number. A call that hangs ends after longer than a thread may wait for its turn on a busy machine.
pub(crate) fn ask<T: Send + 'static>(peer: &Peer<T>, function: &str, number_in: i64) -> Result<i64, Error> {
    let mut parameters = number(number_in);
    let patient = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::default() };
    peer.call(function, &mut parameters).with(patient).wait().map(|()| value(&parameters)).map_err(Error::from)
}

/// Calls a function that moves something by a number. `false` where it is not safe yet, or where the call comes when its lease
/// would be over, as on a busy machine.
pub(crate) fn has_begun<T: Send + 'static>(peer: &Peer<T>, function: &str, renew: Renew) -> bool {
    let wanted = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::renewing(renew) };
    let asked = peer.call(function, &mut number(1)).with(wanted).wait().map_err(Error::from);
    assert!(matches!(asked, Ok(()) | Err(Error::Expired | Error::Busy)), "{asked:?}");
    asked.is_ok()
}

/// A counter of the peer's link, or of a unit's discovery.
pub(crate) fn counter(counters: &[(&'static str, u64)], name: &str) -> u64 {
    let found = counters.iter().find(|(known, _)| *known == name);
    found.unwrap_or_else(|| panic!("no counter {name} in {counters:?}")).1
}

/// A gate that handlers wait at.
#[derive(Default)]
pub(crate) struct Gate {
    open: std::sync::Mutex<bool>,
    changed: std::sync::Condvar,
    waiting: std::sync::atomic::AtomicUsize,
}

impl Gate {
    /// Waits until the gate is opened.
    pub(crate) fn pass(&self) {
        self.waiting.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
        let open = self.open.lock().unwrap();
        let (open, _) = self.changed.wait_timeout_while(open, PATIENCE, |open| !*open).unwrap();
        assert!(*open, "nobody opened the gate");
    }

    pub(crate) fn open(&self) {
        *self.open.lock().unwrap() = true;
        self.changed.notify_all();
    }

    /// How many have come to the gate so far.
    pub(crate) fn came(&self) -> usize {
        self.waiting.load(std::sync::atomic::Ordering::SeqCst)
    }
}

/// A service in place, free, that waits at the gate.
pub(crate) fn held(
    gate: &Arc<Gate>,
) -> impl Fn(&Served, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync + 'static {
    let gate = gate.clone();
    service(move |number| {
        gate.pass();
        number
    })
}
