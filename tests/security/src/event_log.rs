//! Event log of an application: joins and calls, by peer.

use std::collections::HashMap;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cara_core::distribution::identity::Identity;
use cara_std::{Definition, Error, MyFunctionList, ParametersView, Served, ServiceError, ServiceOptions, UnitEvent};

use crate::target::Seen;

/// Functions that each target offers, in the order of their slots.
pub const FUNCTIONS: [&str; 3] = ["mark", "go", "stop"];

/// The event log of one unit.
#[derive(Clone, Debug, Default)]
pub struct EventLog(Arc<Mutex<Entries>>);

#[derive(Debug, Default)]
struct Entries {
    of: HashMap<Identity, Seen>,
    ran: Vec<&'static str>,
    calls: u64,
}

impl EventLog {
    fn entries(&self) -> MutexGuard<'_, Entries> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What was seen of one peer.
    pub fn seen(&self, who: &Identity) -> Seen {
        self.entries().of.get(who).cloned().unwrap_or_default()
    }

    /// The sum over all peers.
    pub fn all(&self) -> Seen {
        let entries = self.entries();
        entries.of.values().fold(Seen::default(), |mut all, seen| {
            all.joins += seen.joins;
            all.marks.extend(&seen.marks);
            all
        })
    }

    /// Joins of peers other than these.
    pub fn joins_but_of(&self, these: &[Identity]) -> usize {
        let entries = self.entries();
        let others = entries.of.iter().filter(|(who, _)| !these.contains(who));
        others.map(|(_, seen)| seen.joins).sum()
    }

    /// Names of the functions that ran since the last call.
    pub fn take_ran(&self) -> Vec<&'static str> {
        std::mem::take(&mut self.entries().ran)
    }

    /// How many calls have run in all.
    pub fn calls(&self) -> u64 {
        self.entries().calls
    }

    /// Records joins until the unit is gone.
    pub fn follow(&self, events: Receiver<UnitEvent>) {
        let log = self.clone();
        std::thread::spawn(move || {
            for event in events {
                if let UnitEvent::Joined { peer } = event {
                    log.entries().of.entry(peer).or_default().joins += 1;
                }
            }
        });
    }

    /// Adds the functions; each records its calls.
    pub fn offer<T: Send + 'static>(&self, functions: &MyFunctionList<'_, T>) -> Result<(), Error> {
        for name in FUNCTIONS {
            let definition: Definition = format!("{name}(n: int)").parse().expect("a signature");
            let log = self.clone();
            let note = move |call: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
                let mark = view.variable("n").map_err(|_| ServiceError::BadResults)?;
                let mut entries = log.entries();
                entries.of.entry(call.caller.clone()).or_default().marks.push(mark);
                entries.ran.push(name);
                entries.calls += 1;
                Ok(())
            };
            functions.add_service(&definition, ServiceOptions::new(), note)?;
        }
        Ok(())
    }
}
