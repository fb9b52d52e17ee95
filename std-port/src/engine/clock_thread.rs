//! The thread that keeps time: timers of links and of the node, datagrams, and new connections. It runs no handlers.

use std::sync::Arc;

use cara_core::distribution::connection_handler::Sorted;
use cara_core::error::Error;
use cara_core::host::mailman::LinkId;
use cara_core::time::Instant;
use core::net::SocketAddr;

use super::{Engine, lock, notice};
use crate::sys::datagram::Socket;
use crate::sys::epoll::{Epoll, Events, Interest};
use crate::sys::stream::Accepted;

const WAKER: u64 = 0;
const SHARED: u64 = 1;
const OWN: u64 = 2;
const LISTENER: u64 = 3;
/// Longest datagram that counts, and one byte more.
const DATAGRAM: usize = 2048;
/// Datagrams and connections that are taken in a row before timers are looked at again.
const BATCH: usize = 256;

impl<T: Send + 'static> Engine<T> {
    pub(super) fn start_clock(self: &Arc<Self>) -> std::io::Result<()> {
        let epoll = Epoll::new()?;
        epoll.add(&self.clock_waker, WAKER, Interest::READ_LEVEL)?;
        epoll.add(self.datagrams.fd(Socket::Shared), SHARED, Interest::READ_LEVEL)?;
        epoll.add(self.datagrams.fd(Socket::Own), OWN, Interest::READ_LEVEL)?;
        if let Some(listener) = &self.listener {
            epoll.add(listener, LISTENER, Interest::READ_LEVEL)?;
        }
        let engine = self.clone();
        let thread = std::thread::Builder::new().name("cara-clock".into());
        let thread = thread.spawn(move || engine.keep_time(&epoll))?;
        lock(&self.threads).push(thread);
        Ok(())
    }

    fn keep_time(&self, epoll: &Epoll) {
        let mut events = Events::new(8);
        let mut buffer = vec![0; DATAGRAM];
        while !self.is_stopping() {
            let next = self.poll_links().min(self.poll_node()).min(self.relieve_stays());
            let wait = (next != Instant::FAR_FUTURE).then(|| next.since(self.clock.now()));
            if let Err(error) = epoll.wait(&mut events, wait) {
                tracing::error!(%error, "waiting for time failed");
                return;
            }
            for ready in events.iter() {
                match ready.token {
                    SHARED => self.read_datagrams(Socket::Shared, &mut buffer),
                    OWN => self.read_datagrams(Socket::Own, &mut buffer),
                    LISTENER => self.accept(),
                    _ => {
                        self.clock_waker.reset();
                    }
                }
            }
        }
    }

    /// Polls every link that is due; returns when the next one is.
    fn poll_links(&self) -> Instant {
        loop {
            let due = {
                let mut timers = lock(&self.timers);
                match timers.pop_due(self.clock.now()) {
                    Some(due) => due,
                    None => return timers.next().unwrap_or(Instant::FAR_FUTURE),
                }
            };
            let Some(link) = self.link(LinkId(due as u16)) else { continue };
            let mut state = link.lock();
            state.timer = Instant::FAR_FUTURE;
            if state.is_paused() {
                self.feed(&link, &mut state, &mut [], None, None);
                if state.session.has_next_call() {
                    self.hand_over(&link);
                }
            }
            self.settle(&link, state);
        }
    }

    fn read_datagrams(&self, socket: Socket, buffer: &mut [u8]) {
        for _ in 0..BATCH {
            let Some((count, from)) = self.datagrams.receive(socket, buffer) else { return };
            self.datagram(from, buffer.get(..count).unwrap_or_default());
        }
    }

    fn datagram(&self, from: SocketAddr, bytes: &[u8]) {
        let sorted = lock(&self.node).node.datagram(self.clock.now(), from, bytes);
        let Sorted::Session { link, nonce, body } = sorted else { return };
        let Some(link) = self.link(link) else { return };
        let mut state = link.lock();
        let event = self.with(&link, &mut state, |session, cx| session.datagram(cx, from, nonce, body));
        state.notices.extend(event.as_ref().and_then(notice));
        if state.session.has_next_call() {
            self.hand_over(&link);
        }
        self.settle(&link, state);
    }

    fn accept(&self) {
        let Some(listener) = &self.listener else { return };
        for _ in 0..BATCH {
            match listener.accept() {
                Accepted::Stream(stream, address) => self.accepted(stream, address),
                Accepted::WouldBlock => return,
                Accepted::Exhausted => {
                    tracing::error!("no file descriptors are left for a new connection: raise the limit (ulimit -n)");
                    std::thread::sleep(std::time::Duration::from_millis(10));
                    return;
                }
            }
        }
    }

    /// Starts the unit's threads.
    pub(crate) fn start(self: &Arc<Self>) -> Result<(), Error> {
        self.start_workers().and_then(|()| self.start_clock()).map_err(system_refused)
    }
}

/// What the system says goes to the log; the error tells where to look.
pub(crate) fn system_refused(error: std::io::Error) -> Error {
    tracing::error!(%error, "the operating system refused a thread, a socket or a descriptor");
    Error::Network
}
