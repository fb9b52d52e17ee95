//! Events go to the machine of their unit, and what comes of them is done, as the front page of `cara_core::services` says.

use std::cell::RefCell;
use std::net::SocketAddr;
use std::rc::Rc;

use cara_core::distribution::authenticator::Authenticator as _;
use cara_core::distribution::connection_handler::{ClaimEvent, Command, NodeCounter};
use cara_core::distribution::datagram;
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::Identity;
use cara_core::error::{CloseReason, Error, Refusal};
use cara_core::host::mailman::LinkId;
use cara_core::services::call::Detail;
use cara_core::services::session::Event;

use super::handle::UnitHandle;
use super::links::{Happened, Link, Links};
use super::replies::{CallError, Promise};
use super::service::{BoxedParameters, Handler, LeaseWatch, Served, Serving, boxed_parameters};
use super::state::{NODE_TIMER, Storing};
use super::streams::Sample;
use super::tasks::Owner;
use super::{Inner, LogEvent, Shared, UnitEvent};
use crate::event::{HostId, NetEvent, StreamId};
use crate::network::Network;

impl Inner {
    /// Begins a life of a unit; its program runs before anything else happens.
    pub(super) fn start(&mut self, shared: &Rc<Shared>, host: HostId) {
        let unit = &mut self.units[host.index()];
        unit.boot(&mut self.network);
        let program = unit.settings.program.clone();
        self.log(shared, host, LogEvent::Started);
        if let Some(program) = program {
            let handle = UnitHandle::new(Rc::downgrade(shared), host);
            self.urgent.push_back(Box::new(move || program(&handle)));
        }
        self.work_node(shared, host);
    }

    /// Ends a life: what waited for the unit's calls is told.
    fn end(&mut self, shared: &Rc<Shared>, host: HostId) {
        let unit = &mut self.units[host.index()];
        unit.life += 1;
        if let Some(mut machine) = unit.machine.take() {
            for (_, link) in machine.links.iter() {
                unit.counters.merge(link.session.counters());
            }
            machine.links.abandon(Error::NotRunning);
            self.log(shared, host, LogEvent::Stopped);
        }
    }

    /// Passes an event of the network to its unit. Returns the host whose life it ended.
    pub(super) fn dispatch(&mut self, shared: &Rc<Shared>, event: NetEvent) -> Option<HostId> {
        let host = event.host();
        // A host without a unit is one that a test has added to the network, and looks after itself.
        self.units.get(host.index())?;
        match event {
            NetEvent::Crashed { .. } => {
                self.end(shared, host);
                return Some(host);
            }
            NetEvent::Restarted { .. } => self.start(shared, host),
            NetEvent::AddressChanged { .. } => self.network_changed(shared, host),
            NetEvent::Timer { token: NODE_TIMER, .. } => self.work_node(shared, host),
            NetEvent::Timer { token, .. } => self.work(shared, host, (token - 1) as u16),
            NetEvent::Datagram { from, bytes, .. } => self.datagram(shared, host, from, &mut bytes.to_vec()),
            NetEvent::Accepted { stream, from, .. } => self.accepted(shared, host, stream, from),
            NetEvent::Connected { stream, .. } => self.on_stream(shared, host, stream, |links, network, index| {
                links.with(network, index, |session, cx| session.connected(cx));
            }),
            NetEvent::Writable { stream, .. } => self.on_stream(shared, host, stream, |links, network, index| {
                links.with(network, index, |session, cx| session.writable(cx));
            }),
            NetEvent::Readable { stream, .. } => self.on_stream(shared, host, stream, |_, _, _| ()),
            NetEvent::Refused { stream, .. } => self.broken(shared, host, stream, CloseReason::DialFailed),
            NetEvent::Closed { stream, .. } | NetEvent::Reset { stream, .. } => {
                self.broken(shared, host, stream, CloseReason::Reset);
            }
        }
        None
    }

