//! One end of a link: the core's own session, whose writes are kept instead of sent.

use core::net::SocketAddr;

use cara_core::config::Constraints;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::function_list::{Entry, FunctionList, Slot};
use cara_core::distribution::hello::Hello;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::host::secure::Plain;
use cara_core::services::heart::Renew;
use cara_core::services::hub::Hub;
use cara_core::services::session::{Delivery, Event, Incoming, RequestOptions, Session, SessionConfig, SessionStorage};
use cara_core::services::{Context, Port, Ticket};
use cara_core::storage::Pool;
use cara_core::time::{Duration, Instant};

use crate::membership;
use crate::stream::{Boxed, buffers};
use crate::vector::definition;

/// What a unit wrote in one go.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Written {
    /// To the stream.
    Stream(Vec<u8>),
    /// In a datagram.
    Datagram(Vec<u8>),
}

#[derive(Default)]
struct Kept(Vec<Written>);

impl Mailman<SocketAddr> for Kept {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let bytes = slices.concat();
        let count = bytes.len();
        match self.0.last_mut() {
            Some(Written::Stream(before)) => before.extend(bytes),
            _ => self.0.push(Written::Stream(bytes)),
        }
        Ok(count)
    }

    fn send_to(&mut self, _: SocketAddr, datagram: &[u8]) -> bool {
        self.0.push(Written::Datagram(datagram.to_vec()));
        true
    }

    fn broadcast(&mut self, _: &[u8]) -> bool {
        false
    }
}

/// These ends, as the core's port.
pub(crate) enum Vectors {}

impl Port for Vectors {
    type Storage = Boxed;
    type Cipher = Plain;
    type Endpoint = SocketAddr;
}

/// One end of a link, with a clock of its own.
pub(crate) struct Side {
    session: Session<Vectors>,
    pool: Pool<Boxed>,
    functions: FunctionList<Boxed, ()>,
    hub: Hub<Vectors>,
    kept: Kept,
    now: Instant,
    /// Calls that the peer has made and that wait for an answer.
    pub(crate) calls: Vec<Incoming>,
    /// What else happened, as the core tells it.
    pub(crate) events: Vec<String>,
}

impl Side {
    /// An end that has just been connected. Its clock begins at the stamp of its hello.
    pub(crate) fn new(hello: Hello, dialed: bool, functions: &[(&str, Attributes)]) -> Self {
        Self::with_room(hello, dialed, functions, 1)
    }

    /// The same of a unit that takes `maximum` peers.
    pub(crate) fn with_room(hello: Hello, dialed: bool, functions: &[(&str, Attributes)], maximum: u16) -> Self {
        let now = Instant::from_micros(hello.stamp);
        let constraints = Constraints {
            message_size: hello.limits.message_size,
            chunk_size: hello.limits.chunk_size,
            calls_per_peer: hello.limits.calls,
            minimum_interval: Duration::from_micros(u64::from(hello.limits.minimum_interval)),
            ..Constraints::S_UNIT
        };
        let hub = membership::hub(&hello, constraints, maximum);
        let config = SessionConfig {
            link: LinkId(hello.link),
            dialed,
            address: SocketAddr::from(([192, 0, 2, 1], 50_000)),
            nonce: hello.nonce,
            constraints,
        };
        let mut side = Self {
            session: Session::new(now, config, Plain, storage()),
            pool: buffers(8, 40_000),
            functions: FunctionList::new((0..8).map(|_| Entry::empty()).collect(), vec![0; 1024].into()),
            hub,
            kept: Kept::default(),
            now,
            calls: Vec::new(),
            events: Vec::new(),
        };
        for (text, attributes) in functions {
            let added = side.functions.add_function(&definition(text), *attributes, ());
            added.unwrap_or_else(|error| panic!("{text}: {error}"));
        }
        side.with(|session, cx| session.connected(cx));
        side
    }

    /// Lets time pass.
    pub(crate) fn wait(&mut self, span: Duration) {
        self.now = self.now + span;
    }

    /// Takes out what was written since the last time.
    pub(crate) fn written(&mut self) -> Vec<Written> {
        std::mem::take(&mut self.kept.0)
    }

    /// Does what is due.
    pub(crate) fn poll(&mut self) {
        while let Some(event) = self.with(|session, cx| session.poll(cx)) {
            self.note(&event);
        }
    }

