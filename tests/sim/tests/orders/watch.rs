//! What must hold of orders, stops and terms whatever fails, judged by what happens at vehicles and what callers have done.
//! It knows the one true time and every caller's wish, and nothing of how the core keeps its promises.

use std::collections::BTreeMap;

use cara_core::distribution::claim::Claim;
use cara_core::services::lease::LeaseEnd;
use cara_core::time::{Duration, Instant};
use cara_sim::LeaseWatch;

/// What a vehicle moves.
pub(crate) const DRIVE: usize = 0;
pub(crate) const FORK: usize = 1;
/// How long each goes on without its caller.
pub(crate) const LENGTHS: [Duration; 2] = [Duration::from_millis(400), Duration::from_millis(300)];
/// A process shows so often that it runs.
pub(crate) const PULSE: Duration = Duration::from_millis(10);

/// What a call does at a vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Does {
    Move(usize),
    Stop(&'static [usize]),
    Reset(&'static [usize]),
    Nothing,
}

/// For how long a call wants what it moves.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Wanted {
    Once,
    Process,
    /// While this heart beats.
    Heart(usize),
}

/// A call as its caller has made it; they are numbered in the order in which they were made.
#[derive(Clone, Debug)]
pub(crate) struct Made {
    /// The process that made it.
    pub(crate) by: usize,
    pub(crate) at: Instant,
    pub(crate) vehicle: usize,
    pub(crate) function: &'static str,
    pub(crate) does: Does,
    pub(crate) wanted: Wanted,
    pub(crate) takes_over: bool,
    /// An operator of the unit made it, and not its program.
    pub(crate) operator: bool,
    pub(crate) is_emergency: bool,
}

struct Call {
    made: Made,
    /// When its caller no longer wanted it.
    ended: Option<Instant>,
    /// Calls from this number on were made after the vehicle was told that.
    reported: Option<usize>,
    has_started: bool,
    /// It has been given an order of what it moves.
    has_begun: bool,
    /// Its order has ended: it moves nothing any more, ever.
    is_dead: bool,
}

/// One life of a caller.
struct Process {
    id: u32,
    /// The claims that it has had, the newest last.
    claims: Vec<Claim>,
    /// When it ran last.
    pulse: Instant,
}

/// What is known of a thing that a vehicle moves.
#[derive(Default)]
struct Moved {
    /// The call whose order has it, until its end has been seen to be made safe.
    open: Option<(usize, LeaseWatch)>,
    /// Whether it was seen dead, without its safe hook.
    is_unsafe: bool,
    /// When it was stopped last, and whether a reset that was made later has run.
    latched: Option<(Instant, bool)>,
    /// When the latest reset was made of those that have run.
    reset_made: Option<Instant>,
    /// Calls that have stopped it.
    stops: Vec<usize>,
}

struct Vehicle {
    /// Obeys terms.
    is_s_unit: bool,
    /// Keeps what it obeys across restarts, from the first call under it that moves something on; none does in plain mode.
    stores: bool,
    stored: Claim,
    executed: Claim,
    moved: [Moved; 2],
}

/// How a vehicle is when something happens to it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    pub(crate) now: Instant,
    pub(crate) term: Claim,
    /// Whether they say that they are stopped.
    pub(crate) latched: [bool; 2],
    /// When they were stopped last.
    pub(crate) stopped: [Option<Instant>; 2],
}

/// Counts what a run has come to.
pub(crate) type Reached = BTreeMap<&'static str, u64>;

/// What a run must have come to at least once: one that does nothing breaks no rule.
pub(crate) const MUST_REACH: [&str; 27] = [
    "begun",
    "moved",
    "committed",
    "commit refused",
    "replaced",
    "taken over",
    "held",
    "held by an operator",
    "expired",
    "inhibited",
    "stopped",
    "stopped in part",
    "stopped by itself",
    "order ended by a stop",
    "reset",
    "reset by itself",
    "reset too old",
    "reset refused",
    "released",
    "given up",
    "hold dropped",
    "heart hung",
    "heart dropped",
    "unanswered",
    "ended by time",
    "finished",
    "newer term obeyed",
];

/// What comes seldom, and has to come in many runs.
pub(crate) const SELDOM: [&str; 2] = ["busy", "dead before its handler"];

