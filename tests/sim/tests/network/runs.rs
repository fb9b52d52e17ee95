//! Whole runs: the same seed gives the same one, plans inject every fault, and a second costs little.

use super::*;
use cara_sim::{FaultCounts, FaultPlan};

/// Four hosts: three dial the fourth again and again, write 200 bytes every 20 ms and broadcast every second.
fn run(seed: u64, plan: Option<FaultPlan>, span: Duration) -> (u64, FaultCounts, usize) {
    let mut network = Network::new(seed);
    network.set_calm(Path::LAN.jitter(Duration::from_micros(300)));
    let hosts: Vec<_> = (0..4).map(|_| network.add_host()).collect();
    let manager = hosts[3];
    network.listen(manager, PORT);
    if let Some(plan) = plan {
        plan.schedule(&mut network, &hosts);
    }
    let mut streams = [None; 4];
    for host in &hosts[..3] {
        network.set_timer(*host, Instant::START, 0);
    }
    let mut events = 0;
    while let Some(event) = network.next_event_until(Instant::START + span) {
        events += 1;
        match event {
            NetEvent::Timer { host, token } => {
                let again = network.now() + millis(20);
                network.set_timer(host, again, token + 1);
                if token % 50 == 0 {
                    network.broadcast(host, b"who has");
                }
                match streams[host.index()] {
                    None => {
                        let to = at_port(&network, manager, PORT);
                        streams[host.index()] = Some(network.connect(host, to));
                    }
                    Some(stream) => drop(network.write(stream, &[&[7; 200]])),
                }
            }
            NetEvent::Readable { stream, .. } => drop(read_all(&mut network, stream)),
            NetEvent::Closed { host, stream } => {
                network.close(stream);
                streams[host.index()] = None;
            }
            NetEvent::Reset { host, .. } | NetEvent::Refused { host, .. } => streams[host.index()] = None,
            NetEvent::Restarted { host } if host == manager => network.listen(manager, PORT),
            NetEvent::Restarted { host } => {
                streams[host.index()] = None;
                let now = network.now();
                network.set_timer(host, now, 0);
            }
            _ => (),
        }
    }
    (network.trace_hash(), *network.counts(), events)
}

#[test]
fn the_same_seed_replays_the_run_and_another_seed_does_not() {
    let harsh = |seed| run(seed, Some(FaultPlan::harsh(seed)), Duration::from_secs(10));
    assert_eq!(harsh(42), harsh(42));
    assert_ne!(harsh(42).0, harsh(43).0);
}

#[test]
fn a_hundred_harsh_runs_inject_every_fault() {
    let mut sum = FaultCounts::default();
    for seed in 0..100 {
        let plan = FaultPlan::harsh(seed);
        let end = plan.ends_after();
        sum += run(seed, Some(plan), end).1;
    }
    assert_eq!(sum.missing().collect::<Vec<_>>(), [], "{sum}");
}

#[test]
fn a_calm_run_injects_nothing_but_jitter() {
    let (_, counts, _) = run(1, None, Duration::from_secs(2));
    assert!(counts.iter().all(|(name, count)| count == 0 || name == "jitter"), "{counts}");
}

/// Prints the cost; the bound is loose, since machines differ and are busy.
#[test]
fn a_virtual_second_of_four_hosts_costs_little() {
    let start = std::time::Instant::now();
    let (mut events, mut seconds) = (0, 0);
    for seed in 0..20 {
        events += run(seed, Some(FaultPlan::mild(seed)), Duration::from_secs(10)).2;
        seconds += 10;
    }
    let each = start.elapsed() / seconds;
    println!("{each:?} per virtual second, {} events in each", events / seconds as usize);
    assert!(each < std::time::Duration::from_millis(20), "{each:?}");
}
