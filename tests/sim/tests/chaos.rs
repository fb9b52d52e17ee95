//! Everything at once: a manager and vehicles drawn from a seed, under all faults that the network knows, with few buffers, full
//! tables and clocks about to wrap. What must hold is judged all the time, and that all is well again once the faults are over. A
//! seed that fails is run again with fewer and fewer faults, and tells which ones it takes.
//!
//! `cargo xtask chaos` runs many seeds, and plants bugs.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::rc::Rc;

use cara_core::config::{Constraints, Priority};
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::host::connections::LinkCounter;
use cara_core::random::Random;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use cara_sim::{
    Action, Actuator, Fault, FaultCounts, FaultPlan, LeaseWatch, Service, Storing, UnitHandle, World, for_each_seed,
};

const LEASE: Duration = Duration::from_millis(400);
/// A manager shows so often that it runs.
const PULSE: Duration = Duration::from_millis(10);
/// All is judged so often, besides what handlers and callers judge.
const STEP: Duration = Duration::from_millis(50);
/// All are back this long after the last fault: a link that leads nowhere is noticed, and searches come seldom by then.
const RECOVERS: Duration = Duration::from_secs(60);
/// The longest until a link that leads nowhere is noticed.
const NOTICED: Duration = Duration::from_secs(10);
/// What is sent on a link that nothing disturbs has arrived by then.
const ARRIVES: Duration = Duration::from_millis(100);
/// Broadcasts of one unit within ten seconds.
const BROADCASTS: u64 = 25;

const fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// How large a run is.
#[derive(Clone, Copy)]
struct Size {
    vehicles: u32,
    /// How long faults begin.
    lasts: Duration,
}

impl Size {
    fn new() -> Self {
        let number = |name: &str| std::env::var(name).ok().and_then(|number| number.parse().ok());
        let vehicles = number("CARA_CHAOS_NODES").map_or(3, |nodes: u64| nodes.saturating_sub(1).max(1) as u32);
        Self { vehicles, lasts: Duration::from_secs(number("CARA_CHAOS_SECONDS").unwrap_or(20)) }
    }
}

/// What callers want and what happens at vehicles.
#[derive(Default)]
struct Judge {
    /// Lives of the manager, each with when it showed last that it runs.
    lives: Vec<Instant>,
    /// How often each unit has started.
    started: BTreeMap<Identity, usize>,
    /// What each call is, by its number.
    calls: Vec<Call>,
    /// The call that stopped all that a vehicle moves, by the number of the vehicle.
    stopped: BTreeMap<u32, usize>,
    /// The last call that moved an actuator, by the number of the vehicle and the function.
    ordered: BTreeMap<(u32, &'static str), usize>,
    /// Since when all links have been live, with nothing that disturbs them.
    calm: Option<Instant>,
    reached: BTreeMap<&'static str, u64>,
    /// Callers make no more calls.
    is_over: bool,
}

struct Call {
    life: usize,
    /// When it was made, and by when it has its outcome.
    times: (Instant, Instant),
    runs: u32,
    outcomes: u32,
    /// From when on its caller does not want it.
    ended: Option<Instant>,
    /// When its caller said so, in time of calm.
    released: Option<Instant>,
}

impl Judge {
    fn reach(&mut self, what: &'static str) {
        *self.reached.entry(what).or_default() += 1;
    }

    fn starts_living(&mut self, unit: &UnitHandle) {
        *self.started.entry(unit.identity()).or_default() += 1;
    }

    fn make(&mut self, now: Instant, timeout: Duration) -> usize {
        let life = self.lives.len() - 1;
        self.calls.push(Call { life, times: (now, now + timeout), runs: 0, outcomes: 0, ended: None, released: None });
        self.calls.len() - 1
    }

    /// A handler starts.
    fn starts(&mut self, number: usize) {
        let call = self.calls.get_mut(number).expect("nobody has made this call");
        call.runs += 1;
        assert_eq!(call.runs, 1, "call {number} runs twice");
        self.reach("run");
    }

