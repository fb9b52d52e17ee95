//! A fleet drawn from a seed: vehicles with a drive and a fork, cranes that everybody may move, managers that take over from
//! each other, a traffic control, and whatever can fail.

use std::cell::{Cell, RefCell};
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::rc::Rc;
use std::task::Poll;

use cara_core::config::{Constraints, Priority};
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{Error, ServiceError};
use cara_core::random::Random;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_sim::{
    Action, Actuator, Crash, Direction, FaultCounts, FaultPlan, Heart, Service, Storing, UnitEvent, UnitHandle, World,
};

use crate::watch::{DRIVE, Does, FORK, LENGTHS, Made, PULSE, Reached, Seen, Wanted, Watch};

/// What a vehicle offers, each with the number of the call.
const FUNCTIONS: [(&str, Does); 8] = [
    ("go", Does::Move(DRIVE)),
    ("dock", Does::Move(DRIVE)),
    ("lift", Does::Move(FORK)),
    ("halt", Does::Stop(&[DRIVE, FORK])),
    ("halt_drive", Does::Stop(&[DRIVE])),
    ("go_on", Does::Reset(&[DRIVE, FORK])),
    ("drive_on", Does::Reset(&[DRIVE])),
    ("note", Does::Nothing),
];
const MOVES: [usize; 3] = [0, 1, 2];
const STOPS: [usize; 3] = [3, 3, 4];
const RESETS: [usize; 3] = [5, 5, 6];
const NOTE: usize = 7;

/// A loop comes round so often, and its heart with it.
const ROUND: Duration = Duration::from_millis(50);
/// The period of hearts.
const PERIOD: Duration = Duration::from_millis(150);
/// Vehicles for each loop of a process.
const EACH: usize = 20;

/// How large a run is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Size {
    pub(crate) vehicles: usize,
    /// Units that try to be the one manager.
    pub(crate) managers: u64,
    pub(crate) lasts: Duration,
}

type Shared = Rc<RefCell<Watch>>;

const fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn between(random: &mut Random, least: u64, most: u64) -> Duration {
    millis(least + random.below(most - least))
}

fn one_in(random: &mut Random, count: u64) -> bool {
    random.below(count) == 0
}

/// Runs the fleet of a seed. Whatever breaks a rule panics, and the world prints the seed.
pub(crate) fn run(seed: u64, size: Size) -> (Reached, FaultCounts) {
    let is_secured = seed % 8 == 7;
    let mut world = if is_secured { World::secured(seed) } else { World::new(seed) };
    // CARA_SIM_SEED may say otherwise.
    let seed = world.seed();
    let mut random = Random::new(seed ^ 0x0DE5_F1EE);
    let watch = Shared::default();
    // One in five is a crane, which any m_unit may move.
    let cranes = size.vehicles.div_ceil(5);
    let vehicles: Rc<[Identity]> = (0..size.vehicles)
        .map(|number| {
            let identity = if number < cranes { Identity::m_unit } else { Identity::s_unit };
            identity(if number < cranes { "crane" } else { "agv" }, 10 + number as u32)
                .expect("a name has 1 to 32 bytes")
        })
        .collect();
    let constraints = Constraints { maximum_nodes: size.vehicles as u16 + 8, ..Constraints::M_UNIT };
    let start = |(number, identity): (usize, &Identity)| {
        let is_crane = number < cranes;
        // Some disks fail, and some hang.
        let storing = match random.below(6) {
            0 => Storing::Fails,
            1 => Storing::Hangs,
            _ => Storing::Works,
        };
        watch.borrow_mut().add_vehicle(!is_crane, is_secured && storing == Storing::Works);
        let (watch, seed) = (Rc::clone(&watch), random.bits());
        let unit = if is_crane {
            world.m_unit(identity.name(), identity.id()).constraints(constraints)
        } else {
            world.s_unit(identity.name(), identity.id()).joins("manager", 1)
        };
        unit.storing(storing).clock(ahead(&mut random)).program(move |unit| vehicle(unit, &watch, number, seed)).start()
    };
    let units: Vec<UnitHandle> = vehicles.iter().enumerate().map(start).collect();
    // The first one is the traffic control; of the managers one runs at first.
    let callers: Vec<(UnitHandle, Rc<Cell<usize>>)> = (0..=size.managers)
        .map(|number| {
            let (name, id) = if number == 0 { ("traffic", 2) } else { ("manager", 1) };
            let (current, seed) = (Rc::new(Cell::new(0)), random.bits());
            let unit = world.m_unit(name, id).constraints(constraints).clock(ahead(&mut random));
            let unit = unit.program({
                let (watch, vehicles, current) = (Rc::clone(&watch), Rc::clone(&vehicles), Rc::clone(&current));
                move |unit| caller(unit, &watch, &current, &vehicles, seed)
            });
            let unit = unit.start();
            let (watch, vehicles, process) = (Rc::clone(&watch), Rc::clone(&vehicles), Rc::clone(&current));
            unit.on_event(move |unit, event| reported(unit, event, &mut watch.borrow_mut(), process.get(), &vehicles));
            if number > 1 {
                unit.stop();
            }
            (unit, current)
        })
        .collect();
    let (traffic, managers) = (&callers[0].0, callers[1..].iter().map(|(unit, _)| unit.clone()).collect::<Vec<_>>());
    let plan = match seed % 4 {
        0 => None,
        3 => Some(FaultPlan::harsh(seed)),
        _ => Some(FaultPlan::mild(seed)),
    };
    if let Some(plan) = plan {
        // Managers crash by their own schedule, for the next start of one takes over.
        world.inject(plan.starting_after(millis(500)).over(size.lasts).without_crashes());
    }
    let mut next = Duration::ZERO;
    let mut now = Duration::ZERO;
    while now < size.lasts {
        if next <= now {
            something_happens(&mut world, &watch, &mut random, &managers, traffic, &units);
            next = now + between(&mut random, 200, 1_500);
        }
        supervise(&mut random, &watch, &managers);
        let (unit, process) = &callers[random.below(callers.len() as u64) as usize];
        let caller = Caller {
            unit: unit.clone(),
            watch: Rc::clone(&watch),
            vehicles: Rc::clone(&vehicles),
            process: process.get(),
            random: Random::new(random.bits()),
        };
        race(&world, caller, &units);
        world.run_for(millis(100));
        now = now + millis(100);
    }
    let counts = world.counts();
    drop(world);
    (watch.take().reached, counts)
}