#[derive(Default)]
pub(crate) struct Watch {
    calls: Vec<Call>,
    processes: Vec<Process>,
    /// When each beat last.
    hearts: Vec<Instant>,
    vehicles: Vec<Vehicle>,
    /// The calls that a peer of a process knows by these numbers.
    named: BTreeMap<(usize, usize, u32), usize>,
    pub(crate) reached: Reached,
}

impl Watch {
    pub(crate) fn add_vehicle(&mut self, is_s_unit: bool, stores: bool) {
        let (stored, executed) = (Claim::NONE, Claim::NONE);
        self.vehicles.push(Vehicle { is_s_unit, stores, stored, executed, moved: Default::default() });
    }

    pub(crate) fn reach(&mut self, what: &'static str) {
        *self.reached.entry(what).or_default() += 1;
    }

    // --- what callers do

    pub(crate) fn process(&mut self, id: u32, claim: Claim, now: Instant) -> usize {
        self.processes.push(Process { id, claims: vec![claim], pulse: now });
        self.processes.len() - 1
    }

    pub(crate) fn raised(&mut self, process: usize, claim: Claim) {
        self.reach("claim raised");
        self.processes[process].claims.push(claim);
    }

    pub(crate) fn pulse(&mut self, process: usize, now: Instant) {
        self.processes[process].pulse = now;
    }

    pub(crate) fn heart(&mut self, now: Instant) -> usize {
        self.hearts.push(now);
        self.hearts.len() - 1
    }

    pub(crate) fn beat(&mut self, heart: usize, now: Instant) {
        self.hearts[heart] = now;
    }

    pub(crate) fn make(&mut self, made: Made) -> usize {
        let (ended, reported) = (None, None);
        self.calls.push(Call { made, ended, reported, has_started: false, has_begun: false, is_dead: false });
        self.calls.len() - 1
    }

    /// What the session calls a call.
    pub(crate) fn name(&mut self, n: usize, id: u32) {
        let Made { by, vehicle, .. } = self.calls[n].made;
        self.named.insert((by, vehicle, id), n);
    }

    /// The call of this name.
    pub(crate) fn named(&self, by: usize, vehicle: usize, id: u32) -> Option<usize> {
        self.named.get(&(by, vehicle, id)).copied()
    }

    /// The caller does not want a call any more, and has said so if it was `reported`.
    pub(crate) fn give_up(&mut self, n: usize, now: Instant, reported: bool) {
        let reported = reported && !self.may_be_forgotten(n);
        let next = self.calls.len();
        let call = &mut self.calls[n];
        call.ended = call.ended.or(Some(now));
        call.reported = call.reported.or(reported.then_some(next));
    }

    /// Whether a newer call of the same function follows it. Where a session holds no more calls, such a one takes the place
    /// of the oldest: that is not renewed any more, and no release is sent for it.
    fn may_be_forgotten(&self, n: usize) -> bool {
        let Made { by, vehicle, function, .. } = self.calls[n].made;
        let is_same = |made: &Made| made.by == by && made.vehicle == vehicle && made.function == function;
        self.calls[n + 1..].iter().any(|call| is_same(&call.made))
    }

    /// The same for all calls of a process that match.
    pub(crate) fn give_up_all(&mut self, by: usize, now: Instant, reported: bool, matches: impl Fn(&Made) -> bool) {
        for n in 0..self.calls.len() {
            if self.calls[n].made.by == by && matches(&self.calls[n].made) {
                self.give_up(n, now, reported);
            }
        }
    }

    /// A caller was told that what a call moved has ended.
    pub(crate) fn order_ended(&mut self, by: usize, vehicle: usize, id: u32, why: LeaseEnd, now: Instant) {
        if why == LeaseEnd::Unanswered {
            self.reach("unanswered");
        }
        if let Some(n) = self.named(by, vehicle, id) {
            self.give_up(n, now, false);
        }
    }

    /// Whether a vehicle is stopped, for callers that choose what to do.
    pub(crate) fn is_stopped(&self, vehicle: usize) -> bool {
        self.vehicles[vehicle].moved.iter().any(|moved| moved.latched.is_some_and(|(_, lifted)| !lifted))
    }

    pub(crate) fn newest_term(&self) -> u64 {
        self.processes.iter().flat_map(|process| &process.claims).map(|claim| claim.term).max().unwrap_or(0)
    }

