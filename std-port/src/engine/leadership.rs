//! Whether this manager leads: its authority has given it the key, the key's time is not over by this unit's clock, and the
//! manager's claim was made under that key. Its loss ends no link and no order.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Condvar, Mutex, PoisonError, Weak};

use cara_core::distribution::claim::Claim;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::claims::Job;
use crate::authority::{Authority, Key};
use crate::error::StartError;
use crate::event::UnitEvent;
use crate::locks::lock;

/// From one question for a key that another one has, or that was not answered, to the next.
const RETRY: Duration = Duration::from_millis(250);
/// From one renewal to the next, however short the key's time is.
const SOONEST: Duration = Duration::from_millis(10);
/// While the key is not wanted, from one look to the next.
const IDLE: Duration = Duration::from_secs(1);
/// A stop waits at most so long for the key to be given back; everything else has ended by then.
const RELEASE: std::time::Duration = std::time::Duration::from_millis(500);
/// A start waits at most so long for the first answer.
const ANSWER: std::time::Duration = std::time::Duration::from_secs(5);

/// What is known of the key, without the locks of the unit.
pub(crate) struct Leadership {
    /// Until the thread that asks has it.
    authority: Mutex<Option<Box<dyn Authority>>>,
    has_authority: bool,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// The unit starts, or runs.
    wanted: bool,
    /// The thread looks at once.
    woken: bool,
    /// It runs.
    asks: bool,
    /// What the start waits for: the first answer.
    answered: bool,
    key: Option<Held>,
    /// Why there is none, as the authority said last.
    refused: Option<String>,
    /// The revision under which the manager's claim was made.
    claimed: Option<u64>,
    /// The application was told that it leads.
    reported: bool,
}

#[derive(Clone, Copy, Debug)]
struct Held {
    revision: u64,
    until: Instant,
}

impl State {
    fn revision(&self, now: Instant) -> Option<u64> {
        self.key.filter(|key| now < key.until).map(|key| key.revision)
    }
}

impl Leadership {
    pub(super) fn new(authority: Option<Box<dyn Authority>>) -> Self {
        let has_authority = authority.is_some();
        Self {
            authority: Mutex::new(authority),
            has_authority,
            state: Mutex::new(State::default()),
            changed: Condvar::new(),
        }
    }

    pub(crate) const fn has_authority(&self) -> bool {
        self.has_authority
    }

    /// The revision above which this manager may claim now; 0 without an authority. `None` without the key.
    pub(super) fn revision(&self, now: Instant) -> Option<u64> {
        if self.has_authority { lock(&self.state).revision(now) } else { Some(0) }
    }

    /// The claim was made under this revision. `false` where the key is not the same any more: then it may not be used.
    pub(super) fn claimed(&self, now: Instant, revision: u64) -> bool {
        let is_held = self.revision(now) == Some(revision);
        if is_held {
            lock(&self.state).claimed = Some(revision);
        }
        is_held
    }

    /// The thread looks at once whether the key is wanted.
    pub(super) fn wake(&self) {
        lock(&self.state).woken = true;
        self.changed.notify_all();
    }

    fn want(&self, wanted: bool) {
        let mut state = lock(&self.state);
        (state.wanted, state.answered) = (wanted, false);
        drop(state);
        self.wake();
    }

    fn sleep(&self, at_most: Duration) {
        let state = lock(&self.state);
        let slept = self.changed.wait_timeout_while(state, at_most.into(), |state| !state.woken);
        slept.unwrap_or_else(PoisonError::into_inner).0.woken = false;
    }

    fn is_wanted(&self) -> bool {
        lock(&self.state).wanted
    }

    fn give_back(&self, authority: &mut dyn Authority) {
        lock(&self.state).key = None;
        if catch_unwind(AssertUnwindSafe(|| authority.release())).is_err() {
            tracing::error!("the authority has panicked: its key stays taken until its time is over");
        }
    }

    /// Waits a moment until the key is given back, so that another manager gets it at once where this process ends.
    pub(super) fn await_release(&self) {
        let state = lock(&self.state);
        drop(self.changed.wait_timeout_while(state, RELEASE, |state| state.asks));
    }

