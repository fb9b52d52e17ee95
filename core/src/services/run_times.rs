//! Run times of the unit's functions, from which admission ([`Scheduling::Admission`](crate::config::Scheduling::Admission))
//! predicts missed deadlines.

use crate::ability::{ADMISSION, Begins, State};
use crate::distribution::function_list::{Generation, Slot};
use crate::host::mailman::LinkId;
use crate::services::calls::{CallHead, Ticket};
use crate::time::{Duration, Instant};

/// How many functions have an average; another one replaces the one that ran longest ago.
const FUNCTIONS: usize = 8;
/// Weight of a new run in the moving average: one part in this many.
const WEIGHT: u64 = 8;
/// How often a call may begin although it seems too late: only a run shows what the function takes now.
const PROBE: Duration = Duration::from_secs(1);
/// After this time another call is measured instead of one that has not ended, whose link may be gone.
const MEASURED_FOR: Duration = Duration::from_secs(60);

/// A call that runs, among those of all links.
type Running = (LinkId, Ticket);

/// What is known of one function.
#[derive(Clone, Copy, Debug)]
struct RunTime {
    function: (Slot, Generation),
    /// Valid at `ran`.
    average: Duration,
    /// When the last measured run ended.
    ran: Instant,
    /// When a call last began although the average said that it would be too late.
    probed: Option<Instant>,
    /// The call being measured, and its start. One per function, so that each running call stores nothing.
    measured: Option<(Running, Instant)>,
}

impl RunTime {
    /// The average, halved for each second without a measurement, so that a function that was slow is tried again.
    fn average(&self, now: Instant) -> Duration {
        let until = self.measured.map_or(now, |(_, since)| since.min(now));
        let idle = until.since(self.ran).as_micros().checked_div(PROBE.as_micros()).unwrap_or(0);
        Duration::from_micros(self.average.as_micros().checked_shr(idle.min(64) as u32).unwrap_or(0))
    }
}

type Table = [Option<RunTime>; FUNCTIONS];

impl Begins for Table {
    const BEGIN: &'static Self = &[None; FUNCTIONS];
}

/// The averages of a unit, measured over all its links. Takes no memory in a build without admission.
#[derive(Default)]
pub(crate) struct RunTimes(State<Table, { ADMISSION as usize }>);

impl RunTimes {
    /// Whether a call that arrives or would begin now is expected to miss its deadline, by the average of its function.
    pub(crate) fn is_too_late(&self, now: Instant, call: &CallHead) -> bool {
        let Some(times) = self.0.iter().flatten().find(|times| times.function == (call.slot, call.generation)) else {
            return false;
        };
        let is_due = times.probed.is_none_or(|probed| now >= probed + PROBE);
        times.average(now) > call.deadline.since(now) && !is_due
    }

    /// A call begins on a link.
    pub(crate) fn began(&mut self, now: Instant, call: &CallHead, running: Running) {
        let function = (call.slot, call.generation);
        self.0.change(|table| {
            let known = table.iter().position(|place| place.is_some_and(|times| times.function == function));
            // Otherwise a free entry, or that of the function that ran longest ago.
            let oldest = || {
                let ran = |(_, place): &(usize, &Option<RunTime>)| place.map_or(Instant::START, |times| times.ran);
                table.iter().enumerate().min_by_key(ran).map(|(index, _)| index)
            };
            let Some(place) = known.or_else(oldest).and_then(|index| table.get_mut(index)) else { return };
            if known.is_none() {
                *place = Some(RunTime { function, average: Duration::ZERO, ran: now, probed: None, measured: None });
            }
            let Some(times) = place else { return };
            if times.average(now) > call.deadline.since(now) {
                times.probed = Some(now);
            }
            if times.measured.is_none_or(|(_, since)| now >= since + MEASURED_FOR) {
                times.measured = Some((running, now));
            }
        });
    }

    /// The handler of a call has returned.
    pub(crate) fn ended(&mut self, now: Instant, function: (Slot, Generation), running: Running) {
        self.0.change(|table| {
            let Some(times) = table.iter_mut().flatten().find(|times| times.function == function) else { return };
            let average = times.average(now);
            let Some((_, since)) = times.measured.take_if(|(measured, _)| *measured == running) else { return };
            if now >= since + MEASURED_FOR {
                return;
            }
            let took = now.since(since);
            // The first run after a pause replaces the average, which is out of date.
            times.average = if average == times.average && average != Duration::ZERO {
                average - average.divided_by(WEIGHT) + took.divided_by(WEIGHT)
            } else {
                took
            };
            times.ran = now;
        });
    }
}

