//! What a vehicle has obeyed is forgotten, by an operator on its host while its program does not run.

use std::io;
use std::path::{Path, PathBuf};

use cara_core::distribution::claim::Claim;
use cara_core::distribution::identity::Identity;
use rustix::fs::FlockOperation;

use super::audit;
use crate::NameAndId;
use crate::claims::{self, ClaimFile};
use crate::keys::{self, KeyError};

/// What a unit had obeyed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Forgotten {
    /// The unit's fleet.
    pub fleet: u32,
    /// Whose claim it was.
    pub manager: Identity,
    /// The claim.
    pub claim: Claim,
}

/// Why a unit's claims are not forgotten.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ForgetError {
    /// The unit's program has the file.
    #[error("{0} runs: stop its program first, so that nothing that it moves can be under way")]
    Runs(NameAndId),
    /// The folder cannot be read.
    #[error("{0}: {1}")]
    Folder(PathBuf, io::Error),
    /// The file cannot be read or written.
    #[error(transparent)]
    File(#[from] KeyError),
    /// Nothing is forgotten that is not written down.
    #[error("nothing is forgotten, since the audit log {0} takes no line: {1}")]
    Audit(PathBuf, io::Error),
}

/// The folder of state that a unit has unless it is told another: what `CARA_STATE` names, or else systemd's `STATE_DIRECTORY`.
pub fn state_folder() -> Option<PathBuf> {
    claims::folder()
}

/// Forgets the claims that a unit with this [folder of state](crate::Builder::state_folder) has obeyed, of one fleet or of all, while
/// its program does not run: it obeys any manager of these identities again. A vehicle
/// that was handed over belongs to its configured manager again. What the unit itself has claimed stays. A line in the
/// [audit log](crate::Builder::audit) comes first.
pub fn forget_claims(
    folder: &Path,
    unit: &NameAndId,
    fleet: Option<u32>,
    audit: &Path,
) -> Result<Vec<Forgotten>, ForgetError> {
    let wrong = |error| ForgetError::Folder(folder.to_owned(), error);
    let mut all = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(wrong)? {
        let path = entry.map_err(wrong)?.path();
        let found = ClaimFile::at(path, unit).filter(|(of, _)| fleet.is_none_or(|fleet| fleet == *of));
        let Some((of, file)) = found else { continue };
        let _lock = file.lock(FlockOperation::NonBlockingLockExclusive).map_err(|error| {
            if error.kind() == io::ErrorKind::WouldBlock { ForgetError::Runs(unit.clone()) } else { wrong(error) }
        })?;
        let mut kept = keys::read_claims(&file.path)?.unwrap_or_default();
        kept.handed = None;
        let obeyed = kept.obeyed.drain(..);
        let forgotten: Vec<_> =
            obeyed.map(|obeyed| Forgotten { fleet: of, manager: obeyed.manager, claim: obeyed.tagged.claim }).collect();
        if forgotten.is_empty() {
            continue;
        }
        audit::note(audit, "forget-claim", &unit.to_string(), "ok")
            .map_err(|error| ForgetError::Audit(audit.to_owned(), error))?;
        file.keep(&kept)?;
        all.extend(forgotten);
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::claim::TaggedClaim;

    use super::*;
    use crate::keys::{KeptClaims, KeptObeyed};

    #[test]
    fn what_is_obeyed_is_forgotten_and_written_down_unless_the_unit_runs() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let (unit, audit): (NameAndId, _) = ("agv-1/7".parse().unwrap(), path("audit.log"));
        let manager = Identity::m_unit("depot", 1).unwrap();
        let claim = |term| Claim { term, claimant: 3 };
        let obeyed =
            KeptObeyed { manager: manager.clone(), tagged: TaggedClaim { claim: claim(9), tag: [1; 16] }, key: [2; 6] };
        let kept = KeptClaims { own: claim(4), obeyed: vec![obeyed], handed: None };
        let files = ["agv-1-7-s_unit-3", "agv-1-7-m_unit-4", "agv-1-8-s_unit-3", "agv-7-s_unit-3"]
            .map(|name| ClaimFile { path: path(name).with_added_extension("claims") });
        files.iter().for_each(|file| file.keep(&kept).unwrap());
        let forget = |fleet| forget_claims(folder.path(), &unit, fleet, &audit);

        let runs = files[0].hold().unwrap();
        assert!(matches!(forget(Some(3)), Err(ForgetError::Runs(of)) if of == unit));
        assert_eq!((files[0].read(), audit.exists()), (kept.clone(), false));
        drop(runs);
        let forgotten = Forgotten { fleet: 3, manager, claim: claim(9) };
        assert_eq!(forget(Some(3)).unwrap(), std::slice::from_ref(&forgotten));
        assert_eq!(files[0].read(), KeptClaims { own: claim(4), ..KeptClaims::default() });
        assert!(files[1..].iter().all(|file| file.read() == kept));
        let lines = std::fs::read_to_string(&audit).unwrap();
        assert!(lines.contains("forget-claim") && lines.contains("agv-1/7") && lines.lines().count() == 1, "{lines}");

        // Nothing is forgotten that cannot be written down.
        let nowhere = path("none").join("audit.log");
        assert!(matches!(forget_claims(folder.path(), &unit, None, &nowhere), Err(ForgetError::Audit(..))));
        assert_eq!(files[1].read(), kept);
        assert_eq!(forget(None).unwrap(), [Forgotten { fleet: 4, ..forgotten }]);
        assert!(forget(None).unwrap().is_empty());
        assert!(matches!(forget_claims(&path("none"), &unit, None, &audit), Err(ForgetError::Folder(..))));
    }
}
