//! The links of one unit: sessions over streams, read and written as a port does.

use std::collections::BTreeMap;
use std::rc::Rc;

use cara_core::distribution::connection_handler::Directive;
use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::access::Access;
use cara_core::services::call::Detail;
use cara_core::services::hub::Hub;
use cara_core::services::requests::CallId;
use cara_core::services::session::{Event, Session};
use cara_core::services::{Context, Port, Ticket};
use cara_core::time::Instant;

use super::audited::Audited;
use super::keys::Keys;
use super::mail::{LazyPool, SimMailman};
use super::replies::{CallError, Promise, Waiting};
use super::service::{BoxedParameters, Handler, Serving};
use super::streams::Reading;
use crate::event::{HostId, StreamId};
use crate::network::Network;
use crate::storage::Boxed;

/// The simulator, as the core's port.
pub(super) enum Simulated {}

impl Port for Simulated {
    type Storage = Boxed;
    type Cipher = Audited;
    type Endpoint = std::net::SocketAddr;
}

pub(super) type SimSession = Session<Simulated>;

/// What a link led to that concerns more than the link; with a call come its arguments.
pub(super) type Happened = (Event, Option<BoxedParameters>);

/// One link.
pub(super) struct Link {
    pub(super) session: SimSession,
    pub(super) stream: StreamId,
    /// Serves only to find what is armed in the network.
    timer: Instant,
    /// Read from the stream and not consumed yet.
    unread: Vec<u8>,
    waiting: BTreeMap<CallId, Waiting>,
    acknowledgements: Vec<(u32, Promise<bool>)>,
    unanswered: Vec<(Ticket, Result<BoxedParameters, Box<CallError>>)>,
    /// Calls of the peer that run.
    running: Vec<Rc<Serving>>,
    /// The newest progress of those that could not be sent.
    progress: Vec<(Ticket, BoxedParameters)>,
    /// The session wants no bytes now: the unit is out of buffers or has not decided about the peer.
    paused: bool,
}

/// All links of a unit, and what they share.
pub(super) struct Links {
    host: HostId,
    links: Vec<Option<Link>>,
    streams: Vec<Option<StreamId>>,
    by_stream: BTreeMap<StreamId, u16>,
    pub(super) functions: FunctionList<Boxed, Handler>,
    pub(super) buffers: LazyPool,
    /// The access table.
    pub(super) access: Option<&'static dyn Access>,
    pub(super) hub: Hub<Simulated>,
    pub(super) keys: Keys,
    /// Streams of other units that are read.
    pub(super) readings: Vec<Reading>,
    arguments: BoxedParameters,
}

/// Bytes read ahead of what the session has consumed; what exceeds it stays in the stream.
const READ_AHEAD: usize = 16 * 1024;

impl Links {
    pub(super) fn new(
        host: HostId,
        count: usize,
        functions: FunctionList<Boxed, Handler>,
        buffers: LazyPool,
        hub: Hub<Simulated>,
        keys: Keys,
        arguments: BoxedParameters,
    ) -> Self {
        let links = (0..count).map(|_| None).collect();
        Self {
            host,
            links,
            streams: vec![None; count],
            by_stream: BTreeMap::new(),
            functions,
            buffers,
            access: None,
            hub,
            keys,
            readings: Vec::new(),
            arguments,
        }
    }

    pub(super) const fn host(&self) -> HostId {
        self.host
    }

    /// An index that no link has.
    pub(super) fn free_index(&self) -> Option<u16> {
        self.links.iter().position(Option::is_none).map(|index| index as u16)
    }

    /// The accepted link that has waited longest for its peer's hello or proof.
    pub(super) fn oldest_silent(&self) -> Option<u16> {
        let silent = |index: &&u16| {
            let link = self.link(**index);
            link.is_some_and(|link| !link.session.dialed() && !link.session.is_proven())
        };
        self.by_stream.values().find(silent).copied()
    }