    /// What came of a question that was asked then. Returns when to ask again.
    fn answered(
        &self,
        asked: Instant,
        answer: Result<Option<Key>, Box<dyn std::error::Error + Send + Sync>>,
    ) -> Instant {
        let mut state = lock(&self.state);
        // A first question that failed is asked again: etcd's next member may answer.
        state.answered |= answer.is_ok();
        let (again, refused) = match answer {
            Ok(Some(Key { revision, lasts })) => {
                let lasts = lasts.as_micros();
                state.key = Some(Held { revision, until: asked + Duration::from_micros(lasts - lasts.div_ceil(10)) });
                (Duration::from_micros(lasts / 3).max(SOONEST), None)
            }
            Ok(None) => {
                state.key = None;
                (RETRY, Some("another one has the key".to_owned()))
            }
            Err(error) => (RETRY, Some(error.to_string())),
        };
        if let Some(why) = refused.as_ref().filter(|why| state.refused.as_ref() != Some(why)) {
            tracing::warn!("this manager did not get its authority's key: {why}");
        }
        state.refused = refused;
        self.changed.notify_all();
        asked + again
    }

    /// Waits for the first answer. The revision above which to claim, or why not.
    fn first_answer(&self, now: impl Fn() -> Instant) -> Result<u64, String> {
        let state = lock(&self.state);
        let waited = self.changed.wait_timeout_while(state, ANSWER, |state| !state.answered);
        let state = waited.unwrap_or_else(PoisonError::into_inner).0;
        let why = || state.refused.clone().unwrap_or_else(|| "it does not answer".to_owned());
        state.revision(now()).ok_or_else(why)
    }
}

impl<T: Send + 'static> Engine<T> {
    /// Whether this manager leads.
    pub(crate) fn leads(&self) -> bool {
        self.leads_at(self.now())
    }

    pub(super) fn leads_at(&self, now: Instant) -> bool {
        let state = lock(&self.leadership.state);
        let is_claimed = state.revision(now).is_some_and(|revision| state.claimed == Some(revision));
        drop(state);
        is_claimed && !self.is_stopping() && !self.hub.lock().hub.node.is_standby()
    }

    /// Tells the application whether this manager leads, where that has changed. Returns when the key's time is over.
    pub(super) fn look_at_leadership(&self) -> Instant {
        if !self.leadership.has_authority {
            return Instant::FAR_FUTURE;
        }
        let now = self.now();
        let (leads, claim) = (self.leads_at(now), self.hub.lock().hub.node.claim());
        let mut state = lock(&self.leadership.state);
        let before = std::mem::replace(&mut state.reported, leads);
        let until = state.key.map(|key| key.until).filter(|until| *until > now);
        drop(state);
        if leads != before {
            tracing::warn!(%claim, leads, "whether this manager leads has changed");
            self.notify(if leads { UnitEvent::Leading { claim } } else { UnitEvent::NotLeading });
        }
        until.unwrap_or(Instant::FAR_FUTURE)
    }

    /// From here on the key is asked for while this m_unit commands, or is to command.
    pub(super) fn want_key(&self) -> Result<(), StartError> {
        if !self.leadership.has_authority {
            return Ok(());
        }
        self.leadership.want(true);
        if let Some(authority) = lock(&self.leadership.authority).take() {
            let (me, leadership) = (self.me.clone(), self.leadership.clone());
            lock(&leadership.state).asks = true;
            let keep = move || keep_key(&me, &leadership, authority);
            let spawned = std::thread::Builder::new().name("cara-authority".into()).spawn(keep);
            spawned.map_err(|error| {
                lock(&self.leadership.state).asks = false;
                self.no_authority(error.to_string())
            })?;
        }
        Ok(())
    }

    /// As [`Self::want_key`], and waits for it. Returns the revision above which this manager claims; 0 without an authority.
    pub(super) fn seek_key(&self) -> Result<u64, StartError> {
        if !self.leadership.has_authority {
            return Ok(0);
        }
        self.want_key()?;
        self.leadership.first_answer(|| self.now()).map_err(|why| self.no_authority(why))
    }

    /// A manager starts with a claim above this revision.
    pub(super) fn started_under(&self, revision: u64) -> Result<(), StartError> {
        if self.leadership.claimed(self.now(), revision) {
            return Ok(());
        }
        Err(self.no_authority("the key was lost meanwhile".to_owned()))
    }

    /// The start has failed: the key is for others.
    pub(super) fn give_up_key(&self) {
        self.leadership.want(false);
    }

    fn no_authority(&self, why: String) -> StartError {
        let (identity, fleet) = self.hub.lock().identity();
        StartError::NoAuthority { identity, fleet, why }
    }

    /// A standby that has the key commands, and a manager that has lost it and has it again claims anew.
    fn key_answered(&self) {
        let state = lock(&self.leadership.state);
        let (key, claimed) = (state.revision(self.now()), state.claimed);
        drop(state);
        // A manager that knows of a higher claim raises its own once nobody is heard under that one, with the key or without.
        let (starts, waits) = {
            let node = &self.hub.lock().hub.node;
            (node.starts_above(), node.is_standby() || node.has_rival())
        };
        match (key, starts) {
            (None, _) => {}
            (Some(_), Some(above)) => self.leave_to_writer(Job::Lead(above)),
            (Some(_), None) if waits || claimed.is_none() || claimed == key => {}
            (Some(_), None) => self.leave_to_writer(Job::Raise(Claim::NONE)),
        }
        self.driver.wake();
    }
}

