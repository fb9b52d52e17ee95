//! The manager: the Linux port, within this process and, where it is to be killed, in one of its own.

use std::ffi::OsString;
use std::path::Path;
use std::sync::Mutex;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_apps::mechanic;
use cara_std::control::Control;
use cara_std::{
    Builder, CloseReason, CommunicationSystem, Constraints, Duration as CoreDuration, Error, MUnit, Parameters, Peer,
    Renew, ServiceError, StartError, UnitEvent,
};

use crate::board::{Board, FLEET, LONG, Who};
use crate::keys::Keys;

/// A manager with its events.
pub(crate) struct Manager {
    pub(crate) system: CommunicationSystem,
    events: Mutex<Receiver<UnitEvent>>,
}

impl Manager {
    pub(crate) fn start(keys: &Keys) -> Result<Self> {
        keys.give(Self::builder()?).and_then(Self::of)
    }

    /// As it is, but for its keys.
    pub(crate) fn builder() -> Result<Builder<(), MUnit>> {
        Ok(CommunicationSystem::builder("depot", 1)?.fleet(FLEET).control(Control::Off))
    }

    /// Starts a manager that was given keys.
    pub(crate) fn of(builder: Builder<(), MUnit>) -> Result<Self> {
        let system = builder.build()?;
        let events = Mutex::new(system.events());
        system.start()?;
        Ok(Self { system, events })
    }

    /// Offers `call_mechanic` to all vehicles.
    pub(crate) fn offer_mechanic(&self) -> Result<()> {
        let functions = self.system.my_function_list();
        functions.add_function("call_mechanic", &mechanic::arguments()?, mechanic::call_mechanic)?;
        self.system.publish_my_function_list()?;
        Ok(())
    }

    /// Waits until a vehicle has joined and offers its functions.
    pub(crate) fn meet(&self, who: &Who) -> Result<Peer> {
        self.meet_offering(who, "go_to")
    }

    /// Waits until a board has joined and offers a function.
    pub(crate) fn meet_offering(&self, who: &Who, function: &str) -> Result<Peer> {
        let deadline = Instant::now() + LONG;
        while Instant::now() < deadline {
            let peer = self.system.s_unit(&who.name).ok().filter(Peer::is_connected);
            if let Some(peer) = peer.filter(|peer| peer.their_function_list().contains(function)) {
                return Ok(peer);
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        bail!("{} has not joined", who.name)
    }

    /// Waits for an event that `wanted` accepts; others are passed over.
    pub(crate) fn event(&self, what: &str, wanted: impl Fn(&UnitEvent) -> bool) -> Result<UnitEvent> {
        let events = self.events.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let deadline = Instant::now() + LONG;
        let mut passed = Vec::new();
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let event = events.recv_timeout(left).ok().with_context(|| format!("no {what}, but {passed:?}"))?;
            if wanted(&event) {
                return Ok(event);
            }
            passed.push(event);
        }
    }

    /// What happened until now is no news.
    pub(crate) fn forget_events(&self) {
        let events = self.events.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        events.try_iter().for_each(drop);
    }

    /// Whether such an event has come that nobody has looked at; all of those are passed over.
    pub(crate) fn has_seen(&self, wanted: impl Fn(&UnitEvent) -> bool) -> bool {
        let events = self.events.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        events.try_iter().filter(wanted).count() > 0
    }

    /// Waits until a board has been given up because nothing came from it any more.
    pub(crate) fn missed(&self, who: &Who) -> Result<()> {
        let is = |event: &UnitEvent| matches!(event, UnitEvent::Left { peer, .. } if peer.name() == who.name);
        let event = self.event("loss", is)?;
        let silent = matches!(event, UnitEvent::Left { reason: CloseReason::Silent, .. });
        ensure!(silent, "it was not missed: {event:?}");
        Ok(())
    }

    /// Waits until a board has joined, also again.
    pub(crate) fn joined(&self, who: &Who) -> Result<()> {
        let is = |event: &UnitEvent| matches!(event, UnitEvent::Joined { peer } if peer.name() == who.name);
        self.event("join", is).map(drop)
    }

    /// Waits until a board has left.
    pub(crate) fn left(&self, who: &Who) -> Result<()> {
        let is = |event: &UnitEvent| matches!(event, UnitEvent::Left { peer, .. } if peer.name() == who.name);
        self.event("loss", is).map(drop)
    }
}

/// Where a vehicle says it is.
pub(crate) fn position(peer: &Peer) -> Result<[i64; 2]> {
    let mut parameters = at([0, 0])?;
    patiently(|| peer.block_request("pos_info", &mut parameters))?;
    Ok(parameters.variable("position")?)
}

/// Announces a fault to a board's test image.
pub(crate) fn announce(peer: &Peer) -> Result<()> {
    patiently(|| peer.block_request("fault", &mut fault(0)?))
}

/// Whether a call may have ended so because this machine was too busy for it: no answer in time, or no room, or an order that
/// was over before its handler could begin with it, which says that the service is not ready.
pub(crate) const fn is_of_a_busy_host(error: &Error) -> bool {
    matches!(error, Error::TimedOut | Error::Expired | Error::Busy | Error::Service(ServiceError::NotReady))
}

/// Asks for what may run twice, again where this machine was too busy for an answer in time.
pub(crate) fn patiently(ask: impl FnMut() -> Result<(), Error>) -> Result<()> {
    Ok(outcome(ask)?)
}

/// As [`patiently`]: what it came to in the end.
pub(crate) fn outcome(mut ask: impl FnMut() -> Result<(), Error>) -> Result<(), Error> {
    let deadline = Instant::now() + LONG;
    loop {
        match ask() {
            Err(error) if is_of_a_busy_host(&error) && Instant::now() < deadline => {}
            ended => return ended,
        }
    }
}

/// Lets a vehicle that was stopped drive again. A reset counts from the earliest time at which it can have been asked for, so
/// one right behind the stop is refused.
pub(crate) fn reset(peer: &Peer) -> Result<()> {
    let deadline = Instant::now() + LONG;
    loop {
        match outcome(|| peer.block_request("reset", &mut Parameters::<512>::new())) {
            Err(Error::Inhibited { .. }) if Instant::now() < deadline => {}
            ended => return Ok(ended?),
        }
    }
}

/// Sends a vehicle to a place; `false` if this machine was too busy for that and the lease has ended.
pub(crate) fn sends(peer: &Peer, position: [i64; 2], renew: Renew) -> Result<bool> {
    match peer.call("go_to", &mut at(position)?).renewing(renew).wait() {
        Err(error) if is_of_a_busy_host(&error.error) => {
            // The call may have run all the same, and its lease is not renewed then.
            peer.release("go_to")?;
            Ok(false)
        }
        ended => ended.map(|()| true).map_err(Into::into),
    }
}

/// Sends a vehicle on its way, again where this machine was too busy for that.
pub(crate) fn sets_out(peer: &Peer, position: [i64; 2]) -> Result<()> {
    let deadline = Instant::now() + LONG;
    while !sends(peer, position, Renew::Process)? {
        ensure!(Instant::now() < deadline, "it does not set out");
    }
    Ok(())
}

/// Sends a vehicle to a place with `ask`, until it is there: on a busy machine it may lose its lease on the way, or the call may
/// come too late to begin.
pub(crate) fn drives(board: &Board, position: [i64; 2], mut ask: impl FnMut() -> Result<()>) -> Result<()> {
    let [x, y] = position;
    let deadline = Instant::now() + LONG;
    loop {
        let line = board.line();
        ask()?;
        match board.finds_within(LONG / 4, line, &["arrived at", "stopped at"]) {
            Ok((_, said)) if said.contains(&format!("arrived at {x} {y}")) => return Ok(()),
            ended if Instant::now() >= deadline => {
                return ended.and_then(|(_, said)| bail!("it does not come to {position:?}, but {said}"));
            }
            _ => {}
        }
    }
}

/// Parameters with a position.
pub(crate) fn at(position: [i64; 2]) -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_int("position", 2)?;
    parameters.set_value("position", position)?;
    Ok(parameters)
}