    pub(super) fn insert(&mut self, index: u16, session: SimSession, stream: StreamId) {
        self.streams[usize::from(index)] = Some(stream);
        self.by_stream.insert(stream, index);
        self.links[usize::from(index)] = Some(Link {
            session,
            stream,
            timer: Instant::FAR_FUTURE,
            unread: Vec::new(),
            waiting: BTreeMap::new(),
            acknowledgements: Vec::new(),
            unanswered: Vec::new(),
            running: Vec::new(),
            progress: Vec::new(),
            paused: false,
        });
    }

    pub(super) fn of_stream(&self, stream: StreamId) -> Option<u16> {
        self.by_stream.get(&stream).copied()
    }

    pub(super) fn link(&self, index: u16) -> Option<&Link> {
        self.links.get(usize::from(index))?.as_ref()
    }

    pub(super) fn link_mut(&mut self, index: u16) -> Option<&mut Link> {
        self.links.get_mut(usize::from(index))?.as_mut()
    }

    /// Where there are links.
    pub(super) fn indices(&self) -> Vec<u16> {
        self.iter().map(|(index, _)| index).collect()
    }

    /// Links with their indices.
    pub(super) fn iter(&self) -> impl Iterator<Item = (u16, &Link)> {
        self.links.iter().enumerate().filter_map(|(index, link)| Some((index as u16, link.as_ref()?)))
    }

