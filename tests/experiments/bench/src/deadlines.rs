//! The share of calls that meet their deadlines while more is asked of a unit than it can do, by earliest deadline, with and
//! without admission, and in the order of arrival: in the simulator, so that each run gives the same figures, and on Linux.

pub(crate) mod linux;

use std::rc::Rc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Result, ensure};
use cara_core::config::{Constraints, Scheduling};
use cara_core::error::ServiceError;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_sim::{Service, UnitHandle, World, boxed_parameters};
use serde::{Serialize, Serializer};

/// Percent of what the unit can do that is asked of it.
pub(crate) const LOADS: [u64; 5] = [50, 80, 100, 120, 150];
/// Calls of a point.
const CALLS: u64 = 4_000;
/// What a call takes, in microseconds: this in the mean, half to one and a half times as long.
const TAKES: u64 = 10_000;
/// Time-outs in milliseconds, one as often as the other.
const TIMEOUTS: [u64; 4] = [50, 100, 200, 400];

/// The share at one load.
#[derive(Serialize)]
pub(crate) struct Share {
    #[serde(serialize_with = "word")]
    pub(crate) scheduling: Scheduling,
    pub(crate) load: u64,
    pub(crate) calls: u64,
    pub(crate) met: f64,
    /// By time-out, the shortest first.
    pub(crate) by_timeout: [f64; TIMEOUTS.len()],
    /// How long runs took, in proportion to what they were to take: with 1.1 the load was a tenth higher than it says.
    pub(crate) run_time: f64,
}

fn word<S: Serializer>(scheduling: &Scheduling, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(scheduling.word())
}

/// Every load in each order; in each order the same calls at the same times.
pub(crate) fn measure() -> Result<Vec<Share>> {
    let each = Scheduling::ALL.into_iter().flat_map(|scheduling| LOADS.map(|load| (scheduling, load)));
    each.map(|(scheduling, load)| share(scheduling, load)).collect()
}

/// A sequence that looks like chance.
struct Draw(u64);

impl Draw {
    /// Below `bound`.
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % bound
    }

    /// Times between arrivals that know nothing of each other.
    fn exponential(&mut self, mean: u64) -> u64 {
        let uniform = (self.below(1_000_000) + 1) as f64 / 1e6;
        (-uniform.ln() * mean as f64) as u64
    }
}

/// A call that is made, with times in microseconds.
struct Call {
    /// Since the first one could be due.
    due: u64,
    takes: u64,
    /// Its time-out.
    which: usize,
}

impl Call {
    /// Those at a load, for ever.
    fn at(load: u64) -> impl Iterator<Item = Self> {
        let (mut draw, mut due) = (Draw(1), 0);
        std::iter::repeat_with(move || {
            due += draw.exponential(TAKES * 100 / load);
            Self { due, takes: TAKES / 2 + draw.below(TAKES), which: draw.below(TIMEOUTS.len() as u64) as usize }
        })
    }

    fn timeout_ms(&self) -> u64 {
        TIMEOUTS[self.which]
    }
}

/// How calls ended, by time-out.
#[derive(Default)]
struct Tally([Ended; TIMEOUTS.len()]);

#[derive(Default)]
struct Ended {
    calls: AtomicU64,
    in_time: AtomicU64,
}

impl Tally {
    fn ended(&self, which: usize, in_time: bool) {
        self.0[which].calls.fetch_add(1, Ordering::Relaxed);
        self.0[which].in_time.fetch_add(in_time.into(), Ordering::Relaxed);
    }

    /// Of so many calls, all of which must have ended.
    fn share(&self, scheduling: Scheduling, load: u64, calls: u64) -> Result<Share> {
        let each =
            self.0.each_ref().map(|ended| [&ended.calls, &ended.in_time].map(|count| count.load(Ordering::Relaxed)));
        let sum = each.iter().fold([0, 0], |sum, [calls, in_time]| [sum[0] + calls, sum[1] + in_time]);
        ensure!(sum[0] == calls, "{} of {calls} calls have ended", sum[0]);
        let of = |[calls, in_time]: [u64; 2]| in_time as f64 / calls.max(1) as f64;
        Ok(Share { scheduling, load, calls, met: of(sum), by_timeout: each.map(of), run_time: 1.0 })
    }
}

/// Two m_units of which one runs one call of the other at a time.
fn pair(scheduling: Scheduling) -> Result<(World, UnitHandle)> {
    let mut world = World::new(1);
    let constraints = Constraints { scheduling, ..Constraints::M_UNIT };
    let main = world.m_unit("main", 2).start();
    let passive = world.m_unit("passive", 1).constraints(constraints).calls_running(1).start();
    let work = Service::future(|call, parameters| async move {
        let takes = parameters.variable::<i64>("takes").map_err(|_| ServiceError::BadResults)?;
        call.unit.sleep(Duration::from_micros(takes as u64)).await;
        Ok(parameters)
    });
    passive.my_function_list().add_service("work(takes: int[1])", work)?;
    passive.publish_my_function_list()?;
    let known = main.clone();
    ensure!(world.run_until(|_| known.knows("passive", "work"), Duration::from_secs(10)), "they did not meet");
    Ok((world, main))
}

fn share(scheduling: Scheduling, load: u64) -> Result<Share> {
    let (mut world, main) = pair(scheduling)?;
    let (start, tally) = (world.now(), Rc::<Tally>::default());
    for call in Call::at(load).take(CALLS as usize) {
        world.run_for((start + Duration::from_micros(call.due)).since(world.now()));
        let (tally, unit) = (tally.clone(), main.clone());
        main.spawn(async move {
            let mut parameters = boxed_parameters(64);
            let set = parameters.add_int("takes", 1).and_then(|()| parameters.set_value("takes", call.takes as i64));
            let timeout = Some(Duration::from_millis(call.timeout_ms()));
            let options = RequestOptions { timeout, ..RequestOptions::default() };
            let called = unit.block_request_with("passive", "work", &mut parameters, options).await;
            tally.ended(call.which, set.is_ok() && called.is_ok());
        });
    }
    world.run_for(Duration::from_secs(1));
    tally.share(scheduling, load, CALLS)
}

/// A table for people.
pub(crate) fn table(shares: &[Share]) -> String {
    let timeouts: String = TIMEOUTS.iter().map(|timeout| format!(" {timeout} ms |")).collect();
    let mut text = format!(
        "| order | load | run time | deadlines met |{timeouts}\n|---|---|---|---|{}\n",
        "---|".repeat(TIMEOUTS.len())
    );
    for Share { scheduling, load, met, by_timeout, run_time, .. } in shares {
        let each: String = by_timeout.iter().map(|share| format!(" {:.1} % |", 100.0 * share)).collect();
        text += &format!("| `{}` | {load} % | {run_time:.2} | {:.1} % |{each}\n", scheduling.word(), 100.0 * met);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_earliest_deadline_first_meets_more_deadlines_than_the_order_of_arrival() {
        for load in [80, 100] {
            let [deadline, fifo, _] = Scheduling::ALL.map(|scheduling| share(scheduling, load).unwrap().met);
            assert!(deadline > fifo + 0.02, "at {load} %: {deadline} by deadline, {fifo} in the order of arrival");
        }
    }

    #[test]
    fn with_admission_more_deadlines_are_met_where_more_is_asked_than_can_be_done() {
        for load in [120, 150] {
            let [deadline, fifo, admission] = Scheduling::ALL.map(|scheduling| share(scheduling, load).unwrap().met);
            assert!(admission > deadline.max(fifo) + 0.02, "at {load} %: {admission}, without {deadline} and {fifo}");
        }
    }
}