    /// What the peer wrote arrives.
    pub(crate) fn hear(&mut self, written: &Written) {
        match written {
            Written::Stream(bytes) => self.hear_stream(bytes),
            Written::Datagram(bytes) => self.hear_datagram(bytes),
        }
    }

    fn hear_stream(&mut self, bytes: &[u8]) {
        let mut rest = bytes.to_vec();
        loop {
            let (consumed, recorded, call) = self.receive(&mut rest);
            self.calls.extend(call);
            rest.drain(..consumed);
            self.events.extend(recorded.clone());
            if consumed == 0 && recorded.is_none() {
                break;
            }
        }
        self.take_calls();
    }

    fn receive(&mut self, rest: &mut [u8]) -> (usize, Option<String>, Option<Incoming>) {
        let mut cx = Context {
            now: self.now,
            mailman: &mut self.kept,
            buffers: &mut self.pool,
            functions: &self.functions,
            access: None,
            hub: &mut self.hub,
            keys: &mut (),
        };
        let receipt = self.session.receive(&mut cx, rest, None);
        let call = if let Some(Event::Incoming(call)) = &receipt.event { Some(*call) } else { None };
        (receipt.consumed, receipt.event.as_ref().map(reported), call)
    }

    fn hear_datagram(&mut self, bytes: &[u8]) {
        let nonce = self.session.nonce();
        let from = self.session.address();
        let mut body = bytes.get(24..).unwrap_or(&[]).to_vec();
        if let Some(event) = self.with(|session, cx| session.datagram(cx, from, nonce, &mut body)) {
            self.note(&event);
        }
        self.take_calls();
    }

    fn take_calls(&mut self) {
        let mut arguments: Parameters<2048> = Parameters::sized();
        while let Some(call) = self.with(|session, cx| session.next_call(cx, &mut arguments)) {
            self.calls.push(call);
        }
    }

    fn note(&mut self, event: &Event) {
        self.events.push(reported(event));
    }

    /// Publishes functions of the list.
    pub(crate) fn publish(&mut self, slots: &[u16]) {
        for &slot in slots {
            let published = self.hub.publications.publish_to_all(Slot(slot));
            published.unwrap_or_else(|error| panic!("{slot}: {error}"));
        }
        self.with(|session, cx| session.publish(cx));
    }

    /// Puts another function in the place of the one of its name.
    pub(crate) fn replace(&mut self, text: &str) -> Result<(), Error> {
        self.functions.replace(&definition(text), Attributes::default(), ()).map(|_| ())
    }

    /// Requests a function of the peer.
    pub(crate) fn request(&mut self, function: &str, parameters: &ParametersView, how: How) -> Result<(), Error> {
        let delivery = if how == How::BestEffort { Delivery::BestEffort } else { Delivery::Reliable };
        let options = RequestOptions { delivery, renew: Renew::Process, ..RequestOptions::default() };
        let wants_reply = how == How::Blocking;
        self.with(|session, cx| session.request(cx, function.into(), parameters, &options, wants_reply)).map(|_| ())
    }

    /// Answers a call.
    pub(crate) fn answer(&mut self, ticket: Ticket, result: Result<&ParametersView, Error>) -> Result<(), Error> {
        self.with(|session, cx| session.answer(cx, ticket, result))
    }

    /// Ends the link.
    pub(crate) fn stop(&mut self) {
        self.with(|session, cx| session.close(cx, CloseReason::StoppedHere));
    }

    fn with<R>(&mut self, act: impl FnOnce(&mut Session<Vectors>, &mut Context<'_, Vectors>) -> R) -> R {
        let mut cx = Context {
            now: self.now,
            mailman: &mut self.kept,
            buffers: &mut self.pool,
            functions: &self.functions,
            access: None,
            hub: &mut self.hub,
            keys: &mut (),
        };
        act(&mut self.session, &mut cx)
    }
}

/// How a request is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum How {
    Blocking,
    OneWay,
    BestEffort,
}

fn reported(event: &Event) -> String {
    let text = format!("{event:?}");
    text.split(['(', ' ']).next().unwrap_or_default().to_owned()
}

fn storage() -> SessionStorage<Boxed> {
    SessionStorage {
        small: vec![0; 512].into(),
        pending: vec![None; 8].into(),
        running: vec![None; 4].into(),
        publications: vec![Default::default(); 8].into(),
        their_functions: (0..8).map(|_| Entry::empty()).collect(),
        their_signatures: vec![0; 1024].into(),
    }
}