    /// Lends the session of a link with its context.
    pub(super) fn with<R>(
        &mut self,
        network: &mut Network,
        index: u16,
        act: impl FnOnce(&mut SimSession, &mut Context<'_, Simulated>) -> R,
    ) -> Option<R> {
        let link = self.links.get_mut(usize::from(index))?.as_mut()?;
        let now = network.clock(self.host);
        let mut mailman = SimMailman { network, host: self.host, streams: &self.streams };
        let mut context = Context {
            now,
            mailman: &mut mailman,
            buffers: &mut self.buffers,
            functions: &self.functions,
            access: self.access,
            hub: &mut self.hub,
            keys: &mut self.keys,
        };
        Some(act(&mut link.session, &mut context))
    }

    /// Requests; with `wants_reply` the promise is kept when the call ends.
    pub(super) fn request(
        &mut self,
        network: &mut Network,
        index: u16,
        function: &str,
        parameters: &ParametersView,
        options: &cara_core::services::session::RequestOptions,
        waiting: Option<Waiting>,
    ) -> Result<CallId, Error> {
        let wants_reply = waiting.is_some();
        let requested = self
            .with(network, index, |session, cx| session.request(cx, function.into(), parameters, options, wants_reply));
        let id = requested.unwrap_or(Err(Error::NotConnected))?;
        if let (Some(link), Some(waiting)) = (self.link_mut(index), waiting) {
            link.waiting.insert(id, waiting);
        }
        Ok(id)
    }

    /// The caller has not taken an outcome, and does not want the call any more.
    pub(super) fn cancel(&mut self, network: &mut Network, index: u16, id: CallId) {
        if let Some(link) = self.link_mut(index) {
            link.waiting.remove(&id);
        }
        self.with(network, index, |session, cx| session.cancel(cx, id));
    }

    /// The promise is kept with `true` when the peer has read the list up to `serial`, with `false` if the link ends.
    pub(super) fn await_acknowledgement(&mut self, index: u16, serial: u32) -> Promise<bool> {
        let promise = Promise::new();
        match self.link_mut(index) {
            Some(link) => link.acknowledgements.push((serial, promise.clone())),
            None => promise.keep(false),
        }
        promise
    }

    /// Answers a call, now or when there is room.
    pub(super) fn answer(
        &mut self,
        network: &mut Network,
        index: u16,
        ticket: Ticket,
        outcome: Result<BoxedParameters, Box<CallError>>,
    ) {
        if let Some(link) = self.link_mut(index) {
            link.running.retain(|running| running.ticket != ticket);
            link.progress.retain(|(known, _)| *known != ticket);
        }
        let answered = self.with(network, index, |session, cx| match &outcome {
            Ok(results) => session.answer(cx, ticket, Ok(results)),
            Err(failed) => match failed.failure() {
                Some(failure) if failed.error == failure.into() => session.answer_failed(cx, ticket, failure),
                _ => session.answer(cx, ticket, Err(failed.error)),
            },
        });
        if let (Some(Err(_)), Some(link)) = (answered, self.link_mut(index)) {
            link.unanswered.push((ticket, outcome));
        }
    }

    /// A call of the peer runs.
    pub(super) fn runs(&mut self, index: u16, running: &Rc<Serving>) {
        if let Some(link) = self.link_mut(index) {
            link.running.push(Rc::clone(running));
        }
    }

    /// Tells the caller of a running call how far it is, now or when there is room.
    pub(super) fn progress(
        &mut self,
        network: &mut Network,
        index: u16,
        ticket: Ticket,
        values: &ParametersView,
    ) -> Result<(), Error> {
        let reported = self.with(network, index, |session, cx| session.progress(cx, ticket, values)).unwrap_or(Ok(()));
        let Some(link) = self.link_mut(index) else { return reported };
        let waiting = link.progress.iter().position(|(known, _)| *known == ticket);
        match reported {
            Err(Error::Full(_)) => {}
            Ok(()) => {
                waiting.map(|place| link.progress.remove(place));
                return Ok(());
            }
            // What is wrong with these values is nothing against those that wait.
            Err(error) => return Err(error),
        }
        let mut kept = super::service::boxed_parameters(size_of_val(values));
        kept.copy_from(values)?;
        match waiting {
            Some(place) => link.progress[place].1 = kept,
            None => link.progress.push((ticket, kept)),
        }
        Ok(())
    }

    fn progress_again(&mut self, network: &mut Network, index: u16) {
        let Some(link) = self.link_mut(index) else { return };
        for (ticket, values) in std::mem::take(&mut link.progress) {
            // What is wrong with it was told when it was new.
            let _ = self.progress(network, index, ticket, &values);
        }
    }

    /// Does all that a link can do now: reads, begins calls, polls. Returns what concerns the unit, in order.
    pub(super) fn work(&mut self, network: &mut Network, index: u16) -> Vec<Happened> {
        let mut happened = Vec::new();
        self.answer_again(network, index);
        self.receive(network, index, &mut happened);
        // What moves stops before a call begins.
        self.poll(network, index, &mut happened);
        self.begin_calls(network, index, &mut happened);
        self.poll(network, index, &mut happened);
        self.progress_again(network, index);
        self.arm(network, index);
        happened
    }

    fn answer_again(&mut self, network: &mut Network, index: u16) {
        let Some(link) = self.link_mut(index) else { return };
        for (ticket, outcome) in std::mem::take(&mut link.unanswered) {
            self.answer(network, index, ticket, outcome);
        }
    }

    fn receive(&mut self, network: &mut Network, index: u16, happened: &mut Vec<Happened>) {
        loop {
            let Some(link) = self.links.get_mut(usize::from(index)).and_then(Option::as_mut) else { return };
            let before = link.unread.len();
            if before < READ_AHEAD {
                network.read(link.stream, |bytes| {
                    let taken = bytes.len().min(READ_AHEAD - before);
                    link.unread.extend_from_slice(&bytes[..taken]);
                    taken
                });
            }
            let more = link.unread.len() > before;
            if !self.digest(network, index, happened) && !more {
                return;
            }
        }
    }

    /// Offers what was read until nothing more comes of it; `false` if nothing came at all.
    fn digest(&mut self, network: &mut Network, index: u16, happened: &mut Vec<Happened>) -> bool {
        let Some(link) = self.links.get_mut(usize::from(index)).and_then(Option::as_mut) else { return false };
        let now = network.clock(self.host);
        let mut mailman = SimMailman { network, host: self.host, streams: &self.streams };
        let mut cx = Context {
            now,
            mailman: &mut mailman,
            buffers: &mut self.buffers,
            functions: &self.functions,
            access: self.access,
            hub: &mut self.hub,
            keys: &mut self.keys,
        };
        let mut unread = std::mem::take(&mut link.unread);
        let (mut start, mut any) = (0, false);
        loop {
            let lent = &mut unread[start..];
            let receipt = link.session.receive(&mut cx, lent, Some(&mut self.arguments));
            let quiet = receipt.consumed == 0 && receipt.event.is_none();
            start += receipt.consumed;
            link.paused = receipt.paused;
            any |= !quiet;
            note(link, receipt.event, lent, &self.functions, &self.arguments, happened);
            if quiet || link.paused {
                break;
            }
        }
        unread.drain(..start);
        link.unread = unread;
        any
    }

    fn begin_calls(&mut self, network: &mut Network, index: u16, happened: &mut Vec<Happened>) {
        let mut arguments = std::mem::replace(&mut self.arguments, super::service::boxed_parameters(0));
        while let Some(Some(call)) = self.with(network, index, |session, cx| session.next_call(cx, &mut arguments)) {
            happened.push((Event::Incoming(call), Some(own(&self.functions, call.slot, &arguments))));
        }
        self.arguments = arguments;
    }

    fn poll(&mut self, network: &mut Network, index: u16, happened: &mut Vec<Happened>) {
        while let Some(Some(event)) = self.with(network, index, |session, cx| session.poll(cx)) {
            self.note(index, Some(event), happened);
        }
    }

    /// Notes an event that came of nothing that was lent.
    fn note(&mut self, index: u16, event: Option<Event>, happened: &mut Vec<Happened>) {
        if let Some(link) = self.links.get_mut(usize::from(index)).and_then(Option::as_mut) {
            note(link, event, &[], &self.functions, &self.arguments, happened);
        }
    }

    /// Links that paused for want of buffers and could go on.
    pub(super) fn resumable(&self) -> Vec<u16> {
        if self.buffers.free() == 0 {
            return Vec::new();
        }
        self.iter().filter(|(_, link)| link.paused && link.session.is_live()).map(|(index, _)| index).collect()
    }

    /// Whether anything that its functions move was stopped since this was asked last.
    pub(super) fn take_stopped(&self) -> bool {
        let actuators = self.functions.iter().filter_map(|function| function.handler.0.actuator.as_ref());
        actuators.fold(false, |stopped, actuator| stopped | actuator.take_stopped())
    }

    /// Passes on what the hub tells a link.
    pub(super) fn direct(&mut self, network: &mut Network, index: u16, directive: Directive) -> Vec<Happened> {
        let mut happened = Vec::new();
        if let Some(event) = self.with(network, index, |session, cx| session.direct(cx, directive)) {
            self.note(index, event, &mut happened);
        }
        happened.extend(self.work(network, index));
        happened
    }

    /// Passes a session datagram to its link.
    pub(super) fn datagram(
        &mut self,
        network: &mut Network,
        index: u16,
        from: std::net::SocketAddr,
        nonce: u64,
        body: &mut [u8],
    ) -> Vec<Happened> {
        let mut happened = Vec::new();
        if let Some(event) = self.with(network, index, |session, cx| session.datagram(cx, from, nonce, body)) {
            self.note(index, event, &mut happened);
        }
        happened.extend(self.work(network, index));
        happened
    }

    /// Sets the network's timer for what the session has to do next.
    pub(super) fn arm(&mut self, network: &mut Network, index: u16) {
        let host = self.host;
        let now = network.clock(host);
        let Some(link) = self.link_mut(index) else { return };
        let due = link.session.deadline();
        if due < link.timer || link.timer <= now {
            link.timer = due;
            if due != Instant::FAR_FUTURE {
                network.set_timer(host, network.time_of(host, due), timer_token(index));
            }
        }
    }

    /// Removes a link that has ended, and closes its stream.
    pub(super) fn remove(&mut self, network: &mut Network, index: u16) -> Option<Link> {
        let link = self.links.get_mut(usize::from(index))?.take()?;
        self.streams[usize::from(index)] = None;
        self.by_stream.remove(&link.stream);
        network.close(link.stream);
        Some(link)
    }

    /// The unit is gone: ends the calls of all links.
    pub(super) fn abandon(&mut self, error: Error) {
        for link in self.links.iter_mut().filter_map(Option::take) {
            link.abandon(error);
        }
    }
}

impl Link {
    /// Ends everything that still waits for this link.
    pub(super) fn abandon(self, error: Error) {
        for waiting in self.waiting.into_values() {
            waiting.promise.keep(Err(Box::new(error.into())));
        }
        for running in self.running {
            running.cancelled.keep(());
        }
        for (_, promise) in self.acknowledgements {
            promise.keep(false);
        }
    }
}

/// The timer of a link; 0 is the node's.
pub(super) fn timer_token(index: u16) -> u64 {
    u64::from(index) + 1
}

/// The arguments of a call in parameters of their own.
fn own(functions: &FunctionList<Boxed, Handler>, slot: Slot, arguments: &ParametersView) -> BoxedParameters {
    let bytes = functions.function(slot).map_or(0, |function| function.signature.parameters_bytes());
    // By its signature alone a list is empty.
    let used = size_of_val(arguments) - arguments.remaining();
    let mut parameters = super::service::boxed_parameters(used.max(bytes as usize));
    // Room for the signature is room for its arguments; if not, the service finds them missing and says so.
    let copied = parameters.copy_from(arguments);
    debug_assert_eq!(copied, Ok(()));
    parameters
}

/// Keeps what waits for the link alone, and leaves the rest to the unit. `lent` is what the event came of.
fn note(
    link: &mut Link,
    event: Option<Event>,
    lent: &[u8],
    functions: &FunctionList<Boxed, Handler>,
    arguments: &ParametersView,
    happened: &mut Vec<Happened>,
) {
    match event {
        None | Some(Event::Answered) => {}
        Some(Event::Reply(id, outcome)) => {
            let failure = if outcome.is_err() { link.session.failure(lent) } else { None };
            if let Some(waiting) = link.waiting.remove(&id) {
                let outcome = outcome.and_then(|results| link.session.results(&results, lent));
                waiting.finish(outcome.map_err(|error| CallError::new(error, failure.map(Detail::Service))));
            }
        }
        Some(Event::Progress(id, values)) => {
            let block = link.session.progress_values(&values, lent).expect("it has just come");
            let mut values = super::service::boxed_parameters(block.parameters_bytes() as usize);
            let read = block.read_into(&mut values);
            if let Some(waiting) = link.waiting.get(&id).filter(|_| read.is_ok()) {
                waiting.progress.put(values);
            }
        }
        Some(Event::Cancelled(ticket)) => {
            let running = link.running.iter().find(|running| running.ticket == ticket);
            running.into_iter().for_each(|running| running.cancelled.keep(()));
        }
        Some(Event::Acknowledged { serial, .. }) => {
            link.acknowledgements.retain(|(wanted, promise)| {
                let reached = wanted.wrapping_sub(serial) as i32 <= 0;
                if reached {
                    promise.keep(true);
                }
                !reached
            });
        }
        Some(event @ Event::Sample(sample)) => {
            let block = link.session.results(&sample.values, lent).expect("it has just come");
            let mut values = super::service::boxed_parameters(block.parameters_bytes() as usize);
            block.read_into(&mut values).expect("it was checked");
            happened.push((event, Some(values)));
        }
        Some(event @ Event::Incoming(call)) => happened.push((event, Some(own(functions, call.slot, arguments)))),
        Some(event) => happened.push((event, None)),
    }
}
