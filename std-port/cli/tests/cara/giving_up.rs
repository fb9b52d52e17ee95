//! A call whose answer is not waited for any more stops what it started, while the manager goes on.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use cara_std::{Definition, ParametersView, Served, ServiceError, ServiceOptions, Unit};

use crate::support::{PATIENCE, Running, Stage, until};

/// What only its lease's own end would stop goes on beyond all patience.
const LEASE: Duration = PATIENCE.saturating_mul(4);
const WAYS: [&[&str]; 2] = [&["call", "lifter", "lift"], &["call", "lifter", "--hold", "--detached", "lift"]];

/// What a vehicle has done so far.
#[derive(Default)]
struct EventLog {
    began: AtomicU32,
    ended: AtomicU32,
    made_safe: AtomicU32,
}

/// A vehicle whose service moves for as long as it is wanted, and answers then.
struct Lifter {
    unit: Unit,
    log: Arc<EventLog>,
}

impl Lifter {
    fn join(stage: &Stage) -> Self {
        stage.know("lifter", 98);
        let unit = stage.vehicle("lifter", 98).build().unwrap();
        let log = Arc::new(EventLog::default());
        let (moved, stopped) = (log.clone(), log.clone());
        let lift = move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            moved.began.fetch_add(1, Ordering::SeqCst);
            call.lease.as_ref().unwrap().wait_until_ended();
            moved.ended.fetch_add(1, Ordering::SeqCst);
            Ok(())
        };
        let safe = move || {
            stopped.made_safe.fetch_add(1, Ordering::SeqCst);
        };
        let options = ServiceOptions::new().lease(LEASE, safe);
        unit.my_function_list().add_service(&Definition::parse("lift()").unwrap(), options, lift).unwrap();
        unit.publish_my_function_list().unwrap();
        unit.start().unwrap();
        until("the lift is offered", || stage.cara(&["functions", "lifter"]).out.contains("lift()"));
        Self { unit, log }
    }

    /// Its motion has ended, and its safe hook has run, as often as this; it is still its manager's.
    fn has_stopped(&self, times: u32) {
        let count = |counter: &AtomicU32| counter.load(Ordering::SeqCst);
        until("the safe hook runs", || count(&self.log.made_safe) == times);
        until("the motion ends", || count(&self.log.ended) == times);
        assert_eq!(count(&self.log.began), times);
        assert!(self.unit.is_connected(), "the manager has gone, and that is what stopped it");
    }
}

#[test]
fn what_times_out_stops_though_the_manager_goes_on() {
    let stage = Stage::with(&[]);
    let lifter = Lifter::join(&stage);
    for (way, times) in WAYS.into_iter().zip(1..) {
        stage.ends(1, &[way, &["--timeout", "3s"]].concat()).says("TimedOut");
        lifter.has_stopped(times);
    }
}

#[test]
fn what_is_killed_while_it_waits_stops_though_the_manager_goes_on() {
    let stage = Stage::with(&[]);
    let lifter = Lifter::join(&stage);
    for (way, times) in WAYS.into_iter().zip(1..) {
        let mut waiting = Running::start(stage.command(way));
        until("the lift begins", || lifter.log.began.load(Ordering::SeqCst) == times);
        waiting.kill();
        lifter.has_stopped(times);
    }
}