    /// The last time at which the caller of a call can have wanted it.
    fn wanted_at(&self, n: usize, now: Instant) -> Instant {
        let Call { made, ended, .. } = &self.calls[n];
        let wanted = match made.wanted {
            Wanted::Once => made.at,
            Wanted::Process => self.processes[made.by].pulse + PULSE,
            Wanted::Heart(heart) => self.hearts[heart],
        };
        wanted.min(ended.unwrap_or(now)).max(made.at).min(now)
    }

    fn end_of(&self, n: usize, actuator: usize, now: Instant) -> Instant {
        self.wanted_at(n, now) + LENGTHS[actuator]
    }

    // --- what happens at vehicles

    /// A life of a vehicle begins: what stopped it is forgotten with all else, but for the claim that it has stored.
    pub(crate) fn started(&mut self, vehicle: usize) {
        let vehicle = &mut self.vehicles[vehicle];
        (vehicle.moved, vehicle.executed) = (Default::default(), vehicle.stored);
    }

    /// An order begins. It is heard of in turn with safe hooks and before its handler, which does not run if the order has ended
    /// by then.
    pub(crate) fn order(&mut self, n: usize, vehicle: usize, actuator: usize, order: &LeaseWatch, seen: Seen) {
        let Made { vehicle: of, does, .. } = self.calls[n].made;
        assert_eq!((of, does), (vehicle, Does::Move(actuator)), "call {n} moves what it is for");
        assert!(!std::mem::replace(&mut self.calls[n].has_begun, true), "call {n} begins two orders");
        self.executes(n, seen);
        self.may_begin(n, actuator, seen);
        let before = self.vehicles[vehicle].moved[actuator].open.replace((n, order.clone()));
        self.reach("begun");
        if let Some((before, _)) = before {
            self.gives_way(before, n, actuator, seen.now);
        }
    }

    /// The handler of a call starts. `order` is its hold of what it moves.
    pub(crate) fn handler(&mut self, n: usize, vehicle: usize, order: Option<&LeaseWatch>, seen: Seen) {
        let made = self.calls[n].made.clone();
        assert_eq!(made.vehicle, vehicle, "a call runs where it was sent");
        assert!(!std::mem::replace(&mut self.calls[n].has_started, true), "call {n} runs twice");
        self.executes(n, seen);
        self.look_at_others(n);
        match made.does {
            Does::Move(actuator) => {
                let is_live = order.expect("it moves something").is_live();
                assert!(is_live, "the handler of {n} starts, and its order has ended");
                self.has_order(n, actuator);
                self.may_begin(n, actuator, seen);
            }
            Does::Stop(actuators) => self.stops(n, actuators, seen),
            Does::Reset(_) | Does::Nothing => {}
        }
    }

    /// What is executed is of claims that never decrease.
    fn executes(&mut self, n: usize, seen: Seen) {
        let Made { by, vehicle, does, .. } = self.calls[n].made;
        let (claims, vehicle, obeyed) = (&self.processes[by].claims, &mut self.vehicles[vehicle], seen.term);
        if !vehicle.is_s_unit {
            return;
        }
        assert!(claims.contains(&obeyed), "call {n} of claims {claims:?} runs, and {obeyed} is obeyed");
        let before = std::mem::replace(&mut vehicle.executed, obeyed);
        assert!(before <= obeyed, "call {n} runs under {obeyed} after one under {before}");
        if vehicle.stores && matches!(does, Does::Move(_)) {
            vehicle.stored = obeyed;
        }
        if before != Claim::NONE && obeyed > before {
            self.reach("newer term obeyed");
        }
    }

    /// A live order is of the term that its vehicle obeys.
    fn term_is_obeyed(&self, n: usize, seen: Seen) {
        let Made { by, vehicle, .. } = self.calls[n].made;
        let (claims, obeyed) = (&self.processes[by].claims, seen.term);
        let is_obeyed = !self.vehicles[vehicle].is_s_unit || claims.contains(&obeyed);
        assert!(is_obeyed, "call {n} of claims {claims:?} is live, and {obeyed} is obeyed");
    }

