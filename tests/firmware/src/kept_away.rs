//! How long a board takes to join from power on, while discovery that was recorded or forged is broadcast beside it.

use std::net::Ipv4Addr;
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cara_security::kept_away::{Attack, median_and_worst};
use cara_std::keys::KeyRing;
use cara_std::sys::datagram::Datagrams;
use cara_std::{Fleet, Interfaces, SECURED_PORT};
use clap::Args;

use crate::board::{Bench, Cable, FLEET, Who};
use crate::manager::Manager;

/// Where the manager is for boards that do not search.
const FIXED: &str = "10.77.0.1:7711";
const PORT: u16 = 7711;
/// Where attackers listen.
const ATTACKER: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 1);

/// Attacks boards that start.
#[derive(Args)]
pub(crate) struct KeptAway {
    /// Boards that start for each attack.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..))]
    starts: u32,
    /// Datagrams a second.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..))]
    a_second: u64,
}

/// Measures and prints. A board that does not join at all fails.
pub(crate) fn run(bench: &Bench, options: &KeptAway) -> Result<()> {
    let ring = KeyRing::load(&bench.keys.manager_file().context("boards without keys believe everything")?)?;
    let socket = Datagrams::open(Interfaces::All, SECURED_PORT)?;
    let cable = bench.cable()?;
    let attacks = [
        Attack::earlier_lives(&socket, ATTACKER, || {
            let manager = Manager::start(&bench.keys)?;
            Ok(Box::new(move || manager.system.stop()))
        })?,
        {
            let _other = bench.board(&cable, &Who::agv(18))?;
            Attack::another_vehicle(&socket)?
        },
        Attack::forged(&ring, Fleet(FLEET), ATTACKER)?,
    ];
    let manager = Manager::of(bench.keys.give(Manager::builder()?.tcp_port(PORT))?)?;
    for (manager_address, finds) in [(None, "searches"), (Some(FIXED), "has an address")] {
        let who = Who { manager_address, ..Who::agv(17) };
        let start = || joins(bench, &cable, &manager, &who);
        print(finds, "calm", (0..options.starts).map(|_| start()))?;
        for attack in &attacks {
            let sent = AtomicU64::new(0);
            let beside = |_| attack.beside(&socket, options.a_second, &sent, start);
            print(finds, attack.name, (0..options.starts).map(beside))?;
            ensure!(sent.into_inner() > 0, "nothing was said");
        }
    }
    Ok(())
}

fn print(finds: &str, beside: &str, starts: impl Iterator<Item = Result<u128>>) -> Result<()> {
    let mut took = starts.collect::<Result<Vec<_>>>()?;
    let (median, worst) = median_and_worst(&mut took);
    println!("board that {finds}, {beside}: {} joined, ms from power on: {median} / {worst}", took.len());
    Ok(())
}

/// Milliseconds from power on until the manager has it. To the manager it comes back from a loss of power.
fn joins(bench: &Bench, cable: &Cable, manager: &Manager, who: &Who) -> Result<u128> {
    manager.forget_events();
    let since = Instant::now();
    let board = bench.board(cable, who)?;
    manager.joined(who)?;
    let took = since.elapsed().as_millis();
    board.cut_power()?;
    Ok(took)
}
