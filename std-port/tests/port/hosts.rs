//! A manager, its standby and their vehicles on a host each, at one switch: `cargo xtask test standby`. What is judged is that two
//! managers are never obeyed by turns; how long it takes is printed.

use std::time::Instant;

use cara_processes::network;
use cara_processes::switch::Switch;
use rustix::process::Signal;

use crate::standby::{Manager, RUNS, Vehicles, show};
use crate::support::fleet;

/// What befalls the manager that commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    Killed,
    Frozen,
    /// Its host loses power.
    Off,
    /// What its host sends is lost, and what it is sent.
    CutOff,
    /// What its host sends is lost.
    Mute,
    /// What its host is sent is lost.
    Deaf,
}

const VEHICLES: usize = 2;

/// The two managers fail by turns, and are back, as standbys, before the other one fails.
fn fails(name: &str, fault: Fault) {
    let name = format!("hosts::{name}");
    if !network::test(&name, &["nft"], true) {
        return;
    }
    let runs = std::env::var(RUNS).ok().and_then(|runs| runs.parse().ok()).unwrap_or(10);
    let (fleet, folder, switch) = (fleet(), tempfile::tempdir().unwrap(), Switch::of(3).unwrap());
    let state = |host: usize| folder.path().join(host.to_string());
    let here = || Ok(Vehicles::start_on(true, fleet, &state(VEHICLES)));
    let vehicles = switch.hosts[VEHICLES].within(here).unwrap();
    let start = |host: usize| Manager::start_on(Some(&switch.hosts[host]), fleet, &state(host));
    let started = Instant::now();
    let mut active = start(0);
    // Of two that start at once both may command for a moment.
    vehicles.obey(active.number(), started);
    let mut standby = start(1);
    let (mut first, mut last) = (Vec::new(), Vec::new());
    for run in 0..runs {
        let host = run % 2;
        let failed = Instant::now();
        match fault {
            Fault::Killed => active.signal(Signal::KILL),
            Fault::Frozen => active.signal(Signal::STOP),
            Fault::Off => {
                switch.cut(host, true, true).unwrap();
                active.signal(Signal::KILL);
            }
            Fault::CutOff => switch.cut(host, true, true).unwrap(),
            Fault::Mute => switch.cut(host, true, false).unwrap(),
            Fault::Deaf => switch.cut(host, false, true).unwrap(),
        }
        let mut took: Vec<_> = vehicles.obey(standby.number(), failed).iter().map(|at| *at - failed).collect();
        took.sort();
        first.push(took[0]);
        last.push(took[took.len() - 1]);
        if matches!(fault, Fault::Off | Fault::CutOff | Fault::Mute | Fault::Deaf) {
            switch.mend().unwrap();
        }
        match fault {
            Fault::Killed | Fault::Off => active = start(host),
            Fault::Frozen => active.signal(Signal::CONT),
            Fault::CutOff | Fault::Mute | Fault::Deaf => {}
        }
        if !matches!(fault, Fault::Killed | Fault::Off) {
            active.says("waits");
        }
        std::mem::swap(&mut active, &mut standby);
        vehicles.obey(active.number(), Instant::now());
    }
    drop((active, standby));
    vehicles.check();
    show(&format!("{fault:?}"), first, last);
}

#[test]
#[ignore = "takes a minute: cargo xtask test standby"]
fn a_manager_is_killed() {
    fails("a_manager_is_killed", Fault::Killed);
}

#[test]
#[ignore = "takes a minute: cargo xtask test standby"]
fn a_manager_is_frozen() {
    fails("a_manager_is_frozen", Fault::Frozen);
}

#[test]
#[ignore = "takes a minute: cargo xtask test standby"]
fn a_managers_host_loses_power() {
    fails("a_managers_host_loses_power", Fault::Off);
}

#[test]
#[ignore = "takes a minute: cargo xtask test standby"]
fn a_managers_host_is_cut_off() {
    fails("a_managers_host_is_cut_off", Fault::CutOff);
}

#[test]
#[ignore = "takes a minute: cargo xtask test standby"]
fn nobody_hears_a_managers_host() {
    fails("nobody_hears_a_managers_host", Fault::Mute);
}

#[test]
#[ignore = "takes a minute: cargo xtask test standby"]
fn a_managers_host_hears_nobody() {
    fails("a_managers_host_hears_nobody", Fault::Deaf);
}
