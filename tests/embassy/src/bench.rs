//! The switch with its boards, and how time passes.

use std::cell::{Cell, RefCell};
use std::future::Future;
use std::net::Ipv4Addr;
use std::rc::Rc;

use cara_core::random::Random;
use cara_core::time::{Duration, Instant};
use cara_ethernet::{FaultCounts, Faults, Mac, PortId, Switch};
use embassy_net::{Config, Ipv4Cidr, Stack, StackResources, StaticConfigV4};

use crate::clock;
use crate::driver::{Cable, Listener};
use crate::tasks::{Job, Task, Tasks};

/// What a poll costs: without it, a task that wakes itself would hold the clock.
const POLL: Duration = Duration::from_micros(4);
/// Sockets of each board.
const SOCKETS: usize = 132;
/// Boards are in 10.77.0.0/16.
const PREFIX: u8 = 16;

/// A switch with boards, and their time. The clock begins anew with each bench of a thread.
#[derive(Clone)]
pub struct Bench {
    inner: Rc<Inner>,
}

struct Inner {
    switch: Rc<RefCell<Switch>>,
    tasks: RefCell<Tasks>,
    spawned: RefCell<Vec<(usize, Job)>>,
    boards: RefCell<Vec<(PortId, Listener)>>,
    random: RefCell<Random>,
    running: Cell<Option<usize>>,
}

/// A board: its cable, its network stack and its tasks.
#[derive(Clone)]
pub struct Board {
    inner: Rc<Inner>,
    index: usize,
    port: PortId,
    address: Ipv4Addr,
    stack: Stack<'static>,
}

impl Bench {
    /// A bench whose faults and seeds are drawn from `seed`.
    pub fn new(seed: u64) -> Self {
        clock::reset();
        let inner = Inner {
            switch: Rc::new(RefCell::new(Switch::new(seed))),
            tasks: RefCell::default(),
            spawned: RefCell::default(),
            boards: RefCell::default(),
            random: RefCell::new(Random::new(seed ^ 0x00B0_A4D5)),
            running: Cell::new(None),
        };
        Self { inner: Rc::new(inner) }
    }

    /// Another board, with power and an address of its own.
    pub fn board(&self) -> Board {
        let number = self.inner.boards.borrow().len() as u16 + 1;
        let [high, low] = number.to_be_bytes();
        let address = Ipv4Addr::new(10, 77, high, low);
        let config =
            StaticConfigV4 { address: Ipv4Cidr::new(address, PREFIX), gateway: None, dns_servers: Default::default() };
        self.board_with(address, Config::ipv4_static(config))
    }

    /// Another board with a network configuration of one's choice; `address` is what [`Board::address`] tells.
    pub fn board_with(&self, address: Ipv4Addr, config: Config) -> Board {
        let index = self.inner.boards.borrow().len();
        let [high, low] = (index as u16 + 1).to_be_bytes();
        let mac = Mac([2, 0, 0, 0, high, low]);
        let port = self.inner.switch.borrow_mut().add_port(mac);
        let listener = Listener::default();
        self.inner.boards.borrow_mut().push((port, Rc::clone(&listener)));
        let switch = Rc::clone(&self.inner.switch);
        let cable = Cable { switch, port, mac, listener };
        let resources = Box::leak(Box::new(StackResources::<SOCKETS>::new()));
        let (stack, mut runner) = embassy_net::new(cable, config, resources, self.random(u64::MAX));
        let board = Board { inner: Rc::clone(&self.inner), index, port, address, stack };
        board.spawn(async move { runner.run().await });
        board
    }

    /// A random number below `bound`, from the seed.
    pub fn random(&self, bound: u64) -> u64 {
        self.inner.random.borrow_mut().below(bound)
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
        self.wake_receivers();
        if let Some(task) = self.inner.next_task() {
            self.inner.poll(task);
            clock::pass(POLL);
            return;
        }
        let boards = self.inner.boards.borrow();
        let arrivals = boards.iter().filter_map(|(port, listener)| {
            let listens = listener.borrow().is_some();
            listens.then(|| self.inner.switch.borrow().next_arrival(*port)).flatten()
        });
        let next = arrivals.chain(clock::next_timer()).min().unwrap_or(end);
        clock::set(next.min(end));
    }

    fn wake_receivers(&self) {
        let now = clock::now();
        for (port, listener) in self.inner.boards.borrow().iter() {
            if self.inner.switch.borrow().next_arrival(*port).is_some_and(|at| at <= now)
                && let Some(waker) = listener.take()
            {
                waker.wake();
            }
        }
    }
}

impl Inner {
    fn next_task(&self) -> Option<Task> {
        for (board, job) in self.spawned.take() {
            self.tasks.borrow_mut().spawn(board, job);
        }
        self.tasks.borrow_mut().next()
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
    /// Its network stack.
    pub fn stack(&self) -> Stack<'static> {
        self.stack
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
        self.inner.switch.borrow_mut().set_link(self.port, up);
        if let Some(waker) = self.inner.boards.borrow().get(self.index).and_then(|(_, listener)| listener.take()) {
            waker.wake();
        }
    }

    /// What happens from now on to the frames that it sends.
    pub fn set_faults(&self, faults: Faults) {
        self.inner.switch.borrow_mut().set_faults_from(self.port, faults);
    }

    /// Ends all its tasks, and pulls its cable: nothing is said. Another life is another board.
    pub fn cut_power(&self) {
        if self.inner.running.get() == Some(self.index) {
            self.inner.running.set(None);
        }
        self.inner.spawned.borrow_mut().retain(|(board, _)| *board != self.index);
        let tasks = self.inner.tasks.borrow_mut().take_all_of(self.index);
        drop(tasks);
        self.inner.boards.borrow()[self.index].1.take();
        self.inner.switch.borrow_mut().set_link(self.port, false);
    }
}
