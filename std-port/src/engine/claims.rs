//! Claims on Linux: what a unit claims or obeys is stored, on a thread of its own while the unit runs, and what the node decides
//! about them is done.

use std::fs::File;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::{Instant, SystemTime};

use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::hello::ClaimReport;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::time::Duration;
use core::net::SocketAddr;

use super::hub::SharedHub;
use super::keys::Keys;
use crate::claims::ClaimFile;
use crate::clock::Clock;
use crate::error::StartError;
use crate::keys::{KeptClaims, KeptHandOver, KeptObeyed, KeyRing};
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
pub(crate) struct Claims {
    folder: Option<PathBuf>,
    /// A manager starts beside a live one, and fences it.
    take_over: TakeOver,
    /// It starts as a standby, and is one again when it steps down.
    stands_by: bool,
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
    /// Storing has failed since: what the file says is not known.
    is_unsure: bool,
    /// The unit steps down.
    ends: bool,
}

/// What is to be stored.
#[derive(Debug)]
pub(super) enum Job {
    Keep(Identity, TaggedClaim),
    Raise(Claim),
    /// Of a standby that is to command.
    Lead(Claim),
    /// Of a manager that steps down.
    Heard(Claim),
}

impl Job {
    /// Takes a job of the same kind in, so that no more than one of each of these waits: the higher claim is enough.
    fn merge(&mut self, job: Self) -> Option<Self> {
        match (self, job) {
            (Self::Raise(above), Self::Raise(other))
            | (Self::Lead(above), Self::Lead(other))
            | (Self::Heard(above), Self::Heard(other)) => *above = (*above).max(other),
            (_, job) => return Some(job),
        }
        None
    }
}

/// What came of a job.
pub(super) enum Written {
    Nothing,
    /// A claim is not stored.
    Failed(Job),
    /// Orders may not be obeyed any more.
    Obeyed,
    /// The claim, raised under this revision of the authority's key, is stored: it counts.
    Raised(Claim, u64),
    /// The same of a standby's first one.
    Leads(Claim, u64),
}

impl Claims {
    pub(super) fn new(folder: Option<PathBuf>, take_over: TakeOver, stands_by: bool) -> Self {
        Self { folder, take_over, stands_by, writer: Mutex::default(), held: Mutex::default() }
    }

    pub(crate) fn takes_over(&self) -> bool {
        self.take_over != TakeOver::No
    }

    pub(crate) fn stands_by(&self) -> bool {
        self.stands_by
    }

    fn file(&self, hub: &SharedHub) -> Option<ClaimFile> {
        let (identity, fleet) = hub.lock().identity();
        self.folder.as_ref().map(|folder| ClaimFile::of(folder, &identity, fleet))
    }

    fn store(&self, hub: &SharedHub, kept: &KeptClaims) -> Result<(), String> {
        let result = self.file(hub).map_or(Ok(()), |file| file.keep(kept).map_err(|error| error.to_string()));
        // It may have failed when the new file was in its place already.
        lock(&self.writer).is_unsure = result.is_err();
        result
    }

    /// A live manager of this identity was found before the start: whether this one starts all the same.
    pub(super) fn may_start_beside(
        &self,
        hub: &SharedHub,
        at: SocketAddr,
        running: Option<&ClaimReport>,
    ) -> Result<(), StartError> {
        let (identity, fleet) = hub.lock().identity();
        let since = running.map_or(ClaimReport::NEVER, |report| report.since);
        let rests = Duration::from_millis(since.into()) >= TAKE_OVER_REST;
        match self.take_over {
            TakeOver::Forced => return Ok(()),
            TakeOver::Yes if rests => return Ok(()),
            TakeOver::Yes | TakeOver::No => {}
        }
        // What was heard is stored, so that the next start claims above it.
        let heard = running.map_or(Claim::NONE, ClaimReport::claim);
        if let Some(file) = self.file(hub) {
            let kept = file.read();
            if heard > kept.own
                && let Err(error) = file.keep(&KeptClaims { own: heard, ..kept })
            {
                tracing::error!(%error, "the claim that was heard is not stored");
            }
        }
        match self.take_over {
            TakeOver::No => Err(StartError::AlreadyRunning { identity, fleet, at }),
            _ => Err(StartError::JustTakenOver { identity, fleet, at }),
        }
    }

