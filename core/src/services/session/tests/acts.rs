//! Actions and questions of tests at one end of a pair.

use std::boxed::Box;
use std::rc::Rc;
use std::vec;
use std::vec::Vec;

use super::super::{Event, Incoming, RequestOptions};
use super::setup::{self, Handler, Run};
use super::side::{Arguments, Side, Started, Table, context};
use crate::config::{Constraints, Priority};
use crate::distribution::connection_handler::Directive;
use crate::distribution::function::{Attributes, Definition};
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::message::RequestHeader;
use crate::distribution::parameters::ParametersView;
use crate::error::{CloseReason, Error, ServiceError};
use crate::host::connections::LinkCounter;
use crate::host::frame::{ChunkWriter, Chunking};
use crate::services::Context;
use crate::services::heart::{Beats, Renew};
use crate::services::lease::{Lease, LeaseEnd, Order};
use crate::services::requests::CallId;
use crate::storage::Buffers;
use crate::time::Duration;

/// The default options of tests: a leased function stays live as long as its call is held.
const WANTED: RequestOptions = RequestOptions::renewing(Renew::Process);

impl<const WHOLE: bool> Side<WHOLE> {
    pub(super) fn counter(&self, counter: LinkCounter) -> u64 {
        self.session.counters().value(counter)
    }

    /// Adds a function that is answered at once.
    pub(super) fn offer(&mut self, definition: &str, run: fn(&mut ParametersView) -> Result<(), Error>) -> Slot {
        self.add(definition, 0, Run::Now(run))
    }

    /// Adds a function whose calls wait for the test's answer.
    pub(super) fn offer_held(&mut self, definition: &str) -> Slot {
        self.add(definition, 0, Run::Held)
    }

    /// Adds a function with a lease, answered at once.
    pub(super) fn offer_leased(&mut self, definition: &str, lease: Duration) -> Slot {
        self.add(definition, lease.as_millis(), Run::Now(|_| Ok(())))
    }

    /// Adds a function with a lease, whose calls the test answers.
    pub(super) fn offer_held_lease(&mut self, definition: &str, lease: Duration) -> Slot {
        self.add(definition, lease.as_millis(), Run::Held)
    }

    /// Adds a function with a lease, which fails for a negative `x`.
    pub(super) fn offer_picky(&mut self, definition: &str, lease: Duration) -> Slot {
        let run = |view: &mut ParametersView| match view.variable::<i64>("x") {
            Ok(x) if x >= 0 => Ok(()),
            _ => Err(Error::Service(ServiceError::Failed(1))),
        };
        self.add(definition, lease.as_millis(), Run::Now(run))
    }

    /// Adds a function with the same actuator as the one in `other`.
    pub(super) fn offer_sharing(&mut self, definition: &str, lease: Duration, other: Slot) -> Slot {
        let word = self.functions.function(other).unwrap().handler.lease.clone();
        let attributes = Attributes { lease: Some(lease), ..Attributes::default() };
        self.add_with(definition, attributes, Run::Now(|_| Ok(())), word)
    }

    /// Adds a function that stops or resets all, or the actuator of the one in `charge`. It fails for a negative `x`.
    pub(super) fn offer_control(&mut self, definition: &str, attributes: Attributes, charge: Option<Slot>) -> Slot {
        let word = charge.and_then(|slot| self.functions.function(slot).unwrap().handler.lease.clone());
        self.add_with(definition, attributes, Run::Held, word)
    }

    fn add_with(&mut self, definition: &str, attributes: Attributes, run: Run, lease: Option<Rc<Lease>>) -> Slot {
        let definition = Definition::parse(definition).unwrap();
        self.functions.add_function(&definition, attributes, Handler::new(run, lease)).unwrap()
    }

    fn add(&mut self, definition: &str, lease: u64, run: Run) -> Slot {
        let definition = Definition::parse(definition).unwrap();
        let attributes = setup::attributes(&definition, lease);
        let lease = attributes.lease.map(|_| Rc::default());
        self.functions.add_function(&definition, attributes, Handler::new(run, lease)).unwrap()
    }

    /// Publishes all functions that were added.
    pub(super) fn publish(&mut self) -> u32 {
        for function in self.functions.iter() {
            self.hub.hub.publications.publish_to_all(function.slot).unwrap();
        }
        self.session.publish(context!(self))
    }

    pub(super) fn is_live(&self, slot: Slot) -> bool {
        self.is_live_behind(slot, Duration::ZERO)
    }

    /// What a lease tells an interrupt that reads it `later` than the session's time.
    pub(super) fn is_live_behind(&self, slot: Slot, later: Duration) -> bool {
        self.functions
            .function(slot)
            .unwrap()
            .handler
            .lease
            .as_ref()
            .is_some_and(|lease| lease.is_live(self.now + later))
    }

    pub(super) fn request_with(
        &mut self,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        let id = self.session.request(context!(self), function.into(), parameters, options, wants_reply)?;
        if wants_reply {
            let mut results: Arguments = Box::default();
            results.copy_from(parameters).unwrap();
            self.results.insert(id, results);
        }
        Ok(id)
    }

    /// A request that waits for its reply.
    pub(super) fn call(&mut self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.request_with(function, parameters, &WANTED, true)
    }

    /// A request without a reply.
    pub(super) fn notify(&mut self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.request_with(function, parameters, &WANTED, false)
    }

    /// Answers the oldest call that is held.
    pub(super) fn answer_held(&mut self, result: Result<&ParametersView, Error>) {
        let call = self.held.remove(0);
        let result = result.map(|results| {
            let mut kept = Arguments::default();
            kept.copy_from(results).unwrap();
            kept
        });
        self.answer(call, result);
    }

