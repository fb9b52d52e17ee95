//! Claims on Linux: what a unit claims or obeys is stored, on a thread of its own while the unit runs, and what the node decides
//! about them is done.

use std::fs::File;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime};

use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::connection_handler::ClaimEvent;
use cara_core::distribution::hello::ClaimReport;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::time::Duration;
use core::net::SocketAddr;

use super::Engine;
use crate::claims::ClaimFile;
use crate::error::StartError;
use crate::event::UnitEvent;
use crate::keys::{KeptClaims, KeptObeyed, KeyRing};
use crate::locks::lock;
use crate::sys::random;

/// Claims that wait to be stored; a further one is not.
const WAITING: usize = 16;
/// So long after a take-over another one has to be forced.
const TAKE_OVER_REST: Duration = Duration::from_secs(60);

/// Whether a manager starts although a live one of its identity answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TakeOver {
    No,
    Yes,
    /// Also where another one has taken over within the last minute.
    Forced,
}

/// A manager that steps down waits at most so long for its disk, and looks this often.
const STORING: std::time::Duration = std::time::Duration::from_secs(2);
const LOOK: std::time::Duration = std::time::Duration::from_millis(5);

/// What is stored, and by whom.
pub(super) struct Claims {
    folder: Option<PathBuf>,
    /// A manager starts beside a live one, and fences it.
    pub(super) take_over: TakeOver,
    writer: Mutex<Writer>,
    /// Says that the unit runs.
    held: Mutex<Option<File>>,
}

/// The thread that writes the file.
#[derive(Debug, Default)]
struct Writer {
    kept: KeptClaims,
    waiting: Vec<Job>,
    runs: bool,
    /// The unit steps down.
    ends: bool,
}

#[derive(Debug)]
enum Job {
    Keep(Identity, TaggedClaim),
    Raise(Claim),
    /// Of a manager that steps down.
    Heard(Claim),
}

impl Claims {
    pub(super) fn new(folder: Option<PathBuf>, take_over: TakeOver) -> Self {
        Self { folder, take_over, writer: Mutex::default(), held: Mutex::default() }
    }
}

