//! The share of calls that meet their deadlines while more is asked of a unit than it can do, by earliest deadline, with and
//! without admission, and in the order of arrival: in the simulator, so that each run gives the same figures.

use std::cell::Cell;
use std::rc::Rc;

use anyhow::{Result, ensure};
use cara_core::config::{Constraints, Scheduling};
use cara_core::error::ServiceError;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_sim::{Service, UnitHandle, World, boxed_parameters};

/// Percent of what the unit can do that is asked of it.
pub(crate) const LOADS: [u64; 5] = [50, 80, 100, 120, 150];
/// Calls of a point.
const CALLS: u64 = 4_000;
/// What a call takes, in microseconds: this in the mean, half to one and a half times as long.
const TAKES: u64 = 10_000;
/// Time-outs in milliseconds, one as often as the other.
const TIMEOUTS: [u64; 4] = [50, 100, 200, 400];

/// The share at one load.
pub(crate) struct Share {
    pub(crate) scheduling: Scheduling,
    pub(crate) load: u64,
    pub(crate) met: f64,
    /// By time-out, the shortest first.
    pub(crate) by_timeout: [f64; TIMEOUTS.len()],
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
    let (mut draw, mut due) = (Draw(1), world.now());
    let met: Rc<[(Cell<u64>, Cell<u64>); TIMEOUTS.len()]> = Rc::default();
    for _ in 0..CALLS {
        due = due + Duration::from_micros(draw.exponential(TAKES * 100 / load));
        let (takes, which) = (TAKES / 2 + draw.below(TAKES), draw.below(TIMEOUTS.len() as u64) as usize);
        let timeout = Duration::from_millis(TIMEOUTS[which]);
        world.run_for(due.since(world.now()));
        let (met, unit) = (met.clone(), main.clone());
        main.spawn(async move {
            let mut parameters = boxed_parameters(64);
            let set = parameters.add_int("takes", 1).and_then(|()| parameters.set_value("takes", takes as i64));
            let options = RequestOptions { timeout: Some(timeout), ..RequestOptions::default() };
            let called = unit.block_request_with("passive", "work", &mut parameters, options).await;
            let (made, in_time) = &met[which];
            made.set(made.get() + 1);
            in_time.set(in_time.get() + u64::from(set.is_ok() && called.is_ok()));
        });
    }
    world.run_for(Duration::from_secs(1));
    let of = |made: u64, in_time: u64| in_time as f64 / made.max(1) as f64;
    let all = met.iter().fold((0, 0), |sum, (made, in_time)| (sum.0 + made.get(), sum.1 + in_time.get()));
    ensure!(all.0 == CALLS, "{} of {CALLS} calls have ended", all.0);
    let by_timeout = std::array::from_fn(|which| of(met[which].0.get(), met[which].1.get()));
    Ok(Share { scheduling, load, met: of(all.0, all.1), by_timeout })
}

/// A table for people.
pub(crate) fn table(shares: &[Share]) -> String {
    let timeouts: String = TIMEOUTS.iter().map(|timeout| format!(" {timeout} ms |")).collect();
    let mut text =
        format!("| order | load | deadlines met |{timeouts}\n|---|---|---|{}\n", "---|".repeat(TIMEOUTS.len()));
    for Share { scheduling, load, met, by_timeout } in shares {
        let each: String = by_timeout.iter().map(|share| format!(" {:.1} % |", 100.0 * share)).collect();
        text += &format!("| `{}` | {load} % | {:.1} % |{each}\n", scheduling.word(), 100.0 * met);
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