    /// A caller learns what has become of its call.
    fn outcome(&mut self, number: usize) {
        let call = &mut self.calls[number];
        call.outcomes += 1;
        assert_eq!(call.outcomes, 1, "call {number} has two outcomes");
    }

    /// Something moves for a call.
    fn moves(&mut self, vehicle: u32, number: usize, now: Instant) {
        let call = &self.calls[number];
        let pulse = self.lives[call.life];
        let wanted = call.ended.map_or(pulse, |ended| ended.min(pulse)) + LEASE + PULSE;
        let wanted = call.released.map_or(wanted, |released| released + ARRIVES);
        assert!(
            now <= wanted,
            "vehicle {vehicle} moves at {now:?} for call {number}, which was wanted until {wanted:?}"
        );
        assert!(!self.stopped.contains_key(&vehicle), "vehicle {vehicle} moves while it is stopped");
        self.reach("moved");
    }

    /// A call that waits for its outcome for too long, while its caller runs.
    fn forgotten(&self, manager: &UnitHandle, now: Instant) -> Option<usize> {
        let life = self.lives.len().checked_sub(1)?;
        let awake = manager.suspended_until().max(self.lives[life]);
        let late = |call: &Call| {
            call.life == life && call.outcomes == 0 && call.times.1.max(manager.suspended_until()) + STEP < now
        };
        let runs = manager.is_running() && awake + STEP >= now && manager.suspended_until() + STEP < now;
        self.calls.iter().position(late).filter(|_| runs)
    }
}

type Shared = Rc<RefCell<Judge>>;

fn number_of(parameters: &ParametersView) -> usize {
    parameters.variable::<i64>("n").expect("the core checked it") as usize
}

fn vehicle(unit: &UnitHandle, number: u32, judge: &Shared) {
    judge.borrow_mut().starts_living(unit);
    judge.borrow_mut().stopped.remove(&number);
    let of = |judge: &Shared| Rc::clone(judge);
    let double = of(judge);
    let double = Service::new(move |_, parameters| {
        let n = number_of(parameters);
        double.borrow_mut().starts(n);
        parameters.set_value("n", 2 * n as i64).expect("it is an int");
        Ok(())
    });
    let moves = |function| {
        // The call whose order the safe hook has not ended.
        let (starts, judge, moving) = (of(judge), of(judge), Rc::new(Cell::new(None)));
        let hook = Rc::clone(&moving);
        let actuator = Actuator::new(move |_| hook.set(None));
        let service = Service::new(move |call, parameters| {
            let n = number_of(parameters);
            starts.borrow_mut().starts(n);
            let is_live = call.lease.as_ref().is_some_and(LeaseWatch::is_live);
            assert!(is_live, "the handler of {function} {n} starts, and its order has ended");
            Ok(())
        });
        // Of orders that end before their handlers as well.
        let service = service.on_order(move |call, parameters| {
            let (n, judge, unit) = (number_of(parameters), of(&judge), call.unit.clone());
            let earlier = judge.borrow_mut().ordered.insert((number, function), n);
            assert!(earlier < Some(n), "{function} {n} begins after {earlier:?}, which was made later");
            let (watch, moving) = (call.lease.clone().expect("it is an order"), Rc::clone(&moving));
            moving.set(Some(n));
            call.unit.spawn(async move {
                while watch.is_live() {
                    judge.borrow_mut().moves(number, n, unit.now());
                    unit.sleep(PULSE).await;
                }
                for _ in 0..100 {
                    unit.sleep(PULSE).await;
                    assert!(!watch.is_live(), "the order of call {n} lives again");
                    assert_ne!(moving.get(), Some(n), "no hook has run for call {n}");
                }
            });
        });
        service.moves(&actuator, LEASE)
    };
    let halt = of(judge);
    let halt = Service::new(move |_, parameters| {
        let (mut judge, n) = (halt.borrow_mut(), number_of(parameters));
        judge.starts(n);
        judge.stopped.insert(number, n);
        judge.reach("stopped");
        Ok(())
    });
    let go_on = of(judge);
    let go_on = Service::new(move |_, parameters| {
        let (mut judge, n) = (go_on.borrow_mut(), number_of(parameters));
        judge.starts(n);
        // One that was made before a stop does not undo it.
        if judge.stopped.get(&number).is_some_and(|stop| *stop < n) {
            judge.stopped.remove(&number);
        }
        judge.reach("reset");
        Ok(())
    });
    let services = [
        ("double(n: int) -> (n: int)", double),
        ("drive(n: int)", moves("drive")),
        ("lift(n: int)", moves("lift")),
        ("halt(n: int)", halt.stops_all().priority(Priority::Emergency)),
        ("go_on(n: int)", go_on.resets_all()),
    ];
    for (signature, service) in services {
        unit.my_function_list().add_service(signature, service).expect("there is room");
    }
    unit.publish_my_function_list().expect("it runs");
}

fn manager(unit: &UnitHandle, judge: &Shared, vehicles: u32, seed: u64) {
    judge.borrow_mut().starts_living(unit);
    judge.borrow_mut().lives.push(unit.now());
    let life = judge.borrow().lives.len() - 1;
    let (pulse, shows) = (Rc::clone(judge), unit.clone());
    unit.spawn(async move {
        loop {
            pulse.borrow_mut().lives[life] = shows.now();
            shows.sleep(PULSE).await;
        }
    });
    for number in 0..vehicles {
        let random = Random::new(seed ^ (u64::from(number) << 32) ^ unit.now().as_micros());
        let caller = Caller { unit: unit.clone(), judge: Rc::clone(judge), peer: identity(number), random };
        unit.spawn(caller.calls());
    }
}

fn identity(number: u32) -> Identity {
    Identity::s_unit("agv", 10 + number).expect("a name has 1 to 32 bytes")
}

struct Caller {
    unit: UnitHandle,
    judge: Shared,
    peer: Identity,
    random: Random,
}

impl Caller {
    async fn calls(mut self) {
        loop {
            let pause = millis(1 + self.random.below(200));
            self.unit.sleep(pause).await;
            if self.judge.borrow().is_over {
                return;
            }
            match self.random.below(12) {
                0 => {
                    // Together with what the stop overtakes.
                    let earlier = ["go_on", "drive", "lift", "double"][self.random.below(4) as usize];
                    self.spawn_call(earlier);
                    self.call("halt").await;
                }
                1 | 2 => self.call("go_on").await,
                3..6 => self.moves().await,
                // More at a time than anybody has room for.
                6 if self.random.below(8) == 0 => (0..80).for_each(|_| self.spawn_call("double")),
                _ => self.call("double").await,
            }
        }
    }

