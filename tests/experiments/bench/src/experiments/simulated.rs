//! The link's experiments in the simulator: the same core, rates, sizes and periods in virtual time, distribution 1 only, as
//! a simulated path is between two hosts. No service prints, and headers of the network cost nothing there.

use std::cell::Cell;
use std::rc::Rc;

use anyhow::{Result, anyhow, ensure};
use cara_bench_ends::{Burst, Delivery, Offered, Outcome, Pin, text};
use cara_core::config::Constraints;
use cara_core::time::Duration;
use cara_sim::{BoxedParameters, Path, Service, UnitHandle, World, boxed_parameters};

use super::plan::Plan;
use crate::pair::Delivered;
use crate::results::{LinkAvailability, Mode, OnLink, Response, Results, measured, micros, ratio};
use crate::statistics::{Cell as Calls, Turn};

/// Its name in the rows.
pub(crate) const SIMULATED: &str = "simulated";
/// Calls of each size: without chance on the way, all take as long.
const CALLS: u32 = 5;
/// Bytes of a simulated host's buffers.
const BUFFER: usize = 128 * 1_024;

/// All rates; nothing where links lose packets, of which these know nothing.
pub(super) fn measure(plan: &Plan, results: &mut Results) -> Result<()> {
    if plan.link.loss_percent > 0 {
        return Ok(());
    }
    for group in plan.link.response.iter().filter(|group| group.setting.distribution == 1) {
        let mbit = group.setting.mbit();
        for order in &group.orders {
            let row = response(mbit, order.chars, order.pause_ms, results)?;
            results.link_response.push(OnLink::measured(mbit, row));
        }
    }
    let bursts = &plan.link.availability;
    for &mbit in &bursts.mbit {
        for &chars in bursts.sizes(mbit) {
            for period_ms in bursts.periods_ms(mbit) {
                let burst =
                    Burst { chars, count: bursts.group, period_ms, delivery: Delivery::Reliable, insist: false };
                results.link_availability.push(OnLink::measured(mbit, availability(mbit, &burst)?));
            }
        }
    }
    Ok(())
}

/// Two m_units and the way between them.
struct Pair {
    world: World,
    main: UnitHandle,
    executed: Rc<Cell<u64>>,
    parameters: BoxedParameters,
}

impl Pair {
    fn start(mbit: u32, chars: u32) -> Result<Self> {
        let mut world = World::new(1);
        let constraints = Constraints { message_size: chars + 64, ..Constraints::M_UNIT };
        let unit = |name, id| world.m_unit(name, id).constraints(constraints).start();
        let (main, passive) = (unit("main", 2), unit("passive", 1));
        let path = Path::LAN.delay(Duration::from_micros(20)).bits_per_second(u64::from(mbit) * 1_000_000);
        world.network(|network| {
            network.set_paths_between(main.host(), passive.host(), path);
            for unit in [&main, &passive] {
                network.set_buffers(unit.host(), BUFFER, BUFFER);
            }
        });
        let executed = Rc::new(Cell::new(0));
        let counted = executed.clone();
        let take = Service::new(move |_, _| {
            counted.set(counted.get() + 1);
            Ok(())
        });
        passive.my_function_list().add_service(&format!("take(text: string[{chars}])"), take)?;
        let echo = format!("echo(text: string[{chars}]) -> (text: string[{chars}])");
        passive.my_function_list().add_service(&echo, Service::new(|_, _| Ok(())))?;
        passive.publish_my_function_list()?;
        let known = main.clone();
        ensure!(world.run_until(|_| known.knows("passive", "take"), Duration::from_secs(10)), "they did not meet");
        let mut parameters = boxed_parameters(chars as usize + 1_024);
        parameters.add_string("text", chars)?;
        parameters.set_value("text", text(chars).as_str())?;
        Ok(Self { world, main, executed, parameters })
    }

    fn nanoseconds(&self) -> u64 {
        self.world.now().as_micros() * 1_000
    }
}

