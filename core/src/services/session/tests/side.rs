//! One end of a pair, driven as a port drives a session.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::boxed::Box;
use std::collections::BTreeMap;
use std::string::{String, ToString};
use std::vec::Vec;

use super::super::{Event, Incoming, Session, SessionConfig};
use super::net::{DATAGRAM_PORT, Net};
use super::setup::{self, Handler, Run, Setup};
use crate::config::Priority;
use crate::distribution::function_list::FunctionList;
use crate::distribution::hello::Hello;
use crate::distribution::parameters::Parameters;
use crate::error::{CloseReason, Error};
use crate::host::mailman::LinkId;
use crate::host::secure::Plain;
use crate::services::access::{Access, Decision, Principal, Rule, Verb, decide};
use crate::services::hub::{Door, Hub};
use crate::services::requests::CallId;
use crate::services::{Context, Keys, Port};
use crate::storage::{Boxed, Pool};
use crate::time::{Duration, Instant};

/// Parameters that hold any message of these tests.
pub(super) type Arguments = Box<Parameters<24_576>>;

/// A handler that was begun.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Started {
    pub(super) function: String,
    pub(super) priority: Priority,
    /// Bytes of the stream received by then.
    pub(super) received: usize,
    /// Number of events by then.
    pub(super) happened: usize,
    /// The argument `x`, if there is one.
    pub(super) x: Option<i64>,
}

/// An access table that a test owns.
#[derive(Clone, Debug, Default)]
pub(super) struct Table(pub(super) Vec<Rule<&'static str, Vec<&'static str>>>);

impl Access for Table {
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        decide(&self.0, who, function, verb)
    }
}

/// The port of these tests: for units that have everything, or that only serve.
pub(super) enum Tested<const WHOLE: bool = true> {}

impl<const WHOLE: bool> Port for Tested<WHOLE> {
    type Storage = Boxed;
    type Cipher = Plain;
    type Endpoint = SocketAddr;
    const CALLS: bool = WHOLE;
    const HAS_ACCESS: bool = WHOLE;
    const TAKES_DATAGRAM_REQUESTS: bool = WHOLE;
}

/// Whether there is a key for every pair.
pub(super) struct Paired(pub(super) bool);

impl<const WHOLE: bool> Keys<Tested<WHOLE>> for Paired {
    fn credentials(&mut self, _: &Hello) -> Option<()> {
        self.0.then_some(())
    }
}

/// A hub whose decisions a test can hold up.
pub(super) struct Lobby<const WHOLE: bool = true> {
    pub(super) hub: Hub<Tested<WHOLE>>,
    pub(super) waits: bool,
    pub(super) entered: usize,
}

impl<const WHOLE: bool> Door<Tested<WHOLE>> for Lobby<WHOLE> {
    fn enter(&mut self, act: &mut dyn FnMut(&mut Hub<Tested<WHOLE>>)) {
        self.entered += 1;
        if !self.waits {
            act(&mut self.hub);
        }
    }
}

/// One end.
pub(super) struct Side<const WHOLE: bool = true> {
    pub(super) now: Instant,
    pub(super) session: Session<Tested<WHOLE>>,
    pub(super) functions: FunctionList<Boxed, Handler>,
    pub(super) pool: Pool<Boxed>,
    /// The access table.
    pub(super) table: Option<Table>,
    pub(super) net: Net,
    pub(super) happened: Vec<Event>,
    /// Handlers that were begun.
    pub(super) ran: Vec<Started>,
    /// Calls that wait for an answer of the test.
    pub(super) held: Vec<Incoming>,
    pub(super) hub: Lobby<WHOLE>,
    pub(super) inbox: Vec<u8>,
    /// Received bytes are left in the inbox.
    pub(super) holds_back: bool,
    pub(super) received: usize,
    /// The results of calls.
    pub(super) results: BTreeMap<CallId, Arguments>,
    /// Answers that could not be queued yet.
    unanswered: Vec<(Incoming, Result<Arguments, Error>)>,
    pub(super) buffers: usize,
    pub(super) base: Duration,
    /// There is a key for every pair.
    pub(super) paired: bool,
    /// Details of failed calls, and progress.
    #[cfg(feature = "details")]
    pub(super) failures: Vec<crate::distribution::failure::Failure>,
    #[cfg(feature = "details")]
    pub(super) progress: Vec<(CallId, i64)>,
    /// Values of streams that have arrived: their `x`, and their age.
    #[cfg(feature = "streams")]
    pub(super) samples: Vec<(i64, Duration)>,
}

/// The context of a side. A macro, since its parts are borrowed separately.
macro_rules! context {
    ($side:expr) => {
        &mut Context {
            now: $side.now,
            mailman: &mut $side.net,
            buffers: &mut $side.pool,
            functions: &$side.functions,
            access: $side.table.as_ref().map(|table| table as &dyn crate::services::access::Access),
            hub: &mut $side.hub,
            keys: &mut $crate::services::session::tests::side::Paired($side.paired),
        }
    };
}
pub(super) use context;