    fn options(&mut self) -> RequestOptions {
        let priority = [None, Some(Priority::Low), Some(Priority::High)][self.random.below(3) as usize];
        let timeout = Some(millis(20 + self.random.below(1_500)));
        RequestOptions { timeout, priority, ..RequestOptions::default() }
    }

    fn spawn_call(&mut self, function: &'static str) {
        let options = self.options();
        let (unit, judge, peer) = (self.unit.clone(), Rc::clone(&self.judge), self.peer.clone());
        self.unit.spawn(async move {
            call(&unit, &judge, &peer, function, options).await;
        });
    }

    async fn call(&mut self, function: &str) {
        // Each has the class of its function, which for a stop is the highest.
        let options = RequestOptions { priority: None, ..self.options() };
        call(&self.unit, &self.judge, &self.peer, function, options).await;
    }

    async fn moves(&mut self) {
        let function = if self.random.below(2) == 0 { "drive" } else { "lift" };
        if self.random.below(4) == 0 {
            self.spawn_call(function);
        }
        let options = RequestOptions { renew: Renew::Process, ..self.options() };
        let n = call(&self.unit, &self.judge, &self.peer, function, options).await;
        let span = millis(self.random.below(2_000));
        self.unit.sleep(span).await;
        let released = self.unit.release(&self.peer, function);
        let (mut judge, now) = (self.judge.borrow_mut(), self.unit.now());
        judge.calls[n].ended.get_or_insert(now);
        judge.calls[n].released = judge.calm.filter(|_| released.is_ok()).map(|_| now);
        judge.reach(if released.is_ok() { "released" } else { "not released" });
    }
}

/// Makes a call, and judges what comes of it. Its number.
async fn call(unit: &UnitHandle, judge: &Shared, peer: &Identity, function: &str, options: RequestOptions) -> usize {
    let n = judge.borrow_mut().make(unit.now(), options.timeout.unwrap_or_default());
    let mut parameters = Parameters::<64>::sized();
    parameters.add_int("n", 1).expect("there is room");
    parameters.set_value("n", n as i64).expect("it is an int");
    let outcome = unit.block_request_with(peer, function, &mut parameters, options).await;
    let mut judge = judge.borrow_mut();
    judge.outcome(n);
    match outcome {
        Ok(()) => {
            let wanted = if function == "double" { 2 * n } else { n };
            assert_eq!(number_of(&parameters), wanted, "call {n} has the answer of another one");
            assert_eq!(judge.calls[n].runs, 1, "call {n} was answered, and has not run");
            judge.reach("answered");
        }
        Err(_) => {
            assert_eq!(number_of(&parameters), n, "call {n} failed, and changed its parameters");
            judge.calls[n].ended = Some(unit.now());
            judge.reach("failed");
        }
    }
    n
}

/// What is known of a unit from the step before.
#[derive(Default)]
struct Before {
    claim: Claim,
    stored: Claim,
    started: Option<usize>,
    searches: u64,
    /// Broadcasts of the last ten seconds, each with how many.
    sent: Vec<(Instant, u64)>,
}

struct Run {
    world: World,
    judge: Shared,
    manager: UnitHandle,
    vehicles: Vec<UnitHandle>,
    buffers: usize,
    before: Vec<Before>,
}

impl Run {
    fn units(&self) -> impl Iterator<Item = &UnitHandle> {
        std::iter::once(&self.manager).chain(&self.vehicles)
    }