fn response(mbit: u32, chars: u32, pause_ms: u64, results: &Results) -> Result<Response> {
    let mut pair = Pair::start(mbit, chars)?;
    let mut round_trips = Vec::new();
    for _ in 0..CALLS {
        pair.world.run_for(Duration::from_millis(pause_ms));
        let before = pair.nanoseconds();
        let called = pair.world.block_request(&pair.main, "passive", "echo", &mut pair.parameters);
        called.map_err(|error| anyhow!("{error}"))?;
        round_trips.push(pair.nanoseconds() - before);
    }
    let outcome = Outcome { elapsed: round_trips.iter().sum(), round_trips, cpu: 0, cpu_calls: 1 };
    let figures = Calls { turns: vec![Turn::new(outcome, 0)] }.figures();
    let floor = measured(&results.link_response)
        .find(|(rate, row)| (*rate, row.peer.as_str(), row.distribution, row.chars) == (mbit, "floor", 1, chars));
    let ratio = floor.map_or(0.0, |(_, floor)| ratio(micros(figures.median) / floor.p50_us.max(0.01)));
    Ok(Response {
        peer: SIMULATED.into(),
        distribution: 1,
        chars,
        pin: Pin::None,
        mode: Mode::Plain,
        print: false,
        pause_ms,
        n: figures.calls,
        mean_us: micros(figures.mean),
        lower_quartile_us: micros(figures.lower_quartile),
        p50_us: micros(figures.median),
        upper_quartile_us: micros(figures.upper_quartile),
        p99_us: micros(figures.p99),
        p999_us: micros(figures.p999),
        max_us: micros(figures.longest),
        ratio,
        ratio_lower_quartile: ratio,
        ratio_upper_quartile: ratio,
        p99_ratio: ratio,
        plain_ratio: None,
        cpu_us_per_call: 0.0,
        cpu_ratio: 0.0,
    })
}

/// One group: without chance on the way, all are alike.
fn availability(mbit: u32, burst: &Burst) -> Result<LinkAvailability> {
    let mut pair = Pair::start(mbit, burst.chars)?;
    let (start, began) = (pair.nanoseconds(), pair.world.now());
    let mut offered = Offered { start, ..Offered::default() };
    for index in 0..u64::from(burst.count) {
        let due = began + Duration::from_millis(burst.period_ms * index);
        pair.world.run_for(due.since(pair.world.now()));
        match pair.main.request("passive", "take", &pair.parameters) {
            Ok(_) => offered.taken += 1,
            Err(error) => {
                offered.refused += 1;
                *offered.reasons.entry(error.to_string()).or_default() += 1;
            }
        }
    }
    pair.world.run_for(super::link::GRACE.into());
    let in_time = pair.executed.get();
    let (executed, taken) = (pair.executed.clone(), offered.taken);
    // Requests live for two seconds; what has not run by then never does.
    let _ = pair.world.run_until(|_| executed.get() >= taken, Duration::from_secs(10));
    let executed = pair.executed.get();
    let elapsed = pair.nanoseconds() - start;
    let delivered = Delivered { failed: taken - executed, offered, executed, in_time, elapsed };
    Ok(super::link::row((SIMULATED, Mode::Plain), 1, false, mbit, burst, &[delivered]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn response_times_are_alike_up_to_a_thousand_characters_and_far_longer_beyond() {
        let [one, thousand, longest] =
            [1, 1_000, 20_000].map(|chars| response(100, chars, 20, &Results::default()).unwrap().p50_us);
        assert!(thousand < 10.0 * one && longest > 10.0 * thousand, "{one}, {thousand}, {longest} us");
    }

    /// Of a hundred requests at this period, how many are executed in time on a link of 10 Mbit/s.
    fn in_time(chars: u32, period_ms: u64) -> f64 {
        let burst = Burst { chars, count: 100, period_ms, delivery: Delivery::Reliable, insist: false };
        availability(10, &burst).unwrap().in_time_of_offered
    }

    #[test]
    fn ten_thousand_characters_are_in_time_from_the_period_on_at_which_they_fit_the_link() {
        assert!(in_time(10_000, 5) < 0.8);
        assert_eq!([10, 20, 50].map(|period| in_time(10_000, period)), [1.0; 3]);
    }

    #[test]
    fn twenty_thousand_characters_are_in_time_from_the_period_on_at_which_they_fit_the_link() {
        assert!(in_time(20_000, 10) < 0.8);
        assert_eq!([20, 70].map(|period| in_time(20_000, period)), [1.0; 2]);
    }
}
