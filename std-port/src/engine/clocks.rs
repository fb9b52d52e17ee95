//! How far the clocks of nodes are from a manager's. A node that offers `clock() -> (unix_us: int)` is asked a few times when it
//! publishes that, and again each minute; of each few, the answer with the shortest round trip counts.
//!
//! The thread that looks at files asks, and waits for no answer: the thread that reads one notes when it came. The calls are in no
//! audit log and are shown to no follower of commands, as the program has not asked for them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::task::Wake as WakeTask;
use std::time::{SystemTime, UNIX_EPOCH};

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::identity::Role;
use cara_core::distribution::parameters::{Parameters, Type};
use cara_core::error::Error;
use cara_core::host::mailman::LinkId;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::calling::worth_waiting;
use super::driving::Driver;
use super::link::{LinkCell, LinkState, Wake};
use super::peer_cell::PeerCell;
use super::reader::Cause;
use crate::locks::lock;
use crate::timers::Timers;

/// The function that tells a node's clock: microseconds since 1970, UTC.
pub(crate) const SIGNATURE: &str = "clock() -> (unix_us: int)";
const FUNCTION: &str = "clock";
/// Its result.
pub(crate) const UNIX_US: &str = "unix_us";

/// Calls of which the one with the shortest round trip counts. One alone where calls to the node have a minimum interval, which the
/// program's calls would wait for.
const FEW: u8 = 4;
/// Between the ends of two of these measurements.
const PERIOD: Duration = Duration::from_secs(60);
/// What was measured is told for so long.
const MOST_AGE: Duration = Duration::from_secs(240);
/// How long an answer is waited for, and a slot for calls is in use.
const PATIENCE: Duration = Duration::from_millis(500);
/// Before the second try where the first call has failed, as it may in a busy moment. It is a period before the third.
const AGAIN: Duration = Duration::from_secs(5);
/// Calls without an answer in a row after which the node is asked no more until it joins again: each of them may still run there.
const MOST_FAILURES: u8 = 3;
/// Before the next try where the link has no room for a call.
const FULL: Duration = Duration::from_secs(1);

/// How far a node's clock is from this unit's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockOffset {
    /// The node's time minus this unit's, in microseconds: positive where the node is ahead.
    pub offset_us: i64,
    /// It is off by this at most: half the round trip.
    pub error: Duration,
    /// How long ago it was measured.
    pub age: Duration,
}

/// What was measured, as the node's cell keeps it.
#[derive(Clone, Copy)]
pub(super) struct Measured {
    offset_us: i64,
    error: Duration,
    at: Instant,
}

impl Measured {
    /// `None` if it is too old.
    pub(super) fn offset(&self, now: Instant) -> Option<ClockOffset> {
        let age = now.since(self.at);
        (age < MOST_AGE).then_some(ClockOffset { offset_us: self.offset_us, error: self.error, age })
    }
}

/// When the clock of which link's node is looked at next.
#[derive(Default)]
pub(super) struct Clocks(Mutex<Timers>);

impl Clocks {
    fn set(&self, link: &LinkCell, at: Instant) {
        lock(&self.0).bring_forward(u32::from(link.id.0), at);
    }
}

/// The measurements on one link.
#[derive(Default)]
pub(super) struct ClockWatch {
    asked: Option<Asked>,
    /// When the next call is due.
    due: Instant,
    /// Answers since the last pause.
    answers: u8,
    failures: u8,
    /// The best error since the last pause.
    best: Duration,
}

/// A call that is not answered yet.
struct Asked {
    id: CallId,
    at: Instant,
    unix_us: i64,
    answer: Arc<Answer>,
}

/// When the answer came. The thread that reads it wakes this.
struct Answer {
    at: AtomicU64,
    link: u32,
    clocks: Arc<Clocks>,
    driver: Arc<Driver>,
}

impl WakeTask for Answer {
    fn wake(self: Arc<Self>) {
        self.at.store(self.driver.clock().now().as_micros(), Ordering::Release);
        lock(&self.clocks.0).bring_forward(self.link, Instant::START);
        self.driver.wake_looker();
    }
}