/// How far the clock of a unit is ahead, another time after each crash: no two are the same, and some pass 2^32 ms while they run.
fn ahead(random: &mut Random) -> Duration {
    match random.below(4) {
        0 => Duration::from_millis((1 << 32) - random.below(20_000)),
        _ => Duration::from_micros(random.below(1 << 42)),
    }
}

/// A manager that has stepped down, or crashed, is started again now and then, and takes over.
fn supervise(random: &mut Random, watch: &Shared, managers: &[UnitHandle]) {
    let chance = if managers.iter().any(UnitHandle::is_running) { 40 } else { 10 };
    let idle: Vec<&UnitHandle> = managers.iter().filter(|manager| !manager.is_running()).collect();
    if !idle.is_empty() && one_in(random, chance) {
        let next = idle[random.below(idle.len() as u64) as usize];
        take_over(random, watch, next);
    }
}

/// With what the managers before it have stored, or on another host, with a store of its own.
fn take_over(random: &mut Random, watch: &Shared, manager: &UnitHandle) {
    if one_in(random, 2) {
        let newest = watch.borrow().newest_term();
        manager.keep_term(newest);
    }
    manager.start();
}

/// What a plan of faults does not know of: managers that hang, crash, come back late and cannot hear each other.
fn something_happens(
    world: &mut World,
    watch: &Shared,
    random: &mut Random,
    managers: &[UnitHandle],
    traffic: &UnitHandle,
    vehicles: &[UnitHandle],
) {
    let pick = |random: &mut Random, units: &[UnitHandle]| units[random.below(units.len() as u64) as usize].clone();
    let running: Vec<UnitHandle> = managers.iter().filter(|manager| manager.is_running()).cloned().collect();
    let crash = if one_in(random, 2) { Crash::PowerCut } else { Crash::Process };
    match random.below(10) {
        0 if !running.is_empty() => {
            let (unit, clock) = (pick(random, &running), ahead(random));
            world.crash(&unit, crash);
            world.network(|network| network.set_clock(unit.host(), clock));
        }
        1 | 2 if !running.is_empty() => {
            let hangs = pick(random, &running);
            world.suspend(&hangs, between(random, 100, 6_000));
            let others = managers.iter().find(|manager| !manager.is_running());
            others.into_iter().for_each(|other| take_over(random, watch, other));
        }
        3 | 4 if !running.is_empty() => {
            // Two managers, neither of which hears of the other: the vehicles have to tell them.
            let (first, span) = (pick(random, &running), between(random, 2_000, 8_000));
            let others: Vec<_> = managers.iter().map(UnitHandle::host).filter(|host| *host != first.host()).collect();
            world.network(|network| network.partition_for(&[first.host()], &others, Direction::Both, span));
            let other = managers.iter().find(|manager| !manager.is_running());
            other.into_iter().for_each(|other| take_over(random, watch, other));
            if one_in(random, 2) {
                world.crash(&pick(random, vehicles), crash);
            }
        }
        5 => {
            let down = between(random, 50, 1_000);
            world.network(|network| network.crash_for(traffic.host(), crash, down));
        }
        _ => {}
    }
    for _ in 0..1 + vehicles.len() / EACH {
        let unit = pick(random, vehicles);
        match random.below(8) {
            0 | 1 => world.suspend(&unit, between(random, 20, 1_500)),
            2 => {
                let down = between(random, 50, 2_000);
                let clock = ahead(random);
                world.network(|network| {
                    network.crash_for(unit.host(), crash, down);
                    network.set_clock(unit.host(), clock);
                });
            }
            _ => {}
        }
    }
    // What is down for no known time comes back sooner or later.
    for unit in vehicles.iter().filter(|unit| !unit.is_running()) {
        if one_in(random, 3) {
            world.restart(unit);
        }
    }
}

