//! Terms on Linux: what a unit claims or remembers is kept before it is told; a manager that is fenced steps down.

use std::path::PathBuf;
use std::sync::Mutex;

use cara_core::distribution::connection_handler::NewerTerm;
use cara_core::distribution::identity::Role;
use cara_core::term::Term;
use cara_core::time::{Duration, Instant};

use super::Engine;
use crate::error::StartError;
use crate::event::UnitEvent;
use crate::locks::lock;
use crate::terms::TermFile;

/// A manager that has kept no term, and is fenced by a vehicle, looks for a live one of its identity for so long.
const LOOK: Duration = Duration::from_secs(3);
/// Between two questions meanwhile.
const ASK: Duration = Duration::from_secs(1);

/// A unit's term, as far as this port has to do with it.
pub(super) struct Terms {
    folder: Option<PathBuf>,
    /// A manager starts beside a live one, and fences it.
    pub(super) takes_over: bool,
    state: Mutex<State>,
}

/// Of an m_unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// It has claimed the term behind one that it had kept, or has claimed a second time: what is newer fences it.
    Claimed,
    /// It has claimed without having kept one: it may do so once more, if it is alone.
    Fresh,
    /// It looks whether it is alone, since then: a vehicle has obeyed this term.
    Looking(Instant, Term),
    /// It steps down.
    Fenced,
}

impl Terms {
    pub(super) const fn new(folder: Option<PathBuf>, takes_over: bool) -> Self {
        Self { folder, takes_over, state: Mutex::new(State::Claimed) }
    }
}

impl<T: Send + 'static> Engine<T> {
    #[cfg(feature = "control")]
    pub(crate) const fn takes_over(&self) -> bool {
        self.terms.takes_over
    }

    fn term_file(&self) -> Option<TermFile> {
        let (identity, fleet) = self.identity();
        self.terms.folder.as_ref().map(|folder| TermFile::of(folder, &identity, fleet))
    }

    /// At the start: an s_unit takes the term that it has kept; an m_unit claims the one behind what it has kept and
    /// `heard`, and keeps it before anything is sent with it.
    pub(super) fn claim(&self, heard: Term) -> Result<(), StartError> {
        let (file, is_manager) = (self.term_file(), self.identity().0.role() == Role::MUnit);
        let kept = file.as_ref().map_or(Term::NONE, TermFile::read);
        let term = if is_manager { kept.newer(heard).next() } else { kept };
        if is_manager {
            *lock(&self.terms.state) = if kept == Term::NONE { State::Fresh } else { State::Claimed };
            self.keep(term).map_err(StartError::Term)?;
            if file.is_none() {
                tracing::info!(%term, "no folder of state is set (CARA_STATE): the term of this manager is not kept");
            }
        }
        self.hub().hub.node.set_term(term);
        Ok(())
    }

    fn keep(&self, term: Term) -> Result<(), String> {
        let Some(file) = self.term_file() else { return Ok(()) };
        file.keep(term).map_err(|error| error.to_string())
    }

    /// Does what follows from a newer term that has been proven to the unit. A vehicle keeps it before a call of its manager
    /// runs: this is called before the link of the one that joins is read on.
    pub(super) fn look_at_terms(&self) {
        let newer = self.hub().hub.node.take_newer_term();
        match newer {
            None => {}
            Some(NewerTerm::Obeyed(term)) => match self.keep(term) {
                Ok(()) => tracing::info!(%term, "obeys a manager of a new term"),
                Err(error) => tracing::error!(%term, %error, "the term is obeyed until this unit ends, and not kept"),
            },
            Some(NewerTerm::AtVehicle(term)) => self.fenced_by_vehicle(term),
            Some(NewerTerm::OfManager(term)) => self.step_down(term),
        }
    }

    fn fenced_by_vehicle(&self, term: Term) {
        {
            let mut state = lock(&self.terms.state);
            *state = match *state {
                State::Fresh => State::Looking(self.now(), term),
                State::Looking(since, other) => State::Looking(since, term.newer(other)),
                State::Claimed | State::Fenced => {
                    drop(state);
                    return self.step_down(term);
                }
            };
        }
        tracing::warn!(%term, "a vehicle has obeyed a newer term, and none was kept here: looks for a live manager");
        self.wake_looker();
    }

    /// Where a manager without a kept term is alone, it claims a second time; returns when to look again.
    pub(super) fn watch_terms(&self) -> Instant {
        let State::Looking(since, heard) = *lock(&self.terms.state) else { return Instant::FAR_FUTURE };
        let (now, another) = (self.now(), self.hub().hub.node.another_proven_at());
        if another.is_some_and(|at| at >= since) {
            self.step_down(heard);
            return Instant::FAR_FUTURE;
        }
        if now < since + LOOK {
            self.broadcast();
            return (now + ASK).min(since + LOOK);
        }
        *lock(&self.terms.state) = State::Claimed;
        let term = heard.next();
        match self.keep(term) {
            Ok(()) => {
                tracing::warn!(%term, "no other manager is alive: claims this term");
                self.hub().hub.node.set_term(term);
                self.broadcast();
            }
            Err(error) => {
                tracing::error!(%error, "the term cannot be kept");
                self.step_down(heard);
            }
        }
        Instant::FAR_FUTURE
    }

    /// Another manager commands. Stopping ends the links, and with them all that this one ordered. What was heard is kept, so
    /// that the next start claims the term behind it, if no live manager answers then.
    fn step_down(&self, term: Term) {
        if std::mem::replace(&mut *lock(&self.terms.state), State::Fenced) == State::Fenced {
            return;
        }
        tracing::error!(%term, "another manager of this name and id has taken over: this one steps down");
        let Some(me) = self.me.upgrade() else { return };
        // A thread of the unit would wait for itself.
        let stop = move || {
            me.stop();
            if let Err(error) = me.keep(term) {
                tracing::error!(%error, "the term that was heard is not kept");
            }
            me.tell(UnitEvent::Fenced { term });
        };
        if let Err(error) = std::thread::Builder::new().name("cara-fenced".into()).spawn(stop) {
            tracing::error!(%error, "no thread is left to step down with: tries again when it is fenced again");
            *lock(&self.terms.state) = State::Claimed;
        }
    }
}