    pub(super) fn close(&mut self, reason: CloseReason) {
        self.session.close(context!(self), reason);
    }

    /// Passes the session a directive of the hub.
    pub(super) fn direct(&mut self, directive: Directive) {
        self.session.direct(context!(self), directive);
    }

    pub(super) fn release(&mut self, slot: Slot) -> Result<(), Error> {
        self.session.release(context!(self), slot)
    }

    pub(super) fn release_beats(&mut self, beats: Beats) {
        self.session.release_beats(context!(self), beats);
    }

    pub(super) fn cancel(&mut self, call: CallId) {
        self.session.cancel(context!(self), call);
    }

    /// Whether an order is live, as its handler sees it.
    pub(super) fn continues(&self, call: &Incoming) -> bool {
        let lease = &self.functions.function(call.slot).unwrap().handler.lease;
        lease.as_ref().unwrap().is_live_for(call.order.unwrap(), self.now)
    }

    /// The vehicle's program reports an order as finished.
    pub(super) fn end_order(&mut self, slot: Slot, order: Order) -> bool {
        let lease = self.functions.function(slot).unwrap().handler.lease.clone().unwrap();
        self.session.end_order(context!(self), &lease, order)
    }

    /// The order of a call of the peer.
    pub(super) fn order_of(&self, call: CallId) -> Order {
        let granted = self.session.granting.granted.iter().find(|granted| granted.call == call.0);
        granted.and_then(|granted| granted.order).unwrap()
    }

    pub(super) fn withdraw(&mut self, slot: Slot) -> u32 {
        self.hub.hub.publications.withdraw(slot);
        self.session.withdraw(context!(self), slot)
    }

    /// Changes the access table.
    pub(super) fn set_table(&mut self, table: Option<Table>) -> u32 {
        self.table = table;
        self.session.access_changed(context!(self))
    }

    pub(super) fn flush_gathered(&mut self) {
        self.session.flush_gathered(context!(self));
    }

    pub(super) fn set_constraints(&mut self, constraints: Constraints) {
        self.session.set_constraints(context!(self), constraints);
    }

    /// Replaces the function of the same name, without publishing it.
    pub(super) fn replace(&mut self, definition: &str) {
        let definition = Definition::parse(definition).unwrap();
        let handler = Handler::new(Run::Now(|_| Ok(())), Some(Rc::default()));
        self.functions.replace(&definition, setup::attributes(&definition, 0), handler).unwrap();
    }

    /// Forged bytes arrive in the stream.
    pub(super) fn hear(&mut self, bytes: &[u8]) {
        self.inbox.extend_from_slice(bytes);
    }

    /// A forged request arrives.
    pub(super) fn hear_request(&mut self, header: &RequestHeader, priority: Priority, block: &[u8]) {
        self.hear_message(&[&header.encode()[..], block].concat(), priority);
    }

    /// A forged message arrives.
    pub(super) fn hear_message(&mut self, message: &[u8], priority: Priority) {
        let chunking = Chunking { chunk: 1_024, overhead: 0 };
        let mut frames = vec![0; chunking.framed_length(message.len())];
        ChunkWriter::new(&mut frames, chunking, priority, message.len()).unwrap().put(message);
        self.hear(&frames);
    }

    /// A forged datagram arrives.
    pub(super) fn hear_datagram(&mut self, nonce: u64, body: &[u8]) {
        self.work(vec![(nonce, body.to_vec())]);
    }

    /// Makes this end believe that the other has published a function.
    pub(super) fn hear_of(&mut self, definition: &str, slot: u16, generation: u16) {
        let definition = Definition::parse(definition).unwrap();
        let attributes = setup::attributes(&definition, 0);
        self.session.wire.theirs.insert(Slot(slot), Generation(generation), attributes, definition.as_bytes()).unwrap();
    }

    /// Takes all buffers, as other links may.
    pub(super) fn take_buffers(&mut self) -> Vec<Box<[u8]>> {
        core::iter::from_fn(|| self.pool.take()).collect()
    }

    pub(super) fn give_buffers(&mut self, buffers: Vec<Box<[u8]>>) {
        buffers.into_iter().for_each(|buffer| self.pool.give(buffer));
    }

    /// The outcome of a call, once it has ended.
    pub(super) fn outcome(&self, id: CallId) -> Option<Result<&ParametersView, Error>> {
        self.happened.iter().find_map(|event| match event {
            Event::Reply(known, result) if *known == id => {
                Some(result.map(|_| self.results.get(&id).unwrap().as_view()))
            }
            _ => None,
        })
    }

    /// The functions whose handlers were begun, in order.
    pub(super) fn ran(&self) -> Vec<&str> {
        self.started().map(|started| started.function.as_str()).collect()
    }

    /// The handlers that were begun, in order.
    pub(super) fn started(&self) -> impl Iterator<Item = &Started> {
        self.ran.iter()
    }

    pub(super) fn count(&self, wanted: impl Fn(&Event) -> bool) -> usize {
        self.happened.iter().filter(|event| wanted(event)).count()
    }

    pub(super) fn has(&self, wanted: &Event) -> bool {
        self.happened.contains(wanted)
    }

    /// Whether this end was notified that the lease of its call ended for this reason.
    pub(super) fn is_reported(&self, wanted: CallId, reason: LeaseEnd) -> bool {
        self.count(|event| matches!(*event, Event::LeaseEnded { call, why, .. } if (call, why) == (wanted, reason))) > 0
    }
}
