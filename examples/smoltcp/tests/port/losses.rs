//! Links that end although both ends are alive, on a network that loses frames: none may, at any share of loss below
//! 10 %. The figures are in `docs/performance.md`:
//! `CARA_VEHICLE_HOURS=400 cargo test --release -p cara-smoltcp --test port losses -- --nocapture`

use std::ops::AddAssign;

use cara_core::time::Duration;
use cara_ethernet::Faults;

use crate::world::World;

/// Vehicles on one manager; each has links and losses of its own.
const VEHICLES: u64 = 4;
/// Virtual time of one world.
const HOURS: u64 = 1;
/// Vehicle-hours for each row without `CARA_VEHICLE_HOURS`.
const SHORT: u64 = 8;

#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    /// Links that ended.
    lost: u64,
    keep_alives_missed: u64,
    frames: u64,
    calls: u64,
    /// Calls that ended without results.
    failed: u64,
}

impl AddAssign for Counts {
    fn add_assign(&mut self, more: Self) {
        self.lost += more.lost;
        self.keep_alives_missed += more.keep_alives_missed;
        self.frames += more.frames;
        self.calls += more.calls;
        self.failed += more.failed;
    }
}

/// What happens within an hour to four vehicles, which are called every second, or never.
fn hour(seed: u64, share: f64, called: bool) -> Counts {
    let mut world = World::new(seed, VEHICLES as usize, Faults { delay: Duration::from_millis(1), ..Faults::NONE });
    world.join();
    world.set_faults(Faults { delay: Duration::from_millis(1), ..Faults::loss(share) });
    let mut counts = Counts::default();
    let before = world.switch.borrow().frames();
    for second in 0..HOURS * 3_600 {
        if called {
            let now = world.now;
            for link in world.manager().links() {
                // One whose vehicle's list has not come yet cannot be called.
                counts.calls += u64::from(world.manager().call(now, link, "echo", second as i64).is_ok());
            }
        }
        world.run(Duration::from_secs(1));
    }
    let left: usize = world.vehicles.iter().map(|vehicle| vehicle.left()).sum();
    counts.lost = left.max(world.manager().left.len()) as u64;
    counts.keep_alives_missed = world.manager().keep_alives_missed();
    counts.frames = world.switch.borrow().frames() - before;
    counts.failed = world.manager().replies.iter().filter(|(_, _, outcome)| outcome.is_err()).count() as u64;
    counts
}

fn series(called: bool) {
    let wanted = std::env::var("CARA_VEHICLE_HOURS").ok().and_then(|hours| hours.parse().ok()).unwrap_or(SHORT);
    let worlds = wanted.div_ceil(VEHICLES * HOURS).max(1);
    let hours = (worlds * VEHICLES * HOURS) as f64;
    println!(
        "loss   links lost   per vehicle-hour   missed/h   frames/s   calls   failed   ({hours} vehicle-hours each)"
    );
    let shares = [0.0, 0.01, 0.05, 0.1, 0.2];
    let rows = shares.map(|share| {
        let mut sum = Counts::default();
        cara_sim::for_each_seed(worlds, |seed| hour(seed, share, called)).into_iter().for_each(|more| sum += more);
        let (rate, missed) = (sum.lost as f64 / hours, sum.keep_alives_missed as f64 / hours);
        let frames = sum.frames as f64 / hours / 3_600.0;
        let Counts { lost, calls, failed, .. } = sum;
        println!(
            "{:>3} %  {lost:>10}  {rate:>17.4}  {missed:>9.1}  {frames:>9.2}  {calls:>6}  {failed:>7}",
            share * 100.0
        );
        rate
    });
    assert_eq!(rows[..3], [0.0; 3], "links were lost at 5 % or less");
    assert!(rows[3] < 0.1, "{} links lost per vehicle-hour at 10 %", rows[3]);
}

#[test]
fn an_idle_link_is_not_lost_for_want_of_frames() {
    series(false);
}

#[test]
fn a_link_that_is_called_every_second_is_not_lost_for_want_of_frames() {
    series(true);
}
