//! Opening a stream: the dial, its answer, and the time-out.

use cara_core::time::Duration;

use super::streams::{End, State};
use super::{Happening, Network};
use crate::event::{HostId, NetEvent, StreamId};
use crate::faults::Fault;

/// Wait before an unanswered dial is repeated; doubles each time.
const FIRST_DIAL_WAIT: Duration = Duration::from_secs(1);
/// Dials without an answer before the stream is refused: after 1 + 2 + 4 + 8 + 16 s.
const DIALS: u32 = 5;

impl Network {
    pub(super) fn dial(&mut self, stream: StreamId, attempt: u32) {
        let End { state, host, local, .. } = *self.end(stream);
        if state != State::Dialling {
            return;
        }
        if attempt >= DIALS {
            return self.dial_refused(stream, true);
        }
        let to = *self.end(stream.peer()).local.ip();
        // The host that has the address now decides which path the dial takes.
        let Some(receiver) = self.find(to, |_| true) else { return self.dial_again(stream, attempt) };
        let lost = *local.ip() != self.host(host).address || self.loses(host, receiver);
        if lost {
            return self.dial_again(stream, attempt);
        }
        let at = self.arrival(self.now, self.path(host, receiver));
        self.push(at, Happening::DialArrives { stream, attempt });
    }

    fn dial_again(&mut self, stream: StreamId, attempt: u32) {
        self.counts.count(Fault::Retransmission);
        let at = self.now + FIRST_DIAL_WAIT.times(1 << attempt);
        self.push(at, Happening::Dial { stream, attempt: attempt + 1 });
    }

    pub(super) fn dial_arrives(&mut self, stream: StreamId, attempt: u32) {
        let dialler = self.end(stream).host;
        let to = self.end(stream.peer()).local;
        let Some(machine) = self.find(*to.ip(), |host| host.power) else { return self.dial_again(stream, attempt) };
        let listening = self.find(*to.ip(), |host| {
            host.running && host.listeners.contains(&to.port()) && host.streams.len() < host.accept_limit
        });
        if self.loses(listening.unwrap_or(machine), dialler) {
            return self.dial_again(stream, attempt);
        }
        let at = self.arrival(self.now, self.path(machine, dialler));
        let Some(host) = listening else { return self.push(at, Happening::DialRefused { stream }) };
        self.accept(stream.peer(), host);
        self.end_mut(stream.peer()).outgoing.last_arrival = at;
        self.push(at, Happening::DialAnswered { stream });
    }

    fn accept(&mut self, stream: StreamId, host: HostId) {
        let end = self.end_mut(stream);
        end.state = State::Open;
        end.host = host;
        let port = end.local.port();
        self.host_mut(host).streams.push(stream);
        let from = self.end(stream.peer()).local.into();
        self.ready.push_back(NetEvent::Accepted { host, port, stream, from });
    }

    pub(super) fn dial_answered(&mut self, stream: StreamId) {
        let End { state, host, .. } = *self.end(stream);
        match state {
            State::Dialling => {
                self.end_mut(stream).state = State::Open;
                self.ready.push_back(NetEvent::Connected { host, stream });
                self.announce_writable(stream);
            }
            State::Gone if self.host(host).power => self.send_reset(stream),
            _ => (),
        }
    }

    pub(super) fn dial_refused(&mut self, stream: StreamId, timed_out: bool) {
        if self.end(stream).state == State::Dialling {
            let host = self.end(stream).host;
            self.bury(stream);
            self.ready.push_back(NetEvent::Refused { host, stream, timed_out });
        }
    }
}