    /// The handler of a call starts, or would start if its order had not ended: a look at what it does not move.
    pub(crate) fn look_at_others(&self, n: usize) {
        let Made { by, vehicle, does, is_emergency, .. } = self.calls[n].made;
        for actuator in [DRIVE, FORK].into_iter().filter(|actuator| does != Does::Move(*actuator)) {
            let Some((open, watch)) = &self.vehicles[vehicle].moved[actuator].open else { continue };
            let other = &self.calls[*open];
            if other.made.by != by {
                continue;
            }
            let is_live = watch.is_live();
            assert!(is_live, "call {n} runs before the safe hook of {open}, which has ended");
            // An emergency overtakes what was sent before it.
            let was_reported = other.reported.is_some_and(|reported| reported <= n) && !is_emergency;
            assert!(!was_reported, "call {open} was released before {n} was made, and still moves");
        }
    }

    /// What must hold when an order begins, and still when its handler starts.
    fn may_begin(&self, n: usize, actuator: usize, seen: Seen) {
        let Made { by, vehicle, .. } = self.calls[n].made;
        self.term_is_obeyed(n, seen);
        assert!(seen.now < self.end_of(n, actuator, seen.now), "call {n} begins when it is not wanted any more");
        let moved = &self.vehicles[vehicle].moved[actuator];
        assert!(moved.latched.is_none_or(|(_, lifted)| lifted), "call {n} begins while its vehicle is stopped");
        for stop in moved.stops.iter().filter(|stop| self.calls[**stop].made.by == by) {
            assert!(*stop < n, "call {n} begins behind {stop}, which stopped it");
        }
    }

    /// The order of this call is the last that has begun, and was not made safe.
    fn has_order(&self, n: usize, actuator: usize) {
        let moved = &self.vehicles[self.calls[n].made.vehicle].moved[actuator];
        assert!(moved.open.as_ref().is_some_and(|(open, _)| *open == n), "call {n} moves what another one has");
    }

    /// The order of a call has ended.
    fn is_over(&mut self, n: usize) {
        let call = &mut self.calls[n];
        call.is_dead = true;
        if !call.has_started {
            self.reach("dead before its handler");
        }
    }

    /// An order takes the place of an earlier one that was not made safe before.
    fn gives_way(&mut self, before: usize, n: usize, actuator: usize, now: Instant) {
        let Made { vehicle, takes_over, .. } = self.calls[n].made;
        let was_unsafe = std::mem::take(&mut self.vehicles[vehicle].moved[actuator].is_unsafe);
        assert!(!was_unsafe, "call {n} begins before the safe hook of {before}, which was dead");
        let is_over = now >= self.end_of(before, actuator, now);
        assert!(!is_over, "call {n} begins before the safe hook of {before}, whose time is over");
        // An operator and the program of one unit are two.
        let [other, own] = [before, n].map(|n| {
            let Made { by, operator, .. } = self.calls[n].made;
            (self.processes[by].id, operator)
        });
        assert!(other == own || takes_over, "call {n} of {own:?} takes what {before} of {other:?} holds");
        self.is_over(before);
        self.reach(if other == own { "replaced" } else { "taken over" });
    }

    fn stops(&mut self, n: usize, actuators: &'static [usize], seen: Seen) {
        let vehicle = self.calls[n].made.vehicle;
        for actuator in actuators {
            let moved = &mut self.vehicles[vehicle].moved[*actuator];
            // The stop has counted since the call came: a reset made later may have run before its handler.
            let since = seen.stopped[*actuator].expect("what stops is noted");
            let lifted = moved.reset_made.is_some_and(|made| since < made);
            assert!(seen.latched[*actuator] || lifted, "{n} stops, and latches nothing");
            let open = moved.open.as_ref().map(|(open, _)| *open).filter(|_| !lifted);
            assert_eq!(open, None, "{n} stops before the safe hook of what moves has run");
            moved.latched = Some((since, lifted));
            moved.stops.push(n);
        }
        self.reach(if actuators.len() == 1 { "stopped in part" } else { "stopped" });
    }

    /// The vehicle is about to stop itself.
    pub(crate) fn stops_itself(&mut self, vehicle: usize, actuator: usize, now: Instant) {
        self.vehicles[vehicle].moved[actuator].latched = Some((now, false));
        self.reach("stopped by itself");
    }

