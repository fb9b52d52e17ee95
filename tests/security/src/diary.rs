//! What an application sees: who joined, and which calls were run for whom.

use std::collections::HashMap;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cara_core::distribution::identity::Identity;
use cara_std::{Call, Definition, Error, MyFunctionList, ParametersView, ServiceError, ServiceOptions, UnitEvent};

use crate::target::Seen;

/// Functions that each target offers, in the order of their slots.
pub const FUNCTIONS: [&str; 3] = ["mark", "go", "stop"];

/// Notes of one unit.
#[derive(Clone, Debug, Default)]
pub struct Diary(Arc<Mutex<Pages>>);

#[derive(Debug, Default)]
struct Pages {
    of: HashMap<Identity, Seen>,
    ran: Vec<&'static str>,
}

impl Diary {
    fn pages(&self) -> MutexGuard<'_, Pages> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What was seen of somebody.
    pub fn seen(&self, who: &Identity) -> Seen {
        self.pages().of.get(who).cloned().unwrap_or_default()
    }

    /// Everything of everybody.
    pub fn all(&self) -> Seen {
        let pages = self.pages();
        pages.of.values().fold(Seen::default(), |mut all, seen| {
            all.joins += seen.joins;
            all.marks.extend(&seen.marks);
            all
        })
    }

    /// How often others than these joined.
    pub fn joins_but_of(&self, these: &[Identity]) -> usize {
        let pages = self.pages();
        let others = pages.of.iter().filter(|(who, _)| !these.contains(who));
        others.map(|(_, seen)| seen.joins).sum()
    }

    /// Names of the functions that ran since this was asked last.
    pub fn take_ran(&self) -> Vec<&'static str> {
        std::mem::take(&mut self.pages().ran)
    }

    /// Notes who joins, until the unit is gone.
    pub fn follow(&self, events: Receiver<UnitEvent>) {
        let diary = self.clone();
        std::thread::spawn(move || {
            for event in events {
                if let UnitEvent::Joined { peer } = event {
                    diary.pages().of.entry(peer).or_default().joins += 1;
                }
            }
        });
    }

    /// Adds the functions, which note their calls.
    pub fn offer<T: Send + 'static>(&self, functions: &MyFunctionList<'_, T>) -> Result<(), Error> {
        for name in FUNCTIONS {
            let definition: Definition = format!("{name}(n: int)").parse().expect("a signature");
            let diary = self.clone();
            let note = move |call: &Call, view: &mut ParametersView| -> Result<(), ServiceError> {
                let mark = view.variable("n").map_err(|_| ServiceError::BadResults)?;
                let mut pages = diary.pages();
                pages.of.entry(call.caller.clone()).or_default().marks.push(mark);
                pages.ran.push(name);
                Ok(())
            };
            functions.add_service(&definition, ServiceOptions::new(), note)?;
        }
        Ok(())
    }
}
