//! The switch with its boards, and how time passes.

use std::cell::{Cell, RefCell};
use std::future::Future;
use std::net::Ipv4Addr;
use std::rc::Rc;

use cara_core::random::Random;
use cara_core::time::{Duration, Instant};
use cara_embassy::Network;
use cara_ethernet::{FaultCounts, Faults, Mac, Switch};
use cara_sim::Path;
use embassy_net::{Config, Ipv4Cidr, Stack, StackResources, StaticConfigV4};

use crate::clock;
use crate::driver::{Cable, Plug};
use crate::gate::{Gate, Rule};
use crate::tasks::{Job, Task, Tasks};

/// What a poll costs: without it, a task that wakes itself would hold the clock.
const POLL: Duration = Duration::from_micros(4);
/// Sockets of each board.
pub const SOCKETS: usize = 132;
/// Boards are in 10.77.0.0/16.
const PREFIX: u8 = 16;

/// A switch with boards, and their time. The clock restarts with each bench of a thread.
#[derive(Clone)]
pub struct Bench {
    inner: Rc<Inner>,
}

struct Inner {
    switch: Rc<RefCell<Switch>>,
    tasks: RefCell<Tasks>,
    spawned: RefCell<Vec<(usize, Job)>>,
    plugs: RefCell<Vec<Plug>>,
    asleep: RefCell<Vec<Asleep>>,
    random: RefCell<Random>,
    running: Cell<Option<usize>>,
}

/// A board whose tasks are not polled.
struct Asleep {
    board: usize,
    until: Instant,
    /// Those that were woken meanwhile.
    tasks: Vec<Task>,
}

/// A board: its cable, its network stack and its tasks.
#[derive(Clone)]
pub struct Board {
    inner: Rc<Inner>,
    index: usize,
    plug: Plug,
    address: Ipv4Addr,
    config: fn(Ipv4Addr) -> Config,
    network: Network<SOCKETS>,
}

impl Bench {
    /// A bench whose faults and seeds are drawn from `seed`.
    pub fn new(seed: u64) -> Self {
        clock::reset();
        let inner = Inner {
            switch: Rc::new(RefCell::new(Switch::new(seed))),
            tasks: RefCell::default(),
            spawned: RefCell::default(),
            plugs: RefCell::default(),
            asleep: RefCell::default(),
            random: RefCell::new(Random::new(seed ^ 0x00B0_A4D5)),
            running: Cell::new(None),
        };
        Self { inner: Rc::new(inner) }
    }

    /// Another board, with power and an address of its own.
    pub fn board(&self) -> Board {
        self.plug_in(fixed)
    }

    /// Another board, which asks for its address; [`Board::address`] tells none of any use.
    pub fn board_on_dhcp(&self) -> Board {
        self.plug_in(|_| Config::dhcpv4(Default::default()))
    }

    fn plug_in(&self, config: fn(Ipv4Addr) -> Config) -> Board {
        let index = self.inner.plugs.borrow().len();
        let [high, low] = (index as u16 + 1).to_be_bytes();
        let mac = Mac([2, 0, 0, 0, high, low]);
        let port = self.inner.switch.borrow_mut().add_port(mac);
        let switch = Rc::clone(&self.inner.switch);
        let gate = Rc::new(RefCell::new(Gate::new(self.random(u64::MAX))));
        let plug = Plug { switch, port, mac, gate, listener: Rc::default(), is_unnoticed: Rc::default() };
        self.inner.plugs.borrow_mut().push(plug.clone());
        Board::boot(&self.inner, index, plug, Ipv4Addr::new(10, 77, high, low), config)
    }

    /// A random number below `bound`, from the seed.
    pub fn random(&self, bound: u64) -> u64 {
        self.inner.random(bound)
    }

    /// The time.
    pub fn now(&self) -> Instant {
        clock::now()
    }

    /// What happens to frames from now on.
    pub fn set_faults(&self, faults: Faults) {
        self.inner.switch.borrow_mut().set_faults(faults);
    }

    /// What happened to frames so far.
    pub fn counts(&self) -> FaultCounts {
        *self.inner.switch.borrow().counts()
    }

    /// Lets time pass until `condition` holds, at most `limit`; whether it held.
    pub fn run_until(&self, condition: impl Fn() -> bool, limit: Duration) -> bool {
        let end = clock::now() + limit;
        loop {
            if condition() {
                return true;
            }
            if clock::now() >= end {
                return false;
            }
            self.step(end);
        }
    }

    /// Lets a span of time pass.
    pub fn run_for(&self, span: Duration) {
        let _ = self.run_until(|| false, span);
    }

    /// Polls one task, or jumps to what comes next.
    fn step(&self, end: Instant) {
        clock::wake_due();
        self.inner.wake_receivers();
        self.inner.wake_sleepers();
        if let Some(task) = self.inner.next_task() {
            self.inner.poll(task);
            clock::pass(POLL);
            return;
        }
        let plugs = self.inner.plugs.borrow();
        let arrivals = plugs.iter().filter_map(Plug::next_arrival);
        let asleep = self.inner.asleep.borrow();
        let wakings = asleep.iter().map(|asleep| asleep.until);
        let next = arrivals.chain(wakings).chain(clock::next_timer()).min().unwrap_or(end);
        clock::set(next.min(end));
    }
}

impl Inner {
    fn random(&self, bound: u64) -> u64 {
        self.random.borrow_mut().below(bound)
    }

    fn wake_receivers(&self) {
        let now = clock::now();
        let plugs = self.plugs.borrow();
        plugs.iter().filter(|plug| plug.next_arrival().is_some_and(|at| at <= now)).for_each(Plug::wake);
    }

