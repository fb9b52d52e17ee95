//! Where a unit keeps its term on Linux: a small file in its folder of state, written whole, and on the disk before the
//! term is told to others.

use std::env;
use std::path::{Path, PathBuf};

use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::term::Term;

use crate::file_name::escape;
use crate::keys::{self, KeyError};

/// Names the folder of state.
pub(crate) const VARIABLE: &str = "CARA_STATE";
/// The same as systemd sets it for `StateDirectory=`.
const OF_SYSTEMD: &str = "STATE_DIRECTORY";

/// The folder of state that the environment names.
pub(crate) fn folder() -> Option<PathBuf> {
    let set = |name| env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set(VARIABLE).or_else(|| set(OF_SYSTEMD))
}

/// The file of a unit's term.
#[derive(Debug)]
pub(crate) struct TermFile {
    path: PathBuf,
}

impl TermFile {
    pub(crate) fn of(folder: &Path, identity: &Identity, fleet: Fleet) -> Self {
        let role = identity.role().as_str();
        let name = format!("{}-{}-{role}-{}.term", escape(identity.name()), identity.id(), fleet.0);
        Self { path: folder.join(name) }
    }

    #[cfg(test)]
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// What is kept. A file that is missing, or damaged, keeps nothing: that locks no unit out, and is told in the log.
    pub(crate) fn read(&self) -> Term {
        match keys::read_term(&self.path) {
            Ok(term) => term.map_or(Term::NONE, Term),
            Err(error) => {
                // The advice of those two is for keys.
                let why = match error {
                    KeyError::Damaged(_) | KeyError::Form { .. } => "it is damaged".to_owned(),
                    error => error.to_string(),
                };
                tracing::warn!(path = %self.path.display(), "the kept term cannot be read, and counts as none: {why}");
                Term::NONE
            }
        }
    }

    /// Keeps a term: on the disk, with its name, when this returns.
    pub(crate) fn keep(&self, term: Term) -> Result<(), KeyError> {
        keys::write_term(&self.path, term.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_is_read_and_what_is_damaged_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let depot = Identity::m_unit("depot", 1).unwrap();
        let file = TermFile::of(&folder.path().join("state"), &depot, Fleet(7));
        assert_eq!(file.read(), Term::NONE);
        for term in [Term(1), Term(u32::MAX)] {
            file.keep(term).unwrap();
            assert_eq!(file.read(), term);
        }
        let right = std::fs::read(file.path()).unwrap();
        for at in 0..right.len() {
            let mut wrong = right.clone();
            wrong[at] ^= 1;
            std::fs::write(file.path(), wrong).unwrap();
            assert_eq!(file.read(), Term::NONE, "{at}");
            std::fs::write(file.path(), &right[..at]).unwrap();
            assert_eq!(file.read(), Term::NONE, "{at}");
        }
        file.keep(Term(3)).unwrap();
        assert_eq!(file.read(), Term(3));
    }
}