    fn broken(&mut self, shared: &Rc<Shared>, host: HostId, stream: StreamId, reason: CloseReason) {
        self.on_stream(shared, host, stream, |links, _, index| {
            if let Some(link) = links.link_mut(index) {
                link.session.disconnected(reason);
            }
        });
    }

    fn on_stream(
        &mut self,
        shared: &Rc<Shared>,
        host: HostId,
        stream: StreamId,
        act: impl FnOnce(&mut Links, &mut Network, u16),
    ) {
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        let Some(index) = machine.links.of_stream(stream) else { return };
        act(&mut machine.links, &mut self.network, index);
        self.work(shared, host, index);
    }

    fn accepted(&mut self, shared: &Rc<Shared>, host: HostId, stream: StreamId, from: SocketAddr) {
        let unit = &mut self.units[host.index()];
        let functions = unit.settings.functions;
        let Some(machine) = &mut unit.machine else { return };
        let silent = if machine.links.free_index().is_none() { machine.links.oldest_silent() } else { None };
        if let Some(index) = silent {
            machine.links.hub.node.counters.add(NodeCounter::GaveWay, 1);
            self.close(shared, host, index, CloseReason::HelloTimeout);
        }
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        match machine.open(&mut self.network, functions, stream, from, false) {
            None => self.network.reset(stream),
            Some(index) => {
                machine.links.with(&mut self.network, index, |session, cx| session.connected(cx));
                self.work(shared, host, index);
            }
        }
    }

    fn datagram(&mut self, shared: &Rc<Shared>, host: HostId, from: SocketAddr, bytes: &mut [u8]) {
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        let links = &mut machine.links;
        let for_session = datagram::for_session(bytes, links.keys.codes.mode(), links.hub.node.fleet());
        if let Some((LinkId(link), nonce, body)) = for_session.filter(|(link, ..)| links.link_mut(link.0).is_some()) {
            let happened = links.datagram(&mut self.network, link, from, nonce, body);
            self.happened(shared, host, link, happened);
            return self.resume(shared, host);
        }
        links.hub.node.datagram(self.network.clock(host), from, bytes, &links.keys.codes);
        if let Some(address) = links.hub.node.take_duplicate() {
            let peer = Some(links.hub.node.identity().clone());
            let reason = CloseReason::Refused(Refusal::DuplicateIdentity);
            self.log(shared, host, UnitEvent::NotJoined { address, peer, reason });
        }
        self.work_node(shared, host);
    }

