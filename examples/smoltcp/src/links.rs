//! The core's two machines, driven: the node's decisions are carried out, the session is given what has arrived, and
//! what comes of it goes to the program.

use core::net::SocketAddrV4;

use cara_core::config::Mode;
use cara_core::distribution::connection_handler::Command;
use cara_core::distribution::datagram;
use cara_core::distribution::identity::Identity;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::LinkId;
use cara_core::host::secure::Plain;
use cara_core::services::session::{Event, Incoming, Session, SessionConfig};
use cara_core::services::{Context, Ticket};
use cara_core::time::Instant;

use crate::program::{Outcome, Program};
use crate::stack::Stream;
use crate::unit::{SUnit, context};

/// The only link.
const LINK: LinkId = LinkId(0);
/// Bytes lent to the core at a time: a datagram of the longest message.
const LENT_BYTES: usize = 1_472;

impl SUnit {
    /// Does what is due, and what waited for something: leases first.
    pub(crate) fn work<P: Program>(&mut self, now: Instant, program: &mut P) {
        self.poll_session(now, program);
        self.poll_node(now);
        self.read(now, program);
        self.poll_session(now, program);
    }

    fn poll_node(&mut self, now: Instant) {
        while let Some(command) = self.hub.node.poll(now, &mut self.stack, &Plain) {
            match command {
                Command::Dial { to, identity } => self.dial(now, to, identity.as_ref()),
                // With one link there is never a second one of which it could be told.
                Command::Notify(..) => {}
            }
        }
    }

    fn dial(&mut self, now: Instant, to: SocketAddrV4, identity: Option<&Identity>) {
        if self.session.is_some() || !self.stack.connect(to) {
            return self.hub.node.dial_failed(now, identity);
        }
        let Some(storage) = self.spare.take() else { return };
        let constraints = *self.hub.node.constraints();
        let nonce = self.hub.node.nonce();
        let config = SessionConfig { link: LINK, dialed: true, address: to, nonce, constraints };
        self.session = Some(Session::new(now, config, Plain, storage));
        self.is_dialing = true;
        self.hub.node.dialing(identity, LINK);
    }

    fn poll_session<P: Program>(&mut self, now: Instant, program: &mut P) {
        while let Some(event) = self.session.as_mut().and_then(|session| session.poll(context!(self, now))) {
            self.happened(now, event, &[], program);
        }
    }

    /// Takes everything that has arrived.
    pub(crate) fn read<P: Program>(&mut self, now: Instant, program: &mut P) {
        let mut lent = [0; LENT_BYTES];
        while let Some((from, length)) = self.stack.datagram(&mut lent) {
            self.take_datagram(now, from, &mut lent[..length], program);
        }
        self.follow_stream(now);
        while self.take_bytes(now, &mut lent, program) {}
        // What moves stops before a call begins.
        self.poll_session(now, program);
        self.serve_waiting(now, program);
    }

    fn take_datagram<P: Program>(&mut self, now: Instant, from: SocketAddrV4, bytes: &mut [u8], program: &mut P) {
        let for_session = datagram::for_session(bytes, Mode::Plain, self.hub.node.fleet());
        if let (Some((LINK, nonce, body)), Some(session)) = (for_session, &mut self.session) {
            if let Some(event) = session.datagram(context!(self, now), from, nonce, body) {
                self.happened(now, event, &[], program);
            }
            return;
        }
        self.hub.node.datagram(now, from, bytes, &Plain);
    }

    /// Tells the session what has become of its stream.
    fn follow_stream(&mut self, now: Instant) {
        let Some(session) = &mut self.session else { return };
        match (self.stack.stream(), self.is_dialing) {
            (Stream::Opening, _) => {}
            (Stream::Open, true) => {
                self.is_dialing = false;
                session.connected(context!(self, now));
            }
            (Stream::Open, false) => {
                if session.wants_to_write() && self.stack.stream_takes_bytes() {
                    session.writable(context!(self, now));
                }
            }
            (Stream::Ended, true) => session.disconnected(CloseReason::DialFailed),
            (Stream::Ended, false) => session.disconnected(CloseReason::Reset),
        }
    }

