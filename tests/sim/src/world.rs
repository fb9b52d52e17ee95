//! Whole fleets: units with the real core inside, on the virtual network.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::future::Future;
use std::panic::resume_unwind;
use std::pin::pin;
use std::rc::Rc;
use std::sync::{Mutex, PoisonError};
use std::task::{Context, Poll, Waker};

use cara_core::config::Mode;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::time::{Duration, Instant};

use crate::event::HostId;
use crate::faults::FaultCounts;
use crate::network::Network;
use crate::plan::{Crash, FaultPlan};
use crate::queue::Queue;

mod actuator;
mod audited;
mod builder;
mod driving;
mod events;
mod functions;
mod handle;
mod keys;
mod links;
mod looking;
mod mail;
mod replies;
mod requests;
mod service;
mod state;
mod streams;
mod tasks;

pub use actuator::{Actuator, Heart};
pub use builder::NewUnit;
pub use events::{LogEvent, UnitEvent};
pub use functions::MyFunctionList;
pub use handle::{Peer, UnitHandle};
pub use keys::Ring;
pub use replies::CallError;
pub use requests::{Hold, Watched};
pub use service::{BoxedParameters, LeaseWatch, Outcome, Served, Service, boxed_parameters};
pub use state::Storing;
pub use streams::Sample;

use audited::Seals;
use replies::Promise;
use state::UnitState;
use tasks::{Job, Owner, Tasks};

/// The environment variable that replays one seed.
const SEED: &str = "CARA_SIM_SEED";
/// The environment variable that says how many seeds a run takes.
const SEEDS: &str = "CARA_SIM_SEEDS";
/// The environment variable that says which of them is the first.
const FIRST: &str = "CARA_SIM_FIRST";
/// Longest virtual time that a blocking call of the world may take.
const PATIENCE: Duration = Duration::from_secs(3_600);
/// Steps at one instant after which a run counts as stuck.
const STEPS_AT_ONCE: u32 = 1_000_000;

/// A fleet and its network, on one virtual clock.
///
/// Units are added with [`Self::m_unit`] and [`Self::s_unit`] and are used through [`UnitHandle`]s. Nothing moves but
/// in the methods that say so: [`Self::run_for`], [`Self::run_until`], [`Self::block_on`], [`Self::block_request`].
///
/// If a test panics, its seed is printed; with `CARA_SIM_SEED=…` in the environment every world takes that seed.
pub struct World {
    shared: Rc<Shared>,
    seed: u64,
    stuck: (Instant, u32),
}

/// What the world, its units' handles and their futures share.
struct Shared {
    inner: RefCell<Inner>,
    tasks: RefCell<Tasks>,
}

struct Inner {
    network: Network,
    /// By host.
    units: Vec<UnitState>,
    sleepers: Queue<(HostId, Promise<()>)>,
    /// Of the units to come.
    mode: Mode,
    /// What all units have sealed with.
    seals: Seals,
    /// Safe hooks, and what hears of orders that have begun, in the order in which it happened: they run before anything else.
    of_orders: VecDeque<Box<dyn FnOnce()>>,
    /// Programs that start, and hooks of events: they run next.
    urgent: VecDeque<Box<dyn FnOnce()>>,
    spawned: Vec<(Owner, Job)>,
}

/// The seeds of a run over many: 0 to `count`, or the one in `CARA_SIM_SEED`. `CARA_SIM_SEEDS` replaces the count, for
/// quick and for long runs, and `CARA_SIM_FIRST` the 0, for parts of a long one.
///
/// ```
/// for seed in cara_sim::seeds(3) {
///     let world = cara_sim::World::new(seed);
///     assert_eq!(world.seed(), seed);
/// }
/// ```
pub fn seeds(count: u64) -> impl Iterator<Item = u64> {
    match number_in_environment(SEED) {
        Some(seed) => seed..seed.saturating_add(1),
        None => {
            let first = number_in_environment(FIRST).unwrap_or_default();
            first..first.saturating_add(number_in_environment(SEEDS).unwrap_or(count))
        }
    }
}

/// Runs `run` for each of the [`seeds`], on all processors, and returns the results in the order of the seeds.
///
/// # Panics
/// When one of the runs does; its world has printed its seed.
pub fn for_each_seed<R: Send>(count: u64, run: impl Fn(u64) -> R + Sync) -> Vec<R> {
    let queue = Mutex::new(seeds(count));
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
    let work = || std::iter::from_fn(next).map(|seed| (seed, run(seed))).collect::<Vec<_>>();
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let mut results: Vec<_> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        workers.into_iter().flat_map(|worker| worker.join().unwrap_or_else(|panic| resume_unwind(panic))).collect()
    });
    results.sort_by_key(|(seed, _)| *seed);
    results.into_iter().map(|(_, result)| result).collect()
}