    fn wake_sleepers(&self) {
        let now = clock::now();
        let awake: Vec<Asleep> = self.asleep.borrow_mut().extract_if(.., |asleep| asleep.until <= now).collect();
        for task in awake.into_iter().flat_map(|asleep| asleep.tasks) {
            task.wake();
            self.tasks.borrow_mut().keep(task);
        }
    }

    fn next_task(&self) -> Option<Task> {
        for (board, job) in self.spawned.take() {
            self.tasks.borrow_mut().spawn(board, job);
        }
        loop {
            let task = self.tasks.borrow_mut().next()?;
            let mut asleep = self.asleep.borrow_mut();
            match asleep.iter_mut().find(|asleep| asleep.board == task.board()) {
                Some(asleep) => asleep.tasks.push(task),
                None => return Some(task),
            }
        }
    }

    fn poll(&self, task: Task) {
        let board = task.board();
        self.running.set(Some(board));
        let kept = task.poll();
        // The task may have cut its own board's power.
        if let (Some(task), Some(_)) = (kept, self.running.take()) {
            self.tasks.borrow_mut().keep(task);
        }
    }
}

impl Board {
    fn boot(inner: &Rc<Inner>, index: usize, plug: Plug, address: Ipv4Addr, config: fn(Ipv4Addr) -> Config) -> Self {
        let resources = Box::leak(Box::new(StackResources::<SOCKETS>::new()));
        let (network, mut runner) =
            cara_embassy::network(Cable(plug.clone()), config(address), resources, inner.random(u64::MAX));
        let board = Self { inner: Rc::clone(inner), index, plug, address, config, network };
        board.spawn(async move { runner.run().await });
        board
    }

    /// Begins another life with the same cable and address: a board that was without power.
    pub fn reboot(&self) -> Self {
        self.cut_power();
        self.set_cable(true);
        Self::boot(&self.inner, self.index, self.plug.clone(), self.address, self.config)
    }

    /// Its network, for a unit.
    pub fn network(&self) -> Network<SOCKETS> {
        self.network
    }

    /// Its network stack.
    pub fn stack(&self) -> Stack<'static> {
        self.network.stack()
    }

    /// Its address.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// Runs a task until it ends or the board loses power.
    pub fn spawn(&self, task: impl Future<Output = ()> + 'static) {
        self.inner.spawned.borrow_mut().push((self.index, Box::pin(task)));
    }

    /// Pulls its cable, or plugs it in.
    pub fn set_cable(&self, up: bool) {
        self.inner.switch.borrow_mut().set_link(self.plug.port, up);
        self.plug.wake();
    }

    /// Whether its driver reports the cable, which passes frames all the same.
    pub fn notice_cable(&self, noticed: bool) {
        self.plug.is_unnoticed.set(!noticed);
        self.plug.wake();
    }

    /// Gives it another address while it runs.
    pub fn move_to(&self, address: Ipv4Addr) {
        self.stack().set_config_v4(fixed(address).ipv4);
    }

    /// What happens from now on to the frames that it sends.
    pub fn set_faults(&self, faults: Faults) {
        self.inner.switch.borrow_mut().set_faults_from(self.plug.port, faults);
    }

    /// It does not hear `other` until [`heal`](Self::heal).
    pub fn lose_frames_of(&self, other: &Self) {
        self.plug.gate.borrow_mut().add(Rule { from: other.plug.mac, until: None, tcp_only: false });
    }

    /// What `other` sends to it within `span` comes at the end of it: all, or what TCP sends.
    pub fn hold_frames_of(&self, other: &Self, span: Duration, tcp_only: bool) {
        let until = Some(clock::now() + span);
        self.plug.gate.borrow_mut().add(Rule { from: other.plug.mac, until, tcp_only });
    }

    /// What `other` sends to it comes over this path from now on.
    pub fn set_path_from(&self, other: &Self, path: Path) {
        self.plug.gate.borrow_mut().set_path(other.plug.mac, path);
    }

    /// Resets all its streams, at both ends.
    pub fn reset_streams(&self) {
        let now = clock::now();
        for plug in self.inner.plugs.borrow().iter() {
            let from = (plug.port != self.plug.port).then_some(self.plug.mac);
            plug.gate.borrow_mut().reset(now, from);
        }
    }

    /// It hears everybody again.
    pub fn heal(&self) {
        self.plug.gate.borrow_mut().heal();
    }

    /// Its tasks stand still for a span, while the world goes on.
    pub fn suspend(&self, span: Duration) {
        let until = clock::now() + span;
        self.inner.asleep.borrow_mut().push(Asleep { board: self.index, until, tasks: Vec::new() });
    }

    /// Ends all its tasks, and pulls its cable: nothing is said.
    pub fn cut_power(&self) {
        if self.inner.running.get() == Some(self.index) {
            self.inner.running.set(None);
        }
        self.inner.spawned.borrow_mut().retain(|(board, _)| *board != self.index);
        let asleep: Vec<Asleep> =
            self.inner.asleep.borrow_mut().extract_if(.., |asleep| asleep.board == self.index).collect();
        let tasks = self.inner.tasks.borrow_mut().take_all_of(self.index);
        drop((tasks, asleep));
        self.plug.listener.take();
        self.plug.gate.borrow_mut().clear();
        self.inner.switch.borrow_mut().set_link(self.plug.port, false);
    }
}

fn fixed(address: Ipv4Addr) -> Config {
    let address = Ipv4Cidr::new(address, PREFIX);
    Config::ipv4_static(StaticConfigV4 { address, gateway: None, dns_servers: Default::default() })
}