    /// At the start: a unit obeys what it has stored. An m_unit claims above what it has stored and `heard`, and stores that
    /// before anything is sent with it; a standby sees that it can.
    pub(super) fn claim(&self, hub: &SharedHub, keys: &Keys, clock: Clock, heard: Claim) -> Result<(), StartError> {
        let (identity, _) = hub.lock().identity();
        let file = self.file(hub);
        if let Some(file) = &file {
            // Before it is read: what is forgotten later would be written back. Where nothing can be written, nothing can be forgotten.
            *lock(&self.held) = file.hold().ok();
        }
        let mut kept = file.as_ref().map(ClaimFile::read).unwrap_or_default();
        let codes = keys.codes();
        if identity.role() == Role::MUnit {
            if file.is_none() {
                tracing::info!("no folder of state is set (CARA_STATE): the claim of this manager is not stored");
                // The clock usually makes it higher than at the last start, also within a second of that one; if not, vehicles fence it
                // until it raises its claim.
                let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
                kept.own.term = since.map_or(0, |since| u64::try_from(since.as_millis()).unwrap_or_default());
            }
            if !self.stands_by {
                kept.own = kept.own.max(heard).raised(random());
            }
            let Some(tagged) = kept.own.tagged(&identity, &codes) else {
                return Err(StartError::NoOwnKey { identity });
            };
            self.store(hub, &kept).map_err(StartError::Claim)?;
            let node = &mut hub.lock().hub.node;
            if self.stands_by {
                node.stand_by(clock.now());
            } else {
                node.set_claim(tagged);
            }
            if self.takes_over() {
                node.take_over(clock.now());
            }
        }
        if let Some(live) = keys.ring() {
            let ring = live.ring();
            let mut cell = hub.lock();
            // With other keys than it was obeyed with, a claim does not count.
            kept.obeyed.retain(|obeyed| has_key(&ring, obeyed));
            for KeptObeyed { manager, tagged, .. } in &kept.obeyed {
                cell.hub.node.keep_obeyed(clock.now(), manager, *tagged);
            }
            if let Some(KeptHandOver { home, present }) =
                kept.handed.as_ref().filter(|kept| ring.pair(&kept.present).is_some())
            {
                cell.hub.node.belong_to(home, present);
            }
            if file.is_some() {
                cell.hub.node.store_claims();
            }
        }
        lock(&self.writer).kept = kept;
        Ok(())
    }

    /// Has the thread that writes do a job. Where it does not run, one is started, which does what `write` does: a hung disk
    /// holds up nothing else. Returns the jobs that are not done.
    pub(super) fn leave_to_writer(&self, job: Job, write: impl FnOnce() + Send + 'static) -> Vec<Job> {
        let mut writer = lock(&self.writer);
        let Some(job) = writer.waiting.iter_mut().try_fold(job, |job, waiting| waiting.merge(job)) else {
            return Vec::new();
        };
        if writer.waiting.len() >= WAITING {
            return vec![job];
        }
        writer.waiting.push(job);
        if std::mem::replace(&mut writer.runs, true) {
            return Vec::new();
        }
        drop(writer);
        let Err(error) = std::thread::Builder::new().name("cara-claims".into()).spawn(write) else { return Vec::new() };
        tracing::error!(%error, "no thread is left to store a claim with");
        let mut writer = lock(&self.writer);
        writer.runs = false;
        std::mem::take(&mut writer.waiting)
    }

    /// What the thread that writes does, until nothing waits. Without a `revision` above which to claim, nothing is claimed.
    pub(super) fn write_next(&self, hub: &SharedHub, keys: &Keys, revision: Option<u64>) -> Option<Written> {
        let (job, mut kept) = {
            let mut writer = lock(&self.writer);
            if writer.waiting.is_empty() {
                writer.runs = false;
                return None;
            }
            (writer.waiting.remove(0), writer.kept.clone())
        };
        Some(match job {
            Job::Keep(manager, tagged) => self.keep_obeyed(hub, keys, kept, manager, tagged),
            Job::Heard(claim) => {
                kept.own = kept.own.max(claim);
                match self.store(hub, &kept) {
                    Ok(()) => lock(&self.writer).kept = kept,
                    Err(error) => tracing::error!(%error, "the claim that was heard is not stored"),
                }
                Written::Nothing
            }
            Job::Raise(above) | Job::Lead(above) => {
                let Some(revision) = revision else { return Some(Written::Failed(job)) };
                match (self.raise(hub, kept, above.max(above_revision(revision))), &job) {
                    (Ok(claim), Job::Lead(_)) => Written::Leads(claim, revision),
                    (Ok(claim), _) => Written::Raised(claim, revision),
                    (Err(error), Job::Lead(_)) => {
                        tracing::error!(%error, "the claim of this standby cannot be stored: it waits on");
                        Written::Failed(job)
                    }
                    (Err(error), _) => {
                        tracing::error!(%error, "a raised claim cannot be stored, and is not announced");
                        Written::Nothing
                    }
                }
            }
        })
    }