fn number_in_environment(name: &str) -> Option<u64> {
    std::env::var(name).ok()?.parse().ok()
}

impl World {
    /// An empty world; `CARA_SIM_SEED` in the environment overrides `seed`.
    pub fn new(seed: u64) -> Self {
        Self::of_mode(seed, Mode::Plain)
    }

    /// The same with secured units. Units of one fleet have keys for each other by default.
    pub fn secured(seed: u64) -> Self {
        Self::of_mode(seed, Mode::Secured)
    }

    /// An empty world of either mode.
    pub fn of_mode(seed: u64, mode: Mode) -> Self {
        let seed = number_in_environment(SEED).unwrap_or(seed);
        let inner = Inner {
            network: Network::new(seed),
            units: Vec::new(),
            sleepers: Queue::new(),
            mode,
            seals: Seals::default(),
            of_orders: VecDeque::new(),
            urgent: VecDeque::new(),
            spawned: Vec::new(),
        };
        let shared = Shared { inner: RefCell::new(inner), tasks: RefCell::default() };
        Self { shared: Rc::new(shared), seed, stuck: (Instant::START, 0) }
    }

    /// The seed that replays this run.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// A manager to be started: connects to many nodes.
    pub fn m_unit(&self, name: &str, id: u32) -> NewUnit {
        NewUnit::m_unit(&self.shared, name, id)
    }

    /// A vehicle to be started: connects to the one manager that it [`NewUnit::joins`].
    pub fn s_unit(&self, name: &str, id: u32) -> NewUnit {
        NewUnit::s_unit(&self.shared, name, id)
    }

    /// The virtual time.
    pub fn now(&self) -> Instant {
        self.network(|network| network.now())
    }

    /// Lends the network, to change paths and to inject faults.
    pub fn network<R>(&self, act: impl FnOnce(&mut Network) -> R) -> R {
        act(&mut self.shared.inner.borrow_mut().network)
    }

    /// Frames and datagrams that were sealed, each with a key and number of its own: the run ends when two have the same.
    pub fn sealed(&self) -> usize {
        self.shared.with(|inner| inner.seals.count())
    }

    /// What was injected so far.
    pub fn counts(&self) -> FaultCounts {
        self.network(|network| *network.counts())
    }

    /// Equal for equal runs.
    pub fn trace_hash(&self) -> u64 {
        self.network(|network| network.trace_hash())
    }

    // --- running

    /// Runs for a span of virtual time.
    pub fn run_for(&mut self, span: Duration) {
        let limit = self.now() + span;
        while self.step(limit) {}
    }

    /// Runs until `condition` holds, at most for `limit` of virtual time; whether it held.
    #[must_use = "false when the limit came first"]
    pub fn run_until(&mut self, condition: impl Fn(&Self) -> bool, limit: Duration) -> bool {
        let limit = self.now() + limit;
        loop {
            if condition(self) {
                return true;
            }
            if !self.step(limit) {
                return condition(self);
            }
        }
    }

    /// Runs until a future is over, and returns what it gives.
    ///
    /// # Panics
    /// After an hour of virtual time, which nothing in a fleet may take.
    pub fn block_on<T>(&mut self, future: impl Future<Output = T>) -> T {
        let mut future = pin!(future);
        let mut context = Context::from_waker(Waker::noop());
        let limit = self.now() + PATIENCE;
        loop {
            if let Poll::Ready(value) = future.as_mut().poll(&mut context) {
                return value;
            }
            assert!(self.step(limit), "nothing ends what the world waits for");
        }
    }

    /// The paper's synchronous request: runs the world until the reply updates `parameters`, or the call fails.
    pub fn block_request(
        &mut self,
        unit: &UnitHandle,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &mut ParametersView,
    ) -> Result<(), Error> {
        self.block_on(unit.block_request(peer, function, parameters))
    }

    /// One hook, one turn of a future or one event; `false` with the clock at `limit` when nothing is due before.
    fn step(&mut self, limit: Instant) -> bool {
        let now = self.now();
        self.stuck = if self.stuck.0 == now { (now, self.stuck.1 + 1) } else { (now, 0) };
        assert!(self.stuck.1 < STEPS_AT_ONCE, "the world is stuck at {now:?}");
        self.shared.step(limit)
    }