impl ClockWatch {
    /// How far the clock is that has answered this, if it is the best of these few.
    fn answered(&mut self, now: Instant, asked: &Asked, theirs: i64) -> Option<Measured> {
        self.failures = 0;
        // Zero where the thread that has read the answer has not called the waker yet: it came no later than now.
        let came = match asked.answer.at.load(Ordering::Acquire) {
            0 => now,
            micros => Instant::from_micros(micros),
        };
        let error = Duration::from_micros(came.since(asked.at).as_micros().div_ceil(2));
        if self.answers > 0 && error >= self.best {
            return None;
        }
        self.best = error;
        let middle = asked.unix_us.saturating_add_unsigned(error.as_micros());
        Some(Measured { offset_us: theirs.saturating_sub(middle), error, at: came })
    }

    fn ends(&mut self, now: Instant, few: u8) {
        self.answers += 1;
        if self.answers >= few {
            (self.answers, self.due) = (0, now + PERIOD);
        }
    }

    /// Whether the node is asked no more.
    fn fails(&mut self, now: Instant) -> bool {
        self.failures += 1;
        self.answers = 0;
        self.due = match self.failures {
            1 => now + AGAIN,
            MOST_FAILURES.. => Instant::FAR_FUTURE,
            _ => now + PERIOD,
        };
        self.failures >= MOST_FAILURES
    }
}

impl<T: Send + 'static> Engine<T> {
    /// A node's list has changed: a manager asks for its clock if it offers that.
    pub(super) fn look_for_clock(&self, link: &LinkCell) {
        let mut state = link.lock();
        if !tells_clock(&state) {
            // A call that is open ends by itself, and the watch with it.
            if state.clock.is_some() {
                drop(state);
                self.clocks.set(link, Instant::START);
                self.driver.wake_looker();
            }
            return;
        }
        if state.clock.is_none() && self.hub.lock().identity().0.role() == Role::MUnit {
            state.clock = Some(Box::default());
            drop(state);
            self.clocks.set(link, Instant::START);
            self.driver.wake_looker();
        }
    }

    /// Goes on with the measurements that are due; returns when the next one is.
    pub(super) fn measure_clocks(&self) -> Instant {
        loop {
            let due = {
                let mut timers = lock(&self.clocks.0);
                match timers.pop_due(self.now()) {
                    Some(link) => link,
                    None => return timers.next().unwrap_or(Instant::FAR_FUTURE),
                }
            };
            let link = u16::try_from(due).ok().and_then(|id| self.links.get(LinkId(id)));
            link.iter().for_each(|link| self.measure_clock(link));
        }
    }

    fn measure_clock(&self, link: &Arc<LinkCell>) {
        let Some(peer) = link.peer.get() else { return };
        // The node has another link, or none, by now.
        if !peer.link().is_some_and(|current| Arc::ptr_eq(&current, link)) {
            return;
        }
        let mut state = link.lock();
        let Some(mut watch) = state.clock.take() else { return };
        if let Some(asked) = watch.asked.take() {
            let (mut answer, now) = (Parameters::new(), self.now());
            match self.take_ended(link, &mut state, asked.id, &mut answer) {
                None => watch.asked = Some(asked),
                Some(Ok(())) => {
                    // It has this variable by its signature.
                    let theirs = answer.variable(UNIX_US).unwrap_or(asked.unix_us);
                    if let Some(measured) = watch.answered(now, &asked, theirs) {
                        peer.set_clock(link, Some(measured));
                    }
                    watch.ends(now, if has_interval(&state) { 1 } else { FEW });
                }
                Some(Err(error)) => fail(peer, link, &mut watch, now, error.error),
            }
        }
        if watch.asked.is_none() && !tells_clock(&state) {
            peer.set_clock(link, None);
            return self.settle(link, state);
        }
        if watch.asked.is_none() && watch.due <= self.now() {
            self.ask_clock(link, &mut state, &mut watch);
        }
        if watch.asked.is_none() {
            self.clocks.set(link, watch.due);
        }
        state.clock = Some(watch);
        self.settle(link, state);
    }

    fn ask_clock(&self, link: &Arc<LinkCell>, state: &mut LinkState, watch: &mut ClockWatch) {
        if !state.session.has_call_room() {
            // Calls of the node wait unread, as a call of this unit would have them refused.
            watch.due = self.now() + FULL;
            return;
        }
        let options =
            RequestOptions { timeout: Some(PATIENCE), priority: Some(Priority::Low), ..RequestOptions::new() };
        // A link that is kept is read by no thread until its caller is back.
        self.links.read_by(self.now(), link, state, Cause::NeedsPool);
        let (at, unix_us) = (self.now(), unix_us());
        match self.request_on(at, link, state, FUNCTION.into(), &Parameters::new(), &options, true) {
            Ok(id) => {
                let (clocks, driver) = (self.clocks.clone(), self.driver.clone());
                let answer = Arc::new(Answer { at: AtomicU64::new(0), link: link.id.0.into(), clocks, driver });
                state.await_reply(id, Wake::Task(Some(answer.clone().into())));
                watch.asked = Some(Asked { id, at, unix_us, answer });
            }
            Err(error) => match (worth_waiting(&error.error, FULL), link.peer.get()) {
                (Some(wait), _) => watch.due = at + wait,
                (None, Some(peer)) => fail(peer, link, watch, at, error.error),
                (None, None) => {}
            },
        }
    }
}