    /// Lends the session what the stream has; `false` when nothing came of it.
    fn take_bytes<P: Program>(&mut self, now: Instant, lent: &mut [u8], program: &mut P) -> bool {
        let Some(session) = &mut self.session else { return false };
        let length = self.stack.peek(lent);
        let arguments = self.unanswered.is_none().then_some(self.arguments.as_mut_view());
        let receipt = session.receive(context!(self, now), &mut lent[..length], arguments);
        self.stack.consume(receipt.consumed);
        if let Some(event) = receipt.event {
            self.happened(now, event, lent, program);
        }
        receipt.consumed > 0 || receipt.event.is_some()
    }

    /// Serves the calls that waited for their turn.
    fn serve_waiting<P: Program>(&mut self, now: Instant, program: &mut P) {
        self.answer_again(now);
        while let Some(call) = self.next_call(now) {
            self.serve(now, &call, program);
        }
    }

    /// While results wait for room there is no place for those of a further call: only emergencies are served.
    fn next_call(&mut self, now: Instant) -> Option<Incoming> {
        let session = self.session.as_mut()?;
        let arguments = self.arguments.as_mut_view();
        match self.unanswered {
            None => session.next_call(context!(self, now), arguments),
            Some(_) => session.next_emergency(context!(self, now), arguments),
        }
    }

    /// Does what an event asks for; `lent` is what it came of.
    fn happened<P: Program>(&mut self, now: Instant, event: Event, lent: &[u8], program: &mut P) {
        match event {
            Event::LeaseExpired(function) => program.make_safe(function),
            Event::Incoming(call) => self.serve(now, &call, program),
            Event::Reply(id, outcome) => {
                let Some(session) = &self.session else { return };
                program.replied(id, outcome.and_then(|results| session.results(&results, lent)));
            }
            Event::Closed(reason) => self.leave(now, reason, program),
            event => program.hear(event),
        }
    }

    /// Shows the manager every function, on this link.
    pub(crate) fn publish(&mut self, now: Instant) {
        if let Some(session) = self.session.as_mut().filter(|session| session.is_live()) {
            session.publish(context!(self, now));
        }
    }

    fn serve<P: Program>(&mut self, now: Instant, call: &Incoming, program: &mut P) {
        if let Outcome::Now(outcome) = program.serve(call, self.arguments.as_mut_view()) {
            self.answer_served(now, call.ticket, outcome.map_err(Error::Service));
        }
    }

    fn answer_served(&mut self, now: Instant, ticket: Ticket, outcome: Result<(), Error>) {
        let Some(session) = &mut self.session else { return };
        let results = outcome.map(|()| self.arguments.as_view());
        if session.answer(context!(self, now), ticket, results).is_ok() {
            return;
        }
        if self.unanswered.is_some() {
            // An emergency whose answer finds no room either: its caller waits in vain, and a counter says so.
            return session.drop_answer(ticket);
        }
        // The results step aside, so that an emergency is served meanwhile. All other calls wait for this one.
        core::mem::swap(&mut self.arguments, &mut self.results);
        self.unanswered = Some((ticket, outcome));
    }

    fn answer_again(&mut self, now: Instant) {
        let (Some((ticket, outcome)), Some(session)) = (self.unanswered, &mut self.session) else { return };
        let results = outcome.map(|()| self.results.as_view());
        if session.answer(context!(self, now), ticket, results).is_ok() {
            self.unanswered = None;
        }
    }

    /// The link has ended, and everything of it has been told: its memory serves the next one.
    fn leave<P: Program>(&mut self, now: Instant, reason: CloseReason, program: &mut P) {
        let Some(session) = self.session.take() else { return };
        let had_joined = session.peer().is_some();
        self.spare = Some(session.into_storage(&mut self.buffers));
        self.unanswered = None;
        self.stack.close();
        self.hub.node.left(now, LINK, reason);
        if had_joined {
            program.hear(Event::Closed(reason));
        }
    }
}