/// Waits until a vehicle is somewhere.
pub(crate) fn arrives(peer: &Peer, target: [i64; 2]) -> Result<()> {
    let deadline = Instant::now() + LONG;
    let mut now_at = position(peer)?;
    while now_at != target {
        ensure!(Instant::now() < deadline, "it should come to {target:?} and is at {now_at:?}");
        std::thread::sleep(Duration::from_millis(50));
        now_at = position(peer)?;
    }
    Ok(())
}

/// A call that announces a fault to a board's test image, or makes it fail.
pub(crate) fn fault(kind: i64) -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_int("kind", 1)?;
    parameters.set_value("kind", kind)?;
    Ok(parameters)
}

/// The arguments with which this program is a manager for itself, which keeps its term in a folder, if it has one.
pub(crate) fn command(keys: &Keys, state: Option<&Path>) -> Vec<OsString> {
    let words = ["--image", "none", "manager"].map(OsString::from);
    words
        .into_iter()
        .chain(keys.manager_file().into_iter().flat_map(|file| ["--key-file".into(), file.into()]))
        .chain(state.into_iter().flat_map(|folder| ["--state".into(), folder.into()]))
        .collect()
}

/// A manager for itself, until it is killed, fenced, or its standard input ends: it sends the vehicle of its fleet on a long way,
/// and announces its end when it is told to.
pub(crate) fn stand_alone(key_file: Option<&Path>, state: Option<&Path>) -> Result<()> {
    let builder = Manager::builder()?;
    let builder = match state {
        // A vehicle misses it soon where it is frozen.
        Some(folder) => {
            builder.state_folder(folder).constraints(Constraints { keep_alive: MISSED_SOON, ..Constraints::M_UNIT })
        }
        None => builder,
    };
    let manager = Manager::of(match key_file {
        Some(file) => builder.key_file(file),
        None => builder.insecure(),
    })?;
    let events = manager.system.events();
    std::thread::spawn(move || {
        if events.iter().any(|event| matches!(event, UnitEvent::Fenced { .. })) {
            std::process::exit(StartError::FENCED_EXIT.into());
        }
    });
    let agv = manager.meet(&Who::agv(17))?;
    sets_out(&agv, [1_000, 0])?;
    println!("driving");
    for line in std::io::stdin().lines() {
        match line?.as_str() {
            ANNOUNCE => {
                announce(&agv)?;
                println!("announced");
            }
            INSIST => {
                insists(&manager);
                break;
            }
            _ => {}
        }
    }
    Ok(())
}

/// Whatever becomes of its calls, the manager wants the vehicle to drive, until it does.
fn insists(manager: &Manager) {
    let drives = |agv: &Peer| sends(agv, [1_000, 0], Renew::Process).is_ok_and(|drives| drives);
    while !manager.system.s_unit(&Who::agv(17).name).is_ok_and(|agv| drives(&agv)) {
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Between two signs of life of a manager that is to be missed soon.
const MISSED_SOON: CoreDuration = CoreDuration::from_millis(250);
/// Tells a manager for itself to announce its end.
pub(crate) const ANNOUNCE: &str = "announce";
/// Tells it to drive, whatever comes.
pub(crate) const INSIST: &str = "insist";
