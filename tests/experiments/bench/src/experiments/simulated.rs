//! The link's experiments in the simulator: the same core, rates, sizes and periods in virtual time. In distribution 2 five
//! s_units of the passive node share the main node's end of the link, and call at random. No service prints, and headers of the
//! network cost nothing there.

use std::cell::Cell;
use std::rc::Rc;

use anyhow::{Result, anyhow, ensure};
use cara_bench_ends::{Burst, Delivery, Offered, Outcome, Pin, text};
use cara_core::config::Constraints;
use cara_core::random::Random;
use cara_core::time::Duration;
use cara_sim::{BoxedParameters, Path, Service, UnitHandle, World, boxed_parameters};

use super::plan::Plan;
use crate::pair::Delivered;
use crate::results::{Mode, OnLink, Response, Results, measured, micros, ratio};
use crate::statistics::{Cell as Calls, Turn};

/// Its name in the rows.
pub(crate) const SIMULATED: &str = "simulated";
/// Calls of each size: without chance on the way, all take as long.
const CALLS: u32 = 5;
/// Nodes more in distribution 2, as on links.
const FURTHER: u32 = 5;
/// Characters of each of their calls.
const FURTHER_CHARS: u32 = 1_000;
/// Between two calls of one, drawn at random from 1 ms on.
const FURTHER_INTERVAL_MS: u64 = 20;
/// Bytes of a simulated host's buffers.
const BUFFER: usize = 128 * 1_024;

/// All rates; nothing where links lose packets, of which these know nothing.
pub(super) fn measure(plan: &Plan, results: &mut Results) -> Result<()> {
    if plan.link.loss_percent > 0 {
        return Ok(());
    }
    for group in &plan.link.response {
        let (mbit, distribution) = (group.setting.mbit(), group.setting.distribution);
        for order in &group.orders {
            let row = response((mbit, distribution), order.chars, order.pause_ms, results)?;
            results.link_response.push(OnLink::measured(mbit, row));
        }
    }
    let bursts = &plan.link.availability;
    for (distribution, &mbit) in
        [1, 2].into_iter().flat_map(|number| bursts.mbit.iter().map(move |mbit| (number, mbit)))
    {
        for &chars in bursts.sizes(mbit) {
            for period_ms in bursts.periods_ms(mbit) {
                let burst =
                    Burst { chars, count: bursts.group, period_ms, delivery: Delivery::Reliable, insist: false };
                let mut pair = Pair::start((mbit, distribution), chars)?;
                let delivered = deliver(&mut pair, &burst);
                ensure!(distribution == 1 || pair.further.get() > 0, "no call of a further node was answered");
                let row = super::link::row((SIMULATED, Mode::Plain), distribution, false, mbit, &burst, &[delivered]);
                results.link_availability.push(OnLink::measured(mbit, row));
            }
        }
    }
    Ok(())
}

/// Two m_units and the way between them.
struct Pair {
    world: World,
    main: UnitHandle,
    passive: UnitHandle,
    executed: Rc<Cell<u64>>,
    /// Calls of the further nodes that were answered.
    further: Rc<Cell<u64>>,
    parameters: BoxedParameters,
}

