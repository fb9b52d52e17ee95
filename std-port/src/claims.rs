//! Where a unit keeps its claims on Linux: a small file in its folder of state, written whole, and on the disk before a claim is
//! announced or a moving call begins under it.

use std::env;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use cara_core::distribution::identity::{Fleet, Identity};
use rustix::fs::{FlockOperation, flock};

use crate::file_name::escape;
use crate::keys::{self, KeptClaims, KeyError};

/// Names the folder of state.
pub(crate) const VARIABLE: &str = "CARA_STATE";
/// The same as systemd sets it for `StateDirectory=`.
const OF_SYSTEMD: &str = "STATE_DIRECTORY";

/// The folder of state that the environment names: `CARA_STATE`, or else systemd's `STATE_DIRECTORY`.
pub(crate) fn folder() -> Option<PathBuf> {
    let set = |name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set(VARIABLE).or_else(|| set(OF_SYSTEMD))
}

/// The file of a unit's claims.
#[derive(Debug)]
pub(crate) struct ClaimFile {
    pub(crate) path: PathBuf,
}

impl ClaimFile {
    pub(crate) fn of(folder: &Path, identity: &Identity, fleet: Fleet) -> Self {
        let role = identity.role().as_str();
        let name = format!("{}-{}-{role}-{}.claims", escape(identity.name()), identity.id(), fleet.0);
        Self { path: folder.join(name) }
    }

    /// The unit's file at this path, and its fleet; `None` for any other file.
    #[cfg(feature = "control")]
    pub(crate) fn at(path: PathBuf, unit: &crate::NameAndId) -> Option<(u32, Self)> {
        let name = path.file_name()?.to_str()?;
        let rest = name.strip_prefix(&format!("{}-{}-", escape(&unit.name), unit.id))?.strip_suffix(".claims")?;
        let (role, fleet) = rest.split_once('-')?;
        let fleet = ["m_unit", "s_unit"].contains(&role).then(|| fleet.parse().ok())??;
        Some((fleet, Self { path }))
    }

    /// What is kept. A file that is missing, or damaged, keeps nothing: that locks no unit out, and is reported in the log.
    pub(crate) fn read(&self) -> KeptClaims {
        keys::read_claims(&self.path).map(Option::unwrap_or_default).unwrap_or_else(|error| {
            // The advice of those two is for keys.
            let why = match error {
                KeyError::Damaged(_) | KeyError::Form { .. } => "it is damaged".to_owned(),
                error => error.to_string(),
            };
            tracing::warn!(path = %self.path.display(), "the kept claims cannot be read, and count as none: {why}");
            KeptClaims::default()
        })
    }

    /// As long as this is there the unit runs, and [`forget_claims`](crate::control::forget_claims) leaves the file alone.
    pub(crate) fn hold(&self) -> io::Result<File> {
        let folder = self.path.parent().unwrap_or(Path::new("."));
        keys::make_folder(folder).map_err(io::Error::other)?;
        self.lock(FlockOperation::NonBlockingLockShared)
    }

    pub(crate) fn lock(&self, how: FlockOperation) -> io::Result<File> {
        let path = self.path.with_added_extension("lock");
        let file = OpenOptions::new().write(true).create(true).truncate(false).mode(0o600).open(path)?;
        flock(&file, how)?;
        Ok(file)
    }

    /// Keeps claims: on the disk, with the file's name, when this returns.
    pub(crate) fn keep(&self, kept: &KeptClaims) -> Result<(), KeyError> {
        keys::write_claims(&self.path, kept)
    }
}

#[cfg(test)]
mod tests {
    use cara_core::distribution::claim::{Claim, TaggedClaim};

    use super::*;
    use crate::keys::{KeptHandOver, KeptObeyed};

    #[test]
    fn what_is_kept_is_read_and_what_is_damaged_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let depot = Identity::m_unit("depot", 1).unwrap();
        let file = ClaimFile::of(&folder.path().join("state"), &depot, Fleet(7));
        assert_eq!(file.read(), KeptClaims::default());
        let claim = |term| Claim { term, claimant: u64::MAX };
        let manager = Identity::m_unit("a hall with spaces", 2).unwrap();
        let tagged = TaggedClaim { claim: claim(u64::MAX), tag: [0xA5; 16] };
        let obeyed = KeptObeyed { manager, tagged, key: [7; 6] };
        let kept = KeptClaims { own: claim(3), obeyed: vec![obeyed.clone(), obeyed], handed: None };
        let handed = KeptHandOver { home: depot.clone(), present: Identity::m_unit("the yard", 3).unwrap() };
        let moved = KeptClaims { handed: Some(handed), ..kept.clone() };
        for kept in [KeptClaims { own: claim(u64::MAX), ..KeptClaims::default() }, kept, moved] {
            file.keep(&kept).unwrap();
            assert_eq!(file.read(), kept);
        }
        let right = std::fs::read(&file.path).unwrap();
        for at in 0..right.len() {
            let mut wrong = right.clone();
            wrong[at] ^= 1;
            std::fs::write(&file.path, wrong).unwrap();
            assert_eq!(file.read(), KeptClaims::default(), "{at}");
            std::fs::write(&file.path, &right[..at]).unwrap();
            assert_eq!(file.read(), KeptClaims::default(), "{at}");
        }
    }
}
