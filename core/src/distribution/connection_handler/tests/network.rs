//! Any number of units on one network that delays and loses datagrams; links open after one round trip.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::*;

/// An event of a unit. Ordered only to be kept in a heap.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Happening {
    On,
    Off,
    Look,
    Datagram {
        from: usize,
        bytes: Vec<u8>,
    },
    /// A link that `from` dialled reaches the unit.
    Dialled {
        from: usize,
        life: u64,
    },
    /// The link to the manager has ended.
    Lost {
        life: u64,
        reason: u8,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sort {
    Search,
    Answer,
}

pub(super) struct Unit {
    config: NodeConfig<SocketAddr>,
    pub(super) node: Option<Node<InMemory>>,
    nodes: usize,
    /// Increases each time that it is switched on.
    life: u64,
    /// When its last link was opened, and whether it is open.
    pub(super) joined: Option<Instant>,
}

pub(super) struct Network {
    pub(super) units: Vec<Unit>,
    queue: BinaryHeap<Reverse<(Instant, u64, usize, Happening)>>,
    order: u64,
    random: Random,
    pub(super) now: Instant,
    pub(super) loss_percent: u64,
    pub(super) latency: Duration,
    /// How long s_units take to notice that their manager has gone; random.
    pub(super) notice: Duration,
    pub(super) broadcasts: Vec<(Instant, Sort)>,
    pub(super) unicasts: usize,
    pub(super) dials: usize,
}

impl Network {
    pub(super) fn new(seed: u64, loss_percent: u64, latency: Duration) -> Self {
        Self {
            units: Vec::new(),
            queue: BinaryHeap::new(),
            order: 0,
            random: Random::new(seed),
            now: Instant::START,
            loss_percent,
            latency,
            notice: Duration::ZERO,
            broadcasts: Vec::new(),
            unicasts: 0,
            dials: 0,
        }
    }

    /// Adds a unit that is switched on at `on` and knows up to `nodes` others.
    pub(super) fn add(&mut self, config: NodeConfig<SocketAddr>, on: Instant, nodes: usize) -> usize {
        let index = self.units.len();
        self.units.push(Unit { config, node: None, nodes, life: 0, joined: None });
        self.plan(on, index, Happening::On);
        index
    }

    /// A manager and `count` s_units of it, switched on within `spread` of `on`.
    pub(super) fn add_fleet(&mut self, name: &str, count: u32, manager_on: Instant, on: Instant, spread: Duration) {
        let mut depot = m_unit(name, MANAGER_ID);
        depot.constraints.maximum_nodes = 1_000;
        let wanted = Target::Manager(Manager::new(name, MANAGER_ID).unwrap());
        let everybody = count as usize * 2 + 8;
        self.add(depot, manager_on, everybody);
        for id in 1..=count {
            let first = self.units.len() as u32;
            let config = NodeConfig { target: wanted.clone(), ..s_unit("agv", id + first * 10_000) };
            let on = on + self.random.jitter(spread);
            self.add(config, on, 2);
        }
    }

    pub(super) fn switch(&mut self, unit: usize, off: Instant, on: Instant) {
        self.plan(off, unit, Happening::Off);
        self.plan(on, unit, Happening::On);
    }

    fn plan(&mut self, when: Instant, unit: usize, happening: Happening) {
        self.order += 1;
        self.queue.push(Reverse((when, self.order, unit, happening)));
    }

    fn address_of(index: usize, port: u16) -> SocketAddr {
        address(index as u32 + 1, port)
    }

    fn at_address(address: SocketAddr) -> usize {
        let core::net::IpAddr::V4(ip) = address.ip() else { panic!("{address}") };
        (u32::from(ip) & 0xFF_FFFF) as usize - 1
    }

    pub(super) fn run_until(&mut self, end: Instant) {
        while self.queue.peek().is_some_and(|Reverse((when, ..))| *when <= end) {
            let Reverse((now, _, unit, happening)) = self.queue.pop().unwrap();
            self.now = now;
            self.happen(unit, happening);
        }
        self.now = end;
    }

    fn happen(&mut self, index: usize, happening: Happening) {
        let now = self.now;
        match happening {
            Happening::On => self.switch_on(index),
            Happening::Off => self.switch_off(index),
            Happening::Look => {
                if self.units[index].node.as_ref().is_none_or(|node| node.next_deadline() > now) {
                    return;
                }
            }
            Happening::Datagram { from, bytes } => {
                if let Some(node) = &mut self.units[index].node {
                    node.hear(now, Self::address_of(from, 7_001), &bytes);
                }
            }
            Happening::Dialled { from, life } => self.connect(from, index, life),
            Happening::Lost { life, reason } => {
                let reason = if reason == 0 { CloseReason::Reset } else { CloseReason::Refused(Refusal::Full) };
                self.lose(index, life, reason);
            }
        }
        self.work(index);
    }

    fn switch_on(&mut self, index: usize) {
        let unit = &mut self.units[index];
        unit.life += 1;
        let (epoch, seed) = (Epoch(self.random.bits()), self.random.bits());
        let config = NodeConfig { epoch, seed, ..unit.config.clone() };
        unit.node = Some(Node::new(self.now, config, storage(unit.nodes)));
    }

    fn switch_off(&mut self, index: usize) {
        self.units[index].node = None;
        for peer in 0..self.units.len() {
            let unit = &self.units[peer];
            let theirs = unit.node.as_ref().and_then(|node| node.nodes().next());
            if unit.joined.is_some() && theirs.is_some_and(|known| Self::at_address(known.address) == index) {
                let (when, life) = (self.now + self.random.jitter(self.notice), unit.life);
                self.plan(when, peer, Happening::Lost { life, reason: 0 });
            }
        }
    }

    fn lose(&mut self, index: usize, life: u64, reason: CloseReason) {
        let unit = &mut self.units[index];
        if unit.life == life
            && let Some(node) = &mut unit.node
        {
            node.left(self.now, LinkId(0), reason);
            unit.joined = None;
        }
    }

    fn work(&mut self, index: usize) {
        let now = self.now;
        let mut outbox = Outbox::default();
        while let Some(node) = &mut self.units[index].node {
            let Some(action) = node.poll(now, &mut outbox, &Plain) else { break };
            let Command::Dial { to, identity } = action else { panic!("{action:?}") };
            node.dialing(identity.as_ref(), LinkId(0));
            self.dials += 1;
            let life = self.units[index].life;
            self.plan(now + self.latency, Self::at_address(to), Happening::Dialled { from: index, life });
        }
        for bytes in outbox.broadcasts {
            let sort = if matches!(read(&bytes), Datagram::WhoHas(_)) { Sort::Search } else { Sort::Answer };
            self.broadcasts.push((now, sort));
            for to in (0..self.units.len()).filter(|to| *to != index) {
                self.fly(to, index, bytes.clone());
            }
        }
        for (to, bytes) in outbox.sent {
            self.unicasts += 1;
            self.fly(Self::at_address(to), index, bytes);
        }
        if let Some(node) = &self.units[index].node {
            let due = node.next_deadline();
            assert!(due > now, "nothing due remains after a poll");
            if due != Instant::FAR_FUTURE {
                self.plan(due, index, Happening::Look);
            }
        }
    }

    fn fly(&mut self, to: usize, from: usize, bytes: Vec<u8>) {
        if self.units[to].node.is_some() && self.random.below(100) >= self.loss_percent {
            let when = self.now + self.random.jitter(self.latency) + Duration::from_micros(1);
            self.plan(when, to, Happening::Datagram { from, bytes });
        }
    }

    /// Exchanges the hellos of `from` and `to`.
    fn connect(&mut self, from: usize, to: usize, life: u64) {
        let (now, link) = (self.now, LinkId(from as u16));
        if self.units[from].life != life || self.units[from].node.is_none() {
            return;
        }
        let Some(server) = &mut self.units[to].node else {
            let node = self.units[from].node.as_mut().unwrap();
            node.left(now, LinkId(0), CloseReason::DialFailed);
            return self.work(from);
        };
        let ours = server.hello(now, link, 1);
        let dialler = self.units[from].node.as_mut().unwrap();
        let theirs = dialler.hello(now, LinkId(0), 2);
        assert_eq!(dialler.admit(now, LinkId(0), Self::address_of(to, 7_000), &ours), Admission::Accept);
        self.units[from].joined = Some(now);
        let server = self.units[to].node.as_mut().unwrap();
        match server.admit(now, link, Self::address_of(from, 40_000), &theirs) {
            Admission::Accept => {}
            Admission::Refuse(Refusal::Full) => {
                self.plan(now + self.latency, from, Happening::Lost { life, reason: 1 })
            }
            other => panic!("{other:?}"),
        }
        self.work(from);
    }

    /// When each s_unit joined, in order; `None` if one has not.
    pub(super) fn joins(&self) -> Option<Vec<Instant>> {
        let s_units = self.units.iter().filter(|unit| unit.config.identity.role() == Role::SUnit);
        let mut joins: Vec<_> = s_units.map(|unit| unit.joined).collect::<Option<_>>()?;
        joins.sort();
        Some(joins)
    }

    pub(super) fn count(&self, sort: Sort) -> usize {
        self.broadcasts.iter().filter(|(_, other)| *other == sort).count()
    }

    /// The most events of a sorted list within `window`.
    pub(super) fn busiest(times: &[Instant], window: Duration) -> usize {
        let mut first = 0;
        let mut most = 0;
        for (index, time) in times.iter().enumerate() {
            while times[first] + window <= *time {
                first += 1;
            }
            most = most.max(index + 1 - first);
        }
        most
    }

    pub(super) fn broadcast_times(&self) -> Vec<Instant> {
        self.broadcasts.iter().map(|(at, _)| *at).collect()
    }
}