    /// Does what the node wants done about claims; whether anything was.
    fn look_at_claims(&mut self, shared: &Rc<Shared>, host: HostId) -> bool {
        let unit = &mut self.units[host.index()];
        let storing = unit.settings.storing;
        let Some(machine) = &mut unit.machine else { return false };
        if let Some((peer, stage)) = machine.links.hub.node.take_hand_over() {
            self.log(shared, host, UnitEvent::HandOver { peer, stage });
            return true;
        }
        match machine.links.hub.node.take_claim_event() {
            None => return false,
            Some(ClaimEvent::Keep(manager, tagged)) if storing != Storing::Hangs => {
                if storing == Storing::Works {
                    unit.claims.obeyed.insert(manager.clone(), tagged);
                    unit.claims.handed = machine.links.hub.node.handed_over(&manager);
                }
                machine.links.hub.node.claim_kept(&manager, tagged.claim, storing == Storing::Works);
            }
            Some(ClaimEvent::Raise(above)) if storing == Storing::Works => {
                unit.claims.own = above.raised(self.network.random().bits());
                let tagged = unit.claims.own.tagged(&unit.settings.identity, &machine.links.keys.codes);
                machine.links.hub.node.set_claim(tagged.unwrap_or_default());
                for index in machine.links.indices() {
                    machine.links.with(&mut self.network, index, |session, cx| session.announce_claim(cx));
                }
                machine.links.hub.node.broadcast(self.network.clock(host));
                let claim = unit.claims.own;
                self.log(shared, host, UnitEvent::Raised { claim });
            }
            Some(ClaimEvent::Lead(above)) if storing != Storing::Hangs => {
                let (now, node) = (self.network.clock(host), &mut machine.links.hub.node);
                if storing == Storing::Fails {
                    node.stand_by(now);
                    return true;
                }
                let claim = unit.claims.own.max(above).raised(self.network.random().bits());
                unit.claims.own = claim;
                let tagged = claim.tagged(&unit.settings.identity, &machine.links.keys.codes);
                if node.lead(now, tagged.unwrap_or_default()) {
                    self.log(shared, host, UnitEvent::TookCommand { claim });
                }
            }
            Some(ClaimEvent::Keep(..) | ClaimEvent::Raise(_) | ClaimEvent::Lead(_)) => {}
            Some(ClaimEvent::Unkept(peer, claim)) => self.log(shared, host, UnitEvent::ClaimNotKept { peer, claim }),
            Some(ClaimEvent::StepDown(by)) => {
                // Stored, so that its next start claims above it.
                unit.claims.own = unit.claims.own.max(by.claim);
                if unit.settings.stands_by {
                    machine.links.hub.node.stand_by(self.network.clock(host));
                    for index in machine.links.indices() {
                        self.close(shared, host, index, CloseReason::StoppedHere);
                    }
                    self.log(shared, host, UnitEvent::StandsBy { by: Some(by.claim) });
                    return true;
                }
                for index in machine.links.indices() {
                    machine
                        .links
                        .with(&mut self.network, index, |session, cx| session.close(cx, CloseReason::StoppedHere));
                }
                self.log(shared, host, UnitEvent::Fenced { claim: by.claim });
                self.network.stop(host);
            }
            Some(_) => {}
        }
        true
    }

    /// The host's interface went or came, or has another address.
    fn network_changed(&mut self, shared: &Rc<Shared>, host: HostId) {
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        let up = self.network.is_plugged(host);
        if up {
            machine.links.hub.node.network_changed(self.network.clock(host));
        }
        self.log(shared, host, UnitEvent::NetworkChanged { up });
        self.work_node(shared, host);
    }

    /// Lets the node do what is due.
    pub(super) fn work_node(&mut self, shared: &Rc<Shared>, host: HostId) {
        loop {
            let Some(machine) = &mut self.units[host.index()].machine else { return };
            match machine.poll_node(&mut self.network, host) {
                Some(command) => self.act(shared, host, command),
                None => break,
            }
        }
        while self.look_at_claims(shared, host) {}
        if let Some(machine) = &mut self.units[host.index()].machine {
            machine.arm_node(&mut self.network, host);
        }
    }

    /// Lets a link do what it can.
    pub(super) fn work(&mut self, shared: &Rc<Shared>, host: HostId, index: u16) {
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        let happened = machine.links.work(&mut self.network, index);
        self.happened(shared, host, index, happened);
        self.resume(shared, host);
    }

    /// Goes on with links that waited for a buffer.
    fn resume(&mut self, shared: &Rc<Shared>, host: HostId) {
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        for index in machine.links.resumable() {
            let Some(machine) = &mut self.units[host.index()].machine else { return };
            let happened = machine.links.work(&mut self.network, index);
            self.happened(shared, host, index, happened);
        }
    }

    fn happened(&mut self, shared: &Rc<Shared>, host: HostId, index: u16, happened: Vec<Happened>) {
        for happened in happened {
            self.one_happened(shared, host, index, happened);
        }
        self.look_at_stops(shared, host);
        // What happened may have left the hub something to do.
        self.work_node(shared, host);
    }