impl<T: Send + 'static> Engine<T> {
    #[cfg(feature = "control")]
    pub(crate) fn takes_over(&self) -> bool {
        self.claims.take_over != TakeOver::No
    }

    fn claim_file(&self) -> Option<ClaimFile> {
        let (identity, fleet) = self.hub.lock().identity();
        self.claims.folder.as_ref().map(|folder| ClaimFile::of(folder, &identity, fleet))
    }

    fn store(&self, kept: &KeptClaims) -> Result<(), String> {
        self.claim_file().map_or(Ok(()), |file| file.keep(kept).map_err(|error| error.to_string()))
    }

    /// A live manager of this identity was found before the start: whether this one starts all the same.
    pub(super) fn may_start_beside(&self, at: SocketAddr, running: Option<&ClaimReport>) -> Result<(), StartError> {
        let (identity, fleet) = self.hub.lock().identity();
        let since = running.map_or(ClaimReport::NEVER, |report| report.since);
        let rests = Duration::from_millis(since.into()) >= TAKE_OVER_REST;
        match self.claims.take_over {
            TakeOver::Forced => return Ok(()),
            TakeOver::Yes if rests => return Ok(()),
            TakeOver::Yes | TakeOver::No => {}
        }
        // What was heard is stored, so that the next start claims above it.
        let heard = running.map_or(Claim::NONE, ClaimReport::claim);
        if let Some(file) = self.claim_file() {
            let kept = file.read();
            if heard > kept.own
                && let Err(error) = file.keep(&KeptClaims { own: heard, ..kept })
            {
                tracing::error!(%error, "the claim that was heard is not stored");
            }
        }
        match self.claims.take_over {
            TakeOver::No => Err(StartError::AlreadyRunning { identity, fleet, at }),
            _ => Err(StartError::JustTakenOver { identity, fleet, at }),
        }
    }

    /// At the start: a unit obeys what it has stored. An m_unit claims above what it has stored and `heard`, and stores that
    /// before anything is sent with it.
    pub(super) fn claim(&self, heard: Claim) -> Result<(), StartError> {
        let (identity, _) = self.hub.lock().identity();
        let file = self.claim_file();
        if let Some(file) = &file {
            // Before it is read: what is forgotten later would be written back. Where nothing can be written, nothing can be forgotten.
            *lock(&self.claims.held) = file.hold().ok();
        }
        let mut kept = file.as_ref().map(ClaimFile::read).unwrap_or_default();
        let codes = self.keys().codes();
        if identity.role() == Role::MUnit {
            if file.is_none() {
                tracing::info!("no folder of state is set (CARA_STATE): the claim of this manager is not stored");
                // By the clock it is above that of its last start, mostly; otherwise vehicles fence it until it raises its claim.
                let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
                kept.own.term = since.map_or(0, |since| since.as_secs());
            }
            kept.own = kept.own.max(heard).raised(random());
            let Some(tagged) = kept.own.tagged(&identity, &codes) else {
                return Err(StartError::NoOwnKey { identity });
            };
            self.store(&kept).map_err(StartError::Claim)?;
            let mut cell = self.hub.lock();
            cell.hub.node.set_claim(tagged);
            if self.claims.take_over != TakeOver::No {
                cell.hub.node.take_over(self.now());
            }
        }
        if let Some(live) = self.keys().ring() {
            let ring = live.ring();
            let mut cell = self.hub.lock();
            // With other keys than it was obeyed with, a claim does not count.
            kept.obeyed.retain(|obeyed| has_key(&ring, obeyed));
            for KeptObeyed { manager, tagged, .. } in &kept.obeyed {
                cell.hub.node.keep_obeyed(self.now(), manager, *tagged);
            }
            if file.is_some() {
                cell.hub.node.store_claims();
            }
        }
        lock(&self.claims.writer).kept = kept;
        Ok(())
    }

    /// Does what the node wants done about claims.
    pub(super) fn look_at_claims(&self) {
        loop {
            let event = self.hub.lock().hub.node.take_claim_event();
            match event {
                None => return,
                Some(ClaimEvent::Keep(manager, tagged)) => self.leave_to_writer(Job::Keep(manager, tagged)),
                Some(ClaimEvent::Raise(above)) => self.leave_to_writer(Job::Raise(above)),
                Some(ClaimEvent::Unkept(peer, claim)) => {
                    tracing::error!(%claim, manager = peer.name(), "a claim is obeyed until this unit ends, and is not stored");
                    self.notify(UnitEvent::ClaimNotKept { peer, claim });
                }
                Some(ClaimEvent::StepDown(by)) => self.step_down(by.claim),
                Some(event) => tracing::debug!(?event, "not understood"),
            }
        }
    }

    /// The thread that writes is started where it does not run; a hung disk holds up nothing else.
    fn leave_to_writer(&self, job: Job) {
        let mut writer = lock(&self.claims.writer);
        if writer.waiting.len() >= WAITING {
            drop(writer);
            return self.failed(&job);
        }
        writer.waiting.push(job);
        if std::mem::replace(&mut writer.runs, true) {
            return;
        }
        drop(writer);
        let Some(me) = self.me.upgrade() else { return };
        let started = std::thread::Builder::new().name("cara-claims".into()).spawn(move || me.write_claims());
        if let Err(error) = started {
            tracing::error!(%error, "no thread is left to store a claim with");
            let mut writer = lock(&self.claims.writer);
            writer.runs = false;
            let jobs = std::mem::take(&mut writer.waiting);
            drop(writer);
            jobs.iter().for_each(|job| self.failed(job));
        }
    }

    fn failed(&self, job: &Job) {
        if let Job::Keep(manager, tagged) = job {
            self.hub.lock().hub.node.claim_kept(manager, tagged.claim, false);
            self.driver.wake();
        }
    }

    /// What the thread that writes does, until nothing waits.
    fn write_claims(self: Arc<Self>) {
        loop {
            let (job, mut kept) = {
                let mut writer = lock(&self.claims.writer);
                if writer.waiting.is_empty() {
                    writer.runs = false;
                    return;
                }
                (writer.waiting.remove(0), writer.kept.clone())
            };
            match job {
                Job::Keep(manager, tagged) => self.keep_obeyed(kept, manager, tagged),
                Job::Heard(claim) => {
                    kept.own = kept.own.max(claim);
                    if let Err(error) = self.store(&kept) {
                        tracing::error!(%error, "the claim that was heard is not stored");
                    }
                }
                Job::Raise(above) => {
                    kept.own = above.raised(random());
                    match self.store(&kept) {
                        Ok(()) => self.raised(kept),
                        Err(error) => tracing::error!(%error, "a raised claim cannot be stored, and is not announced"),
                    }
                }
            }
        }
    }

    fn keep_obeyed(&self, mut kept: KeptClaims, manager: Identity, tagged: TaggedClaim) {
        let ring = self.keys().ring().map(|live| live.ring());
        let key = ring.as_ref().and_then(|ring| ring.pair(&manager)).map(|key| key.fingerprint());
        let Some(key) = key else { return self.failed(&Job::Keep(manager, tagged)) };
        let obeyed = KeptObeyed { manager: manager.clone(), tagged, key };
        if kept.obeyed.contains(&obeyed) {
            return self.hub.lock().hub.node.claim_kept(&manager, tagged.claim, true);
        }
        kept.obeyed.retain(|obeyed| obeyed.manager != manager);
        kept.obeyed.push(obeyed);
        match self.store(&kept) {
            Ok(()) => {
                tracing::info!(claim = %tagged.claim, manager = manager.name(), "a claim is obeyed, and stored");
                lock(&self.claims.writer).kept = kept;
                self.hub.lock().hub.node.claim_kept(&manager, tagged.claim, true);
                self.links.look_at_orders();
            }
            Err(error) => {
                tracing::error!(%error, "a claim cannot be stored");
                self.failed(&Job::Keep(manager, tagged));
            }
        }
    }

    /// The raised claim is stored: it counts, and all peers hear of it.
    fn raised(&self, kept: KeptClaims) {
        let claim = kept.own;
        tracing::warn!(%claim, "no other manager of this identity answers: its claim is raised above the one that vehicles obeyed");
        lock(&self.claims.writer).kept = kept;
        self.announce_claim(claim);
        self.notify(UnitEvent::Raised { claim });
        self.broadcast();
    }

    /// Tells all peers this manager's claim, with a tag of the keys as they are now.
    pub(super) fn announce_claim(&self, claim: Claim) {
        let (identity, _) = self.hub.lock().identity();
        let Some(tagged) = claim.tagged(&identity, &self.keys().codes()) else { return };
        self.hub.lock().hub.node.set_claim(tagged);
        for link in self.links.all() {
            let mut state = link.lock();
            self.with(&link, &mut state, |session, cx| session.announce_claim(cx));
            self.settle(&link, state);
        }
    }

    /// A live manager of this identity has a higher claim. Stopping ends the links, and with them all that this one ordered. What
    /// was heard is stored, so that the next start claims above it.
    fn step_down(&self, claim: Claim) {
        if std::mem::replace(&mut lock(&self.claims.writer).ends, true) {
            return;
        }
        tracing::error!(%claim, "another manager of this name and id commands with a higher claim: this one steps down");
        let Some(me) = self.me.upgrade() else { return };
        // A thread of the unit would wait for itself.
        let stop = move || {
            me.stop();
            // Before the application hears of it and ends; a hung disk does not keep it from ending.
            me.leave_to_writer(Job::Heard(claim));
            let until = Instant::now() + STORING;
            while lock(&me.claims.writer).runs && Instant::now() < until {
                std::thread::sleep(LOOK);
            }
            me.notify(UnitEvent::Fenced { claim });
        };
        if let Err(error) = std::thread::Builder::new().name("cara-fenced".into()).spawn(stop) {
            tracing::error!(%error, "no thread is left to step down with: tries again when the other one is heard again");
            lock(&self.claims.writer).ends = false;
        }
    }
}

/// Whether the pair key with which a claim was obeyed is still there.
fn has_key(ring: &KeyRing, obeyed: &KeptObeyed) -> bool {
    let has = ring.pairs(&obeyed.manager).any(|(_, key)| key.fingerprint() == obeyed.key);
    if !has {
        tracing::info!(manager = obeyed.manager.name(), "a stored claim does not count: the keys are other ones");
    }
    has
}