/// What is sent one after the other arrives in another order: streams to a vehicle are held, and datagrams pass.
fn race(world: &World, mut caller: Caller, vehicles: &[UnitHandle]) {
    let vehicle = caller.random.below(vehicles.len() as u64) as usize;
    let hangs = caller.unit.suspended_until() > world.now();
    if hangs || !caller.unit.is_running() || !caller.unit.is_connected(&caller.vehicles[vehicle]) {
        return;
    }
    let (from, to, span) = (caller.unit.host(), vehicles[vehicle].host(), between(&mut caller.random, 50, 500));
    world.network(|network| network.inject(Action::FreezeStreams { from, to, span }));
    for function in [caller.one_of(&MOVES), caller.one_of(&RESETS), caller.one_of(&[STOPS[0], STOPS[0], NOTE])] {
        let options = RequestOptions::renewing(Renew::Process);
        caller.request(&Asked { vehicle, function, options, wanted: Wanted::Process });
    }
}

// --- vehicles

fn seen(unit: &UnitHandle, actuators: &[Actuator; 2]) -> Seen {
    let latched = [DRIVE, FORK].map(|actuator| actuators[actuator].latch().is_some());
    let stopped = [DRIVE, FORK].map(|actuator| actuators[actuator].stopped_at(unit));
    Seen { now: unit.now(), term: unit.claim(), latched, stopped }
}

/// One life of a vehicle.
fn vehicle(unit: &UnitHandle, watch: &Shared, number: usize, seed: u64) {
    watch.borrow_mut().started(number);
    // The hooks know the actuators, which have them.
    let known: Rc<RefCell<Option<[Actuator; 2]>>> = Rc::default();
    let actuators = [DRIVE, FORK].map(|actuator| {
        let (watch, known) = (Rc::clone(watch), Rc::downgrade(&known));
        Actuator::new(move |unit| {
            let known = known.upgrade().and_then(|known| known.borrow().clone());
            watch.borrow_mut().hook(number, actuator, seen(unit, &known.expect("the program has made them")));
        })
    });
    *known.borrow_mut() = Some(actuators.clone());
    for (function, does) in FUNCTIONS {
        let service = match does {
            Does::Move(actuator) => mover(watch, number, actuator, &actuators),
            _ => plain(watch, number, does, &actuators),
        };
        let service = match does {
            Does::Stop([one]) => service.stops(&actuators[*one]),
            Does::Stop(_) => service.stops_all().priority(Priority::Emergency),
            Does::Reset([one]) => service.resets(&actuators[*one]),
            Does::Reset(_) => service.resets_all(),
            Does::Move(_) | Does::Nothing => service,
        };
        unit.my_function_list().add_service(&format!("{function}(n: int)"), service).expect("there is room");
    }
    unit.publish_my_function_list().expect("it runs");
    unit.spawn(bumper(
        unit.clone(),
        Rc::clone(watch),
        number,
        actuators,
        known,
        Random::new(seed ^ unit.now().as_micros()),
    ));
}