impl<const WHOLE: bool> Side<WHOLE> {
    pub(super) fn new(setup: &Setup, agv: bool, address: u8) -> Self {
        let constraints = if agv { setup.agv } else { setup.manager };
        // The clocks of the two ends are unrelated.
        let base = Duration::from_secs(if agv { 5_000 } else { 10 });
        let now = Instant::START + base;
        let config = SessionConfig {
            link: LinkId(address.into()),
            dialed: agv,
            address: SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 3_u8.wrapping_sub(address))), DATAGRAM_PORT),
            nonce: setup::nonce(agv),
            constraints,
        };
        Self {
            now,
            session: Session::new(now, config, Plain, setup::storage(setup.running, setup.their_functions)),
            functions: setup::functions(),
            table: None,
            pool: setup::pool(setup.buffers, setup.buffer_size),
            net: Net::default(),
            happened: Vec::new(),
            ran: Vec::new(),
            held: Vec::new(),
            hub: Lobby { hub: setup::hub(agv, "manager", constraints, setup.datagrams), waits: false, entered: 0 },
            inbox: Vec::new(),
            holds_back: false,
            received: 0,
            results: BTreeMap::new(),
            unanswered: Vec::new(),
            buffers: setup.buffers,
            base,
            paired: false,
            #[cfg(feature = "details")]
            failures: Vec::new(),
            #[cfg(feature = "details")]
            progress: Vec::new(),
            #[cfg(feature = "streams")]
            samples: Vec::new(),
        }
    }

    /// Does what a port does when bytes have arrived or something is due; returns whether there was anything.
    pub(super) fn work(&mut self, datagrams: Vec<(u64, Vec<u8>)>) -> bool {
        let mut worked = !datagrams.is_empty();
        let from = SocketAddr::new(self.session.address().ip(), DATAGRAM_PORT);
        for (nonce, body) in datagrams {
            self.hear_datagram_from(from, nonce, body);
        }
        worked |= self.read();
        worked |= self.run_calls();
        worked |= self.poll();
        for (call, result) in core::mem::take(&mut self.unanswered) {
            let unanswered = self.unanswered.len();
            self.answer(call, result);
            worked |= self.unanswered.len() == unanswered;
        }
        worked
    }

    fn poll(&mut self) -> bool {
        let mut worked = false;
        while let Some(event) = self.session.poll(context!(self)) {
            self.note(Some(event), &mut Arguments::default());
            worked = true;
        }
        worked
    }

    /// A datagram arrives from an address that may not be the peer's.
    pub(super) fn hear_datagram_from(&mut self, from: SocketAddr, nonce: u64, mut body: Vec<u8>) {
        let event = self.session.datagram(context!(self), from, nonce, &mut body);
        self.note(event, &mut Arguments::default());
        self.run_calls();
    }

    fn read(&mut self) -> bool {
        let mut worked = false;
        let mut arguments: Arguments = Box::default();
        if self.holds_back {
            self.session.hold_back();
            return false;
        }
        loop {
            let lent = &mut self.inbox;
            let receipt = self.session.receive(context!(self), lent, Some(&mut *arguments));
            let more = receipt.consumed > 0 || receipt.event.is_some();
            worked |= more;
            self.note(receipt.event, &mut arguments);
            self.inbox.drain(..receipt.consumed);
            if receipt.paused || !more {
                return worked;
            }
        }
    }

    fn run_calls(&mut self) -> bool {
        let mut worked = self.poll();
        let mut arguments: Arguments = Box::default();
        while let Some(call) = self.session.next_call(context!(self), &mut *arguments) {
            self.run(call, &mut arguments);
            worked = true;
        }
        worked
    }

    fn run(&mut self, call: Incoming, arguments: &mut Arguments) {
        let function = self.functions.function(call.slot).unwrap();
        self.ran.push(Started {
            function: function.name().to_string(),
            priority: call.priority,
            received: self.received,
            happened: self.happened.len(),
            x: arguments.variable("x").ok(),
        });
        match function.handler.run {
            Run::Held => self.held.push(call),
            Run::Now(run) => {
                let result = run(arguments).map(|()| arguments.clone());
                self.answer(call, result);
            }
        }
    }

    pub(super) fn answer(&mut self, call: Incoming, result: Result<Arguments, Error>) {
        let lent = result.as_ref().map(|results| results.as_view()).map_err(|error| *error);
        if self.session.answer(context!(self), call.ticket, lent).is_err() {
            self.unanswered.push((call, result));
        }
    }

    /// A call has its arguments in `arguments`, and results are in what has arrived.
    fn note(&mut self, event: Option<Event>, arguments: &mut Arguments) {
        #[cfg(feature = "details")]
        if let Some(Event::Reply(_, Err(_)) | Event::Failed(..)) = event {
            self.failures.extend(self.session.failure(&self.inbox));
        }
        match event {
            None => {}
            Some(Event::Incoming(call)) => self.run(call, arguments),
            Some(Event::Reply(id, outcome)) => {
                let outcome = outcome.and_then(|results| {
                    let block = self.session.results(&results, &self.inbox)?;
                    block.read_into(self.results.get_mut(&id).unwrap()).map(|()| results)
                });
                self.happened.push(Event::Reply(id, outcome));
            }
            #[cfg(feature = "details")]
            Some(Event::Progress(id, values)) => {
                let mut reported: Arguments = Box::default();
                self.session.progress_values(&values, &self.inbox).unwrap().read_into(&mut reported).unwrap();
                self.progress.push((id, reported.variable("x").unwrap()));
            }
            #[cfg(feature = "streams")]
            Some(Event::Sample(sample)) => {
                let mut values: Arguments = Box::default();
                self.session.results(&sample.values, &self.inbox).unwrap().read_into(&mut values).unwrap();
                self.samples.push((values.variable("x").unwrap(), sample.age));
            }
            Some(event) => self.happened.push(event),
        }
    }

    pub(super) fn end(&mut self) {
        self.session.disconnected(CloseReason::Stopped);
        while self.session.poll(context!(self)).is_some() {}
    }
}
