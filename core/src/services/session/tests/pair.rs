//! Two sessions joined by pipes in memory, on a clock that jumps to the next deadline.

use std::vec::Vec;

use super::net::Net;
use super::setup::Setup;
use super::side::{Side, context};
use crate::distribution::parameters::ParametersView;
use crate::error::{CloseReason, Error};
use crate::services::Context;
use crate::time::{Duration, Instant};

/// A manager and an AGV on one network.
pub(super) type Pair = PairOf<true>;

/// The same, for units that have everything or only serve. When it is dropped, all buffers must be back in the pools.
pub(super) struct PairOf<const WHOLE: bool> {
    pub(super) manager: Side<WHOLE>,
    pub(super) agv: Side<WHOLE>,
    elapsed: Duration,
}

impl<const WHOLE: bool> PairOf<WHOLE> {
    /// Two ends whose connection is open; nothing has been sent.
    pub(super) fn connected(setup: &Setup) -> Self {
        Self::prepared(setup, |_| ())
    }

    /// The same, with `prepare` applied before the connection opens.
    pub(super) fn prepared(setup: &Setup, prepare: impl FnOnce(&mut Self)) -> Self {
        let mut pair =
            Self { manager: Side::new(setup, false, 1), agv: Side::new(setup, true, 2), elapsed: Duration::ZERO };
        prepare(&mut pair);
        pair.manager.session.connected(context!(pair.manager));
        pair.agv.session.connected(context!(pair.agv));
        pair
    }

    /// Two ends that have admitted each other.
    pub(super) fn with(setup: &Setup) -> Self {
        let mut pair = Self::connected(setup);
        pair.settle();
        assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
        pair
    }

    /// The same with the default setup.
    pub(super) fn live() -> Self {
        Self::with(&Setup::default())
    }

    /// A pair whose AGV has published `pos_info() -> (position: int[2])`, which answers 3, 4.
    pub(super) fn with_position() -> Self {
        let mut pair = Self::live();
        pair.agv.offer("pos_info() -> (position: int[2])", |pos| pos.set_value("position", [3, 4]));
        pair.publish();
        pair
    }

    /// Publishes all functions of the AGV, and lets the manager process the list.
    pub(super) fn publish(&mut self) {
        self.agv.publish();
        self.settle();
    }

    /// Delivers and processes everything that can be at this time.
    pub(super) fn settle(&mut self) {
        for _ in 0..100_000 {
            if !self.step() {
                return;
            }
        }
        panic!("the two ends never come to rest");
    }

    /// Delivers once what is in the pipes, and lets both ends work; returns whether anything moved.
    pub(super) fn step(&mut self) -> bool {
        let (to_agv, datagrams_to_agv) = self.manager.net.deliver();
        let (to_manager, datagrams_to_manager) = self.agv.net.deliver();
        let mut moved = !to_agv.is_empty() || !to_manager.is_empty();
        for (side, bytes) in [(&mut self.agv, to_agv), (&mut self.manager, to_manager)] {
            side.received += bytes.len();
            side.inbox.extend(bytes);
            if side.session.wants_to_write() && side.net.has_room() {
                side.session.writable(context!(side));
                moved = true;
            }
        }
        moved |= self.agv.work(datagrams_to_agv);
        moved |= self.manager.work(datagrams_to_manager);
        moved
    }

    /// Lets time pass, deadline by deadline.
    pub(super) fn run(&mut self, span: Duration) {
        let end = self.elapsed + span;
        self.settle();
        for _ in 0..100_000 {
            let next = self.next_deadline();
            if next > end {
                break;
            }
            self.set_elapsed(next.max(self.elapsed));
            self.settle();
        }
        assert!(self.next_deadline() > end, "a deadline passes and stays");
        self.jump(end - self.elapsed);
    }

    /// Lets time pass in one step, as on a host that was suspended.
    pub(super) fn jump(&mut self, span: Duration) {
        self.set_elapsed(self.elapsed + span);
        self.settle();
    }

    /// Lets time pass for the manager only, as while the AGV's host is suspended. The AGV gets what was sent meanwhile
    /// afterwards.
    pub(super) fn suspend_agv(&mut self, span: Duration) {
        let end = self.elapsed + span;
        let base = Instant::START + self.manager.base;
        while self.manager.session.deadline() <= base + end {
            self.manager.now = self.manager.session.deadline();
            self.manager.work(Vec::new());
        }
        self.jump(span);
    }

    fn set_elapsed(&mut self, elapsed: Duration) {
        self.elapsed = elapsed;
        for side in [&mut self.manager, &mut self.agv] {
            side.now = Instant::START + side.base + elapsed;
        }
    }

    fn next_deadline(&self) -> Duration {
        let due = |side: &Side<WHOLE>| side.session.deadline().since(Instant::START + side.base);
        due(&self.manager).min(due(&self.agv))
    }

    /// A blocking request of the manager.
    pub(super) fn block_request(&mut self, function: &str, parameters: &mut ParametersView) -> Result<(), Error> {
        let id = self.manager.call(function, parameters)?;
        self.run(self.manager.session.constraints().request_timeout);
        let results = self.manager.outcome(id).unwrap()?;
        parameters.copy_from(results)
    }

    /// The connection fails.
    pub(super) fn cut(&mut self) {
        for side in [&mut self.manager, &mut self.agv] {
            side.session.disconnected(CloseReason::Reset);
            side.net = Net::default();
        }
        self.settle();
    }
}

impl<const WHOLE: bool> Drop for PairOf<WHOLE> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            return;
        }
        for side in [&mut self.manager, &mut self.agv] {
            side.end();
            assert!(side.session.is_ended());
            assert_eq!(side.pool.free(), side.buffers, "a buffer leaked");
            let closed = side.count(|event| matches!(event, super::super::Event::Closed(_)));
            assert!(closed <= 1, "closed {closed} times");
        }
    }
}
