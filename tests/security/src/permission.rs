//! A peer with its genuine key that calls more than the access table allows: only allowed calls may run.

use anyhow::{Context, Result, ensure};
use cara_core::config::Priority;
use cara_std::access::{AccessTable, Functions, OwnedRule, Rate, Verb, Verbs, Who};
use cara_std::{Duration, Identity, Role};

use crate::event_log::{EventLog, FUNCTIONS};
use crate::links::Extent;
use crate::linux::{Linux, LinuxManager, LinuxVehicles, accept, guarded, named, wait_for};
use crate::speaker::{HANDSHAKE, Speaker};
use crate::tally::{Counters, Report, Row};
use crate::trial::risen;

/// The counter of calls that were given to a handler.
const RUN: &str = "RequestsRun";
/// A slot that no function is in.
const NOWHERE: u16 = 9;

/// Both kinds of unit, under random tables.
pub fn run(report: &mut Report, linux: &Linux, manager: &LinuxManager<'_>, extent: Extent) -> Result<()> {
    let tables = if extent == Extent::Full { 150 } else { 20 };
    let vehicle = manager.next_vehicle();
    let stream = std::net::TcpStream::connect(manager.address())?;
    let caller = linux.claim_of(vehicle);
    let peer = Peer { stream, dials: true, caller: caller.identity.clone(), vehicle };
    let seen = Watched {
        target: "Linux m_unit",
        log: &manager.log,
        set: &|table| manager.system.set_access(table),
        counters: &|| named(manager.system.counters()),
    };
    let row = under_tables(linux, peer, &seen, tables)?;
    manager.system.set_access(None);
    report.add(row);
    let vehicles = LinuxVehicles::new(linux);
    let vehicle = vehicles.next_vehicle();
    let listener = std::net::TcpListener::bind((std::net::Ipv4Addr::LOCALHOST, 0))?;
    let (unit, log) = linux.vehicle(vehicle, Some(listener.local_addr()?))?;
    let stream = accept(&listener)?;
    let peer = Peer { stream, dials: false, caller: linux.claim_of_manager().identity, vehicle };
    let seen = Watched {
        target: "Linux s_unit",
        log: &log,
        set: &|table| unit.set_access(table),
        counters: &|| named(unit.counters()),
    };
    let row = under_tables(linux, peer, &seen, tables)?;
    unit.stop();
    report.add(row);
    Ok(())
}

/// The peer that exceeds its permissions.
struct Peer {
    stream: std::net::TcpStream,
    dials: bool,
    caller: Identity,
    vehicle: u32,
}

/// A unit under tables.
struct Watched<'w> {
    target: &'static str,
    log: &'w EventLog,
    set: &'w dyn Fn(Option<AccessTable>),
    counters: &'w dyn Fn() -> Counters,
}

fn under_tables(linux: &Linux, peer: Peer, unit: &Watched<'_>, tables: usize) -> Result<Row> {
    let claim = if peer.dials { linux.claim_of(peer.vehicle) } else { linux.claim_of_manager() };
    let key = linux.ground.keys(peer.vehicle).genuine;
    let mode = cara_core::config::Mode::Secured;
    let mut speaker = Speaker::new(peer.stream, peer.dials, mode, claim, key)?;
    speaker.converse(HANDSHAKE + 2).context("the genuine peer joins")?;
    speaker.hear_answer(speaker.last_id())?;
    settle();
    unit.log.take_ran();
    let (before, ran) = ((unit.counters)(), unit.log.calls());
    let (mut attempts, mut successes) = (0, 0);
    for _ in 0..tables {
        let rules = random_rules(&peer.caller);
        (unit.set)(guarded(linux.weakness, rules.clone().into()));
        ask_for_everything(&mut speaker)?;
        // What an earlier table let pass has run before the next one is in force: calls of one class may run side by side.
        let given = || (unit.counters)()[RUN] - before[RUN];
        ensure!(wait_for(|| unit.log.calls() - ran == given()), "a call was given to a handler that has not run");
        let forbidden = |function: &&&str| !allows(&rules, &peer.caller, function);
        attempts += 9 * FUNCTIONS.iter().filter(|function| forbidden(function)).count() as u64 + 4;
        successes += unit.log.take_ran().iter().filter(|function| forbidden(function)).count() as u64;
    }
    let noticed = risen(&before, &(unit.counters)());
    let attack = "function called without permission, random tables".to_owned();
    Ok(Row { attack, target: unit.target.to_owned(), attempts, successes, noticed, control: false })
}

fn settle() {
    std::thread::sleep(std::time::Duration::from_millis(5));
}

/// Calls each function in each class, with and without a reply, and in a datagram.
fn ask_for_everything(speaker: &mut Speaker) -> Result<()> {
    for slot in 0..FUNCTIONS.len() as u16 {
        let datagram = speaker.request_in_datagram(slot);
        speaker.say(&datagram)?;
    }
    settle();
    for slot in (0..FUNCTIONS.len() as u16).chain([NOWHERE]) {
        for priority in Priority::ALL {
            // Requests of a class keep their order, so the answer to the second shows that the first is done.
            for waits in [false, true] {
                let request = speaker.request(slot, priority, waits);
                speaker.say_bytes(&request)?;
            }
            speaker.hear_answer(speaker.last_id())?;
        }
    }
    Ok(())
}

fn pick<T: Clone>(from: &[T]) -> T {
    from.get(fastrand::usize(..from.len())).expect("there are some").clone()
}

fn random_rules(caller: &Identity) -> Vec<OwnedRule> {
    let whom = [
        Who::Node { role: Some(caller.role()), name: Some(caller.name().to_owned()), id: Some(caller.id()) },
        Who::Node { role: None, name: Some(caller.name().to_owned()), id: None },
        Who::Node { role: None, name: None, id: Some(caller.id() + 1) },
        Who::M_UNITS,
        Who::S_UNITS,
        Who::Operator,
        Who::ANYBODY,
    ];
    let rates = [None, None, Some(Rate::new(3, Duration::from_secs(1)))];
    let rule = |_| {
        let functions = FUNCTIONS.iter().filter(|_| fastrand::bool()).map(|name| (*name).to_owned());
        OwnedRule {
            who: pick(&whom),
            functions: if fastrand::u8(..8) == 0 { Functions::All } else { Functions::Named(functions.collect()) },
            verbs: pick(&[Verbs::NONE, Verbs::LIST, Verbs::CALL, Verbs::PUBLISH, Verbs::ALL]),
            rate: pick(&rates),
        }
    };
    (0..fastrand::usize(..4)).map(rule).collect()
}

/// The rules of docs/access.md, implemented a second time; the caller is fixed.
fn allows(rules: &[OwnedRule], caller: &Identity, function: &str) -> bool {
    rules.iter().any(|rule| {
        let names = match &rule.functions {
            Functions::All => true,
            Functions::Named(names) => names.iter().any(|name| name == function),
        };
        let means = match &rule.who {
            Who::Operator => false,
            Who::Node { role, name, id } => {
                role.is_none_or(|role: Role| role == caller.role())
                    && name.as_deref().is_none_or(|name| name == caller.name())
                    && id.is_none_or(|id| id == caller.id())
            }
        };
        names && means && rule.verbs.contains(Verb::Call)
    })
}