    /// What was stopped through one link may be the order of another one, whose safe hook is due.
    fn look_at_stops(&mut self, shared: &Rc<Shared>, host: HostId) {
        let Some(machine) = &mut self.units[host.index()].machine else { return };
        if machine.links.take_stopped() {
            machine.links.indices().into_iter().for_each(|index| self.work(shared, host, index));
        }
    }

    fn one_happened(&mut self, shared: &Rc<Shared>, host: HostId, index: u16, happened: Happened) {
        match happened {
            (Event::Incoming(call), Some(parameters)) => self.serve(shared, host, index, &call, parameters),
            (Event::Closed(reason), _) => self.closed(shared, host, index, reason),
            (Event::Sample(sample), Some(values)) => {
                let (at, age) = (self.network.now(), sample.age);
                let Some(machine) = &mut self.units[host.index()].machine else { return };
                if let Some(stream) = machine.links.stream_of(index, sample.slot) {
                    machine.links.sample_arrived(index, &stream, Sample { at, age, values: values.into() });
                }
            }
            (Event::Subscribed(slot, answer), _) => {
                let Some(machine) = &mut self.units[host.index()].machine else { return };
                if let Some(stream) = machine.links.stream_of(index, slot) {
                    machine.links.subscription_answered(index, &stream, answer.err());
                }
            }
            (event, _) => {
                if let (Event::ListChanged, Some(machine)) = (event, &mut self.units[host.index()].machine) {
                    machine.links.subscribe(&mut self.network, index);
                    machine.links.arm(&mut self.network, index);
                }
                if let Event::LeaseExpired(slot) = event {
                    self.make_safe(shared, host, slot);
                }
                self.log_of(shared, host, index, event);
            }
        }
    }

    fn act(&mut self, shared: &Rc<Shared>, host: HostId, command: Command<SocketAddr>) {
        match command {
            Command::Dial { to, identity } => self.dial(host, to, identity.as_ref()),
            Command::Notify(LinkId(index), directive) => {
                let Some(machine) = &mut self.units[host.index()].machine else { return };
                let happened = machine.links.direct(&mut self.network, index, directive);
                self.happened(shared, host, index, happened);
                self.resume(shared, host);
            }
        }
    }

    fn dial(&mut self, host: HostId, to: SocketAddr, identity: Option<&Identity>) {
        let unit = &mut self.units[host.index()];
        let functions = unit.settings.functions;
        let Some(machine) = &mut unit.machine else { return };
        let now = self.network.clock(host);
        if machine.links.free_index().is_none() {
            return machine.links.hub.node.dial_failed(now, identity);
        }
        let stream = self.network.connect(host, to);
        if let Some(index) = machine.open(&mut self.network, functions, stream, to, true) {
            machine.links.hub.node.dialing(identity, LinkId(index));
            machine.links.arm(&mut self.network, index);
        }
    }

    fn close(&mut self, shared: &Rc<Shared>, host: HostId, index: u16, reason: CloseReason) {
        if let Some(machine) = &mut self.units[host.index()].machine {
            machine.links.with(&mut self.network, index, |session, cx| session.close(cx, reason));
            self.work(shared, host, index);
        }
    }

    fn closed(&mut self, shared: &Rc<Shared>, host: HostId, index: u16, reason: CloseReason) {
        let now = self.network.clock(host);
        let unit = &mut self.units[host.index()];
        let Some(machine) = &mut unit.machine else { return };
        let Some(link) = machine.links.remove(&mut self.network, index) else { return };
        unit.counters.merge(link.session.counters());
        let reported = UnitEvent::of(Event::Closed(reason), &link.session, &machine.links.functions, str::to_owned);
        Link::abandon(link, Error::Interrupted);
        machine.links.hub.node.left(now, LinkId(index), reason);
        reported.into_iter().for_each(|event| self.log(shared, host, event));
    }