/// Stops the vehicle now and then, and lets it go on.
async fn bumper(
    unit: UnitHandle,
    watch: Shared,
    number: usize,
    actuators: [Actuator; 2],
    _known: Rc<RefCell<Option<[Actuator; 2]>>>,
    mut random: Random,
) {
    loop {
        unit.sleep(between(&mut random, 500, 6_000)).await;
        let actuator = random.below(2) as usize;
        watch.borrow_mut().stops_itself(number, actuator, unit.now());
        actuators[actuator].inhibit(&unit, 3);
        if one_in(&mut random, 2) {
            unit.sleep(between(&mut random, 1, 1_000)).await;
            watch.borrow_mut().resets_itself(number, actuator, unit.now());
            actuators[actuator].reset(&unit);
        }
    }
}

fn number_of(parameters: &cara_core::distribution::parameters::ParametersView) -> usize {
    parameters.variable::<i64>("n").expect("the core checked it") as usize
}

/// What does not move.
fn plain(watch: &Shared, number: usize, does: Does, actuators: &[Actuator; 2]) -> Service {
    let (watch, actuators) = (Rc::clone(watch), actuators.clone());
    Service::new(move |call, parameters| {
        let (n, mut watch) = (number_of(parameters), watch.borrow_mut());
        watch.handler(n, number, None, seen(&call.unit, &actuators));
        if let Does::Reset(resets) = does {
            if n % 8 == 0 {
                watch.reach("reset refused");
                return Err(ServiceError::NotReady);
            }
            watch.resets(n, resets);
        }
        Ok(())
    })
}

/// What moves: it commits at once, moves while it may, and commits again.
fn mover(watch: &Shared, number: usize, actuator: usize, actuators: &[Actuator; 2]) -> Service {
    let (begun, known) = (Rc::clone(watch), actuators.clone());
    let (watch, all) = (Rc::clone(watch), actuators.clone());
    let service = Service::future(move |call, parameters| {
        let (watch, actuators, n) = (Rc::clone(&watch), all.clone(), number_of(&parameters));
        async move {
            let seen = |unit: &UnitHandle| seen(unit, &actuators);
            let order = call.lease.clone().expect("it has a lease");
            watch.borrow_mut().handler(n, number, Some(&order), seen(&call.unit));
            let commit = || watch.borrow_mut().commit(n, actuator, call.commit(|| ()).is_ok(), seen(&call.unit));
            commit();
            if n % 3 == 0 {
                call.unit.sleep(millis(20 * (n as u64 % 23))).await;
                commit();
            }
            if n % 16 == 1 { Err(ServiceError::NotReady) } else { Ok(parameters) }
        }
    });
    let service = service.moves(&actuators[actuator], LENGTHS[actuator]);
    // The loop looks at orders whose handlers never run, too.
    service.on_order(move |call, parameters| {
        let (n, order) = (number_of(parameters), call.lease.as_ref().expect("it has a lease"));
        begun.borrow_mut().order(n, number, actuator, order, seen(&call.unit, &known));
        call.unit.spawn(moving(Rc::clone(&begun), n, actuator, known.clone(), call.clone()));
    })
}

/// The loop of one order.
async fn moving(watch: Shared, n: usize, actuator: usize, actuators: [Actuator; 2], call: cara_sim::Served) {
    let order = call.lease.clone().expect("it has a lease");
    watch.borrow().look_at_others(n);
    for turn in 0_u64.. {
        call.unit.sleep(PULSE).await;
        if n % 16 == 2 && turn == 40 && order.is_live() {
            assert!(call.unit.end_order(&order), "it is live");
            watch.borrow_mut().finish(n, actuator);
        }
        let (is_live, seen) = (order.is_live(), seen(&call.unit, &actuators));
        if !watch.borrow_mut().looks(n, actuator, is_live, seen) {
            break;
        }
    }
    // What comes much later than its order's end.
    call.unit.sleep(millis(100)).await;
    let done = call.commit(|| ()).is_ok();
    watch.borrow_mut().commit(n, actuator, done, seen(&call.unit, &actuators));
}

// --- callers

