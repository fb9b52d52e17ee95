//! Which waiting call begins next, and which is refused when no more can wait.

use std::vec::Vec;

use super::super::RequestOptions;
use super::pair::Pair;
use super::setup::Setup;
use super::{none, x};
use crate::config::{Constraints, Scheduling};
use crate::error::Error;
use crate::host::connections::LinkCounter;
use crate::services::requests::CallId;
use crate::time::Duration;

/// A vehicle that runs one call at a time and is running one; two more may wait.
fn busy(scheduling: Scheduling) -> Pair {
    let agv = Constraints { calls_per_peer: 3, scheduling, ..Constraints::S_UNIT };
    let mut pair = Pair::with(&Setup { agv, running: 1, ..Setup::default() });
    pair.agv.offer_held("hold()");
    pair.agv.offer("work(x: int[1])", |_| Ok(()));
    pair.agv.offer_leased("drive(x: int[1])", Duration::from_secs(60));
    pair.publish();
    pair.manager.call("hold", &none()).unwrap();
    pair.settle();
    pair
}

fn call(pair: &mut Pair, function: &str, seconds: u64) -> CallId {
    let timeout = Some(Duration::from_secs(seconds));
    let options = RequestOptions { timeout, ..RequestOptions::new() };
    let id = pair.manager.request_with(function, &x(seconds as i64), &options, true).unwrap();
    pair.settle();
    id
}

/// The outcomes of calls of these functions with these time-outs in seconds; two can wait while one runs.
fn outcomes(scheduling: Scheduling, calls: &[(&str, u64)]) -> (Vec<Result<(), Error>>, u64) {
    let mut pair = busy(scheduling);
    let ids: Vec<_> = calls.iter().map(|(function, seconds)| call(&mut pair, function, *seconds)).collect();
    pair.agv.answer_held(Ok(&none()));
    pair.settle();
    let outcomes = ids.iter().map(|id| pair.manager.outcome(*id).unwrap().map(drop)).collect();
    (outcomes, pair.agv.counter(LinkCounter::RequestsDisplaced))
}

#[test]
fn where_no_more_can_wait_the_latest_deadline_is_refused_and_no_call_that_moves() {
    let (deadline, fifo, busy) = (Scheduling::EarliestDeadline, Scheduling::Fifo, Err(Error::Busy));
    let works = [("work", 20), ("work", 30), ("work", 10)];
    assert_eq!(outcomes(deadline, &works), ([Ok(()), busy, Ok(())].into(), 1));
    assert_eq!(outcomes(fifo, &works), ([Ok(()), Ok(()), busy].into(), 0));
    let equal = [("work", 20), ("work", 20), ("work", 20)];
    assert_eq!(outcomes(deadline, &equal), ([Ok(()), Ok(()), busy].into(), 0));
    let moving = [("drive", 30), ("drive", 30), ("work", 10)];
    assert_eq!(outcomes(deadline, &moving).0[2], busy);
}

#[test]
fn calls_that_wait_begin_by_deadline_or_in_their_order() {
    for (scheduling, order) in [(Scheduling::EarliestDeadline, [20, 30]), (Scheduling::Fifo, [30, 20])] {
        let mut pair = busy(scheduling);
        for seconds in [30, 20] {
            call(&mut pair, "work", seconds);
        }
        pair.agv.answer_held(Ok(&none()));
        pair.settle();
        let begun: Vec<_> = pair.agv.started().filter_map(|started| started.x).collect();
        assert_eq!(begun, order);
        let ahead = u64::from(scheduling == Scheduling::EarliestDeadline);
        assert_eq!(pair.agv.counter(LinkCounter::RequestsAhead), ahead);
    }
}