    fn new(seed: u64, size: Size) -> Self {
        let world = if seed % 4 == 3 { World::secured(seed) } else { World::new(seed) };
        let seed = world.seed();
        let mut random = Random::new(seed ^ 0xC4A0_5EED);
        let judge = Shared::default();
        let buffers = [3, 4, 16][random.below(3) as usize];
        // Just enough places for all.
        let constraints = Constraints { maximum_nodes: size.vehicles as u16, ..Constraints::M_UNIT };
        let program = Rc::clone(&judge);
        let new = world.m_unit("manager", 1).constraints(constraints).message_buffers(buffers);
        let new = new.clock(ahead(&mut random)).storing(storing(&mut random));
        let manager = new.program(move |unit| manager(unit, &program, size.vehicles, seed)).start();
        let vehicle = |number| {
            let program = Rc::clone(&judge);
            let new = world.s_unit("agv", 10 + number).joins("manager", 1).message_buffers(buffers);
            let new = new.calls_running(1 + random.below(3) as usize).clock(ahead(&mut random));
            let new = new.storing(storing(&mut random));
            new.program(move |unit| vehicle(unit, number, &program)).start()
        };
        let vehicles: Vec<_> = (0..size.vehicles).map(vehicle).collect();
        let before = (0..=vehicles.len()).map(|_| Before::default()).collect();
        Self { world, judge, manager, vehicles, buffers, before }
    }

    /// The faults of this seed.
    fn faults(&self, size: Size) -> Vec<(Duration, Action)> {
        let (seed, hosts) = (self.world.seed(), self.units().map(UnitHandle::host).collect::<Vec<_>>());
        let plan = if seed % 2 == 0 { FaultPlan::mild(seed) } else { FaultPlan::harsh(seed) };
        plan.over(size.lasts).actions(&hosts)
    }

