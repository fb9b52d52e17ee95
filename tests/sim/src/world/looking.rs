//! What a test sees of a unit: constraints, counters, log.

use std::rc::Rc;

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::access::Access;
use cara_core::time::Instant;

use super::handle::UnitHandle;
use super::links::SimSession;
use super::state::UnitState;
use super::{LogEvent, UnitEvent};

impl UnitHandle {
    /// Its constraints.
    pub fn constraints(&self) -> Result<Constraints, Error> {
        self.machine(|machine, _| machine.constraints)
    }

    /// Changes its constraints while it runs; peers are told.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.with(|inner| {
            let UnitState { machine, settings, .. } = &mut inner.units[self.host().index()];
            let machine = machine.as_mut().ok_or(Error::NotRunning)?;
            let fits = constraints.message_size <= settings.constraints.message_size
                && usize::from(constraints.maximum_nodes) <= settings.links;
            if !fits {
                return Err(Error::BadConstraint);
            }
            machine.constraints = constraints;
            machine.links.hub.node.set_constraints(constraints);
            Ok(())
        })?;
        self.each_link(|links, network, index| {
            links.with(network, index, |session, cx| session.set_constraints(cx, constraints));
        });
        Ok(())
    }

    /// Another access table for this life of the unit, or none: in force when this returns, and peers are told.
    pub fn set_access(&self, table: Option<&'static dyn Access>) -> Result<(), Error> {
        self.machine(|machine, _| machine.links.access = table)?;
        self.each_link(|links, network, index| {
            links.with(network, index, |session, cx| session.access_changed(cx));
        });
        Ok(())
    }

    /// A counter of all links of all its lives.
    pub fn counted(&self, counter: LinkCounter) -> u64 {
        self.with(|inner| {
            let unit = &inner.units[self.host().index()];
            let live = unit.machine.iter().flat_map(|machine| machine.links.iter());
            live.map(|(_, link)| link.session.counters().value(counter)).sum::<u64>() + unit.counters.value(counter)
        })
    }

    /// A counter of discovery and membership, of this life.
    pub fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.machine(|machine, _| machine.links.hub.node.counters.value(counter)).unwrap_or(0)
    }

    /// When a suspension of it ends; in the past if there is none now.
    pub fn suspended_until(&self) -> Instant {
        self.with(|inner| inner.network.suspended_until(self.host()))
    }

    /// Message buffers that are free now.
    pub fn free_buffers(&self) -> usize {
        self.machine(|machine, _| machine.links.buffers.free()).unwrap_or(0)
    }

    /// Calls of this unit to all peers that wait for a reply.
    pub fn calls_in_flight(&self) -> usize {
        self.sum_of_sessions(|session| session.calls_in_flight())
    }

    /// Calls of all peers that run or wait here.
    pub fn calls_held(&self) -> usize {
        self.sum_of_sessions(|session| usize::from(session.calls_held()))
    }

    /// Everything that happened to it, in all its lives.
    pub fn log(&self) -> Vec<(Instant, LogEvent)> {
        self.with(|inner| inner.units[self.host().index()].log.clone())
    }

    /// How many of the events that its program was told match.
    pub fn count(&self, matches: impl Fn(&UnitEvent) -> bool) -> usize {
        let matches = |(_, event): &&(_, LogEvent)| event.reported().is_some_and(&matches);
        self.with(|inner| inner.units[self.host().index()].log.iter().filter(matches).count())
    }

    /// Runs at each event that its program is told from now on, in all its lives.
    pub fn on_event(&self, hook: impl Fn(&Self, &UnitEvent) + 'static) {
        self.with(|inner| inner.units[self.host().index()].hooks.push(Rc::new(hook)));
    }

    fn sum_of_sessions(&self, count: impl Fn(&SimSession) -> usize) -> usize {
        self.machine(|machine, _| machine.links.iter().map(|(_, link)| count(&link.session)).sum()).unwrap_or(0)
    }
}