    // --- faults

    /// Schedules a plan's faults for all units.
    pub fn inject(&self, plan: FaultPlan) {
        self.network(|network| {
            let hosts: Vec<HostId> = network.hosts().collect();
            plan.schedule(network, &hosts);
        });
    }

    /// Ends a unit's life now; its state is lost.
    pub fn crash(&mut self, unit: &UnitHandle, crash: Crash) {
        self.network(|network| network.crash(unit.host(), crash));
        self.settle();
    }

    /// Begins another life of a crashed unit: a new epoch, and its program from the start.
    pub fn restart(&mut self, unit: &UnitHandle) {
        self.network(|network| network.restart(unit.host()));
        self.settle();
    }

    /// The unit sees and does nothing for `span`, as on a laptop that is closed; what it has missed comes all at once
    /// after that.
    pub fn suspend(&mut self, unit: &UnitHandle, span: Duration) {
        self.network(|network| network.suspend(unit.host(), span));
    }

    /// Does what is due at this very instant.
    fn settle(&mut self) {
        let now = self.now();
        while self.step(now) {}
    }
}

impl Drop for World {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("replay this run with {SEED}={}", self.seed);
        }
        // Futures may use the world while they are dropped, so they go first.
        let jobs = self.shared.tasks.borrow_mut().take_all();
        drop(jobs);
        let hooks = {
            let mut inner = self.shared.inner.borrow_mut();
            [std::mem::take(&mut inner.of_orders), std::mem::take(&mut inner.urgent)]
        };
        drop(hooks);
    }
}

impl Shared {
    /// Lends the inner world; what it has spawned is taken over after that.
    fn with<R>(&self, act: impl FnOnce(&mut Inner) -> R) -> R {
        let mut inner = self.inner.borrow_mut();
        let result = act(&mut inner);
        let mut tasks = self.tasks.borrow_mut();
        for (owner, job) in inner.spawned.drain(..) {
            tasks.spawn(Some(owner), job);
        }
        result
    }

    /// Runs programs and hooks that are due.
    fn run_urgent(&self) {
        loop {
            let hook = self.inner.borrow_mut().next_hook();
            let Some(hook) = hook else { return };
            hook();
        }
    }

    fn step(self: &Rc<Self>, limit: Instant) -> bool {
        let hook = self.inner.borrow_mut().next_hook();
        if let Some(hook) = hook {
            hook();
            return true;
        }
        let turn = self.tasks.borrow_mut().next_turn();
        if let Some(turn) = turn {
            self.take_turn(turn);
            return true;
        }
        self.advance(limit)
    }

    fn take_turn(&self, turn: tasks::Turn) {
        let Some(turn) = turn.poll() else { return };
        let lives = turn.owner().is_none_or(|owner| self.inner.borrow().is_alive(owner));
        if lives {
            self.tasks.borrow_mut().keep(turn);
        }
    }

    fn advance(self: &Rc<Self>, limit: Instant) -> bool {
        let sleeper = self.inner.borrow().sleepers.next_time();
        let until = sleeper.map_or(limit, |at| at.min(limit));
        let event = self.inner.borrow_mut().network.next_event_until(until);
        if let Some(event) = event {
            let ended = self.with(|inner| inner.dispatch(self, event));
            if let Some(host) = ended {
                let jobs = self.tasks.borrow_mut().take_jobs_of(host);
                drop(jobs);
            }
            return true;
        }
        self.wake_sleepers()
    }

    fn wake_sleepers(&self) -> bool {
        let mut inner = self.inner.borrow_mut();
        let now = inner.network.now();
        let mut woken = false;
        while inner.sleepers.next_time().is_some_and(|at| at <= now) {
            let Some((_, (host, promise))) = inner.sleepers.pop() else { break };
            woken = true;
            let suspended = inner.network.suspended_until(host);
            if suspended > now {
                inner.sleepers.push(suspended, (host, promise));
            } else {
                promise.keep(());
            }
        }
        woken
    }
}

impl Inner {
    fn next_hook(&mut self) -> Option<Box<dyn FnOnce()>> {
        self.of_orders.pop_front().or_else(|| self.urgent.pop_front())
    }

    fn is_alive(&self, owner: Owner) -> bool {
        self.units.get(owner.host.index()).is_some_and(|unit| unit.life == owner.life && unit.machine.is_some())
    }

    fn sleep_until(&mut self, host: HostId, at: Instant) -> Promise<()> {
        let promise = Promise::new();
        self.sleepers.push(at, (host, promise.clone()));
        promise
    }
}