/// What the thread does that asks the authority, until the unit stops.
fn keep_key<T: Send + 'static>(me: &Weak<Engine<T>>, leadership: &Leadership, mut authority: Box<dyn Authority>) {
    let running = || me.upgrade().filter(|engine| !engine.is_stopping());
    let mut has_asked = false;
    while let Some(engine) = running() {
        let clock = engine.driver.clock();
        let ((identity, fleet), is_to_command) = {
            let cell = engine.hub.lock();
            let node = &cell.hub.node;
            (cell.identity(), !node.is_standby() || node.starts_above().is_some())
        };
        // The authority may not answer for a long time.
        drop(engine);
        let pause = if is_to_command && leadership.is_wanted() {
            has_asked = true;
            let asked = clock.now();
            let answer = catch_unwind(AssertUnwindSafe(|| authority.hold(&identity, fleet)));
            let again = leadership.answered(asked, answer.unwrap_or_else(|_| Err("the authority has panicked".into())));
            if let Some(engine) = running() {
                engine.key_answered();
            }
            again.since(clock.now())
        } else {
            if std::mem::take(&mut has_asked) {
                leadership.give_back(&mut *authority);
            }
            IDLE
        };
        leadership.sleep(pause);
    }
    leadership.give_back(&mut *authority);
    lock(&leadership.state).asks = false;
    leadership.changed.notify_all();
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Instant = Instant::from_micros(10_000_000);

    fn after(millis: u64) -> Instant {
        START + Duration::from_millis(millis)
    }

    fn key(revision: u64) -> Option<Key> {
        Some(Key { revision, lasts: Duration::from_secs(1) })
    }

    struct Never;

    impl Authority for Never {
        fn hold(
            &mut self,
            _: &cara_core::distribution::identity::Identity,
            _: cara_core::distribution::identity::Fleet,
        ) -> Result<Option<Key>, Box<dyn std::error::Error + Send + Sync>> {
            Ok(None)
        }

        fn release(&mut self) {}
    }

    fn leadership() -> Leadership {
        Leadership::new(Some(Box::new(Never)))
    }

    #[test]
    fn the_holder_counts_from_before_it_asked_and_ten_percent_less() {
        let leadership = leadership();
        assert_eq!(leadership.revision(START), None);
        assert_eq!(leadership.answered(START, Ok(key(7))), START + Duration::from_micros(333_333));
        assert_eq!([899, 900].map(|millis| leadership.revision(after(millis))), [Some(7), None]);
        // An answer that came late says as much of the time before it as one at once.
        leadership.answered(after(300), Ok(key(7)));
        assert_eq!([1199, 1200].map(|millis| leadership.revision(after(millis))), [Some(7), None]);
    }

    #[test]
    fn an_error_leaves_the_key_its_time_and_another_holder_takes_it_at_once() {
        let leadership = leadership();
        leadership.answered(START, Ok(key(7)));
        assert_eq!(leadership.answered(after(300), Err("it is down".into())), after(300) + RETRY);
        assert_eq!([899, 900].map(|millis| leadership.revision(after(millis))), [Some(7), None]);
        leadership.answered(after(400), Ok(key(7)));
        leadership.answered(after(500), Ok(None));
        assert_eq!(leadership.revision(after(500)), None);
    }

    #[test]
    fn a_claim_counts_only_under_the_key_that_it_was_made_with() {
        let leadership = leadership();
        leadership.answered(START, Ok(key(7)));
        assert!(leadership.claimed(START, 7));
        // While it was stored the key was lost, and had again.
        leadership.answered(START, Ok(key(9)));
        assert!(!leadership.claimed(START, 7) && leadership.claimed(START, 9) && !leadership.claimed(after(900), 9));
        assert_eq!(Leadership::new(None).revision(START), Some(0), "whoever has no authority may always claim");
    }
}