impl Pair {
    /// At a rate in Mbit/s, in a distribution.
    fn start((mbit, distribution): (u32, u8), chars: u32) -> Result<Self> {
        let mut world = World::new(1);
        let constraints = Constraints { message_size: chars.max(FURTHER_CHARS) + 64, ..Constraints::M_UNIT };
        let unit = |name, id| world.m_unit(name, id).constraints(constraints).start();
        let (main, passive) = (unit("main", 2), unit("passive", 1));
        let further = if distribution == 2 { FURTHER } else { 0 };
        let further: Vec<_> = (0..further)
            .map(|id| world.s_unit(&format!("further-{id}"), 10 + id).joins("passive", 1).start())
            .collect();
        let path = Path::LAN.delay(Duration::from_micros(20)).bits_per_second(u64::from(mbit) * 1_000_000);
        world.network(|network| {
            let near: Vec<_> = further.iter().chain([&main]).map(UnitHandle::host).collect();
            network.share_cable(&near);
            for &host in &near {
                network.set_paths_between(host, passive.host(), path);
            }
            for &host in near.iter().chain([&passive.host()]) {
                network.set_buffers(host, BUFFER, BUFFER);
            }
        });
        let executed = Rc::new(Cell::new(0));
        let counted = executed.clone();
        let take = Service::new(move |_, _| {
            counted.set(counted.get() + 1);
            Ok(())
        });
        passive.my_function_list().add_service(&format!("take(text: string[{chars}])"), take)?;
        for (name, chars) in [("echo", chars), ("further", FURTHER_CHARS)] {
            let echo = format!("{name}(text: string[{chars}]) -> (text: string[{chars}])");
            passive.my_function_list().add_service(&echo, Service::new(|_, _| Ok(())))?;
        }
        passive.publish_my_function_list()?;
        let known = || further.iter().chain([&main]).all(|unit| unit.knows("passive", "take"));
        ensure!(world.run_until(|_| known(), Duration::from_secs(20)), "they did not meet");
        let answered = Rc::new(Cell::new(0));
        for (number, unit) in further.into_iter().enumerate() {
            let (calling, answered) = (unit.clone(), answered.clone());
            let mut parameters = with_text(FURTHER_CHARS)?;
            unit.spawn(async move {
                let mut random = Random::new(number as u64 + 1);
                loop {
                    calling.sleep(Duration::from_millis(1 + random.below(FURTHER_INTERVAL_MS))).await;
                    if calling.block_request("passive", "further", &mut parameters).await.is_ok() {
                        answered.set(answered.get() + 1);
                    }
                }
            });
        }
        Ok(Self { world, main, passive, executed, further: answered, parameters: with_text(chars)? })
    }

    fn nanoseconds(&self) -> u64 {
        self.world.now().as_micros() * 1_000
    }
}

fn with_text(chars: u32) -> Result<BoxedParameters> {
    let mut parameters = boxed_parameters(chars as usize + 1_024);
    parameters.add_string("text", chars)?;
    parameters.set_value("text", text(chars).as_str())?;
    Ok(parameters)
}