/// One life of a manager, or of the traffic control.
fn caller(unit: &UnitHandle, watch: &Shared, current: &Cell<usize>, vehicles: &Rc<[Identity]>, seed: u64) {
    let process = watch.borrow_mut().process(unit.identity().id(), unit.claim(), unit.now());
    current.set(process);
    let mut random = Random::new(seed ^ unit.now().as_micros());
    let mut caller = Caller {
        unit: unit.clone(),
        watch: Rc::clone(watch),
        vehicles: Rc::clone(vehicles),
        process,
        random: Random::new(0),
    };
    for _ in 0..2 + vehicles.len() / EACH {
        caller.random = Random::new(random.bits());
        unit.spawn(caller.clone().commands());
    }
    unit.spawn(caller.pulse());
}

/// What a caller is told of its calls.
fn reported(unit: &UnitHandle, event: &UnitEvent, watch: &mut Watch, process: usize, vehicles: &[Identity]) {
    let number = |peer: &Identity| vehicles.iter().position(|vehicle| vehicle == peer);
    match event {
        UnitEvent::Left { peer, .. } => {
            let Some(vehicle) = number(peer) else { return };
            watch.give_up_all(process, unit.now(), false, |made| made.vehicle == vehicle);
        }
        UnitEvent::LeaseEnded { peer, call, why, .. } => {
            let Some(vehicle) = number(peer) else { return };
            watch.order_ended(process, vehicle, call.0, *why, unit.now());
        }
        UnitEvent::RequestFailed { peer, call, error } => {
            watch.reach(word_of(*error));
            let Some(n) = number(peer).and_then(|vehicle| watch.named(process, vehicle, call.0)) else { return };
            watch.give_up(n, unit.now(), true);
        }
        UnitEvent::Fenced { .. } => watch.reach("fenced"),
        UnitEvent::Raised { claim } => watch.raised(process, *claim),
        _ => {}
    }
}

fn word_of(error: Error) -> &'static str {
    match error {
        Error::Held { operator: true, .. } => "held by an operator",
        Error::Held { .. } => "held",
        Error::Inhibited { .. } => "inhibited",
        Error::Busy => "busy",
        Error::Expired => "expired",
        Error::TimedOut => "timed out",
        Error::Interrupted => "interrupted",
        Error::NotConnected => "not connected",
        Error::Service(_) => "service failed",
        _ => "another error",
    }
}

#[derive(Clone)]
struct Caller {
    unit: UnitHandle,
    watch: Shared,
    vehicles: Rc<[Identity]>,
    process: usize,
    random: Random,
}

impl Caller {
    async fn pulse(self) {
        loop {
            self.watch.borrow_mut().pulse(self.process, self.unit.now());
            self.unit.sleep(PULSE).await;
        }
    }

    /// A loop that beats its heart, and commands something now and then.
    async fn commands(mut self) {
        let (mut heart, mut number) = self.new_heart();
        loop {
            heart.beat();
            self.watch.borrow_mut().beat(number, self.unit.now());
            self.command(&heart, number);
            match self.random.below(60) {
                0 => {
                    self.watch.borrow_mut().reach("heart hung");
                    let span = between(&mut self.random, 100, 1_500);
                    self.unit.sleep(span).await;
                }
                1 => {
                    drop(heart);
                    let of_it = |made: &Made| matches!(made.wanted, Wanted::Heart(heart) if heart == number);
                    let mut watch = self.watch.borrow_mut();
                    watch.give_up_all(self.process, self.unit.now(), true, of_it);
                    watch.reach("heart dropped");
                    drop(watch);
                    (heart, number) = self.new_heart();
                }
                _ => self.unit.sleep(ROUND).await,
            }
        }
    }

    fn new_heart(&self) -> (Heart, usize) {
        (self.unit.heart(PERIOD), self.watch.borrow_mut().heart(self.unit.now()))
    }

    fn one_of(&mut self, functions: &[usize]) -> usize {
        functions[self.random.below(functions.len() as u64) as usize]
    }

