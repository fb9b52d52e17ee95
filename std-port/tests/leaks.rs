//! What a stopped unit leaves behind: nothing. In a process of its own, since it counts the whole process.

mod keyed;

use std::hash::{BuildHasher, Hasher, RandomState};
use std::time::{Duration, Instant};

use cara_std::{Interfaces, Parameters, ParametersView, Served, ServiceError};

fn count(folder: &str) -> usize {
    std::fs::read_dir(folder).unwrap().count()
}

fn until(what: impl Fn() -> String, condition: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(20);
    while !condition() {
        assert!(Instant::now() < end, "not in time: {}", what());
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Two units that meet, call each other in both ways, and stop; their handles are dropped, or only that.
fn live_once(stops: bool) {
    let fleet = RandomState::new().build_hasher().finish() as u32;
    let (manager, agv) = keyed::pair(fleet);
    let manager = manager.interfaces(Interfaces::Loopback).build().unwrap();
    let agv = agv.interfaces(Interfaces::Loopback).build().unwrap();
    let mut number = Parameters::new();
    number.add_int("number", 1).unwrap();
    let echo = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    agv.my_function_list().add_function("echo", &number, echo).unwrap();
    agv.publish_my_function_list().unwrap();
    manager.start().unwrap();
    manager.start().expect("one that runs goes on");
    agv.start().unwrap();
    until(|| "they meet".into(), || manager.nodes_offering("echo").len() == 1);
    let peer = manager.s_units().remove(0);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            let (peer, mut number) = (&peer, number.clone());
            scope.spawn(move || (0..5).for_each(|_| peer.block_request("echo", &mut number).unwrap()));
        }
    });
    peer.request("echo", &number).unwrap();
    if stops {
        agv.stop();
        manager.stop();
    }
}

#[test]
fn thirty_lives_leave_no_thread_and_no_descriptor() {
    live_once(true);
    let counts = || (count("/proc/self/task"), count("/proc/self/fd"));
    // What the first life left for good: of the test's own runtime, not of the units.
    until(|| format!("{:?}", counts()), || counts().0 <= 3);
    let before = counts();
    for life in 0..30 {
        live_once(life % 2 == 0);
    }
    until(|| format!("before {before:?}, after {:?}", counts()), || counts() <= before && counts().1 <= before.1);
}