    fn step(&mut self) {
        self.world.run_for(STEP);
        let now = self.world.now();
        let forgotten = self.judge.borrow().forgotten(&self.manager, now);
        assert_eq!(forgotten, None, "a call has no outcome at {now:?}");
        for (unit, before) in std::iter::once(&self.manager).chain(&self.vehicles).zip(&mut self.before) {
            if !unit.is_running() {
                continue;
            }
            assert!(unit.free_buffers() <= self.buffers, "{} has more buffers than it was given", unit.identity());
            let stored = unit.stored_claim().map_or(Claim::NONE, |tagged| tagged.claim);
            assert!(stored >= before.stored, "{} stores {stored} after {}", unit.identity(), before.stored);
            assert!(unit.claim() >= stored, "{} obeys {} and has stored {stored}", unit.identity(), unit.claim());
            before.stored = stored;
            let lives = self.judge.borrow().started.get(&unit.identity()).copied();
            if before.started == lives {
                let claim = unit.claim();
                assert!(claim >= before.claim, "{} obeys {claim} after {}", unit.identity(), before.claim);
            } else {
                before.searches = 0;
            }
            (before.claim, before.started) = (unit.claim(), lives);
            let searches =
                unit.node_counted(NodeCounter::WhoHasSent) + unit.node_counted(NodeCounter::AnnounceBroadcast);
            before.sent.push((now, searches - before.searches));
            before.searches = searches;
            before.sent.retain(|(at, _)| *at + Duration::from_secs(10) > now);
            let sent = before.sent.iter().map(|(_, sent)| sent).sum::<u64>();
            assert!(sent <= BROADCASTS, "{} has sent {sent} broadcasts within ten seconds", unit.identity());
        }
    }

