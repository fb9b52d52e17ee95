//! The unit's access table: lent to every session, changed while the unit runs, asked for the operator.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, RwLock};

use cara_core::services::access::{Access, Bucket, Decision, Principal, Verb};
use cara_core::time::{Duration, Instant};

#[cfg(feature = "control")]
use super::links::Links;
use crate::access::AccessTable;
use crate::locks::{lock, read, write};

/// The table in force, and what came of it.
#[derive(Default)]
pub(crate) struct Guard {
    /// Whether there is a table: looked at for every event, without a lock.
    is_set: AtomicBool,
    table: RwLock<Option<Arc<AccessTable>>>,
    logged: Mutex<Option<Instant>>,
    operator: Mutex<HashMap<String, Bucket>>,
    operator_refused: AtomicU64,
    pub(super) file: FileCounts,
}

/// What came of the file that the table is read from.
#[derive(Default)]
pub(super) struct FileCounts {
    pub(super) reloads: AtomicU64,
    pub(super) mistakes: AtomicU64,
    /// The file is not what is in force.
    pub(super) is_wrong: AtomicBool,
}

/// The table while a session has it.
pub(crate) struct Asked<'g> {
    table: Arc<AccessTable>,
    guard: &'g Guard,
}

impl Access for Asked<'_> {
    fn decide(&self, who: Principal<'_>, function: &str, verb: Verb) -> Decision {
        self.table.decide(who, function, verb)
    }

    fn may_log(&self, now: Instant) -> bool {
        self.guard.may_log(now)
    }
}

impl Guard {
    /// The table, for a session.
    pub(super) fn ask(&self) -> Option<Asked<'_>> {
        let table = self.table()?;
        Some(Asked { table, guard: self })
    }

    /// The table in force.
    pub(crate) fn table(&self) -> Option<Arc<AccessTable>> {
        if !self.is_set.load(Ordering::Acquire) {
            return None;
        }
        read(&self.table).clone()
    }

    pub(super) fn set(&self, table: Option<AccessTable>) {
        let is_set = table.is_some();
        let mut current = write(&self.table);
        *current = table.map(Arc::new);
        self.is_set.store(is_set, Ordering::Release);
        lock(&self.operator).clear();
    }

    pub(super) fn operator_refused(&self) -> u64 {
        self.operator_refused.load(Ordering::Relaxed)
    }

    /// One line a second of the whole unit, however many links have something to tell.
    fn may_log(&self, now: Instant) -> bool {
        let mut logged = lock(&self.logged);
        let due = logged.is_none_or(|logged| now >= logged + Duration::from_secs(1));
        if due {
            *logged = Some(now);
        }
        due
    }
}

#[cfg(feature = "control")]
mod operator {
    use cara_core::error::Error;
    use cara_core::services::access::Rate;

    use super::*;

    /// Functions for which the operator's use of a rate is remembered. Beyond that, those with a full rate are forgotten.
    const OPERATOR_BUCKETS: usize = 256;

    impl Guard {
        fn take(&self, now: Instant, function: &str, rate: Rate) -> Result<(), Error> {
            let mut buckets = lock(&self.operator);
            if buckets.len() >= OPERATOR_BUCKETS {
                buckets.retain(|_, bucket| !bucket.is_full(now));
            }
            buckets.entry(function.to_owned()).or_default().take(now, rate)
        }

        /// Whether the operator may do something; a refusal is counted, and told in the log once a second at most.
        pub(crate) fn operator_may(
            &self,
            links: &Links,
            now: Instant,
            function: &str,
            verb: Verb,
        ) -> Result<(), Error> {
            let Some(table) = self.table() else { return Ok(()) };
            let decision = match table.decide(Principal::Operator, function, verb) {
                Decision::Allowed { rate: Some(rate), .. } if verb == Verb::Call => {
                    let taken = self.take(now, function, rate);
                    // No rate applies to stops and other emergencies.
                    taken.or_else(|error| if is_urgent(links, function) { Ok(()) } else { Err(error) })
                }
                Decision::Allowed { .. } => Ok(()),
                Decision::Denied => Err(Error::NotAllowed),
            };
            decision.inspect_err(|error| {
                self.operator_refused.fetch_add(1, Ordering::Relaxed);
                if self.may_log(now) {
                    tracing::warn!(function, ?verb, %error, "the access table does not let the operator do this");
                }
            })
        }

        /// Whether the operator may call a function, whatever its rate.
        pub(crate) fn operator_may_go_on(&self, function: &str) -> bool {
            self.operator_has(function, Verb::Call)
        }

        /// Whether the operator may see a function of another node.
        pub(crate) fn operator_sees(&self, function: &str) -> bool {
            self.operator_has(function, Verb::Call) || self.operator_has(function, Verb::List)
        }

        fn operator_has(&self, function: &str, verb: Verb) -> bool {
            let table = self.table();
            table.is_none_or(|table| table.decide(Principal::Operator, function, verb).is_allowed())
        }
    }

    /// Whether a function of this name stops something, or is an emergency service, at any node.
    fn is_urgent(links: &Links, function: &str) -> bool {
        links.all().iter().any(|link| {
            let state = link.lock();
            let known = state.session.their_function_list().named(function);
            known.is_some_and(|known| known.attributes.is_urgent(known.attributes.priority))
        })
    }
}

#[cfg(feature = "access")]
pub(super) mod following {
    use cara_core::error::Error;

    use super::*;
    use crate::access::AccessError;

    /// Between two looks at the file. A change counts when two looks have found it the same.
    const LOOK: std::time::Duration = std::time::Duration::from_millis(400);

    /// Looks at the table's file in a thread of its own, until `look` says that it is over: a disk may take its time.
    pub(crate) fn follow(mut look: impl FnMut() -> bool + Send + 'static) -> Result<(), Error> {
        let run = move || {
            while look() {
                std::thread::park_timeout(LOOK);
            }
        };
        let thread = std::thread::Builder::new().name("cara-access".into());
        thread.spawn(run).map(drop).map_err(crate::error::system_refused)
    }

    impl Guard {
        /// The table that was read, if it is to be set. A mistake keeps the one that is in force.
        pub(crate) fn read(&self, read: Result<AccessTable, AccessError>) -> Option<AccessTable> {
            self.file.is_wrong.store(read.is_err(), Ordering::Relaxed);
            match read {
                Ok(table) => {
                    tracing::info!(file = table.source(), rules = table.rules().len(), "the access table has changed");
                    Some(table)
                }
                Err(error) => {
                    self.file.mistakes.fetch_add(1, Ordering::Relaxed);
                    tracing::error!("the access table stays as it was:\n{error}");
                    None
                }
            }
        }
    }
}