fn response(link: (u32, u8), chars: u32, pause_ms: u64, results: &Results) -> Result<Response> {
    let (mbit, distribution) = link;
    let mut pair = Pair::start(link, chars)?;
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
    let floor = measured(&results.link_response).find(|(rate, row)| {
        (*rate, row.peer.as_str(), row.distribution, row.chars) == (mbit, "floor", distribution, chars)
    });
    let ratio = floor.map_or(0.0, |(_, floor)| ratio(micros(figures.median) / floor.p50_us.max(0.01)));
    Ok(Response {
        peer: SIMULATED.into(),
        distribution,
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

/// One group: in distribution 1, without chance on the way, all are alike.
fn deliver(pair: &mut Pair, burst: &Burst) -> Delivered {
    let (start, began) = (pair.nanoseconds(), pair.world.now());
    let mut offered = Offered { start, ..Offered::default() };
    for index in 0..u64::from(burst.count) {
        let due = began + Duration::from_millis(burst.period_ms * index);
        pair.world.run_for(due.since(pair.world.now()));
        match pair.main.request(&pair.passive, "take", &pair.parameters) {
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
    Delivered { failed: taken - executed, offered, executed, in_time, elapsed }
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::identity::Role;

    use super::*;

    #[test]
    fn response_times_are_alike_up_to_a_thousand_characters_and_far_longer_beyond() {
        let [one, thousand, longest] =
            [1, 1_000, 20_000].map(|chars| response((100, 1), chars, 20, &Results::default()).unwrap().p50_us);
        assert!(thousand < 10.0 * one && longest > 10.0 * thousand, "{one}, {thousand}, {longest} us");
    }

    /// What becomes of a hundred requests at this period on a link of 10 Mbit/s.
    fn delivered(pair: &mut Pair, chars: u32, period_ms: u64) -> Delivered {
        deliver(pair, &Burst { chars, count: 100, period_ms, delivery: Delivery::Reliable, insist: false })
    }

    /// How many of a hundred are executed in time.
    fn in_time(distribution: u8, chars: u32, period_ms: u64) -> u64 {
        delivered(&mut Pair::start((10, distribution), chars).unwrap(), chars, period_ms).in_time
    }

    #[test]
    fn ten_thousand_characters_are_in_time_from_the_period_on_at_which_they_fit_the_link() {
        assert!(in_time(1, 10_000, 5) < 80);
        assert_eq!([10, 20, 50].map(|period| in_time(1, 10_000, period)), [100; 3]);
    }

    #[test]
    fn twenty_thousand_characters_are_in_time_from_the_period_on_at_which_they_fit_the_link() {
        assert!(in_time(1, 20_000, 10) < 80);
        assert_eq!([20, 70].map(|period| in_time(1, 20_000, period)), [100; 2]);
    }

    #[test]
    fn two_m_units_are_joined_by_five_s_units_that_call_at_random() {
        for (distribution, s_units) in [(1, 0), (2, 5)] {
            let mut pair = Pair::start((10, distribution), 1_000).unwrap();
            assert_eq!([&pair.main, &pair.passive].map(|unit| unit.identity().role()), [Role::MUnit; 2]);
            assert_eq!(pair.passive.s_units().len(), s_units, "distribution {distribution}");
            assert_eq!(pair.main.peers(), [pair.passive.identity()]);
            assert_eq!(delivered(&mut pair, 1_000, 10).in_time, 100);
            // Each calls about every 11 ms, for a second.
            let calls = pair.further.get();
            assert!(calls >= 40 * s_units as u64 && (calls == 0) == (s_units == 0), "{calls} calls");
        }
    }

    #[test]
    fn further_nodes_take_ten_thousand_characters_their_time_at_short_periods() {
        let [one, two] = [1, 2].map(|distribution| in_time(distribution, 10_000, 10));
        assert!(two < one, "{one} and {two} of 100");
        assert_eq!(in_time(2, 10_000, 50), 100);
    }

    #[test]
    fn further_nodes_take_twenty_thousand_characters_their_time_at_short_periods() {
        let [one, two] = [1, 2].map(|distribution| in_time(distribution, 20_000, 20));
        assert!(two < one, "{one} and {two} of 100");
        assert_eq!(in_time(2, 20_000, 80), 100);
    }

    /// A longer interval takes fewer requests, and what it takes is executed in time where all would be too much for the link;
    /// a smaller message is there earlier, and larger ones are refused.
    #[test]
    fn interval_and_message_size_trade_what_is_offered_for_what_is_in_time() {
        let limited = |minimum_interval, message_size| {
            let mut pair = Pair::start((10, 1), 10_000).unwrap();
            let constraints = pair.passive.constraints().unwrap();
            let minimum_interval = Duration::from_millis(minimum_interval);
            pair.passive.set_constraints(Constraints { minimum_interval, message_size, ..constraints }).unwrap();
            pair.world.run_for(Duration::from_secs(1));
            delivered(&mut pair, 10_000, 5)
        };
        let by_interval = [0, 10, 20, 40].map(|interval| limited(interval, 10_064));
        let taken = by_interval.each_ref().map(|delivered| delivered.offered.taken);
        assert!(taken.is_sorted_by(|one, other| one > other), "{taken:?} taken");
        let shares = by_interval.each_ref().map(|delivered| delivered.in_time * 100 / delivered.offered.taken);
        assert!(shares[0] < 95 && shares[1..] == [100; 3], "{shares:?} % of them in time");
        assert_eq!(limited(0, 5_000).offered.taken, 0, "longer than the peer says");
    }
}