    /// With faults over, all join, a call is answered, and what was taken is given back.
    fn recovers(&mut self) {
        let start = self.world.now();
        let all = |run: &Self| run.manager.nodes_offering("double").len() == run.vehicles.len();
        // A link that leads nowhere counts until that is noticed.
        let mut back = start;
        while self.world.now() < back + NOTICED {
            assert!(self.world.now() < start + RECOVERS, "not all are back: {:?}", self.manager.s_units());
            self.step();
            if !all(self) {
                back = self.world.now();
            }
        }
        // A full table leaves calls for the time that they have.
        self.judge.borrow_mut().calm = Some(self.world.now());
        (0..60).for_each(|_| self.step());
        let number = |unit: &UnitHandle, counter| unit.counted(counter);
        let sum = |counter| self.units().map(|unit| number(unit, counter)).sum::<u64>();
        let ran = self.judge.borrow().reached.get("run").copied().unwrap_or_default();
        let (sent, received) = (sum(LinkCounter::RequestsSent), sum(LinkCounter::RequestsReceived));
        assert!(ran <= received, "{ran} calls have run, and {received} were received");
        let repeated = sum(LinkCounter::RequestsRepeated);
        assert!(received <= sent + repeated, "{received} requests were received, {sent} sent, {repeated} repeated");
        // With all links live, whose end would give all back.
        self.judge.borrow_mut().is_over = true;
        let buffers = self.buffers;
        let is_idle =
            |unit: &UnitHandle| (unit.calls_held(), unit.calls_in_flight(), unit.free_buffers()) == (0, 0, buffers);
        let (manager, vehicles) = (&self.manager, &self.vehicles);
        let all_idle = |_: &World| std::iter::once(manager).chain(vehicles).all(is_idle);
        let idle = self.world.run_until(all_idle, Duration::from_secs(10));
        assert!(idle, "what was taken is not given back");
        assert_eq!(self.manager.s_units().len(), self.vehicles.len(), "a link has ended without a fault");
    }
}

/// How far the clock of a unit is ahead: some pass 2^32 ms while they run.
fn ahead(random: &mut Random) -> Duration {
    match random.below(2) {
        0 => millis((1 << 32) - random.below(40_000)),
        _ => Duration::from_micros(random.below(1 << 42)),
    }
}

/// Some disks fail, and some hang.
fn storing(random: &mut Random) -> Storing {
    [Storing::Fails, Storing::Hangs, Storing::Works, Storing::Works][random.below(4) as usize]
}

/// Runs a seed with those of its faults that are `kept`.
fn run(seed: u64, size: Size, kept: &dyn Fn(usize) -> bool) -> (BTreeMap<&'static str, u64>, FaultCounts) {
    let mut run = Run::new(seed, size);
    let faults = run.faults(size);
    let end = faults.last().map_or(Duration::ZERO, |(at, _)| *at);
    for (_, (at, action)) in faults.into_iter().enumerate().filter(|(number, _)| kept(*number)) {
        run.world.network(|network| network.schedule(network.now() + at, action));
    }
    let end = run.world.now() + end + Duration::from_secs(1);
    while run.world.now() < end {
        run.step();
    }
    run.recovers();
    let counts = run.world.counts();
    let judge = Rc::clone(&run.judge);
    drop(run);
    (std::mem::take(&mut judge.borrow_mut().reached), counts)
}

fn fails(seed: u64, size: Size, kept: &[usize]) -> bool {
    let kept = |number: usize| kept.contains(&number);
    catch_unwind(AssertUnwindSafe(|| run(seed, size, &kept))).is_err()
}

/// Drops halves, quarters and so on of what is `kept` while the rest still `fails`.
fn shrunk(mut kept: Vec<usize>, fails: impl Fn(&[usize]) -> bool) -> Vec<usize> {
    let mut size = kept.len().div_ceil(2);
    while size > 0 {
        let mut at = 0;
        while at < kept.len() {
            let fewer: Vec<_> =
                kept.iter().enumerate().filter(|(i, _)| *i < at || *i >= at + size).map(|(_, n)| *n).collect();
            if fails(&fewer) { kept = fewer } else { at += size }
        }
        size /= 2;
    }
    kept
}

/// What a seed that fails takes.
fn explain(seed: u64, size: Size) -> String {
    let faults = Run::new(seed, size).faults(size);
    let kept = shrunk((0..faults.len()).collect(), |kept| fails(seed, size, kept));
    let mut text = format!("of {} faults, it takes {}:\n", faults.len(), kept.len());
    for number in kept {
        let (at, action) = &faults[number];
        let _ = writeln!(text, "  {at:?}: {action:?}");
    }
    let (nodes, seconds) = (size.vehicles + 1, size.lasts.as_millis() / 1_000);
    let _ = write!(text, "CARA_SIM_SEED={seed} CARA_CHAOS_NODES={nodes} CARA_CHAOS_SECONDS={seconds} ");
    let _ = writeln!(text, "cargo test --release -p cara-sim --test chaos whatever");
    text
}

#[test]
fn whatever_fails_nothing_is_lost() {
    let size = Size::new();
    let ends = for_each_seed(4, |seed| {
        catch_unwind(AssertUnwindSafe(|| run(seed, size, &|_| true))).unwrap_or_else(|panic| {
            // It takes many runs.
            if std::env::var_os("CARA_CHAOS_UNEXPLAINED").is_none() {
                println!("seed {seed}: {}", explain(seed, size));
            }
            resume_unwind(panic)
        })
    });
    let (count, mut reached, mut faults) = (ends.len(), BTreeMap::<_, u64>::new(), FaultCounts::default());
    for (run, injected) in ends {
        faults += injected;
        run.into_iter().for_each(|(what, times)| *reached.entry(what).or_default() += times);
    }
    println!("{count} seeds: {reached:?}; faults: {faults}");
    for what in ["answered", "failed", "moved", "stopped", "reset", "released"] {
        assert!(count == 1 || reached.contains_key(what), "never {what}: {reached:?}");
    }
    // A few seeds do not have all.
    let missing: Vec<Fault> = faults.missing().collect();
    assert!(count < 20 || missing.is_empty(), "never injected: {missing:?}");
}

#[test]
fn a_failure_is_shrunk_to_what_it_takes() {
    let takes = |kept: &[usize]| [3, 17].iter().all(|wanted| kept.contains(wanted));
    assert_eq!(shrunk((0..40).collect(), takes), [3, 17]);
}