    /// The handler of a reset says whether it may be.
    pub(crate) fn resets(&mut self, n: usize, actuators: &[usize]) {
        let Made { vehicle, at, .. } = self.calls[n].made;
        self.reset_made(vehicle, actuators, at);
    }

    /// The vehicle is about to reset itself.
    pub(crate) fn resets_itself(&mut self, vehicle: usize, actuator: usize, now: Instant) {
        self.reset_made(vehicle, &[actuator], now);
        self.reach("reset by itself");
    }

    fn reset_made(&mut self, vehicle: usize, actuators: &[usize], at: Instant) {
        for actuator in actuators {
            let moved = &mut self.vehicles[vehicle].moved[*actuator];
            moved.reset_made = moved.reset_made.max(Some(at));
            let Some((since, lifted)) = &mut moved.latched else { continue };
            let is_later = *since < at;
            *lifted |= is_later;
            self.reach(if is_later { "reset" } else { "reset too old" });
        }
    }

    /// The application has finished what a call moves, if that call's order still has it.
    pub(crate) fn finish(&mut self, n: usize, actuator: usize) {
        let Made { vehicle, .. } = self.calls[n].made;
        let moved = &mut self.vehicles[vehicle].moved[actuator];
        if moved.open.take_if(|(open, _)| *open == n).is_some() {
            moved.is_unsafe = false;
            self.calls[n].is_dead = true;
            self.reach("finished");
        }
    }

    /// A safe hook runs.
    pub(crate) fn hook(&mut self, vehicle: usize, actuator: usize, seen: Seen) {
        let moved = &mut self.vehicles[vehicle].moved[actuator];
        moved.is_unsafe = false;
        let is_stopped = moved.latched.is_some_and(|(_, lifted)| !lifted) || seen.latched[actuator];
        let Some((open, watch)) = moved.open.take() else { return };
        assert!(!watch.is_live(), "the safe hook of another order runs while {open} moves");
        self.is_over(open);
        if is_stopped {
            self.reach("order ended by a stop");
        }
        if self.calls[open].ended.is_none()
            && self.end_of(open, actuator, seen.now) <= seen.now + Duration::from_millis(3)
        {
            self.reach("ended by time");
        }
    }

    /// A handler has tried to change something for its order.
    pub(crate) fn commit(&mut self, n: usize, actuator: usize, done: bool, seen: Seen) {
        if done {
            self.moves(n, actuator, seen);
            self.reach("committed");
        } else {
            self.calls[n].is_dead = true;
            self.reach("commit refused");
        }
    }

    /// The loop of an order looks whether to go on, and does nothing else; whether it is to look again.
    pub(crate) fn looks(&mut self, n: usize, actuator: usize, is_live: bool, seen: Seen) -> bool {
        let vehicle = self.calls[n].made.vehicle;
        let moved = &mut self.vehicles[vehicle].moved[actuator];
        let is_stopped = moved.latched.is_some_and(|(_, lifted)| !lifted);
        assert!(
            !is_stopped || seen.latched[actuator],
            "what stopped the vehicle is gone without a reset made after it"
        );
        if is_live {
            self.moves(n, actuator, seen);
            self.reach("moved");
            return true;
        }
        self.calls[n].is_dead = true;
        let is_open = moved.open.as_ref().is_some_and(|(open, _)| *open == n);
        if is_open {
            let was_unsafe = std::mem::replace(&mut moved.is_unsafe, true);
            assert!(!was_unsafe, "the order of {n} was dead {PULSE:?} ago, and its safe hook has not run");
        }
        is_open
    }

    /// Something moves for a call.
    fn moves(&mut self, n: usize, actuator: usize, seen: Seen) {
        let end = self.end_of(n, actuator, seen.now);
        assert!(
            seen.now < end,
            "call {n} moves at {:?}, and was not wanted from {end:?} on: {:?}",
            seen.now,
            self.calls[n].made
        );
        assert!(!self.calls[n].is_dead, "call {n} moves, and its order had ended");
        self.has_order(n, actuator);
        let Made { vehicle, .. } = self.calls[n].made;
        let moved = &self.vehicles[vehicle].moved[actuator];
        let is_stopped = moved.latched.is_some_and(|(_, lifted)| !lifted);
        assert!(!is_stopped && !seen.latched[actuator], "call {n} moves what is stopped");
        self.term_is_obeyed(n, seen);
    }
}
