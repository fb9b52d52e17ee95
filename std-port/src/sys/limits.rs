//! How many descriptors the process may have: each link takes one.

use std::os::fd::{AsFd, AsRawFd};

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Descriptors that a process has besides the links: its own files, and the sockets and wakers of a few units.
const BESIDES: u64 = 64;

/// Raises the soft limit of open files to the hard one, so that as many links fit as the administrator allows.
///
/// Most systems begin with 1,024, for programs that still use `select`. Returns the limit in force.
pub(crate) fn raise() -> u64 {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let Some(soft) = current else { return u64::MAX };
    if maximum.is_some_and(|hard| hard <= soft) {
        return soft;
    }
    match setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }) {
        Ok(()) => maximum.unwrap_or(u64::MAX),
        Err(errno) => {
            tracing::debug!(%errno, "the limit of open files could not be raised");
            soft
        }
    }
}

/// Makes room for so many links where the soft limit is too low; `false`, and a warning, where the hard one is.
pub fn make_room_for(links: usize) -> bool {
    let needed = (links as u64).saturating_add(BESIDES);
    let is_enough = is_enough(getrlimit(Resource::Nofile).current, needed) || is_enough(Some(raise()), needed);
    if !is_enough {
        tracing::warn!(needed, limit = raise(), "fewer files may be open than links are allowed: raise ulimit -Hn");
    }
    is_enough
}

/// For how many links there is room at most.
pub fn most_links() -> u64 {
    getrlimit(Resource::Nofile).maximum.map_or(u64::MAX, |limit| limit.saturating_sub(BESIDES))
}

/// How many descriptors the process may open beyond this one. It is the newest, and the system gives the lowest number that is
/// free: so all below are taken.
pub(crate) fn left_above(newest: impl AsFd) -> u64 {
    let number = u64::try_from(newest.as_fd().as_raw_fd()).unwrap_or(0);
    getrlimit(Resource::Nofile).current.map_or(u64::MAX, |limit| limit.saturating_sub(number + 1))
}

fn is_enough(limit: Option<u64>, needed: u64) -> bool {
    limit.is_none_or(|limit| limit >= needed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_soft_limit_becomes_the_hard_one() {
        let limit = raise();
        let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
        assert_eq!((current, current), (maximum, Some(limit)));
        // Too many for any system: it warns, and goes on with what there is.
        assert!(!make_room_for(usize::MAX) && make_room_for(1));
        assert_eq!(getrlimit(Resource::Nofile).current, current);
    }

    #[test]
    fn no_limit_is_enough() {
        assert!(is_enough(None, u64::MAX) && is_enough(Some(7), 7) && !is_enough(Some(7), 8));
    }
}
