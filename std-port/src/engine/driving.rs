//! The unit among those that its threads drive: how it begins, what wakes it, and how the threads let go of it.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use cara_core::config::Mode;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::hello::ClaimReport;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::error::Error;
use cara_core::time::Instant;

use super::Engine;
use super::claims::TakeOver;
use super::worker::Worker;
use crate::clock::Clock;
use crate::error::StartError;
use crate::error::system_refused;
use crate::sys::datagram::Socket;
use crate::sys::epoll::Ready;
use crate::threads::{Driven, Source, ThreadPool, Threads};

/// The threads that drive the unit, and whether they do.
pub(super) struct Driver {
    /// Its own, or those of several units.
    threads: Threads,
    clock: Clock,
    /// No other unit has them.
    own_threads: bool,
    /// The unit's number among those that the threads drive, once it has been started.
    unit_number: OnceLock<u16>,
    /// A manager looks for a live one of its identity before it starts.
    pub(super) asks_for_itself: bool,
    stopping: AtomicBool,
    /// When the unit was made.
    born: Instant,
}

impl Driver {
    pub(super) fn new(threads: Threads, own_threads: bool, asks_for_itself: bool) -> Self {
        let clock = threads.thread_pool().clock;
        let (born, stopping) = (clock.now(), AtomicBool::new(false));
        Self { threads, clock, own_threads, unit_number: OnceLock::new(), asks_for_itself, stopping, born }
    }

    pub(super) const fn clock(&self) -> Clock {
        self.clock
    }

    pub(super) const fn born(&self) -> Instant {
        self.born
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }

    /// The unit stops; whether it did already.
    pub(super) fn stop(&self) -> bool {
        self.stopping.swap(true, Ordering::AcqRel)
    }
}

impl<T: Send + 'static> Engine<T> {
    pub(super) fn thread_pool(&self) -> &Arc<ThreadPool> {
        self.driver.threads.thread_pool()
    }

    pub(super) fn unit_number(&self) -> Option<u16> {
        self.driver.unit_number.get().copied()
    }

    /// Begins to search and to serve, driven by the unit's threads. One that runs already goes on; one that was stopped
    /// does not start again.
    #[cfg(not(feature = "control"))]
    pub(crate) fn start(self: &Arc<Self>) -> Result<(), StartError> {
        self.start_unless(|| None)
    }

    /// Begins, as `start` does, unless a process of this host `holds` what is this unit's, as one does that hangs and
    /// does not say that it runs.
    pub(crate) fn start_unless(self: &Arc<Self>, holds: impl FnOnce() -> Option<PathBuf>) -> Result<(), StartError> {
        if self.is_stopping() {
            return Err(Error::NotRunning.into());
        }
        if self.unit_number().is_some() {
            return Ok(());
        }
        let running = self.running_elsewhere().map_err(system_refused)?;
        if let Some((at, report)) = &running {
            self.may_start_beside(*at, report.as_ref())?;
        }
        let takes_over = self.claims.take_over != TakeOver::No;
        if let Some(path) = (self.driver.asks_for_itself && !takes_over).then(holds).flatten() {
            let (identity, fleet) = self.identity();
            return Err(StartError::SocketHeld { identity, fleet, path });
        }
        self.claim(running.and_then(|(_, report)| report).map_or(Claim::NONE, |report: ClaimReport| report.claim()))?;
        self.thread_pool().start()?;
        let unit_number = self.thread_pool().register(self.clone())?;
        let _ = self.driver.unit_number.set(unit_number);
        self.watch(unit_number).map_err(system_refused)?;
        self.warn_of_plain_mode();
        self.wake_looker();
        self.wake_clock();
        Ok(())
    }

    pub(super) fn identity(&self) -> (Identity, Fleet) {
        let node = &self.hub().hub.node;
        (node.identity().clone(), node.fleet())
    }

    fn warn_of_plain_mode(&self) {
        if self.mode() == Mode::Plain {
            tracing::warn!(
                unit = %self.hub().hub.node.identity(), discovery_port = self.discovery_port(),
                "plain mode, without keys: whoever is on the network can read what this unit says, and speak as any unit"
            );
        }
    }

    fn watch(&self, unit_number: u16) -> std::io::Result<()> {
        for socket in [Socket::Shared, Socket::Own] {
            self.thread_pool().watch(unit_number, Source::Datagrams(socket), self.sockets.datagrams.fd(socket))?;
        }
        self.sockets
            .listener
            .as_ref()
            .map_or(Ok(()), |listener| self.thread_pool().watch(unit_number, Source::Listener, listener))
    }

    /// Something is to be done now, or the time of the next thing has changed.
    pub(super) fn wake_clock(&self) {
        self.wake_clock_at(Instant::START);
    }

    pub(super) fn wake_clock_at(&self, at: Instant) {
        if let Some(unit_number) = self.unit_number() {
            self.thread_pool().wake_at(unit_number, at);
        }
    }

    /// Files and interfaces are looked at now.
    pub(super) fn wake_looker(&self) {
        if let Some(unit_number) = self.unit_number() {
            self.thread_pool().wake_looker(unit_number);
        }
    }

    /// From here on no thread works for the unit any more, except the one that calls.
    pub(super) fn release_threads(&self) {
        for socket in [Socket::Shared, Socket::Own] {
            self.thread_pool().unwatch(self.sockets.datagrams.fd(socket));
        }
        if let Some(listener) = &self.sockets.listener {
            self.thread_pool().unwatch(listener);
        }
        if let Some(unit_number) = self.unit_number() {
            self.thread_pool().leave(unit_number);
        }
        // No thread puts a link there any more.
        self.thread_pool().watched.fetch_sub(self.links.watch.clear(), Ordering::Relaxed);
        if self.driver.own_threads {
            self.thread_pool().stop();
        }
    }
}

impl<T: Send + 'static> Driven for Engine<T> {
    fn ready(&self, ready: Ready, worker: &mut Worker) {
        self.link_ready(ready, worker);
    }

    fn serve_waiting(&self, token: u64, worker: &mut Worker) {
        self.serve_link(token, worker);
    }

    fn keep_time(&self) -> Instant {
        let others = self.poll_node().min(self.go_on_listening());
        let look = self.watch_links(others);
        self.look_at_claims();
        self.poll_links().min(others).min(look).min(self.sound_alarms())
    }

    fn look_around(&self) -> Instant {
        self.watch_interfaces().min(self.watch_keys())
    }

    fn read_datagrams(&self, socket: Socket, buffer: &mut [u8]) {
        let _ = self.datagrams_ready(socket, buffer);
    }

    fn accept(&self) {
        self.connections_ready();
    }
}