    fn command(&mut self, heart: &Heart, number: usize) {
        let vehicle = self.random.below(self.vehicles.len() as u64) as usize;
        let peer = self.vehicles[vehicle].clone();
        if !self.unit.is_connected(&peer) {
            return;
        }
        let is_stopped = self.watch.borrow().is_stopped(vehicle);
        let function = match self.random.below(37) {
            0..4 => return self.release(vehicle),
            4..6 => self.one_of(&STOPS),
            6..8 => self.one_of(&RESETS),
            8..20 if is_stopped => self.one_of(&RESETS),
            8..12 => NOTE,
            _ => self.one_of(&MOVES),
        };
        let (renew, wanted) = match self.random.below(3) {
            0 => (Renew::Never, Wanted::Once),
            1 => (Renew::Process, Wanted::Process),
            _ => (heart.renew(), Wanted::Heart(number)),
        };
        let options = RequestOptions {
            timeout: Some(between(&mut self.random, 50, 1_500)),
            renew,
            take_over: one_in(&mut self.random, 3),
            operator: one_in(&mut self.random, 4),
            ..RequestOptions::new()
        };
        let asked = Asked { vehicle, function, options, wanted };
        match self.random.below(3) {
            0 => self.request(&asked),
            1 => self.wait(asked, false),
            // What is not renewed ends by itself.
            _ => self.wait(asked, !matches!(wanted, Wanted::Once)),
        }
    }

    fn release(&mut self, vehicle: usize) {
        let (function, _) = FUNCTIONS[self.one_of(&MOVES)];
        let reported = self.unit.release(&self.vehicles[vehicle], function).is_ok();
        let mut watch = self.watch.borrow_mut();
        watch.give_up_all(self.process, self.unit.now(), reported, |made| {
            made.vehicle == vehicle && made.function == function
        });
        watch.reach("released");
    }

    fn make(&self, asked: &Asked) -> (usize, Parameters) {
        let (function, does) = FUNCTIONS[asked.function];
        let n = self.watch.borrow_mut().make(Made {
            by: self.process,
            at: self.unit.now(),
            vehicle: asked.vehicle,
            function,
            does,
            wanted: asked.wanted,
            takes_over: asked.options.take_over,
            operator: asked.options.operator,
            is_emergency: function == "halt",
        });
        let mut parameters = Parameters::new();
        parameters.add_int("n", 1).expect("there is room");
        parameters.set_value("n", n as i64).expect("it is an int");
        (n, parameters)
    }

    /// A request without an answer.
    fn request(&self, asked: &Asked) {
        let (n, parameters) = self.make(asked);
        let (function, _) = FUNCTIONS[asked.function];
        let sent = self.unit.request_with(&self.vehicles[asked.vehicle], function, &parameters, asked.options);
        let mut watch = self.watch.borrow_mut();
        match sent {
            Ok(id) => watch.name(n, id.0),
            Err(error) => {
                watch.reach(word_of(error));
                watch.give_up(n, self.unit.now(), true);
            }
        }
    }

    /// A call that is waited for, for as long as its caller pleases; one that is held ends when that does not want it any more.
    fn wait(&mut self, asked: Asked, holds: bool) {
        let (patience, caller) = (between(&mut self.random, 20, 2_000), self.clone());
        self.unit.spawn(async move {
            let (n, mut parameters) = caller.make(&asked);
            let (unit, peer, (function, _)) =
                (&caller.unit, &caller.vehicles[asked.vehicle], FUNCTIONS[asked.function]);
            let ended = if holds {
                let hold = within(unit, patience, unit.hold(peer, function, &mut parameters, asked.options)).await;
                match hold {
                    Some(Ok(hold)) => {
                        unit.sleep(patience).await;
                        drop(hold);
                        Some("hold dropped")
                    }
                    Some(Err(error)) => Some(word_of(error)),
                    None => Some("given up"),
                }
            } else {
                let options = asked.options;
                let call = unit.block_request_with(peer, function, &mut parameters, options);
                match within(unit, patience, call).await {
                    Some(Ok(())) => None,
                    Some(Err(error)) => Some(word_of(error)),
                    None => Some("given up"),
                }
            };
            if let Some(why) = ended {
                let mut watch = caller.watch.borrow_mut();
                watch.reach(why);
                watch.give_up(n, unit.now(), true);
            }
        });
    }
}

/// A call to be made.
#[derive(Clone, Copy)]
struct Asked {
    vehicle: usize,
    /// Of [`FUNCTIONS`].
    function: usize,
    options: RequestOptions,
    wanted: Wanted,
}

/// What a future gives within a time; it is dropped behind that.
async fn within<T>(unit: &UnitHandle, patience: Duration, future: impl Future<Output = T>) -> Option<T> {
    let (mut future, mut sleep) = (pin!(future), pin!(unit.sleep(patience)));
    poll_fn(|context| match future.as_mut().poll(context) {
        Poll::Ready(value) => Poll::Ready(Some(value)),
        Poll::Pending => sleep.as_mut().poll(context).map(|()| None),
    })
    .await
}