    /// Starts the service of a call.
    fn serve(
        &mut self,
        shared: &Rc<Shared>,
        host: HostId,
        index: u16,
        call: &cara_core::services::session::Incoming,
        parameters: BoxedParameters,
    ) {
        let unit = &mut self.units[host.index()];
        let Some(machine) = &mut unit.machine else { return };
        let Some(function) = machine.links.functions.function(call.slot) else { return };
        let Handler(service) = function.handler;
        let (service, function): (_, Rc<str>) = (Rc::clone(service), Rc::from(function.name()));
        let Some(link) = machine.links.link_mut(index) else { return };
        let Some(caller) = link.session.peer().cloned() else { return };
        let (ticket, stream) = (call.ticket, link.stream);
        let handle = UnitHandle::new(Rc::downgrade(shared), host);
        let (failure, cancelled) = (RefCell::default(), Promise::new());
        let running = Rc::new(Serving { stream, ticket, failure, cancelled });
        machine.links.runs(index, &running);
        let reported = Served {
            running: running.clone(),
            caller: caller.clone(),
            priority: call.priority,
            deadline: self.network.time_of(host, call.deadline),
            wants_reply: call.wants_reply,
            lease: LeaseWatch::new(&service, call.order, &handle),
            unit: handle.clone(),
        };
        if service.begun.is_some() && reported.lease.is_some() {
            let (service, reported) = (Rc::clone(&service), reported.clone());
            let mut arguments = boxed_parameters(size_of_val(&*parameters));
            arguments.copy_from(&parameters).expect("there is as much room");
            self.of_orders.push_back(Box::new(move || service.order_begun(&reported, &arguments)));
        }
        let owner = Owner { host, life: unit.life };
        let job = async move {
            // As on Linux and on boards: its order may have ended, and its safe hook have run, before it is its turn.
            if reported.lease.as_ref().is_some_and(|lease| !lease.is_live()) {
                return handle.answer(stream, ticket, Err(Box::new(CallError::new(Error::Expired, None))));
            }
            let outcome = service.run(reported, parameters).await;
            let failure = running.failure.take();
            let failed = |error| Box::new(CallError::new(Error::Service(error), failure.map(Detail::Service)));
            handle.answer(stream, ticket, outcome.map_err(failed));
        };
        self.spawned.push((owner, Box::pin(job)));
        self.log(shared, host, LogEvent::Called { function: function.to_string(), caller });
    }

    /// The safe hook runs before any other work of any unit.
    fn make_safe(&mut self, shared: &Rc<Shared>, host: HostId, slot: Slot) {
        let Some(machine) = &self.units[host.index()].machine else { return };
        let Some(function) = machine.links.functions.function(slot) else { return };
        let Handler(service) = function.handler;
        let service = Rc::clone(service);
        let handle = UnitHandle::new(Rc::downgrade(shared), host);
        self.of_orders.push_back(Box::new(move || {
            if let Some(actuator) = &service.actuator {
                actuator.make_safe(&handle);
            }
        }));
    }

    /// Logs what an event of a link means to the program.
    fn log_of(&mut self, shared: &Rc<Shared>, host: HostId, index: u16, event: Event) {
        let Some(machine) = &self.units[host.index()].machine else { return };
        let Some(link) = machine.links.link(index) else { return };
        let reported = UnitEvent::of(event, &link.session, &machine.links.functions, str::to_owned);
        reported.into_iter().for_each(|event| self.log(shared, host, event));
    }

    fn log(&mut self, shared: &Rc<Shared>, host: HostId, event: impl Into<LogEvent>) {
        let event = event.into();
        let now = self.network.now();
        self.network.note(host, event.words().as_bytes());
        let unit = &mut self.units[host.index()];
        for (hook, event) in unit.hooks.iter().filter_map(|hook| Some((hook, event.reported()?))) {
            let (hook, event, handle) = (Rc::clone(hook), event.clone(), UnitHandle::new(Rc::downgrade(shared), host));
            self.urgent.push_back(Box::new(move || hook(&handle, &event)));
        }
        unit.log.push((now, event));
    }
}