#[cfg(all(test, feature = "admission"))]
mod tests {
    use super::*;
    use crate::config::Priority;

    const LINK: LinkId = LinkId(0);
    const FIRST: (Slot, Generation) = (Slot(1), Generation(0));

    /// A call of a function that is made at `now`.
    fn call(id: u32, function: u16, now: Instant, timeout: Duration) -> CallHead {
        CallHead {
            id,
            slot: Slot(function),
            generation: Generation(0),
            priority: Priority::Normal,
            wants_reply: true,
            wants_progress: false,
            takes_over: false,
            operator: false,
            keeps_order: false,
            deadline: now + timeout,
            sent_at: now,
            number: id,
        }
    }

    /// Runs one from `now` on; when it has ended.
    fn run(times: &mut RunTimes, now: Instant, function: u16, takes: Duration) -> Instant {
        let running = (LINK, Ticket::of(0, 1));
        times.began(now, &call(1, function, now, Duration::from_secs(9)), running);
        times.ended(now + takes, (Slot(function), Generation(0)), running);
        now + takes
    }

    fn of(times: &RunTimes, function: u16) -> Option<&RunTime> {
        times.0.iter().flatten().find(|times| times.function == (Slot(function), Generation(0)))
    }

    fn is_too_late(times: &RunTimes, now: Instant, function: u16, millis: u64) -> bool {
        times.is_too_late(now, &call(2, function, now, Duration::from_millis(millis)))
    }

    #[test]
    fn a_call_is_too_late_where_its_functions_average_is_longer_than_what_it_has_left() {
        let mut times = RunTimes::default();
        let start = Instant::from_micros(60_000_000);
        assert!(!is_too_late(&times, start, 1, 1), "nothing is known");
        let mut now = run(&mut times, start, 1, Duration::from_millis(100));
        // One call is let through: from there on the second counts.
        times.began(now, &call(3, 1, now, Duration::from_millis(1)), (LINK, Ticket::of(1, 3)));
        times.ended(now + Duration::from_millis(100), FIRST, (LINK, Ticket::of(1, 3)));
        now = now + Duration::from_millis(100);
        assert!(
            is_too_late(&times, now, 1, 99) && !is_too_late(&times, now, 1, 101) && !is_too_late(&times, now, 2, 1)
        );
    }

    #[test]
    fn one_call_a_second_begins_whatever_the_average_says_and_without_runs_it_halves() {
        let mut times = RunTimes::default();
        let now = run(&mut times, Instant::from_micros(60_000_000), 1, Duration::from_millis(100));
        assert!(!is_too_late(&times, now, 1, 60), "none was let through yet");
        let late = call(3, 1, now, Duration::from_millis(60));
        times.began(now, &late, (LINK, Ticket::of(1, 3)));
        assert!(is_too_late(&times, now, 1, 60));
        assert!(!is_too_late(&times, now + Duration::from_secs(1), 1, 60), "the next one after a second");
        times.ended(now, FIRST, (LINK, Ticket::of(1, 3)));
        let halved = now + Duration::from_secs(1);
        times.began(halved, &call(4, 1, halved, Duration::from_millis(1)), (LINK, Ticket::of(0, 4)));
        assert!(is_too_late(&times, halved, 1, 40) && !is_too_late(&times, halved, 1, 51));
    }

    #[test]
    fn a_fast_run_moves_the_average_by_an_eighth_and_the_function_that_ran_longest_ago_is_forgotten() {
        let mut times = RunTimes::default();
        let mut now = run(&mut times, Instant::from_micros(60_000_000), 1, Duration::from_millis(80));
        now = run(&mut times, now, 1, Duration::ZERO);
        assert_eq!(of(&times, 1).map(|times| times.average(now)), Some(Duration::from_millis(70)));
        for function in 2..=FUNCTIONS as u16 + 1 {
            now = run(&mut times, now, function, Duration::from_millis(1));
        }
        let known = |function: u16| of(&times, function).is_some();
        assert!(!known(1) && (2..=FUNCTIONS as u16 + 1).all(known));
    }
}