fn fail(peer: &PeerCell, link: &LinkCell, watch: &mut ClockWatch, now: Instant, error: Error) {
    if watch.fails(now) {
        peer.set_clock(link, None);
        tracing::warn!(node = %peer.identity, %error, "does not tell its clock, and is not asked for it until it joins again");
    }
}

/// Whether the peer offers its clock, by a function that moves nothing.
fn tells_clock(state: &LinkState) -> bool {
    state.session.their_function_list().named(FUNCTION).is_some_and(|function| {
        let mut results = function.signature.results();
        let is_it =
            results.next().is_some_and(|result| result.name == UNIX_US && result.kind == Type::Int && result.size == 1);
        let Attributes { lease, actuator, stream, stop, reset, .. } = *function.attributes;
        let moves = lease.is_some() || actuator != 0 || stop || reset;
        is_it
            && results.next().is_none()
            && function.signature.arguments().next().is_none()
            && function.signature.progress().next().is_none()
            && !moves
            && stream.is_none()
    })
}

/// Whether calls to the peer wait for a minimum interval.
fn has_interval(state: &LinkState) -> bool {
    let theirs = state.session.hello().map_or(0, |hello| hello.limits.minimum_interval);
    state.session.constraints().minimum_interval > Duration::ZERO || theirs > 0
}

/// This host's time in microseconds since 1970, UTC.
pub(crate) fn unix_us() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_micros()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Instant {
        Instant::START + Duration::from_millis(ms)
    }

    fn asked(driver: &Arc<Driver>, asked_at: u64, came_at: u64) -> Asked {
        let answer = Answer {
            at: AtomicU64::new(at(came_at).as_micros()),
            link: 0,
            clocks: Arc::default(),
            driver: driver.clone(),
        };
        Asked { id: CallId(1), at: at(asked_at), unix_us: 1_000_000, answer: Arc::new(answer) }
    }

    #[test]
    fn of_a_few_the_answer_with_the_shortest_round_trip_counts() {
        let agv = crate::testing::vehicle(crate::testing::fleet(), 1, cara_core::config::Constraints::S_UNIT);
        let (driver, mut watch) = (agv.engine().driver.clone(), ClockWatch::default());
        let mut measure = |asked_at, came_at, theirs| {
            let measured = watch.answered(at(came_at), &asked(&driver, asked_at, came_at), theirs);
            watch.ends(at(came_at), FEW);
            (measured.map(|measured| (measured.offset_us, measured.error.as_micros())), watch.due)
        };
        assert_eq!(measure(10, 30, 1_000_000), (Some((-10_000, 10_000)), Instant::START));
        assert_eq!(measure(40, 80, 1_500_000), (None, Instant::START), "longer than the one before");
        assert_eq!(measure(90, 92, 1_500_000), (Some((499_000, 1_000)), Instant::START));
        assert_eq!(measure(95, 99, i64::MIN), (None, at(99) + PERIOD));
        assert_eq!(measure(100, 200, i64::MIN), (Some((i64::MIN, 50_000)), at(99) + PERIOD), "the next few");
    }

    #[test]
    fn a_node_that_does_not_answer_is_asked_thrice() {
        let mut watch = ClockWatch::default();
        assert_eq!((watch.fails(at(1)), watch.due), (false, at(1) + AGAIN));
        assert_eq!((watch.fails(at(2)), watch.due), (false, at(2) + PERIOD));
        assert_eq!((watch.fails(at(3)), watch.due), (true, Instant::FAR_FUTURE));
    }
}