    fn raise(&self, hub: &SharedHub, mut kept: KeptClaims, above: Claim) -> Result<Claim, String> {
        let claim = above.max(kept.own).raised(random());
        kept.own = claim;
        self.store(hub, &kept)?;
        lock(&self.writer).kept = kept;
        Ok(claim)
    }

    fn keep_obeyed(
        &self,
        hub: &SharedHub,
        keys: &Keys,
        mut kept: KeptClaims,
        manager: Identity,
        tagged: TaggedClaim,
    ) -> Written {
        let ring = keys.ring().map(|live| live.ring());
        let key = ring.as_ref().and_then(|ring| ring.pair(&manager)).map(|key| key.fingerprint());
        let Some(key) = key else { return Written::Failed(Job::Keep(manager, tagged)) };
        let obeyed = KeptObeyed { manager: manager.clone(), tagged, key };
        let handed = hub.lock().hub.node.handed_over(&manager);
        let handed = handed.map(|(home, present)| KeptHandOver { home, present });
        if kept.obeyed.contains(&obeyed) && kept.handed == handed && !lock(&self.writer).is_unsure {
            hub.lock().hub.node.claim_kept(&manager, tagged.claim, true);
            return Written::Nothing;
        }
        kept.obeyed.retain(|obeyed| obeyed.manager != manager);
        kept.obeyed.push(obeyed);
        kept.handed = handed;
        if let Err(error) = self.store(hub, &kept) {
            tracing::error!(%error, "a claim cannot be stored");
            return Written::Failed(Job::Keep(manager, tagged));
        }
        tracing::info!(claim = %tagged.claim, manager = manager.name(), "a claim is obeyed, and stored");
        lock(&self.writer).kept = kept;
        hub.lock().hub.node.claim_kept(&manager, tagged.claim, true);
        Written::Obeyed
    }

    /// Whether the unit steps down from here on, and whether it did before.
    pub(super) fn step_down(&self, ends: bool) -> bool {
        std::mem::replace(&mut lock(&self.writer).ends, ends)
    }

    /// Waits until everything is written, but not for a hung disk.
    pub(super) fn await_writer(&self) {
        let until = Instant::now() + STORING;
        while lock(&self.writer).runs && Instant::now() < until {
            std::thread::sleep(LOOK);
        }
    }
}

/// The highest claim that is not above this revision of an authority's key: the next one is.
pub(super) const fn above_revision(revision: u64) -> Claim {
    Claim { term: revision, claimant: 0 }
}

/// Whether the pair key with which a claim was obeyed is still there.
fn has_key(ring: &KeyRing, obeyed: &KeptObeyed) -> bool {
    let has = ring.pairs(&obeyed.manager).any(|(_, key)| key.fingerprint() == obeyed.key);
    if !has {
        tracing::info!(manager = obeyed.manager.name(), "a stored claim does not count: the keys are other ones");
    }
    has
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn claims_to_be_raised_wait_as_one_job_and_keep_nothing_out() {
        let claims = Claims::new(None, TakeOver::No, false);
        let above = |term| Claim { term, claimant: 0 };
        for term in [3, 1, 7, 2] {
            for job in [Job::Raise(above(term)), Job::Lead(above(term)), Job::Heard(above(term))] {
                assert!(claims.leave_to_writer(job, || ()).is_empty());
            }
        }
        let waiting = &lock(&claims.writer).waiting;
        let highest = above(7);
        assert!(
            matches!(&waiting[..], [Job::Raise(raise), Job::Lead(lead), Job::Heard(heard)] if [raise, lead, heard] == [&highest; 3]),
            "{waiting:?}"
        );
    }
}
